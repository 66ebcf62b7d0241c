//! `model.json`: what a model's folder says of itself.

use std::fmt;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

use super::LearnedFrom;
use crate::audio::{FEATURE_DIM, FeatureScale, feature_names};
use crate::diffusion::DiffusionConfig;
use crate::model::{DecoderConfig, Family, MotionDecoder, UNet1D, UNetConfig};
use crate::motion::postprocess::FusionVariances;
use crate::motion::rates::MotionRange;
use crate::motion::{CHANNEL_NAMES, MOTION_DIM, Normalizer};
use crate::onnx::Storage;
use crate::units::FPS;

/// Layout of the card; raised when a field changes its meaning.
pub const MODEL_FORMAT: u32 = 1;

/// Largest card that is read, in bytes: the digests of ten million songs and phrases.
pub const MAX_CARD_BYTES: u64 = 256 << 20;
/// Parameters that a network may have, 8 GiB in f32.
pub(super) const MAX_PARAMETERS: usize = 1 << 31;
/// Bytes of a file beside eight for each parameter and each value of the table of steps.
const MAX_GRAPH_BYTES: u64 = 64 << 20;
/// Longest window, in frames: over half an hour.
pub(super) const MAX_WINDOW_FRAMES: usize = 1 << 16;
/// Longest name of a model, in bytes.
const MAX_NAME_BYTES: usize = 100;

/// The names of a model's files.
pub mod file_names {
    pub const CARD: &str = "model.json";
    pub const UNET: &str = "unet.onnx";
    /// Weights of a UNet that is too large for one file.
    pub const UNET_WEIGHTS: &str = "unet.weights.bin";
    pub const DECODER: &str = "decoder.onnx";
    pub const DECODER_WEIGHTS: &str = "decoder.weights.bin";
    /// Of a model of the family `group`.
    pub const DENOISER: &str = "denoiser.onnx";
    pub const SCORE: &str = "score.onnx";
}

/// The files that a model can have beside its card; a card can name no other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ModelFileName {
    Unet,
    UnetWeights,
    Decoder,
    DecoderWeights,
    Denoiser,
    Score,
}

impl ModelFileName {
    /// Every name, in the order in which cards list them.
    pub const ALL: [Self; 6] = [
        Self::Unet,
        Self::UnetWeights,
        Self::Decoder,
        Self::DecoderWeights,
        Self::Denoiser,
        Self::Score,
    ];

    /// Returns the name of the file.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unet => file_names::UNET,
            Self::UnetWeights => file_names::UNET_WEIGHTS,
            Self::Decoder => file_names::DECODER,
            Self::DecoderWeights => file_names::DECODER_WEIGHTS,
            Self::Denoiser => file_names::DENOISER,
            Self::Score => file_names::SCORE,
        }
    }

    /// Returns the file of that name; none where no model has such a file.
    pub fn of_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|file| file.name() == name)
    }
}

impl fmt::Display for ModelFileName {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Serialize for ModelFileName {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for ModelFileName {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        Self::of_name(&text).ok_or_else(|| {
            let start: String = text.chars().take(MAX_NAME_BYTES).collect();
            let known = Self::ALL.map(Self::name).join(", ");
            serde::de::Error::custom(format!("a model has no file {start:?}, only {known}"))
        })
    }
}

/// A model: where it comes from, how it is used, and its files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelCard {
    pub format: u32,
    /// Cards of release 0.1 name none.
    #[serde(default, skip_serializing_if = "Family::is_unet")]
    pub family: Family,
    pub name: String,
    /// The program that wrote it.
    pub program: String,
    pub provenance: Provenance,
    pub precision: Storage,
    pub unet: UNetConfig,
    pub decoder: DecoderConfig,
    pub diffusion: DiffusionConfig,
    /// ᾱ of each step of the diffusion, for programs other than this one that sample from the model.
    pub alphas_cumprod: Vec<f64>,
    pub n_parameters: Networks<usize>,
    /// SHA-256 of each network's weights as f32, in the order in which its layers are made.
    pub weights_sha256: Networks<String>,
    /// Frames that it was trained on; longer motion is sampled in windows of as many.
    pub window_frames: usize,
    /// Frames a second.
    pub fps: f64,
    /// Names of the channels of motion, in order.
    pub channels: Vec<String>,
    /// Names of the features of the music, in order.
    pub features: Vec<String>,
    /// Centre and scale of each channel of motion.
    pub normalizer: Normalizer,
    /// Centre and scale of each feature; `unet.onnx` applies them itself.
    pub feature_scale: FeatureScale,
    /// How fast the motion is that it was trained on; generated motion is held to it.
    #[serde(default)]
    pub motion_range: Option<MotionRange>,
    /// How it is best sampled; cards of release 0.1 do not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sampling: Option<SamplingDefaults>,
    pub licence: String,
    pub files: Vec<FileEntry>,
}

