//! How many beats a bar has, and which is the first.

use super::Bar;
use super::bands::{N_BANDS, Spectra};
use super::onsets::rise;
use super::places::{Places, Sign};
use super::pulse::mean_of;

/// Fewest beats in which bars are told.
const MIN_BEATS: usize = 12;
/// Least margin between the best first beat and the next best; below it every second downbeat was wrong.
const MIN_MARGIN: f64 = 0.3;

/// Signs that tell beats of a bar apart.
const SIGNS: [Sign; 5] =
    [Sign::Low, Sign::High, Sign::Harmony(2), Sign::Harmony(4), Sign::Colour(4)];
/// What every sign says for the first, second … beat of a bar: harmony, colour and bass change on the first;
/// what is bright (a snare, a hat) comes after it. A conditional logit's weights over songs of known bars
/// (`docs/beats.md`), rounded; of bars of three the generated ones alone.
const FOUR: [[f64; SIGNS.len()]; 4] = [
    [0.5, -0.35, 0.7, 0.5, 0.7],
    [-0.1, 0.35, -0.15, -0.1, 0.0],
    [-0.15, -0.35, -0.45, -0.3, -0.4],
    [-0.25, 0.35, -0.1, -0.1, -0.3],
];
const THREE: [[f64; SIGNS.len()]; 3] =
    [[0.5, -0.35, 0.7, 0.5, 0.7], [-0.1, 0.3, -0.1, 0.0, 0.0], [-0.4, 0.05, -0.6, -0.5, -0.7]];

/// Parts of a beat of which each has its onsets.
const PARTS: usize = 4;
/// Lags in beats at which bars of four, and of three, repeat themselves, and their weights.
const REPEATS_OF_FOUR: [(usize, f64); 3] = [(4, 1.0), (8, 1.0), (16, 0.5)];
const REPEATS_OF_THREE: [(usize, f64); 3] = [(3, 1.0), (6, 1.0), (9, 0.5)];

/// Returns the bars of beats, given in frames; none where no beat stands out.
pub fn find(places: &Places, beats: &[f64], spectra: &Spectra) -> Option<Bar> {
    if beats.len() < MIN_BEATS {
        return None;
    }
    let signs = SIGNS.map(|sign| places.standard(sign));
    let rhythm = rhythm(beats, spectra);
    let alike = |lags: [(usize, f64); 3]| {
        lags.iter().map(|&(lag, w)| w * likeness(&rhythm, lag)).sum::<f64>()
    };
    let template: &[[f64; SIGNS.len()]] =
        if alike(REPEATS_OF_THREE) > alike(REPEATS_OF_FOUR) { &THREE } else { &FOUR };
    let n = template.len();
    let evidence = |first: usize| -> f64 {
        let of_beat = |(k, weights): (usize, &[f64; SIGNS.len()])| {
            let means = signs.iter().map(|z| mean_of(z, (first + k) % n, n));
            means.zip(weights).map(|(mean, w)| mean * w).sum::<f64>()
        };
        template.iter().enumerate().map(of_beat).sum()
    };
    let mut ranked: Vec<(f64, usize)> = (0..n).map(|first| (evidence(first), first)).collect();
    ranked.sort_by(|a, b| b.0.total_cmp(&a.0));
    let margin = ranked[0].0 - ranked[1].0;
    let bar = Bar { beats_per_bar: n, first_downbeat: ranked[0].1, margin };
    (margin >= MIN_MARGIN).then_some(bar)
}

/// Returns the strongest rise of every band in every quarter of every beat, in standard deviations,
/// [beats][4 · 36].
fn rhythm(beats: &[f64], spectra: &Spectra) -> Vec<Vec<f64>> {
    let last = spectra.n_frames() - 1;
    let step = beats[beats.len() - 1] - beats[beats.len() - 2];
    let ends: Vec<f64> = beats.iter().copied().chain([beats[beats.len() - 1] + step]).collect();
    let of_beat = |pair: &[f64]| -> Vec<f64> {
        let (a, b) = ((pair[0].round() as usize).min(last), (pair[1].round() as usize).min(last));
        let quarter = b.saturating_sub(a).max(PARTS) / PARTS;
        let strongest = |part: usize, band: usize| {
            let from = (a + b.saturating_sub(a) * part / PARTS).min(last);
            let frames = from..(from + quarter).min(last + 1);
            frames.map(|t| f64::from(rise(spectra, t, band))).fold(0.0, f64::max)
        };
        (0..PARTS * N_BANDS).map(|i| strongest(i / N_BANDS, i % N_BANDS)).collect()
    };
    let mut rows: Vec<Vec<f64>> = ends.windows(2).map(of_beat).collect();
    let n = rows.len() as f64;
    for column in 0..PARTS * N_BANDS {
        let mean = rows.iter().map(|row| row[column]).sum::<f64>() / n;
        let variance = rows.iter().map(|row| (row[column] - mean).powi(2)).sum::<f64>() / n;
        for row in &mut rows {
            row[column] = (row[column] - mean) / variance.sqrt().max(1e-3);
        }
    }
    rows
}

/// Returns the mean product of rows `lag` beats apart; 0 where there are hardly any.
fn likeness(rows: &[Vec<f64>], lag: usize) -> f64 {
    if rows.len() <= lag + 2 {
        return 0.0;
    }
    let dot = |(a, b): (&Vec<f64>, &Vec<f64>)| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let sum: f64 = rows.iter().zip(&rows[lag..]).map(dot).sum();
    sum / ((rows.len() - lag) * PARTS * N_BANDS) as f64
}
