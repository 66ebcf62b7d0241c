//! Post-processing: what a decoder says becomes motion that keeps the rules of the format.
//!
//! The steps come in the order of the reference design (section 9): values, quaternions, smoothing
//! of quaternions, phase, coherence, smoothing. What is derived, by [`Coherence::Derive`] and
//! [`Coherence::Fuse`], alone comes after smoothing: derived before, velocities would belong to positions
//! that smoothing then moves. Fusion itself comes where coherence does, before the limits of speed.
//!
//! Nothing that is not finite is mended: no step puts a finite number where NaN or an infinity was,
//! so that the checks find it. Neither are derived values held within limits: held, they would no longer
//! be differences. It is poses that are held, where a range says how fast they may change.

mod config;
mod fusion;
#[cfg(test)]
mod noise;
mod orientation;
mod smoothing;
#[cfg(test)]
mod tests;
mod turning;
mod variances;

use ndarray::{Array2, s};

pub use config::{
    Coherence, Hemisphere, MAX_WINDOW_FRAMES, PostProcessConfig, PostProcessError, SavitzkyGolay,
};
pub use fusion::{Displacement, FusionFilters, HeldPoses};
pub use variances::{AxisVariances, FusionVariances};

use super::channels::{Channel, MOTION_DIM};
use super::kinematics::{Poses, forward_differences, frames_of};
use super::phase::WRAP_BARS;
use super::quaternion::Quaternion;
use fusion::FusionMeasurements;
use smoothing::{Polynomials, moving_average};

/// Channel groups that the reference clamps and smooths: all that are vectors.
const VECTORS: [Channel; 4] =
    [Channel::Position, Channel::Velocity, Channel::Acceleration, Channel::AngularVelocity];

/// Channel groups that follow from position and quaternion.
const DERIVED: [Channel; 3] = [Channel::Velocity, Channel::Acceleration, Channel::AngularVelocity];

/// Processes motion in place, `[T, 25]` in metres, seconds and radians; `phase` is the bar phase of
/// the music, `[T]`, for `relock_phase`.
///
/// With the default configuration a second time changes nothing. Source: reference design, section
/// 9, with the exceptions that [`PostProcessConfig`] names.
///
/// # Panics
/// When there are other than 25 channels, another number of phases than frames, or the
/// configuration does not pass [`PostProcessConfig::check`].
pub fn process(config: &PostProcessConfig, frames: &mut Array2<f32>, phase: Option<&[f64]>) {
    process_holding(config, frames, phase, &HeldPoses::default());
}

/// Processes motion as [`process`] does, with some poses held where [`Coherence::Fuse`] moves others;
/// returns how far it moved them.
///
/// Held are values as the frames have them when fusion comes to them. Other steps that move poses
/// (smoothing, limits of speed) hold none.
///
/// # Panics
/// As [`process`].
pub fn process_holding(
    config: &PostProcessConfig,
    frames: &mut Array2<f32>,
    phase: Option<&[f64]>,
    held: &HeldPoses,
) -> Option<Displacement> {
    assert_eq!(frames.ncols(), MOTION_DIM, "channels of motion");
    if config.clamp_values {
        for channel in VECTORS {
            clamp(frames, channel, config.limits.bounds(channel));
        }
    }
    process_quaternions(config, frames);
    process_phase(config, frames, phase);
    if config.coherence == Coherence::Blend {
        // Velocity first: acceleration then follows the velocity that is kept.
        if config.enforce_velocity_coherence {
            blend(frames, Channel::Position, Channel::Velocity);
        }
        if config.enforce_accel_coherence {
            blend(frames, Channel::Velocity, Channel::Acceleration);
        }
    }
    if config.apply_smoothing {
        smooth_columns(frames, &VECTORS, |x| moving_average(x, config.smoothing_kernel_size));
    }
    let displacement = (config.coherence == Coherence::Fuse).then(|| fuse(config, frames, held));
    limit(config, frames);
    if let Some(SavitzkyGolay { window, order }) = config.savitzky_golay {
        let polynomials = Polynomials::new(window, order, frames.nrows());
        smooth_columns(frames, &[Channel::Position], |x| polynomials.smooth(x));
        let mut q = quaternions(frames);
        orientation::smooth_by_polynomials(&mut q, &polynomials);
        write_quaternions(config, frames, q);
        limit(config, frames);
    }
    if config.coherence.derives() {
        derive(frames);
    }
    displacement
}

