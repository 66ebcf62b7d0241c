//! The forward process, what a network learns of it, and the way back from a prediction.

use ndarray::{Array3, ArrayView3, Axis, Zip};

use super::config::Prediction;
use super::schedule::{Level, Schedule};

impl Schedule {
    /// Draws x_t from q(x_t | x0).
    ///
    /// x_t = √ᾱ_t x0 + √(1−ᾱ_t) ε (Ho et al. 2020, eq. 4)
    ///
    /// # Shapes
    /// - `x0`, `noise`: \[batch, frames, channels\]; `noise` is ε, standard normal
    /// - `t`: \[batch\], each below `len()`
    /// - returns \[batch, frames, channels\]
    ///
    /// # Panics
    /// Where shapes differ.
    pub fn add_noise(
        &self,
        x0: ArrayView3<'_, f32>,
        noise: ArrayView3<'_, f32>,
        t: &[usize],
    ) -> Array3<f32> {
        self.combine(x0, noise, t, |level| (level.signal, level.noise))
    }

    /// Returns what the network should predict of x_t.
    ///
    /// ε, x0, or v = √ᾱ_t ε − √(1−ᾱ_t) x0 (Salimans and Ho 2022, section 4).
    /// Shapes and panics are those of [`Schedule::add_noise`].
    pub fn target(
        &self,
        x0: ArrayView3<'_, f32>,
        noise: ArrayView3<'_, f32>,
        t: &[usize],
    ) -> Array3<f32> {
        match self.prediction() {
            Prediction::Epsilon => noise.to_owned(),
            Prediction::Sample => x0.to_owned(),
            Prediction::Velocity => {
                self.combine(noise, x0, t, |level| (level.signal, -level.noise))
            }
        }
    }

    /// Returns the estimates of x0 and ε that a prediction amounts to.
    ///
    /// With a = √ᾱ_t and s = √(1−ᾱ_t):
    ///
    /// | prediction | x̂0 | ε̂ |
    /// |---|---|---|
    /// | ε | (x_t − s ε) / a | ε |
    /// | x0 | x0 | (x_t − a x0) / s |
    /// | v | a x_t − s v | s x_t + a v |
    ///
    /// Where x̂0 leaves ± `clip_range` it is clipped, and ε̂ = (x_t − a x̂0) / s follows it, so that
    /// a x̂0 + s ε̂ is still x_t. (The reference design clips x̂0 and keeps the network's ε in its
    /// DDIM step; the two then disagree about where the sample is.)
    ///
    /// # Shapes
    /// - `prediction`, `x_t`: \[batch, frames, channels\]
    /// - `t`: \[batch\], each below `len()`
    /// - returns x̂0 and ε̂, \[batch, frames, channels\] each; NaN stays NaN
    ///
    /// # Panics
    /// Where shapes differ.
    pub fn estimate(
        &self,
        prediction: ArrayView3<'_, f32>,
        x_t: ArrayView3<'_, f32>,
        t: &[usize],
    ) -> (Array3<f32>, Array3<f32>) {
        self.estimate_within(prediction, x_t, t, self.clip_range())
    }

    /// Returns x̂0 and ε̂, x̂0 within ± `clip_range`.
    pub(super) fn estimate_within(
        &self,
        prediction: ArrayView3<'_, f32>,
        x_t: ArrayView3<'_, f32>,
        t: &[usize],
        clip_range: Option<f64>,
    ) -> (Array3<f32>, Array3<f32>) {
        let kind = self.prediction();
        let mut x0 = self.combine(x_t, prediction, t, |level| inversion(kind, level).x0);
        let mut epsilon = self.combine(x_t, prediction, t, |level| inversion(kind, level).epsilon);
        if let Some(range) = clip_range {
            let range = range as f32;
            for (i, &t) in t.iter().enumerate() {
                let level = self.level(Some(t));
                Zip::from(x0.index_axis_mut(Axis(0), i))
                    .and(epsilon.index_axis_mut(Axis(0), i))
                    .and(x_t.index_axis(Axis(0), i))
                    .for_each(|x0, epsilon, &x_t| {
                        if x0.abs() > range {
                            *x0 = x0.clamp(-range, range);
                            *epsilon = epsilon_of(level, x_t, *x0);
                        }
                    });
            }
        }
        (x0, epsilon)
    }

