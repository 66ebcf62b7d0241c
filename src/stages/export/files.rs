//! The files of a model, made in memory.

use std::collections::BTreeMap;

use bytes::Bytes;
use serde::Serialize;

use crate::autodiff::Parameters;
use crate::diffusion::{DiffusionConfig, Schedule};
use crate::generation::{FileEntry, ModelFileName, SharedFields};
use crate::onnx::{EncodedModel, Graph, Model, ModelFile, OnnxError, check};
use crate::stages::model_files::{sha256, sha256_of};

/// A model that is not yet anywhere.
pub struct ExportedFiles<C> {
    pub card: C,
    pub card_text: Bytes,
    /// Name and content, in the order in which they are written.
    pub bytes: Vec<(ModelFileName, Bytes)>,
}

/// A network that becomes a file.
pub struct NetworkFile<'a> {
    pub graph: Graph,
    pub name: ModelFileName,
    /// SHA-256 of the weights as f32, that of all networks or of this one.
    pub weights_sha256: &'a str,
    /// Where weights of more than so many bytes lie; none for within the file, however many there are.
    pub weights_beside: Option<(ModelFileName, usize)>,
}

/// Writes networks as files, and checks them against the rules of the format; `own` is what the files themselves tell
/// of the model beside what cards of all families say.
///
/// # Errors
/// A network that breaks a rule.
pub fn encode(
    networks: Vec<NetworkFile>,
    card: SharedFields<'_>,
    own: &[(&str, String)],
) -> anyhow::Result<Vec<(ModelFileName, Bytes)>> {
    let mut files = Vec::new();
    for NetworkFile { graph, name, weights_sha256, weights_beside } in networks {
        let mut metadata = metadata(&card, own)?;
        metadata.insert("motiongen.weights_sha256".to_owned(), weights_sha256.to_owned());
        let description = format!("{} of {}, by {}", graph.name, card.name, card.program);
        let file = ModelFile { graph, metadata, description };
        let (weights_name, embedded) =
            weights_beside.map_or(("", usize::MAX), |(name, embedded)| (name.name(), embedded));
        let EncodedModel { model, weights } = file.encode(weights_name, embedded);
        let read = Model::read(model.clone(), weights.as_ref(), name.name())?;
        check(&read, name.name())
            .map_err(|e: OnnxError| anyhow::anyhow!("{e}; please report this"))?;
        files.push((name, model));
        files.extend(weights_beside.zip(weights).map(|((name, _), weights)| (name, weights)));
    }
    Ok(files)
}

/// Returns what a card lists of files.
pub fn entries(files: &[(ModelFileName, Bytes)]) -> Vec<FileEntry> {
    let entry = |(name, bytes): &(ModelFileName, Bytes)| FileEntry {
        name: *name,
        n_bytes: bytes.len() as u64,
        sha256: sha256(bytes),
    };
    files.iter().map(entry).collect()
}

/// Returns ᾱ of each step of a diffusion.
///
/// # Errors
/// A configuration of which no schedule can be made.
pub fn alphas_cumprod(diffusion: &DiffusionConfig) -> anyhow::Result<Vec<f64>> {
    let schedule = Schedule::new(diffusion)?;
    Ok((0..schedule.len()).map(|t| schedule.alpha_bar(t)).collect())
}

/// Returns the program that writes a model, as cards name it.
pub fn program() -> String {
    format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION"))
}

impl<C: Serialize> ExportedFiles<C> {
    /// Joins files with the card that lists them.
    ///
    /// # Errors
    /// A number that JSON does not have.
    pub fn new(card: C, bytes: Vec<(ModelFileName, Bytes)>) -> anyhow::Result<Self> {
        let mut text = serde_json::to_vec_pretty(&card)?;
        text.push(b'\n');
        Ok(Self { card, card_text: text.into(), bytes })
    }
}

impl<C> ExportedFiles<C> {
    /// Returns the content of a file.
    pub fn get(&self, name: &str) -> Option<&Bytes> {
        self.bytes.iter().find(|(known, _)| known.name() == name).map(|(_, bytes)| bytes)
    }
}

/// Returns the SHA-256 of a network's weights: f32, little-endian, in the order of its layers.
pub(in crate::stages) fn weights_sha256(parameters: &Parameters<f32>) -> String {
    let bytes =
        |id| -> Vec<u8> { parameters.unpacked(id).iter().flat_map(|x| x.to_le_bytes()).collect() };
    sha256_of(parameters.list().iter().map(|(id, _)| bytes(id)))
}

/// Returns what the files themselves tell of the model, so that one without its card can be used.
fn metadata(
    card: &SharedFields<'_>,
    own: &[(&str, String)],
) -> anyhow::Result<BTreeMap<String, String>> {
    let entries = [
        ("model", card.name.to_owned()),
        ("run", card.run.to_owned()),
        ("data", card.data.to_owned()),
        ("licence", card.licence.to_owned()),
        ("precision", card.precision.name().to_owned()),
        ("fps", card.fps.to_string()),
        ("window_frames", card.window_frames.to_string()),
        ("channels", card.channels.join(",")),
        ("features", card.features.join(",")),
        ("diffusion", serde_json::to_string(card.diffusion)?),
        ("normalizer", serde_json::to_string(card.normalizer)?),
    ];
    let all = entries.into_iter().chain(own.iter().cloned());
    Ok(all.map(|(key, value)| (format!("motiongen.{key}"), value)).collect())
}
