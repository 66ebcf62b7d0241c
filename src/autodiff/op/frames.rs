//! Operations on the number of frames: repeating, holding the last, cropping, masks.

use std::ops::Range;

use rayon::prelude::*;

use super::binary::add_assign;
use crate::autodiff::element::Element;
use crate::autodiff::operation::{Backward, Operation, Run, expect_axes, expect_size};
use crate::autodiff::tensor::Tensor;
use crate::model::{GraphError, Result};

const AXES: &str = "[batch, frames, channels]";

/// Takes frames by index, sample by sample: what repeating, holding and cropping have in common.
///
/// y\[b, i\] = x\[b, index\[i\]\]; the gradient of a frame is the sum over those that took it.
pub struct TakeFrames {
    name: &'static str,
    choose: Choice,
    index: Vec<usize>,
    frames: usize,
}

#[derive(Clone, Copy)]
enum Choice {
    Repeat {
        factor: usize,
    },
    Hold {
        multiple: usize,
    },
    /// As many as the second input has.
    Crop,
    /// Those behind as many as the second input has.
    Behind,
    /// All but some at either end.
    Inner {
        skip: usize,
        drop: usize,
    },
    /// Some, from the first on, or all behind it.
    From {
        first: usize,
        n: Option<usize>,
    },
    /// Those that come later, or earlier; past the first and the last that is not spared, that one.
    Shifted {
        shift: isize,
        spare: usize,
    },
}

impl TakeFrames {
    /// Each frame `factor` times, nearest neighbour: \[batch, frames, c\] → \[batch, factor · frames, c\].
    pub fn repeat(factor: usize) -> Self {
        Self::new("upsample", Choice::Repeat { factor })
    }

    /// The last frame repeated until their number is a multiple.
    pub fn hold(multiple: usize) -> Self {
        Self::new("hold_frames", Choice::Hold { multiple })
    }

    /// The first frames, as many as the second input has.
    pub fn crop() -> Self {
        Self::new("crop_frames", Choice::Crop)
    }

    /// All but the first frames, as many as the second input has.
    pub fn behind() -> Self {
        Self::new("frames_behind", Choice::Behind)
    }

    /// `n` frames from the frame `first` on, or all behind it.
    pub fn from(first: usize, n: Option<usize>) -> Self {
        Self::new("frames", Choice::From { first, n })
    }

    /// All frames but the first `skip` and the last `drop`.
    pub fn inner(skip: usize, drop: usize) -> Self {
        Self::new("inner_frames", Choice::Inner { skip, drop })
    }

    /// Frame t + `shift` at t, but none of the last `spare`: the one before them is held, as the first is.
    pub fn shifted(shift: isize, spare: usize) -> Self {
        Self::new("shift_frames", Choice::Shifted { shift, spare })
    }

    fn new(name: &'static str, choose: Choice) -> Self {
        Self { name, choose, index: Vec::new(), frames: 0 }
    }

    /// Returns the frames that are taken where each is once and they follow each other.
    fn run(&self) -> Option<Range<usize>> {
        let first = *self.index.first()?;
        let follow = self.index.iter().zip(first..).all(|(&i, wanted)| i == wanted);
        follow.then(|| first..first + self.index.len())
    }
}

