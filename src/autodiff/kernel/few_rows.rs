//! The gradient of a layer's input where there are few output rows.

use rayon::prelude::*;

use crate::autodiff::arena::Arena;
use crate::autodiff::element::Element;

use super::gather::{Conv, ZERO_ROW};
use super::pack::{PANEL, panels, transpose_16};
use super::product::SharedPointer;
use super::tile::{MAX_PANELS, MAX_ROWS, Tile, prefetch};

/// Rows of the weight that are fetched ahead of their use.
const AHEAD: usize = 8 * MAX_ROWS;
/// Panels of the weight that such a product reads at once: runs that the memory can fetch ahead.
const RUNS: usize = 8;

/// Computes the gradient of the input where there are few output rows.
///
/// Then transposing the weight costs more than the product itself. Instead the product is computed transposed:
/// Gᵀ = W d_outᵀ, where the numbers of the weight are broadcast as they lie and 16 output rows share a
/// vector; what comes out, \[taps · channels, rows\], is small and is transposed and gathered at the end.
pub fn input_gradient_of_few<E: Element>(
    d_out: &[E],
    n: usize,
    conv: &Conv,
    weight: &[E],
    d_source: &mut [E],
    channels: usize,
    arena: &Arena<E>,
) {
    let k = conv.taps * channels;
    let rows = conv.out_rows();
    let (n_panels, row_panels) = (panels(n), panels(rows));
    let width = row_panels * PANEL;
    // d_outᵀ in panels of 16 rows, [rows / 16][n][16].
    let mut columns = arena.filled(&[row_panels, n_panels * PANEL * PANEL], E::ZERO);
    let columns_of = columns.as_slice_mut().expect("one run of memory");
    for (row, values) in d_out.chunks_exact(n).enumerate() {
        let panel = &mut columns_of[row / PANEL * n_panels * PANEL * PANEL..];
        for (lanes, &x) in panel.chunks_exact_mut(PANEL).zip(values) {
            lanes[row % PANEL] = x;
        }
    }
    let columns_of = &*columns_of;

    // A block of panels at a time, so that each thread reads a few long runs of the weight.
    let mut turned = arena.take(&[k, width]);
    let turned_of = turned.as_slice_mut().expect("one run of memory");
    let tasks = 2 * rayon::current_num_threads();
    let chunk = k.div_ceil(tasks).next_multiple_of(MAX_ROWS);
    turned_of.par_chunks_mut(chunk * width).enumerate().for_each(|(i, part)| {
        let part_rows = part.len() / width;
        let part = part.as_mut_ptr();
        for first in (0..n_panels).step_by(RUNS) {
            let segments = RUNS.min(n_panels - first);
            for row in (0..part_rows).step_by(MAX_ROWS) {
                let n_rows = (part_rows - row).min(MAX_ROWS);
                let a = &weight[(first * k + i * chunk + row) * PANEL..];
                for s in 0..segments {
                    for r in 0..MAX_ROWS {
                        prefetch(a.as_ptr().wrapping_add((s * k + AHEAD + r) * PANEL));
                    }
                }
                for panel in (0..row_panels).step_by(MAX_PANELS) {
                    let n_here = (row_panels - panel).min(MAX_PANELS);
                    let b = &columns_of[(panel * n_panels + first) * PANEL * PANEL..];
                    let tile = Tile {
                        rows: std::array::from_fn(|r| a[r.min(n_rows - 1) * PANEL..].as_ptr()),
                        n_rows,
                        step: 1,
                        k: PANEL,
                        segments,
                        a_segment: k * PANEL,
                        b: b.as_ptr(),
                        b_panel: n_panels * PANEL * PANEL,
                        b_segment: PANEL * PANEL,
                        n_panels: n_here,
                        c: std::array::from_fn(|r| {
                            part.wrapping_add((row + r.min(n_rows - 1)) * width + panel * PANEL)
                        }),
                        c_panel: PANEL,
                        n_columns: n_here * PANEL,
                        add: first > 0,
                        goes_on: false,
                        stream: false,
                    };
                    // SAFETY: the weight has its panels, the columns were made of as many, and the part
                    // is this task's own (invariants 1 and 2).
                    unsafe { E::run_tile(&tile) };
                }
            }
        }
    });
    let turned_of = &*turned_of;

    let gather = conv.forward();
    let out = SharedPointer::new(d_source);
    let in_rows = conv.in_rows();
    (0..panels(channels)).into_par_iter().for_each(|panel| {
        let first = panel * PANEL;
        let lanes = (channels - first).min(PANEL);
        let row_of = |row: usize| {
            let at = out.at(row * channels + first);
            // SAFETY: a row has its channels, and this task alone writes these (invariants 1 and 2).
            unsafe { std::slice::from_raw_parts_mut(at, lanes) }
        };
        (0..in_rows).for_each(|row| row_of(row).fill(E::ZERO));
        let mut square = [E::ZERO; PANEL * PANEL];
        let mut across = [E::ZERO; PANEL * PANEL];
        for tap in 0..conv.taps {
            for block in 0..row_panels {
                for (c, target) in square.chunks_exact_mut(PANEL).take(lanes).enumerate() {
                    let at = (tap * channels + first + c) * width + block * PANEL;
                    target.copy_from_slice(&turned_of[at..at + PANEL]);
                }
                transpose_16(&square, &mut across);
                let met = &gather.source[tap * rows + block * PANEL..(tap + 1) * rows];
                for (&row, values) in met.iter().zip(across.chunks_exact(PANEL)) {
                    if row != ZERO_ROW {
                        row_of(row).iter_mut().zip(values).for_each(|(d, &x)| *d += x);
                    }
                }
            }
        }
    });
    arena.give(columns);
    arena.give(turned);
}
