//! The UNet that predicts the noise in motion from the noisy motion, the step and the music.
//!
//! Drawn as in the reference's diagram: an encoder that halves the frames level by level, a
//! bottleneck, and a decoder that takes each level's skip. At the lower levels attention looks over
//! all frames and at the music. The music is also added to the first level, frame by frame: attention
//! alone sees it as a set of frames, since neither keys nor queries know their place, and could never
//! tell when a beat falls (the reference's network cannot).

mod config;

use std::sync::Arc;

use ndarray::Array2;

pub use config::{ConfigError, Preset, UNetConfig};
pub(super) use config::{MAX_BLOCKS, MAX_TABLE_VALUES, MAX_WIDTH};

use super::graph::{Activation, Graph, Result};
use super::layers::{AttentionBlock, Conv1d, GroupNorm, Linear, ResBlock};
use super::parameter::{Init, ParameterId, ParameterList, Role, Scope};

/// Predicts noise; see the module.
#[derive(Clone, Debug)]
pub struct UNet1D {
    /// Sinusoids of each step, \[n_steps, time_embed_dim\], computed in f64.
    time_table: Arc<Array2<f64>>,
    time_mlp: [Linear; 2],
    style_proj: Option<Linear>,
    audio_proj: Linear,
    null_context: ParameterId,
    /// The context, at the width of the first level.
    audio_in: Option<Linear>,
    conv_in: Conv1d,
    encoder: Vec<EncoderLevel>,
    bottleneck: Bottleneck,
    /// From the lowest level up to level 0.
    decoder: Vec<DecoderLevel>,
    out_norm: GroupNorm,
    out_conv: Conv1d,
    checkpoint: bool,
}

/// The inputs of a UNet.
pub struct UNetInputs<'a, T> {
    /// Noisy motion, normalised, \[batch, frames, in_channels\].
    pub x: &'a T,
    /// Step of each sample, \[batch\], whole numbers in 0..n_steps.
    pub t: &'a T,
    /// Features of the music and its clock, \[batch, frames, condition_dim\].
    pub audio: &'a T,
    /// Samples that go without music, \[batch\], 1 where the null context is used.
    pub drop_audio: Option<&'a T>,
    /// Frames that count, \[batch, frames\], 1 or 0; all where absent.
    pub mask: Option<&'a T>,
    /// Style of each sample, \[batch, style_dim\], of a network that takes one.
    pub style: Option<&'a T>,
}

#[derive(Clone, Debug)]
struct EncoderLevel {
    res: Vec<ResBlock>,
    attn: Option<AttentionBlock>,
    down: Option<Conv1d>,
}

#[derive(Clone, Debug)]
struct Bottleneck {
    res: [ResBlock; 2],
    attn: AttentionBlock,
}

#[derive(Clone, Debug)]
struct DecoderLevel {
    res: Vec<ResBlock>,
    attn: Option<AttentionBlock>,
    up: Option<Conv1d>,
}

/// The conditions of every level.
struct Conditions<T> {
    time: T,
    context: T,
    context_mask: Option<T>,
}

impl<T> Conditions<T> {
    /// Returns the tensors in order, and how to find them again among a part's inputs.
    fn inputs<'a>(&'a self, x: &'a T, mask: &'a T) -> Vec<&'a T> {
        let mut inputs = vec![x, mask, &self.time, &self.context];
        inputs.extend(&self.context_mask);
        inputs
    }
}

impl UNet1D {
    /// Makes the network and the list of its parameters.
    pub fn new(config: &UNetConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let unet = Self::within(&mut Scope::root(&mut list), config);
        (unet, list)
    }

