//! How well motion fits a group.

use super::layers::{EncoderLayer, GlobalLayer};
use super::{GroupConfig, StepEmbedding};
use crate::model::graph::{Convolution, Graph, Result};
use crate::model::layers::Linear;
use crate::model::parameter::{Init, ParameterId, ParameterList, Role, Scope};

/// κ: with N dancers log f spans (1 − 1/N) κ, enough to tell a group from eight mixed ones.
const AGREEMENT_WEIGHT: f64 = 10.0;
/// Least length of a vector that is normalised.
const EPSILON: f64 = 1e-8;

/// log f(x̂, w, t), f the ratio of the densities p(x | w) / p(x) up to a factor (paper, section 4.3).
///
/// Each layer attends within every dancer, whose frames have a token of step and group before them, and then over
/// all dancers, with the tokens of number and group. What is left is averaged over all frames and mapped to one
/// number, the fit; log f is the fit and κ times the agreement of the dancers, ⟨‖⟨u_i⟩_i‖²⟩ over the frames, where
/// u_i = v_i / ‖v_i‖ and v_i is linear in what the last layer made of dancer i alone: 1 where all do the same, and
/// about 1/N where everybody does something else.
///
/// Deviation: the reference has no agreement. Attention alone has to find the frames of one time and to compare them
/// before it can tell unison; what it learns first is how groups stand, and the gradient of that moves all dancers alike
/// (docs/groups.md).
#[derive(Clone, Debug)]
pub struct GroupScore {
    /// A convolution whose stride is its taps: frames become tokens.
    patches: (ParameterId, ParameterId, Convolution),
    time: StepEmbedding,
    group: Linear,
    numbers: ParameterId,
    layers: Vec<(EncoderLayer, GlobalLayer)>,
    out: Linear,
    /// To v.
    agreement: Linear,
    width: usize,
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
    /// 1 for dancers of the group, 0 for empty places, \[B, N ⌈T / patch⌉\]; all are dancers where absent.
    pub mask: Option<&'a T>,
    /// The same for each dancer, \[B, N\].
    pub there: Option<&'a T>,
}

/// What the first layer made of dancers alone.
#[derive(Clone, Debug)]
pub struct ScoredDancers<T> {
    /// Token of step and group, \[rows, d\].
    pub token: T,
    /// \[rows, ⌈T / patch⌉, d\]
    pub frames: T,
}

/// The groups of dancers that are scored together.
pub struct ScoredGroups<'a, T> {
    /// Token of each group, \[B, d\]: [`GroupScore::token`].
    pub within: &'a T,
    /// As in [`GroupScoreInputs`].
    pub number: &'a T,
    pub mask: Option<&'a T>,
    pub there: Option<&'a T>,
}

/// The scores of B groups.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupScores<T> {
    /// log f, \[B, 1\].
    pub log_ratio: T,
    /// The part of it that is the agreement of the dancers, from 0 to κ, \[B, 1\].
    pub agreement: T,
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
            agreement: Linear::new(&mut root.at("agreement"), d, d),
            width: d,
        }
    }

    /// Returns log f of each group, and the part of it that is the dancers' agreement.
    ///
    /// # Shapes
    /// See [`GroupScoreInputs`].
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        inputs: &GroupScoreInputs<G::Tensor>,
    ) -> Result<GroupScores<G::Tensor>> {
        let GroupScoreInputs { x0, t, w, number, mask, there } = *inputs;
        let within = self.token(g, w)?;
        let of_each = g.repeat_batch(&within, x0)?;
        let dancers = self.dancers(g, x0, t, &of_each)?;
        self.together(g, &dancers, &ScoredGroups { within: &within, number, mask, there })
    }

    /// Returns the token of each group. \[B, d\] → \[B, d\]
    pub fn token<G: Graph>(&self, g: &mut G, w: &G::Tensor) -> Result<G::Tensor> {
        self.group.forward(g, w)
    }

    /// Returns what the first layer makes of every dancer alone, which depends on none of the others.
    ///
    /// # Shapes
    /// `x0`: \[rows, T, motion_dim\]; `t`: \[rows\]; `within`: the token of each one's group, \[rows, d\]
    pub fn dancers<G: Graph>(
        &self,
        g: &mut G,
        x0: &G::Tensor,
        t: &G::Tensor,
        within: &G::Tensor,
    ) -> Result<ScoredDancers<G::Tensor>> {
        let (weight, bias, convolution) = self.patches;
        let x = g.hold_frames(x0, convolution.taps)?;
        let x = g.conv1d(&x, weight, Some(bias), convolution)?;
        let hidden = self.time.hidden(g, t)?;
        let t_emb = self.time.embedding.forward(g, &hidden)?;
        let token = g.add(&t_emb, within)?;
        let frames = self.layers[0].0.behind_token(g, &token, &x)?;
        Ok(ScoredDancers { token, frames })
    }

    /// Returns log f of each group of dancers.
    ///
    /// # Shapes
    /// See [`ScoredDancers`], those of each group one after the other, and [`ScoredGroups`].
    pub fn together<G: Graph>(
        &self,
        g: &mut G,
        dancers: &ScoredDancers<G::Tensor>,
        groups: &ScoredGroups<G::Tensor>,
    ) -> Result<GroupScores<G::Tensor>> {
        let ScoredGroups { within, number, mask, there } = *groups;
        let e_n = g.embedding(self.numbers, number)?;
        let tokens = g.concat_frames(&[within, &e_n])?;
        let with_tokens = mask.map(|mask| g.token_mask(mask, 2)).transpose()?;
        let mut alone = dancers.frames.clone();
        let mut folded = g.rebatch(&alone, number)?;
        for (i, (local, global)) in self.layers.iter().enumerate() {
            if i > 0 {
                let x = g.rebatch(&folded, &alone)?;
                alone = local.behind_token(g, &dancers.token, &x)?;
                folded = g.rebatch(&alone, number)?;
            }
            let all = global.forward(g, &tokens, &folded, &alone, with_tokens.as_ref())?;
            folded = g.frames(&all, 2, None)?;
        }
        let mean = g.mean_frames(&folded, mask)?;
        let fit = self.out.forward(g, &mean)?;
        let agreement = self.agreement(g, &alone, number, there)?;
        Ok(GroupScores { log_ratio: g.add(&fit, &agreement)?, agreement })
    }

    /// Returns κ times how much the dancers of each group agree at the same frames. \[B N, P, d\] → \[B, 1\]
    fn agreement<G: Graph>(
        &self,
        g: &mut G,
        alone: &G::Tensor,
        number: &G::Tensor,
        there: Option<&G::Tensor>,
    ) -> Result<G::Tensor> {
        let v = self.agreement.forward(g, alone)?;
        let u = g.normalize(&v, EPSILON)?;
        let mean = g.mean_dancers(&u, number, there)?;
        let squares = g.mul(&mean, &mean)?;
        let squares = g.mean_frames(&squares, None)?;
        let length = g.mean_channels(&squares)?;
        g.scale(&length, AGREEMENT_WEIGHT * self.width as f64)
    }
}
