//! Unison: how the steps of the dancers of a group belong together.

use crate::motion::choreography::beat_grid::BeatGrid;
use crate::motion::placement::Placement;

/// Time that a dancer takes to come to rest, or to start, about a downbeat, s.
const START_S: f64 = 0.3;
/// And at most this share of a bar.
const MAX_START_BARS: f64 = 0.4;

/// How the dancers of a group belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Unison {
    /// All dance the same steps at the same time.
    Same,
    /// The right half dances the mirror image of the left half.
    Mirrored,
    /// Dancer k dances k bars later what dancer 0 dances.
    Canon,
    /// The left half dances every other bar, and the right half repeats it in the next while they rest.
    CallAndResponse,
    /// Everybody dances steps of their own.
    Free,
}

impl Unison {
    /// All kinds of unison.
    pub const ALL: [Self; 5] =
        [Self::Same, Self::Mirrored, Self::Canon, Self::CallAndResponse, Self::Free];

    /// The kind as tables spell it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Same => "same",
            Self::Mirrored => "mirrored",
            Self::Canon => "canon",
            Self::CallAndResponse => "call_and_response",
            Self::Free => "free",
        }
    }

    /// Returns the part of every dancer who stands at `places`.
    pub fn parts(self, places: &[Placement]) -> Vec<Part> {
        let is_right = right_half(places);
        let part = |k: usize| match self {
            Self::Same => Part::of_voice(0),
            Self::Mirrored => Part { is_mirrored: is_right[k], ..Part::of_voice(0) },
            Self::Canon => Part { timing: Timing::BarsLate(k), ..Part::of_voice(0) },
            Self::CallAndResponse => {
                let timing = if is_right[k] { Timing::Response } else { Timing::Call };
                Part { timing, ..Part::of_voice(0) }
            }
            Self::Free => Part::of_voice(k),
        };
        (0..places.len()).map(part).collect()
    }
}

/// Returns who stands in the right half, by X (then by Z); of an odd number the left half is larger.
fn right_half(places: &[Placement]) -> Vec<bool> {
    // Places that differ by rounding alone are in one file.
    let key = |k: &usize| ((places[*k].x_m * 1e6).round(), places[*k].z_m);
    let mut order: Vec<usize> = (0..places.len()).collect();
    order.sort_by(|a, b| {
        let ((xa, za), (xb, zb)) = (key(a), key(b));
        xa.total_cmp(&xb).then(za.total_cmp(&zb))
    });
    let mut is_right = vec![false; places.len()];
    for &k in &order[places.len().div_ceil(2)..] {
        is_right[k] = true;
    }
    is_right
}

/// What one dancer does in a span.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Part {
    /// Number of the choreography whose steps are danced.
    pub voice: usize,
    /// Whether left and right are exchanged.
    pub is_mirrored: bool,
    pub timing: Timing,
}

/// When a dancer does the steps of a voice.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Timing {
    /// As the voice has them.
    Now,
    /// So many bars later.
    BarsLate(usize),
    /// In every other bar from the first of the span on.
    Call,
    /// As [`Timing::Call`], a bar later.
    Response,
}

impl Part {
    const fn of_voice(voice: usize) -> Self {
        Self { voice, is_mirrored: false, timing: Timing::Now }
    }

    /// Returns the time in the voice at the time `at_s` of the song, in a span that begins on beat
    /// `first_beat` of the grid; s.
    ///
    /// With `b` the bars since the begin of the span, `t(b)` its inverse and `k` bars of delay, a canon
    /// dances `t(b - k)`. A call dances `t(G(b))` and its response `t(G(b - 1))`, where `G` grows by a bar in
    /// every even bar and rests in every odd one; it starts and stops within 0.15 s of a downbeat.
    pub fn voice_time_s(&self, at_s: f64, grid: &BeatGrid, first_beat: usize) -> f64 {
        let beats_per_bar = grid.beats_per_bar() as f64;
        let bars = || (grid.position(at_s) - first_beat as f64) / beats_per_bar;
        let time_of = |bars: f64| grid.time_s(first_beat as f64 + bars * beats_per_bar);
        let bar_s = grid.interval_s() * beats_per_bar;
        let half_start = (0.5 * START_S / bar_s).min(0.5 * MAX_START_BARS);
        match self.timing {
            Timing::Now => at_s,
            Timing::BarsLate(0) => at_s,
            Timing::BarsLate(k) => time_of(bars() - k as f64),
            Timing::Call => time_of(every_other_bar(bars(), half_start)),
            Timing::Response => time_of(every_other_bar(bars() - 1.0, half_start)),
        }
    }
}

