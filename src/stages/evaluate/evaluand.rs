//! What is evaluated: the motions of a run of generate, or those of any program.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use anyhow::{Context as _, bail, ensure};
use ndarray::Array2;

use super::foreign::{self, ForeignMotions, RefusedFile};
use super::job::{EvaluatedMotion, EvaluationJob, EvaluationMotion, MotionStage};
use super::making::{Making, keyframes};
use super::measure::{MeasuredMotion, stride_for};
use super::motions::{self, PhraseIndex, is_held_out};
use super::params::Params;
use super::rows::{self, EvaluationRows, RunName};
use super::splits::{MusicSplit, splits_of, telling};
use super::truth::{self, Truth};
use crate::evaluation::keyframe::{KeyframeMisses, keyframe_misses};
use crate::evaluation::metrics::PhaseOrigin;
use crate::evaluation::window::own_window_frames;
use crate::evaluation::{holds_by_construction, holds_by_derivation};
use crate::motion::postprocess::PostProcessConfig;
use crate::stages::Progress;
use crate::stages::motion_source::generated_frames;
use crate::store::tables::{self, GenerationRow};
use crate::store::{
    Location, StoreError, StoreSnapshot, digest, outdated_features, outdated_generations,
};
use crate::units::frames_to_s;

/// Songs whose activity is read; that of others counts as its mean.
const MAX_HEARD_SONGS: usize = 500;

/// The motions to evaluate: those of a run, or of a folder.
pub struct Evaluand {
    pub run: String,
    pub model: String,
    pub phrases: PhraseIndex,
    pub motions: Vec<EvaluationMotion>,
    /// What generate said of them, in the same order; none of motions of another program.
    pub generations: Vec<GenerationRow>,
    /// Candidates that each motion was chosen from, at most.
    pub n_candidates: usize,
    /// What is to be known beside the numbers.
    pub notes: Vec<String>,
    /// Files that hold no motion.
    pub refused: Vec<RefusedFile>,
    /// Lengths of the motions, frames.
    n_frames: Vec<usize>,
    /// How motions were processed; nothing was done to those of another program.
    postprocess: PostProcessConfig,
    /// Whether decoded motion agrees with itself by construction.
    decoder_derives: bool,
    /// Whether decoded motion has the phase of its music by construction.
    phase_given: bool,
    /// Files of motions of another program.
    files: Option<ForeignMotions>,
    /// Whether motions say a phase.
    has_phase: bool,
    /// The tables as they are for the whole evaluation.
    pub(super) snapshot: StoreSnapshot,
}

impl Evaluand {
    /// Reads what the user wants to be evaluated.
    ///
    /// # Errors
    /// When the store cannot be read, or one sentence where there are no motions.
    pub fn read(store: &Location, params: &Params) -> anyhow::Result<Self> {
        let snapshot = StoreSnapshot::take(store)?;
        match (&params.run, &params.motions) {
            (Some(run), _) => Self::of_run(snapshot, run, params.num_samples.map(Into::into)),
            (None, Some(folder)) => Self::of_folder(snapshot, folder, params),
            (None, None) => bail!(
                "give --run NAME, --motions DIR for those of another program, or --tokenizer RUN"
            ),
        }
    }

    /// Reads what is known of the motions of a run, at most `most` of them.
    ///
    /// # Errors
    /// When the store cannot be read, or one sentence where there are no motions.
    pub fn of_run(snapshot: StoreSnapshot, run: &str, most: Option<usize>) -> anyhow::Result<Self> {
        let store = snapshot.store();
        let (generations, n_groups) = motions::of_run(&snapshot, run, most)?;
        let phrases =
            PhraseIndex::read(&snapshot, generations.iter().map(|row| row.phrase_id.as_str()))?;
        refuse_outdated(&snapshot, run, &phrases, &generations)?;
        let (splits, mut notes) = splits_of(store, &phrases, &generations)?;
        if n_groups > 0 {
            notes.push(format!(
                "{n_groups} motions of groups of dancers are left out; what is measured is a soloist's."
            ));
        }
        let motions: anyhow::Result<Vec<EvaluationMotion>> = generations
            .iter()
            .zip(splits)
            .map(|(row, split)| {
                Ok(EvaluationMotion {
                    phrase_id: row.phrase_id.clone(),
                    sample: row.sample,
                    split,
                    misses: [row.control_error_mm, row.control_error_deg],
                    keyframes: keyframes(row)?,
                })
            })
            .collect();
        let motions = motions?;
        let settings: Vec<Making> = generations.iter().filter_map(Making::of_row).collect();
        Ok(Self {
            run: run.to_owned(),
            model: generations[0].model.clone(),
            phrases,
            motions,
            n_candidates: settings.iter().map(|settings| settings.n_candidates).max().unwrap_or(1),
            notes,
            refused: Vec::new(),
            n_frames: generations
                .iter()
                .map(|row| usize::try_from(row.n_frames).unwrap_or(0))
                .collect(),
            decoder_derives: settings.iter().any(|settings| settings.decoder_derives),
            phase_given: settings.iter().any(|settings| settings.phase_given),
            postprocess: settings.into_iter().next().map(|s| s.postprocess).unwrap_or_default(),
            generations,
            files: None,
            has_phase: true,
            snapshot,
        })
    }

