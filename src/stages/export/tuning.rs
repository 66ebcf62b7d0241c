//! How a model is best sampled, measured on the songs that its checkpoints were chosen on.
//!
//! Guidance exaggerates what the music asks for; a model that hears the clock follows the bar as far as real
//! motion does with little of it. How much decoded positions are worth beside decoded velocities and accelerations
//! differs from model to model: fusion weighs them so that motion is as fast and as smooth as real motion.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::{Array2, Array3, Axis, s};

use crate::autodiff::Stream;
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::evaluation::body::{poses, turn_rates};
use crate::evaluation::coupling::{CoupledPassage, Coupling, CouplingSums, Harmonics, Template};
use crate::evaluation::window_range::Posture;
use crate::generation::{
    Engine, EngineError, GroupEngine, GroupGenerator, GroupTrack, RUN_WINDOWS, Sampling,
    SamplingDefaults, sample,
};
use crate::model::condition;
use crate::motion::clock::is_known;
use crate::motion::kinematics::forward_differences;
use crate::motion::phase::unwrapped;
use crate::motion::postprocess::{Coherence, FusionVariances, PostProcessConfig, process};
use crate::motion::{Channel, MOTION_DIM, Normalizer};
use crate::stages::Progress;
use crate::training::{Dataset, GroupNetworkConfig, NetworkConfig, Phrase, Split};
use crate::units::FPS;

/// Most windows that are sampled for each guidance.
const N_WINDOWS: usize = 32;
/// Most groups that are sampled for each guidance.
const N_GROUPS: usize = 8;
/// Most phrases from which it is learned what motion owes to the bar.
const MAX_FITTED_PHRASES: usize = 400;
/// Guidances that are tried, until motion is locked to the bar as far as real motion is.
const GUIDANCES: [f64; 5] = [1.0, 1.5, 2.0, 3.0, 4.0];
/// Powers of two by which variances are multiplied.
const MULTIPLES: [f64; 17] =
    [-8., -7., -6., -5., -4., -3., -2., -1., 0., 1., 2., 3., 4., 5., 6., 7., 8.];
/// Greatest of them for orientations: σ_q of 6°. Beyond, a body leans as far as errors of its turn rates add up to, which
/// the moments of turning do not see: with 2^8 17 of 160 motions were not upright.
const MAX_ORIENTATION_MULTIPLE: f64 = 5.0;
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

/// Measures how a model is best sampled; none without validation phrases as long as a window.
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
    tuned(&windows, dataset, progress, |guidance| decoded(engine, network, guidance, &windows))
}

/// Measures how a model is best sampled whose motion for the windows `decoded` makes, with some guidance.
fn tuned(
    windows: &[Window],
    dataset: &Dataset,
    progress: &dyn Progress,
    mut decoded: impl FnMut(f64) -> anyhow::Result<Vec<Array2<f32>>>,
) -> anyhow::Result<Option<SamplingDefaults>> {
    if windows.is_empty() {
        return Ok(None);
    }
    let couplings = couplings(dataset)?;
    progress.start("tune", "guidances", GUIDANCES.len() as u64);
    let mut tried: Vec<(f64, f64)> = Vec::new();
    let mut variances = FusionVariances::default();
    for guidance in GUIDANCES {
        let decoded = decoded(guidance)?;
        variances = variances_of(windows, &decoded);
        progress.advance(1);
        let Some(locked) = locked(&couplings, windows, &fused(&decoded, variances)) else { break };
        tried.push((guidance, locked));
        if locked >= 1.0 {
            break;
        }
    }
    progress.finish();
    let guidance = rounded(guidance_of(&tried), 3);
    let fusion_variances = variances.map(|variance| rounded(variance, 3));
    Ok(Some(SamplingDefaults { guidance, fusion_variances }))
}

