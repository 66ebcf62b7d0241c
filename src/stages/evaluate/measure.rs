//! Motions on their way from the store to their numbers: one reads, all others measure.

use std::num::NonZeroUsize;
use std::sync::Mutex;
use std::sync::mpsc::{Receiver, sync_channel};

use ndarray::{Array2, ArrayView2, Axis, s};

use crate::evaluation::reference_statistics::ReferenceStatistics;
use crate::evaluation::window::{window, window_starts};
use crate::evaluation::window_range::RANGE_CHECKS;
use crate::evaluation::{Check, WindowMeasures, checks};
use crate::motion::{ChannelLimits, MOTION_DIM};
use crate::stages::pool::lock;

/// Frames that are kept of all motions together, to compare the values of channels.
pub const MAX_KEPT_FRAMES: usize = 60_000;

/// Least share of the windows of a motion within the training split's bounds for the motion to pass.
const MIN_WINDOW_SHARE: f64 = 0.9;
/// Checks that every frame must keep: its values are numbers, and its orientation is one.
const FINITE_CHECKS: [&str; 2] = ["finite", "quaternion"];
/// Checks that hold between neighbouring frames, also where a window ends.
const SEAM_CHECKS: [&str; 4] = ["finite", "velocity", "acceleration", "angular_velocity"];

/// How motions are measured.
pub struct Measurer<'a> {
    pub limits: ChannelLimits,
    pub reference: Option<&'a ReferenceStatistics>,
    /// Frames of a window.
    pub window_frames: usize,
    /// Most frames of a motion that are looked at.
    pub num_frames: Option<usize>,
    /// One of every `stride` frames is kept.
    pub stride: usize,
    pub threads: NonZeroUsize,
}

/// A motion that was measured, at one stage of its making.
#[derive(Debug)]
pub struct MeasuredMotion {
    pub n_frames: usize,
    /// Checks of the whole motion; those of windows are passed where nine in ten windows pass.
    pub checks: Vec<Check>,
    /// Its windows, one behind the other, without messages.
    pub windows: Vec<WindowMeasures>,
    /// Whether it passes [`FINITE_CHECKS`] from its first frame to its last.
    pub is_finite: bool,
    /// Whether nine in ten windows over the borders of `windows` and at the end of the motion pass
    /// [`SEAM_CHECKS`].
    pub is_seamless: bool,
    /// Every `stride`th frame of each window, \[_, 25\].
    pub kept: Array2<f32>,
}

impl Measurer<'_> {
    /// Measures the motions that `feed` gives out by number, and returns them in order of it; a number that
    /// is never given out stays empty.
    ///
    /// # Errors
    /// The error of `feed`.
    pub fn run<E: Send>(
        &self,
        n: usize,
        feed: impl FnOnce(&mut dyn FnMut(usize, Array2<f32>)) -> Result<(), E>,
    ) -> Result<Vec<Option<MeasuredMotion>>, E> {
        let measured: Mutex<Vec<Option<MeasuredMotion>>> =
            Mutex::new((0..n).map(|_| None).collect());
        let (sender, receiver) = sync_channel::<(usize, Array2<f32>)>(4 * self.threads.get());
        let receiver: Mutex<Receiver<_>> = Mutex::new(receiver);
        std::thread::scope(|scope| {
            for _ in 0..self.threads.get() {
                scope.spawn(|| {
                    loop {
                        // The lock must not be held while the motion is measured.
                        let next = lock(&receiver).recv();
                        let Ok((i, frames)) = next else { return };
                        let found = self.measure(frames.view());
                        lock(&measured)[i] = Some(found);
                    }
                });
            }
            // The workers are there until the sender goes.
            let mut give = |i, frames| sender.send((i, frames)).unwrap_or(());
            let fed = feed(&mut give);
            drop(sender);
            fed
        })?;
        Ok(measured.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner))
    }

    /// Measures one motion, `[T, 25]`.
    pub fn measure(&self, frames: ArrayView2<f32>) -> MeasuredMotion {
        let n = self.num_frames.unwrap_or(usize::MAX).min(frames.nrows());
        let frames = frames.slice(s![..n, ..]);
        let length = self.window_frames;
        let (mut windows, mut kept) = (Vec::new(), Array2::zeros((0, MOTION_DIM)));
        for first in window_starts(n, length) {
            let placed = window(frames, first, length);
            windows.push(WindowMeasures::new(placed.view(), self.limits, self.reference));
            // Windows and kept frames have 25 channels each.
            let _ = kept.append(Axis(0), placed.slice(s![..;self.stride, ..]));
        }
        let mut checks = checks(frames, self.limits);
        checks.extend(RANGE_CHECKS.iter().filter_map(|name| over_windows(name, &windows)));
        for check in windows.iter_mut().flat_map(|window| &mut window.checks) {
            check.message = String::new();
        }
        let is_finite = passes(&checks, &FINITE_CHECKS);
        let is_seamless = self.is_seamless(frames);
        MeasuredMotion { n_frames: n, checks, windows, is_finite, is_seamless, kept }
    }

    /// Windows that are measured end where the next begins, so that a jump between them is in none, and the rest of a
    /// motion behind the last is in none either: windows half a length later, and the one that ends with the motion,
    /// have both.
    fn is_seamless(&self, frames: ArrayView2<f32>) -> bool {
        let (n, length) = (frames.nrows(), self.window_frames);
        let Some(last) = n.checked_sub(length) else { return true };
        let halfway = length / 2;
        let between = window_starts(n.saturating_sub(halfway), length).map(|first| first + halfway);
        let firsts: Vec<usize> = between.filter(|&first| first != last).chain([last]).collect();
        let is_passed = |first: usize| {
            let window = frames.slice(s![first..first + length, ..]);
            passes(&checks(window, self.limits), &SEAM_CHECKS)
        };
        let n_passed = firsts.iter().filter(|&&first| is_passed(first)).count();
        n_passed as f64 >= MIN_WINDOW_SHARE * firsts.len() as f64
    }
}

