//! Reads tunes in ABC notation 2.1: one voice with its chord symbols, repeats written out.
//!
//! Source: Walshaw et al., "The abc music standard 2.1", 2011, <https://abcnotation.com/wiki/abc:standard:v2.1>.
//! Decorations, grace notes, slurs, lyrics and voices after the first are passed over. Macros, overlays and
//! changes of meter are not read; da capo and segno are played through.

mod body;
mod cursor;
mod header;
mod repeats;
#[cfg(test)]
mod tests;

use body::Measure;
pub use header::{Key, Meter, Tempo};

/// Durations are counted in these: a whole note has 2⁷·3²·5·7 of them.
pub const TICKS_PER_WHOLE: u32 = 40_320;
/// Longest tune, in notes and in measures as they are played.
const MAX_NOTES: usize = 20_000;
const MAX_MEASURES: usize = 2_000;
/// Share of measures that may be too short without the one after them making up for it.
const MAX_SHORT_SHARE: f64 = 0.25;

/// Why a tune was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AbcError {
    #[error("has no K: field, which ends the header of a tune; write its key, for example K:G")]
    NoKey,
    #[error("line {line}: `{text}` is no {field}; {expected}")]
    Field { line: usize, field: &'static str, text: String, expected: &'static str },
    #[error(
        "has bars of {numerator}/{denominator}; bars of two, three or four beats are danced to"
    )]
    Meter { numerator: u32, denominator: u32 },
    #[error("line {line}: changes its meter; tunes of one meter are read")]
    MeterChange { line: usize },
    #[error("line {line}: {what} is not closed")]
    Open { line: usize, what: &'static str },
    #[error("line {line}: `{symbol}` is no ABC")]
    Symbol { line: usize, symbol: char },
    #[error("line {line}: a note {what}")]
    Note { line: usize, what: &'static str },
    #[error(
        "line {line}: its bar holds {found} of a whole note where the meter has {expected}; correct the bar"
    )]
    Overfull { line: usize, found: String, expected: String },
    #[error("{n_short} of {n_bars} bars are shorter than its meter says; correct M: or the bars")]
    Ragged { n_short: usize, n_bars: usize },
    #[error("has no notes")]
    NoNotes,
    #[error("has more than {MAX_NOTES} notes or {MAX_MEASURES} bars")]
    TooLong,
}

/// A note of a tune as it is played.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TuneNote {
    /// From the first downbeat of the tune on; negative in the pickup. In ticks.
    pub onset: i64,
    /// In ticks.
    pub duration: u32,
    /// MIDI note number.
    pub pitch: u8,
}

/// A tune, its repeats written out.
#[derive(Clone, Debug, PartialEq)]
pub struct Tune {
    /// The first `T:` field.
    pub title: String,
    /// The `R:` field.
    pub rhythm: String,
    pub meter: Meter,
    pub tempo: Option<Tempo>,
    pub key: Key,
    /// Sorted by onset; ties are one note.
    pub notes: Vec<TuneNote>,
    /// Chord symbols with their onsets, in ticks.
    pub chords: Vec<(i64, super::harmony::Chord)>,
    pub n_bars: usize,
    /// Bars with which a part begins.
    pub parts: Vec<usize>,
}

/// A tune of a file, or why it has none.
#[derive(Clone, Debug, PartialEq)]
pub struct TuneEntry {
    /// Line of its X: field, from 1.
    pub line: usize,
    /// Its text, with what the file says of all tunes.
    pub text: String,
    pub tune: Result<Tune, AbcError>,
}

/// Reads every tune of a file: UTF-8, or else Latin-1.
pub fn read(bytes: &[u8]) -> Vec<TuneEntry> {
    let text = match std::str::from_utf8(bytes) {
        Ok(text) => text.to_owned(),
        Err(_) => bytes.iter().map(|byte| char::from(*byte)).collect(),
    };
    let text = text.strip_prefix('\u{feff}').unwrap_or(&text);
    // A file's own header: fields before its first tune.
    let mut common: Vec<&str> = Vec::new();
    let mut tunes: Vec<(usize, Vec<&str>)> = Vec::new();
    let mut is_inside = false;
    for (i, line) in text.lines().enumerate() {
        if line.trim_start().starts_with("X:") {
            tunes.push((i + 1, vec![line]));
            is_inside = true;
        } else if line.trim().is_empty() {
            is_inside = false;
        } else if let Some((_, lines)) = tunes.last_mut().filter(|_| is_inside) {
            lines.push(line);
        } else if tunes.is_empty() && is_common(line) {
            common.push(line);
        }
    }
    let found = |(line, lines): (usize, Vec<&str>)| TuneEntry {
        line,
        text: common.iter().chain(&lines).map(|line| format!("{line}\n")).collect(),
        tune: tune(&common, &lines, line),
    };
    tunes.into_iter().map(found).collect()
}

fn is_common(line: &str) -> bool {
    ["M:", "L:", "Q:", "R:"].iter().any(|field| line.starts_with(field))
}

