//! Tokens drawn from what a planner says of them: all at once by masked discrete diffusion, or one after the other.
//!
//! A planner is any function from tokens to logits. As everywhere in this room nothing draws random numbers: who calls
//! gives them, uniform in \[0, 1), by the number of the draw.
//!
//! # Sources
//!
//! - Chang et al., "MaskGIT", CVPR 2022, arXiv 2202.04200: masking by a cosine, the surest tokens stay
//! - Guo et al., "MoMask", CVPR 2024, arXiv 2312.00063 and its code (`mask_transformer/transformer.py`): number and
//!   order of the iterations, and the filter of the most probable tokens
//! - Gu et al., arXiv 2603.19227, section 4.1: ten iterations, that filter and guidance for tokens of motion

mod autoregressive;
mod masked;
#[cfg(test)]
mod tests;

use std::f64::consts::FRAC_PI_2;

use serde::{Deserialize, Serialize};

use super::config::DiffusionError;
pub use autoregressive::sample_autoregressive;
pub use masked::sample_masked;

/// How tokens are drawn.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokenSampling {
    /// Iterations of masked discrete diffusion.
    pub n_iterations: usize,
    /// Divides the logits before a token is drawn: below 1 likelier tokens are drawn more often, at 0 always the
    /// likeliest.
    pub temperature: f64,
    /// How much chance is in the choice of the tokens that stay: 0 keeps the surest, a large number any.
    pub confidence_temperature: f64,
    /// Share of the tokens, the most probable ones, that may be drawn.
    pub top_share: f64,
}

impl Default for TokenSampling {
    fn default() -> Self {
        Self { n_iterations: 10, temperature: 1.0, confidence_temperature: 0.0, top_share: 0.1 }
    }
}

/// Most iterations; a window has fewer tokens.
const MAX_ITERATIONS: usize = 100_000;

impl TokenSampling {
    /// Refuses numbers by which nothing can be drawn.
    ///
    /// # Errors
    /// One sentence.
    pub fn check(&self) -> Result<(), DiffusionError> {
        let Self { n_iterations, temperature, confidence_temperature, top_share } = *self;
        if !(1..=MAX_ITERATIONS).contains(&n_iterations) {
            return Err(DiffusionError::Iterations { n_iterations, most: MAX_ITERATIONS });
        }
        for (what, temperature) in
            [("temperature", temperature), ("confidence_temperature", confidence_temperature)]
        {
            if !(temperature.is_finite() && temperature >= 0.0) {
                return Err(DiffusionError::Temperature { what, temperature });
            }
        }
        if !(top_share > 0.0 && top_share <= 1.0) {
            return Err(DiffusionError::TopShare { top_share });
        }
        Ok(())
    }

    /// Returns how many of K tokens may be drawn: ⌈share · K⌉, at least one.
    pub fn n_allowed(&self, n_codes: usize) -> usize {
        // A share such as 0.1 of 30 is 3, whatever its last bit says.
        let n = (self.top_share * n_codes as f64 - 1e-9).ceil();
        (n as usize).clamp(1, n_codes.max(1))
    }

    /// Draws a token from logits by a number in \[0, 1); returns it and ln p of it among all tokens.
    ///
    /// p' ∝ p^(1/temperature) over the most probable tokens, of equal ones the first; confidence is that of p, as MoMask
    /// has it.
    ///
    /// # Errors
    /// Logits that are no numbers.
    fn draw(&self, logits: &[f32], u: f64) -> Result<(u32, f64), DiffusionError> {
        if logits.iter().any(|x| x.is_nan() || *x == f32::INFINITY) {
            return Err(DiffusionError::Logits);
        }
        let mut order: Vec<usize> = (0..logits.len()).collect();
        // Stable, so that of equal ones the first comes first.
        order.sort_by(|&a, &b| logits[b].total_cmp(&logits[a]));
        let largest = f64::from(logits[order[0]]);
        if largest == f64::NEG_INFINITY {
            return Err(DiffusionError::Logits);
        }
        let sum: f64 = logits.iter().map(|&x| (f64::from(x) - largest).exp()).sum();
        order.truncate(self.n_allowed(logits.len()));
        let mut chosen = order[0];
        if self.temperature > 0.0 {
            let weight = |k: usize| ((f64::from(logits[k]) - largest) / self.temperature).exp();
            let mut left = u * order.iter().map(|&k| weight(k)).sum::<f64>();
            for &k in &order {
                // Rounding may leave a little behind the last, which is none that cannot be drawn.
                let weight = weight(k);
                if weight > 0.0 {
                    chosen = k;
                }
                left -= weight;
                if left < 0.0 {
                    break;
                }
            }
        }
        Ok((chosen as u32, f64::from(logits[chosen]) - largest - sum.ln()))
    }
}

/// Returns how many of n tokens are masked at a share r of the way: n cos(π r / 2), rounded, and at least one.
pub fn n_masked(n: usize, r: f64) -> usize {
    let masked = (n as f64 * (FRAC_PI_2 * r).cos()).round() as usize;
    masked.clamp(1.min(n), n)
}
