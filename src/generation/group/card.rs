//! `model.json` of a model of the family `group`.

use serde::{Deserialize, Serialize};

use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::diffusion::DiffusionConfig;
use crate::generation::card::{
    CardError, FileEntry, Head, MAX_PARAMETERS, MAX_WINDOW_FRAMES, MODEL_FORMAT, ModelFileName,
    SamplingDefaults, check_file_list, check_layout, check_scales, is_name, most_bytes,
    name_problem,
};
use crate::generation::learned::LearnedFrom;
use crate::model::{Family, GroupConfig, GroupNetworks};
use crate::motion::postprocess::FusionVariances;
use crate::motion::rates::MotionRange;
use crate::motion::{MOTION_DIM, Normalizer};
use crate::onnx::Storage;

/// A model of a group: where it comes from, how it is used, and its files.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupCard {
    pub format: u32,
    pub family: Family,
    pub name: String,
    /// The program that wrote it.
    pub program: String,
    pub provenance: GroupProvenance,
    pub precision: Storage,
    pub group: GroupConfig,
    pub diffusion: DiffusionConfig,
    /// ᾱ of each step of the diffusion, for programs other than this one that sample from the model.
    pub alphas_cumprod: Vec<f64>,
    pub n_parameters: usize,
    /// SHA-256 of the weights of both networks as f32, in the order in which their layers are made.
    pub weights_sha256: String,
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
    /// Centre and scale of each feature; `denoiser.onnx` applies them itself.
    pub feature_scale: FeatureScale,
    /// How fast the motion is that it was trained on; generated motion is held to it.
    pub motion_range: Option<MotionRange>,
    /// How it is best sampled; none where it was not measured.
    pub sampling: Option<SamplingDefaults>,
    pub licence: String,
    pub files: Vec<FileEntry>,
}

/// The run, training steps and data that a model of a group was made from.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct GroupProvenance {
    pub run: String,
    pub step: u64,
    pub validation_loss: Option<f64>,
    /// Digest of the phrases.
    pub data: String,
    /// Which music that was.
    pub learned_from: Option<LearnedFrom>,
}

impl GroupCard {
    /// Reads a card; `place` is what messages call it.
    ///
    /// # Errors
    /// One sentence for a text that is no card of this family, another format, another layout of channels or
    /// features, and for sizes that no memory holds.
    pub fn read(bytes: &[u8], place: &str) -> Result<Self, CardError> {
        Head::read(bytes, place)?.expect(Family::Group, place)?;
        let card: Self = serde_json::from_slice(bytes).map_err(|e| CardError::Unreadable {
            place: place.to_owned(),
            reason: e.to_string(),
        })?;
        let n_scaled = [card.feature_scale.centre.len(), card.feature_scale.scale.len()];
        check_layout((&card.channels, &card.features, card.fps), n_scaled, place)?;
        let config = |problem: String| CardError::Config { place: place.to_owned(), problem };
        card.check_networks().map_err(config)?;
        check_scales(&card.normalizer, &card.feature_scale).map_err(config)?;
        card.check_files().map_err(config)?;
        card.sampling.as_ref().map_or(Ok(()), SamplingDefaults::check).map_err(config)?;
        if !(4..=MAX_WINDOW_FRAMES).contains(&card.window_frames) {
            return Err(config(format!(
                "window_frames is {}; it must be 4 to {MAX_WINDOW_FRAMES}; export the model again",
                card.window_frames
            )));
        }
        if !is_name(&card.name) {
            return Err(config(name_problem(&card.name)));
        }
        Ok(card)
    }

    /// Refuses networks that do not fit this program, or any memory.
    fn check_networks(&self) -> Result<(), String> {
        let Self { group, diffusion, .. } = self;
        group.check().map_err(|e| e.to_string())?;
        diffusion.check().map_err(|e| e.to_string())?;
        for (name, found, expected) in [
            ("motion_dim", group.motion_dim, MOTION_DIM),
            ("audio_cond_dim", group.audio_cond_dim, FEATURE_DIM),
            ("n_steps of the network", group.n_steps, diffusion.n_steps),
        ] {
            if found != expected {
                return Err(format!(
                    "{name} is {found}, expected {expected}; export the model again"
                ));
            }
        }
        let n = GroupNetworks::new(group).1.n_elements();
        if n > MAX_PARAMETERS {
            return Err(format!(
                "the networks have {n} parameters, at most {MAX_PARAMETERS} are read; export the model again"
            ));
        }
        Ok(())
    }

    fn check_files(&self) -> Result<(), String> {
        let n_values =
            GroupNetworks::new(&self.group).1.n_elements() + self.group.n_steps * self.group.width;
        check_file_list(&self.files, |name| match name {
            ModelFileName::Denoiser | ModelFileName::Score => Ok(most_bytes(n_values)),
            other => Err(format!(
                "{other} is no file of a model of the family group; export the model again"
            )),
        })
    }

    /// Returns the guidance that the model is sampled with unless the user says otherwise.
    pub fn guidance(&self) -> f64 {
        self.sampling.as_ref().map_or(1.0, |sampling| sampling.guidance)
    }

    /// Returns the variances by which poses are fused with velocities; none where they were not measured.
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

    /// Returns the format that cards of this program have.
    pub fn own_format() -> u32 {
        MODEL_FORMAT
    }
}
