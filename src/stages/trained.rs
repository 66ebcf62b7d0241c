//! What training left of a run: its configuration and the weights that validated best.

mod tokens;

use crate::autodiff::Parameters;
use crate::model::{MotionDecoder, ParameterList, UNet1D};
use crate::store::Location;
use crate::training::{
    CheckpointKind, Checkpoints, DecoderLearner, DiffusionLearner, FinetuneLearner, Learner as _,
    State, TrainConfig, TrainingError,
};
pub use tokens::{TrainedPlanner, TrainedTokenizer};

/// Which weights of a run.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum WeightsChoice {
    /// Those of finetune where the run has them, else those of train.
    #[default]
    Latest,
    /// Those of train: the UNet and the decoder, each on its own.
    Train,
    /// Those of finetune.
    Finetune,
}

/// A run that was trained.
pub struct TrainedRun {
    /// The state of the UNet's training: configuration, scales, data.
    pub state: State<TrainConfig>,
    pub unet: BestWeights,
    pub decoder: BestWeights,
    /// `diffusion` or `finetune`.
    pub stage: &'static str,
    /// The validation loss of what the stage minimises.
    pub loss: Option<f64>,
    /// The data that fine-tuned weights learned from; none for those of train.
    pub tuned: Option<FinetuneData>,
}

/// The data that finetune learned from.
#[derive(Clone, Debug)]
pub struct FinetuneData {
    /// Fingerprint of its dataset.
    pub data: String,
    /// Most training phrases.
    pub num_phrases: Option<usize>,
}

/// Weights, and the step at which they validated best.
pub struct BestWeights {
    pub parameters: Parameters<f32>,
    pub step: u64,
}

impl TrainedRun {
    /// Reads a run.
    ///
    /// # Errors
    /// [`TrainingError::Missing`] with the command that makes what is missing.
    pub fn read(store: &Location, run: &str, stand: WeightsChoice) -> Result<Self, TrainingError> {
        let checkpoints_of = |stage: &'static str| Checkpoints::new(store, run, stage);
        let diffusion = checkpoints_of(DiffusionLearner::STAGE);
        let Some(&step) = diffusion.steps(CheckpointKind::Best)?.last() else {
            let way_out = format!("run motiongen train --run {run} first");
            return Err(TrainingError::Missing {
                run: run.to_owned(),
                what: "trained UNet",
                way_out,
            });
        };
        let state: State<TrainConfig> = diffusion.read(CheckpointKind::Best, step, State::of)?;
        let network = &state.config.network;
        let (_, unet) = UNet1D::new(&network.unet);
        let (_, decoder) = MotionDecoder::new(&network.decoder);
        let tuned = checkpoints_of(FinetuneLearner::STAGE);
        let tuned_steps = match stand {
            WeightsChoice::Train => Vec::new(),
            WeightsChoice::Latest | WeightsChoice::Finetune => tuned.steps(CheckpointKind::Best)?,
        };
        if let Some(&step) = tuned_steps.last() {
            let best = |prefix, list: ParameterList| -> Result<BestWeights, TrainingError> {
                Ok(BestWeights { parameters: section(&tuned, step, prefix, list)?, step })
            };
            // Only what is looked at has to be as this version has it.
            let tuned_state: State<serde_json::Value> =
                tuned.read(CheckpointKind::Best, step, State::of)?;
            let loss = tuned_state.progress.best.map(|best| best.loss);
            let num_phrases = tuned_state.config["num_phrases"].as_u64();
            let num_phrases = num_phrases.and_then(|n| usize::try_from(n).ok());
            let tuned_on = FinetuneData { data: tuned_state.data, num_phrases };
            let (unet, decoder) = (best("unet.", unet)?, best("decoder.", decoder)?);
            let stage = FinetuneLearner::STAGE;
            return Ok(Self { state, unet, decoder, stage, loss, tuned: Some(tuned_on) });
        }
        if stand == WeightsChoice::Finetune {
            let way_out = format!("run motiongen finetune --run {run} first");
            let (run, what) = (run.to_owned(), "fine-tuned networks");
            return Err(TrainingError::Missing { run, what, way_out });
        }
        let unet = best(&diffusion, run, "unet.", "trained UNet", unet)?;
        let (stage, what) = (checkpoints_of(DecoderLearner::STAGE), "trained decoder");
        let decoder = best(&stage, run, "decoder.", what, decoder)?;
        let loss = state.progress.best.map(|best| best.loss);
        Ok(Self { state, unet, decoder, stage: DiffusionLearner::STAGE, loss, tuned: None })
    }
}

/// Returns the weights of a stage that validated best.
///
/// # Errors
/// [`TrainingError::Missing`] when the stage has none yet.
pub fn best(
    checkpoints: &Checkpoints,
    run: &str,
    prefix: &str,
    what: &'static str,
    list: ParameterList,
) -> Result<BestWeights, TrainingError> {
    let Some(&step) = checkpoints.steps(CheckpointKind::Best)?.last() else {
        let way_out = format!("run motiongen train --run {run} to the end first");
        return Err(TrainingError::Missing { run: run.to_owned(), what, way_out });
    };
    Ok(BestWeights { parameters: section(checkpoints, step, prefix, list)?, step })
}

fn section(
    checkpoints: &Checkpoints,
    step: u64,
    prefix: &str,
    list: ParameterList,
) -> Result<Parameters<f32>, TrainingError> {
    checkpoints.read(CheckpointKind::Best, step, |archive, place| {
        let place = place.to_owned();
        archive.section(prefix, list).map_err(|source| TrainingError::Weights { place, source })
    })
}