    /// Reads the names of the files of a folder; motions are read when they are measured.
    fn of_folder(snapshot: StoreSnapshot, folder: &Path, params: &Params) -> anyhow::Result<Self> {
        let store = snapshot.store();
        let named = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
        let absolute = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        let Some(run) = params.name.clone().or_else(|| named(&absolute)) else {
            bail!("--motions {} has no name; give one with --name", folder.display());
        };
        crate::stages::train::session::check_run_name(&run)
            .with_context(|| format!("--name {run}"))?;
        let known = motions::has_run(&snapshot, &run)?;
        ensure!(
            !known,
            "store {store} has a run \"{run}\" of generate, whose evaluation this one would replace; give \
             another --name"
        );
        let all = PhraseIndex::read(&snapshot, [])?;
        let mut files = foreign::read(folder, &all.foreign_phrases())?;
        if let Some(n) = params.num_samples {
            files.keep(n.get());
        }
        let phrases =
            PhraseIndex::read(&snapshot, files.files.iter().map(|file| file.phrase_id.as_str()))?;
        let mut refused = RefusedFile::all(folder, std::mem::take(&mut files.failures));
        // A look at every file, so that what holds no motion is known before the others are measured.
        let (mut motions, mut n_frames, mut notes) = (Vec::new(), Vec::new(), Vec::new());
        let mut has_phase = true;
        let mut derived: BTreeMap<&'static str, usize> = BTreeMap::new();
        let mut read = Vec::new();
        for file in std::mem::take(&mut files.files) {
            match file.read() {
                Ok(motion) => {
                    motions.push(EvaluationMotion {
                        phrase_id: file.phrase_id.clone(),
                        sample: i32::try_from(file.sample).unwrap_or(i32::MAX),
                        split: MusicSplit::Unknown,
                        misses: [None; 2],
                        keyframes: Vec::new(),
                    });
                    n_frames.push(motion.frames.nrows());
                    has_phase &= motion.has_phase;
                    if let Some(what) = motion.content.derived() {
                        *derived.entry(what).or_default() += 1;
                    }
                    notes.extend(motion.note);
                    read.push(file);
                }
                Err(failure) => refused.extend(RefusedFile::all(folder, [(file.path, failure)])),
            }
        }
        files.files = read;
        ensure!(
            !motions.is_empty(),
            "--motions {} has no file that holds a motion for a phrase of the store: {}",
            folder.display(),
            refused.first().map_or_else(|| "it is empty".to_owned(), |r| r.failure.message.clone())
        );
        notes.truncate(MAX_NOTES);
        notes.extend(derived.into_iter().map(|(what, n)| format!("Of {n} files {what}.")));
        notes.push(
            "Nobody knows which of these songs the motions were learned from, since another program made them."
                .to_owned(),
        );
        Ok(Self {
            run,
            model: String::new(),
            phrases,
            motions,
            generations: Vec::new(),
            n_candidates: 1,
            notes,
            refused,
            n_frames,
            postprocess: PostProcessConfig::nothing(),
            decoder_derives: false,
            phase_given: false,
            files: Some(files),
            has_phase,
            snapshot,
        })
    }

    /// Returns the length of all motions together, s.
    pub fn length_s(&self) -> f64 {
        frames_to_s(self.n_frames.iter().sum())
    }

    /// Reads the frames of a motion.
    ///
    /// # Errors
    /// One sentence where it is not there any more.
    pub fn frames(&self, store: &Location, i: usize) -> anyhow::Result<Array2<f32>> {
        if let Some(files) = &self.files {
            let file = files.files.get(i).context("motions changed while they were evaluated")?;
            return match file.read() {
                Ok(motion) => Ok(motion.frames),
                Err(failure) => bail!(failure.message),
            };
        }
        let motion = &self.motions[i];
        let sample = usize::try_from(motion.sample).unwrap_or(0);
        generated_frames(store, &self.run, &motion.phrase_id, sample)
    }

