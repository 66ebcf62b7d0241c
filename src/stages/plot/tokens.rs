//! `plot tokens`: how often each code of a tokenizer is used.

use std::collections::BTreeSet;
use std::path::PathBuf;

use anyhow::{anyhow, bail};

use crate::plot::{self, TokensPlot};
use crate::stages::{ClientParams, Summary};
use crate::store::tables::{TokenRow, TokenizationRow};
use crate::store::{Location, Row as _, Snapshot};
use crate::training::perplexity;

use super::nearest::nearest;
use super::output::{WIDTHS_PX, format_of, write_picture};

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Run of `train --family tokens` whose tokens are drawn, as tokenize wrote them.
    #[arg(long, value_name = "NAME")]
    pub run: String,
    /// Only the tokens of these phrases.
    #[arg(long, value_name = "ID", num_args = 1..)]
    pub phrase: Vec<String>,
    /// The picture, FILE.png or FILE.svg; written whole or not at all.
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// Width in CSS pixels, 320 to 8192; a PNG has two pixels for each.
    #[arg(long, value_name = "PX", default_value_t = 1000,
          value_parser = clap::value_parser!(u32).range(WIDTHS_PX))]
    pub width: u32,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
}

/// Draws the plot.
///
/// # Errors
/// When there is nothing to draw, or the picture cannot be written.
pub fn run(params: &Params) -> anyhow::Result<Box<dyn Summary>> {
    let Params { run, output, .. } = params;
    let format = format_of(output)?;
    let store = Location::open(&params.store, &params.client.options())?;
    let written: Vec<TokenizationRow> =
        Snapshot::take(&store, TokenizationRow::schema())?.rows()?;
    let mut runs: BTreeSet<String> = written.iter().map(|row| row.run.clone()).collect();
    if !runs.remove(run) {
        let others = match runs.is_empty() {
            true => String::new(),
            false => format!("; nearest: {}", nearest(run, runs)),
        };
        bail!(
            "store {store} has no tokens of run {run}; run motiongen tokenize --run {run} first{others}"
        );
    }
    let is_wanted = |id: &String| params.phrase.is_empty() || params.phrase.contains(id);
    let written: Vec<TokenizationRow> =
        written.into_iter().filter(|row| row.run == *run && is_wanted(&row.phrase_id)).collect();
    let phrases: BTreeSet<&String> = written.iter().map(|row| &row.phrase_id).collect();
    if let Some(id) = params.phrase.iter().find(|id| !phrases.contains(id)) {
        bail!("store {store} has no tokens of phrase \"{id}\" by run {run}");
    }
    let n_codes = written.iter().map(|row| row.n_codes).max().unwrap_or(0);
    let mut counts = vec![0_u64; usize::try_from(n_codes).unwrap_or(0)];
    let tokens = Snapshot::take(&store, TokenRow::schema())?;
    for row in tokens.rows_where(|row: &TokenRow| row.run == *run && is_wanted(&row.phrase_id))? {
        let count = usize::try_from(row.token).ok().and_then(|token| counts.get_mut(token));
        let Some(count) = count else {
            return Err(anyhow!(
                "tokenization {} has the token {}, and run {run} has {n_codes} codes; tokenize it again with --force",
                row.tokenization,
                row.token
            ));
        };
        *count += 1;
    }
    let title = format!("run {run}");
    let n_phrases = phrases.len() as u64;
    let plotted =
        TokensPlot { title: &title, counts: &counts, perplexity: perplexity(&counts), n_phrases };
    let picture = plot::tokens(&plotted, params.width, format)?;
    let n: u64 = counts.iter().sum();
    write_picture(format!("{n} tokens of run {run}"), output, &picture, params.dry_run)
}
