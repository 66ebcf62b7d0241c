//! How a model is best sampled, measured on the songs that its checkpoints were chosen on.
//!
//! Guidance exaggerates what the music asks for; a model that hears the clock follows the bar as far as real
//! motion does with little of it. What is decoded of position, velocity and acceleration has errors that differ
//! from model to model, by which fusion weighs them.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::{Array2, Array3, Axis, s};

use crate::autodiff::Stream;
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::evaluation::coupling::{Coupling, CouplingSums, CoupledPassage, Harmonics, Template};
use crate::generation::{Engine, RUN_WINDOWS, Sampling, SamplingDefaults, sample};
use crate::model::condition;
use crate::motion::clock::is_known;
use crate::motion::phase::unwrapped;
use crate::motion::postprocess::{Coherence, FusionVariances, PostProcessConfig, process};
use crate::motion::{Channel, MOTION_DIM};
use crate::stages::Progress;
use crate::training::{Dataset, NetworkConfig, Phrase, Split};
use crate::units::FPS;

/// Most windows that are sampled for each guidance.
const N_WINDOWS: usize = 16;
/// Guidances that are tried, until motion is locked to the bar as far as real motion is.
const GUIDANCES: [f64; 5] = [1.0, 1.5, 2.0, 3.0, 4.0];
/// Steps of DPM-Solver++, as generate takes them by default.
const N_STEPS: usize = 10;
/// Seed of the noise.
const SEED: u64 = 17;

/// A window of real motion and what a network hears of its music.
struct Window {
    song: Arc<str>,
    beats_per_bar: u32,
    /// \[T, 25\]
    motion: Array2<f32>,
    /// \[T, condition_dim\]
    heard: Array2<f32>,
}

impl Window {
    /// Vertical velocity of frames, and the bars of this window's music.
    fn passage<'a>(&self, rise_m_s: &'a [f64], bars: &'a [f64]) -> CoupledPassage<'a> {
        CoupledPassage { rise_m_s, bars, beats_per_bar: self.beats_per_bar, activity: None }
    }

    fn bars(&self) -> Vec<f64> {
        let phase = self.motion.column(Channel::Phase.range().start);
        unwrapped(&phase.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>())
    }
}

/// Measures how a model is best sampled; none without validation phrases as long as a window, or where motion is
/// not finite.
///
/// Guidance is where the mean coefficient of vertical velocity on what it owes to the bar in real motion of the
/// same song, harmonics 1 to 4, is that of real motion, interpolated between those tried; the highest where none
/// reaches it.
///
/// # Errors
/// When the frames cannot be read, or what the engine says.
pub fn sampling_defaults(
    engine: &dyn Engine,
    network: &NetworkConfig,
    dataset: &Dataset,
    progress: &dyn Progress,
) -> anyhow::Result<Option<SamplingDefaults>> {
    let windows = windows(network, dataset)?;
    if windows.is_empty() {
        return Ok(None);
    }
    progress.start("tune", "guidances", GUIDANCES.len() as u64);
    let mut tried: Vec<(f64, f64)> = Vec::new();
    let mut variances: Option<FusionVariances> = None;
    for guidance in GUIDANCES {
        let mut decoded = decoded(engine, network, guidance, &windows)?;
        if variances.is_none() {
            variances = FusionVariances::of_decoded(decoded.iter().map(|motion| motion.view()));
        }
        let postprocess = PostProcessConfig {
            coherence: Coherence::Fuse,
            fusion_variances: variances,
            relock_phase: false,
            savitzky_golay: None,
            ..PostProcessConfig::default()
        };
        decoded.iter_mut().for_each(|motion| process(&postprocess, motion, None));
        progress.advance(1);
        let Some(locked) = locked(&windows, &decoded) else { break };
        tried.push((guidance, locked));
        if locked >= 1.0 {
            break;
        }
    }
    progress.finish();
    let guidance = rounded(guidance_of(&tried), 3);
    Ok(variances.map(|variances| SamplingDefaults {
        guidance,
        fusion_variances: variances.map(|variance| rounded(variance, 3)),
    }))
}

/// Returns the guidance at which the locked amplitude is 1; 1 where it is so without guidance, or unknown.
fn guidance_of(tried: &[(f64, f64)]) -> f64 {
    let Some(&(last, locked)) = tried.last() else { return GUIDANCES[0] };
    let before = tried.len().checked_sub(2).map(|i| tried[i]);
    match before {
        Some((guidance, below)) if locked > 1.0 => {
            guidance + (last - guidance) * (1.0 - below) / (locked - below)
        }
        _ => last,
    }
}

/// Rounds to significant digits, so that machines with other instructions write the same card.
fn rounded(x: f64, n_digits: i32) -> f64 {
    if x == 0.0 || !x.is_finite() {
        return x;
    }
    let unit = 10.0_f64.powi(n_digits - 1 - x.abs().log10().floor() as i32);
    (x * unit).round() / unit
}

/// Returns the first windows of validation phrases, evenly among all.
fn windows(network: &NetworkConfig, dataset: &Dataset) -> anyhow::Result<Vec<Window>> {
    let n_frames = network.window_frames;
    let phrases: Vec<&Phrase> = dataset
        .phrases()
        .iter()
        .filter(|phrase| phrase.split == Split::Validation && phrase.n_frames >= n_frames)
        .collect();
    let n = phrases.len().min(N_WINDOWS);
    (0..n)
        .map(|i| {
            let phrase = phrases[i * phrases.len() / n];
            let motion = dataset.motion(phrase, 0, n_frames)?;
            let clock = phrase.clock_of(motion.view());
            let features = dataset.features(phrase, 0, n_frames)?;
            let heard = condition(&network.unet, features.view(), Some(clock.view()));
            Ok(Window {
                song: phrase.song_hash.clone().unwrap_or_else(|| Arc::clone(&phrase.id)),
                beats_per_bar: phrase.beats_per_bar,
                motion,
                heard,
            })
        })
        .collect()
}

