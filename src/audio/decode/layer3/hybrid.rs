//! Short blocks in order, butterflies against aliasing, and the inverse transform (ISO/IEC 11172-3
//! sections 2.4.3.4.8 and 2.4.3.4.10).

use std::f64::consts::PI;
use std::sync::LazyLock;

use super::lanes::{F4, F8, Lanes};
use super::side_info::SHORT_BLOCK;
use super::tables::{ANTIALIAS, TWIDDLE_36};
use crate::instructions::{Level, level, vectorized};

pub(super) fn reorder(grbuf: &mut [f32], scratch: &mut [f32], sfb: &[u8]) {
    let mut src = 0;
    let mut dst = 0;
    for &len in sfb.iter().step_by(3).take_while(|&&len| len != 0) {
        let len = len as usize;
        for i in 0..len {
            scratch[dst] = grbuf[src + i];
            scratch[dst + 1] = grbuf[src + i + len];
            scratch[dst + 2] = grbuf[src + i + 2 * len];
            dst += 3;
        }
        src += 3 * len;
    }
    grbuf[..dst].copy_from_slice(&scratch[..dst]);
}

pub(super) fn antialias(grbuf: &mut [f32; 576], nbands: usize) {
    let aa = |k: usize, i: usize| F4::load(&ANTIALIAS[k][i..]);
    for b in 0..nbands {
        let (lo, hi) = grbuf[18 * b..18 * b + 36].split_at_mut(18);
        for i in [0, 4] {
            // hi[i..i+4] against lo[17-i..=14-i] (reversed).
            let u = F4::load(&hi[i..]);
            let d = F4::load(&lo[14 - i..]).rev();
            (u * aa(0, i) - d * aa(1, i)).store(&mut hi[i..]);
            (u * aa(1, i) + d * aa(0, i)).rev().store(&mut lo[14 - i..]);
        }
    }
}

#[inline(always)]
fn dct3_9<T: Lanes>(y: &mut [T; 9]) {
    let c = T::splat;
    let mut s0 = y[0];
    let mut s2 = y[2];
    let mut s4 = y[4];
    let mut s6 = y[6];
    let mut s8 = y[8];
    let mut t0 = s0 + s6 * c(0.5);
    s0 -= s6;
    let mut t4 = (s4 + s2) * c(0.93969262);
    let mut t2 = (s8 + s2) * c(0.76604444);
    s6 = (s4 - s8) * c(0.17364818);
    s4 += s8 - s2;

    s2 = s0 - s4 * c(0.5);
    y[4] = s4 + s0;
    s8 = t0 - t2 + s6;
    s0 = t0 - t4 + t2;
    s4 = t0 + t4 - s6;

    let mut s1 = y[1];
    let mut s3 = y[3];
    let mut s5 = y[5];
    let mut s7 = y[7];

    s3 = s3 * c(0.86602540);
    t0 = (s5 + s1) * c(0.98480775);
    t4 = (s5 - s7) * c(0.34202014);
    t2 = (s1 + s7) * c(0.64278761);
    s1 = (s1 - s5 - s7) * c(0.86602540);

    s5 = t0 - s3 - t2;
    s7 = t4 - s3 - t0;
    s3 = t4 + s3 - t2;

    y[0] = s4 - s7;
    y[1] = s2 + s1;
    y[2] = s0 - s3;
    y[3] = s8 + s5;
    y[5] = s8 - s5;
    y[6] = s0 + s3;
    y[7] = s2 - s1;
    y[8] = s4 + s7;
}

