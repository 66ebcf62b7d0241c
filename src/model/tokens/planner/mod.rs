//! A planner of tokens: what is danced to a piece of music, as a distribution over the codes of a tokenizer.
//!
//! Gu et al., arXiv 2603.19227, 2026, section 3.2. A transformer sees a row of positions, one global and one for each
//! token; music comes to each position through convolutions like those of the tokenizer's encoder. Of the masked kind
//! every position sees all others, and says what stands behind \[MASK\] (Guo et al., "MoMask", CVPR 2024); of the
//! autoregressive kind it sees those before it, and says which token comes next (Zhang et al., "T2M-GPT", CVPR 2023).
//!
//! Constraints on the motion come to the same positions through an encoder of its own, and is added to the music.
//!
//! The paper adds a learned vector to each position. Here queries and keys are turned by it (RoFormer), so that no
//! number of positions is the last.

mod config;
mod constraint;
mod layer;
mod step;

pub use self::config::{PlannerConfig, PlannerKind};
pub use self::constraint::{CONSTRAINT_DIM, PoseConstraint};
pub use self::layer::KeysAndValues;
use self::layer::PlannerLayer;
pub use self::step::{PlanConditions, PlannerStep, PlannerStepInputs};
use super::coder::Encoder;
use crate::model::graph::{Graph, Result};
use crate::model::layers::{LayerNorm, Linear};
use crate::model::parameter::{Init, ParameterId, ParameterList, Role, Scope};

/// Spread of the first values of the table of tokens (GPT-2, MoMask).
const TABLE_DEVIATION: f64 = 0.02;

/// The network; see the module.
#[derive(Clone, Debug)]
pub struct Planner {
    kind: PlannerKind,
    table: ParameterId,
    music: Encoder,
    null_music: ParameterId,
    global: Linear,
    style: Option<Linear>,
    constraints: Option<ConstraintEncoder>,
    layers: Vec<PlannerLayer>,
    norm: LayerNorm,
    out: Linear,
}

/// E_c: constraints of frames to the positions of tokens, and the learned vector of positions without constraints.
#[derive(Clone, Debug)]
struct ConstraintEncoder {
    encoder: Encoder,
    null: ParameterId,
}

/// The inputs of a planner: B windows of N tokens, T frames.
pub struct PlannerInputs<'a, T> {
    /// Tokens, whole numbers in 0..K, \[B, N\]; of the masked kind K is \[MASK\]. The autoregressive kind sees of each
    /// position only those before it.
    pub tokens: &'a T,
    /// Features of the music and its clock, \[B, T, condition_dim\], N = ⌈T / ρ⌉.
    pub audio: &'a T,
    /// Windows that go without music, \[B\], 1 where the learned null takes its place.
    pub drop_audio: Option<&'a T>,
    /// Style of each window, \[B, style_dim\], of a network that takes one.
    pub style: Option<&'a T>,
    /// Constraints on the motion, \[B, T, 12\] ([`PoseConstraint::channels`]), of a network that takes it; nothing where
    /// absent.
    pub constraints: Option<&'a T>,
    /// Windows that go without constraints, \[B\], 1 where the learned null takes their place.
    pub drop_constraints: Option<&'a T>,
    /// Tokens that count, \[B, N\], 1 or 0; all where absent.
    pub mask: Option<&'a T>,
}

/// The conditions of B windows, beside their tokens; see [`PlannerInputs`].
pub struct ConditionInputs<'a, T> {
    pub audio: &'a T,
    pub drop_audio: Option<&'a T>,
    pub style: Option<&'a T>,
    pub constraints: Option<&'a T>,
    pub drop_constraints: Option<&'a T>,
    pub mask: Option<&'a T>,
}

impl Planner {
    /// Makes the network and the list of its parameters.
    pub fn new(config: &PlannerConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let mut root = Scope::root(&mut list);
        let d = config.width;
        let planner = Self {
            kind: config.kind,
            table: root.parameter(
                "table",
                &[config.n_rows(), d],
                Init::Normal { deviation: TABLE_DEVIATION },
                Role::Table,
            ),
            music: Encoder::within(&mut root.at("music"), &config.music()),
            null_music: root.parameter("null_music", &[d], Init::Zeros, Role::Vector),
            global: Linear::new(&mut root.at("global"), d, d),
            style: (config.style_dim > 0)
                .then(|| Linear::new(&mut root.at("style"), config.style_dim, d)),
            constraints: config.constraints().map(|sizes| ConstraintEncoder {
                encoder: Encoder::within(&mut root.at("constraints"), &sizes),
                null: root.parameter("null_constraints", &[d], Init::Zeros, Role::Vector),
            }),
            layers: (0..config.layers)
                .map(|i| PlannerLayer::new(&mut root.at(format!("layers.{i}")), config))
                .collect(),
            norm: LayerNorm::new(&mut root.at("norm"), d),
            out: Linear::new(&mut root.at("out"), d, config.codes),
        };
        (planner, list)
    }