    /// Makes the network as a part of another.
    ///
    /// # Panics
    /// When the configuration is none that [`UNetConfig::check`] lets through.
    pub fn within(root: &mut Scope, config: &UNetConfig) -> Self {
        let c = config;
        let time_dim = c.time_embed_dim;
        let res = |scope: &mut Scope, inputs, outputs| {
            ResBlock::new(scope, inputs, outputs, time_dim, c.use_scale_shift_norm, c.dropout)
        };
        let attn = |scope: &mut Scope, width| {
            AttentionBlock::new(scope, width, c.heads(width), c.context_dim)
        };
        let time_mlp = [
            Linear::new(&mut root.at("time_mlp.0"), time_dim, time_dim),
            Linear::new(&mut root.at("time_mlp.2"), time_dim, time_dim),
        ];
        let style_proj = (c.style_dim > 0)
            .then(|| Linear::new(&mut root.at("style_proj"), c.style_dim, time_dim));
        let audio_proj = Linear::new(&mut root.at("audio_proj"), c.condition_dim(), c.context_dim);
        let null_context =
            root.parameter("null_context", &[c.context_dim], Init::Zeros, Role::Vector);
        let audio_in =
            c.add_audio.then(|| Linear::new(&mut root.at("audio_in"), c.context_dim, c.widths[0]));
        let last = c.widths.len() - 1;
        let conv_in = Conv1d::new(&mut root.at("conv_in"), c.in_channels, c.widths[0], 3, 1);

        let mut encoder = Vec::new();
        let mut width = c.widths[0];
        for (level, &outputs) in c.widths.iter().enumerate() {
            let mut scope = root.at(format!("encoder.{level}"));
            let mut blocks = Vec::new();
            for i in 0..c.num_res_blocks {
                blocks.push(res(&mut scope.at(format!("res.{i}")), width, outputs));
                width = outputs;
            }
            let attends = c.attention_levels.contains(&level);
            encoder.push(EncoderLevel {
                res: blocks,
                attn: attends.then(|| attn(&mut scope.at("attn"), width)),
                down: (level < last)
                    .then(|| Conv1d::new(&mut scope.at("down"), width, width, 3, 2)),
            });
        }

        let mut scope = root.at("bottleneck");
        let bottleneck = Bottleneck {
            res: [0, 1].map(|i| res(&mut scope.at(format!("res.{i}")), width, width)),
            attn: attn(&mut scope.at("attn"), width),
        };

        // Attention takes the place of the last block where a level attends and is neither the lowest
        // nor the highest, as the diagram has it; one block stays, which takes in the skip.
        let mut decoder = Vec::new();
        for level in (0..=last).rev() {
            let mut scope = root.at(format!("decoder.{level}"));
            let outputs = c.widths[level.saturating_sub(1)];
            let attends = c.attention_levels.contains(&level) && level != last && level != 0;
            let n_blocks = (c.num_res_blocks - usize::from(attends)).max(1);
            let mut blocks = Vec::new();
            let mut inputs = width + c.widths[level];
            for i in 0..n_blocks {
                blocks.push(res(&mut scope.at(format!("res.{i}")), inputs, outputs));
                inputs = outputs;
            }
            width = outputs;
            decoder.push(DecoderLevel {
                res: blocks,
                attn: attends.then(|| attn(&mut scope.at("attn"), width)),
                up: (level > 0).then(|| Conv1d::new(&mut scope.at("up"), width, width, 3, 1)),
            });
        }
        let out_norm = GroupNorm::new(&mut root.at("out.norm"), width);
        let out_conv = Conv1d::zeros(&mut root.at("out.conv"), width, c.out_channels, 3);
        Self {
            time_table: Arc::new(time_table(c.n_steps, time_dim)),
            time_mlp,
            style_proj,
            audio_proj,
            null_context,
            audio_in,
            conv_in,
            encoder,
            bottleneck,
            decoder,
            out_norm,
            out_conv,
            checkpoint: c.use_checkpoint,
        }
    }

