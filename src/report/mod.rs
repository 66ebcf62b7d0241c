//! The report of an evaluation: what was measured, beside what it is compared with.
//!
//! A [`Report`] becomes one page of HTML that is complete in itself ([`page()`]), or text for a terminal
//! ([`terminal()`]). Everything here is pure: numbers in, text out; the same report gives the same text.
//! What the metrics mean, and under which heading they stand, is said in one place, `meaning`.

mod against;
mod channels;
mod chart;
mod comparison;
#[cfg(test)]
mod example;
mod html;
mod meaning;
mod names;
mod numbers;
mod page;
mod rows;
mod sanity;
mod summary;
mod tables;
mod terminal;

pub use meaning::{better, knows};
pub use page::page;
pub use terminal::terminal;

/// Which way a number is better.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Better {
    Higher,
    Lower,
    /// Neither: where the nearest to real motion is best, and where a number is there to read others by.
    #[default]
    Neither,
}

/// One measured number, as the table `metrics` has it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Metric {
    /// Whose number it is: `generated`, or what it is compared with, such as `held_out_truth`.
    pub subject: String,
    /// Which music: `all`, or `held_out`, which the model did not learn from.
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
    /// What was counted.
    pub n: i64,
    /// How it was measured.
    pub protocol: String,
    /// What [`better`] says of the metric, or what is known of one that it does not know.
    pub better: Better,
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
        (low.is_finite() && high.is_finite() && low <= high).then_some((low, high))
    }
}

/// How a verdict or one of its tests ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Outcome {
    Won,
    Lost,
    /// Not enough was measured to tell.
    #[default]
    Open,
}

impl Outcome {
    /// Returns the name of the outcome in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Won => "won",
            Self::Lost => "lost",
            Self::Open => "open",
        }
    }
}

/// One test that a verdict rests on.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct VerdictTest {
    pub test: String,
    pub outcome: Outcome,
    pub statistic: String,
    pub value: Option<f64>,
    pub ci_low: Option<f64>,
    pub ci_high: Option<f64>,
    pub unit: String,
    pub rule: String,
    pub limit: Option<f64>,
    pub against: String,
    pub message: String,
}

/// A verdict on a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Verdict {
    pub verdict: String,
    pub split: String,
    pub outcome: Outcome,
    pub tests: Vec<VerdictTest>,
}

/// A difference between two runs, song by song.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Paired {
    pub metric: String,
    pub variant: String,
    pub split: String,
    pub difference: f64,
    pub ci_low: Option<f64>,
    pub ci_high: Option<f64>,
    pub p_holm: Option<f64>,
    pub n_songs: usize,
}

/// How many motions passed one sanity check.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CheckLine {
    /// `reference` or `strict`; the two are never mixed.
    pub set: String,
    pub stage: String,
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
pub struct Worst {
    pub name: String,
    /// Names and values, in the order in which they are listed.
    pub facts: Vec<(String, String)>,
    /// Messages of the checks that it failed.
    pub failed: Vec<String>,
    /// A picture of it: a whole SVG file, as the plot of motion writes.
    pub svg: String,
}

/// Another run to compare with.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Against {
    pub run: String,
    pub metrics: Vec<Metric>,
    pub paired: Vec<Paired>,
    /// Settings that differ: name, there, here.
    pub settings: Vec<(String, String, String)>,
}

/// What a report tells.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    pub title: String,
    /// Names and values, in the order in which they are listed.
    pub facts: Vec<(String, String)>,
    pub verdicts: Vec<Verdict>,
    pub notes: Vec<String>,
    pub checks: Vec<CheckLine>,
    pub metrics: Vec<Metric>,
    pub worst: Vec<Worst>,
    pub against: Option<Against>,
}
