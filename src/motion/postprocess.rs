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
#[cfg(test)]
mod root_tests;
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

use super::channels::BODY;
use super::kinematics::{Poses, forward_differences, frames_in};
use super::layout::{BodyColumns, ColumnRole, Columns, Layout};
use super::phase::WRAP_BARS;
use super::quaternion::Quaternion;
use fusion::FusionMeasurements;
use smoothing::{Polynomials, moving_average};

/// Processes motion of [`BODY`] in place, `[T, 25]` in metres, seconds and radians; `phase` is the bar phase of
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

/// Processes motion of [`BODY`] as [`process`] does, with some poses held where [`Coherence::Fuse`] moves others;
/// returns how far it moved them.
///
/// # Panics
/// As [`process`].
pub fn process_holding(
    config: &PostProcessConfig,
    frames: &mut Array2<f32>,
    phase: Option<&[f64]>,
    held: &HeldPoses,
) -> Option<Displacement> {
    process_in(BODY, config, frames, phase, held)
}

/// Processes motion of any layout, `[T, columns]`; what a layout lacks is passed over, and fusion has no measurement
/// of it.
///
/// Held are values as the frames have them when fusion comes to them. Other steps that move poses
/// (smoothing, limits of speed) hold none.
///
/// # Panics
/// As [`process`], of the columns of the layout.
pub fn process_in(
    layout: Layout,
    config: &PostProcessConfig,
    frames: &mut Array2<f32>,
    phase: Option<&[f64]>,
    held: &HeldPoses,
) -> Option<Displacement> {
    assert_eq!(frames.ncols(), layout.width(), "channels of motion");
    let body = layout.body();
    if config.clamp_values {
        for columns in layout.spatial() {
            clamp(frames, columns, config.limits.of(columns.group));
        }
    }
    process_quaternions(config, frames, body.orientation);
    if let Some(columns) = layout.with_role(ColumnRole::Phase).next() {
        process_phase(config, frames, columns, phase);
    }
    if config.coherence == Coherence::Blend {
        // Velocity first: acceleration then follows the velocity that is kept.
        if let (true, Some(velocity)) = (config.enforce_velocity_coherence, body.velocity) {
            blend(frames, body.position, velocity);
        }
        if let (true, Some(velocity), Some(acceleration)) =
            (config.enforce_accel_coherence, body.velocity, body.acceleration)
        {
            blend(frames, velocity, acceleration);
        }
    }
    if config.apply_smoothing {
        let smooth = |x: &[f64]| moving_average(x, config.smoothing_kernel_size);
        smooth_columns(frames, layout.spatial(), smooth);
    }
    let displacement =
        (config.coherence == Coherence::Fuse).then(|| fuse(config, frames, &body, held));
    limit(config, frames, &body);
    if let Some(SavitzkyGolay { window, order }) = config.savitzky_golay {
        let polynomials = Polynomials::new(window, order, frames.nrows());
        smooth_columns(frames, [body.position], |x| polynomials.smooth(x));
        let mut q = quaternions(frames, body.orientation);
        orientation::smooth_by_polynomials(&mut q, &polynomials);
        write_quaternions(config, frames, body.orientation, q);
        limit(config, frames, &body);
    }
    if config.coherence.derives() {
        derive(layout, frames);
    }
    displacement
}

/// Puts the poses that agree best with all that was decoded in the place of the decoded ones.
fn fuse(
    config: &PostProcessConfig,
    frames: &mut Array2<f32>,
    body: &BodyColumns,
    held: &HeldPoses,
) -> Displacement {
    let variances = config.fusion_variances.unwrap_or_default();
    let measured = FusionMeasurements::of(body, frames.view());
    let shifts_m = measured.shifts(&variances, held);
    let mut position_m = measured.position.clone();
    for (p, shift) in position_m.as_flattened_mut().iter_mut().zip(shifts_m.as_flattened()) {
        *p += shift;
    }
    write_vectors(frames, body.position, &position_m);
    let q = measured.orientations(&variances, held);
    let angle = |(from, to)| Displacement::angle(from, to);
    let turns_rad: Vec<f64> = measured.orientation.iter().zip(&q).map(angle).collect();
    write_quaternions(config, frames, body.orientation, q);
    Displacement::new(&shifts_m, &turns_rad)
}

/// Holds poses to the speeds that they may have.
fn limit(config: &PostProcessConfig, frames: &mut Array2<f32>, body: &BodyColumns) {
    let Some(range) = config.range else { return };
    let mut position_m = vectors(frames, body.position);
    range.limit_positions(&mut position_m);
    write_vectors(frames, body.position, &position_m);
    let mut q = quaternions(frames, body.orientation);
    range.limit_orientations(&mut q);
    write_quaternions(config, frames, body.orientation, q);
}

/// Sets a column of phases to the bar phase of the music, `[T]`, in bars; a phase that is not finite stays.
fn relock_phase(frames: &mut Array2<f32>, columns: Columns, phase: &[f64]) {
    assert_eq!(frames.nrows(), phase.len(), "frames against phases");
    for (x, &phase) in frames.column_mut(columns.first).iter_mut().zip(phase) {
        if x.is_finite() {
            *x = phase as f32;
        }
    }
}

