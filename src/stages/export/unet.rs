//! A run of the family `unet` becomes a model: the UNet and the decoder, checked through onnxruntime.

use super::Params;
use super::checks::{CheckResults, ExportChecks, eager};
use super::family::{CardMeasures, FamilyExport};
use super::files::{
    ExportedFiles, NetworkFile, alphas_cumprod, encode, entries, program, weights_sha256,
};
use super::tuning::sampling_defaults;
use crate::generation::{
    FamilyCard as _, LearnedFrom, MODEL_FORMAT, ModelCard, ModelFileName, Networks, Provenance,
    SamplingDefaults, own_channels, own_features,
};
use crate::model::{Family, ParameterId};
use crate::onnx::{Form, Runtime, decoder, unet};
use crate::stages::trained::TrainedRun;
use crate::stages::{Progress, learned};
use crate::store::Location;
use crate::training::Dataset;
use crate::units::FPS;

impl FamilyExport for TrainedRun {
    type Card = ModelCard;

    const FAMILY: Family = Family::Unet;

    fn of_run(store: &Location, params: &Params) -> anyhow::Result<Self> {
        Ok(Self::read(store, &params.run, params.weights)?)
    }

    fn learned_from(
        &self,
        store: &Location,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<LearnedFrom>> {
        let Params { run, machine, dry_run, .. } = params;
        let learned_from = learned::of_run(store, run, self, machine, progress, *dry_run)?;
        if learned_from.is_none() {
            progress.note(&format!(
                "run {run} does not tell what it learned from, and the phrases of {store} are others by now: the \
                 model's card will not tell either, and evaluate will hold no music for held out"
            ));
        }
        Ok(learned_from)
    }

    fn style_dim(&self) -> usize {
        self.state.config.network.unet.style_dim
    }

    fn sampling(
        &self,
        dataset: &Dataset,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<SamplingDefaults>> {
        let weights = (self.unet.parameters.clone(), self.decoder.parameters.clone());
        let engine = eager(self, weights, params.machine.threads)?;
        sampling_defaults(&engine, &self.state.config.network, dataset, progress)
    }

    fn files(
        &mut self,
        params: &Params,
        CardMeasures { learned_from, motion_range, styles, sampling }: CardMeasures,
    ) -> anyhow::Result<ExportedFiles<ModelCard>> {
        // In training its heads speak for themselves, and by what they were measured to leave they are fused.
        self.state.config.network.decoder.fusion = sampling
            .as_ref()
            .filter(|_| !params.no_fusion)
            .map(|sampling| sampling.fusion_variances);
        let config = &self.state.config.network;
        let scales = &self.state.scales;
        let storage = params.precision;
        let unet_weights = |id: ParameterId| self.unet.parameters.unpacked(id);
        let decoder_weights = |id: ParameterId| self.decoder.parameters.unpacked(id);
        let weights_sha256 = Networks {
            unet: weights_sha256(&self.unet.parameters),
            decoder: weights_sha256(&self.decoder.parameters),
        };
        let mut card = ModelCard {
            format: MODEL_FORMAT,
            family: Family::Unet,
            name: params.model.clone(),
            program: program(),
            provenance: Provenance {
                run: params.run.clone(),
                stage: self.stage.to_owned(),
                unet_step: self.unet.step,
                decoder_step: self.decoder.step,
                validation_loss: self.loss,
                data: self.state.data.clone(),
                learned_from,
            },
            precision: storage,
            unet: config.unet.clone(),
            decoder: config.decoder.clone(),
            diffusion: config.diffusion.clone(),
            alphas_cumprod: alphas_cumprod(&config.diffusion)?,
            n_parameters: Networks {
                unet: self.unet.parameters.list().n_elements(),
                decoder: self.decoder.parameters.list().n_elements(),
            },
            weights_sha256,
            window_frames: config.window_frames,
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
        let weights_beside = |name| Some((name, params.embed_mb.saturating_mul(1_000_000)));
        let own = [
            ("stage", card.provenance.stage.clone()),
            ("unet", serde_json::to_string(&card.unet)?),
            ("decoder", serde_json::to_string(&card.decoder)?),
        ];
        let networks = vec![
            NetworkFile {
                graph: unet(
                    &config.unet,
                    &unet_weights,
                    &scales.features,
                    Form::default(),
                    storage,
                )?,
                name: ModelFileName::Unet,
                weights_sha256: &card.weights_sha256.unet,
                weights_beside: weights_beside(ModelFileName::UnetWeights),
            },
            NetworkFile {
                graph: decoder(&config.decoder, &decoder_weights, storage)?,
                name: ModelFileName::Decoder,
                weights_sha256: &card.weights_sha256.decoder,
                weights_beside: weights_beside(ModelFileName::DecoderWeights),
            },
        ];
        let bytes = encode(networks, card.shared(), &own)?;
        card.files = entries(&bytes);
        ExportedFiles::new(card, bytes)
    }

    fn checks(
        &self,
        files: &ExportedFiles<ModelCard>,
        dataset: &Dataset,
        params: &Params,
        (runtime, progress): (&Runtime, &dyn Progress),
    ) -> anyhow::Result<CheckResults> {
        ExportChecks { dataset, params, trained: self, files }.run(runtime, progress)
    }
}
