//! Motion to tokens, and tokens to motion.

use std::num::NonZeroUsize;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, concatenate, s};

use super::eager::EagerTokenizer;
use super::networks::TokenizerNetworks;
use crate::autodiff::{Parameters, Stream};
use crate::diffusion::{Refine, SamplerConfig, Schedule, sample, sample_refined};
use crate::generation::engine::EngineError;
use crate::model::TokensConfig;
use crate::motion::{MOTION_DIM, Normalizer, Placement};

/// Windows that are done at once, which bounds memory whatever the length of a motion.
const WINDOWS_AT_ONCE: usize = 16;

/// Runs a tokenizer.
///
/// A motion is cut into windows of the frames that training saw, the last as long as is left; each is put over the
/// origin, facing +Z, by its own first frame, as in training. So a token means the same wherever a phrase is danced,
/// and tokens do not depend on frames beyond their window.
pub struct TokenEngine {
    config: TokensConfig,
    networks: Box<dyn TokenizerNetworks + Send>,
    normalizer: Normalizer,
    window_frames: usize,
}

impl TokenEngine {
    /// Makes an engine of the interpreter that trains, of so many workers of so many threads each; `parameters` are those
    /// of [`Tokenizer`](crate::model::Tokenizer).
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn new(
        config: &TokensConfig,
        parameters: Parameters<f32>,
        normalizer: &Normalizer,
        window_frames: usize,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> std::io::Result<Self> {
        let networks = EagerTokenizer::new(config, parameters, workers)?;
        Ok(Self::with(config, Box::new(networks), normalizer, window_frames))
    }

    /// Makes an engine of networks that the interpreter or onnxruntime runs.
    pub fn with(
        config: &TokensConfig,
        networks: Box<dyn TokenizerNetworks + Send>,
        normalizer: &Normalizer,
        window_frames: usize,
    ) -> Self {
        let (config, normalizer) = (config.clone(), normalizer.clone());
        Self { config, networks, normalizer, window_frames }
    }

    /// Cuts motion into windows of so many frames instead.
    pub fn with_window(self, window_frames: usize) -> Self {
        Self { window_frames, ..self }
    }

    /// Returns the name that flags and tables use of what runs the networks.
    pub fn name(&self) -> &'static str {
        self.networks.name()
    }

    /// Returns the sizes of the tokenizer.
    pub fn sizes(&self) -> &TokensConfig {
        &self.config
    }

    /// Returns the units of the networks.
    pub fn normalizer(&self) -> &Normalizer {
        &self.normalizer
    }

    /// Returns the frames of a window.
    pub fn window_frames(&self) -> usize {
        self.window_frames
    }

    /// Returns how many calls run at once.
    pub fn n_workers(&self) -> usize {
        self.networks.n_workers()
    }

    /// Returns the windows of a motion, each over the origin and facing +Z in its first frame.
    ///
    /// \[T, 25\] → windows of \[n, 25\], n at most the frames of a window
    pub fn windows(&self, motion: ArrayView2<f32>) -> Vec<Array2<f32>> {
        motion
            .axis_chunks_iter(Axis(0), self.window_frames)
            .map(|window| {
                let mut window = window.to_owned();
                if let Some(placement) = Placement::of_first(window.view()) {
                    placement.remove(&mut window);
                }
                window
            })
            .collect()
    }

