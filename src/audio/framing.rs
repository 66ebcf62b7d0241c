//! Cutting a stream of samples into overlapping frames.

/// Cuts a stream into frames centred on multiples of the hop, with zeros outside the signal.
///
/// Frame t holds the samples hop·t − n/2 … hop·t + n/2 − 1; a signal of `len` samples has
/// 1 + ⌊len / hop⌋ frames (librosa's `center=True, pad_mode="constant"`).
#[derive(Clone, Debug)]
pub struct Framer {
    n: usize,
    hop: usize,
    buffer: Vec<f32>,
    /// Where the next frame starts in `buffer`.
    start: usize,
}

impl Framer {
    /// Makes a framer for frames of `n` samples, `hop` apart; `n` is even.
    pub fn new(n: usize, hop: usize) -> Self {
        Self { n, hop, buffer: vec![0.0; n / 2], start: 0 }
    }

    /// Takes the next samples and calls `visit` with every frame that they complete.
    pub fn push(&mut self, samples: &[f32], visit: impl FnMut(&[f32])) {
        self.buffer.extend_from_slice(samples);
        self.visit_complete(visit);
    }

    /// Ends the signal and calls `visit` with the frames that reach over its end.
    pub fn finish(&mut self, visit: impl FnMut(&[f32])) {
        self.buffer.resize(self.buffer.len() + self.n / 2, 0.0);
        self.visit_complete(visit);
    }

    /// As [`Framer::push`], with frames 2t and 2t + 1 at once.
    pub fn push_pairs(&mut self, samples: &[f32], mut visit: impl FnMut(&[f32], Option<&[f32]>)) {
        self.buffer.extend_from_slice(samples);
        self.visit_pairs(&mut visit);
    }

    /// As [`Framer::finish`], with frames 2t and 2t + 1 at once; the last of an odd number is alone.
    pub fn finish_pairs(&mut self, mut visit: impl FnMut(&[f32], Option<&[f32]>)) {
        self.buffer.resize(self.buffer.len() + self.n / 2, 0.0);
        self.visit_pairs(&mut visit);
        self.visit_complete(|last| visit(last, None));
    }

    fn visit_pairs(&mut self, visit: &mut impl FnMut(&[f32], Option<&[f32]>)) {
        let frame = |start: usize| start..start + self.n;
        let mut start = self.start;
        while let Some(second) = self.buffer.get(frame(start + self.hop)) {
            visit(&self.buffer[frame(start)], Some(second));
            start += 2 * self.hop;
        }
        self.start = start;
        self.forget();
    }

    fn visit_complete(&mut self, mut visit: impl FnMut(&[f32])) {
        while let Some(frame) = self.buffer.get(self.start..self.start + self.n) {
            visit(frame);
            self.start += self.hop;
        }
        self.forget();
    }

    fn forget(&mut self) {
        // A hop longer than the frame may start the next one behind the buffer's end.
        let used = self.start.min(self.buffer.len());
        self.buffer.drain(..used);
        self.start -= used;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition: sample by sample.
    fn frames(y: &[f32], n: usize, hop: usize) -> Vec<Vec<f32>> {
        let at = |i: isize| usize::try_from(i).ok().and_then(|i| y.get(i)).copied().unwrap_or(0.0);
        let first = |t: usize| (t * hop) as isize - (n / 2) as isize;
        (0..=y.len() / hop).map(|t| (0..n as isize).map(|j| at(first(t) + j)).collect()).collect()
    }

    proptest! {
        #[test]
        fn frames_do_not_depend_on_the_blocks(
            n_samples in 0usize..90,
            half in 1usize..20,
            hop in 1usize..50,
            block in 1usize..33,
        ) {
            let y: Vec<f32> = (0..n_samples).map(|i| (i + 1) as f32).collect();
            let mut framer = Framer::new(2 * half, hop);
            let mut found = Vec::new();
            for samples in y.chunks(block) {
                framer.push(samples, |frame| found.push(frame.to_vec()));
            }
            framer.finish(|frame| found.push(frame.to_vec()));
            prop_assert_eq!(found, frames(&y, 2 * half, hop));
        }

        #[test]
        fn pairs_are_frames_two_by_two_whatever_the_blocks(
            n_samples in 0usize..90,
            half in 1usize..20,
            hop in 1usize..50,
            block in 1usize..33,
        ) {
            let y: Vec<f32> = (0..n_samples).map(|i| (i + 1) as f32).collect();
            let mut framer = Framer::new(2 * half, hop);
            let mut found: Vec<Vec<Vec<f32>>> = Vec::new();
            let mut add = |a: &[f32], b: Option<&[f32]>| {
                found.push([Some(a), b].into_iter().flatten().map(<[f32]>::to_vec).collect());
            };
            for samples in y.chunks(block) {
                framer.push_pairs(samples, &mut add);
            }
            framer.finish_pairs(&mut add);
            let expected: Vec<Vec<Vec<f32>>> =
                frames(&y, 2 * half, hop).chunks(2).map(<[Vec<f32>]>::to_vec).collect();
            prop_assert_eq!(found, expected);
        }
    }
}
