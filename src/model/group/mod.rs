//! The networks that make the motion of a group: a denoiser, and a score of how well motion fits its group.
//!
//! Controllable Group Choreography using Contrastive Diffusion (GCD), Le et al., ACM Transactions on Graphics 42(6),
//! 2023, arXiv 2310.18986, sections 4.1 to 4.3. Where paper and published code differ, the paper holds: the music
//! and the score are averaged over their frames, and the embedding of the number of dancers is added to w. The
//! token of that number is carried through the layers as in the code.
//!
//! N dancers are a fold of the batch: motion is \[B N, T, 25\], sample by sample and dancer by dancer.

mod block;
mod config;
mod embedding;
mod layers;
mod score;

use std::sync::Arc;

use ndarray::Array2;

use self::block::GroupBlock;
pub use self::config::GroupConfig;
use self::embedding::GroupEmbedding;
use self::layers::{EncoderLayer, Memory};
pub use self::score::{GroupScore, GroupScoreInputs, GroupScores, ScoredDancers, ScoredGroups};
use super::graph::{Activation, Graph, Result};
use super::layers::{LayerNorm, Linear};
use super::parameter::{Init, ParameterId, ParameterList, Role, Scope};
use super::unet::time_table;

/// Predicts clean motion of a group; see the module.
#[derive(Clone, Debug)]
pub struct GroupDenoiser {
    time: StepEmbedding,
    music_in: Linear,
    music: Vec<EncoderLayer>,
    null_music: ParameterId,
    memory_norm: LayerNorm,
    /// Mean music as a part of the context of every branch.
    context: (LayerNorm, [Linear; 2]),
    embedding: GroupEmbedding,
    motion_in: Linear,
    /// The music at the frames that hear it.
    audio_in: Option<Linear>,
    number_token: (LayerNorm, [Linear; 2]),
    blocks: Vec<GroupBlock>,
    out: Linear,
}

/// Names of the two networks where their parameters are in one list.
const DENOISER: &str = "denoiser";
const SCORE: &str = "score";

/// Both networks of a group, with one list of parameters.
#[derive(Clone, Debug)]
pub struct GroupNetworks {
    pub denoiser: GroupDenoiser,
    pub score: GroupScore,
}

impl GroupNetworks {
    /// Makes both networks and the list of their parameters.
    pub fn new(config: &GroupConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let mut root = Scope::root(&mut list);
        let denoiser = GroupDenoiser::within(&mut root.at(DENOISER), config);
        let score = GroupScore::within(&mut root.at(SCORE), config);
        (Self { denoiser, score }, list)
    }

    /// Splits the name of a parameter of the list: whether it is the denoiser's, and its name there.
    pub fn own_name(name: &str) -> (bool, &str) {
        match name.split_once('.') {
            Some((DENOISER, rest)) => (true, rest),
            Some((_, rest)) => (false, rest),
            None => (false, name),
        }
    }
}

/// The inputs of a denoiser: B groups of N dancers, T frames.
pub struct GroupInputs<'a, T> {
    /// Noisy motion, normalised, \[B N, T, motion_dim\].
    pub x: &'a T,
    /// Step of each group, \[B\], whole numbers in 0..n_steps.
    pub t: &'a T,
    /// Features of the music and its clock, \[B, T, condition_dim\].
    pub audio: &'a T,
    /// Groups that go without music, \[B\], 1 where the learned null takes its place.
    pub drop_audio: Option<&'a T>,
    /// Row of the number of dancers, \[B\]: [`GroupConfig::embedded_number`].
    pub number: &'a T,
    /// Noise of the group embedding, standard normal, \[B, d\].
    pub z: &'a T,
    /// 1 for dancers of the group, 0 for empty places, \[B, N T\]; all are dancers where absent.
    pub mask: Option<&'a T>,
}

/// The outputs of a denoiser.
pub struct GroupPrediction<T> {
    /// Clean motion, normalised, \[B N, T, motion_dim\].
    pub x0: T,
    /// The group embedding w, \[B, d\].
    pub w: T,
}

/// Sinusoids of the step → 4 d → mish → the width that is given.
#[derive(Clone, Debug)]
struct StepEmbedding {
    table: Arc<Array2<f64>>,
    hidden: Linear,
    embedding: Linear,
    tokens: Option<[Linear; 2]>,
}

impl StepEmbedding {
    fn new(scope: &mut Scope, config: &GroupConfig, has_tokens: bool) -> Self {
        let d = config.width;
        let mut linear =
            |name: &str, inputs, outputs| Linear::new(&mut scope.at(name), inputs, outputs);
        Self {
            table: Arc::new(time_table(config.n_steps, d)),
            hidden: linear("hidden", d, 4 * d),
            embedding: linear("embedding", 4 * d, d),
            tokens: has_tokens
                .then(|| [linear("tokens.0", 4 * d, d), linear("tokens.1", 4 * d, d)]),
        }
    }

    /// \[samples\] → \[samples, 4 d\]
    fn hidden<G: Graph>(&self, g: &mut G, t: &G::Tensor) -> Result<G::Tensor> {
        let h = g.gather(&self.table, t)?;
        let h = self.hidden.forward(g, &h)?;
        g.activation(&h, Activation::Mish)
    }
}

