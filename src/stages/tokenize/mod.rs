//! `tokenize`: motion becomes tokens, in the tables `tokens` and `tokenizations`.

mod phrases;
mod report;

use std::num::NonZeroUsize;
use std::time::Instant;

use anyhow::Context as _;

use super::train::session::check_run_name;
use super::trained::TrainedTokenizer;
use super::{ClientParams, Contract, Progress, RARE, Stage, Summary, all_threads};
use crate::diffusion::{SamplerConfig, Schedule};
use crate::generation::TokenEngine;
use crate::store::{Location, Shard, digest};

use phrases::{Reconstruction, TokenizeTally, TokenizeTarget};
use report::TokenizeSummary;

/// Raised when tokenize writes something else for the same motion and weights.
const OUTPUT_VERSION: u32 = 1;

/// The stage.
pub struct Tokenize;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Run of `train --family tokens` whose tokenizer is used, and the name of its tokens.
    #[arg(long, value_name = "NAME")]
    pub run: String,
    /// Make motion of the tokens again, and measure how far it is from what it was.
    #[arg(long)]
    pub reconstruct: bool,
    /// Seed of the noise that motion is made of again.
    #[arg(long, value_name = "N", default_value_t = 0, hide_short_help = RARE)]
    pub seed: u64,
    /// Only phrases of this split: train, validation or test.
    #[arg(long, value_name = "NAME", help_heading = "Phrases")]
    pub split: Option<String>,
    /// Only these phrases.
    #[arg(long, value_name = "NAME", num_args = 1.., help_heading = "Phrases", hide_short_help = RARE)]
    pub phrase: Vec<String>,
    /// Part of the job that this process does: i/n, or auto inside an array job.
    #[arg(long, value_name = "I/N", default_value_t = Shard::WHOLE.to_string(), help_heading = "Phrases")]
    pub shard: String,
    /// Phrases under way at once.
    #[arg(long, value_name = "N", default_value_t = all_threads())]
    pub workers: NonZeroUsize,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Do every phrase again, done or not.
    #[arg(long)]
    pub force: bool,
}

impl Stage for Tokenize {
    const NAME: &'static str = "tokenize";
    const ABOUT: &'static str = "write motion as tokens";
    const CONTRACT: Contract = Contract {
        reads: "runs/<run>/, phrases, motion",
        writes: "tokens, tokenizations, failures",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        check_run_name(&params.run)?;
        let store = Location::open(&params.store, &params.client.options())?;
        let trained = TrainedTokenizer::read(&store, &params.run)?;
        let network = &trained.state.config.network;
        let scales = &trained.state.scales;
        let weights = super::export::weights_sha256(&trained.parameters);
        let schedule = Schedule::new(&network.diffusion)?;
        let sampler = SamplerConfig::fast27();
        if params.reconstruct {
            sampler.check(schedule.len())?;
        }
        let engine = TokenEngine::new(
            &network.tokens,
            trained.parameters,
            &scales.motion,
            network.window_frames,
            (params.workers, NonZeroUsize::MIN),
        )
        .context("while starting threads")?;
        let settings = |reconstruction: Option<u64>| {
            let text = serde_json::json!({
                "output_version": OUTPUT_VERSION,
                "weights": weights,
                "sizes": network,
                "scales": scales.motion,
                "reconstruction": reconstruction.map(|seed| (seed, &sampler)),
            });
            digest(text.to_string().as_bytes())
        };
        let with_errors = settings(Some(params.seed));
        let target = TokenizeTarget {
            store: &store,
            run: &params.run,
            engine: &engine,
            sizes: &network.tokens,
            weights: &weights,
            reconstruction: params.reconstruct.then_some(Reconstruction {
                sampler: &sampler,
                schedule: &schedule,
                seed: params.seed,
            }),
            params_hash: if params.reconstruct { with_errors.clone() } else { settings(None) },
            params_hash_with_errors: with_errors,
            shard: Shard::parse(&params.shard, |name| std::env::var(name).ok())?,
            split: params.split.as_deref(),
            phrases: &params.phrase,
            n_workers: params.workers,
            force: params.force,
            dry_run: params.dry_run,
        };
        let done: TokenizeTally = phrases::run(&target, progress)?;
        Ok(Box::new(TokenizeSummary {
            run: params.run.clone(),
            store: store.to_string(),
            n_codes: network.tokens.codes,
            frames_per_token: network.tokens.frames_per_token,
            done,
            dry_run: params.dry_run,
            took_s: started.elapsed().as_secs_f64(),
        }))
    }
}
