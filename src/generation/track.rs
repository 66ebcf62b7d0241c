//! Motion for a track of any length: windows sampled together where they meet, and joined.
//!
//! Windows that share frames are brought to agree on them at every step of the sampling, so that each is
//! sampled with its neighbours in view (Bar-Tal et al., "MultiDiffusion", ICML 2023, arXiv 2302.08113, for
//! images; Tseng et al., "EDGE", CVPR 2023, arXiv 2211.10658, section 4.3, for dance; here the shared
//! frames are first placed where each window stands). A long track is sampled in runs of windows, of which
//! the next begins from the last window of the one before: memory does not grow with the track, and what
//! is finished can be watched.

use ndarray::{Array2, Array3, ArrayView2, Axis, s};

use crate::autodiff::Stream;
use crate::diffusion::Refine;
use crate::motion::quaternion::{Quaternion, dot};
use crate::motion::style::STYLE_DIM;
use crate::motion::{Channel, MOTION_DIM, Normalizer, Placement};

use super::control::Constraints;
use super::engine::{Engine, EngineError};
use super::sampling::{Sampling, sample};
use super::seam::{Joiner, agree, follow};
use super::windows::Windows;

/// Windows that are sampled at once. What is sampled depends on it, so that it is no setting: four are a
/// quarter of a minute, and as large a batch as two cores profit from.
pub const RUN_WINDOWS: usize = 4;

/// Frames that neighbouring windows share, by default: one second.
pub const OVERLAP_FRAMES: usize = 30;

/// The model and settings that motion is generated with.
#[derive(Clone, Copy)]
pub struct Generator<'a> {
    pub engine: &'a dyn Engine,
    pub sampling: Sampling<'a>,
    pub normalizer: &'a Normalizer,
    /// Frames of a window, as the model was trained.
    pub window_frames: usize,
    /// Frames that neighbours share, below those of a window.
    pub overlap_frames: usize,
}

/// The conditions of a track that motion is generated for.
#[derive(Clone, Copy, Debug)]
pub struct Track<'a> {
    /// The condition of the network: features as the table has them, then the clock if it takes one,
    /// \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Bar phase of the music, in [0, 1), \[T\]: motion is sampled with this phase, for a network that hears the clock.
    pub phase: Option<&'a [f64]>,
    pub seed: u64,
    /// Normalised style, for a model that takes one.
    pub style: Option<[f32; STYLE_DIM]>,
    pub constraints: Option<WeightedConstraints<'a>>,
    pub primed: Option<PrimingMotion<'a>>,
}

/// Constraints, and how strictly sampling keeps them.
#[derive(Clone, Copy, Debug)]
pub struct WeightedConstraints<'a> {
    pub constraints: &'a Constraints,
    /// Share of the way that an estimate is bent at every step: 1 is in-painting.
    pub strength: f64,
}

/// Motion that sampling begins from instead of noise alone.
#[derive(Clone, Copy, Debug)]
pub struct PrimingMotion<'a> {
    /// Motion for every window of the track, in its own place: windows × frames, \[n T, 25\] in metres.
    pub motion: ArrayView2<'a, f32>,
    /// Steps of the diffusion that are left to sample, out of all that were trained.
    pub n_left: usize,
}

