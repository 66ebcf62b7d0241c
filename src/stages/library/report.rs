//! What library did, in sentences.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::PathBuf;

use super::songs::Song;
use super::write::SongOutcome;
use crate::stages::Summary;
use crate::stages::failure::{Failure, failures_json, write_failures, write_notes};

/// Counts of songs, captures and phrases that were constructed, unchanged or failed.
#[derive(Debug, Default)]
pub struct LibraryTally {
    pub n_todo: usize,
    pub n_done: usize,
    /// Songs whose phrases the store has.
    pub n_unchanged: usize,
    pub n_captures: usize,
    pub n_primitives: usize,
    /// New phrases by split.
    pub phrases: BTreeMap<&'static str, usize>,
    /// Phrases of songs that are gone.
    pub n_forgotten: usize,
    pub failed: Vec<(String, Failure)>,
    /// Whether songs are left because the user asked for an end.
    pub is_stopped: bool,
    /// What a reader should know of captures, with their names.
    pub noted: Vec<(String, String)>,
}

impl LibraryTally {
    pub fn add(&mut self, song: &Song, written: SongOutcome) {
        match written {
            SongOutcome::Phrases(n) => {
                self.n_done += 1;
                *self.phrases.entry(song.split).or_default() += n;
            }
            SongOutcome::Unchanged => self.n_unchanged += 1,
        }
    }
}

pub struct LibraryPlace {
    pub store: String,
    pub output: Option<PathBuf>,
}

pub struct LibrarySummary {
    pub place: LibraryPlace,
    pub dry_run: bool,
    /// Songs of every split.
    pub splits: [(usize, &'static str); 3],
    pub n_without_features: usize,
    pub tally: LibraryTally,
    pub took_s: f64,
}

impl Summary for LibrarySummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let LibrarySummary { place, tally, took_s, .. } = self;
        let LibraryPlace { store, output } = place;
        let n_failed = tally.failed.len();
        writeln!(out, "library → {store}")?;
        let splits: Vec<String> =
            self.splits.iter().map(|(n, split)| format!("{n} {split}")).collect();
        let splits = splits.join(", ");
        if self.dry_run {
            writeln!(
                out,
                "  would dance to {} songs, leave {} as they are ({splits})",
                tally.n_todo, tally.n_unchanged
            )?;
            return Ok(());
        }
        if tally.n_todo == 0 {
            writeln!(
                out,
                "  nothing to do: {} songs are up to date ({splits})",
                tally.n_unchanged
            )?;
        } else {
            let n_phrases: usize = tally.phrases.values().sum();
            writeln!(
                out,
                "  {} songs danced to ({n_phrases} phrases), {} up to date, {n_failed} failed; \
                 {took_s:.1} s",
                tally.n_done, tally.n_unchanged
            )?;
            writeln!(
                out,
                "  {} primitives of {} captures; songs split into {splits}",
                tally.n_primitives, tally.n_captures
            )?;
        }
        if tally.is_stopped {
            writeln!(out, "  stopped as asked; the same command goes on with what is missing")?;
        }
        if tally.n_forgotten > 0 {
            writeln!(out, "  {} phrases left with their songs", tally.n_forgotten)?;
        }
        if self.n_without_features > 0 {
            let n = self.n_without_features;
            writeln!(
                out,
                "  {n} phrases with audio have no features; run extract to dance to them"
            )?;
        }
        if let Some(output) = output {
            writeln!(out, "  files: {}", output.display())?;
        }
        let noted = tally.noted.iter().map(|(name, note)| (name, note.as_str()));
        write_notes(out, noted, None)?;
        write_failures(out, tally.failed.iter().map(|(name, why)| (name, why)), Some(store))
    }

    fn n_failed(&self) -> u64 {
        if self.dry_run { 0 } else { self.tally.failed.len() as u64 }
    }

    fn is_stopped(&self) -> bool {
        self.tally.is_stopped
    }

    fn figures(&mut self) -> serde_json::Value {
        let LibrarySummary { place, tally, .. } = self;
        serde_json::json!({
            "store": place.store,
            "output": place.output,
            "dry_run": self.dry_run,
            "n_todo": tally.n_todo,
            "n_done": tally.n_done,
            "n_unchanged": tally.n_unchanged,
            "n_phrases": tally.phrases.values().sum::<usize>(),
            "n_captures": tally.n_captures,
            "n_primitives": tally.n_primitives,
            "n_forgotten": tally.n_forgotten,
            "n_without_features": self.n_without_features,
            "failures": failures_json(tally.failed.iter().map(|(name, why)| (name, why))),
            "took_s": self.took_s,
        })
    }
}
