//! How fast a body moves and turns, and motion that is held to it.

use ndarray::ArrayView2;
use serde::{Deserialize, Serialize};

use super::channels::Channel;
use super::quantile::percentile;
use super::quaternion::{Quaternion, dot, slerp};
use crate::units::FPS;

/// Percentile of the frames of a set of motions that counts as its highest rate.
pub const RANGE_PERCENT: f64 = 99.9;

/// Steps are held this much below a limit, so that what f32 keeps of a position is below it too.
const MARGIN: f64 = 1e-4;
/// Passes over a motion; a stretch that is too fast spreads by a frame with each.
const MAX_PASSES: usize = 500;

/// How fast the motion of a set is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotionRange {
    /// 99.9th percentile of `|v|` over frames.
    pub speed_m_s: f64,
    /// 99.9th percentile of `|ω|` over frames.
    pub turn_rate_rad_s: f64,
}

impl MotionRange {
    /// Takes the percentiles over all frames of motions, `[T, 25]` each; none without frames or where a
    /// value is not finite.
    pub fn fit<'a>(motions: impl IntoIterator<Item = ArrayView2<'a, f32>>) -> Option<Self> {
        let (mut speeds, mut turn_rates) = (Vec::new(), Vec::new());
        for frames in motions {
            speeds.extend(sizes(frames, Channel::Velocity));
            turn_rates.extend(sizes(frames, Channel::AngularVelocity));
        }
        if speeds.iter().chain(&turn_rates).any(|x| !x.is_finite()) {
            return None;
        }
        Some(Self {
            speed_m_s: percentile(&mut speeds, RANGE_PERCENT)?,
            turn_rate_rad_s: percentile(&mut turn_rates, RANGE_PERCENT)?,
        })
    }

    /// Whether motion can be held to it.
    pub fn is_sound(&self) -> bool {
        let is_rate = |x: f64| x.is_finite() && x > 0.0;
        is_rate(self.speed_m_s) && is_rate(self.turn_rate_rad_s)
    }

    /// Holds positions, m, so that none is farther from the next than the highest speed allows.
    ///
    /// Two frames that are too far apart are brought together by the same amount each, pass after pass,
    /// until all keep the limit; frames elsewhere stay as they are. Source: Müller et al., "Position Based
    /// Dynamics", 2007, distance constraints. What is not finite is passed over.
    pub fn limit_positions(&self, position_m: &mut [[f64; 3]]) {
        let most = (1.0 - MARGIN) * self.speed_m_s / FPS;
        relax(position_m.len(), |t| {
            let (a, b) = (position_m[t], position_m[t + 1]);
            let d: [f64; 3] = std::array::from_fn(|i| b[i] - a[i]);
            let size = d.iter().map(|x| x * x).sum::<f64>().sqrt();
            if !(size.is_finite() && size > most) {
                return false;
            }
            let share = (size - most) / (2.0 * size);
            for i in 0..3 {
                position_m[t][i] += share * d[i];
                position_m[t + 1][i] -= share * d[i];
            }
            size > most * (1.0 + MARGIN / 2.0)
        });
    }

    /// Holds unit orientations so that none is farther from the next than the highest turn rate allows; as
    /// for positions, on the shorter way. Every frame keeps its sign.
    pub fn limit_orientations(&self, orientation: &mut [Quaternion]) {
        let most = (1.0 - MARGIN) * self.turn_rate_rad_s / FPS;
        relax(orientation.len(), |t| {
            let (a, b) = (orientation[t], orientation[t + 1]);
            let angle = 2.0 * dot(a, b).abs().min(1.0).acos();
            if !(angle.is_finite() && angle > most) {
                return false;
            }
            let share = (angle - most) / (2.0 * angle);
            let near = |q: Quaternion, to: Quaternion| {
                if dot(q, to) < 0.0 { to.map(|c| -c) } else { to }
            };
            orientation[t] = slerp(a, near(a, b), share);
            orientation[t + 1] = slerp(b, near(b, a), share);
            angle > most * (1.0 + MARGIN / 2.0)
        });
    }
}

/// Calls `mend` with every pair of neighbours, forth and back, until it finds nothing to mend.
fn relax(n: usize, mut mend: impl FnMut(usize) -> bool) {
    let pairs = n.saturating_sub(1);
    for _ in 0..MAX_PASSES {
        let mut has_mended = false;
        for t in (0..pairs).chain((0..pairs).rev()) {
            has_mended |= mend(t);
        }
        if !has_mended {
            return;
        }
    }
}

