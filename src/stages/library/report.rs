//! What library did, in sentences.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::path::PathBuf;

use super::one::ConstructedPhrase;
use super::songs::Song;
use super::write::SongOutcome;
use crate::motion::choreography::{Formation, Unison};
use crate::stages::Summary;
use crate::stages::failure::{Failure, failures_json, write_failures, write_notes};

/// Counts of phrases, and of those of groups by what is known of them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct PhraseCounts {
    pub n: usize,
    /// Phrases by number of dancers.
    pub n_dancers: BTreeMap<usize, usize>,
    /// Phrases of groups by formation and by unison, `BETWEEN` where neither holds most of the phrase.
    pub formations: BTreeMap<&'static str, usize>,
    pub unisons: BTreeMap<&'static str, usize>,
}

/// What the summary says of a phrase in which one kind goes over into another.
const BETWEEN: &str = "between two";

impl PhraseCounts {
    pub fn count(&mut self, phrase: &ConstructedPhrase) {
        let n_dancers = phrase.n_dancers();
        self.n += 1;
        *self.n_dancers.entry(n_dancers).or_default() += 1;
        if n_dancers > 1 {
            let formation = phrase.formation.map_or(BETWEEN, Formation::name);
            let unison = phrase.unison.map_or(BETWEEN, Unison::name);
            *self.formations.entry(formation).or_default() += 1;
            *self.unisons.entry(unison).or_default() += 1;
        }
    }

    fn add(&mut self, other: &Self) {
        self.n += other.n;
        let add = |sum: &mut BTreeMap<&'static str, usize>, of: &BTreeMap<&'static str, usize>| {
            of.iter().for_each(|(kind, n)| *sum.entry(kind).or_default() += n);
        };
        add(&mut self.formations, &other.formations);
        add(&mut self.unisons, &other.unisons);
        for (n_dancers, n) in &other.n_dancers {
            *self.n_dancers.entry(*n_dancers).or_default() += n;
        }
    }

    /// Writes what groups were made, if any.
    fn write_groups(&self, out: &mut dyn Write) -> io::Result<()> {
        if self.formations.is_empty() {
            return Ok(());
        }
        let sizes: Vec<String> =
            self.n_dancers.iter().map(|(n_dancers, n)| format!("{n} of {n_dancers}")).collect();
        let kinds = |of: &BTreeMap<&'static str, usize>| {
            let kinds: Vec<String> = of.iter().map(|(kind, n)| format!("{n} {kind}")).collect();
            kinds.join(", ")
        };
        writeln!(out, "  phrases by number of dancers: {}", sizes.join(", "))?;
        writeln!(out, "  formations: {}", kinds(&self.formations))?;
        writeln!(out, "  unison: {}", kinds(&self.unisons))
    }
}

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
    pub phrases: BTreeMap<&'static str, PhraseCounts>,
    /// Phrases of songs that are gone.
    pub n_forgotten: usize,
    pub failed: Vec<(String, Failure)>,
    /// Whether songs are left because the user asked for an end.
    pub is_stopped: bool,
    /// What a reader should know of captures, with their names.
    pub noted: Vec<(String, String)>,
}

impl LibraryTally {
    pub fn add(&mut self, song: &Song, written: &SongOutcome) {
        match written {
            SongOutcome::Phrases(counts) => {
                self.n_done += 1;
                self.phrases.entry(song.split).or_default().add(counts);
            }
            SongOutcome::Unchanged => self.n_unchanged += 1,
        }
    }

    /// Returns the counts of all splits together.
    fn all_phrases(&self) -> PhraseCounts {
        let mut all = PhraseCounts::default();
        self.phrases.values().for_each(|counts| all.add(counts));
        all
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
            let phrases = tally.all_phrases();
            let n_phrases = phrases.n;
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
            phrases.write_groups(out)?;
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
        let phrases = tally.all_phrases();
        serde_json::json!({
            "store": place.store,
            "output": place.output,
            "dry_run": self.dry_run,
            "n_todo": tally.n_todo,
            "n_done": tally.n_done,
            "n_unchanged": tally.n_unchanged,
            "n_phrases": phrases.n,
            "n_dancers": phrases.n_dancers,
            "formations": phrases.formations,
            "unisons": phrases.unisons,
            "n_captures": tally.n_captures,
            "n_primitives": tally.n_primitives,
            "n_forgotten": tally.n_forgotten,
            "n_without_features": self.n_without_features,
            "failures": failures_json(tally.failed.iter().map(|(name, why)| (name, why))),
            "took_s": self.took_s,
        })
    }
}