/// How a model is best sampled, as measured on the songs of its validation split.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SamplingDefaults {
    /// With which the motion that is locked to the bar is as large as that of real motion.
    pub guidance: f64,
    /// Of the errors that the decoder's heads leave, by which its last layer and post-processing weigh its channels.
    pub fusion_variances: FusionVariances,
}

impl SamplingDefaults {
    /// Refuses numbers that no motion can be sampled with.
    pub(super) fn check(&self) -> Result<(), String> {
        if !(self.guidance.is_finite() && self.guidance >= 0.0) {
            return Err(format!(
                "guidance is {}; it must be 0 or more; export the model again",
                self.guidance
            ));
        }
        match self.fusion_variances.unsound() {
            Some((name, variance)) => Err(format!(
                "{name} of fusion_variances is {variance}; it must be above 0; export the model again"
            )),
            None => Ok(()),
        }
    }
}

/// What a card says first of all.
#[derive(Debug, Deserialize)]
pub(super) struct Head {
    format: u32,
    #[serde(default)]
    family: Option<String>,
}

impl Head {
    /// Reads format and family; another format is refused.
    pub(super) fn read(bytes: &[u8], place: &str) -> Result<Self, CardError> {
        let place = || place.to_owned();
        let head: Self = serde_json::from_slice(bytes)
            .map_err(|e| CardError::Unreadable { place: place(), reason: e.to_string() })?;
        if head.format != MODEL_FORMAT {
            return Err(CardError::Format { place: place(), found: head.format });
        }
        Ok(head)
    }

    /// Refuses a card of another family.
    pub(super) fn expect(&self, family: Family, place: &str) -> Result<(), CardError> {
        let found = self.family.as_deref().unwrap_or(Family::default().name());
        if found == family.name() {
            return Ok(());
        }
        let found = found.chars().take(MAX_NAME_BYTES).collect();
        Err(CardError::Family { place: place.to_owned(), found, wanted: family.name() })
    }
}

/// Returns the family of a model by its card.
///
/// # Errors
/// [`CardError`] for a text that is no card, or one of another format.
pub fn family_of(bytes: &[u8], place: &str) -> Result<Family, CardError> {
    let head = Head::read(bytes, place)?;
    let is_group = head.family.as_deref() == Some(Family::Group.name());
    Ok(if is_group { Family::Group } else { Family::Unet })
}

/// Refuses other channels, features or frames than those of this program.
pub(super) fn check_layout(
    (channels, features, fps): (&[String], &[String], f64),
    n_scaled: [usize; 2],
    place: &str,
) -> Result<(), CardError> {
    let layout = |what, detail| Err(CardError::Layout { place: place.to_owned(), what, detail });
    if let Some(detail) = difference(channels, &own_channels()) {
        return layout("channels", detail);
    }
    if let Some(detail) = difference(features, &own_features()) {
        return layout("features", detail);
    }
    if fps != FPS {
        return layout("frames", format!("{fps} a second instead of {FPS}"));
    }
    if let Some(n) = n_scaled.into_iter().find(|&n| n != FEATURE_DIM) {
        return layout("features", format!("{n} are scaled instead of {FEATURE_DIM}"));
    }
    Ok(())
}

/// Refuses scales by which nothing can be divided.
pub(super) fn check_scales(
    normalizer: &Normalizer,
    feature_scale: &FeatureScale,
) -> Result<(), String> {
    let centres = normalizer.centre.iter().chain(&feature_scale.centre);
    let scales = normalizer.scale.iter().chain(&feature_scale.scale);
    if let Some(centre) = centres.into_iter().find(|x| !x.is_finite()) {
        return Err(format!("a centre is {centre}; export the model again"));
    }
    if let Some(scale) = scales.into_iter().find(|x| !(x.is_finite() && **x > 0.0)) {
        return Err(format!("a scale is {scale}; it must be above 0; export the model again"));
    }
    Ok(())
}

