//! `generate`: music becomes motion, in the tables `generated`, `decoded` and `generations`, or in files.

mod constraints_file;
mod constraints_text;
mod dancers;
mod files;
mod group;
mod identity;
mod maker;
mod music;
mod outputs;
mod params;
mod path_file;
mod receipt;
mod report;
mod settings;
mod survey;
mod tokens;
mod tracks;

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::bail;

use super::failure::Failure;
use super::model_files::{
    EngineChoice, EngineParams, ModelFolder, OpenModel, is_model_name, sha256,
};
use super::retrieval::Primer;
use super::{Contract, Progress, Stage, Summary};
use crate::diffusion::Schedule;
use crate::generation::{Engine, Generator, ModelCard, Sampling, TokensCard, file_names};
use crate::model::Family;
use crate::store::{Location, Shard};
use crate::units::frames_to_s;

use identity::RunIdentity;
use maker::{GeneratedMotion, MotionMaker, SoloistMaker};
use params::Settings;
pub use params::{Params, SamplerName, Tracks};
use report::{GeneratePlace, GenerateSummary};

pub(in crate::stages) use constraints_text::keyframes_of;
pub(in crate::stages) use files::listen;
pub(in crate::stages) use group::{GroupSettings, parameters as group_parameters};
pub(in crate::stages) use maker::{generation_id, seed_of};
pub(in crate::stages) use params::PostProcessParams;
pub(in crate::stages) use settings::MotionSettings;
pub(in crate::stages) use survey::{SurveyedRun, runs, survey};
pub(in crate::stages) use tokens::TokensSettings;
pub(in crate::stages) use tracks::url_of;

/// The stage.
pub struct Generate;

impl Stage for Generate {
    const NAME: &'static str = "generate";
    const ABOUT: &'static str = "make motion for music of any length";
    const CONTRACT: Contract = Contract {
        reads: "models/MODEL; phrases, features, extractions, beats, or audio files",
        writes: "generated, decoded, generations, failures, or files",
    };
    type Params = Params;

    fn claims_stdout(params: &Params) -> Option<&'static str> {
        (params.stream.as_deref() == Some("-")).then_some("--stream")
    }

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        let store = match &params.store {
            Some(url) => Some(Location::open(url, &params.client.options())?),
            None => None,
        };
        let files = open_model(&params, store.as_ref())?;
        if let Some(n) = params.window.filter(|_| files.family() != Family::Tokens) {
            bail!(
                "--window {n}: {} is a model of the family {}, whose windows are as long as in training; leave it \
                 out, or name a model of the family tokens",
                files.place(),
                files.family().name()
            );
        }
        if files.family() == Family::Group {
            return group::run(&params, store.as_ref(), files, progress);
        }
        if files.family() == Family::Tokens {
            return tokens::run(&params, store.as_ref(), files, progress);
        }
        let model = OpenModel::of(files)?;
        group::refuse_for_soloists(&params, &model.card.name)?;
        let mut settings = Settings::new(&params, &model.card)?;
        let primer = match (params.prime, &store) {
            (None, _) => None,
            (Some(_), None) => bail!(
                "--prime begins from the motion of a library, and there is none without --store; name the \
                 store of one, or leave --prime out"
            ),
            (Some(strength), Some(store)) => {
                let threads = params.engine.threads;
                let primer = Primer::read(store, model.card.window_frames, threads)?;
                settings.begin_from(strength, &primer.fingerprint, &model.card)?;
                Some(primer)
            }
        };
        let name = name_of_model(&params, &model.card.name);
        let run = run_name(&params, &name)?;
        let (engine, note): (Box<dyn Engine>, _) =
            model.engine(&engine_params(&params), n_workers(&params))?;
        if let Some(note) = note {
            progress.note(&note);
        }
        let schedule = Schedule::new(&model.card.diffusion)?;
        let card = &model.card;
        let weights = weights_digest(card);
        let row = settings.to_row();
        let identity = RunIdentity {
            settings_digest: settings.digest(&weights),
            ..RunIdentity::new((&name, &weights, &run), settings.seed, &row)
        };
        let sampling = Sampling {
            config: &settings.sampler,
            schedule: &schedule,
            guidance: settings.guidance,
        };
        let maker = SoloistMaker {
            generator: Generator {
                engine: &*engine,
                sampling,
                normalizer: &card.normalizer,
                window_frames: card.window_frames,
                overlap_frames: settings.overlap_frames,
            },
            card,
            identity,
            settings: &settings,
            primer: primer.as_ref(),
        };
        let (place, done) =
            make_all(&params, store.as_ref(), &maker, engine.n_workers(), progress)?;
        let took_s = started.elapsed().as_secs_f64();
        let by_card = match name == card.name {
            true => String::new(),
            false => format!(" (its card calls it {})", card.name),
        };
        let made_with = format!(
            "model {name}{by_card}, {} ({}), {} in {} steps, guidance {}",
            engine.name(),
            engine.n_workers(),
            settings.sampler.sampler.name(),
            settings.sampler.n_steps,
            settings.guidance
        );
        Ok(Box::new(GenerateSummary {
            place,
            done,
            model: name,
            made_with,
            dry_run: params.dry_run,
            took_s,
        }))
    }
}

/// Returns the name of the generation, that of the model unless the user gives one.
///
/// # Errors
/// A name that could not be a folder.
fn run_name(params: &Params, model: &str) -> anyhow::Result<String> {
    let run = params.run.clone().unwrap_or_else(|| model.to_owned());
    super::train::session::check_run_name(&run)?;
    Ok(run)
}

