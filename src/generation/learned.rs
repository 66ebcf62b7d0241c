//! What a model learned from: digests of songs and phrases, which are the same under any name and in any store.

use std::collections::BTreeSet;
use std::fmt;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Hexadecimal digits of a digest that are kept: 64 bits.
const N_DIGITS: usize = 16;

/// The first 16 hexadecimal digits of a BLAKE3 digest.
///
/// Among a million songs, another one is taken for one of them with a chance of 10⁶ / 2⁶⁴ = 5·10⁻¹⁴.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ShortDigest(u64);

impl ShortDigest {
    /// Returns the beginning of a digest; none where the text is no digest.
    pub fn of_digest(digest: &str) -> Option<Self> {
        let short = digest.get(..N_DIGITS)?;
        // from_str_radix would take a sign and capitals, which no digest of this program has.
        let is_digit = |c: u8| c.is_ascii_digit() || (b'a'..=b'f').contains(&c);
        if !short.bytes().all(is_digit) {
            return None;
        }
        u64::from_str_radix(short, 16).ok().map(Self)
    }
}

impl fmt::Display for ShortDigest {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:0N_DIGITS$x}", self.0)
    }
}

impl Serialize for ShortDigest {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for ShortDigest {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::of_digest(&text).filter(|_| text.len() == N_DIGITS).ok_or_else(|| {
            let start: String = text.chars().take(2 * N_DIGITS).collect();
            serde::de::Error::custom(format!(
                "{start:?} is no digest; it must be {N_DIGITS} hexadecimal digits"
            ))
        })
    }
}

/// Digests of music: of whole songs, and of the phrases cut from them. Each is listed once, in order.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct MusicDigests {
    /// `song_hash` of the table of phrases.
    pub songs: BTreeSet<ShortDigest>,
    /// `content_hash` of the table of phrases.
    pub phrases: BTreeSet<ShortDigest>,
}

impl MusicDigests {
    fn has(&self, song: Option<ShortDigest>, phrase: Option<ShortDigest>) -> bool {
        song.is_some_and(|song| self.songs.contains(&song))
            || phrase.is_some_and(|phrase| self.phrases.contains(&phrase))
    }

    fn add(&mut self, other: Self) {
        self.songs.extend(other.songs);
        self.phrases.extend(other.phrases);
    }
}

/// The music that a model learned from.
///
/// Digests are the first 16 hexadecimal digits of those in the table of phrases ([`ShortDigest`]).
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LearnedFrom {
    /// Fingerprint of the dataset.
    pub data: String,
    /// The music that its weights were fitted to.
    pub trained_on: MusicDigests,
    /// The music that its checkpoints were chosen on.
    pub validated_on: MusicDigests,
    /// Whether the song of every phrase is known; if not, a song that is not listed may have been learned from.
    pub is_complete: bool,
}

/// The use of a phrase in training.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Purpose {
    Training,
    Validation,
}

/// Which music a motion was made for, as the model's card knows it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum MusicSplit {
    /// The model has not met it.
    HeldOut,
    /// The model was not fitted to it, but chosen by it.
    Validation,
    TrainedOn,
    /// The card does not tell.
    Unknown,
}

impl MusicSplit {
    /// Returns the name that tables use.
    pub fn name(self) -> &'static str {
        match self {
            Self::HeldOut => "held_out",
            Self::Validation => "validation",
            Self::TrainedOn => "trained_on",
            Self::Unknown => "unknown",
        }
    }
}

