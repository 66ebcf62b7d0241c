//! The products of a layer with its weight: the output, and the gradient of the input.
//!
//! Work is shared out by panels of the output, so that each thread streams its part of the weights
//! once. Every number of the result is summed in the same order whatever the tasks and tiles: taps in
//! order, channels in blocks of [`BLOCK`]. So the bits do not depend on the number of threads.

use std::ops::Range;

use rayon::prelude::*;

use crate::autodiff::arena::Arena;
use crate::autodiff::element::Element;

use super::few_rows::input_gradient_of_few;
use super::gather::{Conv, GatherRows, ZERO_ROW};
use super::pack::{PANEL, panels, transpose_16};
use super::tile::{MAX_PANELS, MAX_ROWS, Tile};

/// Channels of a block: 3 panels of it (72 kB of `f32`) stay in the second cache while rows pass.
const BLOCK: usize = 384;

/// Elements of a chunk of rows: 768 kB of `f32`, of a second cache of 1 MB or more.
const CHUNK_LEN: usize = 3 << 16;

/// Output rows up to which the product for the input's gradient is computed transposed.
const FEW_ROWS: usize = 64;

/// A place to write from several tasks, each its own columns.
pub struct SharedPointer<E>(*mut E);
// SAFETY: tasks write disjoint elements (invariant 2 of the module).
unsafe impl<E: Send> Sync for SharedPointer<E> {}

impl<E> SharedPointer<E> {
    /// Shares memory that outlives the tasks.
    pub fn new(memory: &mut [E]) -> Self {
        Self(memory.as_mut_ptr())
    }

    /// Returns the address of an element. A method, so that closures capture the whole.
    pub fn at(&self, i: usize) -> *mut E {
        self.0.wrapping_add(i)
    }
}

/// Splits panels into groups of at most three, evenly, at least one for each thread where possible.
pub fn groups(n_panels: usize) -> Vec<Range<usize>> {
    let threads = rayon::current_num_threads();
    split(n_panels, n_panels.div_ceil(MAX_PANELS).next_multiple_of(threads).min(n_panels))
}

/// Splits 0..len into n ranges, evenly.
pub fn split(len: usize, n: usize) -> Vec<Range<usize>> {
    (0..n).map(|i| i * len / n..(i + 1) * len / n).collect()
}

/// Splits rows of `channels` numbers into chunks that stay in the second cache while all panels meet them, and so that
/// there are enough tasks for the threads.
fn row_chunks(rows: usize, channels: usize, n_groups: usize) -> Vec<Range<usize>> {
    let threads = rayon::current_num_threads();
    let wanted = if n_groups >= threads { 1 } else { (2 * threads).div_ceil(n_groups) };
    let wanted = wanted.max((rows * channels).div_ceil(CHUNK_LEN));
    let size = rows.div_ceil(wanted).next_multiple_of(MAX_ROWS);
    (0..rows).step_by(size.max(1)).map(|at| at..rows.min(at + size)).collect()
}

/// Rows of zeros that stand in for padding.
fn zeros<E: Element>() -> Vec<E> {
    vec![E::ZERO; BLOCK]
}

/// The right-hand side of a product, as panels for a run of k.
struct Block<E> {
    b: *const E,
    b_panel: usize,
    /// Which tap of the gather, by position.
    tap: usize,
    /// Channels of the source rows.
    channels: Range<usize>,
}

/// Adds one block's products to the rows `rows` of the gather, columns from `column` on.
///
/// # Safety
/// The block has `n_panels` panels of its channels; `out` has `out_columns` columns in each target row,
/// of which this task alone writes `columns`.
#[allow(
    clippy::too_many_arguments,
    reason = "one loop of two products, split off to be written once"
)]
unsafe fn run_rows<E: Element>(
    gather: &GatherRows,
    rows: Range<usize>,
    source: &[E],
    source_channels: usize,
    block: &Block<E>,
    zeros: &[E],
    out: &SharedPointer<E>,
    out_columns: usize,
    columns: Range<usize>,
    add: bool,
) {
    let tap_rows = &gather.source[block.tap * gather.target.len()..][..gather.target.len()];
    let k = block.channels.len();
    let row_of = |i: usize| match tap_rows[i] {
        ZERO_ROW => zeros[..k].as_ptr(),
        row => source[row * source_channels..][block.channels.clone()].as_ptr(),
    };
    for first in rows.clone().step_by(MAX_ROWS) {
        let n_rows = (rows.end - first).min(MAX_ROWS);
        let index = |r: usize| first + r.min(n_rows - 1);
        let tile = Tile {
            rows: std::array::from_fn(|r| row_of(index(r))),
            n_rows,
            step: 1,
            k,
            segments: 1,
            a_segment: 0,
            b: block.b,
            b_panel: block.b_panel,
            b_segment: 0,
            n_panels: panels(columns.len()),
            c: std::array::from_fn(|r| {
                out.at(gather.target[index(r)] * out_columns + columns.start)
            }),
            c_panel: PANEL,
            n_columns: columns.len(),
            add,
            goes_on: false,
            stream: false,
        };
        // SAFETY: rows are slices of k elements; the rest is the caller's promise.
        unsafe { E::run_tile(&tile) };
    }
}