impl<E: Element> Operation<E> for TakeFrames {
    fn name(&self) -> &'static str {
        self.name
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let input = x[0];
        expect_axes(self.name, "input", input, 3, AXES)?;
        let (batch, frames, channels) = (input.shape()[0], input.shape()[1], input.channels());
        if frames == 0 {
            return Err(GraphError::shape(self.name, "input has no frames"));
        }
        self.frames = frames;
        self.index = match self.choose {
            Choice::Repeat { factor } => (0..factor * frames).map(|i| i / factor).collect(),
            Choice::Hold { multiple } => {
                let n = frames.next_multiple_of(multiple.max(1));
                (0..n).map(|i| i.min(frames - 1)).collect()
            }
            Choice::Crop => {
                expect_axes(self.name, "the other input", x[1], 3, AXES)?;
                let wanted = x[1].shape()[1];
                if wanted > frames {
                    let problem = format!("input has {frames} frames, {wanted} asked for");
                    return Err(GraphError::shape(self.name, problem));
                }
                (0..wanted).collect()
            }
            Choice::Behind => {
                expect_axes(self.name, "the other input", x[1], 3, AXES)?;
                let past = x[1].shape()[1];
                if past >= frames {
                    let problem =
                        format!("input has {frames} frames, those behind {past} asked for");
                    return Err(GraphError::shape(self.name, problem));
                }
                (past..frames).collect()
            }
            Choice::Shifted { shift, spare } => {
                let last = (frames - 1).saturating_sub(spare);
                (0..frames).map(|i| i.saturating_add_signed(shift).min(last)).collect()
            }
            Choice::From { first, n } if first + n.unwrap_or(1) <= frames => {
                (first..n.map_or(frames, |n| first + n)).collect()
            }
            Choice::From { first, n } => {
                let asked = match n {
                    Some(n) => format!("{n} from frame {first} on"),
                    None => format!("those from frame {first} on"),
                };
                let problem = format!("input has {frames} frames, {asked} asked for");
                return Err(GraphError::shape(self.name, problem));
            }
            Choice::Inner { skip, drop } if skip + drop < frames => (skip..frames - drop).collect(),
            Choice::Inner { skip, drop } => {
                let problem =
                    format!("input has {frames} frames, all but {} asked for", skip + drop);
                return Err(GraphError::shape(self.name, problem));
            }
        };
        let shape = [batch, self.index.len(), channels];
        Ok(run.tensor(&shape, |y| {
            let n = (self.index.len() * channels).max(1);
            let samples = y.par_chunks_exact_mut(n);
            samples.zip(input.data().par_chunks_exact(frames * channels)).for_each(|(y, x)| {
                if let Some(run) = self.run() {
                    return y.copy_from_slice(&x[run.start * channels..run.end * channels]);
                }
                for (y, &i) in y.chunks_exact_mut(channels).zip(&self.index) {
                    y.copy_from_slice(&x[i * channels..][..channels]);
                }
            });
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let (batch, channels) = (dy.shape()[0], dy.channels());
        let sample = self.frames * channels;
        let mut found = at.only(|| {
            at.tensor(&[batch, self.frames, channels], |dx| {
                let n = (self.index.len() * channels).max(1);
                let samples = dx.par_chunks_exact_mut(sample).zip(dy.data().par_chunks_exact(n));
                samples.for_each(|(dx, dy)| {
                    if let Some(run) = self.run() {
                        let (before, rest) = dx.split_at_mut(run.start * channels);
                        let (own, behind) = rest.split_at_mut(dy.len());
                        own.copy_from_slice(dy);
                        before.fill(E::ZERO);
                        return behind.fill(E::ZERO);
                    }
                    dx.fill(E::ZERO);
                    for (dy, &i) in dy.chunks_exact(channels).zip(&self.index) {
                        add_assign(&mut dx[i * channels..][..channels], dy);
                    }
                });
            })
        });
        if matches!(self.choose, Choice::Crop | Choice::Behind) {
            found.push(None);
        }
        found
    }
}

/// The first frame of a second input, the last of a third, and in between those of the first.
///
/// All \[batch, frames, channels\] → the same; of a single frame the third input counts.
pub struct ReplaceEnds;

impl ReplaceEnds {
    /// Returns the input that frame t is taken from.
    fn source(t: usize, frames: usize) -> usize {
        if t + 1 == frames { 2 } else { usize::from(t == 0) }
    }
}

impl<E: Element> Operation<E> for ReplaceEnds {
    fn name(&self) -> &'static str {
        "replace_ends"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        expect_axes("replace_ends", "input", x[0], 3, AXES)?;
        for end in &x[1..] {
            if end.shape() != x[0].shape() {
                let (found, wanted) = (end.shape(), x[0].shape());
                let problem = format!("an end has shape {found:?}, input expects {wanted:?}");
                return Err(GraphError::shape("replace_ends", problem));
            }
        }
        let (frames, channels) = (x[0].shape()[1], x[0].channels());
        Ok(run.tensor(x[0].shape(), |y| {
            for (i, y) in y.chunks_exact_mut(channels.max(1)).enumerate() {
                let source = x[Self::source(i % frames, frames)];
                y.copy_from_slice(&source.data()[i * channels..][..channels]);
            }
        }))
    }

    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let (frames, channels) = (dy.shape()[1], dy.channels());
        let needs = at.needs.to_vec();
        let gradient = |input: usize| {
            at.tensor(dy.shape(), |dx| {
                let rows =
                    dx.chunks_exact_mut(channels.max(1)).zip(dy.data().chunks_exact(channels));
                for (i, (dx, dy)) in rows.enumerate() {
                    match Self::source(i % frames, frames) == input {
                        true => dx.copy_from_slice(dy),
                        false => dx.fill(E::ZERO),
                    }
                }
            })
        };
        needs.iter().enumerate().map(|(i, needed)| needed.then(|| gradient(i))).collect()
    }
}