/// The inverse transform of `T::N` adjacent bands at once, one band per lane.
///
/// What is kept for the next block has its own window: block types that do not follow each other
/// by the rules, and mixed blocks after others, then overlap as the standard says.
#[inline(always)]
fn imdct36_bands<T: Lanes>(spectrum: &mut [f32], overlap: &mut [f32], window: &Window) {
    let c = T::splat;
    let g = |spectrum: &[f32], o: usize| T::gather(&spectrum[o..], 18);
    let mut co = [c(0.0); 9];
    let mut si = [c(0.0); 9];
    co[0] = -g(spectrum, 0);
    si[0] = g(spectrum, 17);
    for i in 0..4 {
        si[8 - 2 * i] = g(spectrum, 4 * i + 1) - g(spectrum, 4 * i + 2);
        co[1 + 2 * i] = g(spectrum, 4 * i + 1) + g(spectrum, 4 * i + 2);
        si[7 - 2 * i] = g(spectrum, 4 * i + 4) - g(spectrum, 4 * i + 3);
        co[2 + 2 * i] = -(g(spectrum, 4 * i + 3) + g(spectrum, 4 * i + 4));
    }
    dct3_9(&mut co);
    dct3_9(&mut si);

    si[1] = -si[1];
    si[3] = -si[3];
    si[5] = -si[5];
    si[7] = -si[7];

    for i in 0..9 {
        let head = co[i] * c(TWIDDLE_36[9 + i]) + si[i] * c(TWIDDLE_36[i]);
        let tail = co[i] * c(TWIDDLE_36[i]) - si[i] * c(TWIDDLE_36[9 + i]);
        let before = |at: usize| T::gather(&overlap[at..], 18);
        let (first, last) = (before(i), before(17 - i));
        (first - head * c(window.rise[i])).scatter(&mut spectrum[i..], 18);
        (last + head * c(window.rise[17 - i])).scatter(&mut spectrum[17 - i..], 18);
        (tail * c(window.fall[i])).scatter(&mut overlap[i..], 18);
        (tail * c(window.fall[17 - i])).scatter(&mut overlap[17 - i..], 18);
    }
}

/// Transforms bands; `is_wide` says that registers hold eight of them.
fn imdct36(spectrum: &mut [f32], overlap: &mut [f32], window: &Window) {
    imdct36_all(spectrum, overlap, window, level() != Level::Portable);
}

vectorized! {
    fn imdct36_all(spectrum: &mut [f32], overlap: &mut [f32], window: &Window, is_wide: bool) {
        if is_wide {
            let (spectrum, overlap) = imdct36_groups::<F8>(spectrum, overlap, window);
            imdct36_groups::<f32>(spectrum, overlap, window);
        } else {
            let (spectrum, overlap) = imdct36_groups::<F4>(spectrum, overlap, window);
            imdct36_groups::<f32>(spectrum, overlap, window);
        }
    }
}

/// Transforms as many bands at a time as `T` has lanes and returns the bands that are left.
#[inline(always)]
fn imdct36_groups<'a, T: Lanes>(
    spectrum: &'a mut [f32],
    overlap: &'a mut [f32],
    window: &Window,
) -> (&'a mut [f32], &'a mut [f32]) {
    let (mut spectra, mut overlaps) =
        (spectrum.chunks_exact_mut(18 * T::N), overlap.chunks_exact_mut(18 * T::N));
    for (spectrum, overlap) in spectra.by_ref().zip(overlaps.by_ref()) {
        if spectrum.iter().fold(0, |bits, x| bits | x.abs().to_bits()) == 0 {
            // The transform of nothing is nothing: only what the block before left sounds.
            spectrum.copy_from_slice(overlap);
            overlap.fill(0.0);
        } else {
            imdct36_bands::<T>(spectrum, overlap, window);
        }
    }
    (spectra.into_remainder(), overlaps.into_remainder())
}

/// The transforms of a short block's three windows, which start 6, 12 and 18 samples in.
fn imdct_short(spectrum: &mut [f32], overlap: &mut [f32]) {
    let bands = spectrum.as_chunks_mut::<18>().0.iter_mut();
    for (band, overlap) in bands.zip(overlap.as_chunks_mut::<18>().0) {
        let mut out = [0.0; 36];
        out[..18].copy_from_slice(overlap);
        for w in 0..3 {
            for (t, row) in TABLES.short.iter().enumerate() {
                let sum: f32 = (0..6).map(|k| band[3 * k + w] * row[k]).sum();
                out[6 * (w + 1) + t] += sum;
            }
        }
        band.copy_from_slice(&out[..18]);
        overlap.copy_from_slice(&out[18..]);
    }
}

/// Transforms a granule back, `n_long` bands of it with the window of a normal block.
pub(super) fn imdct(
    spectrum: &mut [f32; 576],
    overlap: &mut [f32; 576],
    block_type: u8,
    n_long: usize,
) {
    let (long, rest) = spectrum.split_at_mut(18 * n_long);
    let (long_overlap, rest_overlap) = overlap.split_at_mut(18 * n_long);
    imdct36(long, long_overlap, &TABLES.windows[0]);
    if block_type == SHORT_BLOCK {
        imdct_short(rest, rest_overlap);
    } else {
        let window = &TABLES.windows[usize::from(block_type)];
        imdct36(rest, rest_overlap, window);
    }
}

