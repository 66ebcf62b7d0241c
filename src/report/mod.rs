//! The report of an evaluation: what was measured, beside what it is compared with, as a page and as text.
//!
//! Everything here is pure: numbers in, text out.

mod chart;
mod comparison;
mod grid;
mod meaning;
mod numbers;
mod page;
mod terminal;
#[cfg(test)]
mod tests;

pub use meaning::knows;
pub use page::page;
pub use terminal::terminal;

/// Subjects in the order in which they are shown: what was generated, its controls, real motion. Others come
/// after them.
const SUBJECTS: [&str; 6] =
    ["generated", "shuffled", "retrieval", "mean_motion", "held_out_truth", "ground_truth"];
/// The subject that the report is about.
const OWN: &str = SUBJECTS[0];

/// A number, as the table of metrics has it.
#[derive(Clone, Debug, PartialEq)]
pub struct Metric {
    /// Whose number it is.
    pub subject: String,
    /// Which music: `all` or `held_out`.
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
    pub n: i64,
    pub protocol: String,
}

/// How many motions passed a sanity check.
#[derive(Clone, Debug, PartialEq)]
pub struct CheckLine {
    /// `reference` or `strict`; the two are never mixed.
    pub set: String,
    pub check: String,
    pub threshold: f64,
    pub n: usize,
    pub n_passed: usize,
    /// The answer that is worst, and its message.
    pub worst_value: f64,
    pub worst_message: String,
}

/// A motion that is worth a look.
#[derive(Clone, Debug, PartialEq)]
pub struct Worst {
    pub name: String,
    pub facts: Vec<(String, String)>,
    /// Messages of the checks that it failed.
    pub failed: Vec<String>,
    /// A picture of it: a whole SVG, which is trusted.
    pub svg: String,
}

/// Another run to compare with.
#[derive(Clone, Debug, PartialEq)]
pub struct Against {
    pub run: String,
    pub metrics: Vec<Metric>,
    /// Settings that differ: name, there, here.
    pub settings: Vec<(String, String, String)>,
}

/// What is told.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    pub title: String,
    pub facts: Vec<(String, String)>,
    pub checks: Vec<CheckLine>,
    pub metrics: Vec<Metric>,
    pub worst: Vec<Worst>,
    pub against: Option<Against>,
}

impl Report {
    /// Returns a number of the report.
    fn find(&self, subject: &str, split: &str, metric: &str, variant: &str) -> Option<&Metric> {
        self.metrics.iter().find(|m| {
            m.subject == subject && m.split == split && m.metric == metric && m.variant == variant
        })
    }

    /// Returns which music the short account is of: that which the model did not learn from, where there is.
    fn main_split(&self) -> &str {
        let of_own = || self.metrics.iter().filter(|m| m.subject == OWN);
        let held_out = of_own().find(|m| m.split == "held_out");
        held_out.or_else(|| of_own().next()).map_or("all", |m| m.split.as_str())
    }
}
