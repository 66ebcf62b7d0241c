//! The gradients of a linear layer over more rows than the caches hold.
//!
//! Rows pass in blocks that stay in the second cache while all outputs meet them. Sums go on from block to block where
//! they were, in memory as in registers, so that the bits are those of one pass over all rows.

use std::ops::Range;

use rayon::prelude::*;

use crate::autodiff::arena::Arena;
use crate::autodiff::element::Element;

use super::pack::{PANEL, panels};
use super::product::split;
use super::tile::{MAX_PANELS, MAX_ROWS, Tile};

/// Elements of a block of rows: 1 MB of `f32`, half of a second cache.
const BLOCK_LEN: usize = 1 << 18;
/// Most rows of a block.
const BLOCK_ROWS: usize = 512;

/// Returns the rows of a block.
pub fn block_rows(channels: usize) -> usize {
    (BLOCK_LEN / channels.max(1)).clamp(MAX_ROWS * 8, BLOCK_ROWS)
}

/// One task's panels of the gradients.
struct Share<'a, E> {
    panels: Range<usize>,
    d_weight: &'a mut [E],
    d_bias: Option<&'a mut [E]>,
}

/// Divides the gradients among threads, by panels.
fn shares<'a, E>(
    n: usize,
    channels: usize,
    d_weight: &'a mut [E],
    mut d_bias: Option<&'a mut [E]>,
) -> Vec<Share<'a, E>> {
    let mut rest = d_weight;
    let threads = rayon::current_num_threads();
    let ranges = split(panels(n), threads.min(panels(n)));
    let take = |panels: Range<usize>| {
        let (d_weight, others) =
            std::mem::take(&mut rest).split_at_mut(panels.len() * channels * PANEL);
        rest = others;
        let d_bias = d_bias.take().map(|all| {
            let n_here = n.min(panels.end * PANEL) - panels.start * PANEL;
            let (part, others) = all.split_at_mut(n_here);
            d_bias = Some(others);
            part
        });
        Share { panels, d_weight, d_bias }
    };
    ranges.into_iter().map(take).collect()
}

/// Adds to, or overwrites, the gradients of the weight and bias of a linear layer; see
/// [`weight_gradient`](super::weight_gradient), which has checked the lengths.
#[allow(clippy::too_many_arguments, reason = "two factors, two results, their sizes")]
pub fn weight_gradient_of_many<E: Element>(
    source: &[E],
    channels: usize,
    d_out: &[E],
    n: usize,
    d_weight: &mut [E],
    d_bias: Option<&mut [E]>,
    add: [bool; 2],
    arena: &Arena<E>,
) {
    let rows = block_rows(channels);
    shares(n, channels, d_weight, d_bias).into_par_iter().for_each(|share| {
        let Share { panels: own, d_weight, d_bias } = share;
        let mut strips = arena.take(&[panels(channels), rows * PANEL]);
        let strips_of = strips.as_slice_mut().expect("one run of memory");
        let widest = split(own.len(), own.len().div_ceil(MAX_PANELS));
        let mut columns =
            arena.take(&[widest.iter().map(Range::len).max().unwrap_or(0), rows * PANEL]);
        let columns_of = columns.as_slice_mut().expect("one run of memory");
        // What is there is added to at the end, so that sums begin at zero.
        let mut sums = add[0].then(|| arena.take(&[d_weight.len()]));
        let mut sums_bias = vec![E::ZERO; own.len() * PANEL];
        let blocks = source.chunks(rows * channels).zip(d_out.chunks(rows * n));
        for (i, (source, d_out)) in blocks.enumerate() {
            pack_block(source, channels, 0..panels(channels), rows, strips_of);
            let target = match &mut sums {
                Some(sums) => sums.as_slice_mut().expect("one run of memory"),
                None => &mut *d_weight,
            };
            for group in &widest {
                let of_all = own.start + group.start..own.start + group.end;
                pack_block(d_out, n, of_all, rows, columns_of);
                let n_rows = d_out.len() / n;
                let sums = sums_bias[group.start * PANEL..].chunks_exact_mut(PANEL);
                for (sums, panel) in
                    sums.zip(columns_of.chunks_exact(rows * PANEL)).take(group.len())
                {
                    for row in panel.chunks_exact(PANEL).take(n_rows) {
                        sums.iter_mut().zip(row).for_each(|(sum, &x)| *sum += x);
                    }
                }
                let target =
                    &mut target[group.start * channels * PANEL..][..group.len() * channels * PANEL];
                add_block(
                    strips_of,
                    columns_of,
                    [n_rows, rows, channels],
                    group.len(),
                    target,
                    i > 0,
                );
            }
        }
        if let Some(sums) = sums {
            let found = sums.as_slice().expect("one run of memory");
            d_weight.iter_mut().zip(found).for_each(|(d, &sum)| *d += sum);
            arena.give(sums);
        }
        for (d, &sum) in d_bias.into_iter().flatten().zip(&sums_bias) {
            *d = if add[1] { *d + sum } else { sum };
        }
        arena.give(strips);
        arena.give(columns);
    });
}

