//! Which input row each output row of a convolution meets at each tap.
//!
//! Products take rows of A by pointer, so that a convolution needs no copy of its input with shifted
//! rows (im2col): M. Dukhan, "The Indirect Convolution Algorithm", arXiv 1907.02129, 2019.

/// A 1-D convolution over \[batch, frames, channels\]; a linear layer is one with a single tap.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Conv {
    pub batch: usize,
    /// Frames of the input.
    pub frames: usize,
    pub taps: usize,
    pub stride: usize,
    /// Frames of zeros at either end.
    pub padding: usize,
    pub dilation: usize,
}

/// Rows of one product: output row `target[i]` is Σ over `taps` of the source row times the weight.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GatherRows {
    /// Taps of the weight, in the order in which they are summed.
    pub taps: Vec<usize>,
    /// Output rows.
    pub target: Vec<usize>,
    /// Input rows, \[taps\]\[target\]; `ZERO_ROW` where the padding is met.
    pub source: Vec<usize>,
}

/// Stands for a row of zeros.
pub const ZERO_ROW: usize = usize::MAX;

impl Conv {
    /// A linear layer over `rows` rows.
    pub fn linear(rows: usize) -> Self {
        Self { batch: 1, frames: rows, taps: 1, stride: 1, padding: 0, dilation: 1 }
    }

    /// Frames that the taps span.
    pub fn span(&self) -> usize {
        self.dilation * (self.taps - 1) + 1
    }

    /// Frames of the output: ⌊(frames + 2 padding − span) / stride⌋ + 1, or 0 where nothing fits.
    pub fn out_frames(&self) -> usize {
        let padded = self.frames + 2 * self.padding;
        padded.checked_sub(self.span()).map_or(0, |room| room / self.stride + 1)
    }

    /// Rows of the input.
    pub fn in_rows(&self) -> usize {
        self.batch * self.frames
    }

    /// Rows of the output.
    pub fn out_rows(&self) -> usize {
        self.batch * self.out_frames()
    }

    /// Rows of the forward product.
    pub fn forward(&self) -> GatherRows {
        let out = self.out_frames();
        let mut source = Vec::with_capacity(self.taps * self.out_rows());
        for tap in 0..self.taps {
            for b in 0..self.batch {
                source.extend((0..out).map(|t| {
                    let padded = t * self.stride + tap * self.dilation;
                    match padded.checked_sub(self.padding) {
                        Some(frame) if frame < self.frames => b * self.frames + frame,
                        _ => ZERO_ROW,
                    }
                }));
            }
        }
        GatherRows {
            taps: (0..self.taps).collect(),
            target: (0..self.out_rows()).collect(),
            source,
        }
    }

    /// Rows of the product for the input's gradient, which is a sum over output rows.
    ///
    /// With a stride, input frames that lie differently to it meet different taps; each such phase
    /// is a product of its own, so that nothing is multiplied by zeros.
    pub fn backward(&self) -> Vec<GatherRows> {
        let out = self.out_frames();
        let frames_of = |phase: usize| {
            (0..self.frames).filter(move |i| (i + self.padding) % self.stride == phase)
        };
        let phase = |phase: usize| {
            let meets = |tap: &usize| tap * self.dilation % self.stride == phase;
            let taps: Vec<_> = (0..self.taps).filter(meets).collect();
            let target: Vec<_> = (0..self.batch)
                .flat_map(|b| frames_of(phase).map(move |i| b * self.frames + i))
                .collect();
            let mut source = Vec::with_capacity(taps.len() * target.len());
            for tap in &taps {
                for b in 0..self.batch {
                    source.extend(frames_of(phase).map(|i| {
                        match (i + self.padding).checked_sub(tap * self.dilation) {
                            Some(at) if at / self.stride < out => b * out + at / self.stride,
                            _ => ZERO_ROW,
                        }
                    }));
                }
            }
            GatherRows { taps, target, source }
        };
        (0..self.stride).map(phase).collect()
    }

    /// Rows of one phase of one sample in the strips of the weight's gradient.
    pub fn strip_frames(&self) -> usize {
        (self.frames + 2 * self.padding).div_ceil(self.stride)
    }

    /// Where an input row lies in a strip of \[batch\]\[stride\]\[strip_frames\] rows.
    ///
    /// Rows of equal phase lie together, so that the frames that a tap meets do.
    pub fn strip_row(&self, row: usize) -> usize {
        let (b, padded) = (row / self.frames, row % self.frames + self.padding);
        (b * self.stride + padded % self.stride) * self.strip_frames() + padded / self.stride
    }

    /// Where the frames that a tap meets begin in a strip, for the first sample.
    pub fn strip_start(&self, tap: usize) -> usize {
        let at = tap * self.dilation;
        at % self.stride * self.strip_frames() + at / self.stride
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn output_frames_are_those_of_the_formula() {
        let conv = |frames, taps, stride, padding, dilation| {
            Conv { batch: 2, frames, taps, stride, padding, dilation }.out_frames()
        };
        assert_eq!(conv(15, 3, 1, 1, 1), 15);
        assert_eq!(conv(15, 3, 2, 1, 1), 8);
        assert_eq!(conv(21, 5, 1, 6, 3), 21);
        assert_eq!(conv(16, 4, 2, 1, 1), 8);
        assert_eq!(conv(3, 5, 1, 0, 1), 0);
    }

    #[test]
    fn the_backward_rows_are_the_forward_rows_turned_round() {
        for conv in [
            Conv { batch: 2, frames: 7, taps: 3, stride: 1, padding: 1, dilation: 1 },
            Conv { batch: 3, frames: 9, taps: 3, stride: 2, padding: 1, dilation: 1 },
            Conv { batch: 1, frames: 11, taps: 5, stride: 1, padding: 6, dilation: 3 },
            Conv { batch: 2, frames: 10, taps: 4, stride: 2, padding: 1, dilation: 1 },
            Conv { batch: 2, frames: 8, taps: 2, stride: 3, padding: 0, dilation: 1 },
        ] {
            let pairs = |gather: &GatherRows, turned: bool| {
                let n = gather.target.len();
                let mut pairs = Vec::new();
                for (i, &source) in gather.source.iter().enumerate() {
                    if source != ZERO_ROW {
                        let (tap, target) = (gather.taps[i / n], gather.target[i % n]);
                        pairs.push(if turned {
                            (tap, target, source)
                        } else {
                            (tap, source, target)
                        });
                    }
                }
                pairs
            };
            let mut forward = pairs(&conv.forward(), false);
            let backward = conv.backward();
            let mut turned: Vec<_> = backward.iter().flat_map(|g| pairs(g, true)).collect();
            forward.sort_unstable();
            turned.sort_unstable();
            assert_eq!(forward, turned, "{conv:?}");
            let mut targets: Vec<_> = backward.iter().flat_map(|g| g.target.clone()).collect();
            targets.sort_unstable();
            assert_eq!(targets, (0..conv.in_rows()).collect::<Vec<_>>(), "{conv:?}");
            // In a strip, a tap's frames follow each other from its start.
            for (tap, source, target) in forward {
                let (b, t) = (target / conv.out_frames(), target % conv.out_frames());
                let sample = b * conv.stride * conv.strip_frames();
                assert_eq!(conv.strip_row(source), sample + conv.strip_start(tap) + t, "{conv:?}");
            }
        }
    }
}
