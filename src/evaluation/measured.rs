//! What is kept of a window once it was measured: enough for every number of a set of windows.

use ndarray::{Array2, ArrayView2};

use crate::motion::kinematics::forward_differences;
use crate::motion::{Channel, ChannelLimits};

use super::beats::motion_beats;
use super::body::poses;
use super::consistency::{Consistency, consistency};
use super::reference_statistics::{FeatureSet, ReferenceStatistics};
use super::sanity::{Check, CheckSet, checks};
use super::window_range::Posture;
use crate::motion::vector::norm;

/// The measured numbers of a window of motion.
#[derive(Clone, Debug)]
pub struct WindowMeasures {
    pub n_frames: usize,
    /// The reference's checks and the strict ones; with reference statistics, those of the training split's
    /// windows too.
    pub checks: Vec<Check>,
    pub consistency: Option<Consistency>,
    /// None where a position or an orientation is not finite.
    pub posture: Option<Posture>,
    /// Mean speed, m/s; none where a position is not finite.
    pub mean_speed_m_s: Option<f64>,
    /// Vertical velocity of the body, m/s, from frame to frame: one fewer. Taken from positions, since the
    /// velocity that a network says need not be the one at which its body moves.
    pub rise_m_s: Vec<f64>,
    /// The phase that the motion says.
    pub phase: Vec<f64>,
    /// Frames at which the body is slowest.
    pub beats: Vec<usize>,
    /// In the order of [`FeatureSet::ALL`].
    features: Vec<Option<Array2<f64>>>,
}

impl WindowMeasures {
    /// Measures a window, `[T, 25]`.
    ///
    /// # Panics
    /// When there are other than 25 channels.
    pub fn new(
        frames: ArrayView2<f32>,
        limits: ChannelLimits,
        reference: Option<&ReferenceStatistics>,
    ) -> Self {
        let poses = poses(frames);
        let posture = poses.as_ref().and_then(Posture::new);
        let mut checks = checks(frames, limits);
        checks.extend(reference.iter().flat_map(|r| r.window_range.checks(posture.as_ref())));
        let velocity =
            poses.as_ref().map(|p| forward_differences(&p.position_m)).unwrap_or_default();
        let mean = |n: usize, sum: f64| (n > 0).then(|| sum / n as f64);
        let features = |set: FeatureSet| reference.and_then(|r| r.features(set, frames));
        Self {
            n_frames: frames.nrows(),
            checks,
            consistency: consistency(frames, limits),
            posture,
            mean_speed_m_s: mean(velocity.len(), velocity.iter().map(|v| norm(*v)).sum()),
            rise_m_s: velocity.iter().map(|v| v[1]).collect(),
            phase: frames
                .column(Channel::Phase.range().start)
                .iter()
                .map(|&x| f64::from(x))
                .collect(),
            beats: poses.as_ref().map(motion_beats).unwrap_or_default(),
            features: FeatureSet::ALL.map(features).into(),
        }
    }

    /// Normalised features of its chunks, `[n_chunks, n_features]`; none without reference statistics or
    /// where it is not finite.
    pub fn features(&self, set: FeatureSet) -> Option<ArrayView2<'_, f64>> {
        let i = FeatureSet::ALL.iter().position(|known| *known == set)?;
        self.features[i].as_ref().map(|rows| rows.view())
    }

    /// Whether it passed every check of a set. A check that post-processing makes true changes nothing here, and one
    /// that fails all the same is a defect.
    pub fn passes(&self, set: CheckSet) -> bool {
        self.checks.iter().filter(|check| check.set == set).all(|check| check.passed)
    }

    /// Whether it passed a check; none where the check was not made.
    pub fn passed(&self, name: &str) -> Option<bool> {
        self.checks.iter().find(|check| check.name == name).map(|check| check.passed)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::evaluation::CheckSet;

    /// A body that rises and falls once a second and keeps its orientation.
    fn bounce(n: usize) -> Array2<f32> {
        let mut frames = Array2::zeros((n, 25));
        let height = |t: usize| 0.1 * (std::f64::consts::TAU * t as f64 / 30.0).sin();
        for t in 0..n {
            frames[[t, 1]] = height(t) as f32;
            frames[[t, 4]] = (30.0 * (height(t + 1) - height(t))) as f32;
            let later = 30.0 * (height(t + 2) - height(t + 1));
            frames[[t, 7]] = (30.0 * (later - 30.0 * (height(t + 1) - height(t)))) as f32;
            frames[[t, Channel::Quaternion.range().start]] = 1.0;
        }
        frames
    }

    #[test]
    fn a_motion_is_measured_by_its_positions() {
        let mut frames = bounce(91);
        let found = WindowMeasures::new(frames.view(), ChannelLimits::Wide, None);
        assert_eq!((found.n_frames, found.rise_m_s.len(), found.phase.len()), (91, 90, 91));
        assert_eq!((found.checks.len(), found.passes(CheckSet::Reference)), (13, true));
        // Four amplitudes a second, less what frames half a frame from the peaks miss.
        let expected = 0.4 * (std::f64::consts::PI / 30.0).cos();
        assert!((found.mean_speed_m_s.unwrap() - expected).abs() < 1e-6, "{found:?}");
        assert!(
            (found.rise_m_s[0] - 30.0 * 0.1 * (std::f64::consts::TAU / 30.0).sin()).abs() < 1e-5
        );
        assert!(found.features(FeatureSet::Axes).is_none());
        // What the velocity channel says changes checks, not the speed.
        frames.column_mut(4).fill(90.0);
        let lying = WindowMeasures::new(frames.view(), ChannelLimits::Wide, None);
        assert_eq!(lying.mean_speed_m_s, found.mean_speed_m_s);
        assert!(!lying.passes(CheckSet::Reference) && !lying.passes(CheckSet::Strict));
    }

    #[test]
    fn a_motion_that_is_not_finite_has_checks_and_nothing_else() {
        let mut frames = bounce(31);
        frames[[7, 0]] = f32::NAN;
        let found = WindowMeasures::new(frames.view(), ChannelLimits::Wide, None);
        assert_eq!((found.mean_speed_m_s, found.rise_m_s.len(), found.beats.len()), (None, 0, 0));
        assert_eq!(found.consistency, None);
        assert!(!found.passes(CheckSet::Strict));
    }
}