/// Samples and decodes motion for windows, each from its own noise.
fn decoded(
    engine: &dyn Engine,
    network: &NetworkConfig,
    guidance: f64,
    windows: &[Window],
) -> anyhow::Result<Vec<Array2<f32>>> {
    let schedule = Schedule::new(&network.diffusion)?;
    let config = SamplerConfig {
        sampler: Sampler::DpmSolver,
        n_steps: N_STEPS.min(schedule.len()),
        spacing: Spacing::Trailing,
        clip: true,
    };
    let sampling = Sampling { config: &config, schedule: &schedule, guidance };
    let (frames, width) = (network.window_frames, network.unet.condition_dim());
    let mut made = Vec::with_capacity(windows.len());
    for (run, windows) in windows.chunks(RUN_WINDOWS).enumerate() {
        let mut x = Array3::zeros((windows.len(), frames, MOTION_DIM));
        Stream::new(SEED, run as u64).normal(0, x.as_slice_mut().expect("an array made in order"));
        let mut heard = Array3::zeros((windows.len(), frames, width));
        for (mut row, window) in heard.outer_iter_mut().zip(windows) {
            row.assign(&window.heard);
        }
        let start = (x, schedule.len());
        let latent = sample(engine, sampling, start, heard.view(), None, |_, _| (), None)?;
        made.extend(engine.decode(latent.view())?.axis_iter(Axis(0)).map(|motion| motion.to_owned()));
    }
    Ok(made)
}

/// Returns the mean coefficient over songs of motions on what the real motion of the song owes to the bar, that of
/// real motion being 1; none where no window has a clock.
fn locked(windows: &[Window], motions: &[Array2<f32>]) -> Option<f64> {
    let mut songs: BTreeMap<&str, Vec<(&Window, &Array2<f32>)>> = BTreeMap::new();
    for (window, motion) in windows.iter().zip(motions).filter(|(window, _)| {
        let phase = window.motion.column(Channel::Phase.range().start);
        is_known(&phase.iter().map(|&x| f64::from(x)).collect::<Vec<f64>>(), window.beats_per_bar)
    }) {
        songs.entry(&window.song).or_default().push((window, motion));
    }
    let ratios: Vec<f64> = songs
        .values()
        .filter_map(|song| {
            let mut harmonics = Harmonics::default();
            for (window, _) in song {
                let (rise, bars) = (rise_m_s(&window.motion), window.bars());
                harmonics.add(&window.passage(&rise, &bars));
            }
            let coupling = Coupling::Learned(Template::fit(&[harmonics])?);
            let coefficient = |motion: &dyn Fn(&(&Window, &Array2<f32>)) -> Vec<f64>| {
                let mut sums = CouplingSums::default();
                for danced in song {
                    let (rise, bars) = (motion(danced), danced.0.bars());
                    sums.add(&coupling, &danced.0.passage(&rise, &bars));
                }
                sums.coefficient(0.0)
            };
            let real = coefficient(&|(window, _)| rise_m_s(&window.motion))?;
            let made = coefficient(&|(_, motion)| rise_m_s(motion))?;
            Some(made / real).filter(|ratio| ratio.is_finite())
        })
        .collect();
    (!ratios.is_empty()).then(|| ratios.iter().sum::<f64>() / ratios.len() as f64)
}

/// Vertical velocity from frame to frame, m/s.
fn rise_m_s(motion: &Array2<f32>) -> Vec<f64> {
    let height = motion.slice(s![.., Channel::Position.range().start + 1]);
    height.windows(2).into_iter().map(|pair| f64::from(pair[1] - pair[0]) * FPS).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn guidance_is_where_the_locked_amplitude_is_that_of_real_motion() {
        assert_eq!(guidance_of(&[]), 1.0);
        assert_eq!(guidance_of(&[(1.0, 1.2)]), 1.0);
        assert_eq!(guidance_of(&[(1.0, 0.8), (1.5, 1.2)]), 1.25);
        assert_eq!(guidance_of(&[(1.0, 0.2), (1.5, 0.3), (4.0, 0.6)]), 4.0);
    }

    #[test]
    fn numbers_keep_their_first_digits() {
        let found = [0.123_456, -98_765.0, 1.0, 0.0, 9.996].map(|x| rounded(x, 3));
        assert_eq!(found, [0.123, -98_800.0, 1.0, 0.0, 10.0]);
    }

    #[test]
    fn locked_motion_of_half_the_size_is_half_as_locked() {
        let n = 121;
        let phase: Vec<f32> = (0..n).map(|t| (t as f32 / 60.0).fract()).collect();
        let motion = |scale: f32| {
            Array2::from_shape_fn((n, MOTION_DIM), |(t, i)| match i {
                1 => scale * 0.1 * (std::f32::consts::TAU * phase[t]).sin(),
                16 => phase[t],
                _ => 0.0,
            })
        };
        let window = Window {
            song: "song".into(),
            beats_per_bar: 4,
            motion: motion(1.0),
            heard: Array2::zeros((n, 1)),
        };
        let found = |scale| locked(std::slice::from_ref(&window), &[motion(scale)]);
        for scale in [1.0, 0.5, -0.25] {
            let found = found(scale).expect("a coefficient");
            assert!((found - f64::from(scale)).abs() < 1e-4, "{found}");
        }
        let mut still = window.motion.clone();
        still.column_mut(16).fill(0.0);
        let window = Window { motion: still, ..window };
        assert_eq!(locked(&[window], &[motion(1.0)]), None);
    }
}
