//! Motion of a group for a track of any length: windows sampled together where they meet, and joined.
//!
//! Windows that share frames agree on them at every step of the sampling, as those of a soloist do
//! ([`crate::generation::Generator`]). A group stays on its stage, so that all windows have one place; but which
//! dancer of a window is which of the next is open, and is decided at every step by the Hungarian method on the
//! shared frames (GCD, section 4.5).

use ndarray::{Array3, ArrayView2, ArrayView3, Axis, s};

use super::engine::{ConsistencyForm, GroupEngineInputs, GroupEstimator};
use crate::autodiff::Stream;
use crate::diffusion::{SamplerConfig, Schedule, sample_refined};
use crate::generation::engine::EngineError;
use crate::generation::track::RUN_WINDOWS;
use crate::generation::windows::Windows;
use crate::motion::group::{blend, match_dancers};
use crate::motion::{Channel, MOTION_DIM, Normalizer};

/// Draw of the noise of the group embedding.
const EMBEDDING_DRAW: u64 = u64::MAX;

/// The model and settings that motion of a group is generated with.
#[derive(Clone, Copy)]
pub struct GroupGenerator<'a> {
    pub engine: &'a dyn GroupEstimator,
    pub sampler: &'a SamplerConfig,
    pub schedule: &'a Schedule,
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// γ: above 0 dancers move alike, below 0 each in a way of their own.
    pub consistency: f64,
    pub form: ConsistencyForm,
    pub normalizer: &'a Normalizer,
    /// Frames of a window, as the model was trained.
    pub window_frames: usize,
    /// Frames that neighbours share, below those of a window.
    pub overlap_frames: usize,
}

/// The conditions of a track that motion of a group is generated for.
#[derive(Clone, Copy, Debug)]
pub struct GroupTrack<'a> {
    /// Features as the table has them, then the clock if the network takes one, \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Bar phase of the music, in [0, 1), \[T\]: motion is sampled with this phase.
    pub phase: Option<&'a [f64]>,
    pub seed: u64,
    pub n_dancers: usize,
}

