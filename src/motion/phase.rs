//! Bar phase from beat times, and the beats file that may lie beside a song.

use thiserror::Error;

use super::quantile::median;

/// Beats in a bar when a beats file does not number its beats.
pub const DEFAULT_BEATS_PER_BAR: u32 = 4;

/// Highest beat number, so that one mistyped number does not make a bar of a thousand beats.
pub const MAX_BEATS_PER_BAR: u32 = 64;

/// A bar phase that falls by more than this, in bars, has begun a new bar.
pub const WRAP_BARS: f64 = 0.5;

/// Why a list of beats was refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum BeatsError {
    /// A line of the file is not a beat.
    #[error(
        "beats line {line} reads `{text}`, expected {expected}; \
         write one beat per line as `time_s` or `time_s beat_number`"
    )]
    Line { line: usize, text: String, expected: &'static str },
    /// Too many lines.
    #[error("beats have more than {limit} lines; split the song or remove comments")]
    TooLong { limit: usize },
    /// Fewer than two beats.
    #[error("beats hold {found} beats, expected at least 2; a tempo needs two beat times")]
    TooFew { found: usize },
    /// A time that is negative, not finite, or not later than the one before.
    #[error(
        "beat {index} is at {time_s} s after {previous_s} s; \
         beat times must be finite, not negative and strictly increasing"
    )]
    Order { index: usize, previous_s: f64, time_s: f64 },
    /// Some beats are numbered and some are not.
    #[error("beats hold {n_times} times and {n_numbers} beat numbers; number every beat or none")]
    Numbering { n_times: usize, n_numbers: usize },
    /// A beat number outside `1..=beats_per_bar`.
    #[error("beat {index} has number {number}, expected 1 to {highest}; number 1 is the downbeat")]
    Number { index: usize, number: i64, highest: u32 },
    /// No beat is numbered 1.
    #[error("beats are numbered but none is number 1; number the downbeats 1 or number no beat")]
    NoDownbeat,
    /// A given bar length outside `1..=MAX_BEATS_PER_BAR`.
    #[error("bar has {beats_per_bar} beats, expected 1 to {highest}; usual bars have 3 or 4")]
    BeatsPerBar { beats_per_bar: u32, highest: u32 },
}

/// Where the number of beats in a bar comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum BeatsPerBarSource {
    /// The caller said it.
    Given,
    /// The highest beat number.
    Numbers,
    /// Not stated: [`DEFAULT_BEATS_PER_BAR`].
    Default,
}

/// Two or more beat times of a song, with or without their number in the bar.
#[derive(Clone, Debug, PartialEq)]
pub struct Beats {
    times_s: Vec<f64>,
    numbers: Option<Vec<i64>>,
    beats_per_bar: u32,
    beats_per_bar_source: BeatsPerBarSource,
}

impl Beats {
    /// Beats at `times_s`, numbered from 1 in each bar when `numbers` are given.
    ///
    /// Without `beats_per_bar` a bar has as many beats as the highest number, else 4. Beats of an excerpt
    /// may be numbered without a downbeat among them. Errors: [`BeatsError`] for fewer than two beats,
    /// times not finite, negative or not increasing, numbers missing or out of range.
    pub fn new(
        times_s: Vec<f64>,
        numbers: Option<Vec<i64>>,
        beats_per_bar: Option<u32>,
    ) -> Result<Self, BeatsError> {
        if times_s.len() < 2 {
            return Err(BeatsError::TooFew { found: times_s.len() });
        }
        let mut previous_s = 0.0;
        for (index, &time_s) in times_s.iter().enumerate() {
            let later = if index == 0 { time_s >= 0.0 } else { time_s > previous_s };
            if !time_s.is_finite() || !later {
                return Err(BeatsError::Order { index, previous_s, time_s });
            }
            previous_s = time_s;
        }
        let (beats_per_bar, beats_per_bar_source) = match (beats_per_bar, &numbers) {
            (Some(given), _) => (given, BeatsPerBarSource::Given),
            (None, None) => (DEFAULT_BEATS_PER_BAR, BeatsPerBarSource::Default),
            (None, Some(numbers)) => {
                let highest = numbers.iter().copied().max().unwrap_or(0);
                let highest = highest.clamp(1, i64::from(MAX_BEATS_PER_BAR)) as u32;
                (highest, BeatsPerBarSource::Numbers)
            }
        };
        if beats_per_bar == 0 || beats_per_bar > MAX_BEATS_PER_BAR {
            return Err(BeatsError::BeatsPerBar { beats_per_bar, highest: MAX_BEATS_PER_BAR });
        }
        if let Some(numbers) = &numbers {
            check_numbers(numbers, times_s.len(), beats_per_bar)?;
        }
        Ok(Self { times_s, numbers, beats_per_bar, beats_per_bar_source })
    }

