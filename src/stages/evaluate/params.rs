//! What the user asks of evaluate.

use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::ensure;

use crate::evaluation::verdict::Quality;
use crate::motion::ChannelLimits;
use crate::stages::{ClientParams, RARE, all_threads};
use crate::store::digest;

/// Raised when evaluate writes something else for the same motions and settings.
const OUTPUT_VERSION: u32 = 2;

/// A verdict that may be required.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum RequiredVerdict {
    /// All four, and of groups the fifth.
    All,
    Sound,
    LikeReal,
    FollowsMusic,
    Varied,
    /// Of groups: do their dancers belong together, and keep apart?
    Together,
}

impl RequiredVerdict {
    /// Whether the verdict of this name, as tables spell it, is required.
    pub fn asks_for(self, verdict: &str) -> bool {
        match self {
            Self::All => true,
            Self::Sound => verdict == Quality::Sound.name(),
            Self::LikeReal => verdict == Quality::LikeReal.name(),
            Self::FollowsMusic => verdict == Quality::FollowsMusic.name(),
            Self::Varied => verdict == Quality::Varied.name(),
            Self::Together => verdict == Quality::Together.name(),
        }
    }
}

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// The run of generate whose motions are evaluated.
    #[arg(
        long,
        value_name = "NAME",
        required_unless_present_any = ["motions", "tokenizer"],
        conflicts_with_all = ["motions", "tokenizer"]
    )]
    pub run: Option<String>,
    /// Motions of any program instead: a folder of files named after the store's phrases (ID.npy, ID.csv, ID.bvh,
    /// ID.parquet; of several motions ID.0.npy, ID.1.npy, …).
    #[arg(long, value_name = "DIR")]
    pub motions: Option<PathBuf>,
    /// A run of `train --family tokens` instead: its tokenizer writes motion that it did not learn from as tokens and
    /// makes it again, which is held against what it was.
    #[arg(long, value_name = "RUN", conflicts_with_all = ["motions", "quick", "report", "against", "require"],
          hide_short_help = RARE)]
    pub tokenizer: Option<String>,
    /// With --motions or --tokenizer: the name under which tables keep what was found [default: the folder's, the run's]
    #[arg(long, value_name = "NAME", conflicts_with = "run", hide_short_help = RARE)]
    pub name: Option<String>,
    /// Sanity checks only: no real motion is read, and no numbers and verdicts are written.
    #[arg(long)]
    pub quick: bool,
    /// Most motions that are looked at, the same ones every time [default: all]
    #[arg(long, value_name = "N")]
    pub num_samples: Option<NonZeroUsize>,
    /// Frames of each motion that are looked at, from its first [default: all]
    #[arg(long, value_name = "N", hide_short_help = RARE)]
    pub num_frames: Option<NonZeroUsize>,
    /// How far each channel may go.
    #[arg(long, value_enum, default_value_t = ChannelLimits::Wide, hide_short_help = RARE)]
    pub limits: ChannelLimits,
    /// Threads that measure motions [default: all cores]
    #[arg(long, value_name = "N", default_value_t = all_threads())]
    pub threads: NonZeroUsize,
    /// The page, FILE.html; written whole or not at all.
    #[arg(long, value_name = "FILE", help_heading = "Report")]
    pub report: Option<PathBuf>,
    /// Another run that was evaluated, to compare with.
    #[arg(long, value_name = "RUN", help_heading = "Report")]
    pub against: Option<String>,
    /// Motions that fail the most, which the report shows.
    #[arg(long, value_name = "N", default_value_t = 3, help_heading = "Report",
          hide_short_help = RARE)]
    pub worst: usize,
    /// Exit code 1 unless these verdicts are won, on music that the model did not meet, where there is any.
    #[arg(long, value_enum, value_name = "VERDICT", num_args = 1.., value_delimiter = ',',
          conflicts_with = "quick", help_heading = "Exit code")]
    pub require: Vec<RequiredVerdict>,
    /// Windows of music for which the untrained network, and the trained one without its music, are sampled as
    /// baselines; 0 leaves both out, and the verdict on following the music open.
    #[arg(long, value_name = "N", default_value_t = 256, hide_short_help = RARE)]
    pub baseline_windows: usize,
    /// Exit code 1 when fewer than this share of the motions pass the reference's checks, 0 to 1.
    #[arg(long, value_name = "X", help_heading = "Exit code", hide_short_help = RARE)]
    pub min_pass_rate: Option<f64>,
    /// Exit code 1 when fewer than this share of the motions pass the strict checks, 0 to 1.
    #[arg(long, value_name = "X", help_heading = "Exit code", hide_short_help = RARE)]
    pub min_strict_pass_rate: Option<f64>,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Evaluate again what is evaluated.
    #[arg(long)]
    pub force: bool,
}

impl Params {
    /// Refuses values that mean nothing.
    ///
    /// # Errors
    /// One sentence with the flag.
    pub fn check(&self) -> anyhow::Result<()> {
        let shares = [
            ("--min-pass-rate", self.min_pass_rate),
            ("--min-strict-pass-rate", self.min_strict_pass_rate),
        ];
        for (flag, share) in shares {
            if let Some(share) = share {
                ensure!(
                    (0.0..=1.0).contains(&share),
                    "{flag} {share} is no share; give a number from 0 to 1"
                );
            }
        }
        if let Some(report) = &self.report {
            let is_page = report.extension().is_some_and(|e| e.eq_ignore_ascii_case("html"));
            ensure!(
                is_page,
                "--report {} is not named like a page; name it .html",
                report.display()
            );
        }
        Ok(())
    }

    /// Returns the digest of everything but the motions that determines the rows; quick checks leave out
    /// those that need the ground truth.
    pub fn digest(&self, quick: bool) -> String {
        let text = format!(
            "{OUTPUT_VERSION}\n{:?}\n{:?}\n{:?}\n{}\n{quick}",
            self.num_samples, self.num_frames, self.limits, self.baseline_windows
        );
        digest(text.as_bytes())
    }
}
