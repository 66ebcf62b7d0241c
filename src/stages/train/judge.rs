//! Sampled motion beside real motion of the validation songs: by it the checkpoint of a UNet is chosen.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::{Array2, Array3, ArrayView3, Axis};

use crate::audio::FeatureScale;
use crate::diffusion::{SamplerConfig, Schedule};
use crate::evaluation::coupling::Coupling;
use crate::model::condition_scale;
use crate::motion::postprocess::FusionVariances;
use crate::stages::validation_motion::{
    Window, couplings, fused, locked, path_moments, turn_moments, usual_sampler, windows,
};
use crate::training::{Dataset, NetworkConfig, SampleJudge};

/// Most windows that are sampled in a validation.
const N_WINDOWS: usize = 16;
/// Least ratio of which a logarithm is taken: motion that moves against the bar is as far off as motion that hardly moves
/// with it.
const MIN_RATIO: f64 = 1e-3;

/// Real motion of validation windows, and how it moves.
pub struct ValidationJudge {
    windows: Vec<Window>,
    couplings: BTreeMap<Arc<str>, Coupling>,
    sampler: SamplerConfig,
    /// \[n, frames, condition_dim\], scaled
    heard: Array3<f32>,
    /// Of real motion.
    moments: Vec<f64>,
}

impl ValidationJudge {
    /// Takes windows of validation phrases; none where no phrase is as long as one.
    ///
    /// # Errors
    /// When the frames cannot be read.
    pub fn new(
        network: &NetworkConfig,
        dataset: &Dataset,
        scale: &FeatureScale,
    ) -> anyhow::Result<Option<Self>> {
        let windows = windows(network, dataset, N_WINDOWS)?;
        if windows.is_empty() {
            return Ok(None);
        }
        let scale = condition_scale(&network.unet, scale);
        let shape = (windows.len(), network.window_frames, network.unet.condition_dim());
        let mut heard = Array3::zeros(shape);
        for (mut row, window) in heard.outer_iter_mut().zip(&windows) {
            row.assign(&window.heard);
            scale.apply(row);
        }
        let real: Vec<Array2<f32>> = windows.iter().map(|window| window.motion.clone()).collect();
        Ok(Some(Self {
            couplings: couplings(dataset)?,
            sampler: usual_sampler(&Schedule::new(&network.diffusion)?),
            heard,
            moments: mean_moments(&fused(&real, FusionVariances::default())),
            windows,
        }))
    }

    /// `D = √⟨ln²(m̂ / m)⟩` with m the amplitude locked to the bar, the root mean square velocity along x, y and z, the mean
    /// jerk, the mean turn rate and its mean change, m̂ those of the motions; poses of both are fused, as post-processing does.
    ///
    /// The share of vertical velocity that the bar explains goes as the square of the locked amplitude over the vertical
    /// speed, so that D is 0 only where both are right. A moment of real motion that is 0, or a song without bars, tells
    /// nothing and is left out.
    fn distance_of(&self, motions: &[Array2<f32>]) -> Option<f64> {
        let motions = fused(motions, FusionVariances::default());
        let locked = locked(&self.couplings, &self.windows, &motions).map(|locked| (locked, 1.0));
        let moments = mean_moments(&motions).into_iter().zip(self.moments.iter().copied());
        let squares: Vec<f64> = locked
            .into_iter()
            .chain(moments.filter(|&(_, real)| real > 0.0))
            .map(|(found, real)| {
                let ratio = found / real;
                // The greater of NaN and a number is the number.
                if ratio.is_nan() { ratio } else { ratio.max(MIN_RATIO).ln().powi(2) }
            })
            .collect();
        let mean = squares.iter().sum::<f64>() / squares.len().max(1) as f64;
        mean.is_finite().then(|| mean.sqrt())
    }
}

/// Means over motions: root mean square velocity along x, y and z, root mean square of mean jerks, turn rate and change.
fn mean_moments(motions: &[Array2<f32>]) -> Vec<f64> {
    let mean = |moments: fn(&Array2<f32>) -> Vec<f64>| {
        let found: Vec<Vec<f64>> = motions.iter().map(moments).collect();
        let width = found.first().map_or(0, Vec::len);
        let n = found.len() as f64;
        (0..width).map(|i| found.iter().map(|m| m[i]).sum::<f64>() / n).collect::<Vec<f64>>()
    };
    let squares = mean(path_moments).into_iter().map(f64::sqrt);
    squares.chain(mean(turn_moments)).collect()
}