impl Generator<'_> {
    /// Returns how a track of `n_frames` is cut.
    pub fn windows(&self, n_frames: usize) -> Windows {
        Windows::new(n_frames, self.window_frames, self.overlap_frames)
    }

    /// Makes motion for a track, and gives out its frames in order, `[…, 25]` in metres, as they are final.
    ///
    /// The track begins at the origin and faces +Z, unless constraints say otherwise. Same track and seed,
    /// same frames: the noise of a frame depends on nothing but its number and the seed.
    ///
    /// # Errors
    /// What the engine or `emit` says; what the sampler refuses.
    pub fn run<E: From<EngineError>>(
        &self,
        track: &Track,
        mut emit: impl FnMut(Array2<f32>) -> Result<(), E>,
    ) -> Result<(), E> {
        let windows = self.windows(track.condition.nrows());
        let origin = Placement::default();
        let start = track.constraints.map_or(origin, |c| c.constraints.placement(origin));
        let (mut last, mut n_given): (Option<Quaternion>, usize) = (None, 0);
        let mut give = |mut frames: Array2<f32>,
                        emit: &mut dyn FnMut(Array2<f32>) -> Result<(), E>| {
            if frames.nrows() == 0 {
                return Ok(());
            }
            start.restore(&mut frames);
            last = continue_signs(&mut frames, last);
            if let Some(phase) = track.phase {
                // What is asked of a track exactly is no matter of the decoder's rounding.
                let column = frames.column_mut(Channel::Phase.range().start);
                column.into_iter().zip(&phase[n_given..]).for_each(|(x, phase)| *x = *phase as f32);
            }
            n_given += frames.nrows();
            emit(frames)
        };
        let mut joiner = Joiner::new(self.normalizer.layout());
        let mut before: Option<Window> = None;
        for run in windows.runs(RUN_WINDOWS) {
            let first = match &before {
                Some(Window { motion, place }) => {
                    place.of_inner(placement_at(motion, windows.shift(run.start)))
                }
                None => start,
            };
            let job = Run { windows: &windows, range: run.clone(), before: before.as_ref(), first };
            let latent = self.sample_run(track, &job)?;
            let decoded = self.engine.decode(latent.view())?;
            for (i, window) in run.clone().zip(decoded.outer_iter()) {
                give(joiner.push(window.to_owned(), windows.n_final(i)), &mut emit)?;
            }
            let motions = self.motions(&latent);
            let place = job.places(&motions).pop().unwrap_or(first);
            before = motions.into_iter().last().map(|motion| Window { motion, place });
        }
        Ok(())
    }

    /// Samples the windows of a run together. → \[windows, frames, 25\], normalised
    fn sample_run(&self, track: &Track, run: &Run) -> Result<Array3<f32>, EngineError> {
        let (n, frames) = (run.range.len(), run.windows.length());
        let audio = stacked(track.condition, run, frames);
        let style = track
            .style
            .map(|style| Array2::from_shape_fn((n, STYLE_DIM), |(_, channel)| style[channel]));
        let mut x = Array3::zeros((n, frames, MOTION_DIM));
        run.fill(track.seed, 0, x.as_slice_mut().expect("an array made in order"));
        let mut n_left = self.sampling.schedule.len();
        if let Some(primed) = &track.primed {
            n_left = primed.n_left.clamp(1, n_left);
            let mut x0 = Array3::zeros(x.raw_dim());
            for (i, mut window) in run.range.clone().zip(x0.outer_iter_mut()) {
                window.assign(&primed.motion.slice(s![i * frames..(i + 1) * frames, ..]));
                self.normalizer.normalize(window);
            }
            x = self.sampling.schedule.add_noise(x0.view(), x.view(), &vec![n_left - 1; n]);
        }
        let mut refine = |x0: &mut Array3<f32>| self.refine(track, run, x0);
        let is_refined =
            n > 1 || run.before.is_some() || track.constraints.is_some() || track.phase.is_some();
        let refine: Option<Refine> = if is_refined { Some(&mut refine) } else { None };
        // Draw 0 is the noise that sampling begins with.
        let noise = |draw: usize, z: &mut [f32]| run.fill(track.seed, draw as u64 + 1, z);
        let style = style.as_ref().map(|style| style.view());
        sample(self.engine, self.sampling, (x, n_left), audio.view(), style, noise, refine)
    }

    /// Brings the estimates of a run's windows to agree with each other, with what came before, with the phase of
    /// the music, and with what is asked of the track.
    fn refine(&self, track: &Track, run: &Run, x0: &mut Array3<f32>) {
        let estimated = self.motions(x0);
        let mut motions = estimated.clone();
        let layout = self.normalizer.layout();
        if let Some(before) = run.before {
            follow(layout, before.motion.view(), &mut motions[0], run.shift(0));
        }
        for i in 1..motions.len() {
            let (earlier, later) = motions.split_at_mut(i);
            agree(layout, &mut earlier[i - 1], &mut later[0], run.shift(i));
        }
        if let Some(WeightedConstraints { constraints, strength }) = track.constraints {
            let places = run.places(&motions);
            for ((i, motion), place) in run.range.clone().zip(&mut motions).zip(places) {
                let frames = run.windows.frames(i);
                if constraints.touch(&frames) {
                    place.restore(motion);
                    constraints.bend(motion, frames.start, strength);
                    place.remove(motion);
                }
            }
        }
        if let Some(phase) = track.phase {
            for (i, motion) in run.range.clone().zip(&mut motions) {
                let frames = run.windows.frames(i);
                let column = motion.column_mut(Channel::Phase.range().start);
                for (x, phase) in column.into_iter().zip(&phase[frames]) {
                    *x = *phase as f32;
                }
            }
        }
        // What nothing has changed keeps its bits.
        for ((mut x0, motion), estimated) in x0.outer_iter_mut().zip(&motions).zip(&estimated) {
            for ((mut x0, row), before) in
                x0.rows_mut().into_iter().zip(motion.rows()).zip(estimated.rows())
            {
                if row != before {
                    x0.assign(&row);
                    self.normalizer.normalize(x0.insert_axis(Axis(0)));
                }
            }
        }
    }

    /// Returns windows in metres.
    fn motions(&self, latent: &Array3<f32>) -> Vec<Array2<f32>> {
        let motion = |window: ArrayView2<f32>| {
            let mut motion = window.to_owned();
            self.normalizer.denormalize(motion.view_mut());
            motion
        };
        latent.outer_iter().map(motion).collect()
    }
}

