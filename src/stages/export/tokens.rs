//! A planner and its tokenizer become a model: encoder, decoder of signals, denoiser and planner, checked through
//! onnxruntime.

mod checks;
mod tuning;

use std::num::NonZeroUsize;

use anyhow::{Context as _, ensure};
use bytes::Bytes;

use super::Params;
use super::checks::CheckResults;
use super::family::{CardMeasures, FamilyExport};
use super::files::{
    ExportedFiles, NetworkFile, alphas_cumprod, encode, entries, program, weights_sha256,
};
use crate::generation::{
    FamilyCard as _, LearnedFrom, MODEL_FORMAT, ModelFileName, PlannerEngine, SamplingDefaults,
    TokenEngine, TokensCard, TokensNetworks, TokensProvenance, own_channels, own_features,
};
use crate::model::{Family, ParameterId, PlannerKind};
use crate::onnx::{
    Runtime, planner, planner_music, planner_step, token_denoiser, token_encoder, token_signal,
};
use crate::stages::trained::{TrainedPlanner, TrainedTokenizer};
use crate::stages::{Progress, learned};
use crate::store::Location;
use crate::training::Dataset;
use crate::units::FPS;
use checks::checks;

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

impl FamilyExport for TrainedTokens {
    type Card = TokensCard;

    const FAMILY: Family = Family::Tokens;

    fn of_run(store: &Location, params: &Params) -> anyhow::Result<Self> {
        Self::read(store, &params.run)
    }

    fn learned_from(
        &self,
        store: &Location,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<LearnedFrom>> {
        let Params { run, machine, dry_run, .. } = params;
        let (planner, tokenizer) = (&self.planner.state, &self.tokenizer.state);
        let runs = [
            (run.as_str(), planner.data.as_str()),
            (planner.config.tokenizer.run.as_str(), tokenizer.data.as_str()),
        ];
        learned::of_planner(store, runs, machine, progress, *dry_run)
    }

    fn style_dim(&self) -> usize {
        self.planner.state.config.network.planner.style_dim
    }

    fn sampling(
        &self,
        dataset: &Dataset,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<SamplingDefaults>> {
        tuning::sampling_defaults(self, params.machine.threads, dataset, progress)
    }

    fn files(
        &mut self,
        params: &Params,
        CardMeasures { learned_from, motion_range, styles, sampling }: CardMeasures,
    ) -> anyhow::Result<ExportedFiles<TokensCard>> {
        let Self { tokenizer, planner } = &*self;
        let config = &planner.state.config;
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
            motion_range,
            styles,
            sampling,
            licence: params.licence.clone(),
            files: Vec::new(),
        };
        let bytes = files(self, params, &card)?;
        card.files = entries(&bytes);
        ExportedFiles::new(card, bytes)
    }

    fn checks(
        &self,
        files: &ExportedFiles<TokensCard>,
        _dataset: &Dataset,
        params: &Params,
        (runtime, _): (&Runtime, &dyn Progress),
    ) -> anyhow::Result<CheckResults> {
        checks(&files.card, params, &files.bytes, runtime)
    }
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
