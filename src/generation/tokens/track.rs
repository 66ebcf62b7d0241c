//! Motion for a track of any length: tokens planned window by window, and motion made of them by diffusion.
//!
//! Neighbouring windows share tokens. A token tells where a body is from the first frame of its window on, so that the
//! tokens that two windows share are not the same numbers: the end of a window is made to motion, placed like the
//! beginning of a window, and becomes tokens again, from which the plan of the next window goes on. The shared frames
//! of its motion are then brought to those of the window before at every step, as for the UNet
//! ([`crate::generation::Generator`]).

use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView2, Axis, s};

use super::constraints::{Control, window_constraints};
use super::control::{Steering, steer};
use super::engine::TokenEngine;
use super::planner::{PlanRequest, PlannerEngine};
use crate::autodiff::Stream;
use crate::diffusion::{Refine, SamplerConfig, Schedule, TokenSampling};
use crate::generation::engine::EngineError;
use crate::generation::seam::{Joiner, follow};
use crate::generation::track::{WeightedConstraints, continue_signs, placement_at};
use crate::generation::windows::Windows;
use crate::motion::style::STYLE_DIM;
use crate::motion::{Channel, MOTION_DIM, Placement};

/// The networks and settings that motion is made with.
#[derive(Clone, Copy)]
pub struct TokenGenerator<'a> {
    pub tokens: &'a TokenEngine,
    pub planner: &'a PlannerEngine,
    /// How tokens are drawn.
    pub plan: &'a TokenSampling,
    /// How motion is made of them.
    pub sampler: &'a SamplerConfig,
    pub schedule: &'a Schedule,
    /// Of the plan: 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// Tokens that neighbours share, below those of a window.
    pub overlap_tokens: usize,
}

/// The conditions of a track that motion is made for.
#[derive(Clone, Copy, Debug)]
pub struct TokenTrack<'a> {
    /// Features as the table has them, then the clock if the network takes one, \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Bar phase of the music, in [0, 1), \[T\]: motion is made with this phase.
    pub phase: Option<&'a [f64]>,
    /// Normalised style, for a planner that takes one.
    pub style: Option<[f32; STYLE_DIM]>,
    /// Constraints; the strength is the length of a step of the descent.
    pub constraints: Option<WeightedConstraints<'a>>,
    /// Where they act.
    pub control: Control,
    /// Where the track begins, unless constraints say otherwise.
    pub place: Placement,
    /// Tokens of the windows that are set beforehand, in order ([`super::kept_of`]); none are of a soloist.
    pub kept: &'a [Vec<Option<u32>>],
    pub seed: u64,
}

impl<'a> TokenTrack<'a> {
    /// Returns a track that begins at the origin, by its music and seed alone.
    pub fn new(condition: ArrayView2<'a, f32>, seed: u64) -> Self {
        Self {
            condition,
            phase: None,
            style: None,
            constraints: None,
            control: Control::None,
            place: Placement::default(),
            kept: &[],
            seed,
        }
    }
}

/// A window that does not change any more.
struct Window {
    /// Over the origin, in metres, \[n, 25\].
    motion: Array2<f32>,
    /// Where it stands in the world.
    place: Placement,
}

/// Frames at the beginning of a window that constraints behind them do not move: of the first window one, since a track
/// begins where it begins, of others those in which it leaves the window before.
const PINNED_FRAMES: [usize; 2] = [1, 3];

/// How a track is cut, in frames; every window begins with a token.
struct FrameWindows {
    of_tokens: Windows,
    frames_per_token: usize,
    n_frames: usize,
}

impl FrameWindows {
    fn frames(&self, i: usize) -> Range<usize> {
        let tokens = self.of_tokens.frames(i);
        let rho = self.frames_per_token;
        tokens.start * rho..(tokens.end * rho).min(self.n_frames)
    }

    /// How many of the first frames of window i no later window has.
    fn n_final(&self, i: usize) -> usize {
        let n = self.of_tokens.n_final(i) * self.frames_per_token;
        n.min(self.frames(i).len())
    }

    /// How far window i lies behind the one before it.
    fn shift(&self, i: usize) -> usize {
        self.of_tokens.shift(i) * self.frames_per_token
    }
}

