//! Motion primitives: stretches of captured motion between accents, each in a frame of its own.

use thiserror::Error;

use super::accent::{cuts, effort, energy, held_differences};
use super::activity::mid_rank;
use crate::motion::channels::Channel;
use crate::motion::kinematics::Poses;
use crate::motion::lowpass::lowpass;
use crate::motion::placement::Placement;
use crate::motion::quantile::median;
use crate::motion::quaternion::{
    Quaternion, angular_velocity, conj, from_axis_angle, make_sign_continuous, mul, normalize,
    rotate,
};
use crate::motion::spline::{CubicSpline, SplineError};
use crate::motion::trajectory::Trajectory;
use crate::motion::vector::norm;
use crate::units::{FPS, frames_to_s};

/// Shortest primitive, frames: 0.4 s.
pub const MIN_PRIMITIVE_FRAMES: usize = 12;
/// Longest primitive, frames: 2.5 s.
pub const MAX_PRIMITIVE_FRAMES: usize = 75;
/// Cutoff of the low-pass on captured positions and orientations, Hz.
pub const CAPTURE_LOWPASS_HZ: f64 = 6.0;
/// Lowest vertical component of the body's up axis at both ends of a primitive. A body that lies or
/// stands on its head has no heading at which another primitive could go on.
const MIN_UPRIGHT: f64 = 0.5;

pub const UP: [f64; 3] = [0.0, 1.0, 0.0];

/// Why a capture gives no primitive.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum PrimitiveError {
    /// Shorter than the shortest primitive.
    #[error(
        "capture has {n_frames} frames, and a primitive needs at least {} ({:.1} s); \
         use a longer take",
        MIN_PRIMITIVE_FRAMES + 1,
        frames_to_s(MIN_PRIMITIVE_FRAMES)
    )]
    TooShort { n_frames: usize },
    /// Never upright at both ends of a stretch.
    #[error(
        "capture is never upright long enough: the body's up axis is {upright:.2} of the vertical on \
         average, and a primitive begins and ends at {MIN_UPRIGHT} or more; check that +Y is up and \
         that the root's orientation is body to world"
    )]
    NeverUpright { upright: f64 },
    /// The frames cannot carry a spline.
    #[error(transparent)]
    Spline(#[from] SplineError),
}

/// One capture as curves in time.
#[derive(Clone, Debug)]
struct CaptureCurves {
    /// x, height above the capture's median, z; m.
    position: [CubicSpline; 3],
    orientation: [CubicSpline; 4],
    duration_s: f64,
}

/// A stretch of a capture between two cuts.
#[derive(Clone, Debug, PartialEq)]
pub struct Primitive {
    capture: usize,
    start_s: f64,
    /// Length at the captured speed, s.
    pub duration_s: f64,
    /// Where it begins in the capture.
    placement: Placement,
    /// Turn of the heading from its begin to its end, rad, whole turns included.
    pub turn_rad: f64,
    /// Mean of `(|v|² + ρ² |ω|²) / 2`, J per kg.
    pub energy: f64,
    /// Highest speed, m/s.
    pub top_speed_m_s: f64,
    /// Highest rate of turning about any axis, rad/s.
    pub top_turn_rad_s: f64,
}

/// The primitives of some captures.
#[derive(Clone, Debug, Default)]
pub struct Repertoire {
    captures: Vec<CaptureCurves>,
    primitives: Vec<Primitive>,
    /// Energies of all primitives, ascending.
    energies: Vec<f64>,
}

impl Repertoire {
    /// Returns a repertoire without primitives.
    pub fn new() -> Self {
        Self::default()
    }

    /// Cuts a capture into primitives and adds them; returns how many.
    ///
    /// Positions and orientations are low-passed at 6 Hz, and the take is cut at its ends and its
    /// accents. Every stretch between two cuts that lasts 0.4 to 2.5 s and begins and ends
    /// upright is a primitive, those that pass over an accent too.
    ///
    /// # Errors
    /// [`PrimitiveError`]; the repertoire is as it was then.
    pub fn add(&mut self, capture: &Trajectory) -> Result<usize, PrimitiveError> {
        let n_frames = capture.n_frames();
        if n_frames <= MIN_PRIMITIVE_FRAMES {
            return Err(PrimitiveError::TooShort { n_frames });
        }
        let poses = smooth(capture);
        let found = primitives(&poses, self.captures.len());
        if found.is_empty() {
            let upright = poses.orientation.iter().map(|&q| rotate(q, UP)[1]).sum::<f64>();
            return Err(PrimitiveError::NeverUpright { upright: upright / n_frames as f64 });
        }
        self.captures.push(CaptureCurves::fit(&poses)?);
        let n_found = found.len();
        // Two runs, of which the first is sorted: the sort merges them.
        self.energies.extend(found.iter().map(|p| p.energy));
        self.energies.sort_by(f64::total_cmp);
        self.primitives.extend(found);
        Ok(n_found)
    }

