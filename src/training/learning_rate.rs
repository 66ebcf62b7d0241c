//! How the learning rate rises and falls.

use std::f64::consts::PI;

use serde::{Deserialize, Serialize};

/// The course of the learning rate after the warm-up.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LearningRateSchedule {
    /// Stays.
    Constant,
    /// (1 + cos π p) / 2 over the share p of the steps after the warm-up.
    Cosine,
    /// 1 − p.
    Linear,
}

/// Learning rate by step: a linear warm-up, then a course down to 0.
///
/// Loshchilov and Hutter, "SGDR", ICLR 2017, eq. 5, with one period.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LearningRate {
    pub peak: f64,
    pub course: LearningRateSchedule,
    /// Steps of the warm-up; in a short training at most a tenth of all.
    pub warmup_steps: u64,
}

impl LearningRate {
    /// Returns the learning rate of `step`, counted from 0, of `n_steps`.
    pub fn at(&self, step: u64, n_steps: u64) -> f64 {
        let warmup = self.warmup_steps.min(n_steps / 10);
        if step < warmup {
            return self.peak * (step + 1) as f64 / warmup as f64;
        }
        let p = (step - warmup) as f64 / (n_steps.saturating_sub(warmup)).max(1) as f64;
        let p = p.min(1.0);
        self.peak
            * match self.course {
                LearningRateSchedule::Constant => 1.0,
                LearningRateSchedule::Cosine => (1.0 + (PI * p).cos()) / 2.0,
                LearningRateSchedule::Linear => 1.0 - p,
            }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn it_rises_to_the_peak_and_falls_to_zero() {
        let rate =
            LearningRate { peak: 2e-4, course: LearningRateSchedule::Cosine, warmup_steps: 1000 };
        let n = 21_000;
        // The first of 1000 equal parts of the peak, but for one rounding.
        assert!((rate.at(0, n) / 2e-7 - 1.0).abs() < 1e-15, "{}", rate.at(0, n));
        assert_eq!(rate.at(499, n), 1e-4);
        assert_eq!(rate.at(1000, n), 2e-4);
        // A quarter, half and three quarters of the way: (1 + cos πp) / 2.
        for (step, share) in
            [(6000, 0.853_553_390_593_273_8), (11_000, 0.5), (16_000, 0.146_446_609_406_726_2)]
        {
            assert!((rate.at(step, n) / 2e-4 - share).abs() < 1e-12, "{step}");
        }
        assert!(rate.at(n - 1, n) < 2e-12);
        let linear = LearningRate { course: LearningRateSchedule::Linear, ..rate };
        assert!((linear.at(6000, n) - 1.5e-4).abs() < 1e-18);
        let constant = LearningRate { course: LearningRateSchedule::Constant, ..rate };
        assert_eq!(constant.at(20_999, n), 2e-4);
    }

    #[test]
    fn a_short_training_warms_up_for_a_tenth() {
        let rate =
            LearningRate { peak: 1.0, course: LearningRateSchedule::Linear, warmup_steps: 1000 };
        assert_eq!((rate.at(0, 50), rate.at(4, 50), rate.at(5, 50)), (0.2, 1.0, 1.0));
        assert_eq!(rate.at(0, 1), 1.0);
        assert_eq!(rate.at(60, 50), 0.0, "beyond the end");
    }
}
