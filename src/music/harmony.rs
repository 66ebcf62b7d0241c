//! Chords by their symbols, and scales.

/// A chord.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Chord {
    /// Pitch class of the root, 0 is C.
    pub root: u8,
    /// Semitones from the root, the first 0.
    pub intervals: &'static [u8],
    /// Pitch class of the lowest tone, usually the root.
    pub bass: u8,
}

/// Qualities by their spelling, as ABC 2.1 and lead sheets have them.
const QUALITIES: [(&str, &[u8]); 26] = [
    ("", &[0, 4, 7]),
    ("maj", &[0, 4, 7]),
    ("M", &[0, 4, 7]),
    ("m", &[0, 3, 7]),
    ("min", &[0, 3, 7]),
    ("-", &[0, 3, 7]),
    ("7", &[0, 4, 7, 10]),
    ("m7", &[0, 3, 7, 10]),
    ("min7", &[0, 3, 7, 10]),
    ("maj7", &[0, 4, 7, 11]),
    ("M7", &[0, 4, 7, 11]),
    ("6", &[0, 4, 7, 9]),
    ("m6", &[0, 3, 7, 9]),
    ("9", &[0, 4, 7, 10, 14]),
    ("m9", &[0, 3, 7, 10, 14]),
    ("maj9", &[0, 4, 7, 11, 14]),
    ("dim", &[0, 3, 6]),
    ("o", &[0, 3, 6]),
    ("dim7", &[0, 3, 6, 9]),
    ("m7b5", &[0, 3, 6, 10]),
    ("aug", &[0, 4, 8]),
    ("+", &[0, 4, 8]),
    ("sus", &[0, 5, 7]),
    ("sus4", &[0, 5, 7]),
    ("sus2", &[0, 2, 7]),
    ("5", &[0, 7]),
];

/// Pitch classes of the letters C to B.
const LETTERS: [(char, u8); 7] =
    [('C', 0), ('D', 2), ('E', 4), ('F', 5), ('G', 7), ('A', 9), ('B', 11)];

impl Chord {
    /// Reads a symbol such as `Am7`, `Bb` or `C/E`; a quality that is not known counts as major or minor by its
    /// first letter, and `None` is what names no root.
    pub fn parse(symbol: &str) -> Option<Self> {
        let (upper, lower) = symbol.split_once('/').unwrap_or((symbol, ""));
        let (root, quality) = pitch_class(upper)?;
        let quality = quality.trim_matches(|c: char| c.is_whitespace() || c == '(' || c == ')');
        let named = QUALITIES.iter().find(|(name, _)| *name == quality);
        let is_minor = quality.starts_with('m') && !quality.starts_with("maj");
        let fallback: &[u8] = if is_minor { &[0, 3, 7] } else { &[0, 4, 7] };
        let intervals = named.map_or(fallback, |(_, intervals)| intervals);
        Some(Self { root, intervals, bass: pitch_class(lower).map_or(root, |(bass, _)| bass) })
    }

    /// Returns the chord `semitones` higher.
    pub fn transposed(self, semitones: u8) -> Self {
        let up = |class: u8| (class + semitones) % 12;
        Self { root: up(self.root), bass: up(self.bass), ..self }
    }

    /// Returns whether a pitch is one of the chord's, in any octave.
    pub fn has(self, pitch: u8) -> bool {
        self.intervals.iter().any(|i| (self.root + i) % 12 == pitch % 12)
    }

    /// Returns its tones as MIDI notes, each in the octave from `lowest` on, ascending.
    pub fn voiced(self, lowest: u8) -> Vec<u8> {
        let mut tones: Vec<u8> =
            self.intervals.iter().map(|i| at_or_above((self.root + i) % 12, lowest)).collect();
        tones.sort_unstable();
        tones.dedup();
        tones
    }
}

/// Returns the pitch of a pitch class in the octave that begins at `lowest`.
pub fn at_or_above(class: u8, lowest: u8) -> u8 {
    lowest + (class + 12 - lowest % 12) % 12
}

/// Reads a letter with its accidental; returns the pitch class and what follows.
fn pitch_class(text: &str) -> Option<(u8, &str)> {
    let first = text.chars().next()?;
    let (_, class) = *LETTERS.iter().find(|(letter, _)| *letter == first)?;
    let rest = &text[first.len_utf8()..];
    let raised = |accidentals: &[char], by: u8| {
        rest.strip_prefix(accidentals).map(|rest| ((class + by) % 12, rest))
    };
    raised(&['#', '♯'], 1).or_else(|| raised(&['b', '♭'], 11)).or(Some((class, rest)))
}

/// Reads a loop of chords, a word per bar; chords within a bar are parted by commas.
///
/// Symbols that are no chords are left out; a bar is never without chords unless all of its symbols are none.
pub fn chord_loop(text: &str) -> Vec<Vec<Chord>> {
    text.split_whitespace().map(|bar| bar.split(',').filter_map(Chord::parse).collect()).collect()
}

/// Returns the pitches of a scale from `lowest` to `highest`: pitch classes relative to `tonic`.
pub fn scale(tonic: u8, classes: &[u8], lowest: u8, highest: u8) -> Vec<u8> {
    let is_in = |pitch: &u8| classes.contains(&((pitch + 12 - tonic % 12) % 12));
    (lowest..=highest).filter(is_in).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn symbols_are_read() {
        let tones = |symbol: &str| Chord::parse(symbol).map(|chord| chord.voiced(60));
        for (symbol, expected) in [
            ("C", vec![60, 64, 67]),
            ("Am", vec![60, 64, 69]),
            ("Bb7", vec![62, 65, 68, 70]),
            ("F#m7b5", vec![60, 64, 66, 69]),
            ("Cmaj7", vec![60, 64, 67, 71]),
            ("G7sus4", vec![62, 67, 71]),
            ("Cb", vec![63, 66, 71]),
            ("G/B", vec![62, 67, 71]),
        ] {
            assert_eq!(tones(symbol), Some(expected), "{symbol}");
        }
        assert_eq!(Chord::parse("G/B").map(|chord| (chord.root, chord.bass)), Some((7, 11)));
        for symbol in ["", "N.C.", "x", "slowly", "ä"] {
            assert_eq!(tones(symbol), None, "{symbol}");
        }
        let chord = Chord::parse("Am").expect("a chord").transposed(5);
        assert_eq!((chord.root, chord.has(74), chord.has(73)), (2, true, false));
        assert_eq!(chord_loop("Am F,G").iter().map(Vec::len).collect::<Vec<_>>(), [1, 2]);
    }

    #[test]
    fn scales_and_octaves() {
        assert_eq!(scale(2, &[0, 2, 4], 60, 75), [62, 64, 66, 74]);
        assert_eq!([at_or_above(0, 60), at_or_above(11, 60), at_or_above(9, 45)], [60, 71, 45]);
    }
}
