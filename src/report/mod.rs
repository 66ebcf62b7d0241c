//! The report of an evaluation: what was measured, beside what it is compared with.
//!
//! A [`Report`] becomes one page of HTML that is complete in itself ([`page()`]), or text for a terminal
//! ([`terminal()`]). Everything here is pure: numbers in, text out; the same report gives the same text.
//! What the metrics mean, and under which heading they stand, is said in one place, `meaning`.
//! Either begins with the verdicts, lost ones first; nothing is called good that no verdict or paired test
//! bears out.

mod against;
mod channels;
mod chart;
mod comparison;
mod dial;
#[cfg(test)]
mod example;
mod meaning;
mod names;
mod numbers;
mod page;
mod panel;
mod rows;
mod sanity;
mod tables;
mod terminal;
mod verdicts;

pub use meaning::{better, knows};
pub use page::page;
pub use terminal::terminal;

/// Stands in the protocol of a number, or for the number itself, that post-processing makes what it is.
pub const BY_CONSTRUCTION: &str = "by construction";

/// How a test ended, or a verdict that rests on several.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outcome {
    /// It holds.
    Won,
    /// It does not hold.
    Lost,
    /// Too little was measured to tell.
    #[default]
    Open,
}

impl Outcome {
    /// Every outcome, in the order in which verdicts are shown.
    pub const ALL: [Self; 3] = [Self::Lost, Self::Open, Self::Won];

    /// Returns the name of the outcome in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Won => "won",
            Self::Lost => "lost",
            Self::Open => "open",
        }
    }

    /// Returns the outcome of a name in tables; none for another name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|outcome| outcome.name() == name)
    }
}

/// One test that a verdict rests on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VerdictTest {
    /// Its name in tables, such as `other_music`.
    pub test: String,
    pub outcome: Outcome,
    /// The measured statistic, in words.
    pub statistic: String,
    /// None where there is too little to tell; such a test is not shown as won.
    pub value: Option<f64>,
    /// Ends of the interval of the value.
    pub ci_low: Option<f64>,
    pub ci_high: Option<f64>,
    pub unit: String,
    /// How the value must stand to the limit: `at most`, `at least`, `below`.
    pub rule: String,
    pub limit: Option<f64>,
    /// What the value is held against, such as `held-out real motion 0.49`.
    pub against: String,
    /// One sentence with the numbers.
    pub message: String,
}

/// The answer of several tests to one question about a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    /// `sound`, `like_real`, `follows_music` or `varied`; of groups also `together`.
    pub verdict: String,
    /// Which music, as a metric has it.
    pub split: String,
    pub outcome: Outcome,
    /// All of them must hold.
    pub tests: Vec<VerdictTest>,
}

/// Which way a number is better.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum BetterDirection {
    Higher,
    Lower,
    /// Neither: where the nearest to real motion is best, and where a number is there to read others by.
    #[default]
    Neither,
}

/// One measured number, as the table `metrics` has it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metric {
    /// The subject that was measured: `generated`, or what it is compared with, such as `held_out_truth`.
    pub subject: String,
    /// Which music: `all`, `held_out`, `validation`, `trained_on` or `unknown`.
    pub split: String,
    pub metric: String,
    /// Which of several ways to measure it; empty where there is one.
    pub variant: String,
    pub unit: String,
    /// None where there is too little to tell.
    pub value: Option<f64>,
    /// Ends of its 95 % interval.
    pub ci_low: Option<f64>,
    pub ci_high: Option<f64>,
    /// How many items were measured.
    pub n: i64,
    /// How it was measured.
    pub protocol: String,
    /// What [`better`] says of the metric, or what is known of one that it does not know.
    pub better: BetterDirection,
}

impl Metric {
    /// Returns the value, if it is a number.
    fn finite(&self) -> Option<f64> {
        self.value.filter(|x| x.is_finite())
    }

    /// Returns the interval of a value that is a number, if both ends are numbers in order.
    fn interval(&self) -> Option<(f64, f64)> {
        self.finite()?;
        let (low, high) = (self.ci_low?, self.ci_high?);
        ordered(low, high)
    }

    /// Returns whether post-processing makes the number what it is.
    fn is_by_construction(&self) -> bool {
        self.protocol.contains(BY_CONSTRUCTION)
    }
}

/// Returns ends that are numbers in order.
fn ordered(low: f64, high: f64) -> Option<(f64, f64)> {
    (low.is_finite() && high.is_finite() && low <= high).then_some((low, high))
}

/// How many motions passed one sanity check.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CheckLine {
    /// `reference` or `strict`; the two are never mixed.
    pub set: String,
    /// `raw`: decoded motion before post-processing; `final`, or empty in old tables: after it.
    pub stage: String,
    /// Post-processing makes it true, so that it counts in no pass rate.
    pub by_construction: bool,
    pub check: String,
    pub threshold: f64,
    pub n: usize,
    pub n_passed: usize,
    /// The answer that is worst, in the unit of the threshold, and its message.
    pub worst_value: f64,
    pub worst_message: String,
}

/// A motion worth looking at.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct WorstMotion {
    pub name: String,
    /// Names and values, in the order in which they are listed.
    pub facts: Vec<(String, String)>,
    /// Messages of the checks that it failed.
    pub failed: Vec<String>,
    /// A picture of it: a whole SVG file, as the plot of motion writes.
    pub svg: String,
}

/// A number of what was generated in both runs, compared song by song.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PairedNumber {
    pub metric: String,
    pub variant: String,
    pub split: String,
    /// Here less there, mean over songs.
    pub difference: f64,
    /// Ends of its 95 % interval.
    pub ci_low: Option<f64>,
    pub ci_high: Option<f64>,
    /// Probability of such a difference by chance, adjusted by Holm over all numbers that are paired; none
    /// where there are too few songs to tell.
    pub p_holm: Option<f64>,
    pub n_songs: usize,
}

/// Another run to compare with.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ComparedRun {
    pub run: String,
    pub metrics: Vec<Metric>,
    /// Differences of the numbers that could be paired by song.
    pub paired: Vec<PairedNumber>,
    /// Settings that differ: name, there, here.
    pub settings: Vec<(String, String, String)>,
}

/// A run of groups of the same model, at its consistency.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DialRun {
    pub run: String,
    /// γ, from -1 to 1.
    pub consistency: f64,
    /// Whether it is the run that the report is about.
    pub is_this: bool,
    pub metrics: Vec<Metric>,
}

/// The content of a report.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    pub title: String,
    /// Names and values, in the order in which they are listed.
    pub facts: Vec<(String, String)>,
    /// One that is missing is shown as open.
    pub verdicts: Vec<Verdict>,
    /// Caveats, a sentence each, which stand right below the verdicts.
    pub notes: Vec<String>,
    pub checks: Vec<CheckLine>,
    pub metrics: Vec<Metric>,
    pub worst: Vec<WorstMotion>,
    pub against: Option<ComparedRun>,
    /// Runs of groups at several degrees of consistency, this one among them, in order of γ.
    pub dial: Vec<DialRun>,
}