/// Sums up the products of one block: `target` are panels of \[channels\], \[16\].
fn add_block<E: Element>(
    strips: &[E],
    columns: &[E],
    [n_rows, rows, channels]: [usize; 3],
    n_panels: usize,
    target: &mut [E],
    goes_on: bool,
) {
    assert!(
        n_rows <= rows && strips.len() == panels(channels) * rows * PANEL,
        "strips of the block"
    );
    assert!(columns.len() >= n_panels * rows * PANEL, "columns of the block");
    assert_eq!(target.len(), n_panels * channels * PANEL, "panels of {channels} inputs");
    let target = target.as_mut_ptr();
    for c in (0..channels).step_by(MAX_ROWS) {
        let n_here = (channels - c).min(MAX_ROWS);
        let a = &strips[c / PANEL * rows * PANEL + c % PANEL..];
        let tile = Tile {
            rows: std::array::from_fn(|r| a[r.min(n_here - 1)..].as_ptr()),
            n_rows: n_here,
            step: PANEL,
            k: n_rows,
            segments: 1,
            a_segment: 0,
            b: columns.as_ptr(),
            b_panel: rows * PANEL,
            b_segment: 0,
            n_panels,
            c: std::array::from_fn(|r| target.wrapping_add((c + r.min(n_here - 1)) * PANEL)),
            c_panel: channels * PANEL,
            n_columns: n_panels * PANEL,
            add: false,
            goes_on,
            stream: false,
        };
        // SAFETY: strips, columns and target have the lengths that were checked above (invariant 1), and the target is
        // this task's own (invariant 2).
        unsafe { E::run_tile(&tile) };
    }
}

/// Copies rows of `channels` numbers into strips of 16 channels, \[strips\]\[strip_rows\]\[16\], padded with zeros.
fn pack_block<E: Element>(
    source: &[E],
    channels: usize,
    strips: Range<usize>,
    strip_rows: usize,
    target: &mut [E],
) {
    let whole = strips.start..strips.end.min(channels / PANEL);
    for (row, values) in source.chunks_exact(channels).enumerate() {
        let own = values[whole.start.min(whole.end) * PANEL..whole.end * PANEL].chunks_exact(PANEL);
        for (s, values) in own.enumerate() {
            target[(s * strip_rows + row) * PANEL..][..PANEL].copy_from_slice(values);
        }
        if whole.end < strips.end {
            let rest = &values[channels / PANEL * PANEL..];
            let target = &mut target[((strips.len() - 1) * strip_rows + row) * PANEL..][..PANEL];
            target[..rest.len()].copy_from_slice(rest);
            target[rest.len()..].fill(E::ZERO);
        }
    }
}
