//! Motion for the songs that checkpoints are chosen on: real windows, and how far sampled motion is locked to the bar and
//! as fast and as smooth as they are.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::{Array2, s};

use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::evaluation::body::{poses, turn_rates};
use crate::evaluation::coupling::{CoupledPassage, Coupling, CouplingSums, Harmonics, Template};
use crate::evaluation::window_range::Posture;
use crate::model::condition;
use crate::motion::Channel;
use crate::motion::clock::is_known;
use crate::motion::kinematics::forward_differences;
use crate::motion::phase::unwrapped;
use crate::motion::postprocess::{Coherence, FusionVariances, PostProcessConfig, process};
use crate::training::{Dataset, NetworkConfig, Phrase, Split};
use crate::units::FPS;

/// Most phrases from which it is learned what motion owes to the bar.
const MAX_FITTED_PHRASES: usize = 400;
/// A window of real motion and what a network hears of its music.
pub struct Window {
    pub song: Arc<str>,
    pub beats_per_bar: u32,
    /// \[T, 25\]
    pub motion: Array2<f32>,
    /// \[T, condition_dim\]
    pub heard: Array2<f32>,
}

/// Returns the first windows of validation phrases, `most` evenly among all.
///
/// # Errors
/// When the frames cannot be read.
pub fn windows(
    network: &NetworkConfig,
    dataset: &Dataset,
    most: usize,
) -> anyhow::Result<Vec<Window>> {
    let n_frames = network.window_frames;
    let phrases: Vec<&Phrase> = dataset
        .phrases()
        .iter()
        .filter(|phrase| phrase.split == Split::Validation && phrase.n_frames >= n_frames)
        .collect();
    let n = phrases.len().min(most);
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

/// Returns how models are sampled unless the user says otherwise.
pub fn usual_sampler(schedule: &Schedule) -> SamplerConfig {
    SamplerConfig {
        sampler: Sampler::DpmSolver,
        n_steps: Sampler::DpmSolver.usual_steps(schedule.len()),
        spacing: Spacing::Trailing,
        clip: true,
    }
}

/// Returns numbers of a motion.
pub type Moments = fn(&Array2<f32>) -> Vec<f64>;

/// Mean squares of the velocity along x, y and z, and mean jerk.
pub fn path_moments(motion: &Array2<f32>) -> Vec<f64> {
    let Some(posture) = poses(motion.view()).and_then(|poses| Posture::new(&poses)) else {
        return vec![f64::NAN; 4];
    };
    let [x, y, z] = posture.axis_speed_m_s.map(|speed| speed * speed);
    // The mean of squares is that of speeds over windows; jerk weighs as much as a speed.
    vec![x, y, z, posture.jerk_m_s3 * posture.jerk_m_s3]
}

/// Mean turn rate, and mean change of it from frame to frame.
pub fn turn_moments(motion: &Array2<f32>) -> Vec<f64> {
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
pub fn fused(decoded: &[Array2<f32>], variances: FusionVariances) -> Vec<Array2<f32>> {
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

/// Returns what vertical velocity owes to the bar in each song: a fit to all of its validation phrases whose phase
/// tells a clock.
///
/// To all, not to the windows that are sampled: a template of a few windows is of their noise too, on which no
/// other motion can lie.
///
/// # Errors
/// When the frames cannot be read.
pub fn couplings(dataset: &Dataset) -> anyhow::Result<BTreeMap<Arc<str>, Coupling>> {
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
pub fn locked(
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

pub fn song_of(phrase: &Phrase) -> Arc<str> {
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
    use crate::motion::MOTION_DIM;

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
