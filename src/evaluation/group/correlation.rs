//! Group motion correlation: how far the energies of dancers go together.

use std::ops::Range;

use super::realism::compressed;
use super::{mean, n_frames, pairs};
use crate::evaluation::body::part;
use crate::evaluation::kinetic::{Formula, marker_energies, markers_m};
use crate::motion::Poses;

/// Frames of a piece in which dancers are matched in time: five seconds, as long as motions of the
/// published set.
pub const PIECE_FRAMES: usize = 150;

/// Numbers that stand for a frame: those of [`marker_energies`], and places of as many coordinates.
type Frame = [f64; 12];

/// Returns GMC as published: for every pair of dancers the mean over their warping path of `fᵢ(s)·fⱼ(t)`, f
/// the twelve energies of a frame as `ln(1 + 1.5 x)`; then the mean over pairs.
///
/// The path is that of dynamic time warping over the markers, in pieces of five seconds (the whole where it
/// is shorter). It is no correlation: energies are positive, so that it grows with how much is moved.
/// Published values near 80 are of 24 joints. Deviations: markers count from the mean place of their dancer,
/// else who stands elsewhere is matched elsewhere; the last frame, which has features here, is not left out.
/// None for fewer than two dancers or three frames. Source: Le et al., "Music-Driven Group Choreography",
/// CVPR 2023, and published code (`calculate_gmc_score`, `extract_kinetic_features_per_frame`).
pub fn published_correlation(dancers: &[Poses]) -> Option<f64> {
    let of_piece = |frames: Range<usize>| {
        let parts: Option<Vec<(Vec<Frame>, Vec<Frame>)>> = dancers
            .iter()
            .map(|dancer| {
                let dancer = part(dancer, frames.clone());
                Some((places(&dancer), energies(&dancer)?))
            })
            .collect();
        let parts = parts?;
        mean(pairs(parts.len()).filter_map(|(i, j)| {
            let path = warping_path(&parts[i].0, &parts[j].0);
            mean(path.into_iter().map(|(s, t)| inner(&parts[i].1[s], &parts[j].1[t])))
        }))
    };
    mean(pieces(n_frames(dancers)).into_iter().filter_map(of_piece))
}

/// Returns the correlation of the energies of dancers, in [-1, 1]: for every pair
/// `Σ fᵢ·fⱼ / √(Σ fᵢ² Σ fⱼ²)` over the frames and the twelve energies as `ln(1 + 1.5 x)`, each without its
/// mean over the motion; then the mean over pairs.
///
/// 1 where all put in and spare their energy together, whatever their places and headings. None for fewer
/// than two dancers or three frames, or where no pair moves unevenly.
pub fn correlation(dancers: &[Poses]) -> Option<f64> {
    let n_frames = n_frames(dancers);
    let centred: Option<Vec<Vec<Frame>>> = dancers
        .iter()
        .map(|dancer| {
            let mut energies = energies(&part(dancer, 0..n_frames))?;
            centre(&mut energies);
            Some(energies)
        })
        .collect();
    let centred = centred?;
    let square = |i: usize| centred[i].iter().map(|f| inner(f, f)).sum::<f64>();
    mean(pairs(centred.len()).filter_map(|(i, j)| {
        let both: f64 = centred[i].iter().zip(&centred[j]).map(|(a, b)| inner(a, b)).sum();
        let scale = (square(i) * square(j)).sqrt();
        (scale > 0.0).then(|| (both / scale).clamp(-1.0, 1.0))
    }))
}

/// Whole pieces; the whole where there is none.
pub(super) fn pieces(n_frames: usize) -> Vec<Range<usize>> {
    let n_pieces = n_frames / PIECE_FRAMES;
    if n_pieces == 0 {
        return std::iter::once(0..n_frames).collect();
    }
    (0..n_pieces).map(|i| i * PIECE_FRAMES..(i + 1) * PIECE_FRAMES).collect()
}

/// Energies of every frame; those of the first are those of the second.
fn energies(dancer: &Poses) -> Option<Vec<Frame>> {
    let energies = marker_energies(dancer, Formula::Correct)?;
    let first = energies.first().copied();
    Some(first.into_iter().chain(energies).map(|frame| frame.map(compressed)).collect())
}

/// Places of the four markers, counted from the mean place of the dancer.
fn places(dancer: &Poses) -> Vec<Frame> {
    let markers = markers_m(dancer);
    let mut places: Vec<Frame> =
        (0..dancer.len()).map(|t| std::array::from_fn(|i| markers[i / 3][t][i % 3])).collect();
    let n = places.len().max(1) as f64;
    let middle: [f64; 3] =
        std::array::from_fn(|i| markers[0].iter().map(|p| p[i]).sum::<f64>() / n);
    for place in &mut places {
        place.iter_mut().enumerate().for_each(|(i, x)| *x -= middle[i % 3]);
    }
    places
}

fn centre(frames: &mut [Frame]) {
    let n = frames.len() as f64;
    for i in 0..12 {
        let mean = frames.iter().map(|frame| frame[i]).sum::<f64>() / n;
        frames.iter_mut().for_each(|frame| frame[i] -= mean);
    }
}

fn inner(a: &Frame, b: &Frame) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

/// Returns the frames that belong together: the path from the first of both to the last of both with the
/// least `Σ |a[s] - b[t]|²`, by steps of one frame of either or both, of both where costs are equal.
///
/// Source: Sakoe and Chiba, "Dynamic programming algorithm optimization for spoken word recognition", 1978.
fn warping_path(a: &[Frame], b: &[Frame]) -> Vec<(usize, usize)> {
    let width = b.len();
    let mut cost = vec![f64::INFINITY; a.len() * width];
    for (s, x) in a.iter().enumerate() {
        for (t, y) in b.iter().enumerate() {
            let here: f64 = x.iter().zip(y).map(|(x, y)| (x - y).powi(2)).sum();
            let (_, before) = step(&cost, width, s, t);
            cost[s * width + t] = here + if (s, t) == (0, 0) { 0.0 } else { before };
        }
    }
    let mut path = Vec::new();
    let (mut s, mut t) = (a.len().saturating_sub(1), width.saturating_sub(1));
    if a.is_empty() || b.is_empty() {
        return path;
    }
    path.push((s, t));
    while (s, t) != (0, 0) {
        (s, t) = step(&cost, width, s, t).0;
        path.push((s, t));
    }
    path.reverse();
    path
}

/// The cheapest place from which a path reaches (s, t), and its cost.
fn step(cost: &[f64], width: usize, s: usize, t: usize) -> ((usize, usize), f64) {
    let places = [(1, 1), (1, 0), (0, 1)];
    let reachable = places.into_iter().filter(|(ds, dt)| *ds <= s && *dt <= t);
    let costs = reachable.map(|(ds, dt)| ((s - ds, t - dt), cost[(s - ds) * width + t - dt]));
    let nothing = ((0, 0), f64::INFINITY);
    costs.fold(nothing, |best, next| if next.1 < best.1 { next } else { best })
}
