//! Notes against music21's, and tunes that are none.

use proptest::prelude::*;

use super::*;
use crate::music::{Voice, arrange, synth};

/// Onset and duration in quarters as fractions, and pitch, as music21 read them (`tests/golden/music/make.py`).
const GOLDEN: &str = include_str!("../../../tests/golden/music/tunes.tsv");
const TUNES: &[u8] = include_bytes!("../../../tests/golden/music/tunes.abc");

fn ticks(quarters: &str) -> i64 {
    let (over, under) = quarters.split_once('/').unwrap_or((quarters, "1"));
    let number = |text: &str| text.parse::<i64>().expect("a number");
    number(over) * i64::from(TICKS_PER_WHOLE) / 4 / number(under)
}

#[test]
fn notes_are_those_of_music21() {
    let found = read(TUNES);
    assert_eq!(found.len(), 6);
    for (i, found) in found.iter().enumerate() {
        let tune = found.tune.as_ref().expect("a tune");
        let number = (i + 1).to_string();
        let mut expected: Vec<(i64, i64, u8)> = GOLDEN
            .lines()
            .map(|line| line.split('\t').collect::<Vec<_>>())
            .filter(|columns| columns[0] == number)
            .map(|c| (ticks(c[1]), ticks(c[2]), c[3].parse().expect("a pitch")))
            .collect();
        let first = tune.notes[0].onset;
        let mut ours: Vec<(i64, i64, u8)> =
            tune.notes.iter().map(|n| (n.onset - first, i64::from(n.duration), n.pitch)).collect();
        expected.sort_unstable();
        ours.sort_unstable();
        assert_eq!(ours.len(), expected.len(), "tune {number}");
        for (ours, expected) in ours.iter().zip(&expected) {
            assert_eq!(ours, expected, "tune {number}");
        }
    }
}

/// Returns the only tune of a body in C, 4/4 and quarters.
fn tune_of(body: &str) -> Result<Tune, AbcError> {
    let text = format!("X:1\nT:t\nM:4/4\nL:1/4\nK:C\n{body}\n");
    read(text.as_bytes()).remove(0).tune
}

/// Returns pitches in order as letters of an octave.
fn played(body: &str) -> String {
    let tune = tune_of(body).unwrap_or_else(|e| panic!("{body}: {e}"));
    tune.notes.iter().map(|n| char::from(b"CdDeEFgGaAbB"[usize::from(n.pitch % 12)])).collect()
}

#[test]
fn a_rhythm_is_broken_once_between_two_notes() {
    let lengths = |body: &str| -> Vec<u32> {
        tune_of(body).expect("a tune").notes.iter().map(|note| note.duration).collect()
    };
    let quarter = TICKS_PER_WHOLE / 4;
    assert_eq!(lengths("C>D E F"), [quarter * 3 / 2, quarter / 2, quarter, quarter]);
    // Found by fuzzing: each further sign lengthened the first note again, until its ticks overflowed.
    let long = lengths("C>>>D E F");
    assert_eq!(long, [quarter * 15 / 8, quarter / 8, quarter, quarter]);
    assert_eq!(lengths(&format!("C{}D E F", ">".repeat(300))), long);
    assert_eq!(lengths(&format!("C>>>{}D E F", " > < >".repeat(50))), long);
}

#[test]
fn repeats_are_written_out() {
    for (body, expected) in [
        ("C4|D4|", "CD"),
        ("C4|D4:|", "CDCD"),
        ("|:C4:|:D4:|", "CCDD"),
        ("|:C4::D4:|", "CCDD"),
        ("C4|:D4:|E4|", "CDDE"),
        ("|:C4|1 D4:|2 E4|]F4|", "CDCEF"),
        ("|:C4|[1 D4:|[2 E4||F4:|", "CDCEFF"),
        ("|:C4|1,3 D4:|2 E4:|", "CDCECD"),
        ("|:C4|1-2 D4:|3 E4|]", "CDCDCE"),
        ("C4:|D4:|", "CCDD"),
        ("C4|:D4|E4", "CDE"),
        (":|C4|", "C"),
        ("|:|:C4:|", "CC"),
    ] {
        assert_eq!(played(body), expected, "{body}");
    }
}

#[test]
fn bars_are_filled_and_pickups_go_before_them() {
    let tune = tune_of("G|CDEF|GAB:|c|cBAG|CDE|").expect("a tune");
    let onsets: Vec<i64> =
        tune.notes.iter().map(|n| n.onset / i64::from(TICKS_PER_WHOLE / 4)).collect();
    // Pickup, two bars of which the second makes room for the pickup again, and so on.
    let bars =
        [-1, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21, 22];
    assert_eq!(onsets, bars[..onsets.len()]);
    assert_eq!(tune.n_bars, 6);
}