/// Puts the poses that agree best with all that was decoded in the place of the decoded ones.
fn fuse(config: &PostProcessConfig, frames: &mut Array2<f32>, held: &HeldPoses) -> Displacement {
    let variances = config.fusion_variances.unwrap_or_default();
    let measured = FusionMeasurements::of(frames.view());
    let shifts_m = measured.shifts(&variances, held);
    let mut position_m = measured.position.clone();
    for (p, shift) in position_m.as_flattened_mut().iter_mut().zip(shifts_m.as_flattened()) {
        *p += shift;
    }
    write_vectors(frames, Channel::Position, &position_m);
    let q = measured.orientations(&variances, held);
    let angle = |(from, to)| Displacement::angle(from, to);
    let turns_rad: Vec<f64> = measured.orientation.iter().zip(&q).map(angle).collect();
    write_quaternions(config, frames, q);
    Displacement::new(&shifts_m, &turns_rad)
}

/// Holds poses to the speeds that they may have.
fn limit(config: &PostProcessConfig, frames: &mut Array2<f32>) {
    let Some(range) = config.range else { return };
    let mut position_m = vectors(frames, Channel::Position);
    range.limit_positions(&mut position_m);
    write_vectors(frames, Channel::Position, &position_m);
    let mut q = quaternions(frames);
    range.limit_orientations(&mut q);
    write_quaternions(config, frames, q);
}

/// Sets the phase to the bar phase of the music, `[T]`, in bars; a phase that is not finite stays.
///
/// # Panics
/// When there is another number of phases than frames.
pub fn relock_phase(frames: &mut Array2<f32>, phase: &[f64]) {
    assert_eq!(frames.nrows(), phase.len(), "frames against phases");
    let column = Channel::Phase.range().start;
    for (x, &phase) in frames.column_mut(column).iter_mut().zip(phase) {
        if x.is_finite() {
            *x = phase as f32;
        }
    }
}

fn clamp(frames: &mut Array2<f32>, channel: Channel, (low, high): (f32, f32)) {
    frames
        .slice_mut(s![.., channel.range()])
        .mapv_inplace(|x| if x.is_finite() { x.clamp(low, high) } else { x });
}

fn process_quaternions(config: &PostProcessConfig, frames: &mut Array2<f32>) {
    if !config.normalize_quaternions && !config.smooth_quaternions {
        return;
    }
    let mut q = quaternions(frames);
    if config.normalize_quaternions {
        for q in &mut q {
            *q = orientation::unit(*q, config.quat_eps);
        }
    }
    if config.smooth_quaternions {
        q = orientation::smooth_by_hann(&q, config.quat_smooth_window);
    }
    write_quaternions(config, frames, q);
}

fn process_phase(config: &PostProcessConfig, frames: &mut Array2<f32>, phase: Option<&[f64]>) {
    if config.clamp_phase {
        clamp(frames, Channel::Phase, (config.phase_min, config.phase_max));
    }
    if config.enforce_phase_monotonic {
        hold_falling_phase(frames);
    }
    if let (true, Some(phase)) = (config.relock_phase, phase) {
        relock_phase(frames, phase);
    }
}

/// Holds the phase where it falls within a bar: `φ[t] = φ[t-1]` where `-0.5 <= Δ < 0`; a larger fall
/// is the step into the next bar and stays.
fn hold_falling_phase(frames: &mut Array2<f32>) {
    let mut running: Option<f32> = None;
    for x in frames.column_mut(Channel::Phase.range().start) {
        if !x.is_finite() {
            continue;
        }
        if let Some(held) = running {
            let change = *x - held;
            if (-WRAP_BARS as f32..0.0).contains(&change) {
                *x = held;
            }
        }
        running = Some(*x);
    }
}

