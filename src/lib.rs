//! motiongen turns a music library into motion.
//!
//! The rooms and what they may use are in `docs/architecture.md`; a test keeps them so.

pub mod audio;
pub mod autodiff;
pub mod chance;
pub mod cli;
pub mod diffusion;
pub mod evaluation;
mod excerpt;
pub mod generation;
mod instructions;
mod markup;
pub mod model;
pub mod motion;
pub mod music;
pub mod onnx;
pub mod plot;
pub mod report;
pub mod stages;
pub mod store;
pub mod training;
pub mod units;
pub mod view;
pub mod weights;