/// Computes out = rows of `source` times the weight, plus the bias.
///
/// out\[target\] = bias + Σ_tap W_tap source\[tap, target\]
///
/// # Shapes
/// - `source`: \[rows, channels\]; `weight`: panels of \[taps · channels\]; `bias`: \[n\]
/// - `out`: \[target rows, n\]
pub fn product<E: Element>(
    source: &[E],
    channels: usize,
    gather: &GatherRows,
    weight: &[E],
    bias: Option<&[E]>,
    out: &mut [E],
    n: usize,
) {
    let k = gather.taps.len() * channels;
    assert_eq!(weight.len(), panels(n) * k * PANEL, "panels of {n} outputs with {k} inputs");
    assert_eq!(out.len(), gather.target.len() * n, "rows of {n} outputs");
    assert!(bias.is_none_or(|bias| bias.len() == n), "a bias of {n}");
    let zeros = zeros::<E>();
    let out = SharedPointer::new(out);
    let groups = groups(panels(n));
    let chunks = row_chunks(gather.target.len(), channels, groups.len());
    let tasks: Vec<_> =
        chunks.iter().flat_map(|rows| groups.iter().map(move |group| (group, rows))).collect();
    tasks.into_par_iter().for_each(|(group, rows)| {
        let columns = group.start * PANEL..n.min(group.end * PANEL);
        if let Some(bias) = bias {
            for &target in &gather.target[rows.clone()] {
                // SAFETY: the row has n columns, and this task alone writes these (invariant 2).
                let row = unsafe {
                    std::slice::from_raw_parts_mut(
                        out.at(target * n + columns.start),
                        columns.len(),
                    )
                };
                row.copy_from_slice(&bias[columns.clone()]);
            }
        }
        let mut add = bias.is_some();
        for (i, tap) in gather.taps.iter().enumerate() {
            for first in (0..channels).step_by(BLOCK) {
                let block = Block {
                    b: weight[(group.start * k + tap * channels + first) * PANEL..].as_ptr(),
                    b_panel: k * PANEL,
                    tap: i,
                    channels: first..channels.min(first + BLOCK),
                };
                // SAFETY: lengths were checked above; the task owns its rows and columns.
                unsafe {
                    let (rows, columns) = (rows.clone(), columns.clone());
                    run_rows(gather, rows, source, channels, &block, &zeros, &out, n, columns, add);
                }
                add = true;
            }
        }
    });
}

/// Computes the gradient of a layer's input: each input row sums over the output rows that it met.
///
/// d_source\[i\] = Σ_tap W_tapᵀ d_out\[the output row that met i at tap\]
///
/// The weight's panels are transposed 16 × 16 numbers at a time into a block that all rows then use.
///
/// # Shapes
/// - `d_out`: \[out rows, n\]; `d_source`: \[in rows, channels\], overwritten
pub fn input_gradient<E: Element>(
    d_out: &[E],
    n: usize,
    conv: &Conv,
    weight: &[E],
    d_source: &mut [E],
    channels: usize,
    arena: &Arena<E>,
) {
    let k = conv.taps * channels;
    assert_eq!(weight.len(), panels(n) * k * PANEL, "panels of {n} outputs with {k} inputs");
    assert_eq!(d_out.len(), conv.out_rows() * n, "rows of {n} outputs");
    assert_eq!(d_source.len(), conv.in_rows() * channels, "rows of {channels} inputs");
    if conv.out_rows() <= FEW_ROWS {
        return input_gradient_of_few(d_out, n, conv, weight, d_source, channels, arena);
    }
    let phases = conv.backward();
    let zeros = zeros::<E>();
    if *conv == Conv::linear(conv.out_rows()) && d_out.len() > CHUNK_LEN {
        return input_gradient_of_many(d_out, n, &phases[0], weight, d_source, channels, arena);
    }
    let out = SharedPointer::new(d_source);
    let groups = groups(panels(channels));
    let scratch = || Arena::<E>::aligned(MAX_PANELS * BLOCK * PANEL);
    groups.into_par_iter().for_each_init(scratch, |scratch, group| {
        let columns = group.start * PANEL..channels.min(group.end * PANEL);
        let scratch = scratch.as_slice_mut().expect("one run of memory");
        for gather in &phases {
            let mut add = false;
            for (i, tap) in gather.taps.iter().enumerate() {
                for first in (0..n).step_by(BLOCK) {
                    let outputs = first..n.min(first + BLOCK);
                    transpose_block(weight, k, tap * channels, &columns, &outputs, scratch);
                    let block = Block {
                        b: scratch.as_ptr(),
                        b_panel: BLOCK * PANEL,
                        tap: i,
                        channels: outputs,
                    };
                    let rows = 0..gather.target.len();
                    // SAFETY: lengths were checked above; the task owns its columns.
                    unsafe {
                        let columns = columns.clone();
                        run_rows(
                            gather, rows, d_out, n, &block, &zeros, &out, channels, columns, add,
                        );
                    }
                    add = true;
                }
            }
            if !add {
                for &target in &gather.target {
                    // SAFETY: the row has its channels, and this task alone writes these.
                    unsafe {
                        let at = out.at(target * channels + columns.start);
                        std::slice::from_raw_parts_mut(at, columns.len()).fill(E::ZERO);
                    }
                }
            }
        }
    });
}

