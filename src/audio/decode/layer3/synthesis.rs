//! The polyphase filter bank (ISO/IEC 11172-3 section 2.4.3.2.2).

use std::sync::LazyLock;

use super::lanes::{F4, F8, Lanes};
use super::tables::{SECANTS, SYNTHESIS_WINDOW};
use crate::instructions::{Level, level, vectorized};

/// From the scale of the tables, that of 16-bit integers, to 1.
const SCALE: f32 = 1.0 / 32_768.0;

// The history of the filter bank is viewed as rows of 4 floats: left even, right even, left odd,
// right odd.
const ZLIN: usize = 15 * 16;
/// Rows that one call to `synthesize` touches.
const SYNTH_ROWS: usize = ZLIN + 2 * 16;
/// Rows in the whole buffer.
pub(super) const SYN_ROWS: usize = (18 + 15) * 2 * 32 / 4;

/// DCT-II over as many columns from `k` on as `T` has lanes, of a matrix of 32 rows `stride` apart.
#[inline(always)]
fn dct_ii_columns<T: Lanes>(grbuf: &mut [f32], stride: usize, k: usize) {
    let grbuf = &mut grbuf[..32 * stride];
    let c = T::splat;
    let mut t = [[c(0.0); 8]; 4];
    for i in 0..8 {
        let x0 = T::load(&grbuf[k + i * stride..]);
        let x1 = T::load(&grbuf[k + (15 - i) * stride..]);
        let x2 = T::load(&grbuf[k + (16 + i) * stride..]);
        let x3 = T::load(&grbuf[k + (31 - i) * stride..]);
        let t0 = x0 + x3;
        let t1 = x1 + x2;
        let t2 = (x1 - x2) * c(SECANTS[3 * i]);
        let t3 = (x0 - x3) * c(SECANTS[3 * i + 1]);
        t[0][i] = t0 + t1;
        t[1][i] = (t0 - t1) * c(SECANTS[3 * i + 2]);
        t[2][i] = t3 + t2;
        t[3][i] = (t3 - t2) * c(SECANTS[3 * i + 2]);
    }
    for x in &mut t {
        let [mut x0, mut x1, mut x2, mut x3, mut x4, mut x5, mut x6, mut x7] = *x;
        let mut xt = x0 - x7;
        x0 += x7;
        x7 = x1 - x6;
        x1 += x6;
        x6 = x2 - x5;
        x2 += x5;
        x5 = x3 - x4;
        x3 += x4;
        x4 = x0 - x3;
        x0 += x3;
        x3 = x1 - x2;
        x1 += x2;
        x[0] = x0 + x1;
        x[4] = (x0 - x1) * c(0.70710677);
        x5 += x6;
        x6 = (x6 + x7) * c(0.70710677);
        x7 += xt;
        x3 = (x3 + x4) * c(0.70710677);
        x5 -= x7 * c(0.198912367); // rotate by PI/8
        x7 += x5 * c(0.382683432);
        x5 -= x7 * c(0.198912367);
        x0 = xt - x6;
        xt += x6;
        x[1] = (xt + x7) * c(0.50979561);
        x[2] = (x4 + x3) * c(0.54119611);
        x[3] = (x0 - x5) * c(0.60134488);
        x[5] = (x0 + x5) * c(0.89997619);
        x[6] = (x4 - x3) * c(1.30656302);
        x[7] = (xt - x7) * c(2.56291556);
    }
    for i in 0..7 {
        let y = k + i * 4 * stride;
        t[0][i].store(&mut grbuf[y..]);
        (t[2][i] + t[3][i] + t[3][i + 1]).store(&mut grbuf[y + stride..]);
        (t[1][i] + t[1][i + 1]).store(&mut grbuf[y + 2 * stride..]);
        (t[2][i + 1] + t[3][i] + t[3][i + 1]).store(&mut grbuf[y + 3 * stride..]);
    }
    let y = k + 7 * 4 * stride;
    t[0][7].store(&mut grbuf[y..]);
    (t[2][7] + t[3][7]).store(&mut grbuf[y + stride..]);
    t[1][7].store(&mut grbuf[y + 2 * stride..]);
    t[3][7].store(&mut grbuf[y + 3 * stride..]);
}

