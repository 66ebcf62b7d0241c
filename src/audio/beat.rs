//! Tempo and beats from an onset envelope (Ellis 2007, "Beat tracking by dynamic programming"), as
//! librosa's `beat_track` with its defaults at 30 frames per second.

use super::stft::{hann, planner};
use crate::units::FPS;

/// Frames per minute: a lag of k frames is a tempo of 1800/k bpm.
const FRAMES_PER_MINUTE: f64 = 60.0 * FPS;
/// Lags of the tempogram: 8 s.
const N_LAGS: usize = 240;
/// Length of the autocorrelation's transform, at least 2·240 − 1.
const N_FFT: usize = 512;
/// Centre of the prior over tempo (one octave of standard deviation), in bpm.
const START_BPM: f64 = 120.0;
/// Tempi from here on are excluded, in bpm.
const MAX_BPM: f64 = 320.0;
/// Weight of a steady tempo against strong onsets.
const TIGHTNESS: f64 = 100.0;
/// librosa adds the smallest normal f32 where it divides.
const TINY: f64 = f32::MIN_POSITIVE as f64;

/// Tempo and beats of a file.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rhythm {
    /// 1800/k bpm for a whole number of frames k; 0 without onsets.
    pub tempo_bpm: f64,
    /// Frames with a beat, ascending.
    pub beat_frames: Vec<usize>,
}

/// Tracks the beats of an onset envelope with one value per frame.
pub fn track_beats(envelope: &[f32]) -> Rhythm {
    if envelope.iter().all(|&e| e == 0.0) {
        return Rhythm::default();
    }
    let e: Vec<f64> = envelope.iter().map(|&e| f64::from(e)).collect();
    let period = period_frames(&e);
    let local = local_score(&e, period);
    let (cumulative, back) = link_beats(&local, period);
    let mut beat_frames = Vec::new();
    let mut at = Some(last_beat(&cumulative));
    while let Some(frame) = at {
        beat_frames.push(frame);
        at = back[frame];
    }
    beat_frames.reverse();
    trim(&mut beat_frames, &local);
    Rhythm { tempo_bpm: FRAMES_PER_MINUTE / period as f64, beat_frames }
}

/// Returns the beat period in frames: argmax over lags of ln(1 + 10⁶ g[lag]) − ½·log₂(bpm/120)²,
/// g being the mean over time of the local autocorrelation.
fn period_frames(e: &[f64]) -> usize {
    let g = mean_autocorrelation(e);
    let score = |lag: usize| {
        let octaves = (FRAMES_PER_MINUTE / lag as f64 / START_BPM).log2();
        (1e6 * g[lag]).ln_1p() - 0.5 * octaves * octaves
    };
    let lags = (1..N_LAGS).filter(|&lag| FRAMES_PER_MINUTE / (lag as f64) < MAX_BPM);
    let mut best = (0, f64::NEG_INFINITY);
    for lag in lags {
        let score = score(lag);
        if score > best.1 {
            best = (lag, score);
        }
    }
    best.0
}