    /// Predicts the noise in `x`.
    ///
    /// Frames beyond a multiple of 2^(levels − 1) are held, masked out of attention, and cropped.
    ///
    /// # Shapes
    /// See [`UNetInputs`]; returns \[batch, frames, out_channels\]
    pub fn forward<G: Graph>(&self, g: &mut G, inputs: UNetInputs<G::Tensor>) -> Result<G::Tensor> {
        let multiple = 1 << (self.encoder.len() - 1);
        let conditions = self.conditions(g, &inputs)?;
        let x = g.hold_frames(inputs.x, multiple)?;
        let mut mask = g.frame_mask(inputs.x, inputs.mask, multiple)?;
        let mut x = self.conv_in.forward(g, &x)?;
        if let Some(audio_in) = &self.audio_in {
            let audio = audio_in.forward(g, &conditions.context)?;
            let audio = g.hold_frames(&audio, multiple)?;
            x = g.add(&x, &audio)?;
        }

        let mut skips = Vec::new();
        for level in &self.encoder {
            x = self.part(g, &conditions, &x, &mask, level)?;
            skips.push((x.clone(), mask.clone()));
            if let Some(down) = &level.down {
                x = down.forward(g, &x)?;
                mask = g.stride_mask(&mask, 2)?;
            }
        }
        x = self.part(g, &conditions, &x, &mask, &self.bottleneck)?;
        for level in &self.decoder {
            let (skip, mask) = skips.pop().expect("as many skips as levels");
            x = g.concat(&[&x, &skip])?;
            drop(skip);
            x = self.part(g, &conditions, &x, &mask, level)?;
            if let Some(up) = &level.up {
                x = g.upsample(&x, 2)?;
                x = up.forward(g, &x)?;
            }
        }
        let x = self.out_norm.forward(g, &x, None, Activation::Silu)?;
        let x = self.out_conv.forward(g, &x)?;
        g.crop_frames(&x, inputs.x)
    }

    /// The time embedding, ready for the blocks, and the music as context.
    fn conditions<G: Graph>(
        &self,
        g: &mut G,
        inputs: &UNetInputs<G::Tensor>,
    ) -> Result<Conditions<G::Tensor>> {
        let time = g.gather(&self.time_table, inputs.t)?;
        let time = self.time_mlp[0].forward(g, &time)?;
        let time = g.activation(&time, Activation::Silu)?;
        let mut time = self.time_mlp[1].forward(g, &time)?;
        if let (Some(style_proj), Some(style)) = (&self.style_proj, inputs.style) {
            let style = style_proj.forward(g, style)?;
            time = g.add(&time, &style)?;
        }
        // Every block begins with the SiLU of the same embedding: once is enough.
        let time = g.activation(&time, Activation::Silu)?;
        let mut context = self.audio_proj.forward(g, inputs.audio)?;
        if let Some(drop_audio) = inputs.drop_audio {
            let null = g.parameter(self.null_context)?;
            context = g.select(drop_audio, &null, &context)?;
        }
        Ok(Conditions { time, context, context_mask: inputs.mask.cloned() })
    }

    /// Runs a level, as a checkpoint where the configuration asks for it.
    fn part<G: Graph, L: Level>(
        &self,
        g: &mut G,
        conditions: &Conditions<G::Tensor>,
        x: &G::Tensor,
        mask: &G::Tensor,
        level: &L,
    ) -> Result<G::Tensor> {
        if !self.checkpoint {
            return level.forward(g, x, mask, conditions);
        }
        let level = level.clone();
        g.checkpoint(&conditions.inputs(x, mask), move |g, inputs| {
            let conditions = Conditions {
                time: inputs[2].clone(),
                context: inputs[3].clone(),
                context_mask: inputs.get(4).cloned(),
            };
            level.forward(g, &inputs[0], &inputs[1], &conditions)
        })
    }
}

/// A part of the network between two changes of the number of frames.
trait Level: Clone + Send + 'static {
    /// \[batch, frames, inputs\] → \[batch, frames, outputs\]
    fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        mask: &G::Tensor,
        conditions: &Conditions<G::Tensor>,
    ) -> Result<G::Tensor>;
}

