//! What is asked of the windows that a planner learns from: parts of their own motion, drawn by chance.
//!
//! As models of control are trained (Xie et al., "OmniControl", ICLR 2024, section 4; MaskControl; InterControl): at 1, 2
//! or 5 frames, at a quarter of them or at all, each as often. The paper of the planners does not say how it draws.

use crate::autodiff::Stream;
use crate::model::{CONSTRAINT_DIM, PoseConstraint};
use crate::motion::quaternion::normalize;
use crate::motion::{Channel, Normalizer};
use crate::training::batch::Batch;

/// Streams of what is asked, apart from those of masks; a batch has one for each window.
const CONSTRAINTS: u64 = 1 << 61;
/// Numbers of a window that are not those of its frames: whether it is withheld, at how many frames, and of what.
const N_OF_WINDOW: usize = 3;
/// Subsets of floor, height and orientation, but the empty one; each as often.
const N_SUBSETS: usize = 7;

/// What is asked of the windows of a batch.
#[derive(Clone, Debug, PartialEq)]
pub struct DrawnConstraints {
    /// \[B, T, 12\]
    pub channels: Vec<f32>,
    /// 1 for windows that go without, \[B\].
    pub dropped: Vec<f32>,
}

impl DrawnConstraints {
    /// Draws; same batch and seed, same constraints. `dropout` is the probability that a window goes without.
    pub fn new(batch: &Batch, normalizer: &Normalizer, dropout: f64, seed: u64) -> Self {
        let n_frames = batch.n_frames;
        let width = normalizer.layout().width();
        let mut channels = vec![0.0; batch.n_windows * n_frames * CONSTRAINT_DIM];
        let mut dropped = Vec::with_capacity(batch.n_windows);
        let mut numbers = vec![0.0_f64; N_OF_WINDOW + n_frames];
        let windows = channels.chunks_exact_mut((n_frames * CONSTRAINT_DIM).max(1));
        for (b, channels) in windows.enumerate() {
            Stream::new(seed, CONSTRAINTS + b as u64).uniform(0, &mut numbers);
            let (of_window, order) = numbers.split_at(N_OF_WINDOW);
            dropped.push(f32::from(u8::from(of_window[0] < dropout)));
            let mask = &batch.mask[b * n_frames..(b + 1) * n_frames];
            let mut frames: Vec<usize> = (0..n_frames).filter(|&t| mask[t] > 0.0).collect();
            frames.sort_by(|&s, &t| order[s].total_cmp(&order[t]));
            frames.truncate(n_asked(frames.len(), of_window[1]));
            let subset = 1 + ((of_window[2] * N_SUBSETS as f64) as usize).min(N_SUBSETS - 1);
            let motion = &batch.motion[b * n_frames * width..(b + 1) * n_frames * width];
            for t in frames {
                let asked = asked(&motion[t * width..(t + 1) * width], normalizer, subset);
                channels[t * CONSTRAINT_DIM..(t + 1) * CONSTRAINT_DIM]
                    .copy_from_slice(&asked.channels());
            }
        }
        Self { channels, dropped }
    }
}

/// Returns of how many of n frames something is asked: 1, 2, 5, a quarter, all, each as often.
fn n_asked(n: usize, u: f64) -> usize {
    let choices = [1, 2, 5, n.div_ceil(4), n];
    choices[((u * choices.len() as f64) as usize).min(choices.len() - 1)].min(n)
}

/// Returns what is asked of a frame, in the tokenizer's units; of the subset bit 0 is the floor, 1 the height, 2 the
/// orientation.
fn asked(frame: &[f32], normalizer: &Normalizer, subset: usize) -> PoseConstraint {
    let has = |bit: usize| subset & (1 << bit) != 0;
    let [x, y, z] = [0, 1, 2].map(|axis| frame[Channel::Position.range().start + axis]);
    let first = Channel::Quaternion.range().start;
    let q = std::array::from_fn(|i| {
        let channel = first + i;
        f64::from(frame[channel] * normalizer.scale[channel] + normalizer.centre[channel])
    });
    PoseConstraint {
        floor: has(0).then_some([x, z]),
        height: has(1).then_some(y),
        orientation: has(2).then(|| normalize(q)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FRAMES: usize = 38;
    const WINDOWS: usize = 2_000;

    /// Windows of which every other has 21 frames; positions tell window and frame, and all face +X.
    fn batch() -> Batch {
        let mut batch = Batch::empty(WINDOWS, FRAMES, 1, 163);
        batch.n_windows = WINDOWS;
        for b in 0..WINDOWS {
            let n = if b % 2 == 0 { FRAMES } else { 21 };
            batch.mask.extend((0..FRAMES).map(|t| if t < n { 1.0 } else { 0.0 }));
            for t in 0..FRAMES {
                let mut frame = [0.0_f32; 25];
                frame[..3].copy_from_slice(&[t as f32, 0.5 * t as f32, b as f32]);
                frame[9] = 0.5_f32.sqrt();
                frame[11] = 0.5_f32.sqrt();
                batch.motion.extend(frame);
            }
        }
        batch
    }

    fn drawn(seed: u64) -> DrawnConstraints {
        DrawnConstraints::new(&batch(), &Normalizer::identity(), 0.25, seed)
    }

    #[test]
    fn windows_are_asked_for_what_they_are_at_as_many_frames_as_control_is_trained_with() {
        let found = drawn(5);
        let mut counts = std::collections::BTreeMap::new();
        let mut subsets = [0_u32; 8];
        for (b, window) in found.channels.chunks(FRAMES * CONSTRAINT_DIM).enumerate() {
            let n_frames = if b % 2 == 0 { FRAMES } else { 21 };
            let (mut n, mut subset) = (0, 0);
            for (t, row) in window.chunks(CONSTRAINT_DIM).enumerate() {
                let has = [9, 10, 11].map(|i| row[i] == 1.0);
                if !has.contains(&true) {
                    assert_eq!(row, [0.0; CONSTRAINT_DIM]);
                    continue;
                }
                assert!(t < n_frames, "nothing is asked beyond a phrase");
                n += 1;
                let of_frame = has.iter().enumerate().map(|(i, &has)| usize::from(has) << i).sum();
                assert!(n == 1 || of_frame == subset, "a window is asked for the same throughout");
                subset = of_frame;
                let pose = (t as f32, 0.5 * t as f32, b as f32);
                assert_eq!((row[0], row[1]), if has[0] { (pose.0, pose.2) } else { (0.0, 0.0) });
                assert_eq!(row[2], if has[1] { pose.1 } else { 0.0 });
                assert!((row[3] - f32::from(u8::from(has[2]))).abs() < 1e-6, "{row:?}");
            }
            subsets[subset] += 1;
            if b % 2 == 0 {
                *counts.entry(n).or_insert(0) += 1;
            }
        }
        assert_eq!(counts.keys().copied().collect::<Vec<_>>(), [1, 2, 5, 10, FRAMES]);
        // Five deviations of a binomial of 1,000 and 1/5, of 2,000 and 1/7.
        assert!(counts.values().all(|&n: &i32| (n - 200).abs() < 64), "{counts:?}");
        assert!(subsets[1..].iter().all(|&n| n.abs_diff(286) < 79), "{subsets:?}");
        let dropped: f32 = found.dropped.iter().sum();
        assert!((dropped - 500.0).abs() < 97.0, "{dropped}");
    }

    #[test]
    fn what_is_asked_follows_from_the_seed() {
        assert_eq!(drawn(5), drawn(5));
        assert_ne!(drawn(5), drawn(6));
    }
}