/// Refuses files that are listed twice, are of another family, or are larger than `most` says of their name.
pub(super) fn check_file_list(
    files: &[FileEntry],
    most: impl Fn(ModelFileName) -> Result<u64, String>,
) -> Result<(), String> {
    for (i, FileEntry { name, n_bytes, .. }) in files.iter().enumerate() {
        if files[..i].iter().any(|before| before.name == *name) {
            return Err(format!("{name} is listed twice; export the model again"));
        }
        let most = most(*name)?;
        if *n_bytes > most {
            return Err(format!(
                "{name} has {n_bytes} bytes, a network of these sizes at most {most}; export the model again"
            ));
        }
    }
    Ok(())
}

/// Returns the bytes that a file of so many numbers may have.
pub(super) fn most_bytes(n_values: usize) -> u64 {
    8 * n_values as u64 + MAX_GRAPH_BYTES
}

/// Says what is wrong with a name that is none.
pub(super) fn name_problem(name: &str) -> String {
    let name: String = name.chars().take(MAX_NAME_BYTES).collect();
    format!(
        "name {name:?} is none of a model: 1 to {MAX_NAME_BYTES} letters, digits, -, _ and ., and no . at \
         the beginning; export the model again"
    )
}

/// Guidance of models whose card tells none, as release 0.1 sampled them.
const GUIDANCE_WITHOUT_CARD: f64 = 4.0;

/// The run, training steps and data that a model was made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Provenance {
    pub run: String,
    /// `diffusion` (UNet and decoder trained apart) or `finetune` (end to end).
    pub stage: String,
    pub unet_step: u64,
    pub decoder_step: u64,
    pub validation_loss: Option<f64>,
    /// Digest of the phrases.
    pub data: String,
    /// Which music that was; cards of release 0.1 do not tell.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub learned_from: Option<LearnedFrom>,
}

/// Something of each network.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Networks<T> {
    pub unet: T,
    pub decoder: T,
}

/// A file of a model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileEntry {
    pub name: ModelFileName,
    pub n_bytes: u64,
    pub sha256: String,
}

/// Why a model cannot be used by this program.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CardError {
    #[error("{place}: is no description of a model ({reason}); export the model again")]
    Unreadable { place: String, reason: String },
    #[error(
        "{place}: has format {found}, this program reads format {MODEL_FORMAT}; use the version of \
         motiongen that wrote it, or export the model again"
    )]
    Format { place: String, found: u32 },
    #[error("{place}: is a model of the family {found}, and one of the family {wanted} is needed")]
    Family { place: String, found: String, wanted: &'static str },
    #[error(
        "{place}: is a model of other {what}: {detail}; train and export a model with this version of \
         motiongen"
    )]
    Layout { place: String, what: &'static str, detail: String },
    #[error("{place}: {problem}")]
    Config { place: String, problem: String },
    #[error("{place}: has no file {name}; export the model again")]
    NoFile { place: String, name: ModelFileName },
    #[error(
        "{place}: has {found} bytes, model.json says {expected}; the file was changed or damaged; copy it again \
         or export the model again"
    )]
    Size { place: String, found: u64, expected: u64 },
    #[error(
        "{place}: SHA-256 is {found}, model.json says {expected}; the file was changed or damaged; copy it \
         again or export the model again"
    )]
    Digest { place: String, found: String, expected: String },
}

impl ModelCard {
    /// Reads a card; `place` is what messages call it.
    ///
    /// # Errors
    /// One sentence for a text that is no card, another format, another layout of channels or features.
    pub fn read(bytes: &[u8], place: &str) -> Result<Self, CardError> {
        Head::read(bytes, place)?.expect(Family::Unet, place)?;
        let card: Self = serde_json::from_slice(bytes).map_err(|e| CardError::Unreadable {
            place: place.to_owned(),
            reason: e.to_string(),
        })?;
        let n_scaled = [card.feature_scale.centre.len(), card.feature_scale.scale.len()];
        check_layout((&card.channels, &card.features, card.fps), n_scaled, place)?;
        let config = |problem: String| CardError::Config { place: place.to_owned(), problem };
        let n_elements = card.check_networks().map_err(config)?;
        check_scales(&card.normalizer, &card.feature_scale).map_err(config)?;
        card.check_files(&n_elements).map_err(config)?;
        card.sampling.as_ref().map_or(Ok(()), SamplingDefaults::check).map_err(config)?;
        if !(2..=MAX_WINDOW_FRAMES).contains(&card.window_frames) {
            return Err(config(format!(
                "window_frames is {}; it must be 2 to {MAX_WINDOW_FRAMES}; export the model again",
                card.window_frames
            )));
        }
        if !is_name(&card.name) {
            return Err(config(name_problem(&card.name)));
        }
        Ok(card)
    }

