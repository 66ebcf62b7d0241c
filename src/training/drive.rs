//! The course of a training: steps, epochs, validations, checkpoints, and every way it can end.

use std::sync::Arc;
use std::time::{Duration, Instant};

use serde::Serialize;
use serde::de::DeserializeOwned;

use crate::store::{Patience, StoreError};
use crate::weights::Section;

use super::batch::Batch;
use super::checkpoint::{Best, CheckpointKind, Checkpoints, State};
use super::error::TrainingError;
use super::journal::{Entry, Journal, RowKind};
use super::learner::{Learner, Losses, Ownership, StepResult, Validation};
use super::loader::Loader;
use super::ranks::Ranks;

/// Steps in a row that may be skipped because something is not finite.
const MAX_SKIPPED_IN_A_ROW: u32 = 10;
/// How long steps are rehearsed, without effect, to estimate how many fit into a time: at least `MIN_TRIED` steps
/// and `TRIED_S` seconds, but at most the share `SHARE_TRIED` of the time.
const MIN_TRIED: u64 = 3;
const TRIED_S: f64 = 8.0;
const SHARE_TRIED: f64 = 0.02;
/// Share of the time that steps may take when their number is chosen; the optimizer and
/// validations take the rest.
const SHARE_OF_TIME: f64 = 0.92;

/// When training ends, saves and validates.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    pub n_steps: Option<u64>,
    pub n_epochs: Option<u64>,
    pub time: Option<Duration>,
    pub windows_per_epoch: u64,
    pub batch_size: u64,
    /// Whether what is there before the first step is measured too.
    pub validate_first: bool,
    pub validate_every_epochs: u64,
    pub save_every_epochs: u64,
    pub save_every_steps: Option<u64>,
    pub save_every: Duration,
    /// Validations without improvement after which training ends.
    pub patience: Option<u64>,
    /// How long a store that does not answer is waited for.
    pub store_patience: Patience,
}

impl Plan {
    /// Returns the epoch of a step, from 0.
    fn epoch(&self, step: u64) -> u64 {
        step * self.batch_size / self.windows_per_epoch.max(1)
    }

    /// Returns how many epochs are over after `step` steps.
    fn epochs_done(&self, steps: u64) -> u64 {
        self.epoch(steps)
    }

    /// Returns the steps that end `n` epochs.
    fn steps_of(&self, n: u64) -> u64 {
        (n * self.windows_per_epoch).div_ceil(self.batch_size)
    }

    /// Returns the steps that the plan names, if it names any.
    fn named_steps(&self) -> Option<u64> {
        let by_epochs = self.n_epochs.map(|n| self.steps_of(n));
        match (self.n_steps, by_epochs) {
            (Some(a), Some(b)) => Some(a.min(b)),
            (a, b) => a.or(b),
        }
    }
}

/// Receives progress events of a training.
pub trait Watch {
    /// Training begins at `step` of `n_steps`.
    fn begin(&self, stage: &'static str, step: u64, n_steps: u64);
    /// A step was taken.
    fn step(&self, said: &str);
    /// Something worth a line.
    fn note(&self, line: &str);
    /// Whether the user asked for an end.
    fn is_interrupted(&self) -> bool;
    /// Memory of the process, in bytes, if it can be told.
    fn resident_bytes(&self) -> Option<u64>;
    /// Training ends.
    fn end(&self);
}

/// How training ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrainingEnd {
    /// All steps were done.
    Done,
    /// The time was over.
    OutOfTime,
    /// Nothing improved any more.
    Stale,
    /// The user asked for an end.
    Interrupted,
}

/// What all processes do before the next step.
struct Decided {
    is_interrupted: bool,
    is_out_of_time: bool,
    saves: bool,
}

/// A stage of a run that is under way.
pub struct Drive<'a, C> {
    pub plan: Plan,
    pub state: State<C>,
    pub checkpoints: Checkpoints<'a>,
    /// None on processes that only take part.
    pub journal: Option<Journal<'a>>,
    pub ranks: Arc<Ranks>,
    pub watch: &'a dyn Watch,
    /// A file of the run, below the store. Where it is missing so is the store (a disk that is not
    /// mounted, a folder that was moved), and nothing is written in its place.
    pub anchor: String,
}

