//! Where every dancer's place is at every moment, and how far from it a dancer may step.

use super::formation::{least_distance_m, pairs};
use super::plan::GroupSpan;
use crate::motion::group::RADIUS_M;
use crate::motion::placement::Placement;
use crate::motion::style::Window;
use crate::units::frames_to_s;

/// Kept between two bodies beyond their radii, m.
const MARGIN_M: f64 = 0.02;
/// Furthest that a dancer steps from its place, m.
const MAX_LEEWAY_M: f64 = 0.6;
/// Time in which the leeway changes, before a way and after it: as many frames on either side.
const LEEWAY_FRAMES: usize = 15;

/// Returns the place of dancer `k` in span `i` at a time of the song.
///
/// Everybody goes straight, at the same share of the way: `p = a + s (b - a)`; headings likewise, past
/// the audience.
pub fn place(spans: &[GroupSpan], i: usize, k: usize, at_s: f64) -> Placement {
    let to = spans[i].places[k];
    let Some(from) = i.checked_sub(1).map(|before| spans[before].places[k]) else { return to };
    let s = spans[i].arrived(at_s);
    Placement {
        x_m: from.x_m + s * (to.x_m - from.x_m),
        z_m: from.z_m + s * (to.z_m - from.z_m),
        yaw_rad: from.yaw_rad + s * (to.yaw_rad - from.yaw_rad),
    }
}

/// Returns how far from its place a dancer may be at every frame, m, so that no two bodies touch.
///
/// While the least distance of two places is `c`, bodies of radius `r` within `(c - 2r) / 2` of them stay
/// apart. The leeway is the least of this over a second about a frame, smoothed over the same second;
/// neither takes it above what the frame itself allows.
pub fn leeway_m(spans: &[GroupSpan], n_poses: usize) -> Vec<f64> {
    let mut allowed = Vec::with_capacity(n_poses);
    for (i, span) in spans.iter().enumerate() {
        let before = i.checked_sub(1).map(|before| &spans[before]);
        let standing = leeway_of(least_distance_m(&span.places));
        let going =
            before.map_or(standing, |b| leeway_of(least_on_ways_m(&b.places, &span.places)));
        let end = if i + 1 == spans.len() { n_poses } else { span.end_frame.min(n_poses) };
        let is_going = |t: usize| frames_to_s(t) <= span.arrival_s;
        allowed.extend((allowed.len()..end).map(|t| if is_going(t) { going } else { standing }));
    }
    let least = |t: usize| {
        let around = t.saturating_sub(LEEWAY_FRAMES)..(t + LEEWAY_FRAMES + 1).min(allowed.len());
        allowed[around].iter().copied().fold(f64::INFINITY, f64::min)
    };
    let least: Vec<f64> = (0..allowed.len()).map(least).collect();
    Window::hann(2 * LEEWAY_FRAMES + 1).mean(&least)
}

fn leeway_of(least_m: f64) -> f64 {
    ((least_m - 2.0 * RADIUS_M - MARGIN_M) / 2.0).clamp(0.0, MAX_LEEWAY_M)
}

/// Returns the least distance of two dancers who go straight from place to place in the same time, m.
fn least_on_ways_m(from: &[Placement], to: &[Placement]) -> f64 {
    let between = |a: &Placement, b: &Placement| [b.x_m - a.x_m, b.z_m - a.z_m];
    let least = |(i, j): (usize, usize)| {
        let (a, b) = (between(&from[i], &from[j]), between(&to[i], &to[j]));
        let d = [b[0] - a[0], b[1] - a[1]];
        let size = d[0] * d[0] + d[1] * d[1];
        // The nearest point of the segment from a to b to the origin.
        let u =
            if size > 0.0 { (-(a[0] * d[0] + a[1] * d[1]) / size).clamp(0.0, 1.0) } else { 0.0 };
        (a[0] + u * d[0]).hypot(a[1] + u * d[1])
    };
    pairs(from.len()).map(least).fold(f64::INFINITY, f64::min)
}

/// Returns a step from the place, kept within `leeway_m` of it: `r / √(1 + |r|² / l²)`.
pub fn within_leeway(step_m: [f64; 2], leeway_m: f64) -> [f64; 2] {
    if leeway_m <= 0.0 {
        return [0.0; 2];
    }
    let ratio = step_m[0].hypot(step_m[1]) / leeway_m;
    let gain = 1.0 / ratio.hypot(1.0);
    step_m.map(|x| x * gain)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_never_leave_their_leeway() {
        for (step, leeway) in [([0.1, 0.0], 0.5), ([3.0, -4.0], 0.3), ([0.0, 0.0], 0.2)] {
            let kept = within_leeway(step, leeway);
            let (size, was) = (kept[0].hypot(kept[1]), step[0].hypot(step[1]));
            assert!(size <= leeway && size <= was, "{kept:?}");
            let wanted = was * leeway / (was * was + leeway * leeway).sqrt();
            assert!((size - wanted).abs() < 1e-12, "{size} for {wanted}");
        }
        assert_eq!(within_leeway([1.0, 2.0], 0.0), [0.0, 0.0]);
    }

    #[test]
    fn the_least_distance_on_ways_is_where_they_cross() {
        let at = |x_m: f64, z_m: f64| Placement { x_m, z_m, yaw_rad: 0.0 };
        // One stands, the other passes at 0.8 m.
        let (from, to) = ([at(0.0, 0.0), at(-3.0, 0.8)], [at(0.0, 0.0), at(3.0, 0.8)]);
        assert!((least_on_ways_m(&from, &to) - 0.8).abs() < 1e-12);
        let stays = [at(0.0, 0.0), at(0.0, 2.0)];
        assert!((least_on_ways_m(&stays, &stays) - 2.0).abs() < 1e-12);
        assert!((leeway_of(1.6) - 0.44).abs() < 1e-12);
        assert_eq!((leeway_of(0.5), leeway_of(f64::INFINITY)), (0.0, 0.6));
    }
}
