//! Motion with errors of known variances, for tests.

use ndarray::Array2;

use super::fusion::{Displacement, FusionMeasurements, HeldPoses};
use super::variances::{AxisVariances, FusionVariances};
use crate::chance::Draws;
use crate::motion::channels::MOTION_DIM;
use crate::motion::kinematics::Poses;
use crate::motion::quaternion::{
    Quaternion, angular_velocity, from_axis_angle, from_rotation_vector, mul,
};
use crate::units::FPS;

pub const NONE: HeldPoses = HeldPoses { position: Vec::new(), orientation: Vec::new() };

/// Different on every group and axis.
pub const VARIANCES: FusionVariances = FusionVariances {
    position_m2: AxisVariances { horizontal: 4e-4, vertical: 1e-4 },
    velocity_m2_s2: AxisVariances { horizontal: 0.02, vertical: 0.05 },
    acceleration_m2_s4: AxisVariances { horizontal: 3.0, vertical: 7.0 },
    orientation_rad2: AxisVariances { horizontal: 3e-3, vertical: 1e-2 },
    angular_velocity_rad2_s2: AxisVariances { horizontal: 0.08, vertical: 0.03 },
};

/// Normal numbers, the same for the same seed (Box and Muller).
pub struct Noise(Draws);

impl Noise {
    pub fn new(seed: u64) -> Self {
        Self(Draws::new(seed))
    }

    pub fn normal(&mut self) -> f64 {
        let (u, v) = (1.0 - self.0.uniform(), self.0.uniform());
        (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
    }

    pub fn vector(&mut self, variance: &AxisVariances) -> [f64; 3] {
        std::array::from_fn(|axis| variance.of_axis(axis).sqrt() * self.normal())
    }
}

/// A walk on a bow that bobs, and turns and leans, by up to a fifth of a radian a frame: six whole turns.
pub fn truth(n: usize) -> Poses {
    let position = |t: f64| [0.3 * (0.11 * t).sin(), 0.9 + 0.05 * (0.5 * t).sin(), 0.02 * t];
    let lean = |t: f64| from_axis_angle([0.6, 0.0, 0.8], 0.4 * (0.17 * t).sin());
    let turn = |t: f64| from_axis_angle([0.0, 1.0, 0.0], 0.19 * t);
    let times: Vec<f64> = (0..n).map(|t| t as f64).collect();
    Poses {
        position_m: times.iter().map(|t| position(*t)).collect(),
        orientation: times.iter().map(|t| mul(turn(*t), lean(*t))).collect(),
    }
}

/// Returns the output of a decoder without any error for poses, in double precision.
pub fn exact(poses: &Poses) -> FusionMeasurements {
    let held = |x: &dyn Fn(usize) -> [f64; 3], n: usize, lost: usize| -> Vec<[f64; 3]> {
        (0..n).map(|t| if n > lost { x(t.min(n - 1 - lost)) } else { [0.0; 3] }).collect()
    };
    let (p, q) = (&poses.position_m, &poses.orientation);
    let v = |t: usize| std::array::from_fn(|i| FPS * (p[t + 1][i] - p[t][i]));
    let a = |t: usize| std::array::from_fn(|i| FPS * (v(t + 1)[i] - v(t)[i]));
    let n = poses.len();
    FusionMeasurements {
        position: p.clone(),
        velocity: held(&v, n, 1),
        acceleration: held(&a, n, 2),
        orientation: q.clone(),
        angular_velocity: held(&|t| angular_velocity(q[t], q[t + 1], FPS), n, 1),
    }
}

/// Adds errors of some variances to every channel, and flips a sign now and then.
pub fn noisy(poses: &Poses, variances: &FusionVariances, seed: u64) -> FusionMeasurements {
    let mut noise = Noise::new(seed);
    let mut measured = exact(poses);
    let groups = [
        (&mut measured.position, &variances.position_m2),
        (&mut measured.velocity, &variances.velocity_m2_s2),
        (&mut measured.acceleration, &variances.acceleration_m2_s4),
        (&mut measured.angular_velocity, &variances.angular_velocity_rad2_s2),
    ];
    for (vectors, variance) in groups {
        for x in vectors {
            let error = noise.vector(variance);
            *x = std::array::from_fn(|axis| x[axis] + error[axis]);
        }
    }
    for q in &mut measured.orientation {
        let error = from_rotation_vector(noise.vector(&variances.orientation_rad2));
        let sign = if noise.0.uniform() < 0.3 { -1.0 } else { 1.0 };
        *q = mul(error, *q).map(|c| sign * c);
    }
    measured
}

/// Rows of \[p 3, v 3, a 3, q 4, ω 3\] as motion, the rest 0.
pub fn frames(measured: &FusionMeasurements) -> Array2<f32> {
    let mut frames = Array2::zeros((measured.position.len(), MOTION_DIM));
    for t in 0..frames.nrows() {
        let row = [
            &measured.position[t][..],
            &measured.velocity[t],
            &measured.acceleration[t],
            &measured.orientation[t],
            &measured.angular_velocity[t],
        ];
        for (i, x) in row.concat().into_iter().enumerate() {
            frames[[t, i]] = x as f32;
        }
    }
    frames
}

pub fn fused(
    measured: &FusionMeasurements,
    variances: &FusionVariances,
    held: &HeldPoses,
) -> Vec<[f64; 3]> {
    let shifts = measured.shifts(variances, held);
    let sum = |(p, d): (&[f64; 3], &[f64; 3])| std::array::from_fn(|i| p[i] + d[i]);
    measured.position.iter().zip(&shifts).map(sum).collect()
}

/// Mean square of the distances along one axis.
pub fn mean_square(a: &[[f64; 3]], b: &[[f64; 3]], axis: usize) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a[axis] - b[axis]).powi(2)).sum::<f64>() / a.len() as f64
}

/// The largest angle between orientations, rad.
pub fn farthest(a: &[Quaternion], b: &[Quaternion]) -> f64 {
    assert_eq!(a.len(), b.len());
    a.iter().zip(b).map(|(a, b)| Displacement::angle(a, b)).fold(0.0, f64::max)
}