fn tune(common: &[&str], lines: &[&str], first_line: usize) -> Result<Tune, AbcError> {
    let mut header = header::Header::default();
    for line in common {
        header.read(line, 0)?;
    }
    let mut rest = lines.iter().enumerate();
    let mut has_key = false;
    for (i, line) in rest.by_ref() {
        header.read(line, first_line + i)?;
        if line.trim_start().starts_with("K:") {
            has_key = true;
            break;
        }
    }
    if !has_key {
        return Err(AbcError::NoKey);
    }
    let meter = header.meter;
    let key = header.key;
    let tempo = header.tempo();
    let body: Vec<(usize, &str)> = rest.map(|(i, line)| (first_line + i, *line)).collect();
    let written = body::measures(&body, &header)?;
    let played = repeats::unfold(&written)?;
    let laid = lay(&written, &played, meter)?;
    if laid.notes.is_empty() {
        return Err(AbcError::NoNotes);
    }
    let TuneLayout { notes, chords, n_bars, parts } = laid;
    let (title, rhythm) = (header.title, header.rhythm);
    Ok(Tune { title, rhythm, meter, tempo, key, notes, chords, n_bars, parts })
}

struct TuneLayout {
    notes: Vec<TuneNote>,
    chords: Vec<(i64, super::harmony::Chord)>,
    n_bars: usize,
    parts: Vec<usize>,
}

/// Lays measures out in time, so that every bar has its full length.
///
/// A short measure and the one after it are one bar where they have its length together, as at repeats with
/// a pickup; any other short one is followed by silence. A short first one is a pickup.
fn lay(written: &[Measure], played: &[usize], meter: Meter) -> Result<TuneLayout, AbcError> {
    let full = meter.ticks();
    let measures: Vec<&Measure> = played.iter().filter_map(|i| written.get(*i)).collect();
    let mut laid =
        TuneLayout { notes: Vec::new(), chords: Vec::new(), n_bars: 0, parts: Vec::new() };
    let (mut at, mut n_short, mut i) = (0_i64, 0, 0);
    // Onsets by pitch of notes that a tie goes on from.
    let mut tied: Vec<usize> = Vec::new();
    let mut place = |laid: &mut TuneLayout, measure: &Measure, at: i64| {
        for note in &measure.notes {
            let onset = at + i64::from(note.onset);
            let ends_here = |n: &TuneNote| {
                n.pitch == note.pitch && (n.onset + i64::from(n.duration) - onset).abs() <= 2
            };
            let from = tied.iter().position(|k| laid.notes.get(*k).is_some_and(ends_here));
            let index = match from.map(|at| tied.swap_remove(at)) {
                Some(k) => {
                    laid.notes[k].duration += note.duration;
                    k
                }
                None => {
                    let (pitch, duration) = (note.pitch, note.duration);
                    laid.notes.push(TuneNote { onset, duration, pitch });
                    laid.notes.len() - 1
                }
            };
            if note.is_tied {
                tied.push(index);
            }
        }
        laid.chords.extend(measure.chords.iter().map(|(t, chord)| (at + i64::from(*t), *chord)));
    };
    let has_more = measures.len() > 1;
    if let Some(first) = measures.first().filter(|first| has_more && first.ticks < full) {
        place(&mut laid, first, -i64::from(first.ticks));
        i = 1;
    }
    while let Some(measure) = measures.get(i) {
        if measure.ticks > full {
            let in_ticks = |ticks: u32| format!("{}/{TICKS_PER_WHOLE}", ticks);
            return Err(AbcError::Overfull {
                line: measure.line,
                found: fraction(measure.ticks).unwrap_or_else(|| in_ticks(measure.ticks)),
                expected: fraction(full).unwrap_or_else(|| in_ticks(full)),
            });
        }
        if measure.begins_part {
            laid.parts.push(laid.n_bars);
        }
        place(&mut laid, measure, at);
        if measure.ticks < full {
            match measures.get(i + 1).filter(|next| measure.ticks + next.ticks == full) {
                Some(next) => {
                    place(&mut laid, next, at + i64::from(measure.ticks));
                    if next.begins_part {
                        laid.parts.push(laid.n_bars + 1);
                    }
                    i += 1;
                }
                // The last bar leaves room for the pickup of the next time.
                None if i + 1 < measures.len() => n_short += 1,
                None => {}
            }
        }
        at += i64::from(full);
        laid.n_bars += 1;
        i += 1;
    }
    if n_short as f64 > MAX_SHORT_SHARE * laid.n_bars as f64 {
        return Err(AbcError::Ragged { n_short, n_bars: laid.n_bars });
    }
    if laid.notes.len() > MAX_NOTES {
        return Err(AbcError::TooLong);
    }
    laid.notes.sort_by_key(|note| note.onset);
    laid.parts.dedup();
    Ok(laid)
}

/// Returns ticks as a fraction of a whole note in lowest terms, such as `9/8`.
fn fraction(ticks: u32) -> Option<String> {
    let (mut a, mut b) = (ticks, TICKS_PER_WHOLE);
    while b > 0 {
        (a, b) = (b, a % b);
    }
    (a > 0).then(|| format!("{}/{}", ticks / a, TICKS_PER_WHOLE / a))
}
