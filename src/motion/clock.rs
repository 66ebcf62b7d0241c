//! The clock: where in its bar and how fast the music is, as a network is told it.

use ndarray::Array2;

use super::phase::unwrapped;
use crate::units::FPS;

/// Numbers of a frame of the clock.
pub const CLOCK_DIM: usize = 10;

/// Names of the clock's numbers, in order.
pub const CLOCK_NAMES: [&str; CLOCK_DIM] = [
    "clock_cos_1",
    "clock_sin_1",
    "clock_cos_2",
    "clock_sin_2",
    "clock_cos_3",
    "clock_sin_3",
    "clock_cos_beat",
    "clock_sin_beat",
    "clock_log_tempo",
    "clock_known",
];

/// Tempo whose logarithm is 0.
const CENTRE_BPM: f64 = 120.0;

/// Tempi outside are none of music: a phase that stands still or rushes tells no clock.
const TEMPO_RANGE_BPM: std::ops::Range<f64> = 20.0..400.0;

/// Frames on either side over which the tempo of a frame is taken: a second.
const TEMPO_FRAMES: usize = 30;

/// Most by which a phase may fall by rounding, bars.
const MAX_FALL_BARS: f64 = 1e-3;

/// Returns the clock of frames with bar phase φ, \[T\] in bars: \[T, 10\], all zeros where φ tells no clock.
///
/// cos 2πnφ and sin 2πnφ for n = 1, 2, 3 and the beats of a bar B (4, or 3 in a waltz), ln(tempo / 120
/// beats per minute), and 1 where the clock is known. The tempo is 60 B dφ/dt, from the bars that pass in
/// the second on either side of a frame.
///
/// A phase tells no clock that falls within a bar, is not finite, or has another tempo than music: that of
/// captures without music stands still.
pub fn clock(phase: &[f64], beats_per_bar: u32) -> Array2<f32> {
    let n = phase.len();
    let mut clock = Array2::zeros((n, CLOCK_DIM));
    let bars = unwrapped(phase);
    // A difference with NaN is not above anything.
    let rises = bars.windows(2).all(|pair| pair[1] - pair[0] >= -MAX_FALL_BARS);
    if n < 2 || !rises || beats_per_bar == 0 {
        return clock;
    }
    let beats = f64::from(beats_per_bar);
    for (t, mut row) in clock.rows_mut().into_iter().enumerate() {
        let (first, last) = (t.saturating_sub(TEMPO_FRAMES), (t + TEMPO_FRAMES).min(n - 1));
        let bars_per_s = (bars[last] - bars[first]) / (last - first) as f64 * FPS;
        let tempo_bpm = 60.0 * beats * bars_per_s;
        if !TEMPO_RANGE_BPM.contains(&tempo_bpm) {
            continue;
        }
        for (i, harmonic) in [1.0, 2.0, 3.0, beats].into_iter().enumerate() {
            let (sin, cos) = (std::f64::consts::TAU * harmonic * phase[t]).sin_cos();
            row[2 * i] = cos as f32;
            row[2 * i + 1] = sin as f32;
        }
        row[8] = (tempo_bpm / CENTRE_BPM).ln() as f32;
        row[9] = 1.0;
    }
    clock
}

/// Returns whether a phase tells the clock of some frame.
pub fn is_known(phase: &[f64], beats_per_bar: u32) -> bool {
    clock(phase, beats_per_bar).column(CLOCK_DIM - 1).iter().any(|&known| known == 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::phase::bar_phase_at_tempo;
    use crate::units::frames_to_s;

    fn phase_at(tempo_bpm: f64, beats_per_bar: u32, n: usize) -> Vec<f64> {
        let times_s: Vec<f64> = (0..n).map(frames_to_s).collect();
        bar_phase_at_tempo(&times_s, tempo_bpm, 0.4, beats_per_bar)
    }

    #[test]
    fn the_clock_of_a_steady_tempo_follows_from_its_formula() {
        for (tempo_bpm, beats_per_bar) in [(93.0, 3), (151.0, 4)] {
            let phase = phase_at(tempo_bpm, beats_per_bar, 77);
            let clock = clock(&phase, beats_per_bar);
            for (row, phi) in clock.rows().into_iter().zip(&phase) {
                let angle = std::f64::consts::TAU * phi;
                let beats = f64::from(beats_per_bar);
                let expected = [
                    angle.cos(),
                    angle.sin(),
                    (2.0 * angle).cos(),
                    (2.0 * angle).sin(),
                    (3.0 * angle).cos(),
                    (3.0 * angle).sin(),
                    (beats * angle).cos(),
                    (beats * angle).sin(),
                    (tempo_bpm / 120.0).ln(),
                    1.0,
                ];
                for (found, expected) in row.iter().zip(expected) {
                    // Of single precision.
                    assert!((f64::from(*found) - expected).abs() < 1e-6, "{found} {expected}");
                }
            }
        }
    }

    #[test]
    fn the_tempo_is_that_of_the_seconds_around_a_frame() {
        // 60 beats a minute, then 120.
        let mut bars = vec![0.0];
        for t in 0..200 {
            bars.push(bars[t] + if t < 100 { 1.0 } else { 2.0 } / (4.0 * FPS));
        }
        let phase: Vec<f64> = bars.iter().map(|bars: &f64| bars.fract()).collect();
        let clock = clock(&phase, 4);
        let tempo_bpm = |t: usize| 120.0 * f64::from(clock[[t, 8]]).exp();
        for (t, expected) in [(0, 60.0), (70, 60.0), (100, 90.0), (130, 120.0), (200, 120.0)] {
            assert!((tempo_bpm(t) - expected).abs() < 1e-4, "{t}: {}", tempo_bpm(t));
        }
    }

    #[test]
    fn a_phase_that_is_none_of_music_tells_no_clock() {
        let mut falling = phase_at(120.0, 4, 60);
        falling[31] -= 0.1;
        let mut broken = phase_at(120.0, 4, 60);
        broken[7] = f64::NAN;
        let too_fast = phase_at(800.0, 4, 60);
        for phase in [vec![0.0; 60], falling, broken, too_fast, vec![0.5], vec![]] {
            assert_eq!(clock(&phase, 4), Array2::<f32>::zeros((phase.len(), CLOCK_DIM)));
        }
        assert!(clock(&phase_at(120.0, 4, 60), 0).iter().all(|&x| x == 0.0));
    }
}
