//! The log of a run: rows that become visible with the checkpoint up to which they reach.

use std::time::Duration;

use serde::Serialize;

use crate::store::tables::TrainingLogRow;
use crate::store::{
    Commit, Item, Lease, Ledger, Location, Patience, Row as _, StoreError, TimestampUs, checkpoint,
    digest,
};

use super::checkpoint::Progress;
use super::error::TrainingError;
use super::learner::{Losses, StepResult};

/// The event that a row records.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RowKind {
    Step,
    Epoch,
    Validation,
}

impl RowKind {
    /// Returns the kind as the table spells it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Step => "step",
            Self::Epoch => "epoch",
            Self::Validation => "validation",
        }
    }
}

/// A row to write.
pub struct Entry<'a> {
    pub kind: RowKind,
    pub epoch: u64,
    pub step: u64,
    pub losses: &'a Losses,
    pub live_loss: Option<f64>,
    pub taken: Option<&'a StepResult>,
    pub is_skipped: bool,
    pub samples_per_s: Option<f64>,
    pub data_wait_s: Option<f64>,
    pub resident_bytes: Option<u64>,
    pub elapsed_s: f64,
}

impl<'a> Entry<'a> {
    /// Returns a row about an epoch or a validation.
    pub fn of_epoch(
        kind: RowKind,
        epoch: u64,
        progress: &Progress,
        losses: &'a Losses,
        live_loss: Option<f64>,
    ) -> Self {
        Self {
            kind,
            epoch,
            step: progress.step,
            losses,
            live_loss,
            taken: None,
            is_skipped: false,
            samples_per_s: None,
            data_wait_s: None,
            resident_bytes: None,
            elapsed_s: progress.elapsed_s,
        }
    }
}

/// Collects rows and commits them in stretches, one from checkpoint to checkpoint.
///
/// A stretch is named by its first step. Who goes on from a checkpoint takes the steps after it again and
/// writes their rows again: the stretch of the same name replaces the older one, and stretches that began
/// after the checkpoint are withdrawn with it.
pub struct Journal<'a> {
    store: &'a Location,
    run: String,
    stage: &'static str,
    command: &'static str,
    /// Digest of the run's configuration.
    params_hash: String,
    /// Identity of the data, which determines the rows beside configuration and steps.
    data: String,
    ledger: Ledger,
    first_step: u64,
    rows: Vec<TrainingLogRow>,
    lease: Option<&'a Lease>,
}

impl<'a> Journal<'a> {
    /// Opens the log of a run's stage, written by the command `command`.
    ///
    /// # Errors
    /// When the store's commits cannot be read.
    pub fn open(
        store: &'a Location,
        command: &'static str,
        run: &str,
        stage: &'static str,
    ) -> Result<Self, StoreError> {
        checkpoint(store, &[command]);
        let ledger = Ledger::read(store, command)?;
        let run = run.to_owned();
        Ok(Self {
            store,
            run,
            stage,
            command,
            params_hash: String::new(),
            data: String::new(),
            ledger,
            first_step: 0,
            rows: Vec::new(),
            lease: None,
        })
    }

    /// Writes under a lease of the run, and no more once it is lost.
    pub fn under(self, lease: &'a Lease) -> Self {
        Self { lease: Some(lease), ..self }
    }

    /// Says what determines the rows beside their steps: the configuration, the digest of the data, and the steps in
    /// all, on which learning rates depend.
    pub fn determined_by(&mut self, config: &impl Serialize, data: &str, n_steps: u64) {
        let config = serde_json::to_vec(config).expect("invariant: numbers and texts become JSON");
        self.params_hash = digest(&config);
        self.data = format!("{data} in {n_steps} steps");
    }

    /// Begins a stretch after `step` steps.
    pub fn begin(&mut self, step: u64) {
        self.first_step = step;
        self.rows.clear();
    }