impl<C: Serialize + DeserializeOwned> Drive<'_, C> {
    /// Trains until the plan is fulfilled, and returns how it ended.
    ///
    /// # Errors
    /// [`TrainingError`]; the last good checkpoint is named where there is one.
    pub fn run<L: Learner>(
        &mut self,
        learner: &mut L,
        start_loader: impl FnOnce(u64, &Ownership) -> Loader,
    ) -> Result<TrainingEnd, TrainingError> {
        let mut loader = start_loader(self.state.progress.step, &learner.ownership());
        let mut first = Some(loader.next_batch()?);
        if self.state.progress.n_steps == 0 {
            let batch = first.as_ref().expect("just put there");
            self.state.progress.n_steps = self.choose_steps(learner, batch)?;
        } else if let Some(n_steps) = self.plan.named_steps() {
            self.state.progress.n_steps = n_steps;
        }
        self.state.progress.has_ended = false;
        let n_steps = self.state.progress.n_steps;
        self.watch.begin(L::STAGE, self.state.progress.step, n_steps);
        if let Some(journal) = &mut self.journal {
            journal.determined_by(&self.state.config, &self.state.data, n_steps);
            journal.begin(self.state.progress.step);
        }
        let before_s = self.state.progress.elapsed_s;
        let started = Instant::now();
        let mut last_save = Instant::now();
        if self.plan.validate_first && self.state.progress.step == 0 {
            self.validate(learner)?;
        }
        let end = loop {
            let step = self.state.progress.step;
            if step >= n_steps {
                break TrainingEnd::Done;
            }
            let elapsed_s = before_s + started.elapsed().as_secs_f64();
            let decided = self.decide(elapsed_s, last_save.elapsed())?;
            if decided.is_interrupted {
                break TrainingEnd::Interrupted;
            }
            if decided.is_out_of_time {
                break TrainingEnd::OutOfTime;
            }
            if decided.saves {
                self.state.progress.elapsed_s = elapsed_s;
                self.save(learner)?;
                last_save = Instant::now();
            }
            let batch = match first.take() {
                Some(batch) => batch,
                None => loader.next_batch()?,
            };
            let step_started = Instant::now();
            let taken = learner.step(&batch, step, n_steps)?;
            let took = step_started.elapsed();
            self.state.progress.elapsed_s = before_s + started.elapsed().as_secs_f64();
            self.after_step(learner, &batch, &taken, took, loader.waited())?;
            let done = self.state.progress.step;
            let epochs = self.plan.epochs_done(done);
            let is_new_epoch = epochs > self.plan.epochs_done(step);
            if is_new_epoch {
                self.end_epoch(epochs);
            }
            let every = |n: u64| n > 0 && is_new_epoch && epochs.is_multiple_of(n);
            let is_last = done >= n_steps;
            if every(self.plan.validate_every_epochs) || is_last {
                self.validate(learner)?;
                if self.is_stale() {
                    break TrainingEnd::Stale;
                }
            }
            let by_steps = self.plan.save_every_steps.is_some_and(|n| done.is_multiple_of(n));
            if (every(self.plan.save_every_epochs) || by_steps) && !is_last {
                self.state.progress.elapsed_s = before_s + started.elapsed().as_secs_f64();
                self.save(learner)?;
                last_save = Instant::now();
            }
        };
        self.state.progress.elapsed_s = before_s + started.elapsed().as_secs_f64();
        if end == TrainingEnd::OutOfTime {
            self.validate(learner)?;
        }
        self.state.progress.has_ended = end != TrainingEnd::Interrupted;
        self.save(learner)?;
        self.watch.end();
        Ok(end)
    }

    /// Returns how many steps to take: those that the plan names, or as many as fit into its time.
    ///
    /// The number is a part of the run's state from then on, because the learning rate depends on it.
    fn choose_steps<L: Learner>(
        &self,
        learner: &mut L,
        batch: &Batch,
    ) -> Result<u64, TrainingError> {
        let named = self.plan.named_steps();
        let Some(time) = self.plan.time else { return Ok(named.unwrap_or(u64::MAX)) };
        // The first asks the system for memory; those after it are like all others.
        learner.rehearse(batch)?;
        let started = Instant::now();
        let enough_s = TRIED_S.min(SHARE_TRIED * time.as_secs_f64());
        let mut n_tried = 0;
        // The first process's clock counts: a rehearsal is one of all processes.
        while self
            .is_true_of_first(n_tried < MIN_TRIED || started.elapsed().as_secs_f64() < enough_s)?
        {
            learner.rehearse(batch)?;
            n_tried += 1;
        }
        let n_tried = n_tried * learner.steps_of_rehearsal();
        let step_s = started.elapsed().as_secs_f64() / n_tried as f64;
        let fitting = (SHARE_OF_TIME * time.as_secs_f64() / step_s.max(1e-6)).floor();
        let fitting = self.ranks.of_first(&[fitting])?[0] as u64;
        Ok(named.unwrap_or(u64::MAX).min(fitting.max(1)))
    }

    /// Decides with the other processes what comes before the next step: any may ask for an end, the clock is that of the
    /// first.
    fn decide(&self, elapsed_s: f64, unsaved: Duration) -> Result<Decided, TrainingError> {
        let is_out_of_time = self.plan.time.is_some_and(|time| elapsed_s >= time.as_secs_f64());
        let own = [self.watch.is_interrupted(), is_out_of_time, unsaved >= self.plan.save_every];
        let all = self.ranks.share_numbers(&own.map(|x| f64::from(u8::from(x))))?;
        let is_true = |numbers: &Vec<f64>, i: usize| numbers.get(i).is_some_and(|&x| x > 0.0);
        Ok(Decided {
            is_interrupted: all.iter().any(|one| is_true(one, 0)),
            is_out_of_time: is_true(&all[0], 1),
            saves: is_true(&all[0], 2),
        })
    }

    fn is_true_of_first(&self, is_true: bool) -> Result<bool, TrainingError> {
        Ok(self.ranks.of_first(&[f64::from(u8::from(is_true))])?[0] > 0.0)
    }

    fn after_step<L: Learner>(
        &mut self,
        learner: &L,
        batch: &Batch,
        taken: &StepResult,
        took: Duration,
        waited: Duration,
    ) -> Result<(), TrainingError> {
        let is_skipped = !taken.is_finite();
        let epoch = self.plan.epoch(self.state.progress.step);
        let progress = &mut self.state.progress;
        progress.step += 1;
        (progress.n_updates, progress.n_averaged) = learner.n_updates();
        if is_skipped {
            progress.n_skipped += 1;
            progress.n_skipped_in_a_row += 1;
        } else {
            progress.n_skipped_in_a_row = 0;
            progress.epoch_loss.0 += taken.losses.total;
            progress.epoch_loss.1 += 1;
        }
        let (step, in_a_row) = (progress.step, progress.n_skipped_in_a_row);
        let entry = Entry {
            kind: RowKind::Step,
            epoch,
            step,
            losses: &taken.losses,
            live_loss: None,
            taken: Some(taken),
            is_skipped,
            samples_per_s: Some(batch.n_windows as f64 / took.as_secs_f64().max(1e-9)),
            data_wait_s: Some(waited.as_secs_f64()),
            resident_bytes: self.watch.resident_bytes(),
            elapsed_s: progress.elapsed_s,
        };
        if let Some(journal) = &mut self.journal {
            journal.add(entry);
        }
        self.watch.step(&format!("epoch {} loss {:.4}", epoch + 1, taken.losses.total));
        if in_a_row >= MAX_SKIPPED_IN_A_ROW {
            let mut phrases: Vec<_> = batch.phrase_ids.iter().map(ToString::to_string).collect();
            phrases.sort();
            phrases.dedup();
            let checkpoint = self.last_checkpoint();
            let (stage, n) = (L::STAGE, in_a_row);
            return Err(TrainingError::NotFinite { stage, n, step, phrases, checkpoint });
        }
        Ok(())
    }

    fn end_epoch(&mut self, epochs: u64) {
        let progress = &mut self.state.progress;
        let (sum, n) = std::mem::take(&mut progress.epoch_loss);
        let losses = Losses { total: sum / n as f64, parts: Vec::new() };
        if let Some(journal) = &mut self.journal {
            journal.add(Entry::of_epoch(RowKind::Epoch, epochs - 1, progress, &losses, None));
        }
    }

    fn validate<L: Learner>(&mut self, learner: &mut L) -> Result<(), TrainingError> {
        learner.collect_average()?;
        let found = self.validation(learner)?;
        let progress = &mut self.state.progress;
        let epoch = self.plan.epoch(progress.step.saturating_sub(1));
        let loss = found.losses.total;
        let now = Best { step: progress.step, loss, distance: found.distance };
        let is_better =
            loss.is_finite() && progress.best.is_none_or(|best| now.is_better_than(&best));
        let kind = RowKind::Validation;
        if let Some(journal) = &mut self.journal {
            journal.add(Entry::of_epoch(kind, epoch, progress, &found.losses, found.live));
        }
        if is_better {
            progress.best = Some(now);
            progress.n_stale = 0;
        } else {
            progress.n_stale += 1;
        }
        let step = progress.step;
        self.watch.note(&format!(
            "{}: step {step}, validation loss {loss:.4}{}{}",
            L::STAGE,
            found.distance.map_or(String::new(), |d| format!(", sampled distance {d:.3}")),
            if is_better { ", the best so far" } else { "" }
        ));
        if is_better && self.ranks.is_first() {
            let best = learner.best();
            self.write(CheckpointKind::Best, &best)?;
        }
        learner.release();
        Ok(())
    }

    /// Has the first process validate, and tells the others what it found.
    fn validation<L: Learner>(&self, learner: &mut L) -> Result<Validation, TrainingError> {
        if self.ranks.is_first() {
            let found = learner.validate()?;
            let distance = found.distance.unwrap_or(f64::NAN);
            self.ranks.of_first(&[found.losses.total, distance])?;
            return Ok(found);
        }
        let found = self.ranks.of_first(&[])?;
        let at = |i: usize| found.get(i).copied().unwrap_or(f64::NAN);
        let losses = Losses { total: at(0), parts: Vec::new() };
        let distance = Some(at(1)).filter(|distance| !distance.is_nan());
        Ok(Validation { losses, live: None, distance })
    }

    fn is_stale(&self) -> bool {
        self.plan.patience.is_some_and(|patience| self.state.progress.n_stale >= patience)
    }

    /// Writes the log, then the checkpoint.
    ///
    /// In this order, so that no checkpoint is ahead of the log: what was logged and not saved is done,
    /// and logged, again.
    fn save<L: Learner>(&mut self, learner: &mut L) -> Result<(), TrainingError> {
        let step = self.state.progress.step;
        learner.collect()?;
        let Some(journal) = &mut self.journal else { return Ok(()) };
        let done = {
            let watch = self.watch;
            let notice = |error: &StoreError, pause| notice(watch, error, pause);
            let patience = self.plan.store_patience;
            patience
                .wait_out(notice, || self.checkpoints.check_anchor(&self.anchor))
                .map_err(TrainingError::from)
                .and_then(|()| journal.commit(step, patience, &notice))
        };
        let done = done.and_then(|()| self.write(CheckpointKind::Step, &learner.sections()));
        learner.release();
        done.map_err(|source| TrainingError::NotSaved {
            stage: L::STAGE,
            step,
            checkpoint: self.last_checkpoint(),
            source: Box::new(source),
        })
    }

    fn write(&self, kind: CheckpointKind, sections: &[Section<f32>]) -> Result<(), TrainingError> {
        let mut outcome = Ok(());
        let written = self.plan.store_patience.wait_out(
            |error, pause| notice(self.watch, error, pause),
            || match self
                .checkpoints
                .check_anchor(&self.anchor)
                .map_err(TrainingError::from)
                .and_then(|()| self.checkpoints.write(kind, &self.state, sections))
            {
                Ok(_) => Ok(()),
                Err(TrainingError::Store(error)) => Err(error),
                Err(other) => {
                    outcome = Err(other);
                    Ok(())
                }
            },
        );
        written?;
        outcome
    }

    /// Returns what messages call the newest checkpoint.
    fn last_checkpoint(&self) -> String {
        match self.checkpoints.steps(CheckpointKind::Step).unwrap_or_default().last() {
            Some(&step) => self.checkpoints.place(CheckpointKind::Step, step),
            None => "none".to_owned(),
        }
    }
}

/// Says that the store does not answer.
pub fn notice(watch: &dyn Watch, error: &StoreError, pause: Duration) {
    watch.note(&format!("{error}; trying again in {:.0} s", pause.as_secs_f64()));
}
