//! The Fréchet distance between two sets of features, taken for normal distributions.
//!
//! In double precision, with symmetric eigenvalues: the square root of a product of covariances, which the
//! field takes of a matrix that is not symmetric, loses digits where they are nearly singular.

use ndarray::{Array1, Array2, ArrayView2, Axis};
use serde::{Deserialize, Serialize};

/// Least feature vectors per dimension for which a covariance is estimated.
pub const MIN_PER_DIMENSION: usize = 10;

/// Added to the diagonals of covariances of which one is singular, as in mint and GCD.
pub const SINGULAR_EPS: f64 = 1e-6;

/// Added to the deviations by which features are divided, as in all published code.
pub const DEVIATION_EPS: f64 = 1e-10;

/// A covariance whose least eigenvalue is below this share of its largest is singular.
const SINGULAR_SHARE: f64 = 1e-12;

/// Sweeps after which a matrix counts as diagonal; a few are enough.
const MAX_SWEEPS: usize = 60;

/// Mean and covariance of a set of features.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gaussian {
    /// Features that were seen.
    pub n: usize,
    pub mean: Vec<f64>,
    /// Of a sample (n - 1), row by row.
    pub covariance: Vec<Vec<f64>>,
}

impl Gaussian {
    /// Fits a set of features, `[n, dim]`; none for fewer than two, or where one is not finite.
    pub fn fit(features: ArrayView2<f64>) -> Option<Self> {
        let n = features.nrows();
        if n < 2 || features.iter().any(|x| !x.is_finite()) {
            return None;
        }
        let mean = features.mean_axis(Axis(0))?;
        let centred = &features - &mean;
        let covariance = centred.t().dot(&centred) / (n - 1) as f64;
        let covariance = covariance.rows().into_iter().map(|row| row.to_vec()).collect();
        Some(Self { n, mean: mean.to_vec(), covariance })
    }

    /// Numbers of a feature.
    pub fn dim(&self) -> usize {
        self.mean.len()
    }

    /// Whether there are enough features for their covariance to be known.
    pub fn is_known(&self) -> bool {
        self.dim() > 0 && self.n >= MIN_PER_DIMENSION * self.dim()
    }

    /// Whether the covariance is a matrix of the size of the mean and everything is finite.
    pub fn is_sound(&self) -> bool {
        let (dim, rows) = (self.dim(), &self.covariance);
        rows.len() == dim
            && rows.iter().all(|row| row.len() == dim)
            && self.mean.iter().chain(rows.iter().flatten()).all(|x| x.is_finite())
    }

    fn matrix(&self) -> Array2<f64> {
        Array2::from_shape_fn((self.dim(), self.dim()), |(i, j)| self.covariance[i][j])
    }
}

/// Returns the Fréchet distance between two sets of features.
///
/// `|μ₁ - μ₂|² + Tr Σ₁ + Tr Σ₂ - 2 Tr (Σ₁ Σ₂)^½`, the last by the eigenvalues of `Σ₁^½ Σ₂ Σ₁^½`, which
/// are those of the product. Where a covariance is singular, 1e-6 is added to the diagonals of both within
/// that root. None where either has fewer than ten features for each dimension or is not sound, or their
/// dimensions differ. Source: Dowson and Landau, "The Fréchet Distance between Multivariate Normal
/// Distributions", 1982.
pub fn frechet_distance(a: &Gaussian, b: &Gaussian) -> Option<f64> {
    let fit = a.dim() == b.dim() && a.is_sound() && b.is_sound();
    (fit && a.is_known() && b.is_known()).then(|| distance(a, b))
}

fn distance(a: &Gaussian, b: &Gaussian) -> f64 {
    let (mut left, mut right) = (a.matrix(), b.matrix());
    let squares: f64 = a.mean.iter().zip(&b.mean).map(|(a, b)| (a - b).powi(2)).sum();
    let traces = left.diag().sum() + right.diag().sum();
    if is_singular(&left) || is_singular(&right) {
        left.diag_mut().mapv_inplace(|x| x + SINGULAR_EPS);
        right.diag_mut().mapv_inplace(|x| x + SINGULAR_EPS);
    }
    let (values, vectors) = eigen(&left);
    let roots: Array1<f64> = values.iter().map(|x| x.max(0.0).sqrt()).collect();
    let root = (&vectors * &roots).dot(&vectors.t());
    let product = root.dot(&right).dot(&root);
    let product = (&product + &product.t()) / 2.0;
    let trace: f64 = eigen(&product).0.iter().map(|x| x.max(0.0).sqrt()).sum();
    // Rounding may leave a distance of nothing slightly negative.
    (squares + traces - 2.0 * trace).max(0.0)
}

fn is_singular(matrix: &Array2<f64>) -> bool {
    let values = eigen(matrix).0;
    let largest = values.iter().copied().fold(0.0, f64::max);
    values.iter().any(|&x| x <= SINGULAR_SHARE * largest)
}

/// Returns eigenvalues and eigenvectors (columns) of a symmetric matrix, in no order.
///
/// Cyclic Jacobi rotations. Source: Golub and Van Loan, "Matrix Computations", 4th edition, 8.5.
fn eigen(matrix: &Array2<f64>) -> (Vec<f64>, Array2<f64>) {
    let n = matrix.nrows();
    let (mut a, mut vectors) = (matrix.clone(), Array2::eye(n));
    let size: f64 = a.iter().map(|x| x * x).sum();
    for _ in 0..MAX_SWEEPS {
        let off: f64 = a.indexed_iter().filter(|((i, j), _)| i != j).map(|(_, x)| x * x).sum();
        if off <= f64::EPSILON.powi(2) * size {
            break;
        }
        for p in 0..n {
            for q in p + 1..n {
                rotate_away(&mut a, &mut vectors, p, q);
            }
        }
    }
    (a.diag().to_vec(), vectors)
}