/// DCT-II over the 18 columns of every channel's subband matrix; `is_wide` says that registers hold
/// eight of them.
#[inline(always)]
fn dct_ii(spectra: &mut [[f32; 576]], is_wide: bool) {
    for spectrum in &mut *spectra {
        if is_wide {
            dct_ii_columns::<F8>(spectrum, 18, 0);
            dct_ii_columns::<F8>(spectrum, 18, 8);
        } else {
            for k in [0, 4, 8, 12] {
                dct_ii_columns::<F4>(spectrum, 18, k);
            }
        }
    }
    // The last two columns of both channels side by side.
    let mut rest = [[0.0; 4]; 32];
    for (ch, spectrum) in spectra.iter().enumerate() {
        for (to, from) in rest.iter_mut().zip(spectrum.as_chunks::<18>().0) {
            to[2 * ch..2 * ch + 2].copy_from_slice(&from[16..]);
        }
    }
    dct_ii_columns::<F4>(rest.as_flattened_mut(), 4, 0);
    for (ch, spectrum) in spectra.iter_mut().enumerate() {
        for (to, from) in spectrum.as_chunks_mut::<18>().0.iter_mut().zip(&rest) {
            to[16..].copy_from_slice(&from[2 * ch..2 * ch + 2]);
        }
    }
}

/// Floats of the 16 rows of 4 that the window is applied to side by side; nothing is made of the last.
const SPAN: usize = 16 * 4;
/// Of these, how many at once: they stay in registers.
const LOT: usize = 16;

/// The window, the two factors of each of 8 steps, spread over the rows and scaled by [`SCALE`].
///
/// A power of two may be multiplied before a sum or after it.
static SPREAD_WINDOW: LazyLock<[[[f32; SPAN]; 2]; 8]> = LazyLock::new(|| {
    let factor = |k: usize, which: usize, at: usize| {
        let row = at / 4;
        if row == 15 { 0.0 } else { SCALE * SYNTHESIS_WINDOW[(14 - row) * 16 + 2 * k + which] }
    };
    std::array::from_fn(|k| {
        std::array::from_fn(|which| std::array::from_fn(|at| factor(k, which, at)))
    })
});

/// Returns the sums a and b of all rows under the window.
#[inline(always)]
fn windowed(lins: &[[f32; 4]; SYNTH_ROWS], window: &[[[f32; SPAN]; 2]; 8]) -> [[f32; SPAN]; 2] {
    let rows = lins.as_flattened();
    let (mut a_sums, mut b_sums) = ([0.0; SPAN], [0.0; SPAN]);
    for at in (0..SPAN).step_by(LOT) {
        let (mut a, mut b) = ([0.0; LOT], [0.0; LOT]);
        for (k, [w0, w1]) in window.iter().enumerate() {
            let vz = &rows[4 * (ZLIN - 16 * k) + at..][..LOT];
            let vy = &rows[4 * 16 * k + at..][..LOT];
            let (w0, w1) = (&w0[at..at + LOT], &w1[at..at + LOT]);
            for l in 0..LOT {
                b[l] += vz[l] * w1[l] + vy[l] * w0[l];
            }
            if k % 2 == 0 {
                for l in 0..LOT {
                    a[l] += vz[l] * w0[l] - vy[l] * w1[l];
                }
            } else {
                for l in 0..LOT {
                    a[l] += vy[l] * w1[l] - vz[l] * w0[l];
                }
            }
        }
        a_sums[at..at + LOT].copy_from_slice(&a);
        b_sums[at..at + LOT].copy_from_slice(&b);
    }
    [a_sums, b_sums]
}

/// `centre_pair`: the two samples C writes to `pcm[0]` and `pcm[16*nch]`,
/// read from `lane` (and `lane + 2`) of every 16th row starting at `row`.
#[inline(always)]
fn centre_pair(z: &[[f32; 4]; SYNTH_ROWS], row: usize, lane: usize) -> (f32, f32) {
    let x = |m: usize| z[row + 16 * m][lane];
    let mut a;
    a = (x(14) - x(0)) * 29.0;
    a += (x(1) + x(13)) * 213.0;
    a += (x(12) - x(2)) * 459.0;
    a += (x(3) + x(11)) * 2037.0;
    a += (x(10) - x(4)) * 5153.0;
    a += (x(5) + x(9)) * 6574.0;
    a += (x(8) - x(6)) * 37489.0;
    a += x(7) * 75038.0;
    let first = a;

    let x = |m: usize| z[row + 16 * m][lane + 2];
    a = x(14) * 104.0;
    a += x(12) * 1567.0;
    a += x(10) * 9727.0;
    a += x(8) * 64019.0;
    a += x(6) * -9975.0;
    a += x(4) * -45.0;
    a += x(2) * 146.0;
    a += x(0) * -5.0;
    (first, a)
}

