//! What is evaluated: the motions of a run of generate, or those of any program.

mod folder;
mod measured;

use std::collections::BTreeSet;

use anyhow::{Context as _, bail};
use ndarray::{Array2, Axis};

use super::foreign::{ForeignMotions, RefusedFile};
use super::group::GroupMeasurer;
use super::job::{EvaluatedMotion, EvaluationJob, EvaluationMotion, MotionStage};
use super::making::{Making, keyframes};
use super::measure::over_dancers;
use super::motions::{self, PhraseIndex, is_held_out};
use super::params::Params;
use super::rows::{self, EvaluationRows, RunName};
use super::splits::{splits_of, telling};
use super::truth::{self, Truth};
use crate::evaluation::metrics::PhaseOrigin;
use crate::evaluation::window::own_window_frames;
use crate::evaluation::{Check, holds_by_construction, holds_by_derivation};
use crate::motion::group::MAX_DANCERS;
use crate::motion::postprocess::PostProcessConfig;
use crate::stages::Progress;
use crate::stages::motion_source::generated_group;
use crate::store::tables::{self, GenerationRow};
use crate::store::{
    Location, StoreError, StoreSnapshot, digest, outdated_features, outdated_generations,
};
use crate::training::Ensemble;
use crate::units::frames_to_s;

/// Songs whose activity is read; that of others counts as its mean.
const MAX_HEARD_SONGS: usize = 500;