/// Returns the variances with which fused motion is as fast and as smooth as real motion of the same music.
///
/// How much a decoder's positions and orientations are worth beside its velocities: the multiples 2^k, k = -8 …
/// 8 (for σ_q² up to 5), of σ_p² and of σ_q² at which `Σ ln²(m̂ / m)` is least, with m the root mean square velocity along each axis
/// and the mean jerk; the mean turn rate and the mean change of it. Of errors that are not independent from frame
/// to frame, as those of networks are not, the likelihood's variances gave motion of half the speed.
fn variances_of(windows: &[Window], decoded: &[Array2<f32>]) -> FusionVariances {
    let mean = |motions: &[Array2<f32>], of: Moments| {
        let moments: Vec<Vec<f64>> = motions.iter().map(of).collect();
        let n = moments.len().max(1) as f64;
        let width = moments.first().map_or(0, Vec::len);
        (0..width).map(|i| moments.iter().map(|m| m[i]).sum::<f64>() / n).collect::<Vec<f64>>()
    };
    let real: Vec<Array2<f32>> = windows.iter().map(|window| window.motion.clone()).collect();
    let least = |of: Moments, greatest: f64, with: &dyn Fn(f64) -> FusionVariances| {
        let wanted = mean(&real, of);
        let miss = |multiple: f64| -> f64 {
            let found = mean(&fused(decoded, with(multiple)), of);
            found.iter().zip(&wanted).map(|(found, wanted)| (found / wanted).ln().powi(2)).sum()
        };
        let multiples = MULTIPLES.iter().filter(|power| **power <= greatest).map(|x| x.exp2());
        let misses = multiples.map(|multiple| (miss(multiple), multiple));
        let finite = misses.filter(|(miss, _)| miss.is_finite());
        finite.min_by(|a, b| a.0.total_cmp(&b.0)).map_or(1.0, |(_, multiple)| multiple)
    };
    let scaled = |position: f64, orientation: f64| {
        let FusionVariances { position_m2, orientation_rad2, .. } = FusionVariances::default();
        FusionVariances {
            position_m2: position_m2.times(position),
            orientation_rad2: orientation_rad2.times(orientation),
            ..FusionVariances::default()
        }
    };
    let position = least(path_moments, f64::INFINITY, &|multiple| scaled(multiple, 1.0));
    let orientation =
        least(turn_moments, MAX_ORIENTATION_MULTIPLE, &|multiple| scaled(position, multiple));
    scaled(position, orientation)
}

/// Returns numbers of a motion.
type Moments = fn(&Array2<f32>) -> Vec<f64>;

/// Mean squares of the velocity along x, y and z, and mean jerk.
fn path_moments(motion: &Array2<f32>) -> Vec<f64> {
    let Some(posture) = poses(motion.view()).and_then(|poses| Posture::new(&poses)) else {
        return vec![f64::NAN; 4];
    };
    let [x, y, z] = posture.axis_speed_m_s.map(|speed| speed * speed);
    // The mean of squares is that of speeds over windows; jerk weighs as much as a speed.
    vec![x, y, z, posture.jerk_m_s3 * posture.jerk_m_s3]
}

/// Mean turn rate, and mean change of it from frame to frame.
fn turn_moments(motion: &Array2<f32>) -> Vec<f64> {
    let Some(poses) = poses(motion.view()) else { return vec![f64::NAN; 2] };
    let rates = turn_rates(&poses.orientation);
    let change = forward_differences(&rates);
    let mean = |values: &[[f64; 3]]| {
        let lengths = values.iter().map(|x| x.iter().map(|x| x * x).sum::<f64>().sqrt());
        lengths.sum::<f64>() / values.len().max(1) as f64
    };
    vec![mean(&rates), mean(&change)]
}

/// Returns motions with their poses fused, as post-processing does it.
fn fused(decoded: &[Array2<f32>], variances: FusionVariances) -> Vec<Array2<f32>> {
    let postprocess = PostProcessConfig {
        coherence: Coherence::Fuse,
        fusion_variances: Some(variances),
        relock_phase: false,
        savitzky_golay: None,
        ..PostProcessConfig::default()
    };
    let mut motions = decoded.to_vec();
    motions.iter_mut().for_each(|motion| process(&postprocess, motion, None));
    motions
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
            Ok(Window { song: song_of(phrase), beats_per_bar: phrase.beats_per_bar, motion, heard })
        })
        .collect()
}

