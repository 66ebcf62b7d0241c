//! Stages: what the user runs. Each has a contract, parameters, a run and a summary.

mod batch;
pub mod beats;
pub mod compact;
pub mod evaluate;
pub mod export;
pub mod extract;
pub mod failure;
pub mod feature_file;
pub mod finetune;
pub mod generate;
pub mod ingest;
mod item_state;
pub mod learned;
mod lease;
pub mod library;
pub mod model;
mod model_files;
mod model_folder;
mod motion_source;
pub mod plot;
mod pool;
mod pretrained;
#[cfg(feature = "query")]
pub mod query;
mod retrieval;
pub mod status;
pub mod tokenize;
mod tokens_model;
mod touched;
pub mod train;
mod trained;
pub mod vacuum;
mod validation_motion;
pub mod view;

use std::io::{self, Write};
use std::num::NonZeroUsize;

use crate::store::ClientOptions;
pub use crate::store::{STANDARD_OUTPUT, is_standard_output, lines, one_line, redacted};

/// One stage of the pipeline.
pub trait Stage {
    /// The verb that the user types.
    const NAME: &'static str;
    /// One line for the list of stages.
    const ABOUT: &'static str;
    /// Tables read and written, for the help text.
    const CONTRACT: Contract;
    type Params: clap::Args;

    /// Returns the flag by which these parameters ask for standard output while the stage runs.
    fn claims_stdout(_params: &Self::Params) -> Option<&'static str> {
        None
    }

    /// Does the work.
    ///
    /// # Errors
    /// Whatever keeps the stage from doing its work at all; items that fail alone are part of the
    /// summary.
    fn run(params: Self::Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>>;
}

/// The tables that a stage reads and writes.
#[derive(Clone, Copy, Debug)]
pub struct Contract {
    pub reads: &'static str,
    pub writes: &'static str,
}

/// Receives the progress of a stage; the command line draws it.
pub trait Progress: Sync {
    /// Starts counting `total` things called `unit` (in the plural).
    fn start(&self, what: &str, unit: &str, total: u64);
    /// Starts counting `total` seconds of audio; the rate is a multiple of real time.
    fn start_audio(&self, what: &str, total_s: u64);
    /// Counts `n` that were done before, which say nothing about how fast the rest goes.
    fn skip(&self, n: u64);
    /// Counts `n` more.
    fn advance(&self, n: u64);
    /// Says something beside the count, for as long as nothing else is said.
    fn say(&self, text: &str);
    /// Says something that stays.
    fn note(&self, line: &str);
    /// Returns whether the user asked for an end (Ctrl-C, or a signal to terminate). A stage that asks gets a
    /// chance to finish what is under way: until the first call such a signal ends the program at once,
    /// and a second one always does.
    fn is_interrupted(&self) -> bool;
    /// Ends the counting.
    fn finish(&self);
}

/// Progress that is not shown.
#[derive(Clone, Copy, Debug, Default)]
pub struct Silent;

impl Progress for Silent {
    fn start(&self, _what: &str, _unit: &str, _total: u64) {}
    fn start_audio(&self, _what: &str, _total_s: u64) {}
    fn skip(&self, _n: u64) {}
    fn advance(&self, _n: u64) {}
    fn say(&self, _text: &str) {}
    fn note(&self, _line: &str) {}
    fn is_interrupted(&self) -> bool {
        false
    }
    fn finish(&self) {}
}

/// The summary of a stage.
pub trait Summary {
    /// Writes what the user asked for, or the account of what was done.
    ///
    /// # Errors
    /// The error of the output.
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()>;

    /// Returns how many items failed; they are in the `failures` table.
    fn n_failed(&self) -> u64;

    /// Returns whether the stage was stopped before it was done.
    fn is_stopped(&self) -> bool {
        false
    }

    /// Returns whether work is left that nobody was asked to do; of a stage that looks and does nothing.
    fn has_work_left(&self) -> bool {
        false
    }

    /// Returns whether there is anything to tell; not where another process tells it.
    fn is_told(&self) -> bool {
        true
    }

    /// Returns the figures of the account as a JSON object, for programs; names carry units.
    fn figures(&mut self) -> serde_json::Value;
    /// Returns whether what is written is data, whose bytes are for a program, and no account for people.
    fn is_data(&self) -> bool {
        false
    }
}

/// Marks a flag that `--help` leaves out and `--help-all` shows: `#[arg(…, hide_short_help = RARE)]`.
pub(in crate::stages) const RARE: bool = true;

/// Returns how many threads this machine runs side by side, the default of every stage that has workers.
pub(in crate::stages) fn all_threads() -> NonZeroUsize {
    std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)
}

/// How links in a source are treated; the same flag in every stage that reads one.
#[derive(Clone, Copy, Debug, Default, clap::Args)]
pub struct LinkParams {
    /// Follow symbolic links that lead out of the source, whose files are failures otherwise.
    #[arg(long, hide_short_help = RARE)]
    pub follow_links: bool,
}

/// How remote storage is used; the same flags in every stage.
#[derive(Clone, Debug, clap::Args)]
pub struct ClientParams {
    /// Requests to remote storage under way at once.
    #[arg(long, value_name = "N", default_value_t = ClientOptions::default().n_requests,
          help_heading = "Remote storage", hide_short_help = RARE)]
    pub requests: usize,
    /// Seconds that one request to remote storage may take.
    #[arg(long, value_name = "S", default_value_t = ClientOptions::default().request_timeout_s,
          help_heading = "Remote storage", hide_short_help = RARE)]
    pub request_timeout_s: f64,
    /// Times that a throttled, failed or broken request is tried again, with jittered backoff.
    #[arg(long, value_name = "N", default_value_t = ClientOptions::default().max_retries,
          help_heading = "Remote storage", hide_short_help = RARE)]
    pub max_retries: usize,
}

impl ClientParams {
    /// Returns the options of the store's client.
    pub fn options(&self) -> ClientOptions {
        ClientOptions {
            n_requests: self.requests,
            request_timeout_s: self.request_timeout_s,
            max_retries: self.max_retries,
        }
    }
}
