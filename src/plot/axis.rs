//! Ticks and numbers of axes, and the axes of time and of steps that panels share.

use super::font;
use super::style::TEXT_PX;
use crate::units::FPS;

/// A place on an axis with what is written there.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Tick {
    pub value: f64,
    pub label: String,
}

/// Free space between two labels on a horizontal axis.
const LABEL_GAP_PX: f64 = 24.0;
/// No axis has more ticks.
const MAX_TICKS: usize = 50;
/// No horizontal axis has more.
const MAX_HORIZONTAL_TICKS: usize = 20;

/// Returns the ticks from `low` to `high`, both included: at most `max_ticks` (and [`MAX_TICKS`]),
/// at multiples of 1, 2 or 5 times a power of ten.
pub(super) fn ticks(low: f64, high: f64, max_ticks: usize) -> Vec<Tick> {
    let max_ticks = max_ticks.clamp(1, MAX_TICKS);
    let span = high - low;
    if !span.is_finite() || span <= 0.0 {
        return vec![Tick { value: low, label: number(low) }];
    }
    // Steps from below what would be needed; the first with few enough multiples is taken.
    let exponent = (span / max_ticks as f64).log10().floor() as i32 - 1;
    for exponent in exponent..exponent + 4 {
        for factor in [1.0, 2.0, 5.0] {
            let step = factor * 10f64.powi(exponent);
            let first = (low / step - 1e-6).ceil();
            let n = ((high / step + 1e-6).floor() - first + 1.0).max(0.0);
            if n <= max_ticks as f64 {
                let decimals = usize::try_from(-exponent).unwrap_or(0);
                return (0..n as usize)
                    .map(|i| (first + i as f64) * step)
                    .map(|value| Tick { value, label: fixed(value, decimals) })
                    .collect();
            }
        }
    }
    Vec::new()
}

/// Returns as many ticks from `low` to `high` as have room for their labels, at most `max_ticks`; `x`
/// tells where a value is on a horizontal axis.
fn fitting_ticks(low: f64, high: f64, max_ticks: usize, x: impl Fn(f64) -> f64) -> Vec<Tick> {
    for max_ticks in (1..=max_ticks).rev() {
        let ticks = ticks(low, high, max_ticks);
        let widest =
            ticks.iter().map(|tick| font::width_px(&tick.label, TEXT_PX)).fold(0.0, f64::max);
        let fits = ticks.windows(2).all(|t| x(t[1].value) - x(t[0].value) >= widest + LABEL_GAP_PX);
        if fits && !ticks.is_empty() {
            return ticks;
        }
    }
    Vec::new()
}

/// Writes a number with three significant figures, or all those of its whole part; very large and
/// very small ones as powers of ten.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 {
        return "0".to_owned();
    }
    let exponent = value.abs().log10().floor();
    if !(-3.0..5.0).contains(&exponent) {
        return format!("{value:.1e}").replace('-', "−");
    }
    let text = fixed(value, (2.0 - exponent).max(0.0) as usize);
    match text.split_once('.') {
        Some(_) => text.trim_end_matches('0').trim_end_matches('.').to_owned(),
        None => text,
    }
}

/// Writes a number with a fixed number of decimals and a true minus sign.
pub(super) fn fixed(value: f64, decimals: usize) -> String {
    if value.abs() >= 1e9 || decimals > 9 {
        return format!("{value:.1e}").replace('-', "−");
    }
    let text = format!("{value:.decimals$}");
    match text.strip_prefix('-') {
        // A zero from below is a zero.
        Some(digits) if digits.chars().all(|c| c == '0' || c == '.') => digits.to_owned(),
        Some(digits) => format!("−{digits}"),
        None => text,
    }
}

/// Where frames and seconds are on the page.
///
/// Frame t is a cell of its own width around its instant, start_s + t / [`FPS`]; so the axis begins
/// half a frame before the first instant and ends half a frame after the last.
#[derive(Clone, Copy, Debug)]
pub(super) struct TimeAxis {
    pub start_s: f64,
    pub n_frames: usize,
    pub left: f64,
    pub width: f64,
}

impl TimeAxis {
    /// Returns the x of an instant: left + ((time_s - start_s) FPS + 1/2) width / n_frames.
    pub fn x(&self, time_s: f64) -> f64 {
        self.x_of_frame((time_s - self.start_s) * FPS + 0.5)
    }

    /// Returns the x of a place in frames from the left edge of frame 0.
    pub fn x_of_frame(&self, frame: f64) -> f64 {
        self.left + frame * self.width / self.n_frames.max(1) as f64
    }

