//! Banks of filters: weighted sums over neighbouring bins of a spectrum.

use crate::instructions::vectorized;

/// Terms that a row sums side by side.
const LANES: usize = 4;

/// Rows of weights over neighbouring bins: y\[i\] = Σ_k w\[i, k\] · x\[k\].
#[derive(Clone, Debug, PartialEq)]
pub struct Bank {
    rows: Vec<Row>,
    /// The weights of all rows, each padded with zeros to whole lanes.
    weights: Vec<[f64; LANES]>,
}

#[derive(Clone, Copy, Debug, PartialEq)]
struct Row {
    /// The first bin.
    first: usize,
    /// How many lots of [`LANES`] bins.
    n_lots: usize,
}

impl Bank {
    /// Takes the first bin and the weights of every row over a spectrum of `n_bins`, which is no less than
    /// a row takes when it is padded.
    pub fn new(n_bins: usize, rows: impl IntoIterator<Item = (usize, Vec<f64>)>) -> Self {
        let mut bank = Self { rows: Vec::new(), weights: Vec::new() };
        for (first, weights) in rows {
            let n_padded = weights.len().next_multiple_of(LANES);
            // Padding must not reach beyond the bins.
            let start = first.min(n_bins - n_padded);
            let weight = |bin: usize| {
                let at = bin.checked_sub(first);
                at.and_then(|at| weights.get(at)).copied().unwrap_or_default()
            };
            let lot = |i: usize| std::array::from_fn(|l| weight(start + LANES * i + l));
            bank.weights.extend((0..n_padded / LANES).map(lot));
            bank.rows.push(Row { first: start, n_lots: n_padded / LANES });
        }
        bank
    }

    /// Writes the sum of every row over either of two spectra, in f64 and rounded once.
    pub fn apply(&self, spectra: [&[f64]; 2], sums: [&mut [f32]; 2]) {
        apply(&self.rows, &self.weights, spectra, sums);
    }

    /// Returns the first bin and the weights of every row, padding and all.
    #[cfg(test)]
    pub fn rows(&self) -> impl Iterator<Item = (usize, &[f64])> {
        let mut rest = self.weights.as_slice();
        self.rows.iter().map(move |row| {
            let (weights, others) = rest.split_at(row.n_lots);
            rest = others;
            (row.first, weights.as_flattened())
        })
    }
}

/// Rows whose lanes are kept before they are added up.
const GROUP: usize = 32;

vectorized! {
    fn apply(rows: &[Row], weights: &[[f64; LANES]], spectra: [&[f64]; 2], sums: [&mut [f32]; 2]) {
        let mut rest = weights;
        let [first_sums, second_sums] = sums;
        let groups = first_sums.chunks_mut(GROUP).zip(second_sums.chunks_mut(GROUP));
        for (rows, (first_sums, second_sums)) in rows.chunks(GROUP).zip(groups) {
            // Lanes that lie in memory are added to as vectors; sums across them come after.
            let mut lanes = [[[0.0; LANES]; GROUP]; 2];
            let [first_lanes, second_lanes] = &mut lanes;
            for ((row, first), second) in rows.iter().zip(first_lanes).zip(second_lanes) {
                let (weights, others) = rest.split_at(row.n_lots);
                rest = others;
                let bins = row.first..row.first + LANES * row.n_lots;
                let [x, y] = spectra.map(|spectrum| spectrum[bins.clone()].as_chunks::<LANES>().0);
                let (mut x_lanes, mut y_lanes) = ([0.0; LANES], [0.0; LANES]);
                for ((w, x), y) in weights.iter().zip(x).zip(y) {
                    for l in 0..LANES {
                        x_lanes[l] += w[l] * x[l];
                    }
                    for l in 0..LANES {
                        y_lanes[l] += w[l] * y[l];
                    }
                }
                *first = x_lanes;
                *second = y_lanes;
            }
            for (sums, lanes) in [first_sums, second_sums].into_iter().zip(&lanes) {
                for (sum, [a, b, c, d]) in sums.iter_mut().zip(lanes) {
                    *sum = ((a + b) + (c + d)) as f32;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_of_any_length_and_place_are_summed() {
        let n_bins = 23;
        let rows: Vec<(usize, Vec<f64>)> = [(0, 1), (3, 4), (7, 9), (22, 1), (14, 9), (5, 0)]
            .map(|(first, n)| (first, (0..n).map(|i| 0.5 + (i * i) as f64).collect()))
            .to_vec();
        let spectrum: Vec<f64> = (0..n_bins).map(|k| 1.0 + (k % 5) as f64).collect();
        let other: Vec<f64> = spectrum.iter().rev().map(|x| 3.0 * x).collect();
        let mut sums = [[f32::NAN; 6]; 2];
        let [a, b] = &mut sums;
        Bank::new(n_bins, rows.clone()).apply([&spectrum, &other], [a, b]);
        for (spectrum, sums) in [spectrum, other].iter().zip(sums) {
            for (found, (first, weights)) in sums.into_iter().zip(&rows) {
                let terms = weights.iter().zip(&spectrum[*first..]).map(|(w, x)| w * x);
                // Halves of small integers: sums are exact in any order.
                assert_eq!(f64::from(found), terms.sum::<f64>());
            }
        }
    }
}