#[inline(always)]
fn synthesize<const NCH: usize>(
    xl: &[f32],
    xr: &[f32],
    dst: &mut [f32],
    lins: &mut [[f32; 4]; SYNTH_ROWS],
    window: &[[[f32; SPAN]; 2]; 8],
) {
    let (Some(xl), Some(xr)) = (xl.first_chunk::<560>(), xr.first_chunk::<560>()) else { return };
    let dst = &mut dst[..64 * NCH];
    let r = NCH - 1;

    lins[ZLIN + 15] = [xl[18 * 16], xr[18 * 16], xl[0], xr[0]];
    lins[ZLIN + 31] = [xl[1 + 18 * 16], xr[1 + 18 * 16], xl[1], xr[1]];

    // For mono, C also computes "right" samples into the same slots and then
    // overwrites them with the left ones; skipping them gives identical output.
    let mut pair = |at: usize, row: usize, lane: usize| {
        let (a, b) = centre_pair(lins, row, lane);
        dst[at] = a * SCALE;
        dst[at + 16 * NCH] = b * SCALE;
    };
    if NCH == 2 {
        pair(r, 15, 1);
        pair(r + 32 * NCH, 31, 1);
    }
    pair(0, 15, 0);
    pair(32 * NCH, 31, 0);

    for i in (0..15).rev() {
        lins[ZLIN + i] =
            [xl[18 * (31 - i)], xr[18 * (31 - i)], xl[1 + 18 * (31 - i)], xr[1 + 18 * (31 - i)]];
        lins[ZLIN + 16 + i][0] = xl[1 + 18 * (1 + i)];
        lins[ZLIN + 16 + i][1] = xr[1 + 18 * (1 + i)];
        lins[ZLIN - 16 + i][2] = xl[18 * (1 + i)];
        lins[ZLIN - 16 + i][3] = xr[18 * (1 + i)];
    }
    let [a, b] = windowed(lins, window);
    for (i, (a, b)) in a.as_chunks::<4>().0.iter().zip(b.as_chunks::<4>().0).take(15).enumerate() {
        dst[(15 - i) * NCH..][..NCH].copy_from_slice(&a[..NCH]);
        dst[(17 + i) * NCH..][..NCH].copy_from_slice(&b[..NCH]);
        dst[(47 - i) * NCH..][..NCH].copy_from_slice(&a[2..2 + NCH]);
        dst[(49 + i) * NCH..][..NCH].copy_from_slice(&b[2..2 + NCH]);
    }
}

/// Synthesizes a granule of `NCH` channels from their subbands; the rows of `lins` are the filter's memory.
#[inline(always)]
fn synthesize_all<const NCH: usize>(
    spectra: &[f32],
    pcm: &mut [f32],
    lins: &mut [[f32; 4]; SYN_ROWS],
    window: &[[[f32; SPAN]; 2]; 8],
) {
    for i in (0..N_STEPS).step_by(2) {
        let Some(rows) = lins[16 * i..].first_chunk_mut() else { return };
        let right = &spectra[576 * (NCH - 1) + i..];
        synthesize::<NCH>(&spectra[i..], right, &mut pcm[32 * NCH * i..], rows, window);
    }
}

/// Samples of a subband in a granule.
const N_STEPS: usize = 18;

/// Synthesizes a granule of one or two channels, interleaved into `pcm`.
pub(super) fn synthesize_granule(
    qmf_state: &mut [f32; 960],
    spectra: &mut [[f32; 576]; 2],
    n_channels: usize,
    pcm: &mut [f32],
    lins: &mut [[f32; 4]; SYN_ROWS],
) {
    lins.as_flattened_mut()[..15 * 64].copy_from_slice(qmf_state);
    let is_wide = level() != Level::Portable;
    synthesize_rows(spectra, n_channels, pcm, lins, &SPREAD_WINDOW, is_wide);
    let tail = &lins.as_flattened()[N_STEPS * 64..N_STEPS * 64 + 15 * 64];
    if n_channels == 1 {
        // Standard (not MINIMP3_NONSTANDARD_BUT_LOGICAL) behavior: a mono frame
        // only advances the left channel's filterbank history, so a later
        // switch to stereo starts the right channel from its old state.
        for (q, l) in qmf_state.as_chunks_mut::<2>().0.iter_mut().zip(tail.as_chunks::<2>().0) {
            q[0] = l[0];
        }
    } else {
        qmf_state.copy_from_slice(tail);
    }
}

vectorized! {
    fn synthesize_rows(
        spectra: &mut [[f32; 576]; 2], n_channels: usize, pcm: &mut [f32],
        lins: &mut [[f32; 4]; SYN_ROWS], window: &[[[f32; SPAN]; 2]; 8], is_wide: bool,
    ) {
        dct_ii(&mut spectra[..n_channels], is_wide);
        if n_channels == 1 {
            synthesize_all::<1>(spectra.as_flattened(), pcm, lins, window);
        } else {
            synthesize_all::<2>(spectra.as_flattened(), pcm, lins, window);
        }
    }
}

#[cfg(test)]
mod tests;
