//! How different motions are from each other, by their features.
//!
//! Features are compared after the ground truth's mean and deviation have been taken out of them.

use ndarray::{ArrayView1, ArrayView2};

use crate::chance::Draws;

/// Pairs that tell the diversity of a set, as for HumanML3D.
pub const DIVERSITY_PAIRS: usize = 300;
/// Pairs for each condition that tell how different its motions are.
pub const MULTIMODALITY_PAIRS: usize = 10;

/// Returns the mean distance of all pairs of features, `[n, dim]`: `2 / (n (n - 1)) Σ |fᵢ - fⱼ|`, "Dist".
///
/// None for fewer than two features, or where one is not finite.
pub fn mean_distance(features: ArrayView2<f64>) -> Option<f64> {
    let n = features.nrows();
    let mut sum = 0.0;
    for i in 0..n {
        for j in i + 1..n {
            sum += distance(features.row(i), features.row(j));
        }
    }
    let mean = sum / (n * n.saturating_sub(1) / 2) as f64;
    mean.is_finite().then_some(mean)
}

/// Returns the mean distance of `n_pairs` pairs of features, `[n, dim]`, drawn so that none is in two
/// pairs; of n / 2 pairs where there are fewer.
///
/// None for fewer than two features, or where one of those drawn is not finite.
pub fn diversity(features: ArrayView2<f64>, n_pairs: usize, seed: u64) -> Option<f64> {
    of_pairs(features, n_pairs, &mut Draws::new(seed))
}

/// Returns how different motions for one condition are: the mean over conditions of the mean distance of
/// `n_pairs` pairs of its features, `[n, dim]` each, drawn as for [`diversity`].
///
/// Conditions with a single motion do not count; none where there are no others, or where a feature
/// that is drawn is not finite.
pub fn multimodality(conditions: &[ArrayView2<f64>], n_pairs: usize, seed: u64) -> Option<f64> {
    let mut draws = Draws::new(seed);
    let several = conditions.iter().filter(|features| features.nrows() > 1);
    let distances: Option<Vec<f64>> =
        several.map(|features| of_pairs(*features, n_pairs, &mut draws)).collect();
    let distances = distances?;
    let mean = distances.iter().sum::<f64>() / distances.len() as f64;
    mean.is_finite().then_some(mean)
}

/// Mean distance of pairs: neighbours in a random order.
fn of_pairs(features: ArrayView2<f64>, n_pairs: usize, draws: &mut Draws) -> Option<f64> {
    let mut order: Vec<usize> = (0..features.nrows()).collect();
    draws.shuffle(&mut order);
    let pairs: Vec<f64> = order
        .chunks_exact(2)
        .take(n_pairs)
        .map(|pair| distance(features.row(pair[0]), features.row(pair[1])))
        .collect();
    let mean = pairs.iter().sum::<f64>() / pairs.len() as f64;
    mean.is_finite().then_some(mean)
}

/// Euclidean distance of two features.
pub fn distance(a: ArrayView1<f64>, b: ArrayView1<f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a - b) * (a - b)).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::{Array2, array};

    /// Corners of a square of side 2.
    fn square() -> Array2<f64> {
        array![[0.0, 0.0], [2.0, 0.0], [2.0, 2.0], [0.0, 2.0]]
    }

    #[test]
    fn all_pairs_of_a_square_are_four_sides_and_two_diagonals() {
        let wanted = (4.0 * 2.0 + 2.0 * 8.0_f64.sqrt()) / 6.0;
        assert!((mean_distance(square().view()).expect("pairs") - wanted).abs() < 1e-14);
        assert_eq!(mean_distance(square().slice(ndarray::s![..1, ..])), None);
        assert_eq!(mean_distance(Array2::zeros((0, 3)).view()), None);
    }

    #[test]
    fn no_feature_is_in_two_pairs() {
        // A feature of its own each, far from the others: two pairs of a square are sides or diagonals.
        let sides = 2.0;
        let diagonals = 8.0_f64.sqrt();
        let mut seen = [false; 2];
        for seed in 0..20 {
            let found = diversity(square().view(), 300, seed).expect("pairs");
            seen[0] |= (found - sides).abs() < 1e-14;
            seen[1] |= (found - diagonals).abs() < 1e-14;
            assert!((found - sides).abs() < 1e-14 || (found - diagonals).abs() < 1e-14, "{found}");
        }
        assert_eq!(seen, [true; 2]);
    }

    #[test]
    fn many_pairs_come_near_to_the_mean_distance() {
        let mut draws = Draws::new(9);
        let features = Array2::from_shape_simple_fn((1001, 3), || draws.uniform());
        let all = mean_distance(features.view()).expect("pairs");
        let some = diversity(features.view(), 300, 4).expect("pairs");
        // Distances in a cube have a deviation of 0.25, and 300 are averaged: three standard errors.
        assert!((all - some).abs() < 3.0 * 0.25 / 300.0_f64.sqrt(), "{all} {some}");
        assert_eq!(diversity(features.view(), 300, 4), Some(some));
    }

    #[test]
    fn conditions_count_alike_whatever_their_number_of_motions() {
        let two = array![[0.0, 0.0], [3.0, 4.0]];
        let one = array![[9.0, 9.0]];
        let same = Array2::ones((7, 2));
        let found = multimodality(&[two.view(), one.view(), same.view()], 10, 0);
        assert_eq!(found, Some(2.5));
        assert_eq!(multimodality(&[one.view()], 10, 0), None);
        assert_eq!(multimodality(&[array![[f64::NAN], [1.0]].view()], 10, 0), None);
    }
}
