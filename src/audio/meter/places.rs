//! What is heard at a beat, and how the music after it differs from that before.

use super::bands::{N_BANDS, N_NOTES, Spectra};
use super::onsets::Onsets;

/// Frames on either side of a place in which an onset belongs to it.
const HALF_ONSET: usize = 3;
/// Least standard deviation of a sign: what varies less says nothing.
const MIN_ONSET_DEVIATION: f64 = 0.25;
const MIN_CHANGE_DEVIATION: f64 = 0.01;

/// Standard deviations beyond which one place says no more.
const MOST: f64 = 5.0;

/// Something that may tell one beat from another.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sign {
    /// Onsets of the four registers.
    Low,
    LowMiddle,
    HighMiddle,
    High,
    /// Change of the 12 notes: 1 − cos of the means over this many places before and after.
    Harmony(usize),
    /// The same of the 36 bands.
    Colour(usize),
}

/// Signs at places of a song.
pub struct Places {
    registers: [Vec<Option<f64>>; 4],
    /// Over 1, 2 and 4 places.
    harmony: [Vec<Option<f64>>; 3],
    colour: [Vec<Option<f64>>; 3],
}

/// Lengths over which changes are heard, in places.
const LENGTHS: [usize; 3] = [1, 2, 4];

impl Places {
    /// Looks at places, frames in ascending order.
    pub fn at(places: &[f64], spectra: &Spectra, onsets: &Onsets) -> Self {
        let last = spectra.n_frames().saturating_sub(1);
        let strongest = |e: &Vec<f64>, place: f64| {
            let t = (place.round() as usize).min(last);
            let around = &e[t.saturating_sub(HALF_ONSET)..(t + HALF_ONSET + 1).min(e.len())];
            around.iter().copied().fold(0.0, f64::max)
        };
        let registers = onsets.registers.each_ref();
        let registers = registers.map(|e| places.iter().map(|&p| Some(strongest(e, p))).collect());
        let step = median_step(places);
        let change = |rows: &[f32], width: usize, length: usize| {
            let reach = length as f64 * step;
            let end = (rows.len() / width) as f64;
            let change_at = |&place: &f64| {
                // What lies outside the song differs from all that is in it.
                if place < reach || place + reach > end {
                    return None;
                }
                let before = mean_row(rows, width, place - reach, place);
                let after = mean_row(rows, width, place, place + reach);
                Some(1.0 - cosine(&before, &after))
            };
            places.iter().map(change_at).collect::<Vec<Option<f64>>>()
        };
        Self {
            registers,
            harmony: LENGTHS.map(|length| change(&spectra.notes, N_NOTES, length)),
            colour: LENGTHS.map(|length| change(&spectra.bands, N_BANDS, length)),
        }
    }

    /// Returns a sign at every place, in standard deviations from its mean, 0 where it cannot be told.
    pub fn standard(&self, sign: Sign) -> Vec<f64> {
        let over = |length: usize| LENGTHS.iter().position(|&l| l == length).unwrap_or(0);
        let (values, least) = match sign {
            Sign::Low => (&self.registers[0], MIN_ONSET_DEVIATION),
            Sign::LowMiddle => (&self.registers[1], MIN_ONSET_DEVIATION),
            Sign::HighMiddle => (&self.registers[2], MIN_ONSET_DEVIATION),
            Sign::High => (&self.registers[3], MIN_ONSET_DEVIATION),
            Sign::Harmony(length) => (&self.harmony[over(length)], MIN_CHANGE_DEVIATION),
            Sign::Colour(length) => (&self.colour[over(length)], MIN_CHANGE_DEVIATION),
        };
        let known = || values.iter().flatten();
        let n = known().count().max(1) as f64;
        let mean = known().sum::<f64>() / n;
        let deviation = (known().map(|x| (x - mean).powi(2)).sum::<f64>() / n).sqrt();
        let standard = |x: f64| ((x - mean) / deviation.max(least)).clamp(-MOST, MOST);
        values.iter().map(|value| value.map_or(0.0, standard)).collect()
    }
}

fn median_step(places: &[f64]) -> f64 {
    let mut steps: Vec<f64> = places.windows(2).map(|pair| pair[1] - pair[0]).collect();
    steps.sort_by(f64::total_cmp);
    steps.get(steps.len() / 2).copied().unwrap_or(1.0)
}

/// Returns the mean of the rows from one frame to before another, at least one.
fn mean_row(rows: &[f32], width: usize, from: f64, to: f64) -> Vec<f64> {
    let n_rows = rows.len() / width;
    let from = (from.max(0.0) as usize).min(n_rows.saturating_sub(1));
    let to = (to.max(0.0) as usize).clamp(from + 1, n_rows.max(from + 1));
    let mut mean = vec![0.0; width];
    for row in rows.chunks_exact(width).skip(from).take(to - from) {
        mean.iter_mut().zip(row).for_each(|(m, x)| *m += f64::from(*x));
    }
    mean.iter_mut().for_each(|m| *m /= (to - from) as f64);
    mean
}

fn cosine(a: &[f64], b: &[f64]) -> f64 {
    let dot = |a: &[f64], b: &[f64]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
    let norm = (dot(a, a) * dot(b, b)).sqrt();
    // Silence is like silence, and unlike all else.
    if norm > 1e-12 { dot(a, b) / norm } else { f64::from(dot(a, a) == dot(b, b)) }
}