    /// Beat times, s, strictly increasing, at least two.
    pub fn times_s(&self) -> &[f64] {
        &self.times_s
    }

    /// The number of each beat in its bar, 1 on the downbeat, if known.
    pub fn numbers(&self) -> Option<&[i64]> {
        self.numbers.as_deref()
    }

    /// Beats in a bar, `1..=64`.
    pub fn beats_per_bar(&self) -> u32 {
        self.beats_per_bar
    }

    /// Where [`Self::beats_per_bar`] comes from.
    pub fn beats_per_bar_source(&self) -> BeatsPerBarSource {
        self.beats_per_bar_source
    }

    /// Tempo in beats per minute, `60 / median(t[i+1] - t[i])`.
    pub fn tempo_bpm(&self) -> f64 {
        60.0 / self.median_interval_s()
    }

    fn median_interval_s(&self) -> f64 {
        let mut intervals: Vec<f64> = self.times_s.windows(2).map(|w| w[1] - w[0]).collect();
        // At least two increasing times, so there is an interval and it is positive.
        median(&mut intervals).unwrap_or(1.0)
    }

    /// Index of the first downbeat; the first beat when beats carry no numbers. Where no beat is numbered 1,
    /// the downbeat before the first beat, counted back from its number.
    pub(super) fn first_downbeat(&self) -> i64 {
        let Some(numbers) = &self.numbers else { return 0 };
        match numbers.iter().position(|&n| n == 1) {
            Some(i) => i as i64,
            None => 1 - numbers.first().copied().unwrap_or(1),
        }
    }
}

fn check_numbers(numbers: &[i64], n_times: usize, highest: u32) -> Result<(), BeatsError> {
    if numbers.len() != n_times {
        return Err(BeatsError::Numbering { n_times, n_numbers: numbers.len() });
    }
    for (index, &number) in numbers.iter().enumerate() {
        if !(1..=i64::from(highest)).contains(&number) {
            return Err(BeatsError::Number { index, number, highest });
        }
    }
    Ok(())
}

/// Bar phase in `[0, 1)` at `times_s`, shape `[T]`: 0 on the downbeat, linear between beats.
///
/// `φ(t) = frac(k(t) / B)`, `k` the beat index counted from the first downbeat, interpolated
/// linearly between beat times and continued at the median interval beyond both ends, `B` beats
/// per bar. Later beat numbers do not restart the count.
pub fn bar_phase(times_s: &[f64], beats: &Beats) -> Vec<f64> {
    let b = &beats.times_s;
    let last = b.len() - 1;
    let interval_s = beats.median_interval_s();
    let first_downbeat = beats.first_downbeat() as f64;
    let position = |t: f64| {
        if t < b[0] {
            (t - b[0]) / interval_s
        } else if t > b[last] {
            last as f64 + (t - b[last]) / interval_s
        } else {
            let i = (b.partition_point(|&x| x <= t).max(1) - 1).min(last - 1);
            i as f64 + (t - b[i]) / (b[i + 1] - b[i])
        }
    };
    let bars = f64::from(beats.beats_per_bar);
    times_s.iter().map(|&t| fraction((position(t) - first_downbeat) / bars)).collect()
}

/// Returns bars that are counted on, of a bar phase that begins anew with each.
pub fn unwrapped(phase: &[f64]) -> Vec<f64> {
    let mut n_bars = 0.0;
    let mut last = phase.first().copied().unwrap_or(0.0);
    phase
        .iter()
        .map(|&x| {
            if last - x > WRAP_BARS {
                n_bars += 1.0;
            }
            last = x;
            n_bars + x
        })
        .collect()
}

