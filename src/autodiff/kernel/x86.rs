//! The tile with AVX-512 and with AVX2, in assembly.
//!
//! Per step of k: load 16 columns per panel, then per row broadcast one number of A and add its
//! products to the row's sums. With 8 rows and 3 panels AVX-512 does 24 fused products of 16 lanes
//! from 11 loads, so that the multipliers, two a cycle, are the limit. The compiler, given the same
//! loops, hoists all broadcasts and spills sums to memory: a third of the speed.

use std::arch::asm;
use std::arch::x86_64::{
    __m256, __m512, __m512d, _MM_HINT_T0, _mm_prefetch, _mm_sfence, _mm256_add_ps, _mm256_loadu_ps,
    _mm256_setzero_ps, _mm256_storeu_ps, _mm512_add_ps, _mm512_castpd_ps, _mm512_castps_pd,
    _mm512_loadu_ps, _mm512_mask_storeu_ps, _mm512_maskz_loadu_ps, _mm512_setzero_ps,
    _mm512_shuffle_f32x4, _mm512_storeu_ps, _mm512_stream_ps, _mm512_unpackhi_pd,
    _mm512_unpackhi_ps, _mm512_unpacklo_pd, _mm512_unpacklo_ps,
};

use super::pack::PANEL;
use super::tile::{MAX_PANELS, MAX_ROWS, Tile, store};

/// The loop over k of segment `$s`, adding to the sums `$v`.
///
/// Each line is a row: its number, its pointer's name, and per vector of sums the register, the place
/// in `$v` and the register of B. `k` counts bytes up to zero, so that one register serves all rows.
macro_rules! accumulate {
    ($tile:ident, $s:ident, $v:ident, loads [$($load:literal),*], broadcast $spare:tt,
     clobbers [$($clobber:tt),*], $($r:tt $a:ident [$($acc:tt $i:tt $b:literal),*];)*) => {{
        let bytes = 4 * $tile.k * $tile.step;
        asm!(
            "2:",
            $($load,)*
            $(
                concat!("vbroadcastss ", $spare, ", dword ptr [{", stringify!($a), "} + {k}]"),
                $(concat!("vfmadd231ps ", $acc, ", ", $b, ", ", $spare),)*
            )*
            "add {b}, 64",
            "add {k}, {step}",
            "jnz 2b",
            "/* {panel} */",
            b = inout(reg) $tile.b.add($s * $tile.b_segment) => _,
            panel = in(reg) 4 * $tile.b_panel,
            k = inout(reg) bytes.wrapping_neg() => _,
            step = in(reg) 4 * $tile.step,
            $($a = in(reg) $tile.rows[$r].add($s * $tile.a_segment).wrapping_byte_add(bytes),)*
            $($(inout($acc) $v[$r][$i],)*)*
            out($spare) _,
            $(out($clobber) _,)*
            options(nostack, readonly),
        );
    }};
}