impl LearnedFrom {
    /// Lists the phrases that a model learns from: what each is used for, its `song_hash` and its `content_hash`.
    pub fn new<'a>(
        data: &str,
        phrases: impl IntoIterator<Item = (Purpose, Option<&'a str>, &'a str)>,
    ) -> Self {
        let (trained_on, validated_on) = (MusicDigests::default(), MusicDigests::default());
        let mut new = Self { data: data.to_owned(), trained_on, validated_on, is_complete: true };
        for (purpose, song_hash, content_hash) in phrases {
            let digests = match purpose {
                Purpose::Training => &mut new.trained_on,
                Purpose::Validation => &mut new.validated_on,
            };
            let song = song_hash.and_then(ShortDigest::of_digest);
            let phrase = ShortDigest::of_digest(content_hash);
            new.is_complete &= song.is_some() && phrase.is_some();
            digests.songs.extend(song);
            digests.phrases.extend(phrase);
        }
        new
    }

    /// Adds what a later course of training learned from.
    pub fn and(mut self, later: Self) -> Self {
        self.trained_on.add(later.trained_on);
        self.validated_on.add(later.validated_on);
        self.is_complete &= later.is_complete;
        self
    }

    /// Adds what another look at the same phrases found: digests that the table had not before.
    pub fn refreshed(self, found: Self) -> Self {
        let is_complete = self.is_complete || found.is_complete;
        Self { is_complete, ..self.and(found) }
    }

    /// Returns which music a phrase is, by its `song_hash` and `content_hash`.
    ///
    /// A song that was trained on stays so whatever else it was used for, and so does one that was validated on.
    /// Only music with an identity can be held out, and only from a list that is complete.
    pub fn split_of(&self, song_hash: Option<&str>, content_hash: &str) -> MusicSplit {
        let song = song_hash.and_then(ShortDigest::of_digest);
        let phrase = ShortDigest::of_digest(content_hash);
        if self.trained_on.has(song, phrase) {
            MusicSplit::TrainedOn
        } else if self.validated_on.has(song, phrase) {
            MusicSplit::Validation
        } else if self.is_complete && song.is_some() && !self.trained_on.songs.is_empty() {
            MusicSplit::HeldOut
        } else {
            MusicSplit::Unknown
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn hash(name: &str) -> String {
        digits(name).repeat(4)
    }

    /// Sixteen digits for a name, another for every name of up to eight bytes.
    fn digits(name: &str) -> String {
        let bytes = name.bytes().chain(std::iter::repeat(0)).take(8);
        bytes.map(|byte| format!("{byte:02x}")).collect()
    }

    fn learned(phrases: &[(Purpose, Option<&str>, &str)]) -> LearnedFrom {
        let hashed: Vec<_> =
            phrases.iter().map(|&(u, song, phrase)| (u, song.map(hash), hash(phrase))).collect();
        LearnedFrom::new("d", hashed.iter().map(|(u, s, p)| (*u, s.as_deref(), p.as_str())))
    }

    fn known() -> LearnedFrom {
        learned(&[
            (Purpose::Training, Some("song a"), "a1"),
            (Purpose::Training, Some("song a"), "a2"),
            (Purpose::Training, Some("both"), "b1"),
            (Purpose::Validation, Some("both"), "b2"),
            (Purpose::Validation, Some("song v"), "v1"),
        ])
    }

    fn split(learned: &LearnedFrom, song: Option<&str>, phrase: &str) -> &'static str {
        learned.split_of(song.map(hash).as_deref(), &hash(phrase)).name()
    }

    #[test]
    fn digests_decide_what_was_held_out() {
        let known = known();
        assert_eq!((known.trained_on.songs.len(), known.trained_on.phrases.len()), (2, 3));
        for (song, phrase, expected) in [
            (Some("song a"), "new", "trained_on"),
            (None, "a2", "trained_on"),
            // Of a song that was trained on, a phrase that was validated on is not held out.
            (Some("both"), "b2", "trained_on"),
            (None, "b2", "validation"),
            (Some("song v"), "new", "validation"),
            (Some("song n"), "new", "held_out"),
            (None, "new", "unknown"),
        ] {
            assert_eq!(split(&known, song, phrase), expected, "{song:?} {phrase}");
        }
        // Digits beyond the sixteenth are not looked at; what is no digest has no identity.
        let longer = format!("{}{}", digits("song a"), "0".repeat(48));
        assert_eq!(known.split_of(Some(&longer), "").name(), "trained_on");
        assert_eq!(known.split_of(Some("song"), "a1").name(), "unknown");
        assert_eq!(known.split_of(Some(&hash("song n").to_uppercase()), "").name(), "unknown");
    }

    #[test]
    fn a_list_with_gaps_holds_nothing_out() {
        let gap =
            learned(&[(Purpose::Training, None, "a1"), (Purpose::Training, Some("song b"), "b1")]);
        assert!(!gap.is_complete);
        assert_eq!(split(&gap, Some("song n"), "new"), "unknown");
        assert_eq!(split(&gap, Some("song b"), "new"), "trained_on");
        assert_eq!(split(&gap, Some("song n"), "a1"), "trained_on");
        // A gap of the validation is one, too.
        let gap =
            learned(&[(Purpose::Training, Some("song a"), "a1"), (Purpose::Validation, None, "v")]);
        assert_eq!(split(&gap, Some("song n"), "new"), "unknown");
        // Who names nothing says nothing.
        assert_eq!(split(&learned(&[]), Some("song n"), "new"), "unknown");
        // Two courses of training: a gap of either is one of both, another look at the same phrases fills it.
        let full = learned(&[(Purpose::Training, Some("song a"), "a1")]);
        let gap = learned(&[(Purpose::Training, None, "a1")]);
        assert!(!full.clone().and(gap.clone()).is_complete);
        assert!(!gap.clone().and(full.clone()).is_complete);
        assert_eq!(gap.refreshed(full.clone()), full);
    }

    #[test]
    fn lists_are_written_in_order_and_read_back() {
        let text = serde_json::to_string(&known()).expect("JSON");
        let list = |names: &[&str]| {
            let digits: Vec<String> = names.iter().map(|n| format!("\"{}\"", digits(n))).collect();
            digits.join(",")
        };
        let expected = format!(
            "{{\"data\":\"d\",\"trained_on\":{{\"songs\":[{}],\"phrases\":[{}]}},\"validated_on\":{{\
             \"songs\":[{}],\"phrases\":[{}]}},\"is_complete\":true}}",
            list(&["both", "song a"]),
            list(&["a1", "a2", "b1"]),
            list(&["both", "song v"]),
            list(&["b2", "v1"])
        );
        assert_eq!(text, expected);
        assert_eq!(serde_json::from_str::<LearnedFrom>(&text).expect("its own"), known());
        // A digest that is cut short would match nothing, and what it stands for would pass for held out.
        for broken in ["6131", &"A".repeat(16), &"6".repeat(17), "+131000000000000"] {
            let text = text.replacen(&digits("a1"), broken, 1);
            let error = serde_json::from_str::<LearnedFrom>(&text).expect_err(broken).to_string();
            let start = format!("{broken:?} is no digest; it must be 16 hexadecimal digits at ");
            assert!(error.starts_with(&start), "{error}");
        }
    }
}