impl SampleJudge for ValidationJudge {
    fn sampler(&self) -> &SamplerConfig {
        &self.sampler
    }

    fn heard(&self) -> ArrayView3<'_, f32> {
        self.heard.view()
    }

    fn distance(&self, motion: ArrayView3<f32>) -> Option<f64> {
        let motions: Vec<_> = motion.axis_iter(Axis(0)).map(|window| window.to_owned()).collect();
        self.distance_of(&motions)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::DiffusionConfig;
    use crate::model::{DecoderConfig, Preset, UNetConfig};
    use crate::motion::{Channel, MOTION_DIM};
    use crate::training::Split;

    const N_FRAMES: usize = 131;

    /// A body that bobs with bars of 66 frames, sways and turns; `scale` is the size of all of it, `shift` moves it against
    /// the bar.
    fn motion(scale: f64, shift: f64) -> Array2<f32> {
        let mut frames = Array2::zeros((N_FRAMES, MOTION_DIM));
        let place = |t: f64| {
            let bar = std::f64::consts::TAU * (t / 66.0 + shift);
            [0.3 * bar.sin(), 1.0 + 0.1 * (2.0 * bar).sin(), 0.2 * bar.cos()].map(|x| scale * x)
        };
        for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
            let t = t as f64;
            let (p, next, last) = (place(t), place(t + 1.0), place(t + 2.0));
            for i in 0..3 {
                row[i] = p[i] as f32;
                row[3 + i] = (30.0 * (next[i] - p[i])) as f32;
                row[6 + i] = (900.0 * (last[i] - 2.0 * next[i] + p[i])) as f32;
            }
            let angle = 0.3 * scale * (std::f64::consts::TAU * t / 66.0).sin();
            let q = Channel::Quaternion.range().start;
            row[q] = (angle / 2.0).cos() as f32;
            row[q + 2] = (angle / 2.0).sin() as f32;
            row[Channel::Phase.range().start] = (t / 66.0).fract() as f32;
        }
        frames
    }

    fn judge(network: &NetworkConfig) -> ValidationJudge {
        let phrase = ("a", Split::Validation, motion(1.0, 0.0), Array2::ones((N_FRAMES, 163)));
        let dataset = Dataset::in_memory([phrase]).expect("in memory");
        let scale = FeatureScale::identity(163);
        ValidationJudge::new(network, &dataset, &scale).expect("read").expect("one window")
    }

    fn network() -> NetworkConfig {
        NetworkConfig {
            unet: UNetConfig { clock: true, ..Preset::Tiny.config() },
            decoder: DecoderConfig::default(),
            diffusion: DiffusionConfig::default(),
            window_frames: N_FRAMES,
        }
    }

    #[test]
    fn motion_that_moves_otherwise_is_farther() {
        let judge = judge(&network());
        let distance = |motion: Array2<f32>| judge.distance(motion.insert_axis(Axis(0)).view());
        let itself = distance(motion(1.0, 0.0)).expect("finite");
        // But for the locked amplitude, which is of real motion as it is: fusion leaves a hundredth of it.
        assert!(itself < 0.02, "{itself}");
        let half = distance(motion(0.5, 0.0)).expect("finite");
        // Every moment is half of what it was, but for the turns, which fusion shrinks a little more.
        assert!((half - 2.0_f64.ln()).abs() < 0.05, "{half}");
        // A quarter of a bar late, a beat of two swings in the bar comes against it: one of seven is as far as can be.
        let late = distance(motion(1.0, 0.25)).expect("finite");
        assert!((late - MIN_RATIO.ln().abs() / 7.0_f64.sqrt()).abs() < 0.05, "{late}");
        let mut broken = motion(1.0, 0.0);
        broken[(60, 1)] = f32::NAN;
        assert_eq!(distance(broken), None);
    }

    #[test]
    fn phrases_shorter_than_a_window_judge_nothing() {
        let mut network = network();
        network.window_frames = N_FRAMES + 1;
        let phrase = ("a", Split::Validation, motion(1.0, 0.0), Array2::ones((N_FRAMES, 163)));
        let dataset = Dataset::in_memory([phrase]).expect("in memory");
        let scale = FeatureScale::identity(163);
        assert!(ValidationJudge::new(&network, &dataset, &scale).expect("read").is_none());
    }
}
