//! Least squares whose equations each hold a few neighbouring unknowns: normal equations with few
//! diagonals, solved in time linear in their size.

/// Most neighbouring unknowns of one equation.
pub const SPAN: usize = 6;

/// `Σₖ cₖ x[first + k] = y + ε`, where ε has the variance of its group.
#[derive(Clone, Copy, Debug)]
pub struct Equation {
    pub first: usize,
    /// c; 0 past the last unknown that it holds.
    pub coefficients: [f64; SPAN],
    /// y
    pub value: f64,
    pub group: usize,
}

impl Equation {
    /// The unknowns that it holds, with their coefficients.
    fn terms(&self) -> impl Iterator<Item = (usize, f64)> + Clone + '_ {
        let with_place = self.coefficients.iter().enumerate();
        with_place.filter(|(_, c)| **c != 0.0).map(|(k, &c)| (self.first + k, c))
    }
}

/// The lower half of a symmetric matrix A, `[n, n]`, with `A[i, j] = 0` where `i - j > bandwidth`.
#[derive(Clone, Debug)]
pub struct BandedMatrix {
    bandwidth: usize,
    /// `A[i, i - k]` at `i (bandwidth + 1) + k`.
    entries: Vec<f64>,
}

impl BandedMatrix {
    /// A = 0.
    pub fn zeros(n: usize, bandwidth: usize) -> Self {
        Self { bandwidth, entries: vec![0.0; n * (bandwidth + 1)] }
    }

    fn len(&self) -> usize {
        self.entries.len() / (self.bandwidth + 1)
    }

    /// `A[i, j]` or, which is the same, `A[j, i]`; within the band.
    fn at(&self, i: usize, j: usize) -> f64 {
        self.entries[i.max(j) * (self.bandwidth + 1) + i.abs_diff(j)]
    }

    /// The one place in which both are.
    pub fn at_mut(&mut self, i: usize, j: usize) -> &mut f64 {
        &mut self.entries[i.max(j) * (self.bandwidth + 1) + i.abs_diff(j)]
    }

    /// `A[i, i]`, `A[i, i - 1]` and so on.
    fn row(&self, i: usize) -> &[f64] {
        &self.entries[i * (self.bandwidth + 1)..(i + 1) * (self.bandwidth + 1)]
    }

    /// Puts x of `A x = b` in the place of b; A is positive definite. O(n bandwidth²).
    ///
    /// Source: Golub and Van Loan, Matrix Computations, section 4.3.5 (band Cholesky; here without
    /// square roots).
    pub fn solve(mut self, b: &mut [f64]) {
        factor(&mut self);
        substitute(&self, b);
    }
}

/// The least-squares solution of equations.
#[derive(Clone, Debug)]
pub struct Solution {
    /// x = argmin Σ (y - c·x)² / σ², 0 for unknowns that are not free.
    pub x: Vec<f64>,
}

impl Solution {
    /// Solves `A x = b`, `A = Σ c cᵀ / σ²`, `b = Σ c y / σ²`, over the unknowns that are free; the others
    /// are 0. O(n bandwidth²).
    ///
    /// Every free unknown needs an equation of its own, else A is singular and x not finite.
    pub fn new(
        equations: &[Equation],
        variances: &[f64],
        is_free: Vec<bool>,
        bandwidth: usize,
    ) -> Self {
        let mut a = BandedMatrix::zeros(is_free.len(), bandwidth);
        let mut x = vec![0.0; is_free.len()];
        for equation in equations {
            let free = equation.terms().filter(|(i, _)| is_free[*i]);
            let weight = 1.0 / variances[equation.group];
            for (i, c) in free.clone() {
                x[i] += weight * c * equation.value;
                for (j, d) in free.clone().take_while(|(j, _)| *j <= i) {
                    *a.at_mut(i, j) += weight * c * d;
                }
            }
        }
        for i in (0..is_free.len()).filter(|i| !is_free[*i]) {
            *a.at_mut(i, i) = 1.0;
        }
        a.solve(&mut x);
        Self { x }
    }
}

