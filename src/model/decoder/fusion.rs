//! The last layer of a decoder that agrees with itself: poses fused with what was decoded of their derivatives,
//! which are then derived from them.
//!
//! The heads of a decoder say each for itself where the body is, how fast it moves and how its speed changes. Here
//! they are brought together as post-processing does it ([`crate::motion::postprocess`]), as filters over frames, so
//! that the network's output has velocities that are the derivatives of its positions.

use std::sync::Arc;

use ndarray::Array2;

use crate::model::graph::{Graph, Mirror, Result};
use crate::motion::postprocess::{FusionFilters, FusionVariances};
use crate::units::FPS;

use super::QUATERNION_EPSILON;

/// How often the slope of the shift at the ends is found anew from the shift that it leads to.
const END_STEPS: usize = 5;
/// Over-relaxation of that slope. A step of 1 leaves 0.23 to 0.72 of its error, for σ_p² from a 256th to 256 times its
/// default; a step of 2 leaves between −0.54 and 0.44.
const END_RELAXATION: f64 = 2.0;

/// How often turns are found anew from the turn rates that they lead to.
const TURNING_STEPS: usize = 4;

/// arcsin x = x + Σ_k c_k x^(2k + 1), c_1 to c_5.
const ARCSINE: [f64; 5] = [1.0 / 6.0, 3.0 / 40.0, 15.0 / 336.0, 105.0 / 3456.0, 945.0 / 42_240.0];

/// Poses and their derivatives, \[batch, frames, 3\] and \[batch, frames, 4\] for the quaternion.
pub(super) struct Kinematics<T> {
    /// p, m.
    pub position: T,
    /// v, m/s.
    pub velocity: T,
    /// a, m/s².
    pub acceleration: T,
    /// q, of unit norm.
    pub quaternion: T,
    /// ω, rad/s, in world axes.
    pub angular_velocity: T,
}

/// Moves poses to where all that was decoded agrees best, and derives the rest.
#[derive(Clone, Debug)]
pub(super) struct PoseFusion {
    velocity: Arc<Array2<f64>>,
    acceleration: Arc<Array2<f64>>,
    angular_velocity: Arc<Array2<f64>>,
}

impl PoseFusion {
    /// Makes the filters of variances.
    pub fn new(variances: &FusionVariances) -> Self {
        let FusionFilters { velocity, acceleration, angular_velocity } =
            FusionFilters::new(variances);
        Self {
            velocity: Arc::new(velocity),
            acceleration: Arc::new(about_middle_frame(&acceleration)),
            angular_velocity: Arc::new(angular_velocity),
        }
    }

    /// p' = p + h_v ∗ r_v + h_a ∗ r_a with r_v = v − Dp and r_a = a − D²p, then v' = Dp', a' = D²p';
    /// q' = (1, θ/2) q / |…| with θ = h_ω ∗ (ω − ω(q') + Dθ), ω' = ω(q').
    ///
    /// D is the forward difference times 30 Hz; the last difference, and the last two second ones, repeat those
    /// before them and are no measurements. θ is found by repetition from 0 on: once is the solution to first order.
    ///
    /// A shift that is mirrored at an end has differences that change their sign there and second differences that do
    /// not; so residuals are mirrored, and what the filters find is the shift of the equations of this motion alone.
    /// To be the differences of one signal, the second ones need a value on either side, 30 (Ds)\[0\] and
    /// −30 (Ds)\[N − 2\] of the shift s, of which no measurement tells: it is found by repetition, from r_v on.
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &Kinematics<G::Tensor>,
    ) -> Result<Kinematics<G::Tensor>> {
        let [slope, curvature] = derivatives(g, &x.position)?;
        let r_v = subtract(g, &x.velocity, &slope)?;
        let r_a = subtract(g, &x.acceleration, &curvature)?;
        let by_velocity = g.filter_frames(&r_v, &self.velocity, Mirror::Odd)?;
        let mut end = r_v;
        let mut shift = by_velocity.clone();
        for step in 0..END_STEPS {
            let r_a = centred(g, &r_a, &end)?;
            let by_acceleration = g.filter_frames(&r_a, &self.acceleration, Mirror::Even)?;
            shift = g.add(&by_velocity, &by_acceleration)?;
            if step + 1 < END_STEPS {
                let found = difference(g, &shift)?;
                let change = subtract(g, &found, &end)?;
                let change = g.scale(&change, END_RELAXATION)?;
                end = g.add(&end, &change)?;
            }
        }
        let position = g.add(&x.position, &shift)?;
        let [velocity, acceleration] = derivatives(g, &position)?;

        let mut rate = turn_rate(g, &x.quaternion)?;
        let mut residual = subtract(g, &x.angular_velocity, &rate)?;
        let mut quaternion = x.quaternion.clone();
        for step in 0..TURNING_STEPS {
            let theta = g.filter_frames(&residual, &self.angular_velocity, Mirror::Odd)?;
            quaternion = turned(g, &x.quaternion, &theta)?;
            rate = turn_rate(g, &quaternion)?;
            if step + 1 < TURNING_STEPS {
                let explained = difference(g, &theta)?;
                residual = subtract(g, &x.angular_velocity, &rate)?;
                residual = g.add(&residual, &explained)?;
            }
        }
        Ok(Kinematics { position, velocity, acceleration, quaternion, angular_velocity: rate })
    }
}