    /// Returns a digest of the motions, of the splits that they are in, and of real motion.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn input_hash(&self, data_hash: &str) -> anyhow::Result<String> {
        let mut text = data_hash.to_owned();
        for (row, motion) in self.generations.iter().zip(&self.motions) {
            text.push_str(&format!(
                "\n{} {} {} {} {}",
                row.generation,
                row.candidate,
                row.weights,
                row.time.0,
                motion.split.name()
            ));
        }
        for file in self.files.iter().flat_map(|files| &files.files) {
            let bytes = std::fs::read(&file.path)
                .with_context(|| format!("while reading {}", file.path.display()))?;
            text.push_str(&format!("\n{} {} {}", file.phrase_id, file.sample, digest(&bytes)));
        }
        for refused in &self.refused {
            text.push_str(&format!("\n{} {}", refused.name, refused.failure.message));
        }
        Ok(digest(text.as_bytes()))
    }

    /// Measures the motions, and all that they are compared with.
    ///
    /// # Errors
    /// When the store cannot be read, or motions changed meanwhile.
    pub fn evaluate(
        &mut self,
        store: &Location,
        params: &Params,
        data_hash: &str,
        progress: &dyn Progress,
    ) -> anyhow::Result<EvaluationRows> {
        let truth = match params.quick {
            true => None,
            false => truth::read(&self.snapshot, data_hash, params.threads, progress)?,
        };
        if let Some(truth) = &truth {
            self.hear(truth)?;
        }
        let told = telling(self.motions.iter().map(|motion| motion.split));
        let sampled = match (params.quick, told) {
            (false, Some(split)) => self.sampled(store, params, truth.as_ref(), split, progress)?,
            _ => None,
        };
        let has_music = self.phrases.has_beats();
        let holds = |check: &str| holds_by_construction(check, &self.postprocess, has_music);
        let job = EvaluationJob {
            params,
            snapshot: &self.snapshot,
            motions: &self.motions,
            phrases: &self.phrases,
            truth: truth.as_ref(),
            window_frames: self.window_frames(truth.as_ref()),
            phase: match (self.has_phase, self.postprocess.relock_phase) {
                (false, _) => PhaseOrigin::Absent,
                (true, true) => PhaseOrigin::Relocked,
                (true, false) => PhaseOrigin::Own,
            },
            has_raw: self.files.is_none(),
            has_network: self.files.is_none(),
            sampled_split: told,
        };
        let evaluated = self.measured(store, &job, progress)?;
        let name = RunName { run: &self.run, model: &self.model };
        let mut rows = EvaluationRows::default();
        for (motion, found) in self.motions.iter().zip(&evaluated) {
            let (id, sample) = (motion.phrase_id.as_str(), motion.sample);
            if let Some(decoded) = &found.decoded {
                let has_phase = self.phase_given && has_music;
                let derived = |check: &str| match check {
                    "phase" | "phase_monotonic" => has_phase,
                    // The decoder's turn rates are exact below a quarter turn a frame alone.
                    "angular_velocity" => false,
                    check => self.decoder_derives && holds_by_derivation(check),
                };
                let raw =
                    rows::checks(name, id, sample, MotionStage::Raw, &decoded.checks, &derived);
                rows.checks.extend(raw);
            }
            let is = rows::checks(name, id, sample, MotionStage::Final, &found.is.checks, &holds);
            rows.checks.extend(is);
        }
        if !params.quick {
            let sampled = sampled.unwrap_or_default();
            let found = job.numbers(&evaluated, &sampled, progress)?;
            rows.add(name, found, &|song| self.phrases.song_name(song));
        }
        Ok(rows)
    }

    /// Returns the frames of a window: as many for all that is compared.
    pub(super) fn window_frames(&self, truth: Option<&Truth>) -> usize {
        truth.map_or_else(
            || own_window_frames(self.n_frames.iter().copied()),
            |truth| truth.statistics.window_frames,
        )
    }

    /// Reads the activity of the songs that were danced to, and of those with held-out real motion.
    fn hear(&mut self, truth: &Truth) -> anyhow::Result<()> {
        let held_out = truth.phrases.iter().filter(|phrase| is_held_out(phrase.split));
        let ids = self.motions.iter().map(|motion| motion.phrase_id.as_str());
        let songs = self.phrases.songs_of(ids.chain(held_out.map(|phrase| phrase.id.as_str())));
        let songs: BTreeSet<String> = songs.into_iter().take(MAX_HEARD_SONGS).collect();
        let motions = self.motions.iter().map(|motion| motion.phrase_id.as_str());
        let real = truth.phrases.iter().map(|phrase| phrase.id.as_str());
        let used: BTreeSet<&str> =
            motions.chain(real).chain(songs.iter().map(String::as_str)).collect();
        let rows = used.into_iter().filter_map(|id| self.phrases.row(id));
        if let Some(first) = outdated_features(&self.snapshot, rows)?.first() {
            bail!(
                "phrase {first}: its features are of a file that was replaced since; run motiongen extract \
                 --store {} first",
                self.snapshot.store()
            );
        }
        let mut heard: Vec<(String, Array2<f32>)> = Vec::new();
        self.snapshot.table(tables::features())?.visit_items(&songs, |id, features| {
            heard.push((id.to_owned(), features));
            Ok::<_, StoreError>(())
        })?;
        for (id, features) in heard {
            self.phrases.add_features(&id, features.view());
        }
        Ok(())
    }

    /// Reads and measures the motions, as they are and as they were decoded.
    fn measured(
        &self,
        store: &Location,
        job: &EvaluationJob,
        progress: &dyn Progress,
    ) -> anyhow::Result<Vec<EvaluatedMotion>> {
        let stride = stride_for(self.n_frames.iter().sum());
        let measurer = job.measurer(stride);
        progress.start("evaluate", "motions", self.motions.len() as u64);
        if let Some(files) = &self.files {
            let found = measurer.run(files.files.len(), |give| {
                for (i, file) in files.files.iter().enumerate() {
                    let motion = file.read().map_err(|failure| anyhow::anyhow!(failure.message))?;
                    give(i, motion.frames);
                    progress.advance(1);
                }
                anyhow::Ok(())
            })?;
            progress.finish();
            return Ok(found
                .into_iter()
                .flatten()
                .map(|is| EvaluatedMotion {
                    is,
                    decoded: None,
                    keyframes: KeyframeMisses::default(),
                })
                .collect());
        }
        let places: BTreeMap<&str, usize> =
            self.generations.iter().map(|row| row.generation.as_str()).zip(0..).collect();
        let names: BTreeSet<String> =
            self.generations.iter().map(|row| row.generation.clone()).collect();
        let read = |schema,
                    look: &mut dyn FnMut(usize, &Array2<f32>)|
         -> Result<Vec<Option<MeasuredMotion>>, StoreError> {
            let table = self.snapshot.table(schema)?;
            measurer.run(self.motions.len(), |give| {
                table.visit_items(&names, |name, frames: Array2<f32>| {
                    if let Some(&i) = places.get(name) {
                        look(i, &frames);
                        give(i, frames);
                    }
                    Ok::<_, StoreError>(())
                })
            })
        };
        let decoded = read(tables::decoded(), &mut |_, _| ())?;
        let mut keyframes = vec![KeyframeMisses::default(); self.motions.len()];
        let is = read(tables::generated(), &mut |i, frames| {
            keyframes[i] = keyframe_misses(frames.view(), &self.motions[i].keyframes);
            progress.advance(1);
        })?;
        progress.finish();
        let missing = self.generations.iter().zip(&is).find(|(_, found)| found.is_none());
        if let Some((row, _)) = missing {
            bail!(
                "store {store} has no frames of {}, though it lists the motion; run motiongen generate \
                 again with --force",
                row.generation
            );
        }
        Ok(is
            .into_iter()
            .flatten()
            .zip(decoded)
            .zip(keyframes)
            .map(|((is, decoded), keyframes)| EvaluatedMotion { is, decoded, keyframes })
            .collect())
    }
}

/// Refuses motions that were made for other music than their phrases have now.
fn refuse_outdated(
    snapshot: &StoreSnapshot,
    run: &str,
    phrases: &PhraseIndex,
    generations: &[GenerationRow],
) -> anyhow::Result<()> {
    let content_of = |id: &str| phrases.row(id).map(|row| row.content_hash.as_str());
    let outdated = outdated_generations(snapshot, generations, content_of)?;
    let store = snapshot.store();
    if let Some(first) = outdated.first() {
        bail!(
            "store {store}: {} of {} motions of run \"{run}\" were made for files that were replaced since; run \
             motiongen extract and generate again. The first: {first}",
            outdated.len(),
            generations.len()
        );
    }
    Ok(())
}

/// Notes on single files that are told; the table of failures has all that were refused.
const MAX_NOTES: usize = 5;
