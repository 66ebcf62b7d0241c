//! Vertical axes: linear from 0, or logarithmic.

use super::axis::{self, Tick, fixed};

/// How values become heights.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ValueScale {
    /// Even, from 0 or below.
    Linear,
    /// Each factor of ten as high as the next; for values above 0.
    Log,
}

impl ValueScale {
    /// Returns whether a value has a place on the scale.
    pub fn holds(self, value: f64) -> bool {
        value.is_finite() && (self == Self::Linear || value > 0.0)
    }
}

/// Space beyond the least and the greatest value of a log axis: a share of the axis, and at least so
/// much of a decade that numbers with two figures can tell its ticks apart.
const PAD_SHARE: f64 = 0.04;
const MIN_PAD_DECADES: f64 = 0.1;
/// Least distance of two labels.
const MIN_LABEL_PX: f64 = 18.0;
/// Fewer ticks than this are no scale.
const MIN_TICKS: usize = 3;
/// More round numbers than this would need a third figure.
const MAX_ROUND_TICKS: usize = 6;
/// Decades from one label to the next, until the labels have room.
const DECADES: [i32; 10] = [1, 2, 3, 5, 10, 20, 50, 100, 200, 500];
/// Powers of ten that are written out.
const PLAIN_EXPONENTS: std::ops::Range<i32> = -4..5;
/// Longest label of round numbers that is not shortened to a power of ten.
const MAX_PLAIN_CHARS: usize = 6;

/// A vertical axis from its foot to its head.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct ValueAxis {
    scale: ValueScale,
    /// Ends; decimal logarithms of them on a log axis.
    low: f64,
    high: f64,
}

impl ValueAxis {
    /// Returns a linear axis from 0, or below where `low` is below, to `high`; to 1 if nothing is above 0.
    pub fn linear(low: f64, high: f64) -> Self {
        let low = low.min(0.0);
        let high = if high > low && high > 0.0 { high } else { low + 1.0 };
        Self { scale: ValueScale::Linear, low, high }
    }

    /// Returns a log axis that has room around `low` and `high`, both above 0.
    pub fn log(low: f64, high: f64) -> Self {
        let (low, high) = (low.log10(), high.log10());
        let pad = (PAD_SHARE * (high - low)).max(MIN_PAD_DECADES);
        Self { scale: ValueScale::Log, low: low - pad, high: high + pad }
    }

    /// Returns how far up the axis a value is, 0 at the foot and 1 at the head; values beyond the ends
    /// are at the ends.
    pub fn up(&self, value: f64) -> f64 {
        let place = match self.scale {
            ValueScale::Linear => value,
            ValueScale::Log => value.log10(),
        };
        // Halves, since the difference of two numbers may be beyond the greatest.
        let above = |x: f64| x / 2.0 - self.low / 2.0;
        (above(place) / above(self.high)).clamp(0.0, 1.0)
    }

    /// Returns the ticks of an axis of this height, whose labels do not touch.
    pub fn ticks(&self, height_px: f64) -> Vec<Tick> {
        let max_ticks = (height_px / (MIN_LABEL_PX + 2.0)).floor().max(2.0) as usize;
        match self.scale {
            ValueScale::Linear => shortened(axis::ticks(self.low, self.high, max_ticks)),
            ValueScale::Log => self.log_ticks(height_px, max_ticks),
        }
    }

