//! What generate made, for people and for programs.

use std::io::{self, Write};
use std::path::PathBuf;

use super::GenerateTally;
use crate::stages::Summary;
use crate::stages::failure::{N_SHOWN, failures_json, write_failures};

/// Where motions go.
pub enum GeneratePlace {
    Store { store: String, run: String },
    Folder(PathBuf),
}

/// The account of a run.
pub struct GenerateSummary {
    pub place: GeneratePlace,
    pub done: GenerateTally,
    pub model: String,
    pub made_with: String,
    pub dry_run: bool,
    pub took_s: f64,
}

impl Summary for GenerateSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { place, done, made_with, took_s, .. } = self;
        match place {
            GeneratePlace::Store { store, .. } => writeln!(out, "generate → {store}")?,
            GeneratePlace::Folder(folder) => writeln!(out, "generate → {}", folder.display())?,
        }
        writeln!(out, "  {made_with}")?;
        if self.dry_run {
            let GenerateTally { n_todo, todo_s, n_unchanged, .. } = done;
            let length = if *todo_s > 0.0 { format!(" ({todo_s:.1} s)") } else { String::new() };
            writeln!(
                out,
                "  would make {n_todo} motions{length}, leave {n_unchanged} as they are"
            )?;
            return Ok(());
        }
        let n_failed = done.failed.len();
        if done.n_todo == 0 {
            writeln!(out, "  nothing to do: {} motions are up to date", done.n_unchanged)?;
        } else {
            let share = match done.made_s > 0.0 {
                true => format!(", {:.2} of the music's length", *took_s / done.made_s),
                false => String::new(),
            };
            writeln!(
                out,
                "  {} motions made ({:.1} s, {} frames), {} up to date, {n_failed} failed; {took_s:.1} s{share}",
                done.n_made, done.made_s, done.n_frames, done.n_unchanged,
            )?;
        }
        if done.n_candidates > done.n_made {
            writeln!(out, "  the best of {} candidates", done.n_candidates)?;
        }
        if done.n_checks_failed > 0 {
            writeln!(out, "  {} of them fail a sanity check", done.n_checks_failed)?;
        }
        if done.n_fused > 0 {
            writeln!(
                out,
                "  fusion moved positions by {:.1} mm (root mean square), {:.1} mm at most",
                (done.fused_mm2 / done.n_fused as f64).sqrt(),
                done.fused_max_mm
            )?;
        }
        for (line, files) in done.told.iter().take(N_SHOWN) {
            writeln!(out, "  {line}")?;
            for file in files {
                writeln!(out, "    {}", file.display())?;
            }
        }
        let url = match place {
            GeneratePlace::Store { store, .. } => Some(store.as_str()),
            GeneratePlace::Folder(_) => None,
        };
        write_failures(out, done.failed.iter().map(|(name, why)| (name, why)), url)?;
        if done.is_interrupted {
            writeln!(out, "  stopped as asked; the same command goes on with what is missing")?;
        }
        if let GeneratePlace::Store { store, run } = place {
            writeln!(
                out,
                "  motiongen query --store {store} \"select phrase_id, score, real_time_factor from \
                 generations where run = '{run}' and selected\""
            )?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        self.done.failed.len() as u64
    }

    fn is_stopped(&self) -> bool {
        self.done.is_interrupted
    }

    fn figures(&mut self) -> serde_json::Value {
        let Self { place, done, .. } = self;
        let (to, run) = match place {
            GeneratePlace::Store { store, run } => (store.clone(), Some(run.clone())),
            GeneratePlace::Folder(folder) => (folder.display().to_string(), None),
        };
        let files: Vec<String> = done
            .told
            .iter()
            .flat_map(|(_, files)| files)
            .map(|f| f.display().to_string())
            .collect();
        serde_json::json!({
            "to": to,
            "run": run,
            "model": self.model,
            "dry_run": self.dry_run,
            "n_todo": done.n_todo,
            "todo_s": done.todo_s,
            "n_done": done.n_made,
            "n_unchanged": done.n_unchanged,
            "n_frames": done.n_frames,
            "duration_s": done.made_s,
            "n_candidates": done.n_candidates,
            "n_checks_failed": done.n_checks_failed,
            "files": files,
            "failures": failures_json(done.failed.iter().map(|(name, why)| (name, why))),
            "took_s": self.took_s,
        })
    }
}
