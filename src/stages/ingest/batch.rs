//! Batches: phrases that are read, checked and committed together.
//!
//! A batch is a range of the phrases' stable hash, so what is in it depends on the source alone:
//! every process, at any time and after any number of kills, writes the same bytes under the same name.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;
use std::sync::{Mutex, PoisonError};

use super::layout::{PlannedPhrase, Role};
use super::phrase::{CheckedPhrase, IngestRules, PhraseFiles};
use super::{BEATS_VERSION, CAPTURE_VERSION, FailedPhrase, IngestTally, notes_of};
use crate::motion::style_name::style_of_name;
use crate::stages::Progress;
use crate::stages::batch::{BatchCommit, BatchJob, n_batches};
use crate::stages::beats::{self, BeatSource};
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::pool::{self, lock};
use crate::stages::touched::TouchedContent;
use crate::store::tables::{self, BeatRow, PhraseRow};
use crate::store::{
    Commit, Content, Item, Shard, Source, SourceFile, StoreError, batch_of, digest, split_of,
};

/// Bytes of source files that one batch holds at most, so that a kill costs little of a slow source.
const MAX_BATCH_BYTES: u64 = 256 << 20;

/// Everything that the batches of a run share.
pub struct IngestJob<'a> {
    pub source: &'a Source,
    pub batches: BatchJob<'a>,
    pub seen: &'a TouchedContent,
    pub rules: &'a IngestRules,
    pub progress: &'a dyn Progress,
    /// Phrases of the store that lack the identity of their music, and have it now.
    pub unidentified: &'a BTreeSet<String>,
    /// Write phrases even when nothing about them changed.
    pub force: bool,
}

/// Groups phrases into batches, in an order and cut that depend on the source alone.
///
/// `all` is the whole plan (it sets the number of batches), `todo` the phrases to do now.
pub fn batches<'p>(
    all: &[PlannedPhrase],
    todo: Vec<&'p PlannedPhrase>,
    batch_phrases: usize,
) -> Vec<Vec<&'p PlannedPhrase>> {
    let n_bytes: u64 = all.iter().flat_map(|p| &p.files).map(|(_, file)| file.size_bytes).sum();
    let by_count = all.len().div_ceil(batch_phrases.max(1));
    let n_batches = n_batches(by_count, n_bytes.div_ceil(MAX_BATCH_BYTES));
    let mut batches: Vec<Vec<&PlannedPhrase>> = vec![Vec::new(); n_batches as usize];
    for phrase in todo {
        batches[batch_of(&phrase.id, n_batches) as usize].push(phrase);
    }
    batches.retain(|batch| !batch.is_empty());
    batches
}

