//! Products of small matrices with any strides, for attention: one thread each.

use crate::autodiff::element::Element;

use super::pack::{PANEL, panels, transpose_16};
use super::product::split;
use super::tile::{MAX_PANELS, MAX_ROWS, Tile};
use super::vectorized;

/// A matrix in memory: element (i, j) is `data[i rows + j columns]`, one of the two being 1.
#[derive(Clone, Copy)]
pub struct Matrix<'a, E> {
    pub data: &'a [E],
    /// From one row to the next, and from one column to the next.
    pub strides: [usize; 2],
}

/// A matrix to write, whose columns lie side by side.
pub struct MatrixMut<'a, E> {
    pub data: &'a mut [E],
    pub row_stride: usize,
}

impl<E> Matrix<'_, E> {
    /// The transpose, without moving anything.
    pub fn t(self) -> Self {
        Self { data: self.data, strides: [self.strides[1], self.strides[0]] }
    }
}

/// Computes C = α A B, or C += α A B.
///
/// # Shapes
/// `[m, k, n]`: A is \[m, k\], B \[k, n\], C \[m, n\]. `scratch` is grown as needed and holds a copy of B, and one of A
/// unless α is 1.
pub fn matmul<E: Element>(
    [m, k, n]: [usize; 3],
    alpha: E,
    a: Matrix<E>,
    b: Matrix<E>,
    c: MatrixMut<E>,
    add: bool,
    scratch: &mut Vec<E>,
) {
    if m == 0 || n == 0 {
        return;
    }
    assert!(c.data.len() >= (m - 1) * c.row_stride + n, "a result of {m} rows");
    let in_place = alpha == E::ONE;
    let [row, column] = a.strides;
    let last = (m - 1) * row + k.saturating_sub(1) * column;
    assert!(!in_place || k == 0 || a.data.len() > last, "a factor of {m} rows");
    let a_len = if in_place { 0 } else { panels(m) * k * PANEL };
    let len = a_len + panels(n) * k * PANEL;
    if scratch.len() < len {
        scratch.resize(len, E::ZERO);
    }
    let (strips, columns) = scratch[..len].split_at_mut(a_len);
    if !in_place {
        pack(m, k, a, strips, alpha);
    }
    pack(n, k, b.t(), columns, E::ONE);
    let strips = &*strips;
    let row_of = |r: usize| match in_place {
        true => a.data[r * row..].as_ptr(),
        false => strips[r / PANEL * k * PANEL + r % PANEL..].as_ptr(),
    };
    let c_start = c.data.as_mut_ptr();
    for group in split(panels(n), panels(n).div_ceil(MAX_PANELS)) {
        for first in (0..m).step_by(MAX_ROWS) {
            let n_rows = (m - first).min(MAX_ROWS);
            let row_at = |r: usize| first + r.min(n_rows - 1);
            let tile = Tile {
                rows: std::array::from_fn(|r| row_of(row_at(r))),
                n_rows,
                step: if in_place { column } else { PANEL },
                k,
                segments: 1,
                a_segment: 0,
                b: columns[group.start * k * PANEL..].as_ptr(),
                b_panel: k * PANEL,
                b_segment: 0,
                n_panels: group.len(),
                c: std::array::from_fn(|r| {
                    c_start.wrapping_add(row_at(r) * c.row_stride + group.start * PANEL)
                }),
                c_panel: PANEL,
                n_columns: n.min(group.end * PANEL) - group.start * PANEL,
                add,
                goes_on: false,
                stream: false,
            };
            // SAFETY: rows and columns have k elements each, the result was checked to hold m rows.
            unsafe { E::run_tile(&tile) };
        }
    }
}

vectorized! {
    /// Copies a matrix of n rows into strips of 16 rows: \[n / 16\]\[k\]\[16\], times α, padded with zeros.
    fn pack<E: Element>(n: usize, k: usize, a: Matrix<E>, strips: &mut [E], alpha: E) {
        let [row, column] = a.strides;
        let mut square = [E::ZERO; PANEL * PANEL];
        let mut turned = [E::ZERO; PANEL * PANEL];
        for (s, strip) in strips.chunks_exact_mut((k * PANEL).max(1)).enumerate() {
            let first = s * PANEL;
            let n_lanes = (n - first).min(PANEL);
            if row == 1 {
                for (at, lanes) in strip.chunks_exact_mut(PANEL).enumerate() {
                    let source = &a.data[first + at * column..][..n_lanes];
                    if n_lanes == PANEL {
                        scale_16(lanes, source, alpha);
                    } else {
                        lanes.iter_mut().zip(source).for_each(|(lane, &x)| *lane = alpha * x);
                        lanes[n_lanes..].fill(E::ZERO);
                    }
                }
                continue;
            }
            assert_eq!(column, 1, "rows or columns lie side by side");
            if n_lanes < PANEL {
                square.fill(E::ZERO);
            }
            for (at, target) in (0..k).step_by(PANEL).zip(strip.chunks_mut(PANEL * PANEL)) {
                let n_here = (k - at).min(PANEL);
                for (lane, square) in square.chunks_exact_mut(PANEL).enumerate().take(n_lanes) {
                    let source = &a.data[(first + lane) * row + at..][..n_here];
                    if n_here == PANEL {
                        scale_16(square, source, alpha);
                    } else {
                        square.iter_mut().zip(source).for_each(|(x, &y)| *x = alpha * y);
                    }
                }
                if n_here == PANEL {
                    transpose_16(&square, target);
                } else {
                    transpose_16(&square, &mut turned);
                    target.copy_from_slice(&turned[..n_here * PANEL]);
                }
            }
        }
    }
}

/// y = α x of 16 numbers, whose number is known when this is compiled.
#[inline(always)]
fn scale_16<E: Element>(y: &mut [E], x: &[E], alpha: E) {
    let (y, x): (&mut [E; PANEL], &[E; PANEL]) =
        (y.try_into().expect("16 numbers"), x.try_into().expect("16 numbers"));
    y.iter_mut().zip(x).for_each(|(y, &x)| *y = alpha * x);
}
