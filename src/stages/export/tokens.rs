//! A planner and its tokenizer become a model: encoder, decoder of signals, denoiser and planner, checked through
//! onnxruntime.

mod checks;
mod summary;
mod tuning;

use std::num::NonZeroUsize;

use anyhow::{Context as _, ensure};
use bytes::Bytes;

use super::files::{
    ExportedFiles, NetworkFile, alphas_cumprod, encode, entries, program, weights_sha256,
};
use super::{Export, MAX_TRAIN_PHRASES, Params, motion_range, named_styles, put_in_place};
use crate::generation::{
    FamilyCard as _, MODEL_FORMAT, ModelFileName, PlannerEngine, TokenEngine, TokensCard,
    TokensNetworks, TokensProvenance, own_channels, own_features,
};
use crate::model::{Family, ParameterId, PlannerKind};
use crate::onnx::{
    planner, planner_music, planner_step, token_denoiser, token_encoder, token_signal,
};
use crate::stages::learned;
use crate::stages::model_files::folder_of;
use crate::stages::train::session::{ProgressWatch, read_phrases};
use crate::stages::trained::{TrainedPlanner, TrainedTokenizer};
use crate::stages::{Progress, Stage as _, Summary};
use crate::store::Location;
use crate::units::FPS;
use checks::checks;
use summary::TokensExportSummary;

/// A planner and the tokenizer that it was trained with.
pub struct TrainedTokens {
    pub tokenizer: TrainedTokenizer,
    pub planner: TrainedPlanner,
}

impl TrainedTokens {
    /// Reads the run of a planner and that of its tokenizer.
    ///
    /// # Errors
    /// One sentence where the tokenizer has other weights than the planner was trained with.
    fn read(store: &Location, run: &str) -> anyhow::Result<Self> {
        let planner = TrainedPlanner::read(store, run)?;
        let config = &planner.state.config;
        let source = &config.tokenizer;
        let tokenizer = TrainedTokenizer::read(store, &source.run)?;
        config.network.check(&tokenizer.state.config.network.tokens)?;
        let found = weights_sha256(&tokenizer.parameters);
        let short = |digest: &str| -> String { digest.chars().take(12).collect() };
        ensure!(
            found == source.weights_sha256,
            "run {run} plans the tokens of {} with the weights {}, which has others now ({}); train a planner of these \
             tokens: motiongen train --family tokens --tokenizer {} --run NAME",
            source.run,
            short(&source.weights_sha256),
            short(&found),
            source.run
        );
        Ok(Self { tokenizer, planner })
    }
}

/// Runs the stage.
///
/// # Errors
/// What export says of a run of any family.
pub fn run(
    params: &Params,
    store: &Location,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let trained = TrainedTokens::read(store, &params.run)?;
    let machine = &params.machine;
    let watch = ProgressWatch(progress);
    let (most, is_dry_run) = (Some(MAX_TRAIN_PHRASES), params.dry_run);
    let phrases = read_phrases(
        store,
        Export::NAME,
        (machine, Family::Tokens),
        most,
        progress,
        &watch,
        is_dry_run,
    )?;
    let TrainedTokens { tokenizer, planner } = &trained;
    let config = &planner.state.config;
    let runs = [
        (params.run.as_str(), planner.state.data.as_str()),
        (config.tokenizer.run.as_str(), tokenizer.state.data.as_str()),
    ];
    let learned_from = learned::of_planner(store, runs, machine, progress, is_dry_run)?;
    let dataset = &phrases.dataset;
    let sampling = tuning::sampling_defaults(&trained, machine.threads, dataset, progress)?;
    let network = &tokenizer.state.config.network;
    let scales = &planner.state.scales;
    let mut card = TokensCard {
        format: MODEL_FORMAT,
        family: Family::Tokens,
        name: params.model.clone(),
        program: program(),
        provenance: TokensProvenance {
            run: params.run.clone(),
            tokenizer: config.tokenizer.run.clone(),
            step: planner.step,
            validation_loss: planner.state.progress.best.map(|best| best.loss),
            data: planner.state.data.clone(),
            learned_from,
        },
        precision: params.precision,
        tokens: network.tokens.clone(),
        planner: config.network.planner.clone(),
        diffusion: network.diffusion.clone(),
        alphas_cumprod: alphas_cumprod(&network.diffusion)?,
        n_parameters: TokensNetworks {
            tokenizer: tokenizer.parameters.list().n_elements(),
            planner: planner.parameters.list().n_elements(),
        },
        weights_sha256: TokensNetworks {
            tokenizer: config.tokenizer.weights_sha256.clone(),
            planner: weights_sha256(&planner.parameters),
        },
        window_frames: network.window_frames,
        fps: FPS,
        channels: own_channels(),
        features: own_features(),
        normalizer: scales.motion.clone(),
        feature_scale: scales.features.clone(),
        motion_range: motion_range(dataset)?,
        styles: named_styles(dataset, config.network.planner.style_dim)?,
        sampling,
        licence: params.licence.clone(),
        files: Vec::new(),
    };
    let bytes = files(&trained, params, &card)?;
    card.files = entries(&bytes);
    let files = ExportedFiles::new(card, bytes)?;
    let place = store.url_of(&folder_of(&params.model));
    let summary = |is_up_to_date, checks| {
        let (card, place) = (files.card.clone(), place.clone());
        Box::new(TokensExportSummary { card, place, checks, is_up_to_date, is_dry_run })
    };
    if is_dry_run {
        return Ok(summary(false, Vec::new()));
    }
    let results =
        put_in_place(params, store, (&files.bytes, &files.card_text), progress, |runtime| {
            checks(&files.card, params, &files.bytes, runtime)
        })?;
    Ok(match results {
        Some(results) => summary(false, results.rows),
        None => summary(true, Vec::new()),
    })
}