/// Which frames count once the last is held: 1 where the mask, or all of x, has one, else 0.
///
/// `x`: \[batch, frames, …\]; mask: \[batch, frames\] → \[batch, frames held\]; it has no gradient.
pub struct FrameMask {
    /// Frames are held up to a multiple of this.
    pub multiple: usize,
}

impl<E: Element> Operation<E> for FrameMask {
    fn name(&self) -> &'static str {
        "frame_mask"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        expect_axes("frame_mask", "input", x[0], 3, AXES)?;
        let (batch, frames) = (x[0].shape()[0], x[0].shape()[1]);
        let mask = x.get(1);
        if let Some(mask) = mask
            && mask.shape() != [batch, frames]
        {
            let problem =
                format!("mask has shape {:?}, input expects {:?}", mask.shape(), [batch, frames]);
            return Err(GraphError::shape("frame_mask", problem));
        }
        let held = frames.next_multiple_of(self.multiple.max(1));
        Ok(run.tensor(&[batch, held], |y| {
            for (b, y) in y.chunks_exact_mut(held.max(1)).enumerate() {
                y.fill(E::ZERO);
                match mask {
                    Some(mask) => {
                        let mask = &mask.data()[b * frames..][..frames];
                        for (y, &x) in y.iter_mut().zip(mask) {
                            *y = if x > E::ZERO { E::ONE } else { E::ZERO };
                        }
                    }
                    None => y[..frames].fill(E::ONE),
                }
            }
        }))
    }

    fn backward(&mut self, _: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        at.needs.iter().map(|_| None).collect()
    }
}

/// Every `stride`-th frame of a mask, from the first on: \[batch, frames\] → \[batch, ⌈frames / stride⌉\].
pub struct StrideMask {
    pub stride: usize,
}

impl<E: Element> Operation<E> for StrideMask {
    fn name(&self) -> &'static str {
        "stride_mask"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        expect_axes("stride_mask", "mask", x[0], 2, "[batch, frames]")?;
        expect_size("stride_mask", "stride", "frames", self.stride.min(1), "a step", 1)?;
        let (batch, frames) = (x[0].shape()[0], x[0].shape()[1]);
        let kept = frames.div_ceil(self.stride);
        Ok(run.tensor(&[batch, kept], |y| {
            for (i, y) in y.iter_mut().enumerate() {
                *y = x[0].data()[i / kept * frames + i % kept * self.stride];
            }
        }))
    }

    fn backward(&mut self, _: Tensor<E>, _: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        vec![None]
    }
}