/// Transposes 16 rows of 16 numbers: pairs, then pairs of pairs, then quarters of vectors.
///
/// # Safety
/// The machine has AVX-512 F.
#[target_feature(enable = "avx512f")]
pub unsafe fn transpose_avx512(source: &[f32; PANEL * PANEL], target: &mut [f32; PANEL * PANEL]) {
    let rows: [__m512; PANEL] = std::array::from_fn(|i| {
        // SAFETY: row i lies within the source.
        unsafe { _mm512_loadu_ps(source.as_ptr().add(i * PANEL)) }
    });
    let pairs: [__m512d; PANEL] = std::array::from_fn(|i| {
        let (a, b) = (rows[i & !1], rows[i | 1]);
        let half = if i & 1 == 0 { _mm512_unpacklo_ps(a, b) } else { _mm512_unpackhi_ps(a, b) };
        _mm512_castps_pd(half)
    });
    let fours: [__m512; PANEL] = std::array::from_fn(|i| {
        // Of rows 4 q to 4 q + 3: column 4 l + i % 4 in quarter l.
        let (a, b) = (pairs[(i & !3) | ((i >> 1) & 1)], pairs[(i & !3) | 2 | ((i >> 1) & 1)]);
        let half = if i & 1 == 0 { _mm512_unpacklo_pd(a, b) } else { _mm512_unpackhi_pd(a, b) };
        _mm512_castpd_ps(half)
    });
    for column in 0..4 {
        let [a, b, c, d] = [0, 4, 8, 12].map(|first| fours[first + column]);
        let (low_even, low_odd) = (quarters::<0x88>(a, b), quarters::<0xdd>(a, b));
        let (high_even, high_odd) = (quarters::<0x88>(c, d), quarters::<0xdd>(c, d));
        for (quarter, row) in [
            (0, quarters::<0x88>(low_even, high_even)),
            (1, quarters::<0x88>(low_odd, high_odd)),
            (2, quarters::<0xdd>(low_even, high_even)),
            (3, quarters::<0xdd>(low_odd, high_odd)),
        ] {
            // SAFETY: the row lies within the target.
            unsafe {
                _mm512_storeu_ps(target.as_mut_ptr().add((4 * quarter + column) * PANEL), row)
            };
        }
    }
}

/// Two quarters of a and two of b, by their numbers in `WHICH`.
#[target_feature(enable = "avx512f")]
fn quarters<const WHICH: i32>(a: __m512, b: __m512) -> __m512 {
    _mm512_shuffle_f32x4::<WHICH>(a, b)
}

/// Makes what was streamed visible to other threads before anything that is written later.
pub fn fence() {
    // SAFETY: every x86-64 has this instruction.
    unsafe { _mm_sfence() }
}

/// Asks for a cache line.
#[inline(always)]
pub fn prefetch(address: *const i8) {
    // SAFETY: every x86-64 has this instruction, and it does not fault.
    unsafe { _mm_prefetch(address, _MM_HINT_T0) }
}

/// Runs a tile with AVX-512.
///
/// # Safety
/// The machine has AVX-512 F, and the tile's pointers are valid.
#[target_feature(enable = "avx512f")]
pub unsafe fn run_avx512(tile: &Tile<f32>) {
    if tile.k == 0 || tile.segments == 0 {
        // SAFETY: as promised by the caller; the loops below need at least one step.
        return unsafe { super::tile::run_portable(tile) };
    }
    // SAFETY: the caller's promise is passed on.
    let v = unsafe { if tile.goes_on { sums::<true>(tile) } else { sums::<false>(tile) } };
    if tile.stream && !tile.add && tile.n_columns == tile.n_panels * PANEL {
        // SAFETY: the caller's promise is passed on.
        return unsafe { stream(tile, &v) };
    }
    for p in 0..tile.n_panels {
        let n = tile.n_columns.saturating_sub(p * PANEL).min(PANEL);
        let mask = ((1_u32 << n) - 1) as u16;
        for (r, v) in v.iter().enumerate().take(tile.n_rows) {
            // SAFETY: masked lanes touch no memory; the others are this tile's own (invariants).
            unsafe {
                let c = tile.c[r].add(p * tile.c_panel);
                let old =
                    if tile.add { _mm512_maskz_loadu_ps(mask, c) } else { _mm512_setzero_ps() };
                let sum = if tile.add { _mm512_add_ps(old, v[p]) } else { v[p] };
                _mm512_mask_storeu_ps(c, mask, sum);
            }
        }
    }
}

/// The sums of a tile: of each row, 16 lanes for each panel.
type Sums = [[__m512; MAX_PANELS]; MAX_ROWS];

