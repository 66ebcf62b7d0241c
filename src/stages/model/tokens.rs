//! What a model of the family `tokens` says of itself, whether its files are whole, and how fast it runs here.

use std::num::NonZeroUsize;
use std::time::Instant;

use ndarray::{Array2, Array3};

use super::exported::{
    ModelSummary, TimedWork, learned, least_seconds, shared_rows, style, validation,
};
use super::thousands;
use crate::autodiff::Stream;
use crate::diffusion::{SamplerConfig, Schedule, TokenSampling};
use crate::generation::{FamilyCard as _, PlanRequest};
use crate::model::PlannerKind;
use crate::motion::MOTION_DIM;
use crate::stages::model_files::{EngineParams, ModelFolder};
use crate::stages::tokens_model::{OpenTokens, TokenEngines};
use crate::stages::{Progress, Summary};

/// Opens a model, looks through its files, plans one motion for silence, and makes it of noise.
///
/// # Errors
/// One sentence about what is missing, damaged or of another kind.
pub fn look(
    files: ModelFolder,
    frames: usize,
    params: &EngineParams,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let place = files.place().to_owned();
    let opened = OpenTokens::of(files)?;
    opened.verify()?;
    let started = Instant::now();
    let TokenEngines { tokens, planner, note } = opened.engines(params, NonZeroUsize::MIN)?;
    let load_s = started.elapsed().as_secs_f64();
    if let Some(note) = note {
        progress.note(&note);
    }
    let card = &opened.card;
    let schedule = Schedule::new(&card.diffusion)?;
    let silence = Array2::zeros((frames, card.planner.condition().dim()));
    let plan = TokenSampling::default();
    let request = PlanRequest {
        condition: silence.view(),
        style: None,
        constraints: None,
        given: &[],
        guidance: card.guidance(),
        seed: 0,
        window: 0,
    };
    let mut planned = Vec::new();
    let plan_s = least_seconds(|| {
        planned = planner.plan(&plan, &request)?;
        Ok(())
    })?;
    let sampler = SamplerConfig::fast27();
    let decode_s = least_seconds(|| {
        let mut x = Array3::zeros((1, frames, MOTION_DIM));
        Stream::new(0, 0).normal(0, x.as_slice_mut().expect("in order"));
        tokens.decode(&planned, x, (&sampler, &schedule), |_, z| z.fill(0.0), None)?;
        Ok(())
    })?;
    let iterations = match card.planner.kind {
        PlannerKind::Masked => plan.n_iterations,
        PlannerKind::Autoregressive => planned.len(),
    };
    let of_plan = match card.planner.kind {
        PlannerKind::Masked => format!("{} tokens in {iterations} iterations", planned.len()),
        PlannerKind::Autoregressive => format!("{} tokens one after the other", planned.len()),
    };
    let name = sampler.sampler.name();
    let timed = vec![
        TimedWork {
            what: of_plan,
            sampler: card.planner.kind.name(),
            n_steps: iterations,
            n_frames: frames,
            took_s: plan_s,
        },
        TimedWork {
            what: format!("{} steps of {name}", sampler.n_steps),
            sampler: name,
            n_steps: sampler.n_steps,
            n_frames: frames,
            took_s: decode_s,
        },
    ];
    let from = &card.provenance;
    let (sizes, counts) = (&card.tokens, &card.n_parameters);
    let rows = vec![
        (
            "run",
            format!("{} (planner, {}, step {})", from.run, card.planner.kind.name(), from.step),
        ),
        ("tokenizer", from.tokenizer.clone()),
        ("validation", validation(from.validation_loss)),
        ("data", from.data.clone()),
        ("learned from", learned(from.learned_from.as_ref())),
        (
            "parameters",
            format!(
                "{} (tokenizer), {} (planner)",
                thousands(counts.tokenizer),
                thousands(counts.planner)
            ),
        ),
        ("tokens", format!("{}, one for {} frames", sizes.codes, sizes.frames_per_token)),
        ("style", style(card.planner.style_dim, &card.styles)),
    ];
    Ok(Box::new(ModelSummary {
        name: card.name.clone(),
        place,
        rows: [rows, shared_rows(card.shared())].concat(),
        files: card.files.clone(),
        engine: tokens.name(),
        load_s,
        timed,
        figures: serde_json::json!({
            "run": from.run,
            "tokenizer": from.tokenizer,
            "planner": card.planner.kind.name(),
            "n_parameters_tokenizer": counts.tokenizer,
            "n_parameters_planner": counts.planner,
            "precision": card.precision.name(),
        }),
    }))
}
