//! Layers: configuration, then parameters, then forward.

mod attention;
mod linear;
mod norm;
mod residual;

pub use attention::AttentionBlock;
pub use linear::{Conv1d, Linear};
pub use norm::{GroupNorm, LayerNorm};
pub use residual::ResBlock;