/// Turns the plane of two axes so that the matrix has no element between them.
fn rotate_away(a: &mut Array2<f64>, vectors: &mut Array2<f64>, p: usize, q: usize) {
    if a[[p, q]] == 0.0 {
        return;
    }
    // The smaller of the two angles, by its tangent.
    let theta = (a[[q, q]] - a[[p, p]]) / (2.0 * a[[p, q]]);
    let tangent = theta.signum() / (theta.abs() + theta.hypot(1.0));
    let cosine = 1.0 / tangent.hypot(1.0);
    let sine = tangent * cosine;
    let turned = |x: f64, y: f64| (cosine * x - sine * y, sine * x + cosine * y);
    for k in 0..a.nrows() {
        (a[[k, p]], a[[k, q]]) = turned(a[[k, p]], a[[k, q]]);
        (vectors[[k, p]], vectors[[k, q]]) = turned(vectors[[k, p]], vectors[[k, q]]);
    }
    for k in 0..a.nrows() {
        (a[[p, k]], a[[q, k]]) = turned(a[[p, k]], a[[q, k]]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chance::Draws;
    use ndarray::array;

    fn gaussian(mean: &[f64], covariance: &Array2<f64>) -> Gaussian {
        let rows = covariance.rows().into_iter().map(|row| row.to_vec()).collect();
        Gaussian { n: 1000, mean: mean.to_vec(), covariance: rows }
    }

    fn random(n: usize, dim: usize, seed: u64) -> Array2<f64> {
        let mut draws = Draws::new(seed);
        Array2::from_shape_simple_fn((n, dim), || draws.uniform() - 0.5)
    }

    #[test]
    fn eigenvectors_rebuild_their_matrix() {
        let x = random(40, 13, 1);
        let matrix = x.t().dot(&x);
        let (values, vectors) = eigen(&matrix);
        let rebuilt = (&vectors * &Array1::from(values)).dot(&vectors.t());
        let unit = vectors.t().dot(&vectors);
        assert!((&rebuilt - &matrix).iter().all(|x| x.abs() < 1e-13));
        assert!((&unit - &Array2::<f64>::eye(13)).iter().all(|x| x.abs() < 1e-13));
        let (values, _) = eigen(&array![[2.0, 1.0], [1.0, 2.0]]);
        assert!((values[0] - 1.0).abs() < 1e-14 && (values[1] - 3.0).abs() < 1e-14, "{values:?}");
        assert_eq!(eigen(&Array2::zeros((3, 3))).0, [0.0; 3]);
    }

    #[test]
    fn covariances_that_commute_have_a_closed_form() {
        // |Δμ|² + Σ (√a - √b)².
        let a = gaussian(&[1.0, 0.0, -1.0], &Array2::from_diag(&array![4.0, 9.0, 1.0]));
        let b = gaussian(&[0.0, 0.0, 1.0], &Array2::from_diag(&array![1.0, 1.0, 16.0]));
        let wanted = 5.0 + 1.0 + 4.0 + 9.0;
        assert!((frechet_distance(&a, &b).expect("known") - wanted).abs() < 1e-12);
        assert!(frechet_distance(&a, &a).expect("known") < 1e-12);
    }

    #[test]
    fn a_singular_covariance_keeps_the_distance_finite() {
        let flat = gaussian(&[0.0, 0.0], &array![[1.0, 1.0], [1.0, 1.0]]);
        // The roots of both are those of the eigenvalues 2 + 1e-6 and 1e-6.
        let wanted = 4.0 - 2.0 * (2.0 + 2e-6);
        let found = frechet_distance(&flat, &flat).expect("known");
        assert_eq!(found, 0.0, "{wanted} is below 0");
        let round = gaussian(&[0.0, 0.0], &Array2::eye(2));
        let root = ((2.0 + 1e-6) * (1.0 + 1e-6_f64)).sqrt() + (1e-6 * (1.0 + 1e-6_f64)).sqrt();
        let found = frechet_distance(&flat, &round).expect("known");
        assert!((found - (4.0 - 2.0 * root)).abs() < 1e-9, "{found}");
    }

    #[test]
    fn a_fit_is_the_covariance_of_a_sample() {
        let found = Gaussian::fit(array![[1.0, 0.0], [3.0, 0.0], [5.0, 3.0]].view()).expect("fit");
        assert_eq!((found.n, found.mean.as_slice()), (3, &[3.0, 1.0][..]));
        assert_eq!(found.covariance, [[4.0, 3.0], [3.0, 3.0]]);
        assert!(found.is_sound() && !found.is_known());
        assert_eq!(Gaussian::fit(array![[1.0, f64::NAN], [1.0, 2.0]].view()), None);
        assert_eq!(Gaussian::fit(array![[1.0, 2.0]].view()), None);
    }

    #[test]
    fn too_few_or_unsound_features_have_no_distance() {
        let [few, enough] = [29, 30].map(|n| Gaussian::fit(random(n, 3, 2).view()).expect("fit"));
        assert_eq!(frechet_distance(&few, &enough), None);
        assert_eq!(frechet_distance(&enough, &few), None);
        assert!(frechet_distance(&enough, &enough).is_some());
        let other = Gaussian::fit(random(40, 4, 2).view()).expect("fit");
        assert_eq!(frechet_distance(&enough, &other), None);
        let mut ragged = enough.clone();
        ragged.covariance[1].pop();
        assert_eq!(frechet_distance(&enough, &ragged), None);
    }
}
