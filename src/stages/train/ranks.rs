//! Training by several processes that `mpirun` or `srun` started: who they are, and that they agree.

use std::sync::Arc;

use anyhow::bail;

use crate::stages::{Progress, Summary};
use crate::training::{Ranks, TrainingError};

/// Variables by which launchers tell a process how many they started: Open MPI, MPICH and PMI-2, Slurm's steps.
const SIZES: [(&str, &str); 3] = [
    ("OMPI_COMM_WORLD_SIZE", "mpirun"),
    ("PMI_SIZE", "mpiexec or srun"),
    ("SLURM_STEP_NUM_TASKS", "srun"),
];

/// Returns how many processes the launcher started, and what it is called; none where there is no launcher.
fn told(variable: impl Fn(&str) -> Option<String>) -> Option<(usize, &'static str)> {
    SIZES.iter().find_map(|(name, launcher)| {
        let size = variable(name)?.trim().parse::<usize>().ok()?;
        (size > 0).then_some((size, *launcher))
    })
}

/// Refuses to run as one of several processes that would all do the same.
///
/// # Errors
/// When a launcher started more than one.
pub fn refuse_others(command: &str) -> anyhow::Result<()> {
    match told(|name| std::env::var(name).ok()) {
        Some((size, launcher)) if size > 1 => bail!(
            "{launcher} started {size} processes of {command}, which runs in one; start it without {launcher}, or with -n 1"
        ),
        _ => Ok(()),
    }
}

/// Joins the other processes that a launcher started with this one.
///
/// # Errors
/// When MPI does not start, and when the processes run different executables.
#[cfg(feature = "mpi")]
pub fn join() -> anyhow::Result<Arc<Ranks>> {
    use crate::training::MpiLink;
    let Some((size, _)) = told(|name| std::env::var(name).ok()).filter(|(size, _)| *size > 1)
    else {
        return Ok(Ranks::alone());
    };
    let ranks = Ranks::start(move || MpiLink::start(size))?;
    let own = identity();
    let all: Vec<[String; 2]> = ranks.share(&own)?;
    if let Some((rank, other)) = all.iter().enumerate().find(|(_, other)| other[1] != all[0][1]) {
        return refuse(
            &ranks,
            format!(
                "rank 0 on {} runs another executable ({}) than rank {rank} on {} ({}); give all nodes the same",
                all[0][0], all[0][1], other[0], other[1]
            ),
        );
    }
    Ok(ranks)
}

/// Refuses several processes: this executable was built without MPI.
///
/// # Errors
/// When a launcher started more than one.
#[cfg(not(feature = "mpi"))]
pub fn join() -> anyhow::Result<Arc<Ranks>> {
    match told(|name| std::env::var(name).ok()) {
        Some((size, launcher)) if size > 1 => bail!(
            "{launcher} started {size} processes of train, but this executable was built without MPI, so each would train \
             the same run; build it with --features mpi, or start one process"
        ),
        _ => Ok(Ranks::alone()),
    }
}

/// Returns the name of the machine, and version and digest of the executable.
#[cfg(feature = "mpi")]
fn identity() -> [String; 2] {
    let version = env!("CARGO_PKG_VERSION");
    let bytes = std::env::current_exe().and_then(std::fs::read);
    let digest = bytes.map_or_else(|e| e.to_string(), |bytes| crate::store::digest(&bytes));
    let digest: String = digest.chars().take(12).collect();
    [host(), format!("{version}, {digest}")]
}

fn host() -> String {
    let name = std::fs::read_to_string("/proc/sys/kernel/hostname");
    name.map_or_else(|_| "an unnamed machine".to_owned(), |name| name.trim().to_owned())
}

/// Ends all processes with a sentence that the first one says.
fn refuse<T>(ranks: &Ranks, sentence: String) -> anyhow::Result<T> {
    take_leave(ranks);
    if ranks.is_first() { bail!(sentence) } else { bail!(SaidByFirst) }
}

/// Takes leave of the others where all end with an error at the same place: a launcher kills those that are left when one
/// ends without, before the first has said why.
fn take_leave(ranks: &Ranks) {
    // A process that has ended has already reported its error.
    ranks.finish().ok();
}

/// An error that the first process reports.
#[derive(Debug, thiserror::Error)]
#[error("the first rank says why")]
struct SaidByFirst;

