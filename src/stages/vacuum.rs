//! `vacuum`: what has been dead for long enough goes.

use std::fmt;
use std::io::{self, Write};
use std::str::FromStr;
use std::time::Duration;

use super::{ClientParams, Contract, Progress, Stage, Summary};
use crate::store::{self, Location, VacuumRemovals};

/// The stage.
pub struct Vacuum;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket that holds the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// How long parts have been dead that go: a number of s, m, h, d or w. Longer than the longest run, which may
    /// read them until its end.
    #[arg(long, value_name = "AGE", default_value_t = Age(Duration::from_secs(7 * 24 * 3600)))]
    pub older_than: Age,
    /// List what would go, and remove nothing.
    #[arg(long)]
    pub dry_run: bool,
    #[command(flatten)]
    pub client: ClientParams,
}

/// Units of an age, and their lengths in seconds.
const UNITS: [(char, u64); 5] =
    [('w', 7 * 24 * 3600), ('d', 24 * 3600), ('h', 3600), ('m', 60), ('s', 1)];

/// A length of time, as `7d` or `36h`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Age(pub Duration);

impl FromStr for Age {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || "use a number and s, m, h, d or w, such as 7d".to_owned();
        let unit = text.chars().last().ok_or_else(wrong)?;
        let (_, seconds) = UNITS.iter().find(|(name, _)| *name == unit).ok_or_else(wrong)?;
        let n: u64 = text[..text.len() - 1].parse().map_err(|_| wrong())?;
        n.checked_mul(*seconds).map(Duration::from_secs).map(Self).ok_or_else(wrong)
    }
}

impl fmt::Display for Age {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.0.as_secs();
        let is_whole = |(_, unit): &&(char, u64)| seconds >= *unit && seconds.is_multiple_of(*unit);
        // Seven days are a week, but ages are usually given in days, so that weeks are not printed.
        let (name, unit) = UNITS.iter().skip(1).find(is_whole).unwrap_or(&('s', 1));
        write!(f, "{}{name}", seconds / unit)
    }
}

impl Stage for Vacuum {
    const NAME: &'static str = "vacuum";
    const ABOUT: &'static str = "remove parts whose rows were all superseded";
    const CONTRACT: Contract =
        Contract { reads: "every commit", writes: "nothing; removes dead parts and their commits" };
    type Params = Params;

    fn run(params: Params, _progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let store = Location::open(&params.store, &params.client.options())?;
        let done = store::vacuum(&store, params.older_than.0, params.dry_run)?;
        let Params { older_than, dry_run, .. } = params;
        Ok(Box::new(VacuumSummary { store: store.to_string(), older_than, dry_run, done }))
    }
}

struct VacuumSummary {
    store: String,
    older_than: Age,
    dry_run: bool,
    done: VacuumRemovals,
}

impl Summary for VacuumSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let VacuumRemovals { paths, n_bytes, n_kept } = &self.done;
        writeln!(out, "vacuum {}", self.store)?;
        if self.dry_run {
            for path in paths {
                writeln!(out, "  {path}")?;
            }
        }
        let verb = if self.dry_run { "would remove" } else { "removed" };
        let megabytes = *n_bytes as f64 / 1e6;
        writeln!(out, "  {verb} {} files, {megabytes:.1} MB", paths.len())?;
        if *n_kept > 0 {
            writeln!(
                out,
                "  {n_kept} commits are dead for less than {} or still named by a Delta Lake log",
                self.older_than
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let VacuumRemovals { paths, n_bytes, n_kept } = &self.done;
        serde_json::json!({
            "store": self.store,
            "dry_run": self.dry_run,
            "older_than_s": self.older_than.0.as_secs(),
            "paths": paths,
            "n_files": paths.len(),
            "n_bytes": n_bytes,
            "n_kept": n_kept,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ages_are_read_and_said() {
        for (text, seconds, said) in [
            ("7d", 604_800, "7d"),
            ("0s", 0, "0s"),
            ("90m", 5400, "90m"),
            ("2w", 1_209_600, "14d"),
            ("36h", 129_600, "36h"),
        ] {
            let age: Age = text.parse().expect(text);
            assert_eq!((age.0.as_secs(), age.to_string().as_str()), (seconds, said), "{text}");
        }
        for text in ["", "7", "d", "7 days", "-1d", "1.5h", "7ü", "99999999999999999999w"] {
            assert!(text.parse::<Age>().is_err(), "{text}");
        }
    }
}