/// Takes the mean of a channel and of the forward difference of another:
/// `y[t] = (y[t] + (x[t+1] - x[t]) FPS) / 2`, the last difference repeated. One frame is left alone.
///
/// Erratum: the reference takes the backward difference `x[t] - x[t-1]` here (section 9.2) and the
/// forward one in its losses and checks (7.2, 10.1), so what it makes coherent fails its own checks.
fn blend(frames: &mut Array2<f32>, of: Channel, channel: Channel) {
    let differences = forward_differences(&vectors(frames, of));
    let Some(last) = differences.last().copied() else { return };
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        let derived = differences.get(t).copied().unwrap_or(last);
        for (i, derived) in channel.range().zip(derived) {
            row[i] = (0.5 * f64::from(row[i]) + 0.5 * derived) as f32;
        }
    }
}

/// Puts what follows from position and quaternion in the place of what was decoded: see
/// [`frames_of`], also for the last frames.
fn derive(frames: &mut Array2<f32>) {
    let poses =
        Poses { position_m: vectors(frames, Channel::Position), orientation: quaternions(frames) };
    let derived = frames_of(&poses, frames.nrows());
    for i in DERIVED.into_iter().flat_map(Channel::range) {
        for (x, &derived) in frames.column_mut(i).iter_mut().zip(derived.column(i)) {
            if x.is_finite() {
                *x = derived;
            }
        }
    }
}

fn smooth_columns(
    frames: &mut Array2<f32>,
    channels: &[Channel],
    smooth: impl Fn(&[f64]) -> Vec<f64>,
) {
    for i in channels.iter().flat_map(|channel| channel.range()) {
        let mut column = frames.column_mut(i);
        let values: Vec<f64> = column.iter().map(|&x| f64::from(x)).collect();
        for (x, smooth) in column.iter_mut().zip(smooth(&values)) {
            *x = smooth as f32;
        }
    }
}

fn vectors(frames: &Array2<f32>, channel: Channel) -> Vec<[f64; 3]> {
    let start = channel.range().start;
    let to_vector = |row: ndarray::ArrayView1<'_, f32>| {
        std::array::from_fn(|axis| f64::from(row[start + axis]))
    };
    frames.rows().into_iter().map(to_vector).collect()
}

fn quaternions(frames: &Array2<f32>) -> Vec<Quaternion> {
    let start = Channel::Quaternion.range().start;
    let to_quaternion =
        |row: ndarray::ArrayView1<'_, f32>| std::array::from_fn(|c| f64::from(row[start + c]));
    frames.rows().into_iter().map(to_quaternion).collect()
}

fn write_vectors(frames: &mut Array2<f32>, channel: Channel, vectors: &[[f64; 3]]) {
    for (mut row, x) in frames.rows_mut().into_iter().zip(vectors) {
        for (i, &x) in channel.range().zip(x) {
            row[i] = x as f32;
        }
    }
}

/// Stores quaternions, with the signs of the configuration where it has the say.
fn write_quaternions(config: &PostProcessConfig, frames: &mut Array2<f32>, q: Vec<Quaternion>) {
    // Signs are chosen of what is stored, so that a second choice finds them right.
    let mut stored: Vec<Quaternion> =
        q.into_iter().map(|q| q.map(|c| f64::from(c as f32))).collect();
    // As in the reference, signs belong to the step that makes quaternions unit.
    if config.normalize_quaternions {
        orientation::choose_signs(&mut stored, config.hemisphere);
    }
    for (mut row, q) in frames.rows_mut().into_iter().zip(stored) {
        for (i, c) in Channel::Quaternion.range().zip(q) {
            row[i] = c as f32;
        }
    }
}