/// Returns the autocorrelation of Hann windows of 240 frames around every frame, each divided by
/// its maximum (its energy), averaged over time. Ramps of 120 frames to 0 extend the envelope.
fn mean_autocorrelation(e: &[f64]) -> Vec<f64> {
    let half = N_LAGS / 2;
    let (first, last) = (e[0], e[e.len() - 1]);
    let ramp = |edge: f64, i: usize| edge * i as f64 / half as f64;
    let before = (0..half).map(|i| ramp(first, i));
    let after = (0..half).rev().map(|i| ramp(last, i));
    let padded: Vec<f64> = before.chain(e.iter().copied()).chain(after).collect();

    let window: Vec<f64> = (0..N_LAGS).map(|n| hann(n, N_LAGS)).collect();
    let (forward, inverse) = {
        let mut planner = planner();
        (planner.plan_fft_forward(N_FFT), planner.plan_fft_inverse(N_FFT))
    };
    let (mut time, mut spectrum) = (forward.make_input_vec(), forward.make_output_vec());
    let mut scratch = forward.make_scratch_vec();
    // The mean commutes with the inverse transform, so one of those is enough.
    let mut mean_power = inverse.make_input_vec();
    for start in 0..e.len() {
        time.fill(0.0);
        let mut energy = 0.0;
        for ((t, e), w) in time.iter_mut().zip(&padded[start..start + N_LAGS]).zip(&window) {
            *t = e * w;
            energy += *t * *t;
        }
        if energy == 0.0 {
            continue;
        }
        forward
            .process_with_scratch(&mut time, &mut spectrum, &mut scratch)
            .expect("invariant: buffers of the plan");
        let scale = 1.0 / (if energy < TINY { 1.0 } else { energy });
        for (mean, x) in mean_power.iter_mut().zip(&spectrum) {
            mean.re += x.norm_sqr() * scale;
        }
    }
    let mut g = inverse.make_output_vec();
    inverse.process(&mut mean_power, &mut g).expect("invariant: real spectrum of the plan");
    let n = (N_FFT * e.len()) as f64;
    g.truncate(N_LAGS);
    // Rounding may leave a lag without correlation just below 0.
    g.into_iter().map(|g| (g / n).max(0.0)).collect()
}

/// local[i] = Σ_{|j| ≤ k} e^(−½(32j/k)²) · x[i − j], x the envelope over its standard deviation.
fn local_score(e: &[f64], period: usize) -> Vec<f64> {
    let n = e.len() as f64;
    let mean = e.iter().sum::<f64>() / n;
    let variance = e.iter().map(|e| (e - mean) * (e - mean)).sum::<f64>() / (n - 1.0);
    let scale = 1.0 / (variance.sqrt() + TINY);
    let weights: Vec<f64> =
        (0..=period).map(|j| (-0.5 * (32.0 * j as f64 / period as f64).powi(2)).exp()).collect();
    // librosa 0.11 and 1.0 leave the first frame out of the sum; it is 0 in every onset envelope.
    let x = |i: usize| if i == 0 { 0.0 } else { e[i] * scale };
    let sum = |i: usize| -> f64 {
        let first = i.saturating_sub(period);
        let last = (i + period).min(e.len() - 1);
        (first..=last).map(|m| weights[i.abs_diff(m)] * x(m)).sum()
    };
    (0..e.len()).map(sum).collect()
}

/// Returns the best score of a beat sequence that ends at each frame, and the beat before.
///
/// C[i] = local[i] + max over lags d = k/2 … 2k of C[i − d] − 100·(ln d − ln k)²
fn link_beats(local: &[f64], period: usize) -> (Vec<f64>, Vec<Option<usize>>) {
    let k = period as f64;
    let shortest = round_half_even(k / 2.0).max(1);
    let penalty = |d: usize| TIGHTNESS * ((d as f64).ln() - k.ln()).powi(2);
    let penalties: Vec<f64> = (shortest..=2 * period).map(penalty).collect();
    let silent_below = 0.01 * local.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let mut cumulative = vec![0.0; local.len()];
    let mut back = vec![None; local.len()];
    let mut has_begun = false;
    for i in 0..local.len() {
        let mut best = None;
        for (d, penalty) in (shortest..=i.min(2 * period)).zip(&penalties) {
            let score = cumulative[i - d] - penalty;
            if best.is_none_or(|(_, highest)| score > highest) {
                best = Some((i - d, score));
            }
        }
        cumulative[i] = local[i] + best.map_or(0.0, |(_, score)| score);
        has_begun |= local[i] >= silent_below;
        if has_begun {
            back[i] = best.map(|(from, _)| from);
        }
    }
    (cumulative, back)
}

fn round_half_even(x: f64) -> usize {
    x.round_ties_even() as usize
}

