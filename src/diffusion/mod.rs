//! Diffusion: noise is added to motion step by step, and a network learns to take it away.
//!
//! A denoiser is any function of x_t and t; this room knows no network, draws no random numbers and
//! does no I/O. Tensors are \[batch, frames, channels\], f32; coefficients are computed in f64. What is
//! diffused is normalized to a standard deviation near 1 in every channel.
//!
//! # Notation
//!
//! | symbol | meaning |
//! |---|---|
//! | T, t | number of steps; a step, 0 (least noise) to T − 1 |
//! | β_t, α_t | share of the variance that step t replaces by noise; 1 − β_t |
//! | ᾱ_t | Π α_s for s ≤ t: share of the data's variance left after step t; 1 is clean data |
//! | ᾱ' | ᾱ where a sampler's step leads |
//! | x0, ε, z | clean sample; the noise in x_t; fresh noise; ε and z standard normal |
//! | x_t | √ᾱ_t x0 + √(1−ᾱ_t) ε |
//! | v | √ᾱ_t ε − √(1−ᾱ_t) x0 |
//! | x̂0, ε̂ | the network's estimates of x0 and ε, whichever of ε, x0 and v it predicts |
//! | SNR, λ | ᾱ/(1−ᾱ); ln(√ᾱ/√(1−ᾱ)) = ½ ln SNR |
//! | σ, η | deviation of the noise that a step adds; σ as a share of DDPM's |
//!
//! # Order of a step
//!
//! [`sample`] imposes known values on x_t, asks the denoiser, turns its prediction into x̂0 and ε̂
//! (clipped if so configured), imposes known values on them, has them refined where the caller wants
//! that ([`sample_refined`]), and takes the sampler's step.
//!
//! # Sources
//!
//! - Ho, Jain and Abbeel, "Denoising Diffusion Probabilistic Models", NeurIPS 2020, arXiv 2006.11239:
//!   process, posterior, linear schedule
//! - Nichol and Dhariwal, "Improved Denoising Diffusion Probabilistic Models", ICML 2021,
//!   arXiv 2102.09672: cosine schedule, respaced steps
//! - Song, Meng and Ermon, "Denoising Diffusion Implicit Models", ICLR 2021, arXiv 2010.02502
//! - Salimans and Ho, "Progressive Distillation for Fast Sampling of Diffusion Models", ICLR 2022,
//!   arXiv 2202.00512: v
//! - Lu et al., "DPM-Solver++", arXiv 2211.01095, 2022
//! - Ho and Salimans, "Classifier-Free Diffusion Guidance", arXiv 2207.12598, 2022
//! - Lugmayr et al., "RePaint", CVPR 2022, arXiv 2201.09865: known values
//! - Hang et al., "Efficient Diffusion Training via Min-SNR Weighting Strategy", ICCV 2023,
//!   arXiv 2303.09556
//! - those of tokens are in `discrete`
//! - Lin et al., "Common Diffusion Noise Schedules and Sample Steps are Flawed", WACV 2024,
//!   arXiv 2305.08891: spacing

mod config;
mod ddim;
mod ddpm;
mod discrete;
mod dpm_solver;
mod guidance;
mod inpaint;
mod process;
mod sample;
mod sampler;
mod schedule;
mod spacing;
mod weighting;

pub use config::{BetaSchedule, DiffusionConfig, DiffusionError, LossType, MAX_STEPS, Prediction};
pub use ddim::{DdimCoefficients, ddim_linear, ddim_update};
pub use ddpm::{Posterior, posterior};
pub use discrete::{TokenSampling, n_masked, sample_autoregressive, sample_masked};
pub use dpm_solver::{DpmCoefficients, dpm_solver_update};
pub use guidance::{denoise_guided, guided};
pub use inpaint::KnownValues;
pub use sample::{Refine, sample, sample_refined};
pub use sampler::{Sampler, SamplerConfig};
pub use schedule::{Level, Schedule};
pub use spacing::{SamplerStep, Spacing, steps, timesteps};
pub use weighting::min_snr_weights;