    /// ln p(z_n | what position n sees) up to a constant, for each token of each position.
    ///
    /// m = E(music), g = W ⟨m⟩ + b + W_s style, l = m + E_c(constraints), e the table of tokens. Of the masked kind the
    /// positions are \[g; e_1 + l_1; …; e_N + l_N\], of the other \[g + l_1; e_1 + l_2; …; e_{N−1} + l_N\] (paper,
    /// section 3.3).
    ///
    /// # Shapes
    /// See [`PlannerInputs`]; returns \[B, N, K\].
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        inputs: &PlannerInputs<G::Tensor>,
    ) -> Result<G::Tensor> {
        let PlannerInputs { tokens, audio, drop_audio, style, constraints, drop_constraints, mask } =
            *inputs;
        let heard =
            ConditionInputs { audio, drop_audio, style, constraints, drop_constraints, mask };
        let conditions = self.conditions(g, &heard)?;
        self.forward_under(g, tokens, &conditions, mask)
    }

    /// [`Planner::forward`] of windows whose conditions are known, [`Planner::conditions`].
    pub fn forward_under<G: Graph>(
        &self,
        g: &mut G,
        tokens: &G::Tensor,
        conditions: &PlanConditions<G::Tensor>,
        mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let PlanConditions { local, global } = conditions;
        let tokens = g.embedding(self.table, tokens)?;
        let h = match self.kind {
            PlannerKind::Masked => {
                let tokens = g.add(&tokens, local)?;
                let h = g.concat_frames(&[global, &tokens])?;
                let mask = mask.map(|mask| g.token_mask(mask, 1)).transpose()?;
                let h = self.transformed(g, h, mask.as_ref())?;
                g.frames(&h, 1, None)?
            }
            PlannerKind::Autoregressive => {
                let before = g.concat_frames(&[global, &tokens])?;
                let before = g.crop_frames(&before, local)?;
                let h = g.add(&before, local)?;
                self.transformed(g, h, mask)?
            }
        };
        let h = self.norm.forward(g, &h)?;
        self.out.forward(g, &h)
    }

    /// Returns the conditions of the positions of windows, l and g of [`Planner::forward`].
    ///
    /// # Shapes
    /// See [`PlannerInputs`].
    pub fn conditions<G: Graph>(
        &self,
        g: &mut G,
        inputs: &ConditionInputs<G::Tensor>,
    ) -> Result<PlanConditions<G::Tensor>> {
        let mut music = self.music.forward(g, inputs.audio)?;
        if let Some(drop_audio) = inputs.drop_audio {
            let null = g.parameter(self.null_music)?;
            music = g.select(drop_audio, &null, &music)?;
        }
        let mean = g.mean_frames(&music, inputs.mask)?;
        let mut global = self.global.forward(g, &mean)?;
        if let (Some(layer), Some(style)) = (&self.style, inputs.style) {
            let style = layer.forward(g, style)?;
            global = g.add(&global, &style)?;
        }
        let local = self.with_constraints(g, music, inputs)?;
        Ok(PlanConditions { local, global })
    }

    /// m + E_c(constraints), of a network that takes them. → \[B, N, d\]
    fn with_constraints<G: Graph>(
        &self,
        g: &mut G,
        music: G::Tensor,
        inputs: &ConditionInputs<G::Tensor>,
    ) -> Result<G::Tensor> {
        let Some(ConstraintEncoder { encoder, null }) = &self.constraints else { return Ok(music) };
        let null = g.parameter(*null)?;
        let Some(constraints) = inputs.constraints else { return g.add(&music, &null) };
        let mut asked = encoder.forward(g, constraints)?;
        if let Some(drop) = inputs.drop_constraints {
            asked = g.select(drop, &null, &asked)?;
        }
        g.add(&music, &asked)
    }

    fn transformed<G: Graph>(
        &self,
        g: &mut G,
        mut h: G::Tensor,
        mask: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        for layer in &self.layers {
            h = layer.forward(g, &h, mask)?;
        }
        Ok(h)
    }
}

#[cfg(test)]
mod tests;
