//! What training came to, for people.

use std::io::{self, Write};

use serde_json::json;

use crate::stages::Summary;
use crate::store::Location;
use crate::training::{Baselines, ExcludedPhrase, Progress, TrainingEnd};

/// Phrases left out that the account spells out.
const N_SHOWN: usize = 10;

/// The outcome of training one network.
#[derive(Clone, Debug)]
pub struct StageSummary {
    stage: &'static str,
    started_at: u64,
    progress: Progress,
    end: TrainingEnd,
    baselines: Option<Baselines>,
}

impl StageSummary {
    /// Returns the account of a stage that began at a step and ended.
    pub fn of(stage: &'static str, progress: &Progress, started_at: u64, end: TrainingEnd) -> Self {
        Self { stage, started_at, progress: progress.clone(), end, baselines: None }
    }
}

/// The summary of a run.
#[derive(Clone, Debug)]
pub struct TrainSummary {
    run: String,
    store: String,
    stages: Vec<StageSummary>,
    left_out: Vec<ExcludedPhrase>,
    resume: Option<String>,
}

impl TrainSummary {
    /// Begins the account of a run.
    pub fn new(run: &str, store: &Location, left_out: Vec<ExcludedPhrase>) -> Self {
        let (run, store) = (run.to_owned(), store.to_string());
        Self { run, store, stages: Vec::new(), left_out, resume: None }
    }

    /// Adds a stage.
    pub fn add(&mut self, stage: StageSummary) {
        self.stages.push(stage);
    }

    /// Compares the last stage's validation loss with those of predictors that ignore their input.
    pub fn beside(&mut self, baselines: Baselines) {
        if let Some(stage) = self.stages.last_mut() {
            stage.baselines = Some(baselines);
        }
    }

    /// Says how to go on.
    pub fn interrupted(mut self, resume: &str) -> Self {
        self.resume = Some(resume.to_owned());
        self
    }
}

impl Summary for TrainSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        for StageSummary { stage, started_at, progress, end, baselines } in &self.stages {
            let n = progress.step - started_at;
            let how = match end {
                TrainingEnd::Done if n == 0 => "was complete already",
                TrainingEnd::Done => "is complete",
                TrainingEnd::OutOfTime => "used up its time",
                TrainingEnd::Stale => "stopped improving",
                TrainingEnd::Interrupted => "was interrupted",
            };
            let minutes = progress.elapsed_s / 60.0;
            write!(out, "{stage}: {how}, {} steps in {minutes:.1} min", progress.step)?;
            if let Some(best) = progress.best {
                write!(out, ", best validation loss {:.4} at step {}", best.loss, best.step)?;
                if let Some(Baselines { constant, untrained }) = baselines {
                    write!(
                        out,
                        " ({} the best constant's {constant:.4}, {} an untrained network's {untrained:.4})",
                        beside(best.loss, *constant),
                        beside(best.loss, *untrained)
                    )?;
                }
            }
            if progress.n_skipped > 0 {
                write!(out, ", {} steps skipped (not finite)", progress.n_skipped)?;
            }
            writeln!(out)?;
        }
        for one in self.left_out.iter().take(N_SHOWN) {
            writeln!(out, "left out: {}", one.message)?;
        }
        if self.left_out.len() > N_SHOWN {
            writeln!(out, "… and {} more", self.left_out.len() - N_SHOWN)?;
        }
        match &self.resume {
            Some(command) => writeln!(out, "saved; go on with: {command}"),
            None => writeln!(out, "run {} is in {}", self.run, self.store),
        }
    }

    fn n_failed(&self) -> u64 {
        self.left_out.iter().filter(|one| !one.is_for_other_models()).count() as u64
    }

    fn is_stopped(&self) -> bool {
        self.resume.is_some()
    }

    fn figures(&mut self) -> serde_json::Value {
        let stages = self.stages.iter().map(|stage| {
            let StageSummary { stage, started_at, progress, end, baselines } = stage;
            let end = match end {
                TrainingEnd::Done => "complete",
                TrainingEnd::OutOfTime => "out_of_time",
                TrainingEnd::Stale => "stale",
                TrainingEnd::Interrupted => "interrupted",
            };
            json!({
                "stage": stage,
                "end": end,
                "n_steps": progress.step,
                "n_new_steps": progress.step - started_at,
                "n_skipped": progress.n_skipped,
                "elapsed_s": progress.elapsed_s,
                "best_step": progress.best.map(|best| best.step),
                "best_validation_loss": progress.best.map(|best| best.loss),
                "loss_of_best_constant": baselines.as_ref().map(|known| known.constant),
                "loss_of_untrained_network": baselines.as_ref().map(|known| known.untrained),
            })
        });
        let left_out =
            self.left_out.iter().take(N_SHOWN).map(
                |one| json!({ "item": one.phrase_id, "kind": one.kind, "message": one.message }),
            );
        json!({
            "run": self.run,
            "store": self.store,
            "stages": stages.collect::<Vec<_>>(),
            "failures": left_out.collect::<Vec<_>>(),
            "resume": self.resume,
        })
    }
}

/// Says how far a loss is below another, or above it.
fn beside(loss: f64, other: f64) -> String {
    let percent = 100.0 * (1.0 - loss / other);
    if percent < 0.0 { format!("{:.0} % above", -percent) } else { format!("{percent:.0} % below") }
}

/// The summary of a dry run.
#[derive(Clone, Debug)]
pub struct TrainDryRun {
    pub run: String,
    /// What the run would do.
    pub what: String,
    pub n_train: usize,
    pub n_validation: usize,
    pub n_left_out: usize,
    pub steps_per_epoch: usize,
}

impl Summary for TrainDryRun {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { run, what, n_train, n_validation, n_left_out, steps_per_epoch } = self;
        writeln!(
            out,
            "run {run} would {what} on {n_train} windows, {steps_per_epoch} steps an epoch, and validate on \
             {n_validation}; {n_left_out} phrases are left out"
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        json!({
            "run": self.run,
            "dry_run": true,
            "n_train_windows": self.n_train,
            "n_validation_windows": self.n_validation,
            "n_left_out": self.n_left_out,
            "steps_per_epoch": self.steps_per_epoch,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_is_above_or_below_another_and_never_minus_so_much_below() {
        assert_eq!(beside(0.3, 0.4), "25 % below");
        assert_eq!(beside(0.96, 0.4192), "129 % above");
        assert_eq!(beside(0.4, 0.4), "0 % below");
    }
}