/// Returns the outcome of a process, unless one of them failed; then the first says which, and why.
///
/// # Errors
/// The error of the first process that has one.
pub fn agreed<T>(ranks: &Ranks, outcome: anyhow::Result<T>) -> anyhow::Result<T> {
    if ranks.is_alone() {
        return outcome;
    }
    let sentence = outcome.as_ref().err().map(|error| format!("{error:#}"));
    let all: Vec<(Option<String>, String)> = ranks.share(&(sentence, host()))?;
    let failed = all.iter().enumerate().find_map(|(rank, (sentence, host))| {
        sentence.as_ref().map(|sentence| (rank, sentence, host))
    });
    match (failed, outcome) {
        (None, outcome) => outcome,
        (Some((0, ..)), Err(own)) if ranks.is_first() => {
            take_leave(ranks);
            Err(own)
        }
        (Some((rank, sentence, host)), _) => {
            refuse(ranks, format!("rank {rank} on {host}: {sentence}"))
        }
    }
}

/// Refuses processes that see other things where they should see the same.
///
/// # Errors
/// When they do.
pub fn check_same(ranks: &Ranks, what: &str, own: &str) -> anyhow::Result<()> {
    let all: Vec<[String; 2]> = ranks.share(&[own.to_owned(), host()])?;
    match all.iter().enumerate().find(|(_, other)| other[0] != all[0][0]) {
        None => Ok(()),
        Some((rank, other)) => refuse(
            ranks,
            format!(
                "rank 0 on {} and rank {rank} on {} see different phrases in {what}; name a folder that every node \
                 sees, or a bucket",
                all[0][1], other[1]
            ),
        ),
    }
}

/// Runs training on all processes: the first tells of it, the others are silent.
///
/// # Errors
/// Errors of `run`.
pub fn on_all(
    progress: &dyn Progress,
    run: impl FnOnce(&Arc<Ranks>, &dyn Progress) -> anyhow::Result<Box<dyn Summary>>,
) -> anyhow::Result<Box<dyn Summary>> {
    let silent = Unheard(progress);
    let ranks = match join() {
        Err(error) if error.is::<SaidByFirst>() => return Ok(Box::new(Nothing)),
        joined => joined?,
    };
    let progress: &dyn Progress = if ranks.is_first() { progress } else { &silent };
    let done = run(&ranks, progress);
    let is_of_all = |error: &anyhow::Error| {
        matches!(error.downcast_ref(), Some(TrainingError::NotFinite { .. }))
    };
    if done.as_ref().err().is_some_and(is_of_all) {
        take_leave(&ranks);
    }
    let is_said = |error: &anyhow::Error| error.is::<SaidByFirst>() || is_of_all(error);
    match done {
        Ok(summary) => {
            // A launcher ends the others as soon as one has ended with an error, so none ends before all are done.
            ranks.finish()?;
            let nothing: Box<dyn Summary> = Box::new(Nothing);
            Ok(if ranks.is_first() { summary } else { nothing })
        }
        Err(error) if !ranks.is_first() && is_said(&error) => Ok(Box::new(Nothing)),
        Err(error) => Err(error),
    }
}

/// The progress of a process that is not the first: it shows nothing, but may be interrupted.
struct Unheard<'a>(&'a dyn Progress);

impl Progress for Unheard<'_> {
    fn start(&self, _what: &str, _unit: &str, _total: u64) {}
    fn start_audio(&self, _what: &str, _total_s: u64) {}
    fn skip(&self, _n: u64) {}
    fn advance(&self, _n: u64) {}
    fn say(&self, _text: &str) {}
    fn note(&self, _line: &str) {}
    fn is_interrupted(&self) -> bool {
        self.0.is_interrupted()
    }
    fn finish(&self) {}
}

/// The summary of a process that is not the first.
struct Nothing;

impl Summary for Nothing {
    fn write(&mut self, _out: &mut dyn std::io::Write) -> std::io::Result<()> {
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn is_told(&self) -> bool {
        false
    }

    fn figures(&mut self) -> serde_json::Value {
        serde_json::json!({})
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn launchers_tell_how_many_they_started() {
        let found = |known: &[(&str, &str)]| {
            told(|name| known.iter().find(|(n, _)| *n == name).map(|(_, x)| (*x).to_owned()))
        };
        assert_eq!(found(&[]), None);
        assert_eq!(found(&[("OMPI_COMM_WORLD_SIZE", "4")]), Some((4, "mpirun")));
        assert_eq!(
            found(&[("PMI_SIZE", "2"), ("SLURM_STEP_NUM_TASKS", "1")]),
            Some((2, "mpiexec or srun"))
        );
        assert_eq!(found(&[("SLURM_STEP_NUM_TASKS", "3")]), Some((3, "srun")));
        // A job of three tasks whose script is one process.
        assert_eq!(found(&[("SLURM_NTASKS", "3")]), None);
        assert_eq!(found(&[("PMI_SIZE", "0")]), None);
        assert_eq!(found(&[("PMI_SIZE", "many")]), None);
    }
}
