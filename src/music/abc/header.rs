//! Fields of a tune: meter, unit length, tempo, key.

use super::{AbcError, TICKS_PER_WHOLE};

/// Letters in the order in which sharps are added to a key; flats come the other way.
const SHARPS: [char; 7] = ['F', 'C', 'G', 'D', 'A', 'E', 'B'];
/// Keys of Highland pipes: two sharps.
const PIPES: [&str; 2] = ["HP", "Hp"];

/// A meter as it is written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Meter {
    pub numerator: u32,
    pub denominator: u32,
}

impl Meter {
    /// Returns the length of a bar.
    pub fn ticks(self) -> u32 {
        self.numerator * TICKS_PER_WHOLE / self.denominator
    }

    /// Returns whether beats have three parts, as in 6/8.
    pub fn is_compound(self) -> bool {
        self.numerator > 3 && self.numerator.is_multiple_of(3) && self.denominator >= 4
    }

    /// Returns the length of a beat: three of the written units in compound meters.
    pub fn beat_ticks(self) -> u32 {
        let unit = TICKS_PER_WHOLE / self.denominator;
        if self.is_compound() { 3 * unit } else { unit }
    }

    /// Returns the number of beats of a bar.
    pub fn n_beats(self) -> u32 {
        self.ticks() / self.beat_ticks()
    }
}

/// A tempo: `per_minute` notes of the length `ticks` in a minute.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tempo {
    pub ticks: u32,
    pub per_minute: f64,
}

/// A key.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Key {
    /// Pitch class, 0 is C.
    pub tonic: u8,
    /// Whether its third is minor.
    pub is_minor: bool,
    /// Sharps, or flats below 0.
    pub sharps: i32,
}

impl Key {
    /// Returns by how many semitones the key alters a letter.
    pub fn alteration(self, letter: char) -> i32 {
        let place = SHARPS.iter().position(|sharp| *sharp == letter).unwrap_or(0) as i32;
        // The k-th sharp comes with k sharps; the k-th flat is the (8−k)-th sharp's letter.
        i32::from(place < self.sharps) - i32::from(6 - place < -self.sharps)
    }
}

/// The fields of a tune's header.
#[derive(Clone, Debug)]
pub struct Header {
    pub title: String,
    pub rhythm: String,
    pub meter: Meter,
    /// Unit length, where `L:` says it.
    unit: Option<u32>,
    tempo: Option<TempoField>,
    pub key: Key,
    /// Alterations that `K:` adds, as in `K:D =c`.
    pub extra: Vec<(char, i32)>,
}

/// A tempo before the unit length is known.
#[derive(Clone, Copy, Debug)]
struct TempoField {
    /// None where it counts units.
    ticks: Option<u32>,
    per_minute: f64,
}

impl Default for Header {
    fn default() -> Self {
        Self {
            title: String::new(),
            rhythm: String::new(),
            meter: Meter { numerator: 4, denominator: 4 },
            unit: None,
            tempo: None,
            key: Key::default(),
            extra: Vec::new(),
        }
    }
}

impl Header {
    /// Reads a line; fields that do not matter here are passed over.
    ///
    /// # Errors
    /// [`AbcError::Field`], [`AbcError::Meter`].
    pub fn read(&mut self, line: &str, number: usize) -> Result<(), AbcError> {
        let line = line.split('%').next().unwrap_or("").trim();
        let Some((field, text)) = line.split_once(':') else { return Ok(()) };
        let text = text.trim();
        let refuse = |field, expected| {
            let text = text.chars().take(40).collect();
            AbcError::Field { line: number, field, text, expected }
        };
        match field {
            "T" if self.title.is_empty() => self.title = text.chars().take(200).collect(),
            "R" => self.rhythm = text.to_lowercase(),
            "M" => {
                self.meter = meter(text)
                    .ok_or_else(|| refuse("meter", "write M:4/4, M:C, M:C| or M:6/8"))?;
                let Meter { numerator, denominator } = self.meter;
                if !(2..=4).contains(&self.meter.n_beats()) {
                    return Err(AbcError::Meter { numerator, denominator });
                }
            }
            "L" => {
                let unit = length_fraction(text).and_then(ticks_of);
                self.unit =
                    Some(unit.ok_or_else(|| refuse("unit length", "write L:1/8 or the like"))?);
            }
            "Q" => self.tempo = tempo(text),
            "K" => {
                let (key, extra) =
                    key(text).ok_or_else(|| refuse("key", "write K:G, K:Am or K:D Mixolydian"))?;
                (self.key, self.extra) = (key, extra);
            }
            _ => {}
        }
        Ok(())
    }

    /// Returns the length that notes without a length have: 1/16 in meters below 3/4, else 1/8.
    pub fn unit_ticks(&self) -> u32 {
        let is_short = 4 * self.meter.numerator < 3 * self.meter.denominator;
        let default = TICKS_PER_WHOLE / if is_short { 16 } else { 8 };
        self.unit.unwrap_or(default)
    }