/// A window that does not change any more.
struct Window {
    /// As it was sampled, in its own place, \[T, 25\].
    motion: Array2<f32>,
    /// Where it stands in the world.
    place: Placement,
}

/// Windows that are sampled together.
struct Run<'a> {
    windows: &'a Windows,
    range: std::ops::Range<usize>,
    before: Option<&'a Window>,
    /// Where the first of them stands in the world.
    first: Placement,
}

impl Run<'_> {
    /// How far window i of the run lies behind the one before it.
    fn shift(&self, i: usize) -> usize {
        self.windows.shift(self.range.start + i)
    }

    /// Returns where the windows stand in the world.
    fn places(&self, motions: &[Array2<f32>]) -> Vec<Placement> {
        let mut place = self.first;
        let mut places = Vec::with_capacity(motions.len());
        for i in 0..motions.len() {
            if i > 0 {
                place = place.of_inner(placement_at(&motions[i - 1], self.shift(i)));
            }
            places.push(place);
        }
        places
    }

    /// Fills the run's windows, \[windows, frames, 25\], with the noise of a draw: that of a frame is the same
    /// in every window that has it.
    fn fill(&self, seed: u64, draw: u64, z: &mut [f32]) {
        let stream = Stream::new(seed, draw);
        let size = self.windows.length() * MOTION_DIM;
        for (i, z) in self.range.clone().zip(z.chunks_exact_mut(size)) {
            stream.normal(self.windows.frames(i).start * MOTION_DIM, z);
        }
    }
}

/// Gives each orientation the sign that is nearer to the one before, q and −q being one orientation; returns the
/// last.
pub(super) fn continue_signs(
    frames: &mut Array2<f32>,
    before: Option<Quaternion>,
) -> Option<Quaternion> {
    let columns = Channel::Quaternion.range();
    let mut before = before;
    for mut row in frames.rows_mut() {
        let mut q: Quaternion = std::array::from_fn(|i| f64::from(row[columns.start + i]));
        if before.is_some_and(|before| dot(before, q) < 0.0) {
            row.slice_mut(s![columns.clone()]).mapv_inplace(|x| -x);
            q = q.map(|x| -x);
        }
        before = Some(q);
    }
    before
}

/// Returns where a motion stands at a frame.
pub(super) fn placement_at(motion: &Array2<f32>, frame: usize) -> Placement {
    Placement::of_first(motion.slice(s![frame.., ..])).unwrap_or_default()
}

/// Returns the condition of a run's windows, \[windows, frames, condition_dim\].
fn stacked(condition: ArrayView2<f32>, run: &Run, frames: usize) -> Array3<f32> {
    let mut audio = Array3::zeros((run.range.len(), frames, condition.ncols()));
    for (i, mut window) in run.range.clone().zip(audio.outer_iter_mut()) {
        window.assign(&condition.slice(s![run.windows.frames(i), ..]));
    }
    audio
}

#[cfg(test)]
mod tests;