/// Sums up a tile, from zero or from what the output holds.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn sums<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: the caller's promise is passed on.
    unsafe {
        match (tile.n_rows > 4, tile.n_panels) {
            (true, 3) => tile_8_3::<GOES_ON>(tile),
            (true, 2) => tile_8_2::<GOES_ON>(tile),
            (true, _) => tile_8_1::<GOES_ON>(tile),
            (false, 3) => tile_4_3::<GOES_ON>(tile),
            (false, 2) => tile_4_2::<GOES_ON>(tile),
            (false, _) => tile_4_1::<GOES_ON>(tile),
        }
    }
}

/// Returns what the sums of a tile begin with.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn begin<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    let mut v = [[_mm512_setzero_ps(); MAX_PANELS]; MAX_ROWS];
    if GOES_ON {
        for (r, v) in v.iter_mut().enumerate() {
            for (p, v) in v.iter_mut().enumerate().take(tile.n_panels) {
                // SAFETY: a tile that goes on has whole panels; rows beyond the last repeat it (invariants).
                *v = unsafe { _mm512_loadu_ps(tile.c[r].add(p * tile.c_panel)) };
            }
        }
    }
    v
}

/// Writes full panels past the caches: a line that is not read soon need not be fetched before.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn stream(tile: &Tile<f32>, v: &Sums) {
    for p in 0..tile.n_panels {
        for (r, v) in v.iter().enumerate().take(tile.n_rows) {
            let c = tile.c[r].wrapping_add(p * tile.c_panel);
            // SAFETY: an output row has its columns, and no other tile writes them (invariants).
            unsafe {
                if c.addr().is_multiple_of(size_of::<__m512>()) {
                    _mm512_stream_ps(c, v[p]);
                } else {
                    _mm512_storeu_ps(c, v[p]);
                }
            }
        }
    }
}

/// 8 rows, 3 panels.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn tile_8_3<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: as promised by the caller.
    let mut v = unsafe { begin::<GOES_ON>(tile) };
    for s in 0..tile.segments {
        // SAFETY: every row and panel has k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups zmm24, [{b}]", "vmovups zmm25, [{b} + {panel}]", "vmovups zmm26, [{b} + 2*{panel}]", "prefetcht0 [{b} + 2048]", "prefetcht0 [{b} + {panel} + 2048]", "prefetcht0 [{b} + 2*{panel} + 2048]"],
                broadcast "zmm27", clobbers ["zmm24", "zmm25", "zmm26"],
                0 a0 ["zmm0" 0 "zmm24", "zmm1" 1 "zmm25", "zmm2" 2 "zmm26"];
                1 a1 ["zmm3" 0 "zmm24", "zmm4" 1 "zmm25", "zmm5" 2 "zmm26"];
                2 a2 ["zmm6" 0 "zmm24", "zmm7" 1 "zmm25", "zmm8" 2 "zmm26"];
                3 a3 ["zmm9" 0 "zmm24", "zmm10" 1 "zmm25", "zmm11" 2 "zmm26"];
                4 a4 ["zmm12" 0 "zmm24", "zmm13" 1 "zmm25", "zmm14" 2 "zmm26"];
                5 a5 ["zmm15" 0 "zmm24", "zmm16" 1 "zmm25", "zmm17" 2 "zmm26"];
                6 a6 ["zmm18" 0 "zmm24", "zmm19" 1 "zmm25", "zmm20" 2 "zmm26"];
                7 a7 ["zmm21" 0 "zmm24", "zmm22" 1 "zmm25", "zmm23" 2 "zmm26"];
            }
        }
    }
    v
}

/// 8 rows, 2 panels.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn tile_8_2<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: as promised by the caller.
    let mut v = unsafe { begin::<GOES_ON>(tile) };
    for s in 0..tile.segments {
        // SAFETY: every row and panel has k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups zmm24, [{b}]", "vmovups zmm25, [{b} + {panel}]"],
                broadcast "zmm27", clobbers ["zmm24", "zmm25"],
                0 a0 ["zmm0" 0 "zmm24", "zmm1" 1 "zmm25"];
                1 a1 ["zmm2" 0 "zmm24", "zmm3" 1 "zmm25"];
                2 a2 ["zmm4" 0 "zmm24", "zmm5" 1 "zmm25"];
                3 a3 ["zmm6" 0 "zmm24", "zmm7" 1 "zmm25"];
                4 a4 ["zmm8" 0 "zmm24", "zmm9" 1 "zmm25"];
                5 a5 ["zmm10" 0 "zmm24", "zmm11" 1 "zmm25"];
                6 a6 ["zmm12" 0 "zmm24", "zmm13" 1 "zmm25"];
                7 a7 ["zmm14" 0 "zmm24", "zmm15" 1 "zmm25"];
            }
        }
    }
    v
}

