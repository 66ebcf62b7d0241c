//! Geometric features: the fraction of frames for which each of sixteen predicates holds.
//!
//! After the features of skeletons of Müller, Röder and Clausen ("Efficient content-based retrieval of motion
//! capture data", 2005), put into terms of one rigid body. Thresholds come from the ground truth and are kept
//! with it, so that two models are asked the same.

use serde::{Deserialize, Serialize};

use crate::motion::Poses;
use crate::motion::kinematics::forward_differences;
use crate::motion::quantile::percentile;
use crate::motion::quaternion::{conj, rotate};
use crate::units::FPS;

use super::body::turn_rates;
use crate::motion::vector::{cross, inner, norm};

/// Speed below which a body stands still and has no direction, m/s.
pub const STILL_M_S: f64 = 0.05;
/// Rate of turning about an axis of the body that counts, degrees per second.
pub const TURN_RATE_DEG_S: f64 = 45.0;
/// Angle between the body's up and the world's that counts, degrees.
pub const TILT_DEG: f64 = 30.0;
/// Cosine between velocity and an axis of the body from which the body moves along it.
pub const ALONG_COSINE: f64 = 0.7;

/// Nearer to the centre of its path than this a body is in it, m.
const MIN_RADIUS_M: f64 = 1e-9;

/// Names of [`geometric_features`].
pub const GEOMETRIC_NAMES: [&str; 16] = [
    "speed_above_q50",
    "speed_above_q90",
    "still",
    "climbing_or_diving",
    "yawing",
    "pitching",
    "rolling",
    "tilted",
    "forward",
    "backward",
    "sideways",
    "radial",
    "curved",
    "low",
    "high",
    "speeding_up",
];

/// Thresholds of the features, quantiles of the ground truth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GeometricThresholds {
    /// Median speed.
    pub speed_q50_m_s: f64,
    pub speed_q90_m_s: f64,
    /// Of the size of vertical velocity.
    pub vertical_speed_q75_m_s: f64,
    /// Of the size of horizontal velocity to or from the centre of the path.
    pub radial_speed_q75_m_s: f64,
    /// Of the curvature of the path, 1/m; 0 where the body stands still.
    pub curvature_q75_per_m: f64,
    pub height_q25_m: f64,
    pub height_q75_m: f64,
    /// Of the rate of change of speed.
    pub speeding_q75_m_s2: f64,
}

impl GeometricThresholds {
    /// Takes the quantiles over all frames of the ground truth, given in chunks; none without frames.
    pub fn fit<'a>(chunks: impl IntoIterator<Item = &'a Poses>) -> Option<Self> {
        let all: Vec<Quantities> = chunks.into_iter().flat_map(quantities).collect();
        let quantile = |quantity: fn(&Quantities) -> f64, p: f64| {
            percentile(&mut all.iter().map(quantity).collect::<Vec<_>>(), p)
        };
        Some(Self {
            speed_q50_m_s: quantile(|x| x.speed, 50.0)?,
            speed_q90_m_s: quantile(|x| x.speed, 90.0)?,
            vertical_speed_q75_m_s: quantile(|x| x.vertical_speed, 75.0)?,
            radial_speed_q75_m_s: quantile(|x| x.radial_speed, 75.0)?,
            curvature_q75_per_m: quantile(|x| x.curvature, 75.0)?,
            height_q25_m: quantile(|x| x.height, 25.0)?,
            height_q75_m: quantile(|x| x.height, 75.0)?,
            speeding_q75_m_s2: quantile(|x| x.speeding, 75.0)?,
        })
    }

    /// Returns whether each predicate holds for a frame, in the order of [`GEOMETRIC_NAMES`].
    fn hold(&self, x: &Quantities) -> [bool; 16] {
        let turns = |axis: usize| x.turn_rate[axis] > TURN_RATE_DEG_S.to_radians();
        [
            x.speed > self.speed_q50_m_s,
            x.speed > self.speed_q90_m_s,
            x.speed <= STILL_M_S,
            x.vertical_speed > self.vertical_speed_q75_m_s,
            turns(1),
            turns(0),
            turns(2),
            x.upright < TILT_DEG.to_radians().cos(),
            x.along > ALONG_COSINE,
            x.along < -ALONG_COSINE,
            x.aside > ALONG_COSINE,
            x.radial_speed > self.radial_speed_q75_m_s,
            x.curvature > self.curvature_q75_per_m,
            x.height < self.height_q25_m,
            x.height > self.height_q75_m,
            x.speeding > self.speeding_q75_m_s2,
        ]
    }
}

