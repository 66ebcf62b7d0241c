//! Windows side by side, as networks learn from them.

use std::sync::Arc;

use crate::motion::MOTION_DIM;
use crate::motion::style::STYLE_DIM;

/// Windows of a pair: 2k and 2k + 1 of a batch, where windows come in pairs.
pub const PAIR: usize = 2;

/// Windows side by side.
#[derive(Clone, Debug, PartialEq)]
pub struct Batch {
    pub n_windows: usize,
    pub n_frames: usize,
    /// Places for dancers in every window; 1 for soloists.
    pub n_slots: usize,
    /// Dancers of each window, in the first of its places.
    pub n_dancers: Vec<usize>,
    /// Normalised motion, `[n_windows, n_slots, n_frames, 25]`, 0 in places without a dancer; beyond a phrase's end its last frame is held.
    pub motion: Vec<f32>,
    /// Features in units of their spread and, for a network that hears it, the clock, `[n_windows, n_frames,
    /// condition_dim]`, held likewise.
    pub audio: Vec<f32>,
    /// 1 for frames of the phrase and 0 for held ones, `[n_windows, n_frames]`.
    pub mask: Vec<f32>,
    /// Mean of the normalised style channels, `[n_windows, 8]`.
    pub style: Vec<f32>,
    /// Standard normal noise, `[n_windows, n_slots, n_frames, 25]`.
    pub noise: Vec<f32>,
    pub chances: Vec<Chances>,
    pub phrase_ids: Vec<Arc<str>>,
}

/// Random decisions for each window, as numbers uniform in \[0, 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Chances {
    /// How much noise is added: step ⌊u T⌋.
    pub step: f64,
    /// Whether the music is withheld.
    pub no_audio: f64,
    /// Whether the style is withheld.
    pub no_style: f64,
    /// Whether the clock alone is withheld.
    pub no_clock: f64,
}

impl Batch {
    pub(super) fn empty(
        n_windows: usize,
        n_frames: usize,
        n_slots: usize,
        condition_dim: usize,
    ) -> Self {
        let zeros = |width: usize| Vec::with_capacity(n_windows * n_frames * width);
        Self {
            n_windows: 0,
            n_frames,
            n_slots,
            n_dancers: Vec::with_capacity(n_windows),
            motion: zeros(n_slots * MOTION_DIM),
            audio: zeros(condition_dim),
            mask: zeros(1),
            style: Vec::with_capacity(n_windows * STYLE_DIM),
            noise: zeros(n_slots * MOTION_DIM),
            chances: Vec::with_capacity(n_windows),
            phrase_ids: Vec::with_capacity(n_windows),
        }
    }

    /// Adds a window of which nothing is known but what it is of: another process learns from it.
    pub(super) fn push_absent(
        &mut self,
        n_dancers: usize,
        phrase: &Arc<str>,
        condition_dim: usize,
    ) {
        let grow = |values: &mut Vec<f32>, width: usize| {
            values.resize(values.len() + width, 0.0);
        };
        let (motion, frames) = (self.n_slots * self.n_frames * MOTION_DIM, self.n_frames);
        grow(&mut self.motion, motion);
        grow(&mut self.noise, motion);
        grow(&mut self.audio, frames * condition_dim);
        grow(&mut self.mask, frames);
        grow(&mut self.style, STYLE_DIM);
        self.n_dancers.push(n_dancers);
        self.chances.push(Chances { step: 0.0, no_audio: 0.0, no_style: 0.0, no_clock: 0.0 });
        self.phrase_ids.push(Arc::clone(phrase));
        self.n_windows += 1;
    }

    /// Returns some windows of the batch.
    ///
    /// # Panics
    /// When it has fewer.
    pub fn windows(&self, range: std::ops::Range<usize>) -> Self {
        let part = |values: &[f32]| {
            let width = values.len() / self.n_windows;
            values[range.start * width..range.end * width].to_vec()
        };
        Self {
            n_windows: range.len(),
            n_frames: self.n_frames,
            n_slots: self.n_slots,
            n_dancers: self.n_dancers[range.clone()].to_vec(),
            motion: part(&self.motion),
            audio: part(&self.audio),
            mask: part(&self.mask),
            style: part(&self.style),
            noise: part(&self.noise),
            chances: self.chances[range.clone()].to_vec(),
            phrase_ids: self.phrase_ids[range.clone()].to_vec(),
        }
    }

    /// Returns how many frames of dancers count.
    pub(super) fn weight(&self) -> f64 {
        let frames = self.mask.chunks_exact(self.n_frames.max(1));
        let of_window = |(mask, &n): (&[f32], &usize)| {
            n as f64 * mask.iter().map(|&w| f64::from(w)).sum::<f64>()
        };
        frames.zip(&self.n_dancers).map(of_window).sum()
    }

    /// Returns the same windows, pair by pair, in order of the largest number of dancers of a pair.
    pub(super) fn by_number_of_dancers(&self) -> Self {
        let order = order_by_dancers(&self.n_dancers);
        let sorted = |values: &[f32]| -> Vec<f32> {
            let width = values.len() / self.n_windows.max(1);
            order.iter().flat_map(|&i| &values[i * width..][..width]).copied().collect()
        };
        Self {
            n_windows: self.n_windows,
            n_frames: self.n_frames,
            n_slots: self.n_slots,
            n_dancers: order.iter().map(|&i| self.n_dancers[i]).collect(),
            motion: sorted(&self.motion),
            audio: sorted(&self.audio),
            mask: sorted(&self.mask),
            style: sorted(&self.style),
            noise: sorted(&self.noise),
            chances: order.iter().map(|&i| self.chances[i]).collect(),
            phrase_ids: order.iter().map(|&i| Arc::clone(&self.phrase_ids[i])).collect(),
        }
    }

    /// Returns the same windows with as many places as the largest of their groups needs.
    pub(super) fn without_empty_slots(self) -> Self {
        let n_slots = self.n_dancers.iter().copied().max().unwrap_or(1).max(1);
        if n_slots == self.n_slots {
            return self;
        }
        let size = self.n_frames * MOTION_DIM;
        let kept = |values: &[f32]| -> Vec<f32> {
            let windows = values.chunks_exact(self.n_slots * size);
            windows.flat_map(|window| &window[..n_slots * size]).copied().collect()
        };
        let (motion, noise) = (kept(&self.motion), kept(&self.noise));
        Self { n_slots, motion, noise, ..self }
    }
}

/// Returns the windows of a batch pair by pair, in order of the largest number of dancers of a pair.
pub(super) fn order_by_dancers(n_dancers: &[usize]) -> Vec<usize> {
    let n = n_dancers.len();
    let mut pairs: Vec<usize> = (0..n.div_ceil(PAIR)).collect();
    let windows = |pair: usize| pair * PAIR..((pair + 1) * PAIR).min(n);
    // A window without a partner stays the last.
    pairs.sort_by_key(|&pair| {
        (windows(pair).len() < PAIR, windows(pair).map(|i| n_dancers[i]).max())
    });
    pairs.into_iter().flat_map(windows).collect()
}
