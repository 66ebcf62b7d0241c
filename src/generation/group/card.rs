//! `model.json` of a model of the family `group`.

use serde::{Deserialize, Serialize};

use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::diffusion::DiffusionConfig;
use crate::generation::card::{
    FamilyCard, FileEntry, ModelFileName, SamplingDefaults, SharedFields, check_n_parameters,
    check_sizes, most_bytes, shared_fields,
};
use crate::generation::learned::LearnedFrom;
use crate::model::{Family, GroupConfig, GroupNetworks};
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

impl FamilyCard for GroupCard {
    const FAMILY: Family = Family::Group;
    const MIN_WINDOW_FRAMES: usize = 4;
    const USUAL_GUIDANCE: f64 = 1.0;

    fn shared(&self) -> SharedFields<'_> {
        shared_fields!(self)
    }

    fn check_networks(&self) -> Result<(), String> {
        let Self { group, diffusion, .. } = self;
        group.check().map_err(|e| e.to_string())?;
        diffusion.check().map_err(|e| e.to_string())?;
        check_sizes(&[
            ("motion_dim", group.motion_dim, MOTION_DIM),
            ("audio_cond_dim", group.audio_cond_dim, FEATURE_DIM),
            ("n_steps of the network", group.n_steps, diffusion.n_steps),
        ])?;
        check_n_parameters("the networks have", GroupNetworks::new(group).1.n_elements())
    }

    fn most_bytes(&self, name: ModelFileName) -> Option<u64> {
        let group = &self.group;
        match name {
            ModelFileName::Denoiser | ModelFileName::Score => {
                let n_table = group.n_steps * group.width;
                Some(most_bytes(GroupNetworks::new(group).1.n_elements() + n_table))
            }
            _ => None,
        }
    }
}
