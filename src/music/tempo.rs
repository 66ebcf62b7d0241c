//! When beats are: a tempo that may drift.

use crate::chance::Chance;

/// Slowest and fastest tempo that a drift leads to, in beats per minute.
const BOUNDS_BPM: (f64, f64) = (60.0, 200.0);
/// How much of a wandering tempo's distance is left after a beat.
const WANDER_DECAY: f64 = 0.9;
/// Beats over which a song slows down at its end.
const SLOWING_BEATS: f64 = 8.0;

/// The times of beats; between two beats the tempo is constant.
#[derive(Clone, Debug, PartialEq)]
pub struct TempoMap {
    /// Of every beat, and of the one after the last.
    beat_times_s: Vec<f64>,
}

/// How a tempo moves.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Drift {
    Steady,
    /// Up and down, by about so much of itself (a standard deviation).
    Wander {
        share: f64,
    },
    /// From so much below its middle to so much above, or the other way.
    Ramp {
        share: f64,
    },
    /// Slower over the last beats, by so much of itself.
    Slowing {
        share: f64,
    },
}

impl TempoMap {
    /// Lays out beats, the first at `lead_s`, each as long as its tempo says.
    pub fn new(lead_s: f64, tempi_bpm: &[f64]) -> Self {
        let mut beat_times_s = Vec::with_capacity(tempi_bpm.len() + 1);
        beat_times_s.push(lead_s);
        let mut time_s = lead_s;
        for bpm in tempi_bpm {
            time_s += 60.0 / bpm;
            beat_times_s.push(time_s);
        }
        Self { beat_times_s }
    }

    /// Returns the time of a place in beats, in seconds; before the first beat and after the last the tempo
    /// goes on.
    pub fn time_s(&self, beats: f64) -> f64 {
        let times_s = &self.beat_times_s;
        let last = times_s.len().saturating_sub(2);
        let i = (beats.max(0.0) as usize).min(last);
        match (times_s.get(i), times_s.get(i + 1)) {
            (Some(&from), Some(&to)) => from + (beats - i as f64) * (to - from),
            (from, _) => from.copied().unwrap_or(0.0),
        }
    }
}

/// Returns the tempo of every beat, in beats per minute.
pub fn drifting(bpm: f64, n_beats: usize, drift: Drift, chance: &mut Chance) -> Vec<f64> {
    let mut distance = 0.0;
    let mut of_beat = |i: usize| match drift {
        Drift::Steady => bpm,
        Drift::Wander { share } => {
            // A walk that is drawn back: its variance is that of a step over 1 − 0.9², a step's is share²/3.
            let step = (2.0 * chance.uniform() - 1.0) * share * 0.755;
            distance = distance * WANDER_DECAY + step;
            bpm * (1.0 + distance)
        }
        Drift::Ramp { share } => {
            let at = i as f64 / n_beats.max(1) as f64;
            bpm * (1.0 + share * (2.0 * at - 1.0))
        }
        Drift::Slowing { share } => {
            let left = (n_beats - i) as f64;
            bpm * (1.0 - share * (1.0 - left / SLOWING_BEATS).max(0.0))
        }
    };
    (0..n_beats).map(|i| of_beat(i).clamp(BOUNDS_BPM.0, BOUNDS_BPM.1)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn time_runs_through_beats_and_on() {
        let map = TempoMap::new(0.5, &[60.0, 120.0, 120.0]);
        let found = [-1.0, 0.0, 0.25, 1.0, 1.5, 2.0, 3.0, 5.0].map(|beats| map.time_s(beats));
        assert_eq!(found, [-0.5, 0.5, 0.75, 1.5, 1.75, 2.0, 2.5, 3.5]);
        assert_eq!(TempoMap::new(0.25, &[]).time_s(7.0), 0.25);
    }

    #[test]
    fn drifts_stay_about_their_tempo() {
        let tempi = |drift| drifting(100.0, 4000, drift, &mut Chance::new(1, 0));
        assert!(tempi(Drift::Steady).iter().all(|bpm| *bpm == 100.0));
        let wander = tempi(Drift::Wander { share: 0.02 });
        let n = wander.len() as f64;
        let mean = wander.iter().sum::<f64>() / n;
        let deviation = (wander.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
        // √(4000 beats / 20 that hang together) = 14 independent values' worth of 2 bpm.
        assert!((mean - 100.0).abs() < 0.5 && (deviation - 2.0).abs() < 0.3, "{mean} {deviation}");
        let ramp = tempi(Drift::Ramp { share: -0.04 });
        assert_eq!((ramp[0], ramp[2000]), (104.0, 100.0));
        let slowing = tempi(Drift::Slowing { share: 0.2 });
        assert_eq!((slowing[3990], slowing[3996], slowing[3999]), (100.0, 90.0, 82.5));
    }
}