/// Measures how a model of groups is best sampled; none without validation phrases as long as a window.
///
/// As [`sampling_defaults`], dancer by dancer.
///
/// # Errors
/// When the frames cannot be read, or what the engine says.
pub fn group_sampling_defaults(
    engine: &GroupEngine,
    network: &GroupNetworkConfig,
    normalizer: &Normalizer,
    dataset: &Dataset,
    progress: &dyn Progress,
) -> anyhow::Result<Option<SamplingDefaults>> {
    let n_frames = network.window_frames;
    let is_fit =
        |p: &&Phrase| p.split == Split::Validation && p.n_frames >= n_frames && p.n_dancers > 1;
    let phrases: Vec<&Phrase> = dataset.phrases().iter().filter(is_fit).collect();
    let n = phrases.len().min(N_GROUPS);
    let mut groups: Vec<(usize, Array2<f32>)> = Vec::new();
    let mut windows: Vec<Window> = Vec::new();
    for i in 0..n {
        let phrase = phrases[i * phrases.len() / n];
        let features = dataset.features(phrase, 0, n_frames)?;
        let group = dataset.group(phrase, 0, n_frames)?;
        let motions: Vec<_> = group.outer_iter().map(|dancer| dancer.to_owned()).collect();
        let clock = phrase.clock_of(motions[0].view());
        let heard = condition(network.group.condition(), features.view(), Some(clock.view()));
        groups.push((phrase.n_dancers, heard.clone()));
        windows.extend(motions.into_iter().map(|motion| Window {
            song: song_of(phrase),
            beats_per_bar: phrase.beats_per_bar,
            motion,
            heard: heard.clone(),
        }));
    }
    let schedule = Schedule::new(&network.diffusion)?;
    let sampler = usual_sampler(&schedule);
    tuned(&windows, dataset, progress, |guidance| {
        let mut made = Vec::new();
        for (i, (n_dancers, heard)) in groups.iter().enumerate() {
            let generator = GroupGenerator {
                engine,
                sampler: &sampler,
                schedule: &schedule,
                guidance,
                consistency: 0.0,
                normalizer,
                window_frames: n_frames,
                overlap_frames: 0,
            };
            let seed = SEED + i as u64;
            let track =
                GroupTrack { condition: heard.view(), phase: None, seed, n_dancers: *n_dancers };
            generator.run(&track, |motion| -> Result<(), EngineError> {
                made.extend(motion.outer_iter().map(|dancer| dancer.to_owned()));
                Ok(())
            })?;
        }
        Ok(made)
    })
}

/// Returns how models are sampled unless the user says otherwise.
fn usual_sampler(schedule: &Schedule) -> SamplerConfig {
    SamplerConfig {
        sampler: Sampler::DpmSolver,
        n_steps: Sampler::DpmSolver.usual_steps(schedule.len()),
        spacing: Spacing::Trailing,
        clip: true,
    }
}

/// Samples and decodes motion for windows, each from its own noise.
fn decoded(
    engine: &dyn Engine,
    network: &NetworkConfig,
    guidance: f64,
    windows: &[Window],
) -> anyhow::Result<Vec<Array2<f32>>> {
    let schedule = Schedule::new(&network.diffusion)?;
    let config = usual_sampler(&schedule);
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
        made.extend(
            engine.decode(latent.view())?.axis_iter(Axis(0)).map(|motion| motion.to_owned()),
        );
    }
    Ok(made)
}