    /// Returns the tempo where one is given.
    pub fn tempo(&self) -> Option<Tempo> {
        let TempoField { ticks, per_minute } = self.tempo?;
        Some(Tempo { ticks: ticks.unwrap_or_else(|| self.unit_ticks()), per_minute })
    }
}

fn meter(text: &str) -> Option<Meter> {
    match text {
        "C" => return Some(Meter { numerator: 4, denominator: 4 }),
        "C|" => return Some(Meter { numerator: 2, denominator: 2 }),
        _ => {}
    }
    let (numerator, denominator) = length_fraction(text)?;
    let is_power = denominator.is_power_of_two() && denominator <= 16;
    (is_power && (1..=32).contains(&numerator)).then_some(Meter { numerator, denominator })
}

/// Reads `1/8`, two numbers above 0 of few digits.
fn length_fraction(text: &str) -> Option<(u32, u32)> {
    let (numerator, denominator) = text.split_once('/')?;
    let number = |text: &str| text.trim().parse::<u32>().ok().filter(|n| (1..=512).contains(n));
    Some((number(numerator)?, number(denominator)?))
}

fn ticks_of((numerator, denominator): (u32, u32)) -> Option<u32> {
    Some(numerator * TICKS_PER_WHOLE / denominator).filter(|ticks| *ticks > 0)
}

/// Reads `1/4=120`, `120`, and either with words in quotes; `None` for words alone.
fn tempo(text: &str) -> Option<TempoField> {
    let bare: String = text.split('"').step_by(2).collect();
    let (note, number) = bare.split_once('=').unwrap_or(("", &bare));
    let per_minute: f64 = number.trim().parse().ok().filter(|n| (10.0..=1000.0).contains(n))?;
    // The lengths of `1/4 3/8=40` add up; `C=100` counts units.
    let lengths: Option<u32> =
        note.split_whitespace().map(|part| length_fraction(part).and_then(ticks_of)).sum();
    Some(TempoField { ticks: lengths.filter(|ticks| *ticks > 0), per_minute })
}

/// Reads a key: letter, accidental, mode, and alterations after it.
fn key(text: &str) -> Option<(Key, Vec<(char, i32)>)> {
    let mut words = text.split_whitespace();
    let first = words.next().unwrap_or("none");
    if first.eq_ignore_ascii_case("none") || first.contains('=') {
        return Some((Key::default(), Vec::new()));
    }
    if PIPES.contains(&first) {
        return Some((Key { tonic: 9, is_minor: false, sharps: 2 }, Vec::new()));
    }
    let mut letters = first.chars();
    let letter = letters.next()?.to_ascii_uppercase();
    let place = SHARPS.iter().position(|sharp| *sharp == letter)? as i32;
    let rest = letters.as_str();
    let (shift, mode) = match rest.chars().next() {
        Some('#') => (7, &rest[1..]),
        Some('b') => (-7, &rest[1..]),
        _ => (0, rest),
    };
    let words: Vec<&str> = words.collect();
    // The mode may be a word of its own.
    let following = words.first().copied().unwrap_or("");
    let mode = if mode.is_empty() { following } else { mode };
    let mode = mode_shift(mode).or_else(|| mode_shift(""))?;
    let (mode_sharps, is_minor) = mode;
    // F is −1 fifths from C, C is 0, G is 1 …
    let sharps = place - 1 + shift + mode_sharps;
    let tonic = (7 * (place - 1 + shift)).rem_euclid(12) as u8;
    let extra = words.iter().filter_map(|word| alteration(word)).collect();
    (-7..=7).contains(&sharps).then_some((Key { tonic, is_minor, sharps }, extra))
}

/// Returns how many sharps a mode has more than major, and whether its third is minor.
fn mode_shift(mode: &str) -> Option<(i32, bool)> {
    let lower = mode.to_lowercase();
    if lower == "m" {
        return Some((-3, true));
    }
    let first: String = lower.chars().take(3).collect();
    match first.as_str() {
        "" | "maj" | "ion" => Some((0, false)),
        "min" | "aeo" => Some((-3, true)),
        "mix" => Some((-1, false)),
        "dor" => Some((-2, true)),
        "phr" => Some((-4, true)),
        "lyd" => Some((1, false)),
        "loc" => Some((-5, true)),
        _ => None,
    }
}

/// Reads `^f`, `_b` or `=c`.
fn alteration(word: &str) -> Option<(char, i32)> {
    let letter = word.chars().last()?.to_ascii_uppercase();
    let sign = match word.strip_suffix(|_: char| true)? {
        "^" => 1,
        "^^" => 2,
        "_" => -1,
        "__" => -2,
        "=" => 0,
        _ => return None,
    };
    SHARPS.contains(&letter).then_some((letter, sign))
}
