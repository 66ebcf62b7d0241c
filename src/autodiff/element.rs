//! The numbers that tensors hold: `f32` to train and infer, `f64` to check gradients.

use std::fmt::{Debug, Display};
use std::iter::Sum;
use std::ops::{Add, AddAssign, Div, DivAssign, Mul, MulAssign, Neg, Sub, SubAssign};

use super::kernel::Tile;

/// A real number that tensors hold.
///
/// Everything but the tile of the matrix product is written once for both types; the tile of `f32`
/// has fast forms that tests hold against the portable one.
pub trait Element:
    Copy
    + Debug
    + Default
    + Display
    + PartialOrd
    + Send
    + Sync
    + 'static
    + Add<Output = Self>
    + AddAssign
    + Div<Output = Self>
    + DivAssign
    + Mul<Output = Self>
    + MulAssign
    + Neg<Output = Self>
    + Sub<Output = Self>
    + SubAssign
    + Sum
{
    const ZERO: Self;
    const ONE: Self;

    fn from_f64(x: f64) -> Self;
    fn to_f64(self) -> f64;
    fn abs(self) -> Self;
    fn sqrt(self) -> Self;
    /// e^x; for `f32` within 2e-7 of the truth, relative, and vectorisable.
    fn exp(self) -> Self;
    fn ln(self) -> Self;
    fn ln_1p(self) -> Self;
    fn tanh(self) -> Self;
    /// The error function, 2/√π ∫₀ˣ e^(-t²) dt; for `f32` within 4e-7, absolute, and vectorisable.
    fn erf(self) -> Self;
    fn is_finite(self) -> bool;
    /// a b + self, rounded once where the machine has such an instruction.
    fn fused(self, a: Self, b: Self) -> Self;

    #[inline(always)]
    fn larger(self, other: Self) -> Self {
        if self > other { self } else { other }
    }

    /// Transposes 16 rows of 16 numbers.
    fn transpose(source: &[Self; 256], target: &mut [Self; 256]) {
        super::kernel::transpose_portable(source, target);
    }

    /// Runs one tile of a matrix product; see `Tile`.
    ///
    /// # Safety
    /// The pointers of the tile are valid for what it reads and writes.
    #[allow(unsafe_code, reason = "declared here, implemented in the kernel module")]
    unsafe fn run_tile(tile: &Tile<Self>);
}

/// 1 / (1 + e^-x).
#[inline(always)]
pub fn sigmoid<E: Element>(x: E) -> E {
    E::ONE / (E::ONE + (-x).exp())
}

/// e^x by Cody and Waite's reduction and a polynomial of degree 6 (Cephes, `expf`).
///
/// x = n ln 2 + r with |r| ≤ ln 2 / 2; e^x = 2^n e^r. Without a branch or a call, so that loops over
/// it become vector code. Below -87.3 it gives the smallest normal number, not a subnormal one;
/// above 88.7 infinity; NaN stays NaN.
#[inline(always)]
pub fn exp_f32(x: f32) -> f32 {
    const LOG2_E: f32 = std::f32::consts::LOG2_E;
    /// 1.5 · 2^23: adding it rounds to an integer, which then lies in the low bits.
    const ROUND: f32 = 12_582_912.0;
    const LN2_HIGH: f32 = 0.693_359_4;
    const LN2_LOW: f32 = -2.121_944_4e-4;
    let bounded = if x < -87.3 { -87.3 } else { x };
    let bounded = if bounded > 88.7 { 88.7 } else { bounded };
    let shifted = bounded * LOG2_E + ROUND;
    let n = shifted - ROUND;
    let r = bounded - n * LN2_HIGH - n * LN2_LOW;
    let p = 1.987_569_1e-4;
    let p = p * r + 1.398_199_9e-3;
    let p = p * r + 8.333_452e-3;
    let p = p * r + 4.166_579_6e-2;
    let p = p * r + 1.666_666_6e-1;
    let p = p * r + 0.5;
    let e_r = p * r * r + r + 1.0;
    // 2^n in two factors: n reaches 128, one more than an exponent holds.
    let bits = shifted.to_bits().wrapping_sub(ROUND.to_bits()) as i32;
    let half = bits >> 1;
    let power = |n: i32| f32::from_bits((n.wrapping_add(127) as u32) << 23);
    let y = e_r * power(half) * power(bits.wrapping_sub(half));
    if x > 88.7 { f32::INFINITY } else { y }
}