/// Returns the fraction of the frames of a chunk for which each of [`GEOMETRIC_NAMES`] holds, in [0, 1].
///
/// Climbing and diving are one feature, as are outward and inward: over a chunk a body that keeps its height
/// and its place does as much of either. None for fewer than three frames.
pub fn geometric_features(poses: &Poses, thresholds: &GeometricThresholds) -> Option<[f64; 16]> {
    let all = quantities(poses);
    if all.is_empty() {
        return None;
    }
    let mut counts = [0_usize; 16];
    for x in &all {
        for (count, holds) in counts.iter_mut().zip(thresholds.hold(x)) {
            *count += usize::from(holds);
        }
    }
    Some(counts.map(|count| count as f64 / all.len() as f64))
}

/// The quantities of one frame that the features are computed from.
struct Quantities {
    speed: f64,
    vertical_speed: f64,
    /// Size of the rate about the body's x (pitch), y (yaw) and z (roll), rad/s.
    turn_rate: [f64; 3],
    /// Cosine between the body's up and the world's.
    upright: f64,
    /// Cosine between velocity and the body's forward.
    along: f64,
    /// Size of the cosine between velocity and the body's right.
    aside: f64,
    radial_speed: f64,
    curvature: f64,
    height: f64,
    speeding: f64,
}