/// As [`input_gradient`] of a linear layer over many rows: the weight is transposed as a whole first, and then a chunk of
/// rows meets all of it before the next one does. Numbers are summed in the same order.
fn input_gradient_of_many<E: Element>(
    d_out: &[E],
    n: usize,
    gather: &GatherRows,
    weight: &[E],
    d_source: &mut [E],
    channels: usize,
    arena: &Arena<E>,
) {
    let zeros = zeros::<E>();
    let out = SharedPointer::new(d_source);
    let groups = groups(panels(channels));
    // Panels of [n / BLOCK][BLOCK][16] each.
    let panel_len = n.next_multiple_of(BLOCK) * PANEL;
    let mut turned = arena.take(&[panels(channels), panel_len]);
    let turned_of = turned.as_slice_mut().expect("one run of memory");
    turned_of.par_chunks_mut(panel_len).enumerate().for_each(|(p, panel)| {
        let columns = p * PANEL..channels.min((p + 1) * PANEL);
        for (first, block) in (0..n).step_by(BLOCK).zip(panel.chunks_exact_mut(BLOCK * PANEL)) {
            transpose_block(weight, channels, 0, &columns, &(first..n.min(first + BLOCK)), block);
        }
    });
    let turned_of = &*turned_of;
    let chunks = row_chunks(gather.target.len(), n, groups.len());
    let tasks: Vec<_> =
        chunks.iter().flat_map(|rows| groups.iter().map(move |group| (group, rows))).collect();
    tasks.into_par_iter().for_each(|(group, rows)| {
        let columns = group.start * PANEL..channels.min(group.end * PANEL);
        for first in (0..n).step_by(BLOCK) {
            let block = Block {
                b: turned_of[group.start * panel_len + first * PANEL..].as_ptr(),
                b_panel: panel_len,
                tap: 0,
                channels: first..n.min(first + BLOCK),
            };
            // SAFETY: lengths were checked by the caller; the task owns its rows and columns.
            unsafe {
                let (rows, columns, add) = (rows.clone(), columns.clone(), first > 0);
                run_rows(gather, rows, d_out, n, &block, &zeros, &out, channels, columns, add);
            }
        }
    });
    arena.give(turned);
}

/// Fills `scratch`, panels of \[BLOCK\]\[16\], with W\[output\]\[from + column\] at \[column / 16\]\[output\]\[lane\].
fn transpose_block<E: Element>(
    weight: &[E],
    k: usize,
    from: usize,
    columns: &Range<usize>,
    outputs: &Range<usize>,
    scratch: &mut [E],
) {
    let mut partial = [E::ZERO; PANEL * PANEL];
    for (j, output) in outputs.clone().step_by(PANEL).enumerate() {
        let panel = &weight[output / PANEL * k * PANEL..][..k * PANEL];
        for (p, column) in columns.clone().step_by(PANEL).enumerate() {
            let n = (columns.end - column).min(PANEL);
            let rows = &panel[(from + column) * PANEL..][..n * PANEL];
            let target = &mut scratch[(p * BLOCK + j * PANEL) * PANEL..][..PANEL * PANEL];
            if n == PANEL {
                transpose_16(rows, target);
            } else {
                partial[..n * PANEL].copy_from_slice(rows);
                transpose_16(&partial, target);
            }
        }
    }
}