/// Puts L and D of `A = L D Lᵀ` in the place of A.
fn factor(a: &mut BandedMatrix) {
    for i in 0..a.len() {
        let first = i.saturating_sub(a.bandwidth);
        // L[i, j] D[j] first, of which L[i, j] and D[i] follow.
        for j in first..i {
            // Σ over k from `first` to j - 1 of A[i, k] A[j, k]; rows hold them backwards.
            let (here, above) = (&a.row(i)[i - j + 1..=i - first], &a.row(j)[1..=j - first]);
            let known: f64 = here.iter().zip(above).rev().map(|(x, y)| x * y).sum();
            *a.at_mut(i, j) -= known;
        }
        for j in first..i {
            let scaled = a.at(i, j);
            let l = scaled / a.at(j, j);
            *a.at_mut(i, j) = l;
            *a.at_mut(i, i) -= l * scaled;
        }
    }
}

/// Puts the solution of `L D Lᵀ x = b` in the place of b.
fn substitute(a: &BandedMatrix, b: &mut [f64]) {
    let n = a.len();
    for i in 0..n {
        for j in i.saturating_sub(a.bandwidth)..i {
            b[i] -= a.at(i, j) * b[j];
        }
    }
    for i in (0..n).rev() {
        b[i] /= a.at(i, i);
        for j in i + 1..n.min(i + a.bandwidth + 1) {
            b[i] -= a.at(j, i) * b[j];
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::Array2;

    /// A random number in (-1, 1), the i-th of a fixed sequence.
    fn random(i: usize) -> f64 {
        2.0 * ((i as f64 * 0.754_877_666 + 0.3).fract() * 7919.0).fract() - 1.0
    }

    /// Solves by elimination with pivots of the largest size.
    fn dense(a: &Array2<f64>, b: &[f64]) -> Vec<f64> {
        let n = b.len();
        let mut m = Array2::zeros((n, n + 1));
        for i in 0..n {
            (0..n).for_each(|j| m[[i, j]] = a[[i, j]]);
            m[[i, n]] = b[i];
        }
        for k in 0..n {
            let size = |i: &usize| m[[*i, k]].abs();
            let pivot = (k..n).max_by(|i, j| size(i).total_cmp(&size(j))).expect("a row");
            for j in 0..=n {
                m.swap([k, j], [pivot, j]);
            }
            for i in (0..n).filter(|i| *i != k) {
                let factor = m[[i, k]] / m[[k, k]];
                for j in k..=n {
                    m[[i, j]] -= factor * m[[k, j]];
                }
            }
        }
        (0..n).map(|i| m[[i, n]] / m[[i, i]]).collect()
    }

    #[test]
    fn solutions_are_those_of_dense_normal_equations() {
        for (n, span) in [(1, 1), (2, 2), (7, 3), (23, 6), (40, 2)] {
            let is_free: Vec<bool> = (0..n).map(|i| i % 9 != 4).collect();
            let single = (0..n).map(|i| (i, 1));
            let wide = (0..=n - span).map(|i| (i, span));
            let equations: Vec<Equation> = single
                .chain(wide)
                .enumerate()
                .map(|(e, (first, len))| Equation {
                    first,
                    coefficients: std::array::from_fn(|k| {
                        if k < len { random(7 * e + k) } else { 0.0 }
                    }),
                    value: random(1000 + e),
                    group: usize::from(len > 1),
                })
                .collect();
            let variances = [0.7, 0.04];
            let (mut a, mut b) = (Array2::<f64>::zeros((n, n)), vec![0.0; n]);
            for e in &equations {
                let mut row = vec![0.0; n];
                e.terms().filter(|(i, _)| is_free[*i]).for_each(|(i, c)| row[i] = c);
                for i in 0..n {
                    b[i] += row[i] * e.value / variances[e.group];
                    (0..n).for_each(|j| a[[i, j]] += row[i] * row[j] / variances[e.group]);
                }
            }
            (0..n).filter(|i| !is_free[*i]).for_each(|i| a[[i, i]] = 1.0);
            let x = dense(&a, &b);
            let found = Solution::new(&equations, &variances, is_free.clone(), span - 1);
            for (found, wanted) in found.x.iter().zip(&x) {
                // Condition numbers up to 1e4.
                assert!((found - wanted).abs() < 1e-11, "{n}: {found} {wanted}");
            }
        }
        assert!(Solution::new(&[], &[], Vec::new(), 2).x.is_empty());
    }
}