/// erf(x) as a quotient of polynomials, x P(x²) / Q(x²) within ±4, beyond which it is ±1 in f32.
///
/// Within 4e-7 of the truth, five units of its last place. Without a branch or a call, so that loops over it become vector code; the
/// coefficients are those of Eigen's `erf` (MPL-2.0), also used by XLA.
#[inline(always)]
pub fn erf_f32(x: f32) -> f32 {
    const P: [f32; 7] = [
        -2.726_142e-10,
        2.770_681_4e-8,
        -2.101_024e-6,
        -5.692_506_4e-5,
        -7.349_906_3e-4,
        -2.954_6e-3,
        -1.609_603_3e-2,
    ];
    const Q: [f32; 5] =
        [-1.456_607_2e-5, -2.133_740_6e-4, -1.682_827e-3, -7.373_329e-3, -1.426_473_9e-2];
    // Written so that NaN stays NaN.
    let x = if x > 4.0 { 4.0 } else { x };
    let x = if x < -4.0 { -4.0 } else { x };
    let square = x * x;
    let polynomial = |coefficients: &[f32]| {
        coefficients[1..].iter().fold(coefficients[0], |sum, c| sum * square + c)
    };
    x * polynomial(&P) / polynomial(&Q)
}

/// The operations that both types take from the standard library.
macro_rules! standard {
    () => {
        const ZERO: Self = 0.0;
        const ONE: Self = 1.0;

        #[inline(always)]
        fn from_f64(x: f64) -> Self {
            x as Self
        }

        #[inline(always)]
        fn to_f64(self) -> f64 {
            f64::from(self)
        }

        #[inline(always)]
        fn abs(self) -> Self {
            self.abs()
        }

        #[inline(always)]
        fn sqrt(self) -> Self {
            self.sqrt()
        }

        #[inline(always)]
        fn ln(self) -> Self {
            self.ln()
        }

        #[inline(always)]
        fn ln_1p(self) -> Self {
            self.ln_1p()
        }

        #[inline(always)]
        fn tanh(self) -> Self {
            self.tanh()
        }

        #[inline(always)]
        fn is_finite(self) -> bool {
            self.is_finite()
        }
    };
}

impl Element for f32 {
    standard!();

    #[inline(always)]
    fn exp(self) -> Self {
        exp_f32(self)
    }

    #[inline(always)]
    fn erf(self) -> Self {
        erf_f32(self)
    }

    #[inline(always)]
    fn fused(self, a: Self, b: Self) -> Self {
        // Where the instruction is not part of the target's base, mul_add is a slow call.
        if cfg!(target_arch = "aarch64") { a.mul_add(b, self) } else { a * b + self }
    }

    fn transpose(source: &[Self; 256], target: &mut [Self; 256]) {
        super::kernel::transpose_f32(source, target);
    }

    #[allow(unsafe_code, reason = "declared here, implemented in the kernel module")]
    unsafe fn run_tile(tile: &Tile<Self>) {
        // SAFETY: the caller's promise is passed on.
        unsafe { super::kernel::run_f32(tile) }
    }
}

impl Element for f64 {
    standard!();

    #[inline(always)]
    fn exp(self) -> Self {
        self.exp()
    }

    #[inline(always)]
    fn erf(self) -> Self {
        libm::erf(self)
    }

    #[inline(always)]
    fn fused(self, a: Self, b: Self) -> Self {
        a * b + self
    }

    #[allow(unsafe_code, reason = "declared here, implemented in the kernel module")]
    unsafe fn run_tile(tile: &Tile<Self>) {
        // SAFETY: the caller's promise is passed on.
        unsafe { super::kernel::run_portable(tile) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers from -100 to 100, dense near zero.
    fn numbers() -> impl Iterator<Item = f32> {
        (-40_000..=40_000).map(|i| (i as f32 / 40_000.0).powi(3) * 100.0)
    }

    #[test]
    fn exp_is_within_2e_7_of_the_truth() {
        for x in numbers().filter(|x| (-87.0..88.7).contains(x)) {
            let wanted = f64::from(x).exp();
            let error = (f64::from(exp_f32(x)) / wanted - 1.0).abs();
            assert!(error < 2e-7, "e^{x}: off by {error:.1e}");
        }
    }

    #[test]
    fn exp_at_the_edges() {
        assert_eq!(exp_f32(0.0), 1.0);
        assert_eq!(exp_f32(88.8), f32::INFINITY);
        assert_eq!(exp_f32(f32::INFINITY), f32::INFINITY);
        assert!(exp_f32(f32::NAN).is_nan());
        // Not zero: the smallest normal number, so that nothing becomes subnormal.
        for x in [-87.4, -200.0, f32::NEG_INFINITY] {
            assert!((0.0..1.3e-38).contains(&exp_f32(x)), "e^{x} = {:e}", exp_f32(x));
        }
    }

    #[test]
    fn erf_is_within_4e_7_of_the_truth() {
        for x in numbers() {
            let error = (f64::from(erf_f32(x)) - libm::erf(f64::from(x))).abs();
            assert!(error < 4e-7, "erf {x}: off by {error:.1e}");
        }
        assert!(erf_f32(f32::NAN).is_nan());
    }
}
