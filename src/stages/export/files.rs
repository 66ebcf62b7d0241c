//! The files of a model, made in memory.

use std::collections::BTreeMap;

use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use super::Params;
use crate::autodiff::Parameters;
use crate::diffusion::Schedule;
use crate::generation::{
    FileEntry, LearnedFrom, MODEL_FORMAT, ModelCard, ModelFileName, Networks, Provenance,
    SamplingDefaults, own_channels, own_features,
};
use crate::model::{Family, ParameterId};
use crate::motion::rates::MotionRange;
use crate::onnx::{EncodedModel, Form, Model, ModelFile, OnnxError, check, decoder, unet};
use crate::stages::model_files::sha256;
use crate::stages::trained::TrainedRun;
use crate::units::FPS;

/// A model that is not yet anywhere.
pub struct ExportedFiles {
    pub card: ModelCard,
    pub card_text: Bytes,
    /// Name and content, in the order in which they are written.
    pub bytes: Vec<(ModelFileName, Bytes)>,
}

impl ExportedFiles {
    /// Writes the networks of a run down, and checks them against the rules of the format.
    ///
    /// # Errors
    /// A network that cannot be written, or one that breaks a rule.
    pub fn make(
        trained: &TrainedRun,
        params: &Params,
        (range, sampling): (Option<MotionRange>, Option<SamplingDefaults>),
        learned_from: Option<LearnedFrom>,
    ) -> anyhow::Result<Self> {
        let config = &trained.state.config.network;
        let scales = &trained.state.scales;
        let storage = params.precision;
        let schedule = Schedule::new(&config.diffusion)?;
        let unet_weights = |id: ParameterId| trained.unet.parameters.unpacked(id);
        let decoder_weights = |id: ParameterId| trained.decoder.parameters.unpacked(id);
        let weights_sha256 = Networks {
            unet: weights_sha256(&trained.unet.parameters),
            decoder: weights_sha256(&trained.decoder.parameters),
        };
        let graphs = [
            unet(&config.unet, &unet_weights, &scales.features, Form::default(), storage)?,
            decoder(&config.decoder, &decoder_weights, storage)?,
        ];
        let mut card = ModelCard {
            format: MODEL_FORMAT,
            family: Family::Unet,
            name: params.model.clone(),
            program: format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION")),
            provenance: Provenance {
                run: params.run.clone(),
                stage: trained.stage.to_owned(),
                unet_step: trained.unet.step,
                decoder_step: trained.decoder.step,
                validation_loss: trained.loss,
                data: trained.state.data.clone(),
                learned_from,
            },
            precision: storage,
            unet: config.unet.clone(),
            decoder: config.decoder.clone(),
            diffusion: config.diffusion.clone(),
            alphas_cumprod: (0..schedule.len()).map(|t| schedule.alpha_bar(t)).collect(),
            n_parameters: Networks {
                unet: trained.unet.parameters.list().n_elements(),
                decoder: trained.decoder.parameters.list().n_elements(),
            },
            weights_sha256,
            window_frames: config.window_frames,
            fps: FPS,
            channels: own_channels(),
            features: own_features(),
            normalizer: scales.motion.clone(),
            feature_scale: scales.features.clone(),
            motion_range: range,
            sampling,
            licence: params.licence.clone(),
            files: Vec::new(),
        };
        let metadata = metadata(&card)?;
        let names = [
            (ModelFileName::Unet, ModelFileName::UnetWeights, &card.weights_sha256.unet),
            (ModelFileName::Decoder, ModelFileName::DecoderWeights, &card.weights_sha256.decoder),
        ];
        let mut bytes = Vec::new();
        for (graph, (name, weights_name, weights_sha256)) in graphs.into_iter().zip(names) {
            let mut metadata = metadata.clone();
            metadata.insert("motiongen.weights_sha256".to_owned(), weights_sha256.clone());
            let description = format!("{} of {}, by {}", graph.name, card.name, card.program);
            let file = ModelFile { graph, metadata, description };
            let embedded = params.embed_mb.saturating_mul(1_000_000);
            let EncodedModel { model, weights } = file.encode(weights_name.name(), embedded);
            let read = Model::read(model.clone(), weights.as_ref(), name.name())?;
            check(&read, name.name())
                .map_err(|e: OnnxError| anyhow::anyhow!("{e}; please report this"))?;
            bytes.push((name, model));
            bytes.extend(weights.map(|weights| (weights_name, weights)));
        }
        card.files = bytes
            .iter()
            .map(|(name, bytes)| FileEntry {
                name: *name,
                n_bytes: bytes.len() as u64,
                sha256: sha256(bytes),
            })
            .collect();
        let mut text = serde_json::to_vec_pretty(&card)?;
        text.push(b'\n');
        Ok(Self { card, card_text: text.into(), bytes })
    }

    /// Returns the content of a file.
    pub fn get(&self, name: &str) -> Option<&Bytes> {
        self.bytes.iter().find(|(known, _)| known.name() == name).map(|(_, bytes)| bytes)
    }
}

/// Returns the SHA-256 of a network's weights: f32, little-endian, in the order of its layers.
pub(in crate::stages) fn weights_sha256(parameters: &Parameters<f32>) -> String {
    let mut hash = Sha256::new();
    for (id, _) in parameters.list().iter() {
        let bytes: Vec<u8> = parameters.unpacked(id).iter().flat_map(|x| x.to_le_bytes()).collect();
        hash.update(&bytes);
    }
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Returns what the files themselves tell of the model, so that one without its card can be used.
fn metadata(card: &ModelCard) -> anyhow::Result<BTreeMap<String, String>> {
    let entries = [
        ("model", card.name.clone()),
        ("run", card.provenance.run.clone()),
        ("stage", card.provenance.stage.clone()),
        ("data", card.provenance.data.clone()),
        ("licence", card.licence.clone()),
        ("precision", card.precision.name().to_owned()),
        ("fps", card.fps.to_string()),
        ("window_frames", card.window_frames.to_string()),
        ("channels", card.channels.join(",")),
        ("features", card.features.join(",")),
        ("diffusion", serde_json::to_string(&card.diffusion)?),
        ("normalizer", serde_json::to_string(&card.normalizer)?),
        ("unet", serde_json::to_string(&card.unet)?),
        ("decoder", serde_json::to_string(&card.decoder)?),
    ];
    Ok(entries.into_iter().map(|(key, value)| (format!("motiongen.{key}"), value)).collect())
}
