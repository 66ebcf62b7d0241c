//! How well motion fits a group.

use super::layers::{EncoderLayer, GlobalLayer};
use super::{GroupConfig, StepEmbedding};
use crate::model::graph::{Convolution, Graph, Result};
use crate::model::layers::Linear;
use crate::model::parameter::{Init, ParameterId, ParameterList, Role, Scope};

/// log f(x̂, w, t), f the ratio of the densities p(x | w) / p(x) up to a factor (paper, section 4.3).
///
/// Each layer attends within every dancer, whose frames have a token of step and group before them, and then over
/// all dancers, with the tokens of number and group. What is left is averaged over all frames and mapped to one
/// number.
#[derive(Clone, Debug)]
pub struct GroupScore {
    /// A convolution whose stride is its taps: frames become tokens.
    patches: (ParameterId, ParameterId, Convolution),
    time: StepEmbedding,
    group: Linear,
    numbers: ParameterId,
    layers: Vec<(EncoderLayer, GlobalLayer)>,
    out: Linear,
}

/// The inputs of a score: B groups of N dancers, T frames.
pub struct GroupScoreInputs<'a, T> {
    /// An estimate of clean motion, normalised, \[B N, T, motion_dim\].
    pub x0: &'a T,
    /// Step that each dancer was estimated from, \[B N\].
    pub t: &'a T,
    /// The group embedding, \[B, d\].
    pub w: &'a T,
    /// Row of the number of dancers, \[B\].
    pub number: &'a T,
    /// Dancers who are there, \[B, N ⌈T / patch⌉\], 1 or 0; all where absent.
    pub mask: Option<&'a T>,
}

impl GroupScore {
    /// Makes the network and the list of its parameters.
    pub fn new(config: &GroupConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let score = Self::within(&mut Scope::root(&mut list), config);
        (score, list)
    }

    /// Makes the network as a part of another.
    pub fn within(root: &mut Scope, config: &GroupConfig) -> Self {
        let (d, patch) = (config.width, config.score_patch_frames);
        let convolution = Convolution { taps: patch, stride: patch, padding: 0, dilation: 1 };
        let init = Init::fan_in(config.motion_dim * patch);
        let mut patches = root.at("patches");
        Self {
            patches: (
                patches.parameter("weight", &[d, config.motion_dim, patch], init, Role::Weight),
                patches.parameter("bias", &[d], init, Role::Vector),
                convolution,
            ),
            time: StepEmbedding::new(&mut root.at("time"), config, false),
            group: Linear::new(&mut root.at("group"), d, d),
            numbers: root.parameter(
                "numbers",
                &[config.max_dancers, d],
                Init::Normal { deviation: 1.0 },
                Role::Table,
            ),
            layers: (0..config.score_layers)
                .map(|i| {
                    let local =
                        EncoderLayer::new(&mut root.at(format!("layers.{i}.local")), config);
                    let global =
                        GlobalLayer::new(&mut root.at(format!("layers.{i}.global")), config);
                    (local, global)
                })
                .collect(),
            out: Linear::new(&mut root.at("out"), d, 1),
        }
    }

    /// Returns log f of each group, \[B, 1\].
    ///
    /// # Shapes
    /// See [`GroupScoreInputs`].
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        inputs: &GroupScoreInputs<G::Tensor>,
    ) -> Result<G::Tensor> {
        let (weight, bias, convolution) = self.patches;
        let x = g.hold_frames(inputs.x0, convolution.taps)?;
        let mut x = g.conv1d(&x, weight, Some(bias), convolution)?;
        let hidden = self.time.hidden(g, inputs.t)?;
        let t_emb = self.time.embedding.forward(g, &hidden)?;
        let group = self.group.forward(g, inputs.w)?;
        let of_each = g.repeat_batch(&group, inputs.x0)?;
        let token = g.add(&t_emb, &of_each)?;
        let e_n = g.embedding(self.numbers, inputs.number)?;
        let tokens = g.concat_frames(&[&group, &e_n])?;
        let mask = inputs.mask.map(|mask| g.token_mask(mask, 2)).transpose()?;
        for (local, global) in &self.layers {
            let with_token = g.concat_frames(&[&token, &x])?;
            let h = local.forward(g, &with_token)?;
            x = g.frames(&h, 1, None)?;
            let folded = g.rebatch(&x, inputs.number)?;
            let all = global.forward(g, &tokens, &folded, &x, mask.as_ref())?;
            let folded = g.frames(&all, 2, None)?;
            x = g.rebatch(&folded, inputs.x0)?;
        }
        let folded = g.rebatch(&x, inputs.number)?;
        let mean = g.mean_frames(&folded, inputs.mask)?;
        self.out.forward(g, &mean)
    }
}
