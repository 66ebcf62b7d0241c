//! From noise to a sample, step by step, with any of the samplers.

use ndarray::{Array3, ArrayView3, Zip};

use super::config::DiffusionError;
use super::inpaint::KnownValues;
use super::process::epsilon_of;
use super::sampler::SamplerConfig;
use super::schedule::Schedule;
use super::spacing::{SamplerStep, steps};

/// Samples: turns noise x_T into x0, one call of the denoiser a step.
///
/// The last step leads to clean data (ᾱ = 1), so that no noise of step 0 stays in the sample; only
/// [`super::Spacing::Reference`] ends at ᾱ_0, whatever the sampler.
///
/// - `x`: x_T, standard normal, \[batch, frames, channels\]
/// - `denoise`: x_t and t to the network's prediction, which [`Schedule::prediction`] names
/// - `noise`: fills a slice, in the order of \[batch, frames, channels\], with the standard normal
///   numbers of a draw. Every draw has its own number: 2i for the noise that step i adds, 2i + 1 for
///   the noise on known values before step i. A draw is asked for at most once, and not at all where
///   nothing is random: same `x` and same draws, same bytes
/// - `known`: values to keep; the sample has them exactly
///
/// NaN and infinity from the denoiser stay in the samples that have them.
///
/// # Errors
/// Those of `denoise`; what [`SamplerConfig::check`] refuses; a prediction or known values of a shape
/// other than that of `x`.
pub fn sample<E: From<DiffusionError>>(
    config: &SamplerConfig,
    schedule: &Schedule,
    x: Array3<f32>,
    denoise: impl FnMut(ArrayView3<'_, f32>, usize) -> Result<Array3<f32>, E>,
    noise: impl FnMut(usize, &mut [f32]),
    known: Option<&KnownValues>,
) -> Result<Array3<f32>, E> {
    sample_refined(config, schedule, (x, schedule.len()), denoise, noise, known, None)
}

/// Changes an estimate of x0, \[batch, frames, channels\], so that it suits what the network cannot know.
pub type Refine<'a> = &'a mut dyn FnMut(&mut Array3<f32>);

/// Samples like [`sample`], and has every estimate of x0 refined before its step is taken.
///
/// ε̂ follows the refined x̂0, so that √ᾱ x̂0 + √(1−ᾱ) ε̂ is still x_t. The refinement comes after known
/// values are imposed, and once more on the sample at the end. Without one the bytes are those of
/// [`sample`].
///
/// - `x`: the sample at the last of its `n_left` steps; all T of them for noise. What was made noisy to
///   step n − 1 ([`Schedule::add_noise`]) has n left
///
/// # Errors
/// Those of [`sample`]; more sampling steps than there are left.
pub fn sample_refined<E: From<DiffusionError>>(
    config: &SamplerConfig,
    schedule: &Schedule,
    (mut x, n_left): (Array3<f32>, usize),
    mut denoise: impl FnMut(ArrayView3<'_, f32>, usize) -> Result<Array3<f32>, E>,
    mut noise: impl FnMut(usize, &mut [f32]),
    known: Option<&KnownValues>,
    mut refine: Option<Refine<'_>>,
) -> Result<Array3<f32>, E> {
    let n_left = n_left.min(schedule.len());
    config.check(n_left)?;
    if let Some(known) = known {
        let what = "the tensor of known values";
        DiffusionError::check_shape(what, known.values().shape(), "the sample", x.shape())?;
    }
    let clip_range = schedule.clip_range().filter(|_| config.clip);
    let steps = steps(n_left, config.n_steps, config.spacing)?;
    let batch = x.dim().0;
    let mut z = Array3::<f32>::zeros(x.raw_dim());
    let mut draw = |number: usize, z: &mut Array3<f32>| {
        noise(number, z.as_slice_mut().expect("an array made in standard order"));
    };
    let mut previous: Option<Array3<f32>> = None;
    for (i, &SamplerStep { t, .. }) in steps.iter().enumerate() {
        let level = schedule.level(Some(t));
        if let Some(known) = known {
            draw(2 * i + 1, &mut z);
            known.impose_noisy(&mut x, level, &z);
        }
        let prediction = denoise(x.view(), t)?;
        DiffusionError::check_shape(
            "the denoiser's prediction",
            prediction.shape(),
            "the sample",
            x.shape(),
        )?;
        let (mut x0, mut epsilon) =
            schedule.estimate_within(prediction.view(), x.view(), &vec![t; batch], clip_range);
        if let Some(known) = known {
            known.impose_on_estimates(&mut x0, &mut epsilon, &x, level);
        }
        if let Some(refine) = &mut refine {
            refine(&mut x0);
            Zip::from(&mut epsilon)
                .and(&x)
                .and(&x0)
                .for_each(|epsilon, &x_t, &x0| *epsilon = epsilon_of(level, x_t, x0));
        }
        let update = config.update(schedule, &steps, i);
        x *= update.x_t as f32;
        add(&mut x, update.x0, &x0);
        add(&mut x, update.epsilon, &epsilon);
        if let Some(previous) = &previous {
            add(&mut x, update.previous, previous);
        }
        if update.sigma > 0.0 {
            draw(2 * i, &mut z);
            add(&mut x, update.sigma, &z);
        }
        previous = Some(x0);
    }
    if let Some(known) = known {
        known.impose(&mut x);
    }
    if let Some(refine) = &mut refine {
        refine(&mut x);
    }
    Ok(x)
}

/// Adds `factor` · `term` to a sum; a factor of 0 adds nothing, not even NaN.
fn add(sum: &mut Array3<f32>, factor: f64, term: &Array3<f32>) {
    if factor != 0.0 {
        sum.scaled_add(factor as f32, term);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::{DiffusionConfig, Sampler};

    /// Numbers that differ by draw and place; their distribution is of no importance here.
    fn some_noise(draw: usize, z: &mut [f32]) {
        for (i, z) in z.iter_mut().enumerate() {
            *z = ((draw * 131 + i * 17) as f32).sin();
        }
    }

    fn schedule() -> Schedule {
        let config = DiffusionConfig { n_steps: 100, ..Default::default() };
        Schedule::new(&config).expect("a schedule")
    }

    fn run(sampler: Sampler, known: Option<&KnownValues>) -> (Array3<f32>, Vec<usize>, Vec<usize>) {
        let (mut visited, mut drawn) = (Vec::new(), Vec::new());
        let config = SamplerConfig { sampler, n_steps: 4, ..Default::default() };
        let x = Array3::from_shape_fn((2, 3, 5), |(i, j, k)| (i + 2 * j + 3 * k) as f32 - 9.0);
        let denoise = |x: ArrayView3<'_, f32>, t: usize| {
            visited.push(t);
            Ok::<_, DiffusionError>(x.mapv(|x| x.tanh()))
        };
        let noise = |draw: usize, z: &mut [f32]| {
            drawn.push(draw);
            some_noise(draw, z);
        };
        let sampled = sample(&config, &schedule(), x, denoise, noise, known).expect("a sample");
        (sampled, visited, drawn)
    }

    #[test]
    fn draws_are_numbered_and_only_made_where_something_is_random() {
        let known = KnownValues::new(
            Array3::from_elem((2, 3, 5), 0.25),
            Array3::from_shape_fn((2, 3, 5), |(_, frame, _)| frame == 0),
        )
        .expect("known values");
        for (sampler, own) in [
            (Sampler::Ddpm, &[0, 2, 4][..]),
            (Sampler::Ddim { eta: 0.5 }, &[0, 2, 4]),
            (Sampler::Ddim { eta: 0.0 }, &[]),
            (Sampler::DpmSolver, &[]),
        ] {
            let (_, visited, drawn) = run(sampler, None);
            assert_eq!(visited, [99, 74, 49, 24], "{sampler:?}");
            assert_eq!(drawn, own, "{sampler:?}");
            let (sampled, _, mut drawn) = run(sampler, Some(&known));
            drawn.sort_unstable();
            let mut all: Vec<usize> = own.iter().copied().chain([1, 3, 5, 7]).collect();
            all.sort_unstable();
            assert_eq!(drawn, all, "{sampler:?}");
            for ((sample, frame, channel), &x) in sampled.indexed_iter() {
                assert_eq!(frame == 0, x == 0.25, "{sampler:?} at {sample} {frame} {channel}: {x}");
            }
        }
    }

    #[test]
    fn refined_estimates_lead_to_a_refined_sample() {
        // Every estimate is made the mean of its frames; the sample ends there, by every sampler.
        for sampler in [Sampler::Ddpm, Sampler::Ddim { eta: 0.5 }, Sampler::DpmSolver] {
            let config = SamplerConfig { sampler, n_steps: 4, ..Default::default() };
            let x = Array3::from_shape_fn((2, 3, 5), |(i, j, k)| (i + 2 * j + 3 * k) as f32 - 9.0);
            let denoise = |x: ArrayView3<'_, f32>, _| Ok::<_, DiffusionError>(x.mapv(f32::tanh));
            let mut n_refined = 0;
            let mut refine = |x0: &mut Array3<f32>| {
                n_refined += 1;
                let mean = x0.mean_axis(ndarray::Axis(1)).expect("three frames");
                x0.axis_iter_mut(ndarray::Axis(1)).for_each(|mut frame| frame.assign(&mean));
            };
            let (s, refine) = (schedule(), Some(&mut refine as Refine<'_>));
            let sampled = sample_refined(&config, &s, (x, 100), denoise, some_noise, None, refine)
                .expect("a sample");
            assert_eq!(n_refined, 5, "{sampler:?}");
            let spread = |i: usize, k: usize| (sampled[[i, 0, k]] - sampled[[i, 2, k]]).abs();
            assert!((0..2).all(|i| (0..5).all(|k| spread(i, k) == 0.0)), "{sampler:?}");
            assert!(sampled.iter().any(|x| x.abs() > 0.1), "{sampler:?}");
        }
    }

    #[test]
    fn same_draws_give_the_same_bytes() {
        for sampler in [Sampler::Ddpm, Sampler::Ddim { eta: 1.0 }, Sampler::DpmSolver] {
            let bits = |x: &Array3<f32>| x.iter().map(|x| x.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&run(sampler, None).0), bits(&run(sampler, None).0), "{sampler:?}");
        }
    }

    #[test]
    fn estimates_are_clipped_if_asked() {
        // A prediction of no noise: x̂0 = x_t / √ᾱ, 200 times x at the first step.
        let run = |clip| {
            let config = SamplerConfig { clip, n_steps: 1, ..Default::default() };
            let silent = |x: ArrayView3<'_, f32>, _| Ok::<_, DiffusionError>(&x * 0.0);
            let x = Array3::from_elem((1, 2, 3), 1.0);
            sample(&config, &schedule(), x, silent, some_noise, None).expect("a sample")
        };
        assert!(run(true).iter().all(|&x| x == 5.0));
        let expected = 1.0 / schedule().level(Some(99)).signal as f32;
        assert!(run(false).iter().all(|&x| x == expected));
    }

    #[test]
    fn bad_input_is_refused_in_whole_sentences() {
        let message = |config: SamplerConfig, output: [usize; 3], known: Option<&KnownValues>| {
            let denoise = |_: ArrayView3<'_, f32>, _| Ok(Array3::zeros(output));
            let result: Result<_, DiffusionError> =
                sample(&config, &schedule(), Array3::zeros((2, 3, 5)), denoise, some_noise, known);
            result.expect_err("bad input").to_string()
        };
        let with = |sampler, n_steps| SamplerConfig { sampler, n_steps, ..Default::default() };
        assert_eq!(
            message(with(Sampler::Ddim { eta: 1.5 }, 4), [2, 3, 5], None),
            "eta is 1.5; it must be 0 (no noise is added while sampling) to 1 (as much as DDPM adds)"
        );
        assert_eq!(
            message(with(Sampler::Ddpm, 101), [2, 3, 5], None),
            "n_steps of the sampler is 101; it must be 1 to 100, the number of steps that the \
             network was trained on"
        );
        assert_eq!(
            message(with(Sampler::DpmSolver, 4), [2, 5, 3], None),
            "the denoiser's prediction has shape [2, 5, 3]; [2, 3, 5] is needed, the shape of the \
             sample"
        );
        let known = KnownValues::new(Array3::zeros((1, 3, 5)), Array3::from_elem((1, 3, 5), true))
            .expect("known values");
        assert_eq!(
            message(with(Sampler::DpmSolver, 4), [2, 3, 5], Some(&known)),
            "the tensor of known values has shape [1, 3, 5]; [2, 3, 5] is needed, the shape of the \
             sample"
        );
    }
}