/// The two halves of a block's window.
#[derive(Clone, Copy)]
struct Window {
    rise: [f32; 18],
    fall: [f32; 18],
}

struct Tables {
    /// By block type; that of short blocks is in `short`.
    windows: [Window; 4],
    /// w(t) cos(pi / 24 (2 t + 7) (2 k + 1)), k = 0 to 5, by t = 0 to 11.
    short: [[f32; 6]; 12],
}

/// Section 2.4.3.4.10.3 of the standard.
static TABLES: LazyLock<Tables> = LazyLock::new(|| {
    let long = |t: usize| (PI / 36.0 * (t as f64 + 0.5)).sin();
    let short = |t: usize| (PI / 12.0 * (t as f64 + 0.5)).sin();
    let rise = std::array::from_fn(|t| long(t) as f32);
    let fall = std::array::from_fn(|t| long(t + 18) as f32);
    let short_rise = std::array::from_fn(|t| match t {
        0..6 => 0.0,
        6..12 => short(t - 6) as f32,
        _ => 1.0,
    });
    let short_fall = std::array::from_fn(|t| match t {
        0..6 => 1.0,
        6..12 => short(t) as f32,
        _ => 0.0,
    });
    let normal = Window { rise, fall };
    let start = Window { rise, fall: short_fall };
    let stop = Window { rise: short_rise, fall };
    let cosine = |t: usize, k: usize| (PI / 24.0 * ((2 * t + 7) * (2 * k + 1)) as f64).cos();
    Tables {
        windows: [normal, start, normal, stop],
        short: std::array::from_fn(|t| std::array::from_fn(|k| (short(t) * cosine(t, k)) as f32)),
    }
});

pub(super) fn invert_odd(grbuf: &mut [f32; 576]) {
    for band in grbuf.as_chunks_mut::<18>().0.iter_mut().skip(1).step_by(2) {
        for x in band.iter_mut().skip(1).step_by(2) {
            *x = -*x;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The standard's formula, in full.
    fn by_definition(spectrum: &[f32; 18]) -> [f64; 36] {
        std::array::from_fn(|t| {
            let terms = spectrum.iter().enumerate().map(|(k, &x)| {
                f64::from(x) * (PI / 72.0 * ((2 * t + 19) * (2 * k + 1)) as f64).cos()
            });
            terms.sum()
        })
    }

    #[test]
    fn long_blocks_are_transformed_by_the_formula_with_their_own_windows() {
        for block_type in [0_u8, 1, 3] {
            let line = |i: usize| ((i * i * 7 + 3 * i) % 23) as f32 / 23.0 - 0.4;
            let spectrum: [f32; 576] = std::array::from_fn(line);
            let before: [f32; 576] = std::array::from_fn(|i| line(i + 5));
            let (mut out, mut overlap) = (spectrum, before);
            imdct(&mut out, &mut overlap, block_type, 2);
            for sb in [0, 1, 2, 7, 31] {
                let band: &[f32; 18] = spectrum[18 * sb..][..18].try_into().unwrap();
                let raw = by_definition(band);
                let window = &TABLES.windows[if sb < 2 { 0 } else { usize::from(block_type) }];
                for t in 0..18 {
                    let at = 18 * sb + t;
                    let head = f64::from(before[at]) + raw[t] * f64::from(window.rise[t]);
                    let tail = raw[18 + t] * f64::from(window.fall[t]);
                    assert!((f64::from(out[at]) - head).abs() < 4e-6, "{block_type}, {at}");
                    assert!((f64::from(overlap[at]) - tail).abs() < 4e-6, "{block_type}, {at}");
                }
            }
        }
    }

    #[test]
    fn bands_of_silence_leave_what_the_block_before_left() {
        let before: [f32; 576] = std::array::from_fn(|i| ((i * 31) % 17) as f32 - 8.0);
        // Bands 9 to 31 are silent: with eight or four at a time and one by one.
        let mut out: [f32; 576] = std::array::from_fn(|i| if i < 18 * 9 { 0.25 } else { 0.0 });
        let mut overlap = before;
        imdct(&mut out, &mut overlap, 0, 1);
        assert_eq!(out[18 * 17..], before[18 * 17..]);
        assert!(overlap[18 * 17..].iter().all(|&x| x == 0.0));
        assert!(out[..18].iter().zip(&before).all(|(x, y)| x != y));
    }
}
