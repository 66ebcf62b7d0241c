//! Weights in panels of 16 outputs, the form in which they live.
//!
//! A weight W\[n\]\[k\] (n outputs, k inputs; for a convolution k = tap · channels + channel) is kept as
//! panels \[n / 16\]\[k\]\[16\], padded with zeros. Products read panels from front to back; the optimizer,
//! averages and clipping work on elements and do not care. Only loading and saving unpack.

use crate::autodiff::element::Element;

#[cfg(target_arch = "x86_64")]
use super::{Level, level};

/// Outputs of a panel: one cache line of `f32`.
pub const PANEL: usize = 16;

/// Returns how many panels hold `n` outputs.
pub fn panels(n: usize) -> usize {
    n.div_ceil(PANEL)
}

/// Returns the length of a packed weight of `n` outputs with `k` inputs each.
pub fn packed_len(n: usize, k: usize) -> usize {
    panels(n) * k * PANEL
}

/// Packs a weight from PyTorch's order: \[outputs, inputs\] or \[outputs, inputs, taps\].
pub fn pack_weight<E: Element>(
    source: &[E],
    n: usize,
    channels: usize,
    taps: usize,
    packed: &mut [E],
) {
    packed.fill(E::ZERO);
    for_each_element(n, channels, taps, |flat, at| packed[at] = source[flat]);
}

/// Unpacks a weight into PyTorch's order.
pub fn unpack_weight<E: Element>(
    packed: &[E],
    n: usize,
    channels: usize,
    taps: usize,
    target: &mut [E],
) {
    for_each_element(n, channels, taps, |flat, at| target[flat] = packed[at]);
}

/// Calls `f(index in PyTorch's order, index in panels)` for each element.
fn for_each_element(n: usize, channels: usize, taps: usize, mut f: impl FnMut(usize, usize)) {
    let k = channels * taps;
    for output in 0..n {
        let (panel, lane) = (output / PANEL, output % PANEL);
        for channel in 0..channels {
            for tap in 0..taps {
                let flat = (output * channels + channel) * taps + tap;
                f(flat, (panel * k + tap * channels + channel) * PANEL + lane);
            }
        }
    }
}

/// Transposes 16 rows of 16 numbers in plain code.
///
/// Compiled for the target's base on purpose: with AVX-512 the compiler gathers one number at a time,
/// half as fast.
pub fn transpose_portable<E: Element>(
    source: &[E; PANEL * PANEL],
    target: &mut [E; PANEL * PANEL],
) {
    for (j, row) in target.chunks_exact_mut(PANEL).enumerate() {
        for (i, x) in row.iter_mut().enumerate() {
            *x = source[i * PANEL + j];
        }
    }
}

/// Transposes 16 rows of 16 numbers with the fastest instructions of the machine.
pub fn transpose_f32(source: &[f32; PANEL * PANEL], target: &mut [f32; PANEL * PANEL]) {
    #[cfg(target_arch = "x86_64")]
    if level() == Level::Avx512 {
        // SAFETY: `level` found the instructions.
        return unsafe { super::x86::transpose_avx512(source, target) };
    }
    transpose_portable(source, target);
}

/// Transposes 16 rows of 16 numbers.
pub fn transpose_16<E: Element>(source: &[E], target: &mut [E]) {
    let source = source.try_into().expect("16 × 16 numbers");
    E::transpose(source, target.try_into().expect("16 × 16 numbers"));
}

/// Copies `source`, rows of `channels` numbers, into strips of 16 channels: \[channels / 16\]\[rows\]\[16\].
///
/// `place(row)` says where a row goes within each strip of `strip_rows` rows; rows of the strips that
/// receive nothing keep what they have. `first` and the length of `strips` choose the strips.
pub fn pack_strips<E: Element>(
    source: &[E],
    channels: usize,
    first: usize,
    strip_rows: usize,
    strips: &mut [E],
    place: impl Fn(usize) -> Option<usize>,
) {
    for (s, strip) in strips.chunks_exact_mut(strip_rows * PANEL).enumerate() {
        let c = (first + s) * PANEL;
        let n = (channels - c).min(PANEL);
        for (row, values) in source.chunks_exact(channels).enumerate() {
            if let Some(at) = place(row) {
                strip[at * PANEL..at * PANEL + n].copy_from_slice(&values[c..c + n]);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_packed_weight_has_the_output_in_the_lane_and_comes_back() {
        // 19 outputs take two panels, the second with 13 lanes of padding.
        let (n, channels, taps) = (19, 5, 3);
        let source: Vec<f64> = (0..n * channels * taps).map(|i| i as f64 + 1.0).collect();
        let mut packed = vec![f64::NAN; packed_len(n, channels * taps)];
        pack_weight(&source, n, channels, taps, &mut packed);
        let (output, channel, tap) = (17, 3, 2);
        let panel = &packed[15 * PANEL..];
        assert_eq!(
            panel[(tap * channels + channel) * PANEL + 1],
            source[(output * 5 + channel) * 3 + tap]
        );
        assert!(panel.chunks_exact(PANEL).all(|lanes| lanes[3..].iter().all(|&x| x == 0.0)));
        let mut back = vec![0.0; source.len()];
        unpack_weight(&packed, n, channels, taps, &mut back);
        assert_eq!(back, source);
    }

    #[test]
    fn transposing_swaps_rows_and_columns() {
        let source: Vec<f32> = (0..256).map(|i| i as f32).collect();
        let mut target = vec![0.0; 256];
        let mut portable = [0.0; 256];
        transpose_16(&source, &mut target);
        transpose_portable(source.as_slice().try_into().unwrap(), &mut portable);
        for i in 0..16 {
            for j in 0..16 {
                assert_eq!(target[j * 16 + i], source[i * 16 + j], "row {i}, column {j}");
            }
        }
        assert_eq!(target, portable);
    }
}
