//! What all motions of a run have in common, in tables and receipts.

use serde::Serialize;

use super::maker::generation_id;
use super::music::PhraseMusic;
use crate::diffusion::SamplerConfig;
use crate::evaluation::Score;
use crate::store::tables::GenerationRow;
use crate::store::{TimestampUs, digest};
use crate::units::frames_to_s;

/// The model, the settings and the name of a generation.
pub struct RunIdentity {
    /// Name of the model, as the user typed it.
    pub model: String,
    /// Digest of the model's weights.
    pub weights: String,
    /// Name of the generation.
    pub run: String,
    /// The user's seed.
    pub seed: u64,
    /// The settings as receipts have them: JSON, of constraints the digest.
    pub settings: serde_json::Value,
    /// The settings as `generations` has them: JSON in the order of their fields, the same in every build.
    pub settings_text: String,
    /// Digest of everything but the music that determines motions.
    pub settings_digest: String,
}

impl RunIdentity {
    /// Takes settings that do not contain the seed.
    pub fn new<S: Serialize>(
        (model, weights, run): (&str, &str, &str),
        seed: u64,
        settings: &S,
    ) -> Self {
        let settings_text =
            serde_json::to_string(settings).expect("invariant: numbers and texts become JSON");
        Self {
            model: model.to_owned(),
            weights: weights.to_owned(),
            run: run.to_owned(),
            seed,
            settings: serde_json::to_value(settings)
                .expect("invariant: numbers and texts become JSON"),
            settings_digest: digest(format!("{settings_text}\n{weights}\n{seed}").as_bytes()),
            settings_text,
        }
    }

    /// Returns the row of a motion that is kept, of a model that knows neither priming, constraints nor consistency.
    pub fn row(&self, music: &PhraseMusic, made: &SampledMotion) -> GenerationRow {
        let SampledMotion { sampler, n_frames, score, generate_s, .. } = *made;
        GenerationRow {
            generation: generation_id(&self.run, music.phrase_id, made.sample),
            run: self.run.clone(),
            phrase_id: music.phrase_id.to_owned(),
            sample: made.sample as i32,
            candidate: made.candidate as i32,
            selected: true,
            seed: made.seed as i64,
            model: self.model.clone(),
            weights: self.weights.clone(),
            engine: made.engine.to_owned(),
            sampler: sampler.sampler.name().to_owned(),
            n_steps: sampler.n_steps as i32,
            guidance: made.guidance,
            eta: sampler.sampler.eta(),
            primed_by: None,
            n_frames: n_frames as i64,
            n_windows: made.n_windows as i32,
            score: score.total,
            checks_passed: score.n_passed as i32,
            n_checks: score.n_checks as i32,
            locking: score.locking,
            velocity_error: made.velocity_error,
            control_error_mm: None,
            control_error_deg: None,
            constraints: None,
            generate_s,
            real_time_factor: generate_s / frames_to_s(n_frames).max(f64::MIN_POSITIVE),
            settings: Some(self.settings_text.clone()),
            content_hash: Some(music.content_hash.to_owned()),
            n_dancers: Some(made.n_dancers as i32),
            consistency: None,
            time: TimestampUs::now(),
        }
    }
}

/// How a motion was sampled, and how good it is.
#[derive(Clone, Copy)]
pub struct SampledMotion<'a> {
    pub sample: usize,
    pub candidate: usize,
    pub seed: u64,
    /// Name of the engine.
    pub engine: &'a str,
    pub sampler: &'a SamplerConfig,
    pub guidance: f64,
    pub n_dancers: usize,
    pub n_frames: usize,
    pub n_windows: usize,
    /// Of several dancers: the means of scores, and the sums of checks.
    pub score: &'a Score,
    /// Error of the velocity as it was decoded, m/s.
    pub velocity_error: f64,
    pub generate_s: f64,
}