/// The motions to evaluate: those of a run, or of a folder.
pub struct Evaluand {
    pub run: String,
    pub model: String,
    pub phrases: PhraseIndex,
    pub motions: Vec<EvaluationMotion>,
    /// What generate said of them, one row for all dancers of a group; none of motions of another program.
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
    /// Whether motions are of dancers of groups.
    pub is_of_groups: bool,
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
            (None, None) => bail!("give --run NAME, or --motions DIR for those of another program"),
        }
    }

    /// Reads what is known of the motions of a run, at most `most` of them.
    ///
    /// # Errors
    /// When the store cannot be read, or one sentence where there are no motions.
    pub fn of_run(snapshot: StoreSnapshot, run: &str, most: Option<usize>) -> anyhow::Result<Self> {
        let store = snapshot.store();
        let (generations, n_groups) = motions::of_run(&snapshot, run, most)?;
        let is_of_groups = generations.iter().any(|row| row.count_dancers() > 1);
        let mut phrases =
            PhraseIndex::read(&snapshot, generations.iter().map(|row| row.phrase_id.as_str()))?;
        if is_of_groups {
            phrases.hold_against(Ensemble::Groups { most: MAX_DANCERS });
        }
        refuse_outdated(&snapshot, run, &phrases, &generations)?;
        let (splits, mut notes) = splits_of(store, &phrases, &generations)?;
        if n_groups > 0 {
            notes.push(format!(
                "{n_groups} motions of groups of dancers are left out; what is measured is a soloist's."
            ));
        }
        let mut motions = Vec::new();
        let mut n_frames = Vec::new();
        for (item, (row, split)) in generations.iter().zip(splits).enumerate() {
            let n_dancers = row.count_dancers().max(1);
            for (dancer, keyframes) in keyframes(row, n_dancers)?.into_iter().enumerate() {
                motions.push(EvaluationMotion {
                    phrase_id: row.phrase_id.clone(),
                    sample: row.sample,
                    item,
                    dancer,
                    split,
                    misses: [row.control_error_mm, row.control_error_deg],
                    keyframes,
                });
                n_frames.push(usize::try_from(row.n_frames).unwrap_or(0));
            }
        }
        let settings: Vec<Making> = generations.iter().filter_map(Making::of_row).collect();
        let phase_given = settings.iter().any(|settings| settings.phase_given);
        let n_candidates = settings.iter().map(|settings| settings.n_candidates).max().unwrap_or(1);
        let decoder_derives = settings.iter().any(|settings| settings.decoder_derives);
        let postprocess = settings.into_iter().next().map(|settings| settings.postprocess);
        Ok(Self {
            run: run.to_owned(),
            model: generations[0].model.clone(),
            phrases,
            motions,
            n_candidates,
            notes,
            refused: Vec::new(),
            n_frames,
            decoder_derives,
            phase_given,
            postprocess: postprocess.unwrap_or_default(),
            generations,
            files: None,
            is_of_groups,
            has_phase: true,
            snapshot,
        })
    }

    /// Returns the length of all motions together, s; that of a group counts once.
    pub fn length_s(&self) -> f64 {
        let motions = self.motions.iter().zip(&self.n_frames);
        frames_to_s(motions.filter(|(motion, _)| motion.dancer == 0).map(|(_, n)| n).sum())
    }

    /// Returns the number of motions; a group is one.
    pub fn n_items(&self) -> usize {
        self.motions.iter().filter(|motion| motion.dancer == 0).count()
    }

    /// Reads the frames of a motion, of a group those of its dancer.
    ///
    /// # Errors
    /// One sentence where it is not there any more.
    pub fn frames(&self, store: &Location, i: usize) -> anyhow::Result<Array2<f32>> {
        if let Some(files) = &self.files {
            let changed = "motions changed while they were evaluated";
            let file = files.files.get(self.motions[i].item).context(changed)?;
            return match file.read() {
                Ok(motion) => motion.into_dancers().nth(self.motions[i].dancer).context(changed),
                Err(failure) => bail!(failure.message),
            };
        }
        let motion = &self.motions[i];
        let sample = usize::try_from(motion.sample).unwrap_or(0);
        let group = generated_group(store, &self.run, &motion.phrase_id, sample)?;
        let dancer = group.axis_iter(Axis(0)).nth(motion.dancer);
        Ok(dancer.context("motions changed while they were evaluated")?.to_owned())
    }

    /// Returns a digest of the motions, of the splits that they are in, and of real motion.
    ///
    /// # Errors
    /// When a file cannot be read.
    pub fn input_hash(&self, data_hash: &str) -> anyhow::Result<String> {
        let mut text = data_hash.to_owned();
        for motion in self.motions.iter().filter(|motion| motion.dancer == 0) {
            let Some(row) = self.generations.get(motion.item) else { continue };
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
            false => truth::read(
                &self.snapshot,
                (data_hash, self.phrases.ensemble()),
                params.threads,
                progress,
            )?,
        };
        if let Some(truth) = &truth {
            self.hear(truth)?;
        }
        let told = telling(self.motions.iter().map(|motion| motion.split));
        let mut groups = (self.is_of_groups && !params.quick)
            .then(|| GroupMeasurer::new(&self.n_frames, truth.as_ref()));
        let sampled = match (params.quick, told, &mut groups) {
            (false, Some(split), Some(groups)) if !self.is_by_tokens() => {
                self.sampled_groups(store, params, (split, groups), progress)?
            }
            (false, Some(split), _) => {
                self.sampled(store, params, truth.as_ref(), split, progress)?
            }
            _ => None,
        };
        let has_music = self.phrases.has_beats();
        let holds = |check: &str| holds_by_construction(check, &self.postprocess, has_music);
        let mut job = EvaluationJob {
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
            groups: None,
        };
        let evaluated = self.measured(store, &job, groups.as_mut(), progress)?;
        let groups = groups.map(|groups| groups.finish(&self.phrases, truth.as_ref()));
        job.groups = groups.as_ref();
        let name = RunName { run: &self.run, model: &self.model };
        let mut rows = EvaluationRows::default();
        let pairs: Vec<(&EvaluationMotion, &EvaluatedMotion)> =
            self.motions.iter().zip(&evaluated).collect();
        for dancers in pairs.chunk_by(|(a, _), (b, _)| a.item == b.item) {
            let (id, sample) = (dancers[0].0.phrase_id.as_str(), dancers[0].0.sample);
            let decoded =
                dancers.iter().map(|(_, found)| Some(&found.decoded.as_ref()?.checks[..]));
            if let Some(decoded) = decoded.collect::<Option<Vec<&[Check]>>>() {
                let has_phase = self.phase_given && has_music;
                let derived = |check: &str| match check {
                    "phase" | "phase_monotonic" => has_phase,
                    // The decoder's turn rates are exact below a quarter turn a frame alone.
                    "angular_velocity" => false,
                    check => self.decoder_derives && holds_by_derivation(check),
                };
                let checks = over_dancers(&decoded);
                let raw = rows::checks(name, id, sample, MotionStage::Raw, &checks, &derived);
                rows.checks.extend(raw);
            }
            let is: Vec<&[Check]> = dancers.iter().map(|(_, found)| &found.is.checks[..]).collect();
            let checks = over_dancers(&is);
            let is = rows::checks(name, id, sample, MotionStage::Final, &checks, &holds);
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