/// Returns the last local maximum of the scores that reaches half their median.
fn last_beat(cumulative: &[f64]) -> usize {
    let n = cumulative.len();
    let is_peak = |i: usize| {
        i > 0
            && cumulative[i] > cumulative[i - 1]
            && (i + 1 == n || cumulative[i] >= cumulative[i + 1])
    };
    let mut peaks: Vec<f64> = (0..n).filter(|&i| is_peak(i)).map(|i| cumulative[i]).collect();
    peaks.sort_unstable_by(f64::total_cmp);
    let median = match (peaks.len(), peaks.len() / 2) {
        (0, _) => 0.0,
        (len, half) if len % 2 == 1 => peaks[half],
        (_, half) => (peaks[half - 1] + peaks[half]) / 2.0,
    };
    (0..n).rev().find(|&i| is_peak(i) && cumulative[i] >= 0.5 * median).unwrap_or(n - 1)
}

/// Removes beats from both ends up to the first, and behind the last, strong frame.
fn trim(beat_frames: &mut Vec<usize>, local: &[f64]) {
    let at_beats: Vec<f64> = beat_frames.iter().map(|&frame| local[frame]).collect();
    // Convolution with [0, ½, 1, ½, 0] without its first two values, never longer than the file.
    let at = |i: isize| usize::try_from(i).ok().and_then(|i| at_beats.get(i)).unwrap_or(&0.0);
    let n = (at_beats.len() + 2).min(local.len());
    let smooth = |i: isize| 0.5 * at(i - 1) + at(i) + 0.5 * at(i + 1);
    let energy: f64 = (0..n as isize).map(|i| smooth(i).powi(2)).sum();
    let threshold = 0.5 * (energy / n as f64).sqrt();
    let is_strong = |&frame: &usize| local[frame] > threshold;
    let frames = 0..local.len();
    let first = frames.clone().find(is_strong).unwrap_or(local.len());
    let last = frames.rev().find(is_strong);
    beat_frames.retain(|&frame| frame >= first && last.is_some_and(|last| frame <= last));
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    /// Onsets every `period` frames, from frame `first` on.
    fn pulses(n: usize, first: usize, period: usize) -> Vec<f32> {
        (0..n)
            .map(|i| if i >= first && (i - first).is_multiple_of(period) { 2.0 } else { 0.01 })
            .collect()
    }

    #[test]
    fn steady_pulses_are_found_where_they_are() {
        for period in [11, 15, 19] {
            let rhythm = track_beats(&pulses(601, 7, period));
            assert_eq!(rhythm.tempo_bpm, 1800.0 / period as f64);
            let frames = rhythm.beat_frames;
            assert!(frames.len() >= 601 / period - 2, "period {period}: {frames:?}");
            assert!(frames.iter().all(|frame| (frame - 7) % period == 0), "{frames:?}");
        }
    }

    #[test]
    fn silence_and_shreds_have_no_beats() {
        assert_eq!(track_beats(&[]), Rhythm::default());
        assert_eq!(track_beats(&[0.0; 500]), Rhythm::default());
        // Whatever comes of so little, it must not panic.
        for n in 1..9 {
            track_beats(&vec![0.5; n]);
            track_beats(&pulses(n, 1, 2));
        }
    }

    #[test]
    fn the_autocorrelation_is_its_definition() {
        let e: Vec<f64> = (0..7).map(|i| f64::from(i * i % 5) + 0.25).collect();
        let ramp = |edge: f64, i: usize| edge * i as f64 / 120.0;
        let padded: Vec<f64> = (0..120)
            .map(|i| ramp(e[0], i))
            .chain(e.iter().copied())
            .chain((0..120).map(|i| ramp(e[6], 119 - i)))
            .collect();
        let mut expected = vec![0.0; N_LAGS];
        for t in 0..e.len() {
            let x: Vec<f64> = (0..N_LAGS)
                .map(|n| padded[t + n] * (0.5 - 0.5 * (TAU * n as f64 / 240.0).cos()))
                .collect();
            let energy: f64 = x.iter().map(|x| x * x).sum();
            for (lag, sum) in expected.iter_mut().enumerate() {
                let products = x.iter().zip(&x[lag..]).map(|(a, b)| a * b);
                *sum += products.sum::<f64>() / energy / e.len() as f64;
            }
        }
        for (lag, (found, expected)) in mean_autocorrelation(&e).iter().zip(&expected).enumerate() {
            assert!((found - expected).abs() < 1e-13, "lag {lag}: {found} != {expected}");
        }
    }
}