impl IngestJob<'_> {
    /// Does all batches on `n_workers` threads; where the user asks for an end, those that are under way.
    ///
    /// # Errors
    /// The first [`StoreError`] of the store itself; what was committed stays.
    pub fn run(
        &self,
        batches: &[Vec<&PlannedPhrase>],
        n_workers: NonZeroUsize,
    ) -> Result<IngestTally, StoreError> {
        let total = Mutex::new(IngestTally::default());
        let mut queue = batches.iter();
        let n_batches = NonZeroUsize::new(batches.len()).unwrap_or(NonZeroUsize::MIN);
        pool::run(
            n_workers.min(n_batches),
            || {
                let batch = queue.next()?;
                if self.progress.is_interrupted() {
                    lock(&total).is_stopped = true;
                    return None;
                }
                Some(batch)
            },
            |batch| self.batch(batch).map(|tally| lock(&total).add(tally)),
        )?;
        Ok(total.into_inner().unwrap_or_else(PoisonError::into_inner))
    }

    /// Removes the failures of phrases that the source no longer has.
    ///
    /// # Errors
    /// [`StoreError`] of the store.
    pub fn forget_failures(&self, all: &[PlannedPhrase], shard: Shard) -> Result<(), StoreError> {
        let there: BTreeSet<&str> = all.iter().map(|p| p.id.as_str()).collect();
        let suffix = self.contested("");
        self.batches.forget_failures(|id| {
            let phrase = id.strip_suffix(&suffix).unwrap_or(id);
            !there.contains(phrase) && shard.takes(phrase)
        })
    }

    fn batch(&self, batch: &[&PlannedPhrase]) -> Result<IngestTally, StoreError> {
        let mut tally = IngestTally::default();
        let mut commit = self.batches.start();
        let mut seen = self.seen.start(self.batches.store, self.batches.origin);
        let mut rows = BatchRows::default();
        let readable = batch.iter().filter(|p| p.problem.is_none());
        let files = readable.flat_map(|p| p.files.iter().map(|(_, f)| f.clone())).collect();
        let mut contents = self.source.read_in_order(files);
        for planned in batch {
            let read = planned.problem.is_none();
            // The read-ahead budget of these files is given back when the phrase is done.
            let (files, _budget): (Vec<_>, Vec<_>) = planned
                .files
                .iter()
                .filter(|_| read)
                .map(|(role, file)| {
                    let (content, permit) = contents.next().unwrap_or_else(|| (gone(file), None));
                    ((*role, file.clone(), content), permit)
                })
                .unzip();
            let (content_hash, outcome) = self.phrase(planned, files);
            self.see(planned, &content_hash, &outcome, &mut seen);
            self.settle(planned, &content_hash, outcome, &mut commit, &mut tally, &mut rows)?;
            self.progress.advance(1);
        }
        commit.rows(&rows.phrases)?;
        commit.rows(&rows.beats)?;
        commit.publish()?;
        if !seen.is_empty() {
            seen.publish()?;
        }
        Ok(tally)
    }

    /// Keeps the fingerprint of a phrase whose rows the store has, and which is met under another: its files were
    /// touched, or are those of a second source.
    fn see(
        &self,
        planned: &PlannedPhrase,
        content_hash: &str,
        outcome: &Result<CheckedPhrase, Failure>,
        seen: &mut Commit<'_>,
    ) {
        let Some(known) = self.batches.known(&planned.id) else { return };
        let origin = self.batches.origin;
        let fingerprint = fingerprint(planned);
        let is_same =
            known.item.succeeded() && known.item.input_hash == input_hash(planned, content_hash);
        let is_news = known.item.fingerprint != fingerprint || known.origin != origin;
        let stays = !self.force && !self.unidentified.contains(&planned.id);
        if outcome.is_ok() && is_same && is_news && stays {
            self.seen.settle(known, origin, &fingerprint, seen);
        }
    }

    /// Reads and checks one phrase, and returns its content hash with it; a defect of ours costs the phrase,
    /// not the job.
    fn phrase(
        &self,
        planned: &PlannedPhrase,
        files: Vec<(Role, SourceFile, Result<Content, StoreError>)>,
    ) -> (String, Result<CheckedPhrase, Failure>) {
        let without_content = |failure: &Failure| digest(failure.message.as_bytes());
        if let Some(problem) = &planned.problem {
            return (without_content(problem), Err((**problem).clone()));
        }
        let files = match PhraseFiles::take(files) {
            Ok(files) => files,
            Err(failure) => return (without_content(&failure), Err(failure)),
        };
        let content_hash = files.content_hash().to_owned();
        let path = planned.files.first().map_or(planned.id.as_str(), |(_, file)| &file.path);
        let outcome = guarded(path, || files.check(self.rules));
        (content_hash, outcome)
    }

    /// Writes an outcome into the commit unless the store has it already.
    fn settle(
        &self,
        planned: &PlannedPhrase,
        content_hash: &str,
        mut outcome: Result<CheckedPhrase, Failure>,
        commit: &mut BatchCommit<'_>,
        tally: &mut IngestTally,
        rows: &mut BatchRows,
    ) -> Result<(), StoreError> {
        let mut id = planned.id.clone();
        let contested = self.contested(&id);
        let input_hash = input_hash(planned, content_hash);
        if let Some(failure) = self.claimed_by_another_source(planned, content_hash) {
            id.clone_from(&contested);
            outcome = Err(failure);
        } else if self.is_out_of_reach(&id, &outcome) {
            id.clone_from(&contested);
        }
        let failure = outcome.as_ref().err().map(Failure::digest);
        let unchanged = !self.force
            && !self.unidentified.contains(&id)
            && self.batches.known(&id).is_some_and(|known| {
                known.item.input_hash == input_hash && known.item.failure == failure
            });
        match &outcome {
            Ok(_) if unchanged => tally.n_unchanged += 1,
            Ok(phrase) => {
                tally.n_done += 1;
                let (n_dancers, n_frames) = phrase
                    .motion
                    .as_ref()
                    .map_or((0, 0), |dancers| (dancers.n_dancers(), dancers.n_frames()));
                tally.n_frames += (n_dancers * n_frames) as u64;
                tally.n_groups += u64::from(n_dancers > 1);
                tally.duration_s += phrase.duration_s();
                let notes = phrase.capture.as_ref().and_then(notes_of);
                tally.noted.extend(notes.map(|notes| (id.clone(), notes)));
            }
            Err(failure) => {
                tally.failed.push(FailedPhrase { id: id.clone(), failure: failure.clone() });
            }
        }
        let fingerprint = fingerprint(planned);
        if id != contested && self.batches.has_failed(&contested) {
            // What kept the phrase from its own name is gone, and with it the failure.
            commit.forget(&contested);
        }
        if unchanged {
            return Ok(());
        }
        if let Ok(CheckedPhrase { motion: Some(motion), .. }) = &outcome {
            let part = commit.part(tables::MOTION, tables::motion)?;
            part.write_group(&id, motion.to_array().view())?;
        }
        match outcome {
            Ok(phrase) => {
                if let Some(list) = &phrase.beats {
                    let (numbered, source) = (beats::numbered(list), BeatSource::BeatsFile);
                    rows.beats.extend(beats::rows(&id, numbered, phrase.n_frames(), source));
                }
                rows.phrases.push(self.phrase_row(planned, phrase));
            }
            Err(failure) => {
                let url = self.source.location().url_of(&failure.path);
                commit.list_failure(&id, &url, &failure);
            }
        }
        commit.settle(Item { id, fingerprint, input_hash, failure });
        Ok(())
    }

    /// Returns whether a phrase that the store has could not be read just now.
    ///
    /// Its rows were true when they were written, and a disk or a network that fails for an hour says
    /// nothing about them: they stay, and the failure is listed beside them.
    fn is_out_of_reach(&self, id: &str, outcome: &Result<CheckedPhrase, Failure>) -> bool {
        matches!(outcome, Err(failure) if failure.kind == FailureKind::Unreadable)
            && self.batches.has_rows(id)
    }

    /// Returns the name under which a phrase fails whose own name stands for rows that stay: those of
    /// another source, or those of a phrase that cannot be read just now.
    fn contested(&self, id: &str) -> String {
        contested(id, self.batches.origin)
    }

    /// Refuses a phrase whose name the store has from elsewhere with other content.
    fn claimed_by_another_source(
        &self,
        planned: &PlannedPhrase,
        content_hash: &str,
    ) -> Option<Failure> {
        let known = self.batches.ledger.get(&planned.id)?;
        // Release 0.1 kept the content hash of every phrase.
        let same = [content_hash, &input_hash(planned, content_hash)];
        let here = self.batches.origin;
        if self.force
            || known.origin == here
            || !known.item.succeeded()
            || same.contains(&known.item.input_hash.as_str())
        {
            return None;
        }
        let message = format!(
            "phrase {} is in the store already, from {}, with other content; rename it, ingest it \
             into another store, or replace the other one with --force",
            planned.id, known.origin
        );
        let path = planned.files.first().map_or(planned.id.as_str(), |(_, file)| &file.path);
        Some(Failure::new(FailureKind::DuplicateId, path, message))
    }

    fn phrase_row(&self, planned: &PlannedPhrase, phrase: CheckedPhrase) -> PhraseRow {
        let location = self.source.location();
        let file = |name: &str| planned.files.iter().find(|(role, _)| role.name() == name);
        let url = |name| file(name).map(|(_, f)| location.url_of(&f.path));
        // A group may have a file for each dancer.
        let bytes = |name| {
            let of_role = planned.files.iter().filter(|(role, _)| role.name() == name);
            file(name).map(|_| of_role.map(|(_, f)| f.size_bytes as i64).sum::<i64>())
        };
        let duration_s = phrase.duration_s();
        let tempo = phrase.tempo;
        let capture = phrase.capture.as_ref();
        let beats_per_bar = tempo.and_then(|t| t.beats_per_bar);
        PhraseRow {
            phrase_id: planned.id.clone(),
            source: location.url().to_owned(),
            motion_url: url("motion"),
            features_url: url("features"),
            audio_url: url("audio"),
            beats_url: url("beats"),
            motion_bytes: bytes("motion"),
            features_bytes: bytes("features"),
            audio_bytes: bytes("audio"),
            beats_bytes: bytes("beats"),
            content_hash: phrase.content_hash,
            song_hash: phrase.song_hash,
            has_motion: phrase.motion.is_some(),
            has_features: phrase.n_feature_frames.is_some(),
            has_audio: phrase.audio.is_some(),
            has_beats: phrase.has_beats,
            motion_format: phrase.motion_format.map(str::to_owned),
            motion_root: capture.map(|found| found.root.clone()),
            motion_up: capture.map(|found| found.up.name().to_owned()),
            motion_unit_m: capture.map(|found| found.unit_m),
            motion_cut_s: capture.map(|found| found.cut_s),
            motion_notes: capture.and_then(notes_of),
            audio_codec: phrase.audio.as_ref().map(|a| a.codec.clone()),
            sample_rate_hz: phrase.audio.as_ref().map(|a| a.sample_rate_hz as i32),
            n_channels: phrase.audio.as_ref().map(|a| i32::from(a.n_channels)),
            duration_s,
            start_s: None,
            n_frames: phrase.motion.as_ref().map(|m| m.n_frames() as i64),
            n_feature_frames: phrase.n_feature_frames.map(|n| n as i64),
            split: split_of(&planned.id).to_owned(),
            tempo_bpm: tempo.map(|t| t.bpm),
            tempo_source: tempo.map(|t| t.source.to_owned()),
            beats_per_bar: beats_per_bar.map(|(n, _)| n as i32),
            beats_per_bar_source: beats_per_bar.map(|(_, source)| source.to_owned()),
            n_dancers: phrase.motion.as_ref().map(|dancers| dancers.n_dancers() as i32),
            formation: None,
            unison: None,
            style_name: phrase.style_name.or_else(|| style_of_name(&planned.id).map(str::to_owned)),
        }
    }
}