impl Level for EncoderLevel {
    fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        mask: &G::Tensor,
        conditions: &Conditions<G::Tensor>,
    ) -> Result<G::Tensor> {
        blocks_then_attention(g, &self.res, self.attn.as_ref(), x, mask, conditions)
    }
}

impl Level for Bottleneck {
    fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        mask: &G::Tensor,
        conditions: &Conditions<G::Tensor>,
    ) -> Result<G::Tensor> {
        let [first, last] = &self.res;
        let attn = Some(&self.attn);
        let x = blocks_then_attention(g, std::slice::from_ref(first), attn, x, mask, conditions)?;
        last.forward(g, &x, &conditions.time)
    }
}

impl Level for DecoderLevel {
    fn forward<G: Graph>(
        &self,
        g: &mut G,
        x: &G::Tensor,
        mask: &G::Tensor,
        conditions: &Conditions<G::Tensor>,
    ) -> Result<G::Tensor> {
        blocks_then_attention(g, &self.res, self.attn.as_ref(), x, mask, conditions)
    }
}

/// Runs the blocks in order, then attention where the level has it.
fn blocks_then_attention<G: Graph>(
    g: &mut G,
    blocks: &[ResBlock],
    attn: Option<&AttentionBlock>,
    x: &G::Tensor,
    mask: &G::Tensor,
    conditions: &Conditions<G::Tensor>,
) -> Result<G::Tensor> {
    let mut x = x.clone();
    for block in blocks {
        x = block.forward(g, &x, &conditions.time)?;
    }
    match attn {
        Some(attn) => {
            let context_mask = conditions.context_mask.as_ref();
            attn.forward(g, &x, Some(mask), &conditions.context, context_mask)
        }
        None => Ok(x),
    }
}

/// Returns the sinusoids of each step: row t is \[cos(t ω₀), …, sin(t ω₀), …\], ω_i = 10000^(−i / half).
///
/// In f64, since the sine of a large angle in f32 is off by 3e-5 (Vaswani et al., "Attention Is All
/// You Need", NIPS 2017, sec. 3.5, cosines first as in Dhariwal and Nichol's code).
pub(super) fn time_table(n_steps: usize, dim: usize) -> Array2<f64> {
    let half = dim / 2;
    Array2::from_shape_fn((n_steps, dim), |(t, i)| {
        let angle = t as f64 * (-(10_000_f64.ln()) * (i % half) as f64 / half as f64).exp();
        if i < half { angle.cos() } else { angle.sin() }
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn presets_have_the_sizes_that_the_reference_states() {
        // Counted by PyTorch (tests/golden/engine/network.py) as the reference draws them; the null
        // context and the music at the first level come on top.
        let count = |preset: Preset| UNet1D::new(&preset.config()).1.n_elements();
        let more = 256 + (256 * 256 + 256);
        assert_eq!(count(Preset::Large), 225_084_697 + more);
        assert_eq!(count(Preset::Base), 116_651_673 + more);
        let drawn = UNetConfig { add_audio: false, ..Preset::Base.config() };
        assert_eq!(UNet1D::new(&drawn).1.n_elements(), 116_651_673 + 256);
        assert!((116e6 * 0.99..116e6 * 1.01).contains(&(count(Preset::Base) as f64)));
        assert!((3_000_000..6_000_000).contains(&count(Preset::Small)), "{}", count(Preset::Small));
        assert!(count(Preset::Tiny) < 500_000, "{}", count(Preset::Tiny));
    }

    #[test]
    fn the_time_table_holds_cosines_and_then_sines() {
        let table = time_table(1000, 8);
        assert_eq!(table.row(0).to_vec(), [1.0, 1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
        let angle = 999.0 * 0.001;
        assert!((table[[999, 3]] - f64::cos(angle)).abs() < 1e-12);
        assert!((table[[999, 7]] - f64::sin(angle)).abs() < 1e-12);
    }
}
