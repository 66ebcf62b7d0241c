//! Products of small matrices with any strides, for attention: one thread each.

use crate::autodiff::element::Element;

use super::pack::{PANEL, panels, transpose_16};
use super::tile::{MAX_PANELS, MAX_ROWS, Tile};

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
/// `[m, k, n]`: A is \[m, k\], B \[k, n\], C \[m, n\]. `scratch` is grown as needed and holds copies of both.
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
    let a_len = panels(m) * k * PANEL;
    scratch.clear();
    scratch.resize(a_len + panels(n) * k * PANEL, E::ZERO);
    let (strips, columns) = scratch.split_at_mut(a_len);
    pack(m, k, a, strips, alpha);
    pack(n, k, b.t(), columns, E::ONE);
    let c_start = c.data.as_mut_ptr();
    for panel in (0..panels(n)).step_by(MAX_PANELS) {
        for first in (0..m).step_by(MAX_ROWS) {
            let n_rows = (m - first).min(MAX_ROWS);
            let a = &strips[first / PANEL * k * PANEL + first % PANEL..];
            let tile = Tile {
                rows: std::array::from_fn(|r| a.as_ptr().wrapping_add(r.min(n_rows - 1))),
                n_rows,
                step: PANEL,
                k,
                segments: 1,
                a_segment: 0,
                b: columns[panel * k * PANEL..].as_ptr(),
                b_panel: k * PANEL,
                b_segment: 0,
                n_panels: (panels(n) - panel).min(MAX_PANELS),
                c: std::array::from_fn(|r| {
                    let row = first + r.min(n_rows - 1);
                    c_start.wrapping_add(row * c.row_stride + panel * PANEL)
                }),
                c_panel: PANEL,
                n_columns: (n - panel * PANEL).min(MAX_PANELS * PANEL),
                add,
                goes_on: false,
                stream: false,
            };
            // SAFETY: strips and columns have k rows each, the result was checked to hold m rows.
            unsafe { E::run_tile(&tile) };
        }
    }
}

/// Copies a matrix of n rows into strips of 16 rows: \[n / 16\]\[k\]\[16\], times α.
fn pack<E: Element>(n: usize, k: usize, a: Matrix<E>, strips: &mut [E], alpha: E) {
    let [row, column] = a.strides;
    let mut square = [E::ZERO; PANEL * PANEL];
    for (s, strip) in strips.chunks_exact_mut((k * PANEL).max(1)).enumerate() {
        let first = s * PANEL;
        let n_lanes = (n - first).min(PANEL);
        if row == 1 {
            for (at, lanes) in strip.chunks_exact_mut(PANEL).enumerate() {
                let source = &a.data[first + at * column..][..n_lanes];
                lanes.iter_mut().zip(source).for_each(|(lane, &x)| *lane = alpha * x);
            }
            continue;
        }
        assert_eq!(column, 1, "rows or columns lie side by side");
        let whole = k / PANEL * PANEL;
        for at in (0..whole).step_by(PANEL) {
            for (lane, target) in square.chunks_exact_mut(PANEL).enumerate().take(n_lanes) {
                let source = &a.data[(first + lane) * row + at..][..PANEL];
                target.iter_mut().zip(source).for_each(|(x, &y)| *x = alpha * y);
            }
            transpose_16(&square, &mut strip[at * PANEL..][..PANEL * PANEL]);
        }
        for lane in 0..n_lanes {
            let source = &a.data[(first + lane) * row..][..k];
            for at in whole..k {
                strip[at * PANEL + lane] = alpha * source[at];
            }
        }
    }
}
