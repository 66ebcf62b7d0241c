//! Following the beats of a known period.

use super::onsets::Onsets;
use super::places::{Places, Sign};

/// Weight of an even pulse against strong onsets.
const TIGHTNESS: f64 = 300.0;
/// Shortest and longest interval, in periods.
const INTERVALS: (f64, f64) = (0.6, 1.6);
/// Beats on either side that a beat's time is smoothed over, and their weight's standard deviation.
const HALF_WINDOW: usize = 9;
const DEVIATION_BEATS: f64 = 3.0;

/// Returns the beats of a song as frames, to fractions of a frame, ascending.
///
/// The chain that maximises Σ o(tᵢ) − 300 ln²((tᵢ − tᵢ₋₁)/period) (Ellis 2007), without weak beats at either end,
/// its times smoothed by local lines.
pub fn follow(onsets: &Onsets, period: f64) -> Vec<f64> {
    let chain = chain(&onsets.sum, period);
    let chain = trimmed(&chain, &onsets.sum);
    smoothed(chain, &onsets.sum)
}

fn chain(o: &[f64], period: f64) -> Vec<usize> {
    let lags = (period * INTERVALS.0).round() as usize..=(period * INTERVALS.1).round() as usize;
    let penalties: Vec<(usize, f64)> =
        lags.map(|lag| (lag, -TIGHTNESS * (lag as f64 / period).ln().powi(2))).collect();
    let mut scores = o.to_vec();
    let mut back: Vec<Option<usize>> = vec![None; o.len()];
    for t in 0..o.len() {
        let mut best = (None, 0.0);
        for &(lag, penalty) in &penalties {
            let Some(before) = t.checked_sub(lag) else { break };
            let score = scores[before] + penalty;
            if score > best.1 {
                best = (Some(before), score);
            }
        }
        scores[t] = o[t] + best.1;
        back[t] = best.0;
    }
    let last_period = o.len().saturating_sub(period as usize)..o.len();
    let last = last_period.max_by(|&a, &b| scores[a].total_cmp(&scores[b]));
    let mut beats: Vec<usize> = std::iter::successors(last, |&t| back[t]).collect();
    beats.reverse();
    beats
}

/// Returns the strongest onset within `half` frames of a beat.
fn strength(o: &[f64], beat: usize, half: usize) -> f64 {
    let around = &o[beat.saturating_sub(half)..(beat + half + 1).min(o.len())];
    around.iter().copied().fold(0.0, f64::max)
}

/// Returns the beats from the first to the last that is at least half as strong as their root mean square.
fn trimmed<'a>(beats: &'a [usize], o: &[f64]) -> &'a [usize] {
    let strengths: Vec<f64> = beats.iter().map(|&beat| strength(o, beat, 3)).collect();
    let mean_square = strengths.iter().map(|s| s * s).sum::<f64>() / beats.len().max(1) as f64;
    let is_strong = |s: &f64| *s > 0.5 * mean_square.sqrt();
    match (strengths.iter().position(is_strong), strengths.iter().rposition(is_strong)) {
        (Some(first), Some(last)) => &beats[first..=last],
        _ => beats,
    }
}

/// Returns the beats' times as local lines over their number have them, weighted by their onsets.
fn smoothed(beats: &[usize], o: &[f64]) -> Vec<f64> {
    let peak = |&t: &usize| {
        let Some(&[p, q, r]) = t.checked_sub(1).and_then(|from| o.get(from..from + 3)) else {
            return t as f64;
        };
        let curvature = p - 2.0 * q + r;
        if curvature < 0.0 {
            t as f64 + (0.5 * (p - r) / curvature).clamp(-1.0, 1.0)
        } else {
            t as f64
        }
    };
    let times: Vec<f64> = beats.iter().map(peak).collect();
    let onsets: Vec<f64> = beats.iter().map(|&t| strength(o, t, 1) + 0.1).collect();
    let line_at = |k: usize| {
        let window = k.saturating_sub(HALF_WINDOW)..(k + HALF_WINDOW + 1).min(times.len());
        let points = || {
            window.clone().map(|i| {
                let d = i as f64 - k as f64;
                (d, times[i], onsets[i] * (-0.5 * (d / DEVIATION_BEATS).powi(2)).exp())
            })
        };
        let weight: f64 = points().map(|(_, _, w)| w).sum();
        let mean_d = points().map(|(d, _, w)| w * d).sum::<f64>() / weight;
        let mean_t = points().map(|(_, t, w)| w * t).sum::<f64>() / weight;
        let var = points().map(|(d, _, w)| w * (d - mean_d).powi(2)).sum::<f64>();
        let cov = points().map(|(d, t, w)| w * (d - mean_d) * (t - mean_t)).sum::<f64>();
        let slope = if var > 1e-9 { cov / var } else { 0.0 };
        (mean_t - slope * mean_d).max(0.0)
    };
    let mut smooth: Vec<f64> = (0..times.len()).map(line_at).collect();
    // Lines of neighbours cross where the first beats lie near 0.
    smooth.dedup_by(|later, earlier| *later <= *earlier);
    smooth
}

/// What says which of two chains half a beat apart is on the beat: harmony changes there, and the spectrum, and
/// there are more onsets. Weights of the difference of means, in standard deviations.
const ON_BEAT: [(Sign, f64); 10] = [
    (Sign::Low, 0.2),
    (Sign::LowMiddle, 0.2),
    (Sign::HighMiddle, 0.2),
    (Sign::High, 0.2),
    (Sign::Harmony(1), 1.5),
    (Sign::Harmony(2), 1.0),
    (Sign::Harmony(4), 2.0),
    (Sign::Colour(1), 0.3),
    (Sign::Colour(2), 0.3),
    (Sign::Colour(4), 0.3),
];

/// Returns the beats, or what lies half way between them if that has more of the signs of a beat.
pub fn on_the_beat(beats: Vec<f64>, places: impl Fn(&[f64]) -> Places) -> Vec<f64> {
    let middles: Vec<f64> = beats.windows(2).map(|pair| (pair[0] + pair[1]) / 2.0).collect();
    let mut halves: Vec<f64> = Vec::with_capacity(2 * beats.len());
    for (i, &beat) in beats.iter().enumerate() {
        halves.push(beat);
        halves.extend(middles.get(i));
    }
    let places = places(&halves);
    let evidence: f64 = ON_BEAT
        .iter()
        .map(|&(sign, weight)| {
            let z = places.standard(sign);
            weight * (mean_of(&z, 0, 2) - mean_of(&z, 1, 2))
        })
        .sum();
    if evidence >= 0.0 {
        return beats;
    }
    let before = middles[0] - (beats[1] - beats[0]);
    (before >= 0.0).then_some(before).into_iter().chain(middles).collect()
}

/// Returns the mean of every n-th value from `first` on; 0 for none.
pub fn mean_of(values: &[f64], first: usize, n: usize) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for x in values.iter().skip(first).step_by(n) {
        sum += x;
        count += 1;
    }
    if count == 0 { 0.0 } else { sum / f64::from(count) }
}
