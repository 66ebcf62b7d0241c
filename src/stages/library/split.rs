//! Which songs are for training, which for validation and which for the test.

use std::collections::BTreeMap;
use std::fmt;
use std::str::FromStr;

use crate::store::digest;

pub const TRAIN: &str = "train";
pub const VALIDATION: &str = "validation";
pub const TEST: &str = "test";

/// Fewest songs that are split.
const MIN_SPLIT_SONGS: usize = 3;

/// How many songs: a number, or a fraction of all.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SongShare {
    Songs(usize),
    Fraction(f64),
}

impl SongShare {
    /// Returns how many of `n` songs that is; of a fraction above 0, at least one.
    fn of(self, n: usize) -> usize {
        match self {
            SongShare::Songs(songs) => songs,
            SongShare::Fraction(0.0) => 0,
            SongShare::Fraction(fraction) => ((fraction * n as f64).round() as usize).max(1),
        }
    }
}

impl FromStr for SongShare {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Ok(songs) = text.parse() {
            return Ok(SongShare::Songs(songs));
        }
        match text.parse() {
            Ok(fraction) if (0.0..1.0).contains(&fraction) => Ok(SongShare::Fraction(fraction)),
            _ => Err("give a number of songs such as 2, or a fraction such as 0.1".to_owned()),
        }
    }
}

impl fmt::Display for SongShare {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            SongShare::Songs(songs) => write!(f, "{songs}"),
            // With its point, so that it is read back as a fraction.
            SongShare::Fraction(fraction) => write!(f, "{fraction:?}"),
        }
    }
}

/// Returns the split of every song, by a stable hash of the names: in the order of their digests, the
/// first songs validate, the next are for the test, the rest train. Fewer than three songs all train.
///
/// # Errors
/// A sentence where no song would be left to train.
pub fn assign<'a>(
    songs: impl Iterator<Item = &'a str>,
    validation: SongShare,
    test: SongShare,
) -> Result<BTreeMap<&'a str, &'static str>, String> {
    let mut ordered: Vec<(String, &str)> =
        songs.map(|song| (digest(song.as_bytes()), song)).collect();
    ordered.sort();
    ordered.dedup();
    let n = ordered.len();
    let (n_validation, n_test) =
        if n < MIN_SPLIT_SONGS { (0, 0) } else { (validation.of(n), test.of(n)) };
    if n > 0 && n_validation + n_test >= n {
        return Err(format!(
            "{n_validation} songs for validation and {n_test} for the test leave none of {n} to train \
             on; lower --validation-songs or --test-songs, or add songs"
        ));
    }
    let split = |i: usize| match i {
        _ if i < n_validation => VALIDATION,
        _ if i < n_validation + n_test => TEST,
        _ => TRAIN,
    };
    Ok(ordered.into_iter().enumerate().map(|(i, (_, song))| (song, split(i))).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(n: usize) -> Vec<String> {
        (0..n).map(|i| format!("album/song {i}.ogg")).collect()
    }

    fn counts(n: usize, validation: SongShare, test: SongShare) -> [usize; 3] {
        let names = names(n);
        let split = assign(names.iter().map(String::as_str), validation, test).unwrap();
        assert_eq!(split.len(), n);
        [TRAIN, VALIDATION, TEST].map(|s| split.values().filter(|v| **v == s).count())
    }

    #[test]
    fn tenths_are_rounded_and_at_least_one() {
        let tenth = SongShare::Fraction(0.1);
        for (n, expected) in [
            (0, [0, 0, 0]),
            (1, [1, 0, 0]),
            (2, [2, 0, 0]),
            (3, [1, 1, 1]),
            (14, [12, 1, 1]),
            (22, [18, 2, 2]),
            (25, [19, 3, 3]),
        ] {
            assert_eq!(counts(n, tenth, tenth), expected, "{n}");
        }
        assert_eq!(counts(9, SongShare::Songs(3), SongShare::Songs(0)), [6, 3, 0]);
        assert_eq!(counts(9, SongShare::Fraction(0.0), SongShare::Fraction(0.5)), [4, 0, 5]);
    }

    #[test]
    fn the_order_of_the_listing_does_not_matter() {
        let names = names(40);
        let tenth = SongShare::Fraction(0.1);
        let forwards = assign(names.iter().map(String::as_str), tenth, tenth);
        let backwards = assign(names.iter().rev().map(String::as_str), tenth, tenth);
        assert_eq!(forwards, backwards);
    }

    #[test]
    fn somebody_has_to_train() {
        let names = names(4);
        let found =
            assign(names.iter().map(String::as_str), SongShare::Songs(3), SongShare::Fraction(0.1));
        assert_eq!(
            found,
            Err("3 songs for validation and 1 for the test leave none of 4 to train on; lower \
                 --validation-songs or --test-songs, or add songs"
                .to_owned())
        );
    }

    #[test]
    fn shares_are_read_and_written() {
        for (text, share) in [
            ("3", SongShare::Songs(3)),
            ("0.25", SongShare::Fraction(0.25)),
            ("0.0", SongShare::Fraction(0.0)),
        ] {
            assert_eq!(text.parse(), Ok(share));
            assert_eq!(share.to_string(), text);
        }
        for text in ["-1", "1.5", "1.0", "some", "", "nan"] {
            assert!(text.parse::<SongShare>().is_err(), "{text}");
        }
    }
}