    /// Adds a row to the stretch.
    pub fn add(&mut self, entry: Entry) {
        let part = |name: &str| {
            entry.losses.parts.iter().find(|(known, _)| *known == name).map(|&(_, value)| value)
        };
        let finite = |x: f64| x.is_finite().then_some(x);
        self.rows.push(TrainingLogRow {
            segment: self.name(self.first_step),
            run: self.run.clone(),
            stage: self.stage.to_owned(),
            kind: entry.kind.name().to_owned(),
            epoch: entry.epoch as i32 + 1,
            step: entry.step as i64,
            learning_rate: entry.taken.map(|taken| taken.learning_rate),
            lr_decoder: entry.taken.and_then(|taken| taken.lr_decoder),
            loss: finite(entry.losses.total),
            loss_live: entry.live_loss.and_then(finite),
            diffusion: part("diffusion"),
            reconstruction: part("reconstruction"),
            decoder_position: part("decoder_position"),
            decoder_quaternion: part("decoder_quaternion"),
            velocity_coherence: part("velocity_coherence"),
            acceleration_coherence: part("acceleration_coherence"),
            jerk: part("jerk"),
            quaternion_delta: part("quaternion_delta"),
            phase_monotonic: part("phase_monotonic"),
            position_smoothness: part("position_smoothness"),
            velocity_error: part("velocity_error"),
            acceleration_error: part("acceleration_error"),
            quaternion_pass_rate: part("quaternion_pass_rate"),
            speed_ratio: part("speed_ratio"),
            markers: part("markers"),
            contrast: part("contrast"),
            sampled_distance: part("sampled_distance"),
            commitment: part("commitment"),
            perplexity: part("perplexity"),
            gradient_norm: entry.taken.and_then(|taken| finite(taken.gradient_norm)),
            skipped: entry.is_skipped,
            samples_per_s: entry.samples_per_s,
            data_wait_s: entry.data_wait_s,
            rss_bytes: entry.resident_bytes.map(|bytes| bytes as i64),
            elapsed_s: entry.elapsed_s,
            time: TimestampUs::now(),
        });
    }

    /// Commits the stretch up to `step` and begins the next.
    ///
    /// # Errors
    /// Errors of the store, once patience is at its end; the rows are kept then.
    pub fn commit(
        &mut self,
        step: u64,
        patience: Patience,
        notice: &dyn Fn(&StoreError, Duration),
    ) -> Result<(), TrainingError> {
        if let Some(lease) = self.lease {
            lease.check()?;
        }
        if self.rows.is_empty() {
            return Ok(());
        }
        let mine = format!("{}/{}/", self.run, self.stage);
        let withdrawn: Vec<String> = self
            .ledger
            .ids()
            .filter(|id| {
                let first = id.strip_prefix(&mine).and_then(|first| first.parse::<u64>().ok());
                first.is_some_and(|first| first > self.first_step)
            })
            .map(str::to_owned)
            .collect();
        let id = self.name(self.first_step);
        let ledger = &mut self.ledger;
        patience.wait_out(notice, || {
            let mut commit = Commit::new(self.store, self.command, &self.params_hash, &self.run);
            let schema = TrainingLogRow::schema;
            commit.part(schema().name, schema)?.write_rows(&self.rows)?;
            // The same steps of the same run have the same losses, whichever process takes them: a run is
            // determined by its name, its data and its settings.
            let input_hash = digest(format!("{id} to {step} of {}", self.data).as_bytes());
            let fingerprint = input_hash.clone();
            let item = Item { id: id.clone(), fingerprint, input_hash, failure: None };
            commit.settle(item, ledger);
            for id in &withdrawn {
                commit.settle(Item::forgotten(id), ledger);
            }
            commit.publish_into(ledger)
        })?;
        self.begin(step);
        Ok(())
    }

    /// Withdraws everything that was logged of the run's stage.
    ///
    /// # Errors
    /// Errors of the store.
    pub fn clear(&mut self) -> Result<(), TrainingError> {
        let mine = format!("{}/{}/", self.run, self.stage);
        let mut ids: Vec<String> = self.ledger.ids().map(str::to_owned).collect();
        ids.retain(|id| {
            id.starts_with(&mine) && self.ledger.get(id).is_some_and(|known| known.item.succeeded())
        });
        ids.sort();
        if !ids.is_empty() {
            let mut commit = Commit::new(self.store, self.command, "", &self.run);
            for id in &ids {
                commit.settle(Item::forgotten(id), &self.ledger);
            }
            commit.publish_into(&mut self.ledger)?;
        }
        Ok(())
    }

    fn name(&self, first_step: u64) -> String {
        format!("{}/{}/{first_step:08}", self.run, self.stage)
    }
}
