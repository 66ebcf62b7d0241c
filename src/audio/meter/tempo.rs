//! The beat period: the hypothesis whose multiples the song repeats itself at.

use super::RATE_HZ;
use super::onsets::Onsets;
use crate::audio::stft::planner;

/// Slowest and fastest hypothesis, beats/min.
const RANGE_BPM: (f64, f64) = (50.0, 230.0);
/// Step between hypotheses, as a share of the tempo.
const STEP: f64 = 0.004;
/// Longest lag of the autocorrelation: 16 beats at 50 beats/min.
const N_LAGS: usize = 1921;
/// Multiples of the beat period at which a song is compared with itself, and what likeness there says for the
/// hypothesis: a beat, a half, two and three, bars and pairs of bars speak for it, and thirds against it, as they
/// are beats of something else. The weights are a conditional logit's over 131 songs of known tempo
/// (`docs/beats.md`), rounded.
const COMB: [(f64, f64); 14] = [
    (0.25, -0.5),
    (1.0 / 3.0, -1.0),
    (0.5, 1.0),
    (2.0 / 3.0, -1.0),
    (0.75, -0.2),
    (1.0, 4.0),
    (1.5, 0.4),
    (2.0, 1.3),
    (3.0, 2.6),
    (4.0, 3.4),
    (6.0, 0.5),
    (8.0, 1.4),
    (12.0, 2.6),
    (16.0, 1.3),
];
/// The prior over x = log₂(bpm/120): 1.66 x − 3.06 x², highest at 145 beats/min; long lags favour slow ones.
const PRIOR: (f64, f64) = (1.66, -3.06);
/// Tolerance of a lag: a song drifts, and hypotheses are STEP apart.
const TOLERANCE: f64 = 0.008;
/// Lags beyond this share of the song have too few pairs of frames.
const MAX_SHARE: f64 = 0.75;
/// Likeness at one, two and four beats below which there is no pulse: MIN + SPREAD/√T, as the likeness of noise
/// falls with its length.
const MIN_SALIENCE: (f64, f64) = (0.06, 3.0);

/// What [`find`] found.
#[derive(Clone, Copy, Debug)]
pub struct TempoEstimate {
    pub period_frames: f64,
    /// Mean likeness at one, two and four beats.
    pub salience: f64,
}

/// Returns the beat period of a song; none where it has no pulse.
pub fn find(onsets: &Onsets) -> Option<TempoEstimate> {
    let heard = onsets.registers.iter().zip(onsets.is_heard).filter(|(_, is_heard)| *is_heard);
    let each: Vec<Vec<f64>> = heard.map(|(e, _)| autocorrelation(e)).collect();
    let mean = |lag: usize| each.iter().map(|a| a[lag]).sum::<f64>() / each.len() as f64;
    let n_lags = each.iter().map(Vec::len).min()?;
    let likeness: Vec<f64> = (0..n_lags).map(mean).collect();
    let period = |i: usize| 60.0 * RATE_HZ / (RANGE_BPM.0 * (i as f64 * STEP).exp());
    let n = ((RANGE_BPM.1 / RANGE_BPM.0).ln() / STEP).ceil() as usize;
    let combs: Vec<[f64; COMB.len()]> = (0..n).map(|i| comb(&likeness, period(i))).collect();
    // A hypothesis is a local maximum of likeness at 1, 2, 4 and 8 beats.
    let peak: Vec<f64> = combs.iter().map(|v| v[5] + v[7] + v[9] + v[11]).collect();
    let around = |i: usize, by: usize| peak[(i + by) % n];
    let is_peak = |&i: &usize| peak[i] >= around(i, 1) && peak[i] >= around(i, n - 1);
    let score = |i: usize| {
        let x = (60.0 * RATE_HZ / period(i) / 120.0).log2();
        let sum: f64 = combs[i].iter().zip(COMB).map(|(likeness, (_, w))| likeness * w).sum();
        sum + PRIOR.0 * x + PRIOR.1 * x * x
    };
    let best = (0..n).filter(is_peak).max_by(|&a, &b| score(a).total_cmp(&score(b)))?;
    let salience = (combs[best][5] + combs[best][7] + combs[best][9]) / 3.0;
    let least = MIN_SALIENCE.0 + MIN_SALIENCE.1 / (onsets.sum.len() as f64).sqrt();
    if salience < least {
        return None;
    }
    Some(TempoEstimate {
        period_frames: refined(&autocorrelation(&onsets.sum), period(best)),
        salience,
    })
}

/// Returns the likeness at every multiple of the comb; that of half as long a lag where the song is too short.
fn comb(likeness: &[f64], period: f64) -> [f64; COMB.len()] {
    let mut found = [None; COMB.len()];
    for i in 0..COMB.len() {
        let lag = COMB[i].0 * period;
        let (from, to) = ((lag * (1.0 - TOLERANCE)).floor(), (lag * (1.0 + TOLERANCE)).ceil());
        found[i] = likeness
            .get(from as usize..=to as usize)
            .map(|range| range.iter().copied().fold(f64::NEG_INFINITY, f64::max))
            .or_else(|| i.checked_sub(2).and_then(|shorter| found[shorter]));
    }
    found.map(|likeness| likeness.unwrap_or(0.0))
}

/// Returns the period within 1.2 % whose first five octaves of multiples are the most alike.
fn refined(likeness: &[f64], period: f64) -> f64 {
    let at = |lag: f64| {
        let i = lag.floor() as usize;
        let (a, b) = (likeness.get(i)?, likeness.get(i + 1)?);
        Some(a + (b - a) * lag.fract())
    };
    let score = |period: f64| {
        let found: Vec<f64> =
            [1.0, 2.0, 4.0, 8.0, 16.0].iter().filter_map(|m| at(m * period)).collect();
        found.iter().sum::<f64>() / found.len().max(1) as f64
    };
    let candidates = (-24..=24).map(|i| period * (f64::from(i) * 0.0005).exp());
    candidates.max_by(|&a, &b| score(a).total_cmp(&score(b))).unwrap_or(period)
}

/// Returns the autocorrelation a\[l\] = T/(T − l) · Σ x\[t\] x[t + l] / Σ x\[t\]² of x = e − mean, for lags up to
/// 19.2 s and three quarters of the song.
fn autocorrelation(e: &[f64]) -> Vec<f64> {
    let n_frames = e.len();
    let n_fft = (2 * n_frames).next_power_of_two();
    let (forward, inverse) = {
        let mut planner = planner();
        (planner.plan_fft_forward(n_fft), planner.plan_fft_inverse(n_fft))
    };
    let mean = e.iter().sum::<f64>() / n_frames as f64;
    let mut x = forward.make_input_vec();
    x.iter_mut().zip(e).for_each(|(x, e)| *x = e - mean);
    let mut spectrum = forward.make_output_vec();
    forward.process(&mut x, &mut spectrum).expect("invariant: all buffers come from the plan");
    for s in &mut spectrum {
        *s = s.norm_sqr().into();
    }
    inverse.process(&mut spectrum, &mut x).expect("invariant: all buffers come from the plan");
    let n_lags = N_LAGS.min((MAX_SHARE * n_frames as f64) as usize + 1);
    let energy = x[0].max(f64::MIN_POSITIVE);
    let pairs = |lag: usize| n_frames as f64 / (n_frames - lag) as f64;
    (0..n_lags).map(|lag| x[lag] / energy * pairs(lag)).collect()
}