#[test]
fn keys_and_headers_are_read() {
    for (key, f, b) in [
        ("G", 66, 71),
        ("F", 65, 70),
        ("Dm", 65, 70),
        ("D Mixolydian", 66, 71),
        ("Ador", 66, 71),
        ("Ephr", 65, 71),
        ("C#", 66, 72),
        ("Cb", 64, 70),
        ("Fmin", 65, 70),
        ("HP", 66, 71),
        ("none", 65, 71),
        ("", 65, 71),
        ("D =c ^g", 66, 71),
        ("G clef=treble", 66, 71),
        ("Glyd", 66, 71),
    ] {
        let text = format!("X:1\nM:2/4\nL:1/4\nK:{key}\nFB|\n");
        let tune = read(text.as_bytes()).remove(0).tune.unwrap_or_else(|e| panic!("{key}: {e}"));
        assert_eq!([tune.notes[0].pitch, tune.notes[1].pitch], [f, b], "{key}");
    }
    let tune = |header: &str| {
        read(format!("X:1\n{header}\nK:D\nd4|\n").as_bytes()).remove(0).tune.expect("a tune")
    };
    let tempo = |header: &str| tune(header).tempo.map(|t| (t.ticks, t.per_minute));
    let quarter = TICKS_PER_WHOLE / 4;
    assert_eq!(tempo("Q:1/4=120"), Some((quarter, 120.0)));
    assert_eq!(tempo("L:1/8\nQ:90"), Some((quarter / 2, 90.0)));
    assert_eq!(tempo("Q:\"Allegro\" 3/8=112"), Some((quarter * 3 / 2, 112.0)));
    assert_eq!((tempo("Q:\"Slow\""), tempo("Q:0"), tempo("T:x")), (None, None, None));
    // Without L:, an eighth, or a sixteenth in short meters.
    assert_eq!(tune("M:C|").notes[0].duration, quarter * 2);
    assert_eq!(tune("M:2/4").notes[0].duration, quarter);
}

#[test]
fn encodings_and_files_of_several_tunes() {
    let mut bytes = b"\xef\xbb\xbfM:3/4\n%%abc 2.1\n\nX:1\nT:K\xc3\xb6ln\nK:G\nG6|\n\nwords\n\nX:2\nK:none\nz6|\n".to_vec();
    let found = read(&bytes);
    assert_eq!(found.len(), 2);
    let first = found[0].tune.as_ref().expect("a tune");
    assert_eq!((first.title.as_str(), first.meter.numerator, found[0].line), ("Köln", 3, 4));
    assert_eq!(found[1].tune, Err(AbcError::NoNotes));
    bytes = b"X:1\r\nT:K\xf6ln\r\nM:4/4\r\nK:G\r\nG8|\r\n".to_vec();
    assert_eq!(read(&bytes)[0].tune.as_ref().expect("Latin-1").title, "Köln");
    assert_eq!(read(b""), []);
    assert_eq!(read(b"K:G\nGAB|"), []);
}

#[test]
fn broken_tunes_say_what_is_wrong() {
    for (body, part) in [
        ("", "has no notes"),
        ("|::|]", "has no notes"),
        ("CDEFG|", "holds 5/4 of a whole note where the meter has 1/1"),
        ("[CEG|", "a chord is not closed"),
        ("\"Am C4|", "a quote is not closed"),
        ("{gC4|", "a grace note is not closed"),
        ("^|C4|", "accidental and no letter"),
        ("C4|[M:3/4]C3|", "changes its meter"),
        ("C4|\nM:6/8\nC3|", "changes its meter"),
        ("C|D|E|F|G|A|", "are shorter than its meter says"),
        ("C0|", "no length that can be played"),
        ("C/9999/9999|", "no length that can be played"),
        ("C9999|", "no length that can be played"),
        ("C''''''|", "is beyond hearing"),
        ("(1C", "tuplet"),
        ("C4|\u{4e2d}|", "is no ABC"),
    ] {
        let refused = tune_of(body).expect_err(body).to_string();
        assert!(refused.contains(part), "{body}: {refused}");
    }
    for (header, part) in [
        ("M:5/4\nK:C", "bars of 5/4"),
        ("M:none\nK:C", "`none` is no meter"),
        ("M:4/0\nK:C", "`4/0` is no meter"),
        ("L:1\nK:C", "`1` is no unit length"),
        ("K:H", "`H` is no key"),
        ("T:x", "has no K: field"),
        ("K:G#lyd", "is no key"),
    ] {
        let refused = read(format!("X:1\n{header}\nC4|\n").as_bytes()).remove(0).tune;
        let refused = refused.expect_err(header).to_string();
        assert!(refused.contains(part), "{header}: {refused}");
    }
    // Repeats of repeats do not make a tune without end.
    let many = format!("|:{}", "C4:|".repeat(1500));
    assert_eq!(tune_of(&many), Err(AbcError::TooLong));
}