    /// Returns 1, 2 and 5 times the powers of ten if these have room, else the powers or every nth
    /// of them; round numbers where the axis is too short for three of those.
    fn log_ticks(&self, height_px: f64, max_ticks: usize) -> Vec<Tick> {
        let fits = |ticks: &[Tick]| {
            let up = |tick: &Tick| self.up(tick.value) * height_px;
            ticks.windows(2).all(|t| up(&t[1]) - up(&t[0]) >= MIN_LABEL_PX)
        };
        let dense = self.power_ticks(1, &[1, 2, 5]);
        if dense.len() < MIN_TICKS {
            let (low, high) = (10f64.powf(self.low), 10f64.powf(self.high));
            let mut round =
                (2..=max_ticks.min(MAX_ROUND_TICKS)).rev().map(|n| axis::ticks(low, high, n));
            let is_scale = |ticks: &Vec<Tick>| ticks.len() >= dense.len().max(2) && fits(ticks);
            return match round.find(is_scale) {
                Some(ticks) => shortened(ticks),
                None => dense,
            };
        }
        if fits(&dense) {
            return dense;
        }
        let mut sparse = DECADES.iter().map(|&every| self.power_ticks(every, &[1]));
        sparse.find(|ticks| fits(ticks)).unwrap_or_default()
    }

    /// Returns the ticks at `factors` times those powers of ten whose exponent is a multiple of `every`.
    fn power_ticks(&self, every: i32, factors: &[u8]) -> Vec<Tick> {
        let exponents = self.low.floor() as i32..=self.high.ceil() as i32;
        exponents
            .filter(|exponent| exponent % every == 0)
            .flat_map(|exponent| factors.iter().map(move |&factor| (factor, exponent)))
            .filter(|&(factor, exponent)| {
                let place = f64::from(factor).log10() + f64::from(exponent);
                (self.low..=self.high).contains(&place)
            })
            .map(|(factor, exponent)| {
                // Parsed, since a product of powers need not be the number that is meant.
                let value = format!("{factor}e{exponent}").parse().unwrap_or(f64::NAN);
                let label = if PLAIN_EXPONENTS.contains(&exponent) {
                    fixed(value, usize::try_from(-exponent).unwrap_or(0))
                } else {
                    format!("{factor}e{exponent}").replace('-', "−")
                };
                Tick { value, label }
            })
            .collect()
    }
}

/// Writes long labels as powers of ten: all of them or none.
fn shortened(mut ticks: Vec<Tick>) -> Vec<Tick> {
    if ticks.iter().any(|tick| tick.label.chars().count() > MAX_PLAIN_CHARS) {
        for tick in &mut ticks {
            tick.label = power(tick.value);
        }
    }
    ticks
}

