//! What an exported model says of itself, whether its files are whole, and how fast it runs here.

use std::io::{self, Write};
use std::num::NonZeroUsize;
use std::time::Instant;

use ndarray::Array3;

use super::thousands;
use crate::autodiff::Stream;
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::generation::{
    FamilyCard as _, FileEntry, LearnedFrom, MusicDigests, Sampling, SharedFields, sample,
};
use crate::motion::MOTION_DIM;
use crate::motion::style_name::NamedStyles;
use crate::stages::model_files::{EngineParams, ModelFolder, OpenModel};
use crate::stages::{Progress, Summary};
use crate::units::frames_to_s;

/// Samplings that are timed: their step counts, 20 of DDIM and 10 of DPM-Solver++.
const TIMED: [(Sampler, usize); 2] = [(Sampler::Ddim { eta: 0.0 }, 20), (Sampler::DpmSolver, 10)];

/// The account of a model of any family.
pub struct ModelSummary {
    pub name: String,
    pub place: String,
    /// What its card says, name and value.
    pub rows: Vec<(&'static str, String)>,
    pub files: Vec<FileEntry>,
    pub engine: &'static str,
    pub load_s: f64,
    pub timed: Vec<TimedWork>,
    /// Figures beside those of every family.
    pub figures: serde_json::Value,
}

/// Some work of a model, and how long it took.
pub struct TimedWork {
    /// As the account calls it.
    pub what: String,
    pub sampler: &'static str,
    pub n_steps: usize,
    pub n_frames: usize,
    pub took_s: f64,
}

/// Does a piece of work four times, and returns the least seconds: the first run makes buffers, and of the others the
/// best is what the machine can do.
///
/// # Errors
/// Errors of the work.
pub fn least_seconds(mut work: impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<f64> {
    let mut best = f64::INFINITY;
    for i in 0..4 {
        let started = Instant::now();
        work()?;
        if i > 0 {
            best = best.min(started.elapsed().as_secs_f64());
        }
    }
    Ok(best)
}

/// Returns what a model says of styles.
pub fn style(style_dim: usize, named: &NamedStyles) -> String {
    if style_dim == 0 {
        return "takes none".to_owned();
    }
    let names: Vec<&str> = named.keys().map(String::as_str).collect();
    match names.as_slice() {
        [] => "eight values; none has a name".to_owned(),
        names => format!("eight values, or {}", names.join(", ")),
    }
}

/// Opens a model, looks through its files, and samples one motion of noise and silence.
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
    let opened = OpenModel::of(files)?;
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
        let took_s = least_seconds(|| {
            let mut x = Array3::zeros((1, frames, MOTION_DIM));
            Stream::new(0, 0).normal(0, x.as_slice_mut().expect("in order"));
            let sampling = Sampling { config: &config, schedule: &schedule, guidance: 1.0 };
            let start = (x, schedule.len());
            let latent = sample(&*engine, sampling, start, audio.view(), None, |_, _| (), None)?;
            engine.decode(latent.view())?;
            Ok(())
        })?;
        let (sampler, n_steps) = (sampler.name(), config.n_steps);
        let what = format!("{n_steps} steps of {sampler}");
        timed.push(TimedWork { what, sampler, n_steps, n_frames: frames, took_s });
    }
    let provenance = &card.provenance;
    let rows = vec![
        (
            "run",
            format!("{} ({}, step {})", provenance.run, provenance.stage, provenance.unet_step),
        ),
        ("validation", validation(provenance.validation_loss)),
        ("data", provenance.data.clone()),
        ("learned from", learned(provenance.learned_from.as_ref())),
        (
            "parameters",
            format!(
                "{} (UNet), {} (decoder)",
                thousands(card.n_parameters.unet),
                thousands(card.n_parameters.decoder)
            ),
        ),
        ("style", style(card.unet.style_dim, &card.styles)),
    ];
    Ok(Box::new(ModelSummary {
        name: card.name.clone(),
        place,
        rows: [rows, shared_rows(card.shared())].concat(),
        files: card.files.clone(),
        engine: engine.name(),
        load_s,
        timed,
        figures: serde_json::json!({
            "run": provenance.run,
            "n_parameters_unet": card.n_parameters.unet,
            "n_parameters_decoder": card.n_parameters.decoder,
            "precision": card.precision.name(),
        }),
    }))
}

/// Returns a validation loss as the account has it.
pub fn validation(loss: Option<f64>) -> String {
    loss.map_or_else(|| "not known".to_owned(), |x| format!("{x:.4}"))
}

/// Returns the music that a model learned from as the account has it.
pub fn learned(from: Option<&LearnedFrom>) -> String {
    from.map_or_else(|| "not known".to_owned(), summary_of)
}

/// Returns what cards of every family say, behind what they say of their runs and networks.
pub fn shared_rows(card: SharedFields) -> Vec<(&'static str, String)> {
    vec![
        ("precision", card.precision.name().to_owned()),
        ("window", format!("{} frames", card.window_frames)),
        ("licence", card.licence.to_owned()),
        ("written by", card.program.to_owned()),
    ]
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
        let Self { name, place, rows, files, engine, load_s, timed, .. } = self;
        writeln!(out, "model {name}, {place}\n")?;
        for (name, value) in rows {
            writeln!(out, "{name:<14}{value}")?;
        }
        for file in files {
            let mb = file.n_bytes as f64 / 1e6;
            writeln!(
                out,
                "{:<20}{mb:.1} MB, SHA-256 {}, as it should be",
                file.name,
                &file.sha256[..16]
            )?;
        }
        writeln!(out, "\nengine {engine}, ready in {load_s:.2} s")?;
        for TimedWork { what, n_frames, took_s, .. } in timed {
            let motion_s = frames_to_s(*n_frames);
            writeln!(
                out,
                "{what}: {took_s:.2} s for {motion_s:.1} s of motion, {:.1} × real time",
                motion_s / *took_s
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let Self { name, place, engine, load_s, timed, figures, .. } = self;
        let timed = timed.iter().map(|TimedWork { sampler, n_steps, n_frames, took_s, .. }| {
            serde_json::json!({
                "sampler": sampler, "n_steps": n_steps, "n_frames": n_frames, "took_s": took_s,
            })
        });
        let mut all = serde_json::json!({
            "model": name,
            "place": place,
            "engine": engine,
            "load_s": load_s,
            "timed": timed.collect::<Vec<_>>(),
        });
        if let (Some(all), serde_json::Value::Object(figures)) = (all.as_object_mut(), figures) {
            all.append(figures);
        }
        all
    }
}
