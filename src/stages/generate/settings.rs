//! The settings of a motion as `generations` keeps them, and the digest under which it is made once.

use serde::{Deserialize, Serialize};

use super::params::Prime;
use crate::diffusion::SamplerConfig;
use crate::motion::postprocess::PostProcessConfig;
use crate::motion::style::STYLE_DIM;
use crate::store::digest;

/// Raised when generate writes something else for the same model, music and settings.
pub(super) const OUTPUT_VERSION: u32 = 3;

/// The settings that determine a motion beside its music and its candidate: the column `settings` of `generations`, and
/// what the digest of a generation is made of.
///
/// As text it is JSON in the order of these fields, the same in every build. `weights` and `seed` have columns
/// of their own and stand in the digest alone.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct MotionSettings {
    /// The version of what generate writes.
    pub output_version: u32,
    /// SHA-256 of the model's weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub weights: Option<String>,
    pub sampler: SamplerConfig,
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// The user's seed, from which those of candidates follow.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seed: Option<u64>,
    /// Candidates, of which one is kept.
    pub best_of: usize,
    /// Style in the model's units.
    pub style: Option<[f32; STYLE_DIM]>,
    /// Frames that neighbouring windows share.
    pub overlap_frames: usize,
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub prime: Option<Prime>,
    pub postprocess: PostProcessConfig,
    /// Digest of the constraints; in the digest of a generation all of them, written out.
    pub constraints: Option<String>,
    /// Share of the way to a constraint that every step of the sampling goes.
    pub constraint_strength: f64,
    /// Whether the rest of the way to constraints is left.
    pub soft: bool,
    /// Whether the clock is withheld from a network that hears it.
    #[serde(default, skip_serializing_if = "is_false")]
    pub no_clock: bool,
    /// Whether the decoder derives velocities from its poses, so that decoded motion agrees with itself by
    /// construction.
    #[serde(default, skip_serializing_if = "is_false")]
    pub decoder_derives: bool,
    /// Whether motion is sampled with the phase of its music, where that is known.
    #[serde(default, skip_serializing_if = "is_false")]
    pub phase_given: bool,
    /// Whether constraints are measured, and nothing is done about them.
    #[serde(default, skip_serializing_if = "is_false")]
    pub uncontrolled: bool,
}

/// As release 0.1 wrote settings, what it did not know is left out where it says nothing new.
fn is_false(is: &bool) -> bool {
    !is
}

impl MotionSettings {
    /// Returns the settings as JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string(self).expect("invariant: numbers and texts become JSON")
    }

    /// Returns the digest of the settings.
    pub fn digest(&self) -> String {
        digest(self.to_json().as_bytes())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::{Sampler, Spacing};

    fn settings() -> MotionSettings {
        MotionSettings {
            output_version: 2,
            weights: None,
            sampler: SamplerConfig {
                sampler: Sampler::Ddim { eta: 0.25 },
                n_steps: 7,
                spacing: Spacing::Trailing,
                clip: true,
            },
            guidance: 4.0,
            seed: None,
            best_of: 3,
            style: None,
            overlap_frames: 30,
            prime: None,
            postprocess: PostProcessConfig::default(),
            constraints: None,
            constraint_strength: 1.0,
            soft: false,
            no_clock: false,
            decoder_derives: false,
            phase_given: false,
            uncontrolled: false,
        }
    }

    #[test]
    fn settings_survive_their_text() {
        let prime = Some(Prime { n_left: 500, library: "d".to_owned() });
        let full = MotionSettings { style: Some([0.125; STYLE_DIM]), prime, ..settings() };
        for settings in [settings(), full] {
            let text = settings.to_json();
            assert!(!text.contains("weights") && !text.contains("seed"), "{text}");
            assert_eq!(serde_json::from_str::<MotionSettings>(&text).ok(), Some(settings));
        }
    }

    /// The text that release 0.1 digested: another one would make every motion again.
    #[test]
    fn the_digested_text_is_that_of_release_0_1() {
        let digested =
            MotionSettings { weights: Some("w".to_owned()), seed: Some(9), ..settings() };
        let postprocess = serde_json::to_string(&PostProcessConfig::default()).expect("JSON");
        let text = format!(
            "{{\"output_version\":2,\"weights\":\"w\",\"sampler\":{{\"sampler\":{{\"name\":\"ddim\",\
             \"eta\":0.25}},\"n_steps\":7,\"spacing\":\"trailing\",\"clip\":true}},\"guidance\":4.0,\
             \"seed\":9,\"best_of\":3,\"style\":null,\"overlap_frames\":30,\"postprocess\":{postprocess},\
             \"constraints\":null,\"constraint_strength\":1.0,\"soft\":false}}"
        );
        assert_eq!(digested.to_json(), text);
        assert_eq!(digested.digest(), digest(text.as_bytes()));
        // Neither a seed nor weights may be left out of it.
        assert_ne!(digested.digest(), settings().digest());
    }
}