    /// Returns the sum, sample by sample, of two tensors times what `factors` says of their level.
    ///
    /// Summed in f64 and rounded once: 1/√ᾱ is 2e4 where the cosine schedule ends, and what two
    /// products lose in single precision would be as much as the network's own rounding.
    fn combine(
        &self,
        x: ArrayView3<'_, f32>,
        y: ArrayView3<'_, f32>,
        t: &[usize],
        factors: impl Fn(Level) -> (f64, f64),
    ) -> Array3<f32> {
        assert_eq!(x.dim(), y.dim(), "tensors of one diffusion step have one shape");
        assert_eq!(x.dim().0, t.len(), "every sample of the batch has a step");
        let mut sum = Array3::zeros(x.raw_dim());
        for (i, &t) in t.iter().enumerate() {
            let (a, b) = factors(self.level(Some(t)));
            Zip::from(sum.index_axis_mut(Axis(0), i))
                .and(x.index_axis(Axis(0), i))
                .and(y.index_axis(Axis(0), i))
                .for_each(|sum, &x, &y| *sum = (a * f64::from(x) + b * f64::from(y)) as f32);
        }
        sum
    }
}

/// x̂0 and ε̂ as sums of x_t and the prediction: the factors of the two in each.
pub(super) struct Inversion {
    pub x0: (f64, f64),
    pub epsilon: (f64, f64),
}

/// Returns how x̂0 and ε̂ follow from x_t and a prediction: the table at [`Schedule::estimate`].
pub(super) fn inversion(prediction: Prediction, level: Level) -> Inversion {
    let Level { signal: a, noise: s } = level;
    match prediction {
        Prediction::Epsilon => Inversion { x0: (1.0 / a, -s / a), epsilon: (0.0, 1.0) },
        Prediction::Sample => Inversion { x0: (0.0, 1.0), epsilon: (1.0 / s, -a / s) },
        Prediction::Velocity => Inversion { x0: (a, -s), epsilon: (s, a) },
    }
}

/// Returns the ε of which x_t and x0 consist: (x_t − √ᾱ x0) / √(1−ᾱ).
pub(super) fn epsilon_of(level: Level, x_t: f32, x0: f32) -> f32 {
    ((f64::from(x_t) - level.signal * f64::from(x0)) / level.noise) as f32
}

#[cfg(test)]
mod tests {
    use ndarray::arr3;
    use proptest::prelude::*;

    use super::*;
    use crate::diffusion::{BetaSchedule, DiffusionConfig};

    const PREDICTIONS: [Prediction; 3] =
        [Prediction::Epsilon, Prediction::Sample, Prediction::Velocity];

    fn schedule(prediction: Prediction, clip_range: Option<f64>) -> Schedule {
        let config = DiffusionConfig { prediction, clip_range, ..Default::default() };
        Schedule::new(&config).expect("a schedule")
    }