/// Returns how many bars are danced after `bars` bars of which the even ones are danced.
///
/// The rate goes from 0 to 1 as `3u² - 2u³` from `half_start` bars before an even bar to as much after its
/// begin, and back about its end.
fn every_other_bar(bars: f64, half_start: f64) -> f64 {
    let n_danced = ((bars + half_start) / 2.0).floor();
    let x = bars - 2.0 * n_danced;
    // ∫ 3u² - 2u³ from -half_start to x.
    let ramp = |x: f64| {
        let u = ((x + half_start) / (2.0 * half_start)).clamp(0.0, 1.0);
        2.0 * half_start * u * u * u * (1.0 - u / 2.0)
    };
    n_danced
        + if x < half_start {
            ramp(x)
        } else if x < 1.0 - half_start {
            x
        } else {
            1.0 - ramp(1.0 - x)
        }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::phase::Beats;

    #[test]
    fn the_call_dances_even_bars_and_rests_in_odd_ones() {
        let half = 0.1;
        for (bars, danced) in [
            (-1.5, -0.5),
            (-0.5, 0.0),
            (0.1, 0.1),
            (0.5, 0.5),
            (0.9, 0.9),
            (1.1, 1.0),
            (1.7, 1.0),
            (2.5, 1.5),
            (3.5, 2.0),
            (4.25, 2.25),
        ] {
            let found = every_other_bar(bars, half);
            assert!((found - danced).abs() < 1e-12, "{bars}: {found}");
        }
        // The rate is continuous and within 0 and 1.
        let h = 1e-4;
        let rates: Vec<f64> = (0..60_000)
            .map(|i| f64::from(i) * h - 1.0)
            .map(|b| (every_other_bar(b + h, half) - every_other_bar(b, half)) / h)
            .collect();
        assert!(rates.iter().all(|r| (-1e-9..=1.0 + 1e-9).contains(r)));
        assert!(rates.windows(2).all(|r| (r[1] - r[0]).abs() < 1e-3));
    }

    #[test]
    fn a_canon_counts_bars_and_not_seconds() {
        // A bar of 3 s, one of 1.5 s, then 1.5 s each.
        let times = vec![0.0, 1.0, 2.0, 3.0, 3.5, 4.0, 4.5, 5.0, 5.5, 6.0];
        let beats = Beats::new(times, None, Some(3)).unwrap();
        let grid = BeatGrid::over(&beats, 6.0);
        let part = Part { timing: Timing::BarsLate(1), ..Part::of_voice(0) };
        for (at_s, voice_s) in [(3.0, 0.0), (3.25, 0.5), (4.0, 2.0), (4.5, 3.0), (5.75, 4.25)] {
            let found = part.voice_time_s(at_s, &grid, 3);
            assert!((found - voice_s).abs() < 1e-12, "{at_s}: {found}");
        }
        let two = Part { timing: Timing::BarsLate(2), ..Part::of_voice(0) };
        assert!((two.voice_time_s(4.75, &grid, 3) - 0.5).abs() < 1e-12);
    }

    #[test]
    fn halves_are_those_of_the_floor() {
        let at = |x_m: f64, z_m: f64| Placement { x_m, z_m, yaw_rad: 0.0 };
        let places = [at(1.0, 0.0), at(-1.0, 0.0), at(0.0, 2.0), at(0.0, -2.0), at(5.0, 1.0)];
        assert_eq!(right_half(&places), [true, false, false, false, true]);
        let mirrored: Vec<bool> =
            Unison::Mirrored.parts(&places).iter().map(|part| part.is_mirrored).collect();
        assert_eq!(mirrored, right_half(&places));
        let voices: Vec<usize> = Unison::Free.parts(&places).iter().map(|p| p.voice).collect();
        assert_eq!(voices, [0, 1, 2, 3, 4]);
        assert_eq!(
            Unison::ALL.map(Unison::name),
            ["same", "mirrored", "canon", "call_and_response", "free"]
        );
    }
}
