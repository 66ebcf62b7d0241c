//! Quaternions of a clip: unit, on one hemisphere, smooth. What is not finite stays as it is.

use super::config::Hemisphere;
use super::smoothing::{Polynomials, hann};
use crate::motion::quaternion::{Quaternion, dot, make_sign_continuous};

/// Norms this near to 1 are those of unit quaternions in single precision, whose components are off
/// by half of it: dividing by them would only stir the rounding.
const UNIT_ROUNDING: f64 = f32::EPSILON as f64;

/// Returns `q / max(|q|, eps)`; what is unit already stays, bit for bit.
pub fn unit(q: Quaternion, eps: f64) -> Quaternion {
    let norm = dot(q, q).sqrt();
    if !norm.is_finite() || (norm - 1.0).abs() <= UNIT_ROUNDING {
        return q;
    }
    q.map(|c| c / norm.max(eps))
}

/// Chooses between `q` and `-q`, which are the same rotation; quaternions that are not finite are
/// passed over.
pub fn choose_signs(q: &mut [Quaternion], hemisphere: Hemisphere) {
    match hemisphere {
        Hemisphere::Sequential => {
            let mut finite: Vec<Quaternion> = q.iter().copied().filter(is_finite).collect();
            make_sign_continuous(&mut finite);
            for (q, signed) in q.iter_mut().filter(|q| is_finite(q)).zip(finite) {
                *q = signed;
            }
        }
        Hemisphere::PerFrame => {
            for q in q.iter_mut().filter(|q| q[0] < 0.0) {
                *q = negated(*q);
            }
        }
    }
}

/// Smooths orientations by normalized sums with Hann weights over `window` frames, odd.
///
/// `r[t] = Σₖ wₖ s q[t+k]` over its norm, `s = ±1` the sign of `q[t+k] · q[t]`, `w` from [`hann`].
/// Near the ends the window shrinks evenly and stays centred. Source: Markley et al., Averaging
/// Quaternions, Journal of Guidance, Control, and Dynamics 30(4), 2007, whose mean these sums
/// approach where orientations lie close together.
pub fn smooth_by_hann(q: &[Quaternion], window: usize) -> Vec<Quaternion> {
    let weights = hann(window);
    let half = window / 2;
    (0..q.len())
        .map(|t| {
            let reach = half.min(t).min(q.len() - 1 - t);
            let mut sum = [0.0; 4];
            for k in t - reach..=t + reach {
                let weight = weights[half + k - t];
                let near = toward(q[k], q[t]);
                for (sum, c) in sum.iter_mut().zip(near) {
                    *sum += weight * c;
                }
            }
            normalized(sum)
        })
        .collect()
}

/// Smooths orientations in place: each component like a position, on one hemisphere, then unit
/// again; every frame keeps its sign.
pub fn smooth_by_polynomials(q: &mut [Quaternion], polynomials: &Polynomials) {
    let mut continuous = q.to_vec();
    choose_signs(&mut continuous, Hemisphere::Sequential);
    let smooth: [Vec<f64>; 4] = std::array::from_fn(|c| {
        let component: Vec<f64> = continuous.iter().map(|q| q[c]).collect();
        polynomials.smooth(&component)
    });
    for (t, q) in q.iter_mut().enumerate() {
        let r = normalized(std::array::from_fn(|c| smooth[c][t]));
        *q = toward(r, *q);
    }
}

/// Returns `q` or `-q`, whichever is nearer to `other`.
fn toward(q: Quaternion, other: Quaternion) -> Quaternion {
    if dot(q, other) < 0.0 { negated(q) } else { q }
}

fn negated(q: Quaternion) -> Quaternion {
    q.map(|c| -c)
}

/// Returns `q / |q|`; a sum without direction stays as it is.
fn normalized(q: Quaternion) -> Quaternion {
    let norm = dot(q, q).sqrt();
    if norm > 0.0 && norm.is_finite() { q.map(|c| c / norm) } else { q }
}

fn is_finite(q: &Quaternion) -> bool {
    q.iter().all(|c| c.is_finite())
}
