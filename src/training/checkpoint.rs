//! Checkpoints: a safetensors file with all numbers of a run, and its state as JSON in the header.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

use crate::store::{Location, PutOutcome, StoreError};
use crate::weights::{self, Archive, Precision, Section, save_to_file};

use super::error::TrainingError;
use super::window::Scales;

/// Layout of checkpoints; raised when a field changes its meaning.
const FORMAT: u32 = 1;
/// Key of the state in the file's header.
const STATE: &str = "motiongen.state";
/// Longest header of a checkpoint, in bytes.
const MAX_HEADER_BYTES: u64 = 100_000_000;
/// Checkpoints of the newest steps that are kept.
const N_KEPT: usize = 2;

/// Where a run's stage stands, beside its numbers.
///
/// Random numbers depend on the seed and the step alone, so the step is their state.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct State<C> {
    pub format: u32,
    pub program: String,
    pub stage: String,
    pub config: C,
    /// Digest of the phrases.
    pub data: String,
    pub scales: Scales,
    pub progress: Progress,
}

/// The progress of a training, which changes from step to step.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// Steps done.
    pub step: u64,
    /// Steps in all, for the course of the learning rate.
    pub n_steps: u64,
    /// Steps that the optimizer took; those that were skipped do not count.
    pub n_updates: u64,
    /// Updates of the average.
    pub n_averaged: u64,
    pub n_skipped: u64,
    pub n_skipped_in_a_row: u32,
    pub elapsed_s: f64,
    /// Sum of the losses of the epoch under way, and how many.
    pub epoch_loss: (f64, u64),
    pub best: Option<Best>,
    /// Validations since the best one.
    pub n_stale: u64,
    /// Whether training came to its end: all steps, its time, or its patience.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub has_ended: bool,
}

/// The best validation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Best {
    pub step: u64,
    pub loss: f64,
    /// Distance of sampled motion from real motion; none where none is sampled, and in checkpoints of 0.1.
    #[serde(default)]
    pub distance: Option<f64>,
}

impl Best {
    /// Returns whether a validation is better than another: by the distance of sampled motion where both have one, else
    /// by the loss.
    pub fn is_better_than(&self, other: &Self) -> bool {
        match (self.distance, other.distance) {
            (Some(distance), Some(of_other)) => distance < of_other,
            (Some(_), None) => true,
            (None, Some(_)) => false,
            (None, None) => self.loss < other.loss,
        }
    }
}

impl<C: Serialize + DeserializeOwned> State<C> {
    /// Returns the state of a stage that has not begun.
    pub fn new(stage: &str, config: C, data: &str, scales: impl Into<Scales>) -> Self {
        Self {
            format: FORMAT,
            program: format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION")),
            stage: stage.to_owned(),
            config,
            data: data.to_owned(),
            scales: scales.into(),
            progress: Progress::default(),
        }
    }

    /// Reads the state from a file's header.
    ///
    /// # Errors
    /// [`TrainingError::Checkpoint`] when there is none, or it has another format.
    pub fn of(archive: &Archive, place: &str) -> Result<Self, TrainingError> {
        Self::of_metadata(archive.metadata(), place)
    }

    fn of_metadata(
        metadata: &BTreeMap<String, String>,
        place: &str,
    ) -> Result<Self, TrainingError> {
        let refuse =
            |reason: String| Err(TrainingError::Checkpoint { place: place.to_owned(), reason });
        #[derive(Deserialize)]
        struct FormatField {
            format: u32,
        }
        let Some(text) = metadata.get(STATE) else {
            return refuse("holds weights but no state; name a checkpoint that train wrote".into());
        };
        match serde_json::from_str::<FormatField>(text) {
            Ok(FormatField { format }) if format != FORMAT => {
                return refuse(format!(
                    "has format {format}, this program reads format {FORMAT}; use the version of \
                     motiongen that wrote it, or train anew with --force"
                ));
            }
            _ => {}
        }
        serde_json::from_str(text).or_else(|e| refuse(format!("has a state that is damaged ({e})")))
    }
}

/// The checkpoints of one stage of a run: `runs/<run>/<stage>/<kind>-<step>.safetensors`.
#[derive(Clone, Debug)]
pub struct Checkpoints<'a> {
    store: &'a Location,
    folder: String,
}

/// The purpose of a checkpoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CheckpointKind {
    /// Everything, to go on from.
    Step,
    /// The weights that validated best.
    Best,
}

impl CheckpointKind {
    fn name(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Best => "best",
        }
    }
}

impl<'a> Checkpoints<'a> {
    pub fn new(store: &'a Location, run: &str, stage: &str) -> Self {
        Self { store, folder: format!("runs/{run}/{stage}") }
    }

    /// Returns the path of a checkpoint below the store.
    pub fn path(&self, kind: CheckpointKind, step: u64) -> String {
        format!("{}/{}-{step:08}.safetensors", self.folder, kind.name())
    }