    /// Returns the instant of the last frame.
    pub fn end_s(&self) -> f64 {
        self.start_s + self.n_frames.saturating_sub(1) as f64 / FPS
    }

    pub fn right(&self) -> f64 {
        self.left + self.width
    }

    /// Returns as many ticks as have room for their labels; none without frames.
    pub fn ticks(&self) -> Vec<Tick> {
        if self.n_frames == 0 {
            return Vec::new();
        }
        fitting_ticks(self.start_s, self.end_s(), MAX_HORIZONTAL_TICKS, |s| self.x(s))
    }
}

/// Where steps are on the page: x = left + step width / n_steps, so that 0 steps done are at the left
/// edge and all of them at the right.
#[derive(Clone, Copy, Debug)]
pub(super) struct StepAxis {
    pub n_steps: u64,
    pub left: f64,
    pub width: f64,
}

impl StepAxis {
    /// Returns the x of a step; steps beyond the last are at the right edge.
    pub fn x(&self, step: f64) -> f64 {
        let n_steps = self.n_steps.max(1) as f64;
        self.left + step.min(n_steps) * self.width / n_steps
    }

    pub fn right(&self) -> f64 {
        self.left + self.width
    }

    /// Returns as many ticks as have room for their labels, all at whole steps; none without steps.
    pub fn ticks(&self) -> Vec<Tick> {
        if self.n_steps == 0 {
            return Vec::new();
        }
        let n_whole = usize::try_from(self.n_steps).unwrap_or(usize::MAX).saturating_add(1);
        let max_ticks = n_whole.min(MAX_HORIZONTAL_TICKS);
        fitting_ticks(0.0, self.n_steps as f64, max_ticks, |step| self.x(step))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_few() {
        let cases: [(f64, f64, usize, &[&str]); 8] = [
            (0.0, 1.0, 3, &["0.0", "0.5", "1.0"]),
            (0.0, 8.0, 9, &["0", "1", "2", "3", "4", "5", "6", "7", "8"]),
            (0.0, 7200.0, 8, &["0", "1000", "2000", "3000", "4000", "5000", "6000", "7000"]),
            (-3.0, 2.0, 4, &["−2", "0", "2"]),
            (0.0, 0.03, 4, &["0.00", "0.01", "0.02", "0.03"]),
            (5.0, 5.0, 4, &["5"]),
            (12.3, 13.9, 5, &["12.5", "13.0", "13.5"]),
            (0.4, 0.6, 1, &["0.5"]),
        ];
        for (low, high, max_ticks, wanted) in cases {
            let labels: Vec<_> = ticks(low, high, max_ticks).into_iter().map(|t| t.label).collect();
            assert_eq!(labels, wanted, "{low} to {high}");
        }
    }

    #[test]
    fn numbers_have_three_figures() {
        let cases = [
            (0.0, "0"),
            (1.0, "1"),
            (-3.5, "−3.5"),
            (0.12345, "0.123"),
            (1234.5, "1234"),
            (-80.04, "−80"),
            (1.5e12, "1.5e12"),
            (-2e-7, "−2.0e−7"),
        ];
        for (value, wanted) in cases {
            assert_eq!(number(value), wanted);
        }
    }

    #[test]
    fn an_instant_is_in_the_middle_of_its_frame() {
        let time = TimeAxis { start_s: 2.0, n_frames: 60, left: 10.0, width: 120.0 };
        assert_eq!(time.x(2.0), 11.0);
        assert!((time.x(2.5) - 41.0).abs() < 1e-9, "{}", time.x(2.5));
        assert_eq!(time.x_of_frame(60.0), time.right());
    }

    #[test]
    fn steps_have_whole_ticks_with_room_for_their_labels() {
        let cases: [(u64, f64, &[&str]); 6] = [
            (0, 400.0, &[]),
            (1, 400.0, &["0", "1"]),
            (3, 400.0, &["0", "1", "2", "3"]),
            (20_000, 422.0, &["0", "5000", "10000", "15000", "20000"]),
            (123_456, 228.0, &["0", "50000", "100000"]),
            (u64::MAX, 228.0, &["0", "1.0e19"]),
        ];
        for (n_steps, width, wanted) in cases {
            let axis = StepAxis { n_steps, left: 64.0, width };
            let labels: Vec<_> = axis.ticks().into_iter().map(|tick| tick.label).collect();
            assert_eq!(labels, wanted, "{n_steps} steps on {width} px");
            assert_eq!(axis.x(0.0), 64.0);
        }
        let axis = StepAxis { n_steps: 40, left: 10.0, width: 120.0 };
        assert_eq!((axis.x(1.0), axis.x(40.0)), (13.0, axis.right()));
    }
}
