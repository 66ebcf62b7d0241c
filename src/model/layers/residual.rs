//! The residual block of the UNet.

use super::{Conv1d, GroupNorm, Linear};
use crate::model::graph::{Activation, Graph, Result};
use crate::model::parameter::Scope;

/// Two convolutions with a time-dependent scale and shift between them, around a skip.
#[derive(Clone, Debug)]
pub struct ResBlock {
    norm1: GroupNorm,
    conv1: Conv1d,
    time_mlp: Linear,
    norm2: GroupNorm,
    conv2: Conv1d,
    skip_conv: Option<Conv1d>,
    scale_shift: bool,
    dropout: f64,
}

impl ResBlock {
    /// Makes a block from `inputs` to `outputs` channels.
    ///
    /// With `scale_shift` the time embedding scales and shifts what `norm2` gives (FiLM); without, it
    /// is added before.
    pub fn new(
        scope: &mut Scope,
        inputs: usize,
        outputs: usize,
        time_embed_dim: usize,
        scale_shift: bool,
        dropout: f64,
    ) -> Self {
        let time_outputs = if scale_shift { 2 * outputs } else { outputs };
        Self {
            norm1: GroupNorm::new(&mut scope.at("norm1"), inputs),
            conv1: Conv1d::new(&mut scope.at("conv1"), inputs, outputs, 3, 1),
            time_mlp: Linear::new(&mut scope.at("time_mlp.1"), time_embed_dim, time_outputs),
            norm2: GroupNorm::new(&mut scope.at("norm2"), outputs),
            conv2: Conv1d::new(&mut scope.at("conv2"), outputs, outputs, 3, 1),
            skip_conv: (inputs != outputs)
                .then(|| Conv1d::new(&mut scope.at("skip_conv"), inputs, outputs, 1, 1)),
            scale_shift,
            dropout,
        }
    }

    /// # Shapes
    /// - `x`: \[batch, frames, inputs\]; `time`: \[batch, time_embed_dim\], after its SiLU
    /// - returns \[batch, frames, outputs\]
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        time: &G::Tensor,
    ) -> Result<G::Tensor> {
        let h = self.norm1.forward(g, x, None, Activation::Silu)?;
        let h = self.conv1.forward(g, &h)?;
        let time = self.time_mlp.forward(g, time)?;
        let h = if self.scale_shift {
            self.norm2.forward(g, &h, Some(&time), Activation::Silu)?
        } else {
            let h = g.add_to_frames(&h, &time)?;
            self.norm2.forward(g, &h, None, Activation::Silu)?
        };
        let h = g.dropout(&h, self.dropout)?;
        let h = self.conv2.forward(g, &h)?;
        match &self.skip_conv {
            Some(skip_conv) => {
                let skip = skip_conv.forward(g, x)?;
                g.add(&h, &skip)
            }
            None => g.add(&h, x),
        }
    }
}