    /// Returns what messages call a checkpoint.
    pub fn place(&self, kind: CheckpointKind, step: u64) -> String {
        self.store.url_of(&self.path(kind, step))
    }

    /// Refuses a store in which a file of the run is missing.
    ///
    /// # Errors
    /// [`StoreError::NotFound`], or errors of the store.
    pub fn check_anchor(&self, path: &str) -> Result<(), StoreError> {
        self.store.size_bytes(path).map(|_| ())
    }

    /// Returns the steps of the checkpoints that are there, in order.
    ///
    /// # Errors
    /// When the store cannot be listed.
    pub fn steps(&self, kind: CheckpointKind) -> Result<Vec<u64>, TrainingError> {
        let prefix = format!("{}/{}-", self.folder, kind.name());
        let listed = self.store.list(&self.folder)?;
        let step = |path: &str| {
            path.strip_prefix(&prefix)?.strip_suffix(".safetensors")?.parse::<u64>().ok()
        };
        let mut steps: Vec<_> = listed.iter().filter_map(|listed| step(&listed.path)).collect();
        steps.sort_unstable();
        Ok(steps)
    }

    /// Writes a checkpoint, whole or not at all; then removes those of its kind that are out of date.
    ///
    /// The same step of the same run has the same numbers, so one that is there already is left.
    ///
    /// # Errors
    /// Errors of the store, a full disk among others; older checkpoints are untouched then.
    pub fn write<C: Serialize>(
        &self,
        kind: CheckpointKind,
        state: &State<C>,
        sections: &[Section<f32>],
    ) -> Result<PutOutcome, TrainingError> {
        let step = state.progress.step;
        let path = self.path(kind, step);
        let text = serde_json::to_string(state).map_err(|e| TrainingError::Checkpoint {
            place: path.clone(),
            reason: e.to_string(),
        })?;
        let metadata = BTreeMap::from([(STATE.to_owned(), text)]);
        let file = self.store.temporary(&path)?;
        let file = save_to_file(sections, Precision::F32, &metadata, file)
            .map_err(|source| TrainingError::Weights { place: self.store.url_of(&path), source })?;
        let put = self.store.put_file_new(&path, file)?;
        let kept = match kind {
            CheckpointKind::Step => N_KEPT,
            CheckpointKind::Best => 1,
        };
        let mut steps = self.steps(kind)?;
        steps.retain(|&other| other <= step);
        steps.truncate(steps.len().saturating_sub(kept));
        for old in steps {
            self.store.remove(&self.path(kind, old))?;
        }
        Ok(put)
    }

    /// Removes a checkpoint.
    ///
    /// # Errors
    /// Errors of the store.
    pub fn remove(&self, kind: CheckpointKind, step: u64) -> Result<(), TrainingError> {
        Ok(self.store.remove(&self.path(kind, step))?)
    }

    /// Removes all checkpoints of the stage.
    ///
    /// # Errors
    /// Errors of the store.
    pub fn clear(&self) -> Result<(), TrainingError> {
        for kind in [CheckpointKind::Step, CheckpointKind::Best] {
            for step in self.steps(kind)? {
                self.remove(kind, step)?;
            }
        }
        Ok(())
    }

    /// Reads the state of a checkpoint alone, without its numbers.
    ///
    /// # Errors
    /// When it cannot be read, or is no checkpoint.
    pub fn state<C: Serialize + DeserializeOwned>(
        &self,
        kind: CheckpointKind,
        step: u64,
    ) -> Result<State<C>, TrainingError> {
        let (place, path) = (self.place(kind, step), self.path(kind, step));
        let start = self.store.read_start(&path, weights::N_LENGTH_BYTES)?;
        let n_header = weights::header_length(&start).filter(|n| *n <= MAX_HEADER_BYTES);
        let Some(n_header) = n_header else {
            let reason = "is damaged: it has no header".to_owned();
            return Err(TrainingError::Checkpoint { place, reason });
        };
        let start = self.store.read_start(&path, weights::N_LENGTH_BYTES + n_header)?;
        let metadata = weights::metadata(&start)
            .map_err(|source| TrainingError::Weights { place: place.clone(), source })?;
        State::of_metadata(&metadata, &place)
    }

    /// Reads a checkpoint and hands it to `load`.
    ///
    /// # Errors
    /// When it cannot be read, or errors of `load`.
    pub fn read<T>(
        &self,
        kind: CheckpointKind,
        step: u64,
        load: impl FnOnce(&Archive, &str) -> Result<T, TrainingError>,
    ) -> Result<T, TrainingError> {
        let place = self.place(kind, step);
        let bytes = self.store.read(&self.path(kind, step))?;
        let archive = Archive::open(&bytes)
            .map_err(|source| TrainingError::Weights { place: place.clone(), source })?;
        load(&archive, &place)
    }
}
