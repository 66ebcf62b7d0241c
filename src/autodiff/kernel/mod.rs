//! The only code with `unsafe` but for the choice of instructions (`instructions`): tiles of matrix products.
//!
//! Why here: the tile with AVX-512 runs at 95 % of the machine's peak; what the compiler makes of the
//! same loops keeps sums in memory and runs at a third of it at best (`docs/benchmarks.md`). Written in
//! assembly it is 30 lines, and a test holds every form against the portable one, bit for bit where
//! both round once per product.
//!
//! Invariants, which every `unsafe` block relies on:
//! 1. A [`Tile`] points into slices whose lengths the drivers in `product` have checked against the
//!    geometry: a row has `k` readable elements, a panel `16 k`, and an output row its columns.
//! 2. Two tiles that run at once write disjoint columns of the output: a task owns its panels.
//! 3. Code for an instruction set runs only where [`level`] found it.

#![allow(unsafe_code, reason = "the one measured kernel module; the invariants are above")]

mod few_rows;
mod gather;
mod many_rows;
mod pack;
mod product;
mod small;
#[cfg(test)]
mod tests;
mod tile;
mod weight_gradient;
#[cfg(target_arch = "x86_64")]
mod x86;

pub(super) use crate::instructions::vectorized;
pub use crate::instructions::{Level, level};
pub use gather::Conv;
pub use pack::{PANEL, pack_weight, packed_len, transpose_f32, transpose_portable, unpack_weight};
pub use product::{input_gradient, product};
pub use small::{Matrix, MatrixMut, matmul};
pub use tile::{Tile, peak_gflops, run_f32, run_portable};
pub use weight_gradient::weight_gradient;