/// Measures all frames that have forward differences of both orders: two fewer.
fn quantities(poses: &Poses) -> Vec<Quantities> {
    let n = poses.len();
    let p = &poses.position_m[..n];
    let velocity = forward_differences(p);
    let acceleration = forward_differences(&velocity);
    let turns = turn_rates(&poses.orientation[..n]);
    let centre = [0, 2].map(|axis| p.iter().map(|p| p[axis]).sum::<f64>() / n as f64);
    let measure = |t: usize| {
        let (q, v) = (poses.orientation[t], velocity[t]);
        let speed = norm(v);
        let moves = speed > STILL_M_S;
        let cosine = |axis: [f64; 3]| if moves { inner(v, rotate(q, axis)) / speed } else { 0.0 };
        let outward = [p[t][0] - centre[0], p[t][2] - centre[1]];
        let radius = outward[0].hypot(outward[1]);
        let in_centre = radius < MIN_RADIUS_M;
        Quantities {
            speed,
            vertical_speed: v[1].abs(),
            turn_rate: rotate(conj(q), turns[t]).map(f64::abs),
            upright: rotate(q, [0.0, 1.0, 0.0])[1],
            along: cosine([0.0, 0.0, 1.0]),
            aside: cosine([1.0, 0.0, 0.0]).abs(),
            radial_speed: if in_centre {
                0.0
            } else {
                ((outward[0] * v[0] + outward[1] * v[2]) / radius).abs()
            },
            curvature: if moves { norm(cross(v, acceleration[t])) / speed.powi(3) } else { 0.0 },
            height: p[t][1],
            speeding: (norm(velocity[t + 1]) - speed) * FPS,
        }
    };
    (0..acceleration.len()).map(measure).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::{IDENTITY, from_axis_angle};

    const THRESHOLDS: GeometricThresholds = GeometricThresholds {
        speed_q50_m_s: 0.5,
        speed_q90_m_s: 1.5,
        vertical_speed_q75_m_s: 0.2,
        radial_speed_q75_m_s: 0.3,
        curvature_q75_per_m: 0.8,
        height_q25_m: 0.9,
        height_q75_m: 1.1,
        speeding_q75_m_s2: 0.5,
    };

    fn shares(poses: &Poses) -> Vec<&'static str> {
        let found = geometric_features(poses, &THRESHOLDS).expect("frames");
        assert!(found.iter().all(|x| *x == 0.0 || *x == 1.0), "{found:?}");
        GEOMETRIC_NAMES.into_iter().zip(found).filter(|(_, x)| *x > 0.0).map(|(n, _)| n).collect()
    }

    /// At 1 m/s round a circle of 1 m, facing where it goes.
    fn circle(n: usize) -> Poses {
        let angle = |t: usize| t as f64 / FPS;
        Poses {
            position_m: (0..n).map(|t| [angle(t).sin(), 1.0, angle(t).cos()]).collect(),
            orientation: (0..n)
                // Forward is half a step ahead of the tangent at the frame, as the difference is.
                .map(|t| {
                    let heading = angle(t) + 0.5 / FPS + std::f64::consts::FRAC_PI_2;
                    from_axis_angle([0.0, 1.0, 0.0], heading)
                })
                .collect(),
        }
    }

    #[test]
    fn a_circle_is_curved_and_yaws() {
        // Whole circles only have their mean at the centre: 188.5 frames a turn.
        assert_eq!(shares(&circle(754)), ["speed_above_q50", "yawing", "forward", "curved"]);
    }

    #[test]
    fn a_body_that_only_tilts_stands_still() {
        let tilted = from_axis_angle([1.0, 0.0, 0.0], 0.6);
        let poses = Poses { position_m: vec![[0.0, 0.5, 0.0]; 7], orientation: vec![tilted; 7] };
        assert_eq!(shares(&poses), ["still", "tilted", "low"]);
    }

    #[test]
    fn a_body_that_speeds_up_sideways_climbs_out() {
        // 2 m/s along x and growing by 1 m/s²; the centre of its path lies far behind only at the end.
        let time_s = |t: usize| t as f64 / FPS;
        let x = |t: usize| 2.0 * time_s(t) + 0.5 * time_s(t).powi(2);
        let n = 31;
        let poses = Poses {
            position_m: (0..n).map(|t| [x(t), 1.2 + 0.3 * time_s(t), 0.0]).collect(),
            orientation: (0..n)
                .map(|t| from_axis_angle([0.0, 0.0, 1.0], 1.0 * time_s(t)))
                .collect(),
        };
        let found = geometric_features(&poses, &THRESHOLDS).expect("frames");
        let feature =
            |name: &str| found[GEOMETRIC_NAMES.iter().position(|n| *n == name).expect("a feature")];
        for name in ["speed_above_q50", "speed_above_q90", "climbing_or_diving", "rolling"] {
            assert_eq!(feature(name), 1.0, "{name}");
        }
        for name in ["radial", "high", "speeding_up"] {
            assert_eq!(feature(name), 1.0, "{name}");
        }
        assert_eq!(
            (feature("yawing"), feature("pitching"), feature("forward"), feature("curved")),
            (0.0, 0.0, 0.0, 0.0)
        );
        assert!(feature("sideways") > 0.5, "as long as the roll leaves x aside");
    }

    #[test]
    fn thresholds_are_quantiles_of_all_frames() {
        // Speeds 0, 1, 2, 3 and 4 m/s along z in turn, two frames each but for the last.
        let mut z = 0.0;
        let mut position_m = vec![[0.0, 1.0, 0.0]];
        for step in [0.0, 0.0, 1.0, 1.0, 2.0, 2.0, 3.0, 3.0, 4.0, 4.0] {
            z += step / FPS;
            position_m.push([0.0, 1.0, z]);
        }
        let n = position_m.len();
        let poses = Poses { position_m, orientation: vec![IDENTITY; n] };
        let found = GeometricThresholds::fit([&poses]).expect("frames");
        // Nine frames have differences of both orders: the median is the fifth speed.
        assert!((found.speed_q50_m_s - 2.0).abs() < 1e-9, "{found:?}");
        assert!((found.speed_q90_m_s - (3.0 + 0.2)).abs() < 1e-9, "{found:?}");
        assert_eq!((found.height_q25_m, found.height_q75_m), (1.0, 1.0));
        assert!(found.curvature_q75_per_m < 1e-9 && found.vertical_speed_q75_m_s == 0.0);
        assert!((found.speeding_q75_m_s2 - FPS).abs() < 1e-9, "{found:?}");
    }

    #[test]
    fn two_frames_have_no_features() {
        assert_eq!(geometric_features(&circle(2), &THRESHOLDS), None);
        assert_eq!(GeometricThresholds::fit([&circle(2)]), None);
        let text = serde_json::to_string(&THRESHOLDS).expect("numbers");
        assert_eq!(serde_json::from_str::<GeometricThresholds>(&text).expect("same"), THRESHOLDS);
    }
}