    /// Refuses networks that do not fit this program, or any memory; returns how many parameters each has.
    fn check_networks(&self) -> Result<Networks<usize>, String> {
        let Self { unet, decoder, diffusion, .. } = self;
        unet.check().map_err(|e| e.to_string())?;
        decoder.check().map_err(|e| e.to_string())?;
        diffusion.check().map_err(|e| e.to_string())?;
        let again = "export the model again";
        for (name, found, expected) in [
            ("in_channels", unet.in_channels, MOTION_DIM),
            ("out_channels", unet.out_channels, MOTION_DIM),
            ("audio_cond_dim", unet.audio_cond_dim, FEATURE_DIM),
            ("input_dim of the decoder", decoder.input_dim, MOTION_DIM),
            ("n_steps of the network", unet.n_steps, diffusion.n_steps),
        ] {
            if found != expected {
                return Err(format!("{name} is {found}, expected {expected}; {again}"));
            }
        }
        let n_elements = Networks {
            unet: UNet1D::new(unet).1.n_elements(),
            decoder: MotionDecoder::new(decoder).1.n_elements(),
        };
        for (name, n) in [("UNet", n_elements.unet), ("decoder", n_elements.decoder)] {
            if n > MAX_PARAMETERS {
                return Err(format!(
                    "the {name} has {n} parameters, at most {MAX_PARAMETERS} are read; {again}"
                ));
            }
        }
        Ok(n_elements)
    }

    /// Refuses files that are listed twice, or are larger than what they hold.
    fn check_files(&self, n_elements: &Networks<usize>) -> Result<(), String> {
        let n_table = self.unet.n_steps * self.unet.time_embed_dim;
        check_file_list(&self.files, |name| match name {
            ModelFileName::Unet | ModelFileName::UnetWeights => {
                Ok(most_bytes(n_elements.unet + n_table))
            }
            ModelFileName::Decoder | ModelFileName::DecoderWeights => {
                Ok(most_bytes(n_elements.decoder))
            }
            other => Err(format!(
                "{other} is no file of a model of the family unet; export the model again"
            )),
        })
    }

    /// Returns the guidance that the model is sampled with unless the user says otherwise.
    pub fn guidance(&self) -> f64 {
        self.sampling.as_ref().map_or(GUIDANCE_WITHOUT_CARD, |sampling| sampling.guidance)
    }

    /// Returns the variances of the decoder's errors; none where they were not measured.
    pub fn fusion_variances(&self) -> Option<FusionVariances> {
        self.sampling.as_ref().map(|sampling| sampling.fusion_variances)
    }

    /// Returns a file's entry.
    ///
    /// # Errors
    /// [`CardError::NoFile`] when the card lists none.
    pub fn file(&self, name: ModelFileName, place: &str) -> Result<&FileEntry, CardError> {
        let found = self.files.iter().find(|file| file.name == name);
        found.ok_or_else(|| CardError::NoFile { place: place.to_owned(), name })
    }
}

/// Returns whether a name can be that of a model: 1 to 100 letters, digits, `-`, `_` and `.`, and no `.` at the
/// beginning.
pub fn is_name(name: &str) -> bool {
    let is_plain = |c: char| c.is_ascii_alphanumeric() || ['-', '_', '.'].contains(&c);
    (1..=MAX_NAME_BYTES).contains(&name.len())
        && name.chars().all(is_plain)
        && !name.starts_with('.')
}

/// Returns the names of the channels, as cards have them.
pub fn own_channels() -> Vec<String> {
    CHANNEL_NAMES.iter().map(|&name| name.to_owned()).collect()
}

/// Returns the names of the features, as cards have them.
pub fn own_features() -> Vec<String> {
    feature_names().map(|(name, _)| name.into_owned()).collect()
}

/// Says where two lists of names part.
fn difference(found: &[String], own: &[String]) -> Option<String> {
    let first = (0..found.len().max(own.len())).find(|&i| found.get(i) != own.get(i))?;
    let name = |names: &[String]| names.get(first).cloned().unwrap_or_else(|| "none".to_owned());
    Some(format!(
        "{} of them instead of {}, and number {first} is {} instead of {}",
        found.len(),
        own.len(),
        name(found),
        name(own)
    ))
}

#[cfg(test)]
mod tests;
