//! What cards of every family have in common, and how any of them is read.

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use super::ModelFileName;
use crate::audio::{FEATURE_DIM, FeatureScale, feature_names};
use crate::diffusion::DiffusionConfig;
use crate::model::Family;
use crate::motion::postprocess::FusionVariances;
use crate::motion::rates::MotionRange;
use crate::motion::{CHANNEL_NAMES, Normalizer};
use crate::onnx::Storage;
use crate::units::FPS;

/// Layout of the card; raised when a field changes its meaning.
pub const MODEL_FORMAT: u32 = 1;

/// Largest card that is read, in bytes: the digests of ten million songs and phrases.
pub const MAX_CARD_BYTES: u64 = 256 << 20;
/// Parameters that a network may have, 8 GiB in f32.
const MAX_PARAMETERS: usize = 1 << 31;
/// Bytes of a file beside eight for each parameter and each value of the table of steps.
const MAX_GRAPH_BYTES: u64 = 64 << 20;
/// Longest window, in frames: over half an hour.
const MAX_WINDOW_FRAMES: usize = 1 << 16;
/// Longest name of a model, in bytes.
pub(super) const MAX_NAME_BYTES: usize = 100;

/// What a card of any family says beside its networks.
#[derive(Clone, Copy, Debug)]
pub struct SharedFields<'a> {
    pub name: &'a str,
    pub program: &'a str,
    /// The run that the model was made from.
    pub run: &'a str,
    /// Digest of the phrases of that run.
    pub data: &'a str,
    pub precision: Storage,
    pub licence: &'a str,
    pub diffusion: &'a DiffusionConfig,
    /// Frames that the model was trained on.
    pub window_frames: usize,
    pub fps: f64,
    pub channels: &'a [String],
    pub features: &'a [String],
    pub normalizer: &'a Normalizer,
    pub feature_scale: &'a FeatureScale,
    pub motion_range: Option<MotionRange>,
    pub sampling: Option<&'a SamplingDefaults>,
    pub files: &'a [FileEntry],
}

/// Borrows what a card of any family says beside its networks, from fields that are called alike in all of them.
macro_rules! shared_fields {
    ($card:expr) => {
        SharedFields {
            name: &$card.name,
            program: &$card.program,
            run: &$card.provenance.run,
            data: &$card.provenance.data,
            precision: $card.precision,
            licence: &$card.licence,
            diffusion: &$card.diffusion,
            window_frames: $card.window_frames,
            fps: $card.fps,
            channels: &$card.channels,
            features: &$card.features,
            normalizer: &$card.normalizer,
            feature_scale: &$card.feature_scale,
            motion_range: $card.motion_range,
            sampling: $card.sampling.as_ref(),
            files: &$card.files,
        }
    };
}
pub(in crate::generation) use shared_fields;

/// The card of a model of one family.
pub trait FamilyCard: DeserializeOwned {
    const FAMILY: Family;
    /// Fewest frames of a window.
    const MIN_WINDOW_FRAMES: usize;
    /// Guidance of models whose card tells none.
    const USUAL_GUIDANCE: f64;

    /// Returns what the card says beside its networks.
    fn shared(&self) -> SharedFields<'_>;

    /// Refuses networks that do not fit this program, or any memory.
    ///
    /// # Errors
    /// One sentence.
    fn check_networks(&self) -> Result<(), String>;

    /// Returns the bytes that a file may have; none where no model of the family has such a file.
    fn most_bytes(&self, name: ModelFileName) -> Option<u64>;

    /// Reads a card; `place` is what messages call it.
    ///
    /// # Errors
    /// One sentence for a text that is no card of this family, another format, another layout of channels or
    /// features, and for sizes that no memory holds.
    fn read(bytes: &[u8], place: &str) -> Result<Self, CardError> {
        CardHead::read(bytes, place)?.expect(Self::FAMILY, place)?;
        let card: Self = serde_json::from_slice(bytes).map_err(|e| CardError::Unreadable {
            place: place.to_owned(),
            reason: e.to_string(),
        })?;
        let fields = card.shared();
        check_layout(&fields, place)?;
        let config = |problem: String| CardError::Config { place: place.to_owned(), problem };
        card.check_networks().map_err(config)?;
        check_scales(fields.normalizer, fields.feature_scale).map_err(config)?;
        card.check_files().map_err(config)?;
        fields.sampling.map_or(Ok(()), SamplingDefaults::check).map_err(config)?;
        let least = Self::MIN_WINDOW_FRAMES;
        if !(least..=MAX_WINDOW_FRAMES).contains(&fields.window_frames) {
            return Err(config(format!(
                "window_frames is {}; it must be {least} to {MAX_WINDOW_FRAMES}; export the model again",
                fields.window_frames
            )));
        }
        if !is_name(fields.name) {
            return Err(config(name_problem(fields.name)));
        }
        Ok(card)
    }

