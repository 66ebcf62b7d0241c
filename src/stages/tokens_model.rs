//! A model of the family `tokens`, opened to be run.

use std::num::NonZeroUsize;

use anyhow::Context as _;

use super::model_folder::ModelFolder;
use crate::autodiff::Parameters;
use crate::generation::{
    FamilyCard as _, PlannerEngine, TokenEngine, TokensCard, tokens_parameters,
};
use crate::model::{ParameterList, Planner, Tokenizer};
use crate::onnx::Model;

/// The card of a model of tokens, with the weights of its networks.
pub struct OpenTokensModel {
    pub card: TokensCard,
    tokenizer: Parameters<f32>,
    planner: Parameters<f32>,
}

impl OpenTokensModel {
    /// Reads the weights of a model that was exported.
    ///
    /// # Errors
    /// A card of another family, or a file that is not what the card says.
    pub fn read(files: &ModelFolder) -> anyhow::Result<Self> {
        let card = TokensCard::read(files.card_bytes(), files.card_place())?;
        let (tokenizer, planner) = tokens_parameters(&card, |name| -> anyhow::Result<_> {
            let place = files.place_of(name);
            Ok((Model::read(files.read(name)?, None, &place)?, place))
        })?;
        Ok(Self { card, tokenizer, planner })
    }

    /// Makes networks of a model's sizes with the weights that training begins with.
    ///
    /// Layers that begin at zero are drawn as others are: with zeros the denoiser says the same whatever the tokens.
    pub fn untrained(card: TokensCard) -> Self {
        let first = |list: ParameterList| Parameters::new(list.without_zero_layers(), 0);
        let tokenizer = first(Tokenizer::new(&card.tokens).1);
        let planner = first(Planner::new(&card.planner).1);
        Self { card, tokenizer, planner }
    }

    /// Starts the engines of both networks, of so many workers of so many threads each.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn engines(
        self,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> anyhow::Result<(TokensCard, TokenEngine, PlannerEngine)> {
        let Self { card, tokenizer, planner } = self;
        let start = || {
            let tokens = TokenEngine::new(
                &card.tokens,
                tokenizer,
                &card.normalizer,
                card.window_frames,
                workers,
            )?;
            let planner = PlannerEngine::new(&card.planner, planner, &card.feature_scale, workers)?;
            Ok::<_, std::io::Error>((tokens, planner))
        };
        let (tokens, planner) = start().context("while starting threads")?;
        Ok((card, tokens, planner))
    }
}