/// Returns how many motions are made at once: a single track is fastest with all threads in one worker; many keep a
/// worker each busy.
fn n_workers(params: &Params) -> NonZeroUsize {
    let is_single = params.audio.len() == 1 || params.phrase.len() == 1;
    if is_single { NonZeroUsize::MIN } else { params.engine.threads }
}

/// Returns which engine is opened; in a dry run the one that keeps no prepared copy of a model.
fn engine_params(params: &Params) -> EngineParams {
    match params.dry_run {
        true => EngineParams { engine: EngineChoice::Eager, ..params.engine.clone() },
        false => params.engine.clone(),
    }
}

/// Makes every motion that is asked for, in files or in tables.
fn make_all(
    params: &Params,
    store: Option<&Location>,
    maker: &dyn MotionMaker,
    n_workers: usize,
    progress: &dyn Progress,
) -> anyhow::Result<(GeneratePlace, GenerateTally)> {
    let n_samples = params.samples.get();
    match (&params.output, store) {
        (Some(folder), _) => {
            let target = files::FolderTarget {
                audio: &params.audio,
                folder,
                formats: &params.format,
                stream: params.stream.as_deref(),
                stream_format: params.stream_format,
                n_samples,
                dry_run: params.dry_run,
                force: params.force,
            };
            Ok((GeneratePlace::Folder(folder.clone()), files::run(maker, &target, progress)?))
        }
        (None, Some(store)) => {
            let target = tracks::TrackTarget {
                store,
                shard: Shard::parse(&params.shard, |name| std::env::var(name).ok())?,
                params_hash: &maker.identity().settings_digest,
                force: params.force,
                dry_run: params.dry_run,
                tracks: params.tracks,
                split: params.split.as_deref(),
                phrases: &params.phrase,
                n_samples,
                n_workers: NonZeroUsize::new(n_workers).unwrap_or(NonZeroUsize::MIN),
            };
            let run = maker.identity().run.clone();
            let place = GeneratePlace::Store { store: store.to_string(), run };
            Ok((place, tracks::run(maker, &target, progress)?))
        }
        (None, None) => bail!("nothing to do: give --store, or --audio with --output"),
    }
}

/// Opens the model of a store, or in a folder.
fn open_model(params: &Params, store: Option<&Location>) -> anyhow::Result<ModelFolder> {
    match &params.model {
        None => ModelFolder::shipped(group::shipped_for(params)),
        Some(model) => ModelFolder::named(model, store, &params.engine.cache()),
    }
}

/// Returns what a model is called: as the user typed it, whatever its card says; a folder by its own name.
fn name_of_model(params: &Params, name_of_card: &str) -> String {
    let Some(typed) = &params.model else { return name_of_card.to_owned() };
    let folder = Path::new(typed);
    if !folder.join(file_names::CARD).is_file() {
        return typed.clone();
    }
    let absolute = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let name = absolute.file_name().map(|name| name.to_string_lossy().into_owned());
    // A folder may be called what no model can be.
    name.filter(|name| is_model_name(name)).unwrap_or_else(|| name_of_card.to_owned())
}

/// Returns one digest for both networks of a model.
pub(in crate::stages) fn weights_digest(card: &ModelCard) -> String {
    let both = format!("{}\n{}\n", card.weights_sha256.unet, card.weights_sha256.decoder);
    sha256(both.as_bytes())
}

/// Returns one digest for both networks of a model of tokens.
pub(in crate::stages) fn weights_digest_of_tokens(card: &TokensCard) -> String {
    let both = format!("{}\n{}\n", card.weights_sha256.tokenizer, card.weights_sha256.planner);
    sha256(both.as_bytes())
}

/// Counts of the motions that were generated, unchanged or failed.
#[derive(Debug, Default)]
struct GenerateTally {
    n_todo: u64,
    todo_s: f64,
    n_unchanged: u64,
    n_made: u64,
    made_s: f64,
    n_frames: u64,
    n_candidates: u64,
    n_checks_failed: u64,
    /// Frames that were fused.
    n_fused: u64,
    /// Sum over them of the squared shift of the position, mm².
    fused_mm2: f64,
    /// Of the frame that was moved farthest.
    fused_max_mm: f64,
    is_interrupted: bool,
    /// A line on each motion that was written to files, and the files.
    told: Vec<(String, Vec<PathBuf>)>,
    failed: Vec<(String, Failure)>,
}

impl GenerateTally {
    fn add_made(&mut self, made: &GeneratedMotion) {
        self.n_made += 1;
        self.n_frames += (made.frames.dim().0 * made.n_frames()) as u64;
        self.made_s += frames_to_s(made.n_frames());
        self.n_candidates += made.rows.len() as u64;
        let failed = made.rows.iter().any(|row| row.selected && row.checks_passed < row.n_checks);
        self.n_checks_failed += u64::from(failed);
        if let Some(moved) = made.displacement {
            let n_frames = made.frames.dim().0 * made.n_frames();
            self.n_fused += n_frames as u64;
            self.fused_mm2 += n_frames as f64 * moved.position_rms_mm.powi(2);
            self.fused_max_mm = self.fused_max_mm.max(moved.position_max_mm);
        }
    }

    fn add(&mut self, outcomes: &BTreeMap<String, Result<GeneratedMotion, Failure>>) {
        for (name, outcome) in outcomes {
            match outcome {
                Ok(made) => self.add_made(made),
                Err(failure) => self.failed.push((name.clone(), failure.clone())),
            }
        }
    }
}
