//! What an exported model says of itself, whether its files are whole, and how fast it runs here.

use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::time::Instant;

use ndarray::Array3;

use super::thousands;
use crate::autodiff::Stream;
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::generation::{LearnedFrom, ModelCard, MusicDigests, Sampling, sample};
use crate::motion::MOTION_DIM;
use crate::stages::model_files::{EngineParams, OpenModel};
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::units::frames_to_s;

/// Samplings that are timed: their step counts, 20 of DDIM and 10 of DPM-Solver++.
const TIMED: [(Sampler, usize); 2] = [(Sampler::Ddim { eta: 0.0 }, 20), (Sampler::DpmSolver, 10)];

/// The account of a model.
pub struct ModelSummary {
    card: ModelCard,
    place: String,
    engine: &'static str,
    load_s: f64,
    /// Sampler, steps, frames, and the seconds that one motion took.
    timed: Vec<(&'static str, usize, usize, f64)>,
}

/// Opens a model, looks through its files, and samples one motion of noise and silence.
///
/// # Errors
/// One sentence about what is missing, damaged or of another kind.
pub fn look(
    store: &Location,
    name: &str,
    frames: usize,
    params: &EngineParams,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let opened = OpenModel::of_store(store, name, &params.cache())?;
    let started = Instant::now();
    let (engine, note) = opened.engine(params, NonZeroUsize::MIN)?;
    let load_s = started.elapsed().as_secs_f64();
    if let Some(note) = note {
        progress.note(&note);
    }
    let card = &opened.card;
    let schedule = Schedule::new(&card.diffusion)?;
    let audio = Array3::zeros((1, frames, card.unet.condition_dim()));
    let mut timed = Vec::new();
    for (sampler, n_steps) in TIMED {
        let config = SamplerConfig {
            sampler,
            n_steps: n_steps.min(schedule.len()),
            spacing: Spacing::Trailing,
            clip: true,
        };
        let run = || -> anyhow::Result<f64> {
            let mut x = Array3::zeros((1, frames, MOTION_DIM));
            Stream::new(0, 0).normal(0, x.as_slice_mut().expect("in order"));
            let sampling = Sampling { config: &config, schedule: &schedule, guidance: 1.0 };
            let started = Instant::now();
            let latent = sample(
                &*engine,
                sampling,
                (x, schedule.len()),
                audio.view(),
                None,
                |_, _| (),
                None,
            )?;
            engine.decode(latent.view())?;
            Ok(started.elapsed().as_secs_f64())
        };
        // The first run makes buffers; of the others the best is what the machine can do.
        run()?;
        let best = (0..3).map(|_| run()).collect::<anyhow::Result<Vec<f64>>>()?;
        let best = best.into_iter().fold(f64::INFINITY, f64::min);
        timed.push((sampler.name(), config.n_steps, frames, best));
    }
    let (place, card) = (store.url_of(&crate::stages::model_files::folder_of(name)), card.clone());
    Ok(Box::new(ModelSummary { card, place, engine: engine.name(), load_s, timed }))
}

/// Counts the music that a model learned from.
fn summary_of(learned: &LearnedFrom) -> String {
    let counts = |digests: &MusicDigests| {
        let count =
            |n: usize, what| format!("{} {what}{}", thousands(n), if n == 1 { "" } else { "s" });
        format!(
            "{}, {}",
            count(digests.songs.len(), "song"),
            count(digests.phrases.len(), "phrase")
        )
    };
    format!(
        "trained on {}; validated on {}{}",
        counts(&learned.trained_on),
        counts(&learned.validated_on),
        if learned.is_complete { "" } else { "; the song of some phrases is not known" }
    )
}

impl Summary for ModelSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { card, place, engine, load_s, timed } = self;
        let provenance = &card.provenance;
        writeln!(out, "model {}, {place}\n", card.name)?;
        let row = |name: &str, value: String| format!("{name:<14}{value}");
        let lines = [
            row(
                "run",
                format!("{} ({}, step {})", provenance.run, provenance.stage, provenance.unet_step),
            ),
            row(
                "validation",
                provenance
                    .validation_loss
                    .map_or_else(|| "not known".to_owned(), |x| format!("{x:.4}")),
            ),
            row("data", provenance.data.clone()),
            row(
                "learned from",
                provenance.learned_from.as_ref().map_or_else(|| "not known".to_owned(), summary_of),
            ),
            row(
                "parameters",
                format!(
                    "{} (UNet), {} (decoder)",
                    thousands(card.n_parameters.unet),
                    thousands(card.n_parameters.decoder)
                ),
            ),
            row("precision", card.precision.name().to_owned()),
            row("window", format!("{} frames", card.window_frames)),
            row("licence", card.licence.clone()),
            row("written by", card.program.clone()),
        ];
        for line in lines {
            writeln!(out, "{line}")?;
        }
        for file in &card.files {
            let mb = file.n_bytes as f64 / 1e6;
            writeln!(
                out,
                "{:<14}{mb:.1} MB, SHA-256 {}, as it should be",
                file.name,
                &file.sha256[..16]
            )?;
        }
        writeln!(out, "\nengine {engine}, ready in {load_s:.2} s")?;
        for (sampler, n_steps, frames, seconds) in timed.iter() {
            let motion_s = frames_to_s(*frames);
            writeln!(
                out,
                "{n_steps} steps of {sampler}: {seconds:.2} s for {motion_s:.1} s of motion, {:.1} × real time",
                motion_s / seconds
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let Self { card, place, engine, load_s, timed } = self;
        let timed = timed.iter().map(|(sampler, n_steps, n_frames, took_s)| {
            serde_json::json!({
                "sampler": sampler, "n_steps": n_steps, "n_frames": n_frames, "took_s": took_s,
            })
        });
        serde_json::json!({
            "model": card.name,
            "place": place,
            "run": card.provenance.run,
            "n_parameters_unet": card.n_parameters.unet,
            "n_parameters_decoder": card.n_parameters.decoder,
            "precision": card.precision.name(),
            "engine": engine,
            "load_s": load_s,
            "timed": timed.collect::<Vec<_>>(),
        })
    }
}