/// Returns whether all checks of these names were passed.
fn passes(checks: &[Check], names: &[&str]) -> bool {
    checks.iter().filter(|check| names.contains(&check.name)).all(|check| check.passed)
}

/// Returns a check of all windows of a motion, with the answer that is worst; none where it was not made.
fn over_windows(name: &str, windows: &[WindowMeasures]) -> Option<Check> {
    let all: Vec<&Check> = windows
        .iter()
        .filter_map(|window| window.checks.iter().find(|check| check.name == name))
        .collect();
    let worst = all.iter().copied().reduce(|a, b| if is_worse(b, a) { b } else { a })?;
    let n_passed = all.iter().filter(|check| check.passed).count();
    let message = format!("{}; {n_passed} of {} windows pass", worst.message, all.len());
    let passed = n_passed as f64 >= MIN_WINDOW_SHARE * all.len() as f64;
    Some(Check { passed, message, ..worst.clone() })
}

/// Whether an answer is worse than another: failures before passes, the former the farther and the latter the nearer to
/// the threshold.
fn is_worse(check: &Check, than: &Check) -> bool {
    let distance = |check: &Check| (check.value - check.threshold).abs();
    match (than.passed, check.passed) {
        (true, false) => true,
        (false, true) => false,
        (false, false) => distance(check) > distance(than) || check.value.is_nan(),
        (true, true) => distance(check) < distance(than),
    }
}

/// Returns the checks of a motion, of a group those of the dancer whose answer is worst: a group passes what all its
/// dancers pass.
pub fn over_dancers(dancers: &[&[Check]]) -> Vec<Check> {
    let [first, others @ ..] = dancers else { return Vec::new() };
    let mut worst: Vec<(usize, &Check)> = first.iter().map(|check| (0, check)).collect();
    for (dancer, checks) in others.iter().enumerate() {
        for (worst, check) in worst.iter_mut().zip(*checks) {
            if is_worse(check, worst.1) {
                *worst = (dancer + 1, check);
            }
        }
    }
    let told = |(dancer, check): (usize, &Check)| match others.is_empty() {
        true => check.clone(),
        false => Check { message: format!("dancer {dancer}: {}", check.message), ..check.clone() },
    };
    worst.into_iter().map(told).collect()
}

/// Returns the kept frames of motions one behind the other, \[n, 25\].
pub fn kept_frames<'a>(kept: impl IntoIterator<Item = &'a Array2<f32>>) -> Array2<f32> {
    let mut frames = Array2::zeros((0, MOTION_DIM));
    for kept in kept {
        // All have 25 channels.
        let _ = frames.append(Axis(0), kept.view());
    }
    frames
}

/// Returns one of how many frames is kept of `n_frames`.
pub fn stride_for(n_frames: usize) -> usize {
    n_frames.div_ceil(MAX_KEPT_FRAMES).max(1)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::kinematics::{Poses, frames_of};

    /// A body that goes round, of `n` frames.
    fn motion(n: usize) -> Array2<f32> {
        let place = |t: usize| {
            let s = t as f64 / 30.0;
            [s.sin(), 1.0, s.cos()]
        };
        let position_m = (0..n + 2).map(place).collect();
        let orientation = vec![[1.0, 0.0, 0.0, 0.0]; n + 2];
        frames_of(&Poses { position_m, orientation }, n)
    }

    fn measured(frames: &Array2<f32>) -> [bool; 2] {
        let measurer = Measurer {
            limits: ChannelLimits::Wide,
            reference: None,
            window_frames: 120,
            num_frames: None,
            stride: 1,
            threads: NonZeroUsize::MIN,
        };
        let found = measurer.measure(frames.view());
        [found.is_finite, found.is_seamless]
    }

    #[test]
    fn what_no_window_has_is_seen_where_windows_meet_and_at_the_end() {
        assert_eq!(measured(&motion(497)), [true, true]);
        // 1 m to the side at each border, which the velocities do not say.
        let mut jumps = motion(497);
        for t in 0..497 {
            jumps[[t, 0]] += (t / 120 % 2) as f32;
        }
        assert_eq!(measured(&jumps), [true, false]);
        // Behind the last whole window, which ends at frame 480.
        let mut tail = motion(497);
        tail.slice_mut(s![481.., 3..6]).fill(9.0);
        assert_eq!(measured(&tail), [true, false]);
        tail[[490, 20]] = f32::NAN;
        assert_eq!(measured(&tail), [false, false]);
        let mut long = motion(497);
        long.slice_mut(s![.., 9..13]).mapv_inplace(|x| 1.5 * x);
        assert_eq!(measured(&long), [false, true]);
        // Too short for a window.
        assert_eq!(measured(&motion(61)), [true, true]);
    }
}
