//! What post-processing does, and which settings make sense.

use serde::{Deserialize, Serialize};

use super::variances::FusionVariances;
use crate::motion::channels::Channel;
use crate::motion::rates::MotionRange;
use crate::motion::trajectory::ChannelLimits;

/// Widest window of any smoothing: ten seconds.
pub const MAX_WINDOW_FRAMES: usize = 301;

/// Which of the two signs of a quaternion is stored.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Default, clap::ValueEnum, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum Hemisphere {
    /// The first frame has w ≥ 0, every other the sign nearest to the frame before: no jumps.
    #[default]
    Sequential,
    /// Every frame has w ≥ 0, as in the reference: the sign jumps where w crosses 0.
    PerFrame,
}

/// What becomes of velocity, acceleration and angular velocity.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Default, clap::ValueEnum, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum Coherence {
    /// They stay as they were decoded.
    Keep,
    /// Velocity and acceleration become the mean of decoded and derived, as in the reference.
    Blend,
    /// All three are derived from position and orientation.
    #[default]
    Derive,
    /// Positions and orientations become those that agree best with all that was decoded, by least squares;
    /// then all three are derived from them.
    Fuse,
}

impl Coherence {
    /// The name in configurations.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Keep => "keep",
            Self::Blend => "blend",
            Self::Derive => "derive",
            Self::Fuse => "fuse",
        }
    }

    /// Returns whether velocity, acceleration and angular velocity are derived from poses.
    pub const fn derives(self) -> bool {
        matches!(self, Self::Derive | Self::Fuse)
    }
}

/// Smoothing by polynomials that are fitted to a sliding window (Savitzky and Golay 1964).
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SavitzkyGolay {
    /// Frames of the window, odd, up to [`MAX_WINDOW_FRAMES`].
    pub window: usize,
    /// Order of the polynomial, below `window`.
    pub order: usize,
}

impl Default for SavitzkyGolay {
    /// A third of a second, cubic: what makes the jerk of generated motion that of captured motion, and
    /// leaves how far it follows the bar (docs/generate.md).
    fn default() -> Self {
        Self { window: 11, order: 3 }
    }
}

/// What [`super::process`] does, in the names and the order of the reference design (section 9.1).
///
/// Defaults are the reference's but for four: signs are continuous in time, velocities and the like are
/// derived, the phase is that of the music, and angular velocity has the wide limit. The reference's
/// four `max_…` are `limits`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PostProcessConfig {
    /// Whether quaternions are divided by their norms and their signs chosen.
    pub normalize_quaternions: bool,
    /// Norms below this are not divided by, above 0 and below 1.
    pub quat_eps: f64,
    /// Which sign quaternions get where they are normalized.
    pub hemisphere: Hemisphere,
    /// Whether orientations are smoothed by normalized sums with Hann weights.
    pub smooth_quaternions: bool,
    /// Frames of these sums, odd, up to [`MAX_WINDOW_FRAMES`].
    pub quat_smooth_window: usize,
    /// Whether the phase is held within `phase_min` and `phase_max`.
    pub clamp_phase: bool,
    /// Lowest phase, bars.
    pub phase_min: f32,
    /// Highest phase, bars.
    pub phase_max: f32,
    /// Whether the phase is held where it falls within a bar; a fall by more than half a bar is the
    /// step into the next one.
    pub enforce_phase_monotonic: bool,
    /// Whether the phase becomes that of the music's bars, where it is known.
    pub relock_phase: bool,
    /// Whether position, velocity, acceleration and angular velocity are held within `limits`.
    pub clamp_values: bool,
    pub limits: ChannelLimits,
    pub coherence: Coherence,
    /// Whether [`Coherence::Blend`] takes in velocity. The reference blends neither by default; that
    /// is [`Coherence::Keep`].
    pub enforce_velocity_coherence: bool,
    /// Whether [`Coherence::Blend`] takes in acceleration, after velocity.
    pub enforce_accel_coherence: bool,
    /// Whether vectors are smoothed by a moving average.
    pub apply_smoothing: bool,
    /// Frames of the moving average, odd, up to [`MAX_WINDOW_FRAMES`].
    pub smoothing_kernel_size: usize,
    /// How positions and orientations are smoothed by polynomials, after the moving average and after fusion;
    /// needs a coherence that derives velocities. [`Coherence::Fuse`] does not need it, and may have it.
    pub savitzky_golay: Option<SavitzkyGolay>,
    /// How fast the body may move and turn; before and after smoothing, which carries over its peaks.
    pub range: Option<MotionRange>,
    /// What [`Coherence::Fuse`] weighs by; none for [`FusionVariances::default`]. No other coherence looks at
    /// it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub fusion_variances: Option<FusionVariances>,
}