impl TokenGenerator<'_> {
    fn windows(&self, n_frames: usize) -> FrameWindows {
        let sizes = self.tokens.sizes();
        let length = sizes.n_tokens(self.tokens.window_frames());
        let of_tokens = Windows::new(sizes.n_tokens(n_frames), length, self.overlap_tokens);
        FrameWindows { of_tokens, frames_per_token: sizes.frames_per_token, n_frames }
    }

    /// Returns how many windows a track of so many frames has.
    pub fn n_windows(&self, n_frames: usize) -> usize {
        self.windows(n_frames).of_tokens.len()
    }

    /// Makes motion for a track, and gives out its frames in order, `[…, 25]` in metres, as they are final; returns the
    /// plan of each window.
    ///
    /// Same track and seed, same frames.
    ///
    /// # Errors
    /// What the engines or `emit` say; what the samplers refuse.
    pub fn run<E: From<EngineError>>(
        &self,
        track: &TokenTrack,
        mut emit: impl FnMut(Array2<f32>) -> Result<(), E>,
    ) -> Result<Vec<Vec<u32>>, E> {
        let windows = self.windows(track.condition.nrows());
        let start = track.constraints.map_or(track.place, |c| c.constraints.placement(track.place));
        let mut plans = Vec::with_capacity(windows.of_tokens.len());
        let (mut last, mut n_given) = (None, 0);
        let mut give = |mut frames: Array2<f32>,
                        emit: &mut dyn FnMut(Array2<f32>) -> Result<(), E>| {
            if frames.nrows() == 0 {
                return Ok(());
            }
            start.restore(&mut frames);
            last = continue_signs(&mut frames, last);
            set_phase(&mut frames, track.phase, n_given);
            n_given += frames.nrows();
            emit(frames)
        };
        let mut joiner = Joiner::new(self.tokens.normalizer().layout());
        let mut before: Option<Window> = None;
        for i in 0..windows.of_tokens.len() {
            let place = match &before {
                Some(Window { motion, place }) => {
                    place.of_inner(placement_at(motion, windows.shift(i)))
                }
                None => start,
            };
            let before_it = before.as_ref().map(|before| &before.motion);
            let (plan, motion) = self.window(track, &windows, i, (before_it, place))?;
            plans.push(plan);
            give(joiner.push(motion.clone(), windows.n_final(i)), &mut emit)?;
            before = Some(Window { motion, place });
        }
        Ok(plans)
    }

    /// Plans a window and makes its motion, over the origin, in metres, \[n, 25\].
    fn window(
        &self,
        track: &TokenTrack,
        windows: &FrameWindows,
        i: usize,
        (before, place): (Option<&Array2<f32>>, Placement),
    ) -> Result<(Vec<u32>, Array2<f32>), EngineError> {
        let (frames, shift) = (windows.frames(i), windows.shift(i));
        let before = before.filter(|before| shift < before.nrows());
        let known = match before {
            Some(before) => self.tokens_from(before, shift)?,
            None => Vec::new(),
        };
        let kept = track.kept.get(i).map_or(&[][..], |kept| kept.get(known.len()..).unwrap_or(&[]));
        let given: Vec<Option<u32>> =
            known.into_iter().map(Some).chain(kept.iter().copied()).collect();
        let normalizer = self.tokens.normalizer();
        let asked = track.constraints.filter(|_| track.control.plans()).and_then(|request| {
            window_constraints(request.constraints, &frames, place, normalizer)
        });
        let request = PlanRequest {
            constraints: asked.as_ref().map(|asked| asked.view()),
            condition: track.condition.slice(s![frames.clone(), ..]),
            style: track.style,
            given: &given,
            guidance: self.guidance,
            seed: track.seed,
            window: i as u64,
        };
        let tokens = self.planner.plan(self.plan, &request)?;
        // The noise of a frame depends on nothing but its number and the seed; draw 0 is what sampling begins with.
        let fill = |draw: u64, z: &mut [f32]| {
            Stream::new(track.seed, draw).normal(frames.start * MOTION_DIM, z);
        };
        let mut x = Array3::zeros((1, frames.len(), MOTION_DIM));
        fill(0, x.as_slice_mut().expect("an array made in order"));
        let steered =
            track.constraints.filter(|c| track.control.decodes() && c.constraints.touch(&frames));
        let mut refine = |x0: &mut Array3<f32>| {
            let mut motion = x0.index_axis(Axis(0), 0).to_owned();
            normalizer.denormalize(motion.view_mut());
            if let Some(before) = before {
                follow(normalizer.layout(), before.view(), &mut motion, shift);
            }
            if let Some(WeightedConstraints { constraints, strength }) = steered {
                let n_pinned = PINNED_FRAMES[usize::from(before.is_some())];
                place.restore(&mut motion);
                let steering = Steering::Estimate { n_pinned, share: strength };
                steer(constraints, &mut motion, frames.start, steering);
                place.remove(&mut motion);
            }
            set_phase(&mut motion, track.phase, frames.start);
            normalizer.normalize(motion.view_mut());
            x0.index_axis_mut(Axis(0), 0).assign(&motion);
        };
        let is_refined = before.is_some() || track.phase.is_some() || steered.is_some();
        let refine: Option<Refine> = if is_refined { Some(&mut refine) } else { None };
        let noise = |draw: usize, z: &mut [f32]| fill(draw as u64 + 1, z);
        let how = (self.sampler, self.schedule);
        let sampled = self.tokens.decode(&tokens, x, how, noise, refine)?;
        let mut motion = sampled.index_axis(Axis(0), 0).to_owned();
        normalizer.denormalize(motion.view_mut());
        Ok((tokens, motion))
    }

    /// Returns the tokens of the end of a window, from a frame on, as those of the beginning of the next.
    fn tokens_from(&self, before: &Array2<f32>, first: usize) -> Result<Vec<u32>, EngineError> {
        let mut shared = before.slice(s![first.., ..]).to_owned();
        if let Some(placement) = Placement::of_first(shared.view()) {
            placement.remove(&mut shared);
        }
        self.tokens.tokens(&[shared])
    }
}

/// Writes the phase of the music, where that is known, into frames, the first of which is frame `first` of a track.
fn set_phase(frames: &mut Array2<f32>, phase: Option<&[f64]>, first: usize) {
    if let Some(phase) = phase {
        let column = frames.column_mut(Channel::Phase.range().start);
        column.into_iter().zip(&phase[first..]).for_each(|(x, phase)| *x = *phase as f32);
    }
}

#[cfg(test)]
mod tests;