impl GroupGenerator<'_> {
    /// Returns how a track of `n_frames` is cut.
    pub fn windows(&self, n_frames: usize) -> Windows {
        Windows::new(n_frames, self.window_frames, self.overlap_frames)
    }

    /// Makes motion for a track, and gives out its frames in order, `[N, …, 25]` in metres, as they are final.
    ///
    /// Same track and seed, same frames: the noise of a dancer's frame depends on nothing but its number and the seed.
    ///
    /// # Errors
    /// What the engine or `emit` says; what the sampler refuses.
    pub fn run<E: From<EngineError>>(
        &self,
        track: &GroupTrack,
        mut emit: impl FnMut(Array3<f32>) -> Result<(), E>,
    ) -> Result<(), E> {
        let windows = self.windows(track.condition.nrows());
        let mut z = vec![0.0; self.engine.embedding_dim()];
        Stream::new(track.seed, EMBEDDING_DRAW).normal(0, &mut z);
        let mut before: Option<Array3<f32>> = None;
        for run in windows.runs(RUN_WINDOWS) {
            let made = self.sample_run(track, &windows, run.clone(), before.as_ref(), &z)?;
            // Frames are given out by the last window that has them, whose blend ends as itself.
            for (i, motion) in run.clone().zip(&made) {
                emit(with_phase(
                    motion.slice(s![.., ..windows.n_final(i), ..]),
                    track.phase,
                    windows.frames(i).start,
                ))?;
            }
            before = made.into_iter().last();
        }
        Ok(())
    }

    /// Samples the windows of a run together. → windows of \[N, frames, 25\], in metres
    fn sample_run(
        &self,
        track: &GroupTrack,
        windows: &Windows,
        run: std::ops::Range<usize>,
        before: Option<&Array3<f32>>,
        z: &[f32],
    ) -> Result<Vec<Array3<f32>>, EngineError> {
        let (n, frames, n_dancers) = (run.len(), windows.length(), track.n_dancers);
        let mut audio = Array3::zeros((n, frames, track.condition.ncols()));
        for (i, mut window) in run.clone().zip(audio.outer_iter_mut()) {
            window.assign(&track.condition.slice(s![windows.frames(i), ..]));
        }
        let fill = |draw: u64, z: &mut [f32]| {
            // The noise of a dancer's frame is the same in every window that has it.
            let rows = z.chunks_exact_mut(frames * MOTION_DIM);
            for (row, z) in rows.enumerate() {
                let (window, dancer) = (run.start + row / n_dancers, row % n_dancers);
                let stream = Stream::new(track.seed.wrapping_add(dancer as u64), draw);
                stream.normal(windows.frames(window).start * MOTION_DIM, z);
            }
        };
        let mut x = Array3::zeros((n * n_dancers, frames, MOTION_DIM));
        fill(0, x.as_slice_mut().expect("an array made in order"));
        let denoise = |x: ArrayView3<f32>, t: usize| {
            self.engine.predict(&GroupEngineInputs {
                x,
                t,
                audio: audio.view(),
                n_dancers,
                z,
                guidance: self.guidance,
                consistency: (self.form, self.form.factor(self.schedule, t, self.consistency)),
            })
        };
        let mut refine = |x0: &mut Array3<f32>| {
            let mut motions = self.motions(x0, n_dancers);
            self.stitch(&mut motions, windows, run.clone(), before);
            for (i, motion) in run.clone().zip(&mut motions) {
                *motion = with_phase(motion.view(), track.phase, windows.frames(i).start);
            }
            for (mut x0, motion) in x0.axis_chunks_iter_mut(Axis(0), n_dancers).zip(&motions) {
                x0.assign(motion);
                x0.outer_iter_mut().for_each(|dancer| self.normalizer.normalize(dancer));
            }
        };
        let noise = |draw: usize, z: &mut [f32]| fill(draw as u64 + 1, z);
        let start = (x, self.schedule.len());
        let latent = sample_refined(
            self.sampler,
            self.schedule,
            start,
            denoise,
            noise,
            None,
            Some(&mut refine),
        )?;
        Ok(self.motions(&latent, n_dancers))
    }

    /// Names the dancers of every window as the one before does, and makes both agree on the frames that they share.
    fn stitch(
        &self,
        motions: &mut [Array3<f32>],
        windows: &Windows,
        run: std::ops::Range<usize>,
        before: Option<&Array3<f32>>,
    ) {
        if let Some(before) = before {
            let shift = windows.shift(run.start);
            let left = before.slice(s![.., shift.., ..]);
            follow(left, &mut motions[0]);
        }
        for i in 1..motions.len() {
            let shift = windows.shift(run.start + i);
            let (earlier, later) = motions.split_at_mut(i);
            let earlier = &mut earlier[i - 1];
            let left = earlier.slice(s![.., shift.., ..]).to_owned();
            let shared = follow(left.view(), &mut later[0]);
            earlier.slice_mut(s![.., shift.., ..]).assign(&shared);
        }
    }

    /// Returns windows in metres.
    fn motions(&self, latent: &Array3<f32>, n_dancers: usize) -> Vec<Array3<f32>> {
        let motion = |window: ArrayView3<f32>| {
            let mut motion = window.to_owned();
            motion.outer_iter_mut().for_each(|dancer| self.normalizer.denormalize(dancer));
            motion
        };
        latent.axis_chunks_iter(Axis(0), n_dancers).map(motion).collect()
    }
}

/// Brings the beginning of a window to the end of the one before it; returns the frames that both share.
fn follow(left: ArrayView3<f32>, later: &mut Array3<f32>) -> Array3<f32> {
    let n_shared = left.dim().1.min(later.dim().1);
    let left = left.slice(s![.., ..n_shared, ..]);
    let order = match_dancers(left, later.slice(s![.., ..n_shared, ..]));
    *later = later.select(Axis(0), &order);
    let shared = blend(left, later.slice(s![.., ..n_shared, ..]));
    later.slice_mut(s![.., ..n_shared, ..]).assign(&shared);
    shared
}

/// Returns frames with the phase of the music, where that is known.
fn with_phase(motion: ArrayView3<f32>, phase: Option<&[f64]>, first: usize) -> Array3<f32> {
    let mut motion = motion.to_owned();
    if let Some(phase) = phase {
        let channel = Channel::Phase.range().start;
        for mut dancer in motion.outer_iter_mut() {
            let column = dancer.column_mut(channel);
            column.into_iter().zip(&phase[first..]).for_each(|(x, phase)| *x = *phase as f32);
        }
    }
    motion
}

#[cfg(test)]
mod tests;
