//! A model of the family `tokens`, opened to be run.

use std::num::NonZeroUsize;

use anyhow::Context as _;

use super::model_files::{EngineChoice, EngineParams};
use super::model_folder::ModelFolder;
use crate::autodiff::Parameters;
use crate::generation::{
    FamilyCard as _, ModelFileName, OnnxPlanner, OnnxTokenizer, PlannerEngine, SessionPlan,
    TokenEngine, TokensCard, tokens_parameters,
};
use crate::model::{ParameterList, Planner, Tokenizer};
use crate::onnx::{Device, Model, Runtime, check};

/// A model of tokens whose files are at hand on this machine.
pub struct OpenTokens {
    pub card: TokensCard,
    files: ModelFolder,
}

/// The engines of a model of tokens.
pub struct TokenEngines {
    pub tokens: TokenEngine,
    pub planner: PlannerEngine,
    /// What is to be told of the choice.
    pub note: Option<String>,
}

impl OpenTokens {
    /// Reads the card of a model.
    ///
    /// # Errors
    /// A card of another family, or none.
    pub fn of(files: ModelFolder) -> anyhow::Result<Self> {
        let card = TokensCard::read(files.card_bytes(), files.card_place())?;
        Ok(Self { card, files })
    }

    /// Holds every file against the card.
    ///
    /// # Errors
    /// The first that is not the one that the card lists.
    pub fn verify(&self) -> anyhow::Result<()> {
        self.files.verify()
    }

    /// Makes engines of the interpreter that trained the networks, or of onnxruntime where that is asked for.
    ///
    /// A token is drawn from what a planner says, so that the last bit of a sum may decide between two: unless
    /// onnxruntime is named, motion does not depend on whether its library is found.
    ///
    /// # Errors
    /// When the engine that was asked for cannot be had, or a file is not the one that the card lists.
    pub fn engines(
        &self,
        params: &EngineParams,
        n_workers: NonZeroUsize,
    ) -> anyhow::Result<TokenEngines> {
        let n_workers = n_workers.min(params.threads);
        let n_threads =
            NonZeroUsize::new(params.threads.get() / n_workers.get()).unwrap_or(NonZeroUsize::MIN);
        match params.engine {
            EngineChoice::Auto | EngineChoice::Eager => self.eager((n_workers, n_threads)),
            EngineChoice::Onnx => {
                let runtime = Runtime::load(params.ort_lib.as_deref())?;
                let (device, note) = Device::from_environment()?.chosen(&runtime);
                let plan =
                    SessionPlan { n_workers: n_workers.get(), n_threads: n_threads.get(), device };
                Ok(TokenEngines { note, ..self.onnx(&runtime, params, plan)? })
            }
        }
    }

    fn eager(&self, workers: (NonZeroUsize, NonZeroUsize)) -> anyhow::Result<TokenEngines> {
        TokensWeights::read(&self.files, &self.card)?.engines(&self.card, workers)
    }

    fn onnx(
        &self,
        runtime: &Runtime,
        params: &EngineParams,
        plan: SessionPlan,
    ) -> anyhow::Result<TokenEngines> {
        let Self { card, files } = self;
        let of_tokenizer = [ModelFileName::Encoder, ModelFileName::Signal, ModelFileName::Denoiser];
        for &name in of_tokenizer.iter().chain(OnnxPlanner::files(&card.planner)) {
            // onnxruntime runs whatever a file says.
            let place = files.place_of(name);
            check(&Model::read(files.read(name)?, None, &place)?, &place)?;
        }
        let folder = files.folder(&params.cache())?;
        let tokenizer = OnnxTokenizer::open(runtime, &folder, &card.tokens, plan)?;
        let planner = OnnxPlanner::open(runtime, &folder, &card.planner, plan)?;
        let (normalizer, window) = (&card.normalizer, card.window_frames);
        Ok(TokenEngines {
            tokens: TokenEngine::with(&card.tokens, Box::new(tokenizer), normalizer, window),
            planner: PlannerEngine::with(&card.planner, Box::new(planner)),
            note: None,
        })
    }
}

/// The weights of the networks of a model of tokens.
pub struct TokensWeights {
    tokenizer: Parameters<f32>,
    planner: Parameters<f32>,
}

impl TokensWeights {
    /// Reads the weights of a model that was exported.
    ///
    /// # Errors
    /// A file that is not the one that the card lists.
    pub fn read(files: &ModelFolder, card: &TokensCard) -> anyhow::Result<Self> {
        let (tokenizer, planner) = tokens_parameters(card, |name| -> anyhow::Result<_> {
            let place = files.place_of(name);
            Ok((Model::read(files.read(name)?, None, &place)?, place))
        })?;
        Ok(Self { tokenizer, planner })
    }

    /// Makes networks of a model's sizes with the weights that training begins with.
    ///
    /// Layers that begin at zero are drawn as others are: with zeros the denoiser says the same whatever the tokens.
    pub fn untrained(card: &TokensCard) -> Self {
        let first = |list: ParameterList| Parameters::new(list.without_zero_layers(), 0);
        let tokenizer = first(Tokenizer::new(&card.tokens).1);
        let planner = first(Planner::new(&card.planner).1);
        Self { tokenizer, planner }
    }

    /// Starts the engines of both networks by the interpreter that trains, of so many workers of so many threads each.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn engines(
        self,
        card: &TokensCard,
        workers: (NonZeroUsize, NonZeroUsize),
    ) -> anyhow::Result<TokenEngines> {
        let Self { tokenizer, planner } = self;
        let (window, starting) = (card.window_frames, "while starting threads");
        let tokens = TokenEngine::new(&card.tokens, tokenizer, &card.normalizer, window, workers)
            .context(starting)?;
        let planner = PlannerEngine::new(&card.planner, planner, &card.feature_scale, workers)
            .context(starting)?;
        Ok(TokenEngines { tokens, planner, note: None })
    }
}