/// Returns the lengths of a channel of three columns, frame by frame.
pub fn sizes(frames: ArrayView2<f32>, channel: Channel) -> Vec<f64> {
    let size = |row: ndarray::ArrayView1<f32>| {
        channel.range().map(|i| f64::from(row[i]).powi(2)).sum::<f64>().sqrt()
    };
    frames.rows().into_iter().map(size).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::{angular_velocity, from_axis_angle};

    const RANGE: MotionRange = MotionRange { speed_m_s: 3.0, turn_rate_rad_s: 6.0 };

    fn speeds(p: &[[f64; 3]]) -> Vec<f64> {
        let step = |w: &[[f64; 3]]| (0..3).map(|i| (w[1][i] - w[0][i]).powi(2)).sum::<f64>();
        p.windows(2).map(|w| FPS * step(w).sqrt()).collect()
    }

    #[test]
    fn a_jump_is_spread_over_its_neighbours_and_the_rest_stays() {
        let mut path: Vec<[f64; 3]> = (0..41).map(|t| [0.01 * f64::from(t), 0.0, 0.0]).collect();
        // Half a metre at once: five frames' worth.
        path[20..].iter_mut().for_each(|p| p[1] += 0.5);
        let before = path.clone();
        RANGE.limit_positions(&mut path);
        let fastest = speeds(&path).into_iter().fold(0.0, f64::max);
        assert!((2.9..=3.0).contains(&fastest), "{fastest}");
        assert_eq!(
            (path[0], path[12], path[29], path[40]),
            (before[0], before[12], before[29], before[40])
        );
        // The middle of the jump is where it was.
        assert!((path[19][1] + path[20][1] - 0.5).abs() < 1e-3, "{:?}", &path[19..21]);
    }

    #[test]
    fn a_flip_becomes_a_turn_on_the_shorter_way() {
        let mut q: Vec<Quaternion> = (0..61)
            .map(|t| from_axis_angle([0.0, 1.0, 0.0], if t < 30 { 0.1 } else { 2.4 }))
            .collect();
        q[45] = q[45].map(|c| -c);
        RANGE.limit_orientations(&mut q);
        let rates: Vec<f64> = q
            .windows(2)
            .map(|w| {
                let w = angular_velocity(w[0], w[1], FPS);
                w.iter().map(|x| x * x).sum::<f64>().sqrt()
            })
            .collect();
        let fastest = rates.iter().copied().fold(0.0, f64::max);
        assert!((5.9..=6.0).contains(&fastest), "{fastest}");
        // The whole turn is still made, and a sign is no turn.
        assert!((rates.iter().sum::<f64>() / FPS - 2.3).abs() < 1e-6);
        assert!(q[45][0] < 0.0 && q.iter().all(|q| (dot(*q, *q) - 1.0).abs() < 1e-12));
    }

    #[test]
    fn what_keeps_the_limits_or_is_not_finite_stays_bit_for_bit() {
        let slow: Vec<[f64; 3]> = (0..17).map(|t| [0.09 * f64::from(t), 0.0, 1.0]).collect();
        let mut path = slow.clone();
        RANGE.limit_positions(&mut path);
        assert_eq!(path, slow);
        let mut holed = vec![[0.0; 3], [f64::NAN; 3], [0.0; 3]];
        RANGE.limit_positions(&mut holed);
        assert!(holed[1][0].is_nan() && holed[0] == [0.0; 3] && holed[2] == [0.0; 3]);
        RANGE.limit_positions(&mut []);
        RANGE.limit_orientations(&mut [[1.0, 0.0, 0.0, 0.0]]);
    }

    #[test]
    fn ranges_are_percentiles_of_all_frames() {
        let mut frames = ndarray::Array2::<f32>::zeros((1001, 25));
        for t in 0..1001 {
            frames[[t, Channel::Velocity.range().start]] = t as f32 * 0.6;
            frames[[t, Channel::Velocity.range().start + 1]] = t as f32 * 0.8;
            frames[[t, Channel::AngularVelocity.range().start + 2]] = -2.0;
        }
        let range = MotionRange::fit([frames.view()]).expect("finite");
        assert!((range.speed_m_s - 999.0).abs() < 1e-3, "{range:?}");
        assert!((range.turn_rate_rad_s - 2.0).abs() < 1e-12 && range.is_sound());
        // Of two motions the frames count together: 0, 0, 1, 1, 2, and 99.6 % of the way from 1 to 2.
        let rising = |n: usize| {
            ndarray::Array2::from_shape_fn((n, 25), |(t, i)| if i == 4 { t as f32 } else { 0.0 })
        };
        let range = MotionRange::fit([rising(3).view(), rising(2).view()]).expect("finite");
        assert!((range.speed_m_s - 1.996).abs() < 1e-9, "{range:?}");
        assert_eq!(MotionRange::fit([]), None);
        frames[[3, Channel::Velocity.range().start]] = f32::INFINITY;
        assert_eq!(MotionRange::fit([frames.view()]), None);
        assert!(!MotionRange { speed_m_s: 0.0, turn_rate_rad_s: 1.0 }.is_sound());
    }
}