/// Bar phase in `[0, 1)` at `times_s` for a constant tempo with a downbeat at `downbeat_s`.
///
/// `φ(t) = frac((t - t₀) bpm / (60 B))`.
#[cfg(test)]
pub fn bar_phase_at_tempo(
    times_s: &[f64],
    tempo_bpm: f64,
    downbeat_s: f64,
    beats_per_bar: u32,
) -> Vec<f64> {
    let bars_per_s = tempo_bpm / 60.0 / f64::from(beats_per_bar.max(1));
    times_s.iter().map(|&t| fraction((t - downbeat_s) * bars_per_s)).collect()
}

/// `x - ⌊x⌋`, in `[0, 1)` also after rounding to single precision.
fn fraction(x: f64) -> f64 {
    let f = x.rem_euclid(1.0);
    // A phase that rounds to 1 as f32 is the downbeat it is about to reach.
    if f as f32 >= 1.0 { 0.0 } else { f }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::beat_list::MAX_BEATS_LINES;
    use proptest::prelude::*;

    fn refusal(text: &str) -> String {
        Beats::parse(text).unwrap_err().to_string()
    }

    #[test]
    fn bars_are_counted_on() {
        assert_eq!(unwrapped(&[0.4, 0.7, 0.0, 0.3, 0.6]), [0.4, 0.7, 1.0, 1.3, 1.6]);
        // A small fall is none of a bar's.
        assert_eq!(unwrapped(&[0.7, 0.3, 0.9]), [0.7, 0.3, 0.9]);
        assert_eq!(unwrapped(&[]), [0.0; 0]);
    }

    #[test]
    fn numbered_beats_set_the_bar_and_the_downbeat() {
        let text = "# a waltz\r\n0.5 2\r\n1.0\t3 # pickup\r\n\r\n1.5 1\r\n2.1 2\r\n";
        let beats = Beats::parse(text).unwrap();
        assert_eq!(beats.times_s(), [0.5, 1.0, 1.5, 2.1]);
        assert_eq!(beats.numbers(), Some(&[2, 3, 1, 2][..]));
        assert_eq!(beats.beats_per_bar(), 3);
        assert_eq!(beats.beats_per_bar_source(), BeatsPerBarSource::Numbers);
        assert!((beats.tempo_bpm() - 120.0).abs() < 1e-12);
        // One beat before the first, on each beat, half way, and one interval after the last.
        let phase = bar_phase(&[0.0, 0.5, 1.0, 1.5, 1.8, 2.1, 2.6], &beats);
        let want = [0.0, 1.0 / 3.0, 2.0 / 3.0, 0.0, 0.5 / 3.0, 1.0 / 3.0, 2.0 / 3.0];
        for (p, w) in phase.iter().zip(want) {
            assert!((p - w).abs() < 1e-12, "{phase:?}");
        }
    }

    #[test]
    fn unnumbered_beats_start_on_a_downbeat_in_four() {
        let beats = Beats::parse("0.25\n0.75\n1.25\n").unwrap();
        assert_eq!(beats.beats_per_bar_source(), BeatsPerBarSource::Default);
        let times = [0.25, 0.5, 1.0, 2.0, 2.25];
        assert_eq!(bar_phase(&times, &beats), [0.0, 0.125, 0.375, 0.875, 0.0]);
        let constant = bar_phase_at_tempo(&times, 120.0, 0.25, 4);
        assert_eq!(constant, [0.0, 0.125, 0.375, 0.875, 0.0]);
    }

    #[test]
    fn beats_of_an_excerpt_are_counted_from_their_first_number() {
        let beats = Beats::new(vec![0.25, 0.75], Some(vec![3, 4]), Some(5)).unwrap();
        let phase = bar_phase(&[0.25, 0.5, 0.75, 1.25, 1.75], &beats);
        let want = [0.4, 0.5, 0.6, 0.8, 0.0];
        assert!(phase.iter().zip(want).all(|(p, w)| (p - w).abs() < 1e-12), "{phase:?}");
        // The whole song says the same of these times.
        let song = Beats::new(vec![0.0, 0.25, 0.75, 1.25, 1.75], Some(vec![2, 3, 4, 5, 1]), None);
        let phase_of_song = bar_phase(&[0.25, 0.5, 0.75, 1.25, 1.75], &song.unwrap());
        assert!(phase.iter().zip(phase_of_song).all(|(p, w)| (p - w).abs() < 1e-12));
    }

    #[test]
    fn a_given_bar_length_wins() {
        let beats = Beats::new(vec![0.0, 1.0], None, Some(3)).unwrap();
        assert_eq!(beats.beats_per_bar_source(), BeatsPerBarSource::Given);
        assert!((bar_phase(&[2.0], &beats)[0] - 2.0 / 3.0).abs() < 1e-15);
        let zero = Beats::new(vec![0.0, 1.0], None, Some(0)).unwrap_err();
        assert_eq!(zero.to_string(), "bar has 0 beats, expected 1 to 64; usual bars have 3 or 4");
        assert!(Beats::new(vec![0.0, 1.0], Some(vec![1, 4]), Some(3)).is_err());
    }

    #[test]
    fn errors_name_the_line_its_text_and_the_way_out() {
        assert_eq!(
            refusal("0.5\n1.0 two\n"),
            "beats line 2 reads `1.0 two`, expected no beat number, like the beats before; \
             write one beat per line as `time_s` or `time_s beat_number`"
        );
        let long = format!("0.5\n{}", "é".repeat(90));
        let Err(BeatsError::Line { line, text, .. }) = Beats::parse(&long) else {
            panic!("expected a line error");
        };
        assert_eq!((line, text), (2, "é".repeat(40)));
        for bad in ["0.5\n0.5", "-1\n2", "nan\n1", "1 1 1\n2", "0 1\n1", "0 0\n1 1", "0 1\n1 65"] {
            assert!(matches!(Beats::parse(bad), Err(BeatsError::Line { .. })), "{bad:?}");
        }
        assert_eq!(
            refusal("# nothing\n3.0\n"),
            "beats hold 1 beats, expected at least 2; a tempo needs two beat times"
        );
        assert_eq!(Beats::parse("0 2\n1 3\n"), Err(BeatsError::NoDownbeat));
        assert!(matches!(Beats::parse("0 2\n"), Err(BeatsError::TooFew { found: 1 })));
        assert_eq!(
            Beats::new(vec![0.0, 2.0, 1.0], None, None).unwrap_err().to_string(),
            "beat 2 is at 1 s after 2 s; \
             beat times must be finite, not negative and strictly increasing"
        );
        assert_eq!(
            Beats::new(vec![0.0, 2.0], Some(vec![1]), None).unwrap_err().to_string(),
            "beats hold 2 times and 1 beat numbers; number every beat or none"
        );
    }

    #[test]
    fn too_many_lines_are_refused() {
        let text = "\n".repeat(MAX_BEATS_LINES + 1);
        assert_eq!(Beats::parse(&text), Err(BeatsError::TooLong { limit: MAX_BEATS_LINES }));
    }

    #[test]
    fn a_hair_before_the_downbeat_is_the_downbeat() {
        let beats = Beats::new(vec![0.0, 1.0], None, Some(1)).unwrap();
        assert_eq!(bar_phase(&[1.0 - 1e-12, -1e-18], &beats), [0.0, 0.0]);
    }

    proptest! {
        #[test]
        fn parsing_never_panics(text in "[0-9a-z .,;#\"\\\\\\-+\\t\\n\\r\u{e9}]{0,80}") {
            let _ = Beats::parse(&text);
        }

        #[test]
        fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = Beats::parse(&String::from_utf8_lossy(&bytes));
        }

        #[test]
        fn phases_lie_in_the_half_open_bar(
            steps in prop::collection::vec(0.01..2.0f64, 1..9), at in -50.0..50.0f64,
            bars in 1..7u32
        ) {
            let mut times = vec![0.3];
            for step in steps {
                times.push(times[times.len() - 1] + step);
            }
            let beats = Beats::new(times, None, Some(bars)).unwrap();
            let phase = bar_phase(&[at], &beats)[0];
            prop_assert!((0.0..1.0).contains(&(phase as f32)));
        }
    }
}