/// 8 rows, 1 panel.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn tile_8_1<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: as promised by the caller.
    let mut v = unsafe { begin::<GOES_ON>(tile) };
    for s in 0..tile.segments {
        // SAFETY: every row and panel has k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups zmm24, [{b}]"],
                broadcast "zmm27", clobbers ["zmm24"],
                0 a0 ["zmm0" 0 "zmm24"];
                1 a1 ["zmm1" 0 "zmm24"];
                2 a2 ["zmm2" 0 "zmm24"];
                3 a3 ["zmm3" 0 "zmm24"];
                4 a4 ["zmm4" 0 "zmm24"];
                5 a5 ["zmm5" 0 "zmm24"];
                6 a6 ["zmm6" 0 "zmm24"];
                7 a7 ["zmm7" 0 "zmm24"];
            }
        }
    }
    v
}

/// 4 rows, 3 panels.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn tile_4_3<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: as promised by the caller.
    let mut v = unsafe { begin::<GOES_ON>(tile) };
    for s in 0..tile.segments {
        // SAFETY: every row and panel has k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups zmm24, [{b}]", "vmovups zmm25, [{b} + {panel}]", "vmovups zmm26, [{b} + 2*{panel}]", "prefetcht0 [{b} + 2048]", "prefetcht0 [{b} + {panel} + 2048]", "prefetcht0 [{b} + 2*{panel} + 2048]"],
                broadcast "zmm27", clobbers ["zmm24", "zmm25", "zmm26"],
                0 a0 ["zmm0" 0 "zmm24", "zmm1" 1 "zmm25", "zmm2" 2 "zmm26"];
                1 a1 ["zmm3" 0 "zmm24", "zmm4" 1 "zmm25", "zmm5" 2 "zmm26"];
                2 a2 ["zmm6" 0 "zmm24", "zmm7" 1 "zmm25", "zmm8" 2 "zmm26"];
                3 a3 ["zmm9" 0 "zmm24", "zmm10" 1 "zmm25", "zmm11" 2 "zmm26"];
            }
        }
    }
    v
}

/// 4 rows, 2 panels.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn tile_4_2<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: as promised by the caller.
    let mut v = unsafe { begin::<GOES_ON>(tile) };
    for s in 0..tile.segments {
        // SAFETY: every row and panel has k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups zmm24, [{b}]", "vmovups zmm25, [{b} + {panel}]"],
                broadcast "zmm27", clobbers ["zmm24", "zmm25"],
                0 a0 ["zmm0" 0 "zmm24", "zmm1" 1 "zmm25"];
                1 a1 ["zmm2" 0 "zmm24", "zmm3" 1 "zmm25"];
                2 a2 ["zmm4" 0 "zmm24", "zmm5" 1 "zmm25"];
                3 a3 ["zmm6" 0 "zmm24", "zmm7" 1 "zmm25"];
            }
        }
    }
    v
}

/// 4 rows, 1 panel.
///
/// # Safety
/// As for [`run_avx512`].
#[target_feature(enable = "avx512f")]
unsafe fn tile_4_1<const GOES_ON: bool>(tile: &Tile<f32>) -> Sums {
    // SAFETY: as promised by the caller.
    let mut v = unsafe { begin::<GOES_ON>(tile) };
    for s in 0..tile.segments {
        // SAFETY: every row and panel has k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups zmm24, [{b}]"],
                broadcast "zmm27", clobbers ["zmm24"],
                0 a0 ["zmm0" 0 "zmm24"];
                1 a1 ["zmm1" 0 "zmm24"];
                2 a2 ["zmm2" 0 "zmm24"];
                3 a3 ["zmm3" 0 "zmm24"];
            }
        }
    }
    v
}

