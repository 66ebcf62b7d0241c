//! Products with a matrix that stays the same.
//!
//! With AVX2 and AVX-512 each product is fused with a sum, which gives the same bits; other machines multiply
//! with ndarray.

use ndarray::linalg::general_mat_mul;
use ndarray::{Array2, ArrayView2, ArrayViewMut2, ShapeBuilder};

use crate::instructions::{Level, level, vectorized};

/// Columns of a panel: as many as the widest register holds.
const PANEL: usize = 8;
/// A matrix B \[k, n\] in panels of eight columns, the last one padded with zeros.
#[derive(Clone, Debug, PartialEq)]
pub struct Panels {
    /// Row i of panel p at p k + i.
    rows: Vec<[f64; PANEL]>,
    k: usize,
    /// The matrix with its padding, where it is multiplied as a whole.
    whole: Option<Array2<f64>>,
}

impl Panels {
    /// Packs a matrix of `k` rows and `n` columns, given its elements.
    pub fn new(k: usize, n: usize, element: impl Fn(usize, usize) -> f64) -> Self {
        let padded = |i: usize, j: usize| if j < n { element(i, j) } else { 0.0 };
        let row = |p: usize, i: usize| std::array::from_fn(|l| padded(i, PANEL * p + l));
        let n_panels = n.div_ceil(PANEL);
        let whole = (level() == Level::Portable)
            .then(|| Array2::from_shape_fn((k, n_panels * PANEL), |(i, j)| padded(i, j)));
        let rows = (0..n_panels).flat_map(|p| (0..k).map(move |i| (p, i)));
        Self { rows: rows.map(|(p, i)| row(p, i)).collect(), k, whole }
    }

    /// Columns with padding.
    pub fn n_columns(&self) -> usize {
        self.rows.len() / self.k * PANEL
    }

    /// Writes A · B, given `n_rows` rows of A that are `a_stride` apart; those of the product are as long as
    /// B is wide with its padding.
    pub fn multiply(&self, a: &[f64], a_stride: usize, n_rows: usize, product: &mut [f64]) {
        let (k, n) = (self.k, self.n_columns());
        let product = &mut product[..n_rows * n];
        let Some(whole) = &self.whole else {
            return multiply(&self.rows, k, a, a_stride, product, level());
        };
        let a = ArrayView2::from_shape((n_rows, k).strides((a_stride, 1)), a)
            .expect("invariant: rows of A that lie in it");
        let mut product =
            ArrayViewMut2::from_shape((n_rows, n), product).expect("invariant: cut to its shape");
        general_mat_mul(1.0, &a, whole, 0.0, &mut product);
    }
}

/// Writes one panel's columns of some rows of the product; every sum is taken in order, whatever R.
#[inline(always)]
fn tile<const R: usize>(
    panel: &[[f64; PANEL]],
    a: &[f64],
    a_stride: usize,
    product: &mut [f64],
    stride: usize,
) {
    let a: [&[f64]; R] = std::array::from_fn(|r| &a[r * a_stride..][..panel.len()]);
    let mut sums = [[0.0; PANEL]; R];
    for (i, b) in panel.iter().enumerate() {
        for r in 0..R {
            let x = a[r][i];
            for l in 0..PANEL {
                sums[r][l] = x.mul_add(b[l], sums[r][l]);
            }
        }
    }
    for (r, sums) in sums.iter().enumerate() {
        product[r * stride..][..PANEL].copy_from_slice(sums);
    }
}

/// Writes a panel's columns of the product, R rows at once and then one by one.
#[inline(always)]
fn rows<const R: usize>(
    panel: &[[f64; PANEL]],
    a: &[f64],
    a_stride: usize,
    product: &mut [f64],
    stride: usize,
) {
    let n_rows = product.len().div_ceil(stride);
    let n_tiled = n_rows - n_rows % R;
    for row in (0..n_tiled).step_by(R) {
        tile::<R>(panel, &a[row * a_stride..], a_stride, &mut product[row * stride..], stride);
    }
    for row in n_tiled..n_rows {
        tile::<1>(panel, &a[row * a_stride..], a_stride, &mut product[row * stride..], stride);
    }
}

vectorized! {
    /// Of as many rows at once as their sums fit into the registers, a panel of each.
    fn multiply(
        panels: &[[f64; PANEL]], k: usize, a: &[f64], a_stride: usize, product: &mut [f64],
        widest: Level,
    ) {
        let stride = panels.len() / k * PANEL;
        for (p, panel) in panels.chunks_exact(k).enumerate() {
            let product = &mut product[PANEL * p..];
            if widest == Level::Avx512 {
                rows::<8>(panel, a, a_stride, product, stride);
            } else {
                rows::<4>(panel, a, a_stride, product, stride);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_any_shape_are_the_sums_that_define_them() {
        for (n_rows, k, n) in [(1, 3, 1), (7, 5, 8), (11, 368, 17), (32, 40, 121)] {
            let a_stride = k + 2;
            let a: Vec<f64> =
                (0..n_rows * a_stride).map(|i| ((i * 37) % 19) as f64 - 9.0).collect();
            let b = |i: usize, j: usize| ((i * 5 + j * 11) % 23) as f64 * 0.5;
            let panels = Panels::new(k, n, b);
            let stride = panels.n_columns();
            assert_eq!(stride, n.next_multiple_of(PANEL));
            let mut product = vec![f64::NAN; n_rows * stride];
            panels.multiply(&a, a_stride, n_rows, &mut product);
            for row in 0..n_rows {
                for j in 0..stride {
                    let terms = (0..k).map(|i| a[row * a_stride + i] * b(i, j));
                    // Halves of small integers: sums are exact, fused or not. Padding is 0.
                    let expected: f64 = if j < n { terms.sum() } else { 0.0 };
                    assert_eq!(product[row * stride + j], expected, "{n_rows} {k} {n}: {row}, {j}");
                }
            }
        }
    }
}
