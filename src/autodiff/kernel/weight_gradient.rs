//! The gradients of a layer's weight and bias.

use rayon::prelude::*;

use crate::autodiff::arena::Arena;
use crate::autodiff::element::Element;

use super::gather::Conv;
use super::many_rows::{block_rows, weight_gradient_of_many};
use super::pack::{PANEL, pack_strips, panels};
use super::product::groups;
use super::tile::{MAX_ROWS, Tile, fence};

/// Rows over which a weight's gradient is summed before it is added to memory.
const GRADIENT_ROWS: usize = 960;
/// Elements from which on a weight's gradient is written past the caches: 1 MB of `f32`, all of a second
/// cache.
const STREAM_LEN: usize = 1 << 18;

/// Returns how many samples a weight's gradient is summed over before it is added to memory.
fn samples_of(out_frames: usize) -> usize {
    (GRADIENT_ROWS / out_frames.max(1)).max(1)
}

/// Adds to, or overwrites, the gradients of a layer's weight and bias.
///
/// d_W\[n\]\[tap, c\] = Σ_rows d_out\[row\]\[n\] source\[row's input at tap\]\[c\],  d_bias\[n\] = Σ_rows d_out\[row\]\[n\]
///
/// Both factors are first copied into strips of 16 channels, in which rows of a sample lie together.
///
/// # Shapes
/// - `source`: \[in rows, channels\]; `d_out`: \[out rows, n\]; `d_weight`: panels; `d_bias`: \[n\]
#[allow(clippy::too_many_arguments, reason = "two factors, two results, their sizes")]
pub fn weight_gradient<E: Element>(
    source: &[E],
    channels: usize,
    d_out: &[E],
    n: usize,
    conv: &Conv,
    d_weight: &mut [E],
    d_bias: Option<&mut [E]>,
    add: [bool; 2],
    arena: &Arena<E>,
) {
    let k = conv.taps * channels;
    let out_frames = conv.out_frames();
    let out_rows = conv.out_rows();
    assert_eq!(d_weight.len(), panels(n) * k * PANEL, "panels of {n} outputs with {k} inputs");
    assert_eq!(d_out.len(), out_rows * n, "rows of {n} outputs");
    assert_eq!(source.len(), conv.in_rows() * channels, "rows of {channels} inputs");
    if *conv == Conv::linear(out_rows) && out_rows > block_rows(channels) {
        return weight_gradient_of_many(source, channels, d_out, n, d_weight, d_bias, add, arena);
    }

    let sample_rows = conv.stride * conv.strip_frames();
    let strip = conv.batch * sample_rows * PANEL;
    let mut strips = arena.take(&[panels(channels), strip]);
    let strips_of = strips.as_slice_mut().expect("one run of memory");
    strips_of.par_chunks_mut(strip.max(1)).enumerate().for_each(|(s, target)| {
        if conv.padding > 0 || conv.stride > 1 || (s + 1) * PANEL > channels {
            target.fill(E::ZERO);
        }
        pack_strips(source, channels, s, target.len() / PANEL, target, |row| {
            Some(conv.strip_row(row))
        });
    });
    let strips_of = &*strips_of;
    let mut columns = arena.take(&[panels(n), out_rows * PANEL]);
    let columns_of = columns.as_slice_mut().expect("one run of memory");
    columns_of.par_chunks_mut((out_rows * PANEL).max(1)).enumerate().for_each(|(p, target)| {
        if (p + 1) * PANEL > n {
            target.fill(E::ZERO);
        }
        pack_strips(d_out, n, p, out_rows, target, Some);
    });
    let columns_of = &*columns_of;

    let mut rest = d_weight;
    let mut rest_bias = d_bias;
    let mut tasks = Vec::new();
    for group in groups(panels(n)) {
        let (part, others) = rest.split_at_mut(group.len() * k * PANEL);
        rest = others;
        let bias = rest_bias.take().map(|all| {
            let n_here = n.min(group.end * PANEL) - group.start * PANEL;
            let (part, others) = all.split_at_mut(n_here);
            rest_bias = Some(others);
            part
        });
        tasks.push((group, part, bias));
    }
    let stream = n * k >= STREAM_LEN && conv.batch <= samples_of(out_frames);
    // A block of samples at a time, so that the rows stay in the second cache.
    let samples = samples_of(out_frames);
    tasks.into_par_iter().for_each(|(group, part, bias)| {
        for first in (0..conv.batch).step_by(samples) {
            let segments = samples.min(conv.batch - first);
            for tap in 0..conv.taps {
                for c in (0..channels).step_by(MAX_ROWS) {
                    let n_rows = (channels - c).min(MAX_ROWS);
                    let row = first * sample_rows + conv.strip_start(tap);
                    let a = &strips_of[c / PANEL * strip + row * PANEL + c % PANEL..];
                    let b = &columns_of[(group.start * out_rows + first * out_frames) * PANEL..];
                    let c_at = (tap * channels + c) * PANEL;
                    let part = part.as_mut_ptr();
                    let tile = Tile {
                        rows: std::array::from_fn(|r| a[r.min(n_rows - 1)..].as_ptr()),
                        n_rows,
                        step: PANEL,
                        k: out_frames,
                        segments,
                        a_segment: sample_rows * PANEL,
                        b: b.as_ptr(),
                        b_panel: out_rows * PANEL,
                        b_segment: out_frames * PANEL,
                        n_panels: group.len(),
                        c: std::array::from_fn(|r| {
                            part.wrapping_add(c_at + r.min(n_rows - 1) * PANEL)
                        }),
                        c_panel: k * PANEL,
                        n_columns: group.len() * PANEL,
                        add: add[0] || first > 0,
                        goes_on: false,
                        stream,
                    };
                    // SAFETY: a tap's frames lie within its phase of the strip, and panels and the
                    // gradient have the lengths that were checked above (invariant 1); the part is
                    // this task's own (invariant 2).
                    unsafe { E::run_tile(&tile) };
                }
            }
        }
        if stream {
            fence();
        }
        if let Some(bias) = bias {
            for (i, lanes) in bias.chunks_mut(PANEL).enumerate() {
                let rows = &columns_of[(group.start + i) * out_rows * PANEL..][..out_rows * PANEL];
                let mut sums = [E::ZERO; PANEL];
                for row in rows.chunks_exact(PANEL) {
                    for (sum, &x) in sums.iter_mut().zip(row) {
                        *sum += x;
                    }
                }
                for (d, &sum) in lanes.iter_mut().zip(&sums) {
                    *d = if add[1] { *d + sum } else { sum };
                }
            }
        }
    });
    arena.give(strips);
    arena.give(columns);
}