/// LN → linear → SiLU → linear.
fn projected<G: Graph>(
    (norm, [first, last]): &(LayerNorm, [Linear; 2]),
    g: &mut G,
    x: &G::Tensor,
) -> Result<G::Tensor> {
    let h = norm.forward(g, x)?;
    let h = first.forward(g, &h)?;
    let h = g.activation(&h, Activation::Silu)?;
    last.forward(g, &h)
}

fn projection(scope: &mut Scope, d: usize) -> (LayerNorm, [Linear; 2]) {
    let norm = LayerNorm::new(&mut scope.at("norm"), d);
    (norm, [Linear::new(&mut scope.at("0"), d, d), Linear::new(&mut scope.at("1"), d, d)])
}

impl GroupDenoiser {
    /// Makes the network and the list of its parameters.
    pub fn new(config: &GroupConfig) -> (Self, ParameterList) {
        let mut list = ParameterList::default();
        let denoiser = Self::within(&mut Scope::root(&mut list), config);
        (denoiser, list)
    }

    /// Makes the network as a part of another.
    pub fn within(root: &mut Scope, config: &GroupConfig) -> Self {
        let d = config.width;
        let condition_dim = config.condition().dim();
        Self {
            time: StepEmbedding::new(&mut root.at("time"), config, true),
            music_in: Linear::new(&mut root.at("music_in"), condition_dim, d),
            music: (0..config.music_layers)
                .map(|i| EncoderLayer::new(&mut root.at(format!("music.{i}")), config))
                .collect(),
            null_music: root.parameter("null_music", &[d], Init::Zeros, Role::Vector),
            memory_norm: LayerNorm::new(&mut root.at("memory_norm"), d),
            context: projection(&mut root.at("context"), d),
            embedding: GroupEmbedding::new(&mut root.at("embedding"), config),
            motion_in: Linear::new(&mut root.at("motion_in"), config.motion_dim, d),
            audio_in: config.add_audio.then(|| Linear::new(&mut root.at("audio_in"), d, d)),
            number_token: projection(&mut root.at("number_token"), d),
            blocks: (0..config.blocks)
                .map(|i| GroupBlock::new(&mut root.at(format!("blocks.{i}")), config))
                .collect(),
            out: Linear::new(&mut root.at("out"), d, config.motion_dim),
        }
    }

    /// Predicts clean motion, and the embedding of the group that it is of.
    ///
    /// w hears the music even where it is withheld from the dancers, so that guidance changes how they follow the
    /// music and not which group they are. The reference does not say.
    ///
    /// # Shapes
    /// See [`GroupInputs`] and [`GroupPrediction`].
    pub fn forward<G: Graph>(
        &self,
        g: &mut G,
        inputs: &GroupInputs<G::Tensor>,
    ) -> Result<GroupPrediction<G::Tensor>> {
        let x = inputs.x;
        let mut music = self.music_in.forward(g, inputs.audio)?;
        for layer in &self.music {
            music = layer.forward(g, &music)?;
        }
        let mean = g.mean_frames(&music, None)?;
        let e_n = self.embedding.number(g, inputs.number)?;
        let w = self.embedding.forward(g, inputs.z, &mean, &e_n)?;
        let mut heard = mean;
        if let Some(drop_audio) = inputs.drop_audio {
            let null = g.parameter(self.null_music)?;
            music = g.select(drop_audio, &null, &music)?;
            heard = g.mean_frames(&music, None)?;
        }

        let hidden = self.time.hidden(g, inputs.t)?;
        let t_emb = self.time.embedding.forward(g, &hidden)?;
        let context = projected(&self.context, g, &heard)?;
        let context = g.add(&t_emb, &context)?;
        let context = g.activation(&context, Activation::Mish)?;
        let [a, b] =
            self.time.tokens.as_ref().expect("invariant: a denoiser has tokens of the step");
        let (a, b) = (a.forward(g, &hidden)?, b.forward(g, &hidden)?);
        let step = g.concat_frames(&[&a, &b])?;
        let memory = Memory {
            music: self.memory_norm.forward(g, &music)?,
            step: self.memory_norm.forward(g, &step)?,
        };

        let mut h = self.motion_in.forward(g, x)?;
        if let Some(audio_in) = &self.audio_in {
            let audio = audio_in.forward(g, &music)?;
            let audio = g.repeat_batch(&audio, x)?;
            h = g.add(&h, &audio)?;
        }
        h = g.rebatch(&h, inputs.t)?;
        let mut token = projected(&self.number_token, g, &e_n)?;
        let mask = inputs.mask.map(|mask| g.token_mask(mask, 2)).transpose()?;
        let masks = inputs.mask.zip(mask.as_ref());
        for block in &self.blocks {
            (h, token) = block.forward(g, &h, &token, &w, (x, &context, &memory), masks)?;
        }
        let y = self.out.forward(g, &h)?;
        let x0 = g.rebatch(&y, x)?;
        Ok(GroupPrediction { x0, w })
    }
}

#[cfg(test)]
mod tests;
