//! One tile of a matrix product: up to 8 rows by 3 panels of 16 columns.

use crate::autodiff::element::Element;

use super::level::{Level, level};
use super::pack::PANEL;

/// Rows of a tile at most.
pub const MAX_ROWS: usize = 8;
/// Panels of a tile at most: 8 × 3 sums of 16 lanes fill 24 of AVX-512's 32 registers.
pub const MAX_PANELS: usize = 3;

/// A tile of C += A B, or C = A B.
///
/// c\[r\]\[16 p + j\] = Σ_s Σ_k a\[r\](s, k) · b\[p\](s, k)\[j\] over `segments` s and `k` steps, where
/// a\[r\](s, k) = rows\[r\]\[s a_segment + k step\] and b\[p\](s, k) = the 16 numbers at
/// b + p b_panel + s b_segment + 16 k.
#[derive(Clone, Copy)]
pub struct Tile<E> {
    /// Where each row of A begins; entries from `n_rows` on repeat the last.
    pub rows: [*const E; MAX_ROWS],
    pub n_rows: usize,
    /// From one k to the next in A: 1 where rows lie along memory, 16 in a strip.
    pub step: usize,
    pub k: usize,
    pub segments: usize,
    pub a_segment: usize,
    pub b: *const E,
    pub b_panel: usize,
    pub b_segment: usize,
    pub n_panels: usize,
    /// Where each row of C begins.
    pub c: [*mut E; MAX_ROWS],
    pub c_panel: usize,
    /// Columns that are written, at most 16 times `n_panels`; the rest would be padding.
    pub n_columns: usize,
    /// Whether C is added to or overwritten.
    pub add: bool,
}

/// Runs a tile with the fastest instructions of the machine.
///
/// # Safety
/// The tile's pointers are valid: see the invariants of the module.
pub unsafe fn run_f32(tile: &Tile<f32>) {
    // SAFETY: the caller's promise is passed on; `level` found the instructions.
    unsafe {
        #[cfg(target_arch = "x86_64")]
        match level() {
            Level::Avx512 => return super::x86::run_avx512(tile),
            Level::Avx2 => return super::x86::run_avx2(tile),
            Level::Portable => {}
        }
        run_portable(tile);
    }
}

/// Runs a tile in plain code, which is also what the fast forms are held against.
///
/// # Safety
/// The tile's pointers are valid: see the invariants of the module.
pub unsafe fn run_portable<E: Element>(tile: &Tile<E>) {
    const ROWS: usize = 4;
    for first in (0..tile.n_rows).step_by(ROWS) {
        for p in 0..tile.n_panels {
            let mut sums = [[E::ZERO; PANEL]; ROWS];
            for s in 0..tile.segments {
                for k in 0..tile.k {
                    // SAFETY: a panel has 16 k elements (invariant 1).
                    let b = unsafe {
                        let at = p * tile.b_panel + s * tile.b_segment + k * PANEL;
                        &*tile.b.add(at).cast::<[E; PANEL]>()
                    };
                    for (r, sums) in sums.iter_mut().enumerate() {
                        // SAFETY: a row has k elements (invariant 1); rows beyond the last repeat it.
                        let a = unsafe {
                            let row = tile.rows[(first + r).min(tile.n_rows - 1)];
                            *row.add(s * tile.a_segment + k * tile.step)
                        };
                        for (sum, &b) in sums.iter_mut().zip(b) {
                            *sum = sum.fused(a, b);
                        }
                    }
                }
            }
            for r in first..tile.n_rows.min(first + ROWS) {
                // SAFETY: an output row has its columns, and no other tile writes them (invariants).
                unsafe { store(tile, r, p, &sums[r - first]) };
            }
        }
    }
}

/// Writes the sums of one row and panel.
///
/// # Safety
/// As for [`run_portable`].
#[inline(always)]
pub unsafe fn store<E: Element>(tile: &Tile<E>, r: usize, p: usize, sums: &[E; PANEL]) {
    let n = tile.n_columns.saturating_sub(p * PANEL).min(PANEL);
    // SAFETY: the caller's promise.
    let c = unsafe { std::slice::from_raw_parts_mut(tile.c[r].add(p * tile.c_panel), n) };
    if tile.add {
        for (c, &sum) in c.iter_mut().zip(sums) {
            *c += sum;
        }
    } else {
        c.copy_from_slice(&sums[..n]);
    }
}