    /// Returns the primitives, in the order in which their captures were added.
    pub fn primitives(&self) -> &[Primitive] {
        &self.primitives
    }

    /// Returns how many captures gave primitives.
    pub fn n_captures(&self) -> usize {
        self.captures.len()
    }

    /// Returns the share of primitives with less energy, in [0, 1]; equal ones count half.
    pub fn energy_quantile(&self, energy: f64) -> f64 {
        mid_rank(&self.energies, energy)
    }

    /// Returns a primitive's path at times `at_s` from its begin, s at the captured speed.
    ///
    /// It begins over the origin with heading 0; heights are above the capture's median. Beyond the
    /// primitive the capture goes on, and beyond the capture its first or last pose stays.
    pub fn path(&self, primitive: &Primitive, at_s: &[f64]) -> Poses {
        let capture = &self.captures[primitive.capture];
        let clamped = |s: &f64| (primitive.start_s + s).clamp(0.0, capture.duration_s);
        let at_s: Vec<f64> = at_s.iter().map(clamped).collect();
        let [x, y, z] = capture.position.each_ref().map(|curve| curve.evaluate(&at_s));
        let q = capture.orientation.each_ref().map(|curve| curve.evaluate(&at_s));
        let Placement { x_m, z_m, yaw_rad } = primitive.placement;
        let back = from_axis_angle(UP, -yaw_rad);
        let position_m =
            (0..at_s.len()).map(|i| rotate(back, [x[i] - x_m, y[i], z[i] - z_m])).collect();
        let turned = |i: usize| mul(back, normalize(std::array::from_fn::<f64, 4, _>(|c| q[c][i])));
        Poses { position_m, orientation: (0..at_s.len()).map(turned).collect() }
    }
}

impl CaptureCurves {
    fn fit(poses: &Poses) -> Result<Self, SplineError> {
        let n_frames = poses.len();
        let times_s: Vec<f64> = (0..n_frames).map(frames_to_s).collect();
        let mut heights: Vec<f64> = poses.position_m.iter().map(|p| p[1]).collect();
        let usual_m = median(&mut heights).unwrap_or(0.0);
        let coordinate = |axis: usize| {
            let base_m = if axis == 1 { usual_m } else { 0.0 };
            let values: Vec<f64> = poses.position_m.iter().map(|p| p[axis] - base_m).collect();
            CubicSpline::fit(&times_s, &values)
        };
        let component = |c: usize| {
            let values: Vec<f64> = poses.orientation.iter().map(|q| q[c]).collect();
            CubicSpline::fit(&times_s, &values)
        };
        Ok(Self {
            position: [coordinate(0)?, coordinate(1)?, coordinate(2)?],
            orientation: [component(0)?, component(1)?, component(2)?, component(3)?],
            duration_s: frames_to_s(n_frames - 1),
        })
    }
}

/// Returns the low-passed poses of a capture, orientations unit and continuous in sign.
fn smooth(capture: &Trajectory) -> Poses {
    let signal = |channel: Channel, i: usize| {
        let mut x: Vec<f64> =
            capture.channel(channel).column(i).iter().map(|&x| f64::from(x)).collect();
        lowpass(&mut x, CAPTURE_LOWPASS_HZ, FPS);
        x
    };
    let p: [Vec<f64>; 3] = std::array::from_fn(|axis| signal(Channel::Position, axis));
    let mut orientation: Vec<Quaternion> = capture
        .channel(Channel::Quaternion)
        .rows()
        .into_iter()
        .map(|q| normalize(std::array::from_fn(|c| f64::from(q[c]))))
        .collect();
    make_sign_continuous(&mut orientation);
    let mut poses = Poses {
        position_m: (0..capture.n_frames()).map(|t| std::array::from_fn(|i| p[i][t])).collect(),
        orientation,
    };
    lowpass_orientation(&mut poses.orientation, CAPTURE_LOWPASS_HZ);
    poses
}

