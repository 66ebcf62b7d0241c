//! How much each step counts in training.

use super::config::{DiffusionError, Prediction};
use super::schedule::Schedule;

/// Returns the weight of each sample's loss by which Hang et al. balance the steps.
///
/// With SNR = ᾱ/(1−ᾱ): min(SNR, γ)/SNR for a network that predicts ε, min(SNR, γ) for x0, and
/// min(SNR, γ)/(SNR+1) for v. All are the same weight, min(SNR, γ), of an error in x0.
///
/// - `t`: \[batch\], each below `schedule.len()`
/// - `gamma`: above 0; the paper's choice is 5
///
/// # Errors
/// A `gamma` that is not a number above 0.
///
/// Hang et al., "Efficient Diffusion Training via Min-SNR Weighting Strategy", ICCV 2023,
/// arXiv 2303.09556, section 3.4.
pub fn min_snr_weights(
    schedule: &Schedule,
    t: &[usize],
    gamma: f64,
) -> Result<Vec<f64>, DiffusionError> {
    if !(gamma > 0.0 && gamma.is_finite()) {
        return Err(DiffusionError::Gamma { gamma });
    }
    let weight = |&t: &usize| {
        let snr = schedule.snr(t);
        let clamped = snr.min(gamma);
        match schedule.prediction() {
            Prediction::Epsilon => clamped / snr,
            Prediction::Sample => clamped,
            Prediction::Velocity => clamped / (snr + 1.0),
        }
    };
    Ok(t.iter().map(weight).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::DiffusionConfig;

    #[test]
    fn the_three_weights_are_one_weight_of_an_error_in_x0() {
        let t: Vec<usize> = (0..1000).step_by(37).collect();
        let weights_for = |prediction| {
            let config = DiffusionConfig { prediction, ..Default::default() };
            let schedule = Schedule::new(&config).expect("a schedule");
            (min_snr_weights(&schedule, &t, 5.0).expect("weights"), schedule)
        };
        let (epsilon, schedule) = weights_for(Prediction::Epsilon);
        let (sample, _) = weights_for(Prediction::Sample);
        let (velocity, _) = weights_for(Prediction::Velocity);
        for (i, &t) in t.iter().enumerate() {
            // An error e in x0 is √SNR e in ε and √(SNR+1) e in v.
            let snr = schedule.snr(t);
            assert!((epsilon[i] * snr / sample[i] - 1.0).abs() < 1e-12, "step {t}");
            assert!((velocity[i] * (snr + 1.0) / sample[i] - 1.0).abs() < 1e-12, "step {t}");
            assert!(sample[i] <= 5.0 && epsilon[i] <= 1.0, "step {t}");
        }
        assert_eq!(
            min_snr_weights(&schedule, &[0], 0.0).expect_err("gamma 0").to_string(),
            "gamma of min-SNR weighting is 0; it must be a number above 0, and 5 is usual"
        );
    }
}
