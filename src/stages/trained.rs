//! What training left of a run: its configuration and the weights that validated best.

mod tokens;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::train::survey::first_stage;
use crate::autodiff::Parameters;
use crate::model::{MotionDecoder, ParameterList, UNet1D};
use crate::store::Location;
use crate::training::{
    CheckpointKind, Checkpoints, DecoderLearner, DiffusionLearner, FinetuneLearner, GroupLearner,
    Learner as _, PlannerLearner, State, TokensLearner, TrainConfig, TrainingError,
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
            return Err(without_unet(store, run)?);
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

/// Returns what a run lacks that has no trained UNet, in terms of the family that it is of.
fn without_unet(store: &Location, run: &str) -> Result<TrainingError, TrainingError> {
    let family = first_stage(store, run)?.and_then(|stage| match stage {
        GroupLearner::STAGE => Some((stage, "trained denoiser of groups", "--family group")),
        TokensLearner::STAGE => Some((stage, "trained tokenizer", "--family tokens")),
        PlannerLearner::STAGE => {
            Some((stage, "trained planner", "--family tokens --tokenizer RUN"))
        }
        _ => None,
    });
    let run = run.to_owned();
    let Some((stage, trained, flags)) = family else {
        let way_out = format!("run motiongen train --run {run} first");
        return Ok(TrainingError::Missing { run, what: "trained UNet", way_out });
    };
    let is_trained = has_best(store, &run, stage)?;
    let (what, way_out) = match is_trained {
        true => ("trained UNet", format!("it has a {trained}; name a run of the family unet")),
        false => (
            trained,
            format!(
                "its training ended before anything was validated, so go on with motiongen train {flags} --run {run}"
            ),
        ),
    };
    Ok(TrainingError::Missing { run, what, way_out })
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

/// Returns whether a stage of a run validated anything.
///
/// # Errors
/// When the store cannot be listed.
pub fn has_best(store: &Location, run: &str, stage: &str) -> Result<bool, TrainingError> {
    Ok(!Checkpoints::new(store, run, stage).steps(CheckpointKind::Best)?.is_empty())
}

/// Returns the state of a stage at the step at which it validated best, and its weights; `list` names them by the
/// configuration.
///
/// # Errors
/// A checkpoint that is damaged or of another configuration, and errors of `list`.
pub fn read_best<C: Serialize + DeserializeOwned>(
    checkpoints: &Checkpoints,
    step: u64,
    prefix: &str,
    list: impl FnOnce(&C) -> Result<ParameterList, TrainingError>,
) -> Result<(State<C>, Parameters<f32>), TrainingError> {
    checkpoints.read(CheckpointKind::Best, step, |archive, place| {
        let state: State<C> = State::of(archive, place)?;
        let list = list(&state.config)?;
        let place = place.to_owned();
        let parameters = archive
            .section(prefix, list)
            .map_err(|source| TrainingError::Weights { place, source })?;
        Ok((state, parameters))
    })
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_that_was_not_validated_lacks_what_its_family_has() {
        let folder = tempfile::tempdir().expect("a folder");
        let store = Location::local(folder.path()).expect("a store");
        let begun = |run: &str, config: &str| {
            let path = format!("runs/{run}/train.json");
            store.put_new(&path, config.to_owned().into()).expect("written");
        };
        let refused = |run: &str| {
            let refused = TrainedRun::read(&store, run, WeightsChoice::Latest);
            refused.err().expect("no UNet").to_string()
        };
        for (run, config) in [
            ("g", r#"{"group": {}}"#),
            ("t", r#"{"network": {"tokens": {}}, "tokens": {}}"#),
            ("p", r#"{"planner": {}}"#),
            ("u", r#"{"diffusion": {}}"#),
        ] {
            begun(run, config);
        }
        let goes_on =
            "its training ended before anything was validated, so go on with motiongen train";
        assert_eq!(
            refused("g"),
            format!("run g has no trained denoiser of groups; {goes_on} --family group --run g")
        );
        assert_eq!(
            refused("t"),
            format!("run t has no trained tokenizer; {goes_on} --family tokens --run t")
        );
        assert_eq!(
            refused("p"),
            format!(
                "run p has no trained planner; {goes_on} --family tokens --tokenizer RUN --run p"
            )
        );
        for run in ["u", "x"] {
            let expected =
                format!("run {run} has no trained UNet; run motiongen train --run {run} first");
            assert_eq!(refused(run), expected);
        }
        store.put_new("runs/t/tokens/best-00000007.safetensors", "".into()).expect("written");
        assert_eq!(
            refused("t"),
            "run t has no trained UNet; it has a trained tokenizer; name a run of the family unet"
        );
    }
}