/// Writes a number as up to three figures and a power of ten.
fn power(value: f64) -> String {
    let text = format!("{value:.2e}");
    match text.split_once('e') {
        Some(("0.00" | "-0.00", _)) | None => "0".to_owned(),
        Some((figures, exponent)) => {
            let figures = figures.trim_end_matches('0').trim_end_matches('.');
            format!("{figures}e{exponent}").replace('-', "−")
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn labels(ticks: &[Tick]) -> Vec<&str> {
        ticks.iter().map(|tick| tick.label.as_str()).collect()
    }

    #[test]
    fn decades_are_labelled_and_two_and_five_where_there_is_room() {
        let cases: [(f64, f64, f64, &[&str]); 10] = [
            (0.011, 1.3, 280.0, &["0.01", "0.02", "0.05", "0.1", "0.2", "0.5", "1"]),
            (0.02, 0.5, 170.0, &["0.02", "0.05", "0.1", "0.2", "0.5"]),
            (3e-5, 300.0, 170.0, &["0.0001", "0.001", "0.01", "0.1", "1", "10", "100"]),
            (3e-7, 0.2, 170.0, &["1e−6", "1e−5", "0.0001", "0.001", "0.01", "0.1"]),
            (40.0, 3e6, 170.0, &["100", "1000", "10000", "1e5", "1e6"]),
            (1e-9, 1e9, 170.0, &["1e−9", "1e−6", "0.001", "1", "1000", "1e6", "1e9"]),
            (1e-300, 1e300, 170.0, &["1e−300", "1e−200", "1e−100", "1", "1e100", "1e200", "1e300"]),
            // Less than three of them: round numbers between.
            (0.41, 0.47, 170.0, &["0.35", "0.40", "0.45", "0.50", "0.55"]),
            (0.0003, 0.0003, 170.0, &["2.5e−4", "3e−4", "3.5e−4"]),
            (4.1e-8, 4.7e-8, 170.0, &["3.5e−8", "4e−8", "4.5e−8", "5e−8", "5.5e−8"]),
        ];
        for (low, high, height_px, wanted) in cases {
            let ticks = ValueAxis::log(low, high).ticks(height_px);
            assert_eq!(labels(&ticks), wanted, "{low} to {high} on {height_px} px");
        }
    }

    #[test]
    fn a_factor_of_ten_is_as_high_wherever_it_is() {
        let axis = ValueAxis::log(0.01, 1.0);
        // Two decades and a tenth of one at each end.
        let wanted = |decades: f64| (decades + 0.1) / 2.2;
        let cases = [(0.01, 0.0), (0.1, 1.0), (1.0, 2.0), (0.05, 0.698_970_004_336_018_8)];
        for (value, decades) in cases {
            assert!(
                (axis.up(value) - wanted(decades)).abs() < 1e-12,
                "{value}: {}",
                axis.up(value)
            );
        }
        assert_eq!([axis.up(1e-9), axis.up(1e9)], [0.0, 1.0]);
        let tick = &axis.ticks(100.0)[0];
        assert_eq!((tick.value, tick.label.as_str()), (0.01, "0.01"));
    }

    #[test]
    fn labels_never_touch() {
        for low in [1e-12, 2.3e-5, 0.04, 0.9, 7.0, 8e4] {
            for ratio in [1.0, 1.01, 1.5, 3.0, 8.0, 40.0, 900.0, 1e5, 1e12, 1e40] {
                for height_px in [150.0, 170.0, 280.0, 320.0] {
                    let axis = ValueAxis::log(low, low * ratio);
                    let ticks = axis.ticks(height_px);
                    let case = format!("{low} × {ratio} on {height_px} px: {:?}", labels(&ticks));
                    assert!((2..=20).contains(&ticks.len()), "{case}");
                    for pair in ticks.windows(2) {
                        let gap_px = (axis.up(pair[1].value) - axis.up(pair[0].value)) * height_px;
                        assert!(gap_px >= MIN_LABEL_PX - 1e-9, "{case}: {gap_px}");
                        assert_ne!(pair[0].label, pair[1].label, "{case}");
                    }
                    let longest = ticks.iter().map(|t| t.label.chars().count()).max();
                    assert!(longest <= Some(7), "{case}");
                }
            }
        }
    }

    #[test]
    fn linear_axes_begin_at_zero() {
        let cases: [(f64, f64, &[&str]); 5] = [
            (0.3, 2.0, &["0.0", "0.5", "1.0", "1.5", "2.0"]),
            (0.0, 0.0002, &["0", "5e−5", "1e−4", "1.5e−4", "2e−4"]),
            (0.0, 0.0, &["0.0", "0.2", "0.4", "0.6", "0.8", "1.0"]),
            (-1.0, 1.0, &["−1.0", "−0.5", "0.0", "0.5", "1.0"]),
            (1e-5, 1e-5, &["0", "2e−6", "4e−6", "6e−6", "8e−6", "1e−5"]),
        ];
        for (low, high, wanted) in cases {
            let ticks = ValueAxis::linear(low, high).ticks(120.0);
            assert_eq!(labels(&ticks), wanted, "{low} to {high}");
        }
        assert_eq!(ValueAxis::linear(0.2, 4.0).up(1.0), 0.25);
    }

    #[test]
    fn scales_hold_what_they_can_show() {
        let values = [1.0, 0.0, -1.0, f64::NAN, f64::INFINITY];
        assert_eq!(values.map(|v| ValueScale::Log.holds(v)), [true, false, false, false, false]);
        assert_eq!(values.map(|v| ValueScale::Linear.holds(v)), [true, true, true, false, false]);
    }
}