/// Low-passes orientations with continuous signs, component by component.
pub fn lowpass_orientation(orientation: &mut [Quaternion], cutoff_hz: f64) {
    for c in 0..4 {
        let mut x: Vec<f64> = orientation.iter().map(|q| q[c]).collect();
        lowpass(&mut x, cutoff_hz, FPS);
        orientation.iter_mut().zip(x).for_each(|(q, x)| q[c] = x);
    }
    orientation.iter_mut().for_each(|q| *q = normalize(*q));
}

/// Returns the primitives of capture number `capture`.
fn primitives(poses: &Poses, capture: usize) -> Vec<Primitive> {
    let velocity = held_differences(&poses.position_m);
    let mut omega: Vec<[f64; 3]> =
        poses.orientation.windows(2).map(|q| angular_velocity(q[0], q[1], FPS)).collect();
    omega.extend(omega.last().copied());
    let energy = energy(&velocity, &omega);
    let headings = headings(&poses.orientation);
    let cuts = cuts(&effort(&velocity, &omega), MAX_PRIMITIVE_FRAMES);
    let is_upright = |t: usize| rotate(poses.orientation[t], UP)[1] >= MIN_UPRIGHT;
    let top = |x: &[[f64; 3]]| x.iter().copied().map(norm).fold(0.0, f64::max);
    let mut found = Vec::new();
    for (i, &start) in cuts.iter().enumerate().filter(|&(_, &start)| is_upright(start)) {
        let ends = cuts[i + 1..].iter().take_while(|&&end| end - start <= MAX_PRIMITIVE_FRAMES);
        for &end in ends.filter(|&&end| end - start >= MIN_PRIMITIVE_FRAMES && is_upright(end)) {
            found.push(Primitive {
                capture,
                start_s: frames_to_s(start),
                duration_s: frames_to_s(end - start),
                placement: Placement::of(poses.position_m[start], poses.orientation[start]),
                turn_rad: headings[end] - headings[start],
                energy: energy[start..end].iter().sum::<f64>() / (end - start) as f64,
                top_speed_m_s: top(&velocity[start..end]),
                top_turn_rad_s: top(&omega[start..end]),
            });
        }
    }
    found
}

