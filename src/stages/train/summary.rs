//! What training came to, for people.

use std::io::{self, Write};

use crate::stages::Summary;
use crate::store::Location;
use crate::training::{Baselines, End, LeftOut, Progress};

/// Phrases left out that the account spells out.
const N_SHOWN: usize = 10;

/// What became of one network.
#[derive(Clone, Debug)]
pub struct StageAccount {
    stage: &'static str,
    started_at: u64,
    progress: Progress,
    end: End,
    baselines: Option<Baselines>,
}

impl StageAccount {
    /// Returns the account of a stage that began at a step and ended.
    pub fn of(stage: &'static str, progress: &Progress, started_at: u64, end: End) -> Self {
        Self { stage, started_at, progress: progress.clone(), end, baselines: None }
    }
}

/// What became of a run.
#[derive(Clone, Debug)]
pub struct Account {
    run: String,
    store: String,
    stages: Vec<StageAccount>,
    left_out: Vec<LeftOut>,
    resume: Option<String>,
}

impl Account {
    /// Begins the account of a run.
    pub fn new(run: &str, store: &Location, left_out: Vec<LeftOut>) -> Self {
        let (run, store) = (run.to_owned(), store.to_string());
        Self { run, store, stages: Vec::new(), left_out, resume: None }
    }

    /// Adds a stage.
    pub fn add(&mut self, stage: StageAccount) {
        self.stages.push(stage);
    }

    /// Holds the last stage's validation loss against what is lost without looking.
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

impl Summary for Account {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        for StageAccount { stage, started_at, progress, end, baselines } in &self.stages {
            let n = progress.step - started_at;
            let how = match end {
                End::Done if n == 0 => "was complete already",
                End::Done => "is complete",
                End::OutOfTime => "used up its time",
                End::Stale => "stopped improving",
                End::Interrupted => "was interrupted",
            };
            let minutes = progress.elapsed_s / 60.0;
            write!(out, "{stage}: {how}, {} steps in {minutes:.1} min", progress.step)?;
            if let Some(best) = progress.best {
                write!(out, ", best validation loss {:.4} at step {}", best.loss, best.step)?;
                if let Some(Baselines { constant, untrained }) = baselines {
                    let below = |loss: f64| 100.0 * (1.0 - best.loss / loss);
                    write!(
                        out,
                        " ({:.0} % below the best constant's {constant:.4}, {:.0} % below an untrained \
                         network's {untrained:.4})",
                        below(*constant),
                        below(*untrained)
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
        // Who interrupts wants to hear that all is well; the next call tells of phrases again.
        if self.resume.is_some() { 0 } else { self.left_out.len() as u64 }
    }
}

/// What would be done.
#[derive(Clone, Debug)]
pub struct DryRun {
    pub run: String,
    pub n_train: usize,
    pub n_validation: usize,
    pub n_left_out: usize,
    pub n_parameters: usize,
    pub steps_per_epoch: usize,
}

impl Summary for DryRun {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { run, n_train, n_validation, n_left_out, n_parameters, steps_per_epoch } = self;
        writeln!(
            out,
            "run {run} would train a UNet of {n_parameters} parameters on {n_train} windows, \
             {steps_per_epoch} steps an epoch, and validate on {n_validation}; {n_left_out} phrases are \
             left out"
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }
}