    /// Returns the tokens of windows, in order: one for every ρ frames of a window, the last of a window for what is
    /// left.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn tokens(&self, windows: &[Array2<f32>]) -> Result<Vec<u32>, EngineError> {
        let mut tokens = Vec::new();
        for group in alike(windows) {
            tokens.extend(self.networks.encode(self.normalized(group).view())?);
        }
        Ok(tokens)
    }

    /// Makes motion of the tokens of windows of so many frames: \[n, 25\] each, over the origin.
    ///
    /// Same tokens and seed, same motion.
    ///
    /// # Errors
    /// A token that the codebook does not have, and what the sampler refuses.
    ///
    /// # Panics
    /// When there are fewer tokens than the windows have.
    pub fn motion(
        &self,
        tokens: &[u32],
        n_frames: &[usize],
        (sampler, schedule): (&SamplerConfig, &Schedule),
        seed: u64,
    ) -> Result<Vec<Array2<f32>>, EngineError> {
        let (mut found, mut first) = (Vec::new(), 0);
        for (number, group) in runs(n_frames).enumerate() {
            let (n, frames) = (group.len(), group[0]);
            let n_tokens = n * self.config.n_tokens(frames);
            let signal = self.networks.signal(&tokens[first..][..n_tokens], (n, frames))?;
            first += n_tokens;
            let shape = [n, frames, MOTION_DIM];
            // Every group of windows has draws of its own; the first is where sampling begins.
            let noise = |draw: usize, z: &mut [f32]| {
                Stream::new(seed, ((number as u64) << 32) + draw as u64 + 1).normal(0, z);
            };
            let mut x = Array3::zeros(shape);
            Stream::new(seed, (number as u64) << 32)
                .normal(0, x.as_slice_mut().expect("new arrays lie in order"));
            let denoise = |x: ArrayView3<f32>, t: usize| self.networks.denoise(x, t, signal.view());
            let sampled = sample(sampler, schedule, x, denoise, noise, None)?;
            found.extend(self.denormalized(&sampled));
        }
        Ok(found)
    }

    /// Reads motion from the signal of the tokens of windows of so many frames, without diffusion: \[n, 25\] each, over
    /// the origin.
    ///
    /// This is the plain convolutional decoder that the paper holds its own against (section 4.4).
    ///
    /// # Errors
    /// A token that the codebook does not have, and a network that drafts nothing.
    ///
    /// # Panics
    /// When there are fewer tokens than the windows have.
    pub fn draft(
        &self,
        tokens: &[u32],
        n_frames: &[usize],
    ) -> Result<Vec<Array2<f32>>, EngineError> {
        let (mut found, mut first) = (Vec::new(), 0);
        for group in runs(n_frames) {
            let (n, frames) = (group.len(), group[0]);
            let n_tokens = n * self.config.n_tokens(frames);
            let signal = self.networks.signal(&tokens[first..][..n_tokens], (n, frames))?;
            first += n_tokens;
            let drafted = self.networks.draft(signal.view())?.ok_or(EngineError::NoDraft)?;
            found.extend(self.denormalized(&drafted));
        }
        Ok(found)
    }

    /// Decodes a window with the caller's noise and changes: \[1, n, 25\] in units of spread.
    ///
    /// - `x`: where sampling begins, \[1, n, 25\]
    /// - `noise`, `refine`: as for [`sample_refined`]
    ///
    /// # Errors
    /// A token that the codebook does not have, and what the sampler refuses.
    ///
    /// # Panics
    /// When there are not as many tokens as the window has.
    pub fn decode(
        &self,
        tokens: &[u32],
        x: Array3<f32>,
        (sampler, schedule): (&SamplerConfig, &Schedule),
        noise: impl FnMut(usize, &mut [f32]),
        refine: Option<Refine>,
    ) -> Result<Array3<f32>, EngineError> {
        let signal = self.networks.signal(tokens, (1, x.len_of(Axis(1))))?;
        let denoise = |x: ArrayView3<f32>, t: usize| self.networks.denoise(x, t, signal.view());
        let start = (x, schedule.len());
        sample_refined(sampler, schedule, start, denoise, noise, None, refine)
    }

    /// Returns windows in the units of motion, \[n, 25\] each.
    fn denormalized(&self, windows: &Array3<f32>) -> Vec<Array2<f32>> {
        let in_units = |window: ArrayView2<f32>| {
            let mut window = window.to_owned();
            self.normalizer.denormalize(window.view_mut());
            window
        };
        windows.axis_iter(Axis(0)).map(in_units).collect()
    }

    /// Returns windows of as many frames in units of spread, \[windows, n, 25\].
    fn normalized(&self, windows: &[Array2<f32>]) -> Array3<f32> {
        let views: Vec<_> =
            windows.iter().map(|window| window.view().insert_axis(Axis(0))).collect();
        let mut motion = concatenate(Axis(0), &views).expect("invariant: windows are alike");
        for mut window in motion.axis_iter_mut(Axis(0)) {
            self.normalizer.normalize(window.slice_mut(s![.., ..]));
        }
        motion
    }
}