/// Returns the name under which a phrase from `origin` fails while rows of its own name stay.
pub fn contested(id: &str, origin: &str) -> String {
    format!("{id} @ {origin}")
}

/// The rows of a batch but for motion and failures.
#[derive(Default)]
struct BatchRows {
    phrases: Vec<PhraseRow>,
    beats: Vec<BeatRow>,
}

/// Returns what a phrase's rows are made from, as its item names it: its content, and the versions of what is
/// written for a beat list and a motion capture.
fn input_hash(planned: &PlannedPhrase, content_hash: &str) -> String {
    match version_lines(planned) {
        lines if lines.is_empty() => content_hash.to_owned(),
        lines => digest(format!("{content_hash}\n{lines}").as_bytes()),
    }
}

/// Returns lines that only phrases with a beat list or a motion capture have.
fn version_lines(planned: &PlannedPhrase) -> String {
    let has = |wanted| planned.files.iter().any(|(role, _)| *role == wanted);
    let mut lines = String::new();
    if has(Role::Beats) {
        lines += &format!("beats version {BEATS_VERSION}\n");
    }
    let is_capture = |(role, file): &(Role, SourceFile)| {
        matches!(role, Role::Dancer(_)) && file.path.ends_with(".bvh")
    };
    if has(Role::MotionCapture) || planned.files.iter().any(is_capture) {
        lines += &format!("capture version {CAPTURE_VERSION}\n");
    }
    lines
}

/// Returns what the storage says of a phrase's files, without reading them.
pub fn fingerprint(planned: &PlannedPhrase) -> String {
    let lines: String = planned
        .files
        .iter()
        .map(|(role, file)| format!("{} {} {}\n", role.name(), file.path, file.fingerprint))
        .collect();
    let problem = planned.problem.as_ref().map_or("", |p| p.message.as_str());
    let versions = version_lines(planned);
    digest(format!("{lines}{versions}{problem}").as_bytes())[..32].to_owned()
}

fn gone(file: &SourceFile) -> Result<Content, StoreError> {
    Err(StoreError::NotFound { place: file.path.clone(), hint: "" })
}
