//! One float or several, so that each kernel is written once for all; lane by lane, nothing is fused
//! or reordered.

use std::ops::{Add, AddAssign, Mul, Neg, Sub, SubAssign};

pub(super) trait Lanes:
    Copy
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Neg<Output = Self>
    + AddAssign
    + SubAssign
{
    /// How many floats.
    const N: usize;
    fn splat(x: f32) -> Self;
    /// Loads the first `N` floats of `s`.
    fn load(s: &[f32]) -> Self;
    /// Stores into the first `N` floats of `s`.
    fn store(self, s: &mut [f32]);
    /// Loads `s[0], s[stride], s[2*stride], ...`.
    fn gather(s: &[f32], stride: usize) -> Self;
    /// Stores to `s[0], s[stride], s[2*stride], ...`.
    fn scatter(self, s: &mut [f32], stride: usize);
    /// Reverses the lane order.
    fn rev(self) -> Self;
}

impl Lanes for f32 {
    const N: usize = 1;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        x
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        s[0]
    }
    #[inline(always)]
    fn store(self, s: &mut [f32]) {
        s[0] = self;
    }
    #[inline(always)]
    fn gather(s: &[f32], _stride: usize) -> Self {
        s[0]
    }
    #[inline(always)]
    fn scatter(self, s: &mut [f32], _stride: usize) {
        s[0] = self;
    }
    #[inline(always)]
    fn rev(self) -> Self {
        self
    }
}

/// Floats side by side; LLVM turns these element-wise loops into SIMD on its own.
#[derive(Copy, Clone)]
pub(super) struct Floats<const N: usize>([f32; N]);

pub(super) type F4 = Floats<4>;
pub(super) type F8 = Floats<8>;

macro_rules! binop {
    ($trait:ident, $f:ident, $op:tt) => {
        impl<const N: usize> $trait for Floats<N> {
            type Output = Self;
            #[inline(always)]
            fn $f(self, o: Self) -> Self {
                Self(std::array::from_fn(|i| self.0[i] $op o.0[i]))
            }
        }
    };
}
binop!(Add, add, +);
binop!(Sub, sub, -);
binop!(Mul, mul, *);
impl<const N: usize> AddAssign for Floats<N> {
    #[inline(always)]
    fn add_assign(&mut self, o: Self) {
        *self = *self + o;
    }
}
impl<const N: usize> SubAssign for Floats<N> {
    #[inline(always)]
    fn sub_assign(&mut self, o: Self) {
        *self = *self - o;
    }
}
impl<const N: usize> Neg for Floats<N> {
    type Output = Self;
    #[inline(always)]
    fn neg(self) -> Self {
        Self(self.0.map(|x| -x))
    }
}

impl<const N: usize> Lanes for Floats<N> {
    const N: usize = N;
    #[inline(always)]
    fn splat(x: f32) -> Self {
        Self([x; N])
    }
    #[inline(always)]
    fn load(s: &[f32]) -> Self {
        let s = &s[..N];
        Self(std::array::from_fn(|i| s[i]))
    }
    #[inline(always)]
    fn store(self, s: &mut [f32]) {
        s[..N].copy_from_slice(&self.0);
    }
    #[inline(always)]
    fn gather(s: &[f32], stride: usize) -> Self {
        let s = &s[..=stride * (N - 1)];
        Self(std::array::from_fn(|i| s[stride * i]))
    }
    #[inline(always)]
    fn scatter(self, s: &mut [f32], stride: usize) {
        let s = &mut s[..=stride * (N - 1)];
        for (i, x) in self.0.into_iter().enumerate() {
            s[stride * i] = x;
        }
    }
    #[inline(always)]
    fn rev(self) -> Self {
        Self(std::array::from_fn(|i| self.0[N - 1 - i]))
    }
}
