//! One tile of a matrix product: up to 8 rows by 3 panels of 16 columns.

use crate::autodiff::arena::Arena;
use crate::autodiff::element::Element;

use super::pack::PANEL;
use super::{Level, level};

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
    /// Whether sums begin with what C holds instead of zero, so that k may be divided without another rounding; then
    /// panels are whole and `add` is not set.
    pub goes_on: bool,
    /// Whether C is large and not read soon, so that it should not pass through the caches; the
    /// caller must call [`fence`] before other threads may read.
    pub stream: bool,
}

/// Asks for a cache line that will be read soon; any address will do.
#[inline(always)]
pub fn prefetch<E>(address: *const E) {
    #[cfg(target_arch = "x86_64")]
    super::x86::prefetch(address.cast());
    #[cfg(not(target_arch = "x86_64"))]
    let _ = address;
}

/// Makes what tiles have streamed visible to other threads.
pub fn fence() {
    #[cfg(target_arch = "x86_64")]
    super::x86::fence();
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

/// Measures what a thread can do at most: GFLOP/s of a tile whose operands stay in the first cache.
///
/// What a product reaches of this, and not of a number on paper, is how well it is written.
pub fn peak_gflops() -> f64 {
    const K: usize = 64;
    const RUNS: usize = 20_000;
    let a = vec![0.5_f32; MAX_ROWS * K];
    let b = Arena::<f32>::aligned(MAX_PANELS * K * PANEL);
    let mut c = Arena::<f32>::aligned(MAX_ROWS * MAX_PANELS * PANEL);
    let c = c.as_mut_ptr();
    let tile = Tile {
        rows: std::array::from_fn(|r| a[r * K..].as_ptr()),
        n_rows: MAX_ROWS,
        step: 1,
        k: K,
        segments: 1,
        a_segment: 0,
        b: b.as_ptr(),
        b_panel: K * PANEL,
        b_segment: 0,
        n_panels: MAX_PANELS,
        c: std::array::from_fn(|r| c.wrapping_add(r * MAX_PANELS * PANEL)),
        c_panel: PANEL,
        n_columns: MAX_PANELS * PANEL,
        add: false,
        goes_on: false,
        stream: false,
    };
    let flops = 2.0 * (RUNS * MAX_ROWS * MAX_PANELS * PANEL * K) as f64;
    let best = (0..5).map(|_| {
        let started = std::time::Instant::now();
        for _ in 0..RUNS {
            // SAFETY: rows, panels and output were made of these sizes just now.
            unsafe { run_f32(std::hint::black_box(&tile)) };
        }
        flops / started.elapsed().as_secs_f64() / 1e9
    });
    best.fold(0.0, f64::max)
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
            if tile.goes_on {
                for (r, sums) in sums.iter_mut().enumerate() {
                    // SAFETY: a tile that goes on has whole panels; rows beyond the last repeat it (invariants).
                    *sums = unsafe {
                        let row = tile.c[(first + r).min(tile.n_rows - 1)];
                        *row.add(p * tile.c_panel).cast::<[E; PANEL]>()
                    };
                }
            }
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