/// Makes the engines of a model that is being exported.
///
/// # Errors
/// When the system gives no threads.
fn engines(
    trained: &TrainedTokens,
    threads: NonZeroUsize,
) -> anyhow::Result<(TokenEngine, PlannerEngine)> {
    let TrainedTokens { tokenizer, planner } = trained;
    let (network, workers) = (&tokenizer.state.config.network, (NonZeroUsize::MIN, threads));
    let tokens = TokenEngine::new(
        &network.tokens,
        tokenizer.parameters.clone(),
        &planner.state.scales.motion,
        network.window_frames,
        workers,
    )
    .context("while starting threads")?;
    let planner = PlannerEngine::new(
        &planner.state.config.network.planner,
        planner.parameters.clone(),
        &planner.state.scales.features,
        workers,
    )
    .context("while starting threads")?;
    Ok((tokens, planner))
}

/// Writes the networks down, and checks them against the rules of the format.
fn files(
    trained: &TrainedTokens,
    params: &Params,
    card: &TokensCard,
) -> anyhow::Result<Vec<(ModelFileName, Bytes)>> {
    let (config, storage) = (&card.tokens, params.precision);
    let of_tokenizer = |id: ParameterId| trained.tokenizer.parameters.unpacked(id);
    let of_planner = |id: ParameterId| trained.planner.parameters.unpacked(id);
    let own = [
        ("family", card.family.name().to_owned()),
        ("tokens", serde_json::to_string(&card.tokens)?),
        ("planner", serde_json::to_string(&card.planner)?),
    ];
    let TokensNetworks { tokenizer, planner: planner_sha256 } = &card.weights_sha256;
    // The largest preset has 190 MB.
    let network = |graph, name, weights_sha256| NetworkFile {
        graph,
        name,
        weights_sha256,
        weights_beside: None,
    };
    let mut networks = vec![
        network(
            token_encoder(config, &of_tokenizer, storage)?,
            ModelFileName::Encoder,
            tokenizer.as_str(),
        ),
        network(token_signal(config, &of_tokenizer, storage)?, ModelFileName::Signal, tokenizer),
        network(
            token_denoiser(config, &of_tokenizer, storage)?,
            ModelFileName::Denoiser,
            tokenizer,
        ),
        network(
            planner(&card.planner, &of_planner, &card.feature_scale, storage)?,
            ModelFileName::Planner,
            planner_sha256,
        ),
    ];
    if card.planner.kind == PlannerKind::Autoregressive {
        networks.push(network(
            planner_music(&card.planner, &of_planner, &card.feature_scale, storage)?,
            ModelFileName::PlannerMusic,
            planner_sha256,
        ));
        networks.push(network(
            planner_step(&card.planner, &of_planner, storage)?,
            ModelFileName::PlannerStep,
            planner_sha256,
        ));
    }
    encode(networks, card.shared(), &own)
}