/// Splits windows into runs of as many frames, none of too many windows.
fn alike(windows: &[Array2<f32>]) -> impl Iterator<Item = &[Array2<f32>]> {
    windows.chunk_by(|a, b| a.nrows() == b.nrows()).flat_map(|alike| alike.chunks(WINDOWS_AT_ONCE))
}

/// Splits lengths in the same way.
fn runs(n_frames: &[usize]) -> impl Iterator<Item = &[usize]> {
    n_frames.chunk_by(|a, b| a == b).flat_map(|alike| alike.chunks(WINDOWS_AT_ONCE))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::{DiffusionConfig, Prediction};
    use crate::generation::walk::walk;
    use crate::model::{Preset, Tokenizer};
    use crate::motion::Channel;

    const WINDOW_FRAMES: usize = 24;

    fn engine(n_workers: usize) -> TokenEngine {
        let config = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
        let (_, list) = Tokenizer::new(&config);
        // Layers that begin at zero would say the same of all tokens.
        let parameters = Parameters::new(list.without_zero_layers(), 3);
        let workers = (NonZeroUsize::new(n_workers).expect("not 0"), NonZeroUsize::MIN);
        let normalizer = Normalizer::identity();
        TokenEngine::new(&config, parameters, &normalizer, WINDOW_FRAMES, workers).expect("threads")
    }

    fn schedule() -> Schedule {
        let config = DiffusionConfig { prediction: Prediction::Sample, ..Default::default() };
        Schedule::new(&config).expect("a schedule")
    }

    #[test]
    fn tokens_are_counted_by_window_and_know_nothing_of_where_a_phrase_is_danced() {
        let engine = engine(1);
        let here = walk(2 * WINDOW_FRAMES + 9);
        let windows = engine.windows(here.view());
        let n_frames: Vec<usize> = windows.iter().map(Array2::nrows).collect();
        assert_eq!(n_frames, [24, 24, 9]);
        for window in &windows {
            let first = window.row(0);
            assert!(first[0].abs() < 1e-6 && first[2].abs() < 1e-6, "{first:?}");
        }
        let tokens = engine.tokens(&windows).expect("shapes fit");
        assert_eq!(tokens.len(), 6 + 6 + 3);
        assert!(tokens.iter().any(|&token| token != tokens[0]), "{tokens:?}");
        let mut elsewhere = here;
        Placement { x_m: 2.0, z_m: -1.5, yaw_rad: 1.25 }.restore(&mut elsewhere);
        let windows = engine.windows(elsewhere.view());
        assert_eq!(engine.tokens(&windows).expect("shapes fit"), tokens);
        // A window alone has the tokens that it has among others.
        assert_eq!(engine.tokens(&windows[1..2]).expect("shapes fit"), tokens[6..12]);
    }

    #[test]
    fn the_same_tokens_and_seed_make_the_same_motion_by_any_number_of_workers() {
        let n_frames = [24, 24, 9];
        let tokens: Vec<u32> = (0..15).map(|i| i * 7 % 32).collect();
        let (sampler, schedule) = (SamplerConfig::fast27(), schedule());
        let motions = |engine: &TokenEngine, seed| {
            let how = (&sampler, &schedule);
            engine.motion(&tokens, &n_frames, how, seed).expect("a motion")
        };
        let (one, three) = (engine(1), engine(3));
        let found = motions(&one, 5);
        assert_eq!(found.iter().map(Array2::nrows).collect::<Vec<_>>(), n_frames);
        assert!(found.iter().all(|window| window.iter().all(|x| x.is_finite())));
        assert_eq!(found, motions(&three, 5));
        assert_ne!(found, motions(&one, 6));
        let first = Channel::Position.range().start;
        assert_ne!(found[0][[3, first]], found[1][[3, first]], "windows have noise of their own");
    }

    #[test]
    fn a_token_that_the_codebook_does_not_have_is_refused() {
        let how = (&SamplerConfig::fast27(), &schedule());
        let error = engine(1).motion(&[0, 32, 1], &[9], how, 0).expect_err("no such token");
        assert_eq!(
            error.to_string(),
            "embedding: index 32 is not a whole number below 32, the rows of the table"
        );
    }
}
