//! What tokenize did, for people and for programs.

use std::io::{self, Write};

use super::TokenizeTally;
use crate::stages::Summary;
use crate::stages::failure::{failures_json, quoted, write_failures};
use crate::training::perplexity;

/// The account of a run.
pub struct TokenizeSummary {
    pub run: String,
    pub store: String,
    pub n_codes: usize,
    pub frames_per_token: usize,
    pub done: TokenizeTally,
    pub dry_run: bool,
    pub took_s: f64,
}

impl TokenizeSummary {
    fn n_tokens(&self) -> u64 {
        self.done.usage.values().sum()
    }

    /// Returns how many codes are in use, were all used alike; none without tokens.
    fn perplexity(&self) -> Option<f64> {
        let counts: Vec<u64> = self.done.usage.values().copied().collect();
        (self.n_tokens() > 0).then(|| perplexity(&counts))
    }

    /// Returns the means over frames of this command's errors of position, m, and orientation, degrees.
    fn errors(&self) -> Option<[f64; 2]> {
        let (sum, n) = self.done.errors?;
        Some([sum.position_m, sum.orientation_deg].map(|sum| sum / n.max(1) as f64))
    }
}

impl Summary for TokenizeSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { run, store, n_codes, frames_per_token, done, took_s, .. } = &*self;
        writeln!(out, "tokenize → {store}")?;
        writeln!(out, "  run {run}: {n_codes} codes, one for {frames_per_token} frames")?;
        if self.dry_run {
            let TokenizeTally { n_todo, n_unchanged, .. } = done;
            writeln!(out, "  would tokenize {n_todo} phrases, leave {n_unchanged} as they are")?;
            return Ok(());
        }
        let n_failed = done.failed.len();
        if done.n_todo == 0 {
            writeln!(out, "  nothing to do: {} phrases are up to date", done.n_unchanged)?;
        } else {
            writeln!(
                out,
                "  {} phrases tokenized ({} frames, {} tokens), {} up to date, {n_failed} failed; {took_s:.1} s",
                done.n_done,
                done.n_frames,
                self.n_tokens(),
                done.n_unchanged,
            )?;
        }
        if let Some(perplexity) = self.perplexity() {
            writeln!(
                out,
                "  of their codes {} are in use, perplexity {perplexity:.1} ({:.0} % of {n_codes})",
                done.usage.len(),
                100.0 * perplexity / *n_codes as f64
            )?;
        }
        if let Some([position_m, orientation_deg]) = self.errors() {
            writeln!(
                out,
                "  made again, positions are off by {:.1} cm and orientations by {orientation_deg:.2}°, on average",
                100.0 * position_m
            )?;
        }
        let failed = done.failed.iter().map(|(name, why)| (name, why));
        write_failures(out, failed, Some(store))?;
        if done.is_interrupted {
            writeln!(out, "  stopped as asked; the same command goes on with what is missing")?;
        }
        writeln!(
            out,
            "  motiongen query --store {} \"select token, count(*) as n from tokens where run = '{run}' group by \
             token order by n desc\"",
            quoted(store)
        )
    }

    fn n_failed(&self) -> u64 {
        self.done.failed.len() as u64
    }

    fn is_stopped(&self) -> bool {
        self.done.is_interrupted
    }

    fn figures(&mut self) -> serde_json::Value {
        let errors = self.errors();
        serde_json::json!({
            "store": self.store,
            "run": self.run,
            "dry_run": self.dry_run,
            "n_todo": self.done.n_todo,
            "n_done": self.done.n_done,
            "n_unchanged": self.done.n_unchanged,
            "n_frames": self.done.n_frames,
            "n_tokens": self.n_tokens(),
            "n_codes": self.n_codes,
            "n_codes_used": self.done.usage.len(),
            "perplexity": self.perplexity(),
            "position_error_m": errors.map(|[position_m, _]| position_m),
            "orientation_error_deg": errors.map(|[_, orientation_deg]| orientation_deg),
            "failures": failures_json(self.done.failed.iter().map(|(name, why)| (name, why))),
            "took_s": self.took_s,
        })
    }
}