    proptest! {
        #[test]
        fn estimate_undoes_target(
            values in proptest::collection::vec((-4.0_f32..4.0, -4.0_f32..4.0), 2 * 3 * 5),
            t in proptest::array::uniform2(0_usize..1000),
            beta_schedule in prop_oneof![
                Just(BetaSchedule::Linear), Just(BetaSchedule::Cosine), Just(BetaSchedule::Sqrt)
            ],
            prediction in proptest::sample::select(&PREDICTIONS[..]),
        ) {
            let config = DiffusionConfig { beta_schedule, prediction, ..Default::default() };
            let schedule = Schedule::new(&config).expect("a schedule");
            let (x0, noise): (Vec<_>, Vec<_>) = values.into_iter().unzip();
            let x0 = Array3::from_shape_vec((2, 3, 5), x0).expect("2 · 3 · 5 values");
            let noise = Array3::from_shape_vec((2, 3, 5), noise).expect("2 · 3 · 5 values");
            let x_t = schedule.add_noise(x0.view(), noise.view(), &t);
            let target = schedule.target(x0.view(), noise.view(), &t);
            let (got_x0, got_noise) = schedule.estimate_within(target.view(), x_t.view(), &t, None);
            for (i, &t) in t.iter().enumerate() {
                let Level { signal, noise: deviation } = schedule.level(Some(t));
                // x_t and v are at most 4√2, each rounded once; the inversion divides what they
                // lose by √ᾱ or √(1−ᾱ), and rounds once more.
                let rounding = 2.0 * 5.7 * f64::from(f32::EPSILON);
                let (x0_bound, noise_bound) = match prediction {
                    Prediction::Epsilon => (rounding / signal, 0.0),
                    Prediction::Sample => (0.0, rounding / deviation),
                    Prediction::Velocity => (rounding, rounding),
                };
                for (got, want, bound) in
                    [(&got_x0, &x0, x0_bound), (&got_noise, &noise, noise_bound)]
                {
                    let (got, want) = (got.index_axis(Axis(0), i), want.index_axis(Axis(0), i));
                    for (&got, &want) in got.iter().zip(want) {
                        let error = f64::from((got - want).abs());
                        prop_assert!(
                            error <= bound,
                            "{prediction:?}, {beta_schedule:?}, step {t}: got {got}, wanted {want}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn a_clipped_estimate_still_makes_up_the_sample() {
        for prediction in PREDICTIONS {
            let schedule = schedule(prediction, Some(1.0));
            let t = [400, 401];
            let x0 = arr3(&[[[0.5_f32, -3.0, 2.0]], [[1.0, 0.25, -1.5]]]);
            let noise = arr3(&[[[-0.5_f32, 1.0, 0.1]], [[0.3, -2.0, 0.7]]]);
            let x_t = schedule.add_noise(x0.view(), noise.view(), &t);
            let target = schedule.target(x0.view(), noise.view(), &t);
            let (got_x0, got_noise) = schedule.estimate(target.view(), x_t.view(), &t);
            for ((i, &got), &want) in got_x0.indexed_iter().zip(&x0) {
                let want = want.clamp(-1.0, 1.0);
                assert!((got - want).abs() < 1e-5, "{prediction:?} {i:?}: {got}, {want}");
                assert!(got.abs() <= 1.0, "{prediction:?} {i:?}: {got}");
            }
            let again = schedule.add_noise(got_x0.view(), got_noise.view(), &t);
            for ((i, &got), &want) in again.indexed_iter().zip(&x_t) {
                assert!((got - want).abs() < 1e-5, "{prediction:?} {i:?}: {got}, {want}");
            }
        }
    }

    #[test]
    fn nan_is_neither_clipped_nor_spread() {
        let schedule = schedule(Prediction::Sample, Some(1.0));
        let x_t = Array3::zeros((1, 1, 2));
        let prediction = arr3(&[[[f32::NAN, 0.5]]]);
        let (x0, epsilon) = schedule.estimate(prediction.view(), x_t.view(), &[500]);
        assert!(x0[[0, 0, 0]].is_nan() && epsilon[[0, 0, 0]].is_nan());
        assert!(x0[[0, 0, 1]] == 0.5 && epsilon[[0, 0, 1]].is_finite());
    }

    #[test]
    #[should_panic(expected = "every sample of the batch has a step")]
    fn a_batch_with_too_few_steps_is_a_mistake_of_the_caller() {
        let x0 = Array3::zeros((2, 3, 5));
        schedule(Prediction::Epsilon, None).add_noise(x0.view(), x0.view(), &[0]);
    }
}