/// Returns what vertical velocity owes to the bar in each song: a fit to all of its validation phrases whose phase
/// tells a clock.
///
/// To all, not to the windows that are sampled: a template of a few windows is of their noise too, on which no
/// other motion can lie.
fn couplings(dataset: &Dataset) -> anyhow::Result<BTreeMap<Arc<str>, Coupling>> {
    let mut songs: BTreeMap<Arc<str>, Harmonics> = BTreeMap::new();
    let validation = dataset.phrases().iter().filter(|phrase| phrase.split == Split::Validation);
    for phrase in validation.take(MAX_FITTED_PHRASES) {
        // Of a group the first dancer, whose bar is that of all.
        let motion = dataset.motion(phrase, 0, phrase.n_frames)?;
        let phase = phase_of(&motion);
        if is_known(&phase, phrase.beats_per_bar) {
            let (rise, bars) = (rise_m_s(&motion), unwrapped(&phase));
            let passage = passage(&rise, &bars, phrase.beats_per_bar);
            songs.entry(song_of(phrase)).or_default().add(&passage);
        }
    }
    let coupling =
        |(song, harmonics)| Some((song, Coupling::Learned(Template::fit(&[harmonics])?)));
    Ok(songs.into_iter().filter_map(coupling).collect())
}

/// Returns the mean coefficient over songs of motions on what vertical velocity owes to the bar, that of real motion
/// being 1; none where no window has a clock.
fn locked(
    couplings: &BTreeMap<Arc<str>, Coupling>,
    windows: &[Window],
    motions: &[Array2<f32>],
) -> Option<f64> {
    let mut songs: BTreeMap<&str, [CouplingSums; 2]> = BTreeMap::new();
    for (window, motion) in windows.iter().zip(motions) {
        let phase = phase_of(&window.motion);
        let Some(coupling) = couplings.get(&window.song) else { continue };
        if is_known(&phase, window.beats_per_bar) {
            let bars = unwrapped(&phase);
            let sums = songs.entry(&window.song).or_default();
            for (sums, motion) in sums.iter_mut().zip([&window.motion, motion]) {
                let rise = rise_m_s(motion);
                sums.add(coupling, &passage(&rise, &bars, window.beats_per_bar));
            }
        }
    }
    let ratio = |[real, made]: &[CouplingSums; 2]| {
        let ratio = made.coefficient(0.0)? / real.coefficient(0.0)?;
        Some(ratio).filter(|ratio| ratio.is_finite())
    };
    let ratios: Vec<f64> = songs.values().filter_map(ratio).collect();
    (!ratios.is_empty()).then(|| ratios.iter().sum::<f64>() / ratios.len() as f64)
}

/// Vertical velocity of frames, and the bars of its music.
fn passage<'a>(rise_m_s: &'a [f64], bars: &'a [f64], beats_per_bar: u32) -> CoupledPassage<'a> {
    CoupledPassage { rise_m_s, bars, beats_per_bar, activity: None }
}

/// Bar phase of frames.
fn phase_of(motion: &Array2<f32>) -> Vec<f64> {
    motion.column(Channel::Phase.range().start).iter().map(|&x| f64::from(x)).collect()
}

fn song_of(phrase: &Phrase) -> Arc<str> {
    phrase.song_hash.clone().unwrap_or_else(|| Arc::clone(&phrase.id))
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
        let phrase = ("a", Split::Validation, motion(1.0), Array2::zeros((n, 163)));
        let dataset = Dataset::in_memory([phrase]).expect("in memory");
        let couplings = couplings(&dataset).expect("a fit");
        let window = Window { song: "a".into(), ..window };
        let found = |scale| locked(&couplings, std::slice::from_ref(&window), &[motion(scale)]);
        for scale in [1.0, 0.5, -0.25] {
            let found = found(scale).expect("a coefficient");
            assert!((found - f64::from(scale)).abs() < 1e-4, "{found}");
        }
        let mut still = window.motion.clone();
        still.column_mut(16).fill(0.0);
        let window = Window { motion: still, ..window };
        assert_eq!(locked(&couplings, &[window], &[motion(1.0)]), None);
    }
}
