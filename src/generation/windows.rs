//! How a track is cut into the windows that a network sees.

use std::ops::Range;

/// Windows of one length that cover a track, each sharing frames with the next.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Windows {
    starts: Vec<usize>,
    n_frames: usize,
    length: usize,
}

impl Windows {
    /// Covers a track of `n_frames` with windows of `length` frames of which neighbours share at least
    /// `overlap`, as few as that takes and evenly spaced; a shorter track is one window of its own length.
    ///
    /// # Panics
    /// Unless `overlap < length`.
    pub fn new(n_frames: usize, length: usize, overlap: usize) -> Self {
        assert!(overlap < length, "windows of {length} frames cannot share {overlap}");
        if n_frames <= length {
            return Self { starts: vec![0], n_frames, length: n_frames };
        }
        let last_start = n_frames - length;
        let n_steps = last_start.div_ceil(length - overlap);
        let starts = (0..=n_steps).map(|i| i * last_start / n_steps).collect();
        Self { starts, n_frames, length }
    }

    /// Returns the number of windows.
    pub fn len(&self) -> usize {
        self.starts.len()
    }

    /// Returns whether there is no window; never.
    pub fn is_empty(&self) -> bool {
        self.starts.is_empty()
    }

    /// Returns the number of frames of the track.
    pub fn n_frames(&self) -> usize {
        self.n_frames
    }

    /// Returns the number of frames of every window.
    pub fn length(&self) -> usize {
        self.length
    }

    /// Returns the frames of window i.
    pub fn frames(&self, i: usize) -> Range<usize> {
        self.starts[i]..self.starts[i] + self.length
    }

    /// Returns how far window i lies behind the one before it; 0 for the first.
    pub fn shift(&self, i: usize) -> usize {
        i.checked_sub(1).map_or(0, |before| self.starts[i] - self.starts[before])
    }

    /// Returns how many of the first frames of window i no later window has.
    pub fn n_final(&self, i: usize) -> usize {
        if i + 1 < self.len() { self.shift(i + 1) } else { self.length }
    }

    /// Returns the windows in runs of at most `n`, the last of which may be shorter.
    pub fn runs(&self, n: usize) -> impl Iterator<Item = Range<usize>> {
        let (n, len) = (n.max(1), self.len());
        (0..len).step_by(n).map(move |first| first..(first + n).min(len))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_short_track_is_one_window() {
        for n in [1, 77, 120] {
            let windows = Windows::new(n, 120, 30);
            assert_eq!((windows.len(), windows.frames(0)), (1, 0..n));
        }
    }

    #[test]
    fn windows_are_spaced_evenly_up_to_the_end() {
        let windows = Windows::new(301, 120, 30);
        let frames: Vec<_> = (0..windows.len()).map(|i| windows.frames(i)).collect();
        assert_eq!(frames, [0..120, 60..180, 120..240, 181..301]);
        assert_eq!((windows.shift(0), windows.shift(1), windows.shift(3)), (0, 60, 61));
        assert_eq!((0..4).map(|i| windows.n_final(i)).collect::<Vec<_>>(), [60, 60, 61, 120]);
        let runs: Vec<_> = windows.runs(3).collect();
        assert_eq!(runs, [0..3, 3..4]);
    }

    proptest! {
        #[test]
        fn every_frame_is_covered_and_neighbours_share(
            n in 1usize..4000, length in 2usize..200, share in 0.0..1.0f64,
        ) {
            let overlap = (share * (length - 1) as f64) as usize;
            let windows = Windows::new(n, length, overlap);
            prop_assert_eq!(windows.frames(0).start, 0);
            prop_assert_eq!(windows.frames(windows.len() - 1).end, n);
            for i in 1..windows.len() {
                let (before, here) = (windows.frames(i - 1), windows.frames(i));
                prop_assert!(here.start > before.start);
                prop_assert!(here.start + overlap <= before.end, "{before:?} {here:?}");
                prop_assert_eq!(windows.shift(i), here.start - before.start);
            }
            let n_steps = n.saturating_sub(length).div_ceil(length - overlap);
            prop_assert_eq!(windows.len(), n_steps + 1);
        }
    }
}