fn clamp(frames: &mut Array2<f32>, columns: Columns, (low, high): (f32, f32)) {
    frames
        .slice_mut(s![.., columns.range()])
        .mapv_inplace(|x| if x.is_finite() { x.clamp(low, high) } else { x });
}

fn process_quaternions(config: &PostProcessConfig, frames: &mut Array2<f32>, columns: Columns) {
    if !config.normalize_quaternions && !config.smooth_quaternions {
        return;
    }
    let mut q = quaternions(frames, columns);
    if config.normalize_quaternions {
        for q in &mut q {
            *q = orientation::unit(*q, config.quat_eps);
        }
    }
    if config.smooth_quaternions {
        q = orientation::smooth_by_hann(&q, config.quat_smooth_window);
    }
    write_quaternions(config, frames, columns, q);
}

fn process_phase(
    config: &PostProcessConfig,
    frames: &mut Array2<f32>,
    columns: Columns,
    phase: Option<&[f64]>,
) {
    if config.clamp_phase {
        clamp(frames, columns, (config.phase_min, config.phase_max));
    }
    if config.enforce_phase_monotonic {
        hold_falling_phase(frames, columns);
    }
    if let (true, Some(phase)) = (config.relock_phase, phase) {
        relock_phase(frames, columns, phase);
    }
}

/// Holds the phase where it falls within a bar: `φ[t] = φ[t-1]` where `-0.5 <= Δ < 0`; a larger fall
/// is the step into the next bar and stays.
fn hold_falling_phase(frames: &mut Array2<f32>, columns: Columns) {
    let mut running: Option<f32> = None;
    for x in frames.column_mut(columns.first) {
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
fn blend(frames: &mut Array2<f32>, of: Columns, columns: Columns) {
    let differences = forward_differences(&vectors(frames, of));
    let Some(last) = differences.last().copied() else { return };
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        let derived = differences.get(t).copied().unwrap_or(last);
        for (i, derived) in columns.range().zip(derived) {
            row[i] = (0.5 * f64::from(row[i]) + 0.5 * derived) as f32;
        }
    }
}

/// Puts what follows from position and quaternion in the place of what was decoded: see
/// [`frames_in`], also for the last frames.
fn derive(layout: Layout, frames: &mut Array2<f32>) {
    let body = layout.body();
    let poses = Poses {
        position_m: vectors(frames, body.position),
        orientation: quaternions(frames, body.orientation),
    };
    let derived = frames_in(layout, &poses, frames.nrows());
    for i in body.derived().flat_map(|columns| columns.range()) {
        for (x, &derived) in frames.column_mut(i).iter_mut().zip(derived.column(i)) {
            if x.is_finite() {
                *x = derived;
            }
        }
    }
}

fn smooth_columns(
    frames: &mut Array2<f32>,
    groups: impl IntoIterator<Item = Columns>,
    smooth: impl Fn(&[f64]) -> Vec<f64>,
) {
    for i in groups.into_iter().flat_map(|columns| columns.range()) {
        let mut column = frames.column_mut(i);
        let values: Vec<f64> = column.iter().map(|&x| f64::from(x)).collect();
        for (x, smooth) in column.iter_mut().zip(smooth(&values)) {
            *x = smooth as f32;
        }
    }
}

fn vectors(frames: &Array2<f32>, columns: Columns) -> Vec<[f64; 3]> {
    let start = columns.first;
    let to_vector = |row: ndarray::ArrayView1<'_, f32>| {
        std::array::from_fn(|axis| f64::from(row[start + axis]))
    };
    frames.rows().into_iter().map(to_vector).collect()
}

fn quaternions(frames: &Array2<f32>, columns: Columns) -> Vec<Quaternion> {
    let start = columns.first;
    let to_quaternion =
        |row: ndarray::ArrayView1<'_, f32>| std::array::from_fn(|c| f64::from(row[start + c]));
    frames.rows().into_iter().map(to_quaternion).collect()
}

fn write_vectors(frames: &mut Array2<f32>, columns: Columns, vectors: &[[f64; 3]]) {
    for (mut row, x) in frames.rows_mut().into_iter().zip(vectors) {
        for (i, &x) in columns.range().zip(x) {
            row[i] = x as f32;
        }
    }
}

/// Stores quaternions, with the signs of the configuration where it has the say.
fn write_quaternions(
    config: &PostProcessConfig,
    frames: &mut Array2<f32>,
    columns: Columns,
    q: Vec<Quaternion>,
) {
    // Signs are chosen of what is stored, so that a second choice finds them right.
    let mut stored: Vec<Quaternion> =
        q.into_iter().map(|q| q.map(|c| f64::from(c as f32))).collect();
    // As in the reference, signs belong to the step that makes quaternions unit.
    if config.normalize_quaternions {
        orientation::choose_signs(&mut stored, config.hemisphere);
    }
    for (mut row, q) in frames.rows_mut().into_iter().zip(stored) {
        for (i, c) in columns.range().zip(q) {
            row[i] = c as f32;
        }
    }
}