/// Puts second differences where their middle frame is, r\[t − 1\] at t, and 30 e\[0\] and −30 e\[N − 2\] at the ends.
fn centred<G: Graph>(g: &mut G, r_a: &G::Tensor, end: &G::Tensor) -> Result<G::Tensor> {
    let inner = g.shift_frames(r_a, -1, 0)?;
    let last = g.shift_frames(end, 0, 1)?;
    let (first, last) = (g.scale(end, FPS)?, g.scale(&last, -FPS)?);
    g.replace_ends(&inner, &first, &last)
}

/// Taps that expect second differences where their middle frame is instead of at their first.
fn about_middle_frame(taps: &Array2<f64>) -> Array2<f64> {
    Array2::from_shape_fn(taps.dim(), |(axis, j)| if j == 0 { 0.0 } else { taps[[axis, j - 1]] })
}

fn subtract<G: Graph>(g: &mut G, a: &G::Tensor, b: &G::Tensor) -> Result<G::Tensor> {
    let minus = g.scale(b, -1.0)?;
    g.add(a, &minus)
}

/// First and second derivative of positions, per second.
fn derivatives<G: Graph>(g: &mut G, x: &G::Tensor) -> Result<[G::Tensor; 2]> {
    let first = difference(g, x)?;
    let second = difference(g, &first)?;
    let second = g.shift_frames(&second, 0, 2)?;
    Ok([first, second])
}

/// FPS (x\[t+1\] − x\[t\]); the last repeats the one before it.
fn difference<G: Graph>(g: &mut G, x: &G::Tensor) -> Result<G::Tensor> {
    let (next, here) = (g.shift_frames(x, 1, 0)?, g.shift_frames(x, 0, 1)?);
    let change = subtract(g, &next, &here)?;
    g.scale(&change, FPS)
}

/// a × b.
fn cross<G: Graph>(g: &mut G, a: &G::Tensor, b: &G::Tensor) -> Result<G::Tensor> {
    let mut rotated = |x: &G::Tensor, first: usize| {
        let (head, tail) = (g.channels(x, first..3)?, g.channels(x, 0..first)?);
        g.concat(&[&head, &tail])
    };
    let (a_yzx, a_zxy) = (rotated(a, 1)?, rotated(a, 2)?);
    let (b_yzx, b_zxy) = (rotated(b, 1)?, rotated(b, 2)?);
    let (forth, back) = (g.mul(&a_yzx, &b_zxy)?, g.mul(&a_zxy, &b_yzx)?);
    subtract(g, &forth, &back)
}

/// Sum over channels, \[…, n\] → \[…, 1\].
fn sum<G: Graph>(g: &mut G, x: &G::Tensor, n: usize) -> Result<G::Tensor> {
    let mut total = g.channels(x, 0..1)?;
    for i in 1..n {
        let next = g.channels(x, i..i + 1)?;
        total = g.add(&total, &next)?;
    }
    Ok(total)
}

/// a · b over three or four channels, \[…, n\] → \[…, 1\].
fn dot<G: Graph>(g: &mut G, a: &G::Tensor, b: &G::Tensor, n: usize) -> Result<G::Tensor> {
    let product = g.mul(a, b)?;
    sum(g, &product, n)
}

/// ω\[t\] = FPS log(q\[t+1\] q\[t\]*), in world axes; the last repeats the one before it.
///
/// With r = q\[t+1\] q\[t\]* the vector s = sgn(r_w) (r_x, r_y, r_z) is axis · sin θ/2 whatever the signs of the two, and
/// θ = 2 arcsin |s|, as a series up to |s|¹¹: off by 1e-9 of itself at 0.5 rad a frame, 15 rad/s, by 4e-4 at a quarter
/// turn, and by a seventh at half a turn.
fn turn_rate<G: Graph>(g: &mut G, q: &G::Tensor) -> Result<G::Tensor> {
    let (a, b) = (g.shift_frames(q, 1, 0)?, g.shift_frames(q, 0, 1)?);
    let (a_w, b_w) = (g.channels(&a, 0..1)?, g.channels(&b, 0..1)?);
    let (a_v, b_v) = (g.channels(&a, 1..4)?, g.channels(&b, 1..4)?);
    let r_w = dot(g, &a, &b, 4)?;
    let sign = g.normalize(&r_w, QUATERNION_EPSILON)?;
    // (a b*)_v = b_w a_v − a_w b_v + b_v × a_v
    let (forth, back) = (g.mul(&a_v, &b_w)?, g.mul(&b_v, &a_w)?);
    let r_v = subtract(g, &forth, &back)?;
    let across = cross(g, &b_v, &a_v)?;
    let r_v = g.add(&r_v, &across)?;
    let s = g.mul(&r_v, &sign)?;
    let u = dot(g, &s, &s, 3)?;
    let mut power = s.clone();
    let mut half = s;
    for coefficient in ARCSINE {
        power = g.mul(&power, &u)?;
        let term = g.scale(&power, coefficient)?;
        half = g.add(&half, &term)?;
    }
    g.scale(&half, 2.0 * FPS)
}

/// Turns orientations by small rotation vectors θ: (1, θ/2) q, made a unit quaternion again.
fn turned<G: Graph>(g: &mut G, q: &G::Tensor, theta: &G::Tensor) -> Result<G::Tensor> {
    let half = g.scale(theta, 0.5)?;
    let (w, v) = (g.channels(q, 0..1)?, g.channels(q, 1..4)?);
    let along = dot(g, &half, &v, 3)?;
    let new_w = subtract(g, &w, &along)?;
    let (straight, across) = (g.mul(&half, &w)?, cross(g, &half, &v)?);
    let change = g.add(&straight, &across)?;
    let new_v = g.add(&v, &change)?;
    let q = g.concat(&[&new_w, &new_v])?;
    g.normalize(&q, QUATERNION_EPSILON)
}