/// Runs a tile with AVX2 and FMA, 4 rows and a panel at a time: 8 of its 16 registers hold sums.
///
/// # Safety
/// The machine has AVX2 and FMA, and the tile's pointers are valid.
#[target_feature(enable = "avx2,fma")]
pub unsafe fn run_avx2(tile: &Tile<f32>) {
    const ROWS: usize = 4;
    if tile.k == 0 || tile.segments == 0 {
        // SAFETY: as promised by the caller; the loop below needs at least one step.
        return unsafe { super::tile::run_portable(tile) };
    }
    for first in (0..tile.n_rows).step_by(ROWS) {
        for p in 0..tile.n_panels {
            let mut part = *tile;
            for r in 0..ROWS {
                part.rows[r] = tile.rows[(first + r).min(tile.n_rows - 1)];
            }
            part.b = tile.b.wrapping_add(p * tile.b_panel);
            part.c = std::array::from_fn(|r| {
                tile.c[(first + r).min(tile.n_rows - 1)].wrapping_add(p * tile.c_panel)
            });
            // SAFETY: the caller's promise is passed on.
            let v = unsafe { tile_4_avx2(&part) };
            for r in first..tile.n_rows.min(first + ROWS) {
                let full = tile.n_columns >= (p + 1) * PANEL;
                // SAFETY: an output row has its columns, and no other tile writes them.
                unsafe {
                    let c = tile.c[r].add(p * tile.c_panel);
                    if full {
                        for (half, &sum) in v[r - first].iter().enumerate() {
                            let c = c.add(8 * half);
                            let sum =
                                if tile.add { _mm256_add_ps(_mm256_loadu_ps(c), sum) } else { sum };
                            _mm256_storeu_ps(c, sum);
                        }
                    } else {
                        let mut sums = [0.0; PANEL];
                        _mm256_storeu_ps(sums.as_mut_ptr(), v[r - first][0]);
                        _mm256_storeu_ps(sums.as_mut_ptr().add(8), v[r - first][1]);
                        store(tile, r, p, &sums);
                    }
                }
            }
        }
    }
}

/// 4 rows, one panel.
///
/// # Safety
/// As for [`run_avx2`].
#[target_feature(enable = "avx2,fma")]
unsafe fn tile_4_avx2(tile: &Tile<f32>) -> [[__m256; 2]; 4] {
    let mut v = [[_mm256_setzero_ps(); 2]; 4];
    if tile.goes_on {
        for (v, c) in v.iter_mut().zip(tile.c) {
            // SAFETY: a tile that goes on has whole panels; rows beyond the last repeat it (invariants).
            *v = unsafe { [_mm256_loadu_ps(c), _mm256_loadu_ps(c.add(8))] };
        }
    }
    for s in 0..tile.segments {
        // SAFETY: every row and the panel have k elements in segment s (invariant 1); k is not zero.
        unsafe {
            accumulate! {
                tile, s, v,
                loads ["vmovups ymm8, [{b}]", "vmovups ymm9, [{b} + 32]"],
                broadcast "ymm10", clobbers ["ymm8", "ymm9"],
                0 a0 ["ymm0" 0 "ymm8", "ymm1" 1 "ymm9"];
                1 a1 ["ymm2" 0 "ymm8", "ymm3" 1 "ymm9"];
                2 a2 ["ymm4" 0 "ymm8", "ymm5" 1 "ymm9"];
                3 a3 ["ymm6" 0 "ymm8", "ymm7" 1 "ymm9"];
            }
        }
    }
    v
}