/// Returns the heading of every orientation, rad, without jumps of whole turns.
pub(super) fn headings(orientation: &[Quaternion]) -> Vec<f64> {
    let yaw = |q: Quaternion| Placement::of([0.0; 3], q).yaw_rad;
    let mut heading = orientation.first().map_or(0.0, |&q| yaw(q));
    let steps = orientation.windows(2).map(|q| yaw(mul(conj(q[0]), q[1])));
    let exact = orientation.iter().map(|&q| yaw(q));
    // The steps tell how often the body went round, the yaws where it ended.
    std::iter::once(0.0)
        .chain(steps)
        .zip(exact)
        .map(|(step, exact)| {
            heading += step;
            let turns = ((heading - exact) / std::f64::consts::TAU).round();
            heading = exact + turns * std::f64::consts::TAU;
            heading
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::kinematics::frames_of;
    use std::f64::consts::TAU;

    /// Walks forward in steps of 20 frames (0.2 to 1.2 m/s), turning by `turn_rad_s`.
    fn steps(n: usize, yaw_rad: f64, turn_rad_s: f64) -> Trajectory {
        let (mut x, mut z) = (5.0, -4.0);
        let mut poses = Poses::default();
        for t in 0..n + 2 {
            let yaw = yaw_rad + turn_rad_s * t as f64 / FPS;
            poses.position_m.push([x, 0.9 + 0.05 * (TAU * t as f64 / 20.0).cos(), z]);
            poses.orientation.push(from_axis_angle(UP, yaw));
            let speed = 0.7 - 0.5 * (TAU * t as f64 / 20.0).cos();
            x += speed * yaw.sin() / FPS;
            z += speed * yaw.cos() / FPS;
        }
        make_sign_continuous(&mut poses.orientation);
        Trajectory::new(frames_of(&poses, n)).unwrap()
    }

    #[test]
    fn primitives_run_from_accent_to_accent_in_their_own_frame() {
        let mut repertoire = Repertoire::new();
        let n = repertoire.add(&steps(121, 2.0, 0.0)).unwrap();
        assert_eq!((n, repertoire.n_captures()), (repertoire.primitives().len(), 1));
        for p in repertoire.primitives() {
            let n_frames = (p.duration_s * FPS).round() as usize;
            assert!((MIN_PRIMITIVE_FRAMES..=MAX_PRIMITIVE_FRAMES).contains(&n_frames));
            // Whole steps of 20 frames, but for the bent ends of the low-pass.
            assert!(n_frames.abs_diff(n_frames.div_ceil(20) * 20) % 20 <= 3, "{n_frames}");
            let at_s: Vec<f64> = (0..=n_frames).map(frames_to_s).collect();
            let path = repertoire.path(p, &at_s);
            let (first, last) = (path.position_m[0], path.position_m[n_frames]);
            assert!(first[0].abs() < 1e-9 && first[2].abs() < 1e-9, "{first:?}");
            // 0.7 m/s straight ahead, whatever the heading in the capture was.
            assert!((last[2] - 0.7 * p.duration_s).abs() < 0.1, "{last:?} {p:?}");
            assert!(last[0].abs() < 0.01 && p.turn_rad.abs() < 1e-6, "{last:?} {p:?}");
            let q = path.orientation[0];
            assert!((q[0] - 1.0).abs() < 1e-9, "{q:?}");
            // Mean of (0.7 - 0.5 cos)² / 2 over whole steps: (0.49 + 0.125) / 2, and 6 % less after
            // the low-pass; the height's own share is (0.05 · 2π · 1.5)² / 4 = 0.056.
            assert!((0.25..0.42).contains(&p.energy), "{}", p.energy);
        }
        // Every accent is 20 frames from the next, so spans of 20, 40 and 60 frames fit.
        assert!(n >= 9, "{n}");
    }

    #[test]
    fn turns_count_whole_rounds() {
        let mut repertoire = Repertoire::new();
        repertoire.add(&steps(121, 1.0, 6.0)).unwrap();
        for p in repertoire.primitives() {
            assert!((p.turn_rad - 6.0 * p.duration_s).abs() < 0.2, "{p:?}");
            assert!((p.top_turn_rad_s - 6.0).abs() < 0.5, "{p:?}");
        }
        let most = repertoire.primitives().iter().map(|p| p.turn_rad).fold(0.0, f64::max);
        assert!(most > TAU, "{most}");
    }

    #[test]
    fn quantiles_are_ranks_among_all_primitives() {
        let mut repertoire = Repertoire::new();
        repertoire.add(&steps(91, 0.0, 0.0)).unwrap();
        repertoire.add(&steps(91, 0.0, 9.0)).unwrap();
        assert_eq!(repertoire.energy_quantile(0.0), 0.0);
        assert_eq!(repertoire.energy_quantile(1e9), 1.0);
        let spinning = repertoire.primitives().last().unwrap();
        assert!(repertoire.energy_quantile(spinning.energy) > 0.5);
        assert_eq!(repertoire.n_captures(), 2);
    }

    #[test]
    fn what_has_no_primitive_says_why() {
        let mut repertoire = Repertoire::new();
        assert_eq!(
            repertoire.add(&steps(12, 0.0, 0.0)).unwrap_err().to_string(),
            "capture has 12 frames, and a primitive needs at least 13 (0.4 s); use a longer take"
        );
        let lying = {
            let mut frames = steps(61, 0.0, 0.0).into_array();
            let q = from_axis_angle([1.0, 0.0, 0.0], 2.0);
            for mut row in frames.rows_mut() {
                (0..4).for_each(|c| row[9 + c] = q[c] as f32);
            }
            Trajectory::new(frames).unwrap()
        };
        assert_eq!(
            repertoire.add(&lying).unwrap_err().to_string(),
            "capture is never upright long enough: the body's up axis is -0.42 of the vertical on \
             average, and a primitive begins and ends at 0.5 or more; check that +Y is up and that \
             the root's orientation is body to world"
        );
        assert!(repertoire.primitives().is_empty() && repertoire.n_captures() == 0);
    }
}