/// A bar of count-in (of pairs: two bars), and the tune up to three times, until half a minute has passed.
const BARS: [usize; 6] = [1 + 2 * 16, (2 + 3 * 6) / 2, 1 + 3 * 10, 1 + 3 * 8, 1 + 3 * 9, 1 + 3 * 6];

#[test]
fn a_tune_is_arranged_in_bars_that_people_count() {
    let per_bar: Vec<(u32, usize)> = read(TUNES)
        .into_iter()
        .map(|found| {
            let score = arrange(&found.tune.expect("a tune"), 5);
            (score.beats_per_bar, score.n_bars)
        })
        .collect();
    assert_eq!(per_bar.iter().map(|(n, _)| *n).collect::<Vec<_>>(), [4, 4, 3, 3, 2, 2]);
    // The last two have parts of five and three bars, which are not counted in pairs.
    assert_eq!(per_bar.iter().map(|(_, n)| *n).collect::<Vec<_>>(), BARS);
    let found = read(TUNES).remove(0).tune.expect("a tune");
    let score = arrange(&found, 5);
    assert_eq!(arrange(&found, 5), score);
    assert_ne!(arrange(&found, 6), score);
    // Written tempo: 180 quarters a minute.
    assert!((score.tempo_bpm() / 180.0 - 1.0).abs() < 0.05, "{}", score.tempo_bpm());
    // The pickup, a quarter, sounds on the last beat of the count-in.
    let melody: Vec<_> = score.notes.iter().filter(|n| n.voice == Voice::Melody).collect();
    assert_eq!((melody[0].onset_beats, melody[1].onset_beats), (3.0, 4.0));
    // D, G and A7 are written over the third bar; bass plays their roots.
    let bass = |beat: f64| {
        let note = score.notes.iter().find(|n| n.voice == Voice::Bass && n.onset_beats == beat);
        note.map(|n| n.pitch % 12)
    };
    assert_eq!((bass(12.0), bass(16.0)), (Some(2), Some(9)));
    let samples = synth::render(&score, 5).expect("a tune");
    assert!(samples.iter().all(|y| y.is_finite() && y.abs() < 1.0));
}

#[test]
fn chords_are_guessed_from_notes() {
    let tune = tune_of("CEGE|FAcA|GBdB|C4|").expect("a tune");
    let score = arrange(&tune, 1);
    let mut bass: Vec<u8> = Vec::new();
    for bar in 1..5 {
        let beat = f64::from(4 * bar);
        let note = score.notes.iter().find(|n| n.voice == Voice::Bass && n.onset_beats == beat);
        bass.push(note.expect("a root").pitch % 12);
    }
    assert_eq!(bass, [0, 5, 7, 0]);
}

/// Pieces of tunes, right and wrong.
fn pieces() -> impl Strategy<Value = String> {
    let piece = prop::sample::select(vec![
        "C", "^f", "_B,", "=c'", "z", "Z2", "3", "/", "//", "3/2", ">", "<<", "-", "|", ":|", "|:",
        "::", "|1", "[2", "|]", "[|", "||", "(3", "(5:4:6", "(", ")", "[CEG]", "[", "]", "{g}",
        "{", "\"Am\"", "\"", "!trill!", "!", "+", "~", "y", "&", "\\", "\n", "%", "[K:Em]",
        "[M:3/4]", "K:Dm\n", "V:2\n", "w:la\n", "X:3\n", "\n\n", "9999", "0", ",", "'", ".", "ä",
        " ",
    ]);
    prop::collection::vec(piece, 0..60).prop_map(|pieces| pieces.concat())
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(3000) })]

    #[test]
    fn whatever_is_read_nothing_breaks(body in pieces()) {
        let text = format!("X:1\nM:4/4\nL:1/8\nK:G\n{body}");
        for found in read(text.as_bytes()) {
            match found.tune {
                Ok(tune) => {
                    prop_assert!(tune.notes.is_sorted_by_key(|note| note.onset));
                    let end = i64::from(tune.meter.ticks()) * tune.n_bars as i64;
                    prop_assert!(tune.notes.iter().all(|n| n.onset < end && n.pitch < 128));
                    let score = arrange(&tune, 1);
                    prop_assert!(score.notes.iter().all(|n| n.onset_beats >= 0.0 && n.velocity > 0.0));
                }
                Err(e) => prop_assert!(e.to_string().len() < 300),
            }
        }
    }

    #[test]
    fn bytes_do_not_break_it_either(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let mut text = b"X:1\nK:C\n".to_vec();
        text.extend(bytes);
        read(&text);
    }
}