impl Default for PostProcessConfig {
    fn default() -> Self {
        let (phase_min, phase_max) = ChannelLimits::Wide.bounds(Channel::Phase);
        Self {
            normalize_quaternions: true,
            quat_eps: 1e-8,
            hemisphere: Hemisphere::Sequential,
            smooth_quaternions: false,
            quat_smooth_window: 5,
            clamp_phase: true,
            phase_min,
            phase_max,
            enforce_phase_monotonic: false,
            relock_phase: true,
            clamp_values: true,
            limits: ChannelLimits::Wide,
            coherence: Coherence::Derive,
            enforce_velocity_coherence: true,
            enforce_accel_coherence: true,
            apply_smoothing: false,
            smoothing_kernel_size: 3,
            savitzky_golay: None,
            range: None,
            fusion_variances: None,
        }
    }
}

impl PostProcessConfig {
    /// Returns the configuration without any step that moves poses, for motion that was smoothed or fused
    /// before.
    pub fn without_smoothing(&self) -> Self {
        let coherence = match self.coherence {
            // What was fused is the poses; what follows from them may be derived again.
            Coherence::Fuse => Coherence::Derive,
            other => other,
        };
        Self {
            coherence,
            smooth_quaternions: false,
            apply_smoothing: false,
            savitzky_golay: None,
            range: None,
            ..self.clone()
        }
    }

    /// Every step off: motion stays as it is, bit for bit.
    pub fn nothing() -> Self {
        Self {
            normalize_quaternions: false,
            clamp_phase: false,
            relock_phase: false,
            clamp_values: false,
            coherence: Coherence::Keep,
            ..Self::default()
        }
    }

    /// Refuses settings that make no sense, of steps that are off as well.
    ///
    /// # Errors
    /// The first setting that is out of its range.
    pub fn check(&self) -> Result<(), PostProcessError> {
        if !(self.quat_eps > 0.0 && self.quat_eps < 1.0) {
            return Err(PostProcessError::QuatEps { quat_eps: self.quat_eps });
        }
        check_window("quat_smooth_window", self.quat_smooth_window)?;
        let (low, high) = (self.phase_min, self.phase_max);
        let (lowest, highest) = self.limits.bounds(Channel::Phase);
        // Written so that NaN fails.
        if !(lowest <= low && low <= high && high <= highest) {
            return Err(PostProcessError::Phase { low, high, lowest, highest });
        }
        check_window("smoothing_kernel_size", self.smoothing_kernel_size)?;
        if let Some(SavitzkyGolay { window, order }) = self.savitzky_golay {
            check_window("window of savitzky_golay", window)?;
            if order >= window {
                return Err(PostProcessError::Order { order, window, highest: window - 1 });
            }
            if !self.coherence.derives() {
                return Err(PostProcessError::NotDerived { coherence: self.coherence.name() });
            }
        }
        match self.fusion_variances.and_then(|variances| variances.unsound()) {
            Some((name, variance)) => Err(PostProcessError::Variance { name, variance }),
            None => Ok(()),
        }
    }
}

fn check_window(name: &'static str, n_frames: usize) -> Result<(), PostProcessError> {
    if n_frames % 2 == 1 && n_frames <= MAX_WINDOW_FRAMES {
        Ok(())
    } else {
        Err(PostProcessError::Window { name, n_frames })
    }
}

/// Why motion cannot be processed like this.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum PostProcessError {
    #[error(
        "quat_eps is {quat_eps:e}; it must lie above 0 and below 1, the norm of a quaternion; 1e-8 \
         is usual"
    )]
    QuatEps { quat_eps: f64 },
    #[error(
        "{name} is {n_frames} frames; a window needs a frame in its middle, so give an odd number \
         from 1 to {MAX_WINDOW_FRAMES}"
    )]
    Window { name: &'static str, n_frames: usize },
    #[error(
        "phase_min is {low} and phase_max is {high}; both must lie within {lowest} and {highest} \
         bars, and the second not below the first"
    )]
    Phase { low: f32, high: f32, lowest: f32, highest: f32 },
    #[error(
        "order of savitzky_golay is {order} in a window of {window} frames; a polynomial of that \
         order smooths nothing there, give at most {highest} or a wider window"
    )]
    Order { order: usize, window: usize, highest: usize },
    #[error(
        "savitzky_golay smooths positions and orientations, and coherence is {coherence}, which \
         leaves velocities that no longer belong to them; set coherence to derive or fuse"
    )]
    NotDerived { coherence: &'static str },
    #[error(
        "{name} of fusion_variances is {variance}; fusion divides by it, so give a number above 0, a very \
         large one for what shall not count"
    )]
    Variance { name: &'static str, variance: f64 },
}
