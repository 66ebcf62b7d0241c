//! The diffusion against published formulas and against closed forms of a Gaussian.

mod gaussian;
mod golden;
mod guidance;
mod inpainting;
mod propagation;
mod samplers;