    /// Refuses files that are listed twice, are of another family, or are larger than what they hold.
    ///
    /// # Errors
    /// One sentence.
    fn check_files(&self) -> Result<(), String> {
        let files = self.shared().files;
        for (i, FileEntry { name, n_bytes, .. }) in files.iter().enumerate() {
            if files[..i].iter().any(|before| before.name == *name) {
                return Err(format!("{name} is listed twice; export the model again"));
            }
            let Some(most) = self.most_bytes(*name) else {
                let family = Self::FAMILY.name();
                return Err(format!(
                    "{name} is no file of a model of the family {family}; export the model again"
                ));
            };
            if *n_bytes > most {
                return Err(format!(
                    "{name} has {n_bytes} bytes, a network of these sizes at most {most}; export the model again"
                ));
            }
        }
        Ok(())
    }

    /// Returns the guidance that the model is sampled with unless the user says otherwise.
    fn guidance(&self) -> f64 {
        self.shared().sampling.map_or(Self::USUAL_GUIDANCE, |sampling| sampling.guidance)
    }

    /// Returns the variances by which poses are fused with velocities; none where they were not measured.
    fn fusion_variances(&self) -> Option<FusionVariances> {
        self.shared().sampling.map(|sampling| sampling.fusion_variances)
    }

    /// Returns a file's entry.
    ///
    /// # Errors
    /// [`CardError::NoFile`] when the card lists none.
    fn file(&self, name: ModelFileName, place: &str) -> Result<&FileEntry, CardError> {
        let found = self.shared().files.iter().find(|file| file.name == name);
        found.ok_or_else(|| CardError::NoFile { place: place.to_owned(), name })
    }
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
    fn check(&self) -> Result<(), String> {
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

/// A file of a model.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct FileEntry {
    pub name: ModelFileName,
    pub n_bytes: u64,
    pub sha256: String,
}

/// What a card says first of all.
#[derive(Debug, Deserialize)]
struct CardHead {
    format: u32,
    #[serde(default)]
    family: Option<String>,
}

impl CardHead {
    /// Reads format and family; another format is refused.
    fn read(bytes: &[u8], place: &str) -> Result<Self, CardError> {
        let place = || place.to_owned();
        let head: Self = serde_json::from_slice(bytes)
            .map_err(|e| CardError::Unreadable { place: place(), reason: e.to_string() })?;
        if head.format != MODEL_FORMAT {
            return Err(CardError::Format { place: place(), found: head.format });
        }
        Ok(head)
    }

    /// Refuses a card of another family.
    fn expect(&self, family: Family, place: &str) -> Result<(), CardError> {
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
    let head = CardHead::read(bytes, place)?;
    let known = [Family::Group, Family::Tokens];
    let found = known.into_iter().find(|family| head.family.as_deref() == Some(family.name()));
    Ok(found.unwrap_or(Family::Unet))
}

/// Refuses other channels, features or frames than those of this program.
fn check_layout(fields: &SharedFields<'_>, place: &str) -> Result<(), CardError> {
    let SharedFields { channels, features, fps, feature_scale, .. } = *fields;
    let n_scaled = [feature_scale.centre.len(), feature_scale.scale.len()];
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
fn check_scales(normalizer: &Normalizer, feature_scale: &FeatureScale) -> Result<(), String> {
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

/// Returns the most bytes that a file of `n_values` numbers may have.
pub fn most_bytes(n_values: usize) -> u64 {
    8 * n_values as u64 + MAX_GRAPH_BYTES
}

/// Says what is wrong with a name that is none.
fn name_problem(name: &str) -> String {
    let name: String = name.chars().take(MAX_NAME_BYTES).collect();
    format!(
        "name {name:?} is none of a model: 1 to {MAX_NAME_BYTES} letters, digits, -, _ and ., and no . at \
         the beginning; export the model again"
    )
}

/// Refuses sizes of networks that are not what this program has, or what the card says elsewhere.
pub fn check_sizes(sizes: &[(&str, usize, usize)]) -> Result<(), String> {
    match sizes.iter().find(|(_, found, expected)| found != expected) {
        None => Ok(()),
        Some((name, found, expected)) => {
            Err(format!("{name} is {found}, expected {expected}; export the model again"))
        }
    }
}

/// Refuses networks of more parameters than are read; `who` is the beginning of the sentence.
pub fn check_n_parameters(who: &str, n: usize) -> Result<(), String> {
    if n > MAX_PARAMETERS {
        return Err(format!(
            "{who} {n} parameters, at most {MAX_PARAMETERS} are read; export the model again"
        ));
    }
    Ok(())
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
