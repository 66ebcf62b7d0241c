//! How a model is best sampled, measured on the songs that its checkpoints were chosen on.
//!
//! Guidance exaggerates what the music asks for; a model that hears the clock follows the bar as far as real
//! motion does with little of it. How much decoded positions are worth beside decoded velocities and accelerations
//! differs from model to model: fusion weighs them so that motion is as fast and as smooth as real motion.

use ndarray::{Array2, Array3, Axis};

use crate::autodiff::Stream;
use crate::diffusion::Schedule;
use crate::generation::{
    ConsistencyForm, Engine, EngineError, GroupEngine, GroupGenerator, GroupTrack, RUN_WINDOWS,
    Sampling, SamplingDefaults, sample,
};
use crate::model::condition;
use crate::motion::postprocess::FusionVariances;
use crate::motion::{MOTION_DIM, Normalizer};
use crate::stages::Progress;
use crate::stages::validation_motion::{
    Moments, Window, couplings, fused, locked, path_moments, song_of, turn_moments, usual_sampler,
    windows,
};
use crate::training::{Dataset, GroupNetworkConfig, NetworkConfig, Phrase, Split};

/// Most windows that are sampled for each guidance.
const N_WINDOWS: usize = 32;
/// Most groups that are sampled for each guidance.
const N_GROUPS: usize = 8;
/// Guidances that are tried, until motion is locked to the bar as far as real motion is.
const GUIDANCES: [f64; 5] = [1.0, 1.5, 2.0, 3.0, 4.0];
/// Powers of two by which variances are multiplied.
const MULTIPLES: [f64; 17] =
    [-8., -7., -6., -5., -4., -3., -2., -1., 0., 1., 2., 3., 4., 5., 6., 7., 8.];
/// Greatest of them for orientations: σ_q of 6°. Beyond, a body leans as far as errors of its turn rates add up to, which
/// the moments of turning do not see: with 2^8 17 of 160 motions were not upright.
const MAX_ORIENTATION_MULTIPLE: f64 = 5.0;
/// Seed of the noise.
pub(super) const SEED: u64 = 17;

/// Measures how a model is best sampled; none without validation phrases as long as a window.
///
/// Guidance is where the mean coefficient of vertical velocity on what it owes to the bar in real motion of the
/// same song, harmonics 1 to 4, is that of real motion, interpolated between those tried; the highest where none
/// reaches it.
///
/// # Errors
/// When the frames cannot be read, or errors of the engine.
pub fn sampling_defaults(
    engine: &dyn Engine,
    network: &NetworkConfig,
    dataset: &Dataset,
    progress: &dyn Progress,
) -> anyhow::Result<Option<SamplingDefaults>> {
    let windows = windows(network, dataset, N_WINDOWS)?;
    tuned(&windows, dataset, progress, |guidance| decoded(engine, network, guidance, &windows))
}

/// Measures how a model is best sampled whose motion for the windows `decoded` makes, with some guidance.
pub(super) fn tuned(
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

/// Returns the guidance at which the locked amplitude is 1; 1 where that holds without guidance, or where nothing was measured.
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

/// Measures how a model of groups is best sampled; none without validation phrases as long as a window.
///
/// As [`sampling_defaults`], dancer by dancer.
///
/// # Errors
/// When the frames cannot be read, or errors of the engine.
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
                form: ConsistencyForm::default(),
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
}
