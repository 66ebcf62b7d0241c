//! Progress: a bar with rate and ETA on a terminal, a plain line every 10 s elsewhere.

use std::io::{IsTerminal as _, Write as _};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::{Duration, Instant};

use indicatif::{ProgressBar, ProgressState, ProgressStyle};

use super::interrupt;
use crate::stages::{Progress, one_line, redacted};

/// Time between plain lines.
const LINE_EVERY: Duration = Duration::from_secs(10);

/// Writes a line to standard error. One that nobody can read, because the reader of the pipe has gone or the disk is full,
/// does not stop the work: `eprintln!` would panic.
pub fn tell(line: &str) {
    writeln!(std::io::stderr(), "{line}").ok();
}

/// Draws the progress of a stage on standard error.
#[derive(Clone)]
pub struct Bars {
    mode: Mode,
    state: Arc<Mutex<State>>,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Mode {
    Silent,
    Bar,
    Lines,
}

#[derive(Default)]
struct State {
    bar: Option<ProgressBar>,
    count: Option<Count>,
}

struct Count {
    what: String,
    unit: String,
    /// The text after the rate.
    rate_unit: &'static str,
    done: u64,
    /// Of those, how many were done before the counting began.
    skipped: u64,
    total: u64,
    said: String,
    started: Instant,
    last_line: Instant,
}

impl Bars {
    pub fn new(quiet: bool) -> Self {
        let mode = match (quiet, std::io::stderr().is_terminal()) {
            (true, _) => Mode::Silent,
            (false, true) => Mode::Bar,
            (false, false) => Mode::Lines,
        };
        Self { mode, state: Arc::default() }
    }

    /// Runs `write` while no bar is on the screen.
    pub fn suspend<T>(&self, write: impl FnOnce() -> T) -> T {
        let bar = self.lock().bar.clone();
        match bar {
            Some(bar) => bar.suspend(write),
            None => write(),
        }
    }

    fn begin(&self, what: &str, unit: &str, total: u64, rate_unit: &'static str) {
        let mut state = self.lock();
        match self.mode {
            Mode::Silent => {}
            Mode::Bar => {
                let template = format!(
                    "{what} {{wide_bar}} {{human_pos}}/{{human_len}} {unit} {{rate}} ETA {{eta}} {{msg}}"
                );
                let style = ProgressStyle::with_template(&template)
                    .unwrap_or_else(|_| ProgressStyle::default_bar())
                    .with_key(
                        "rate",
                        move |state: &ProgressState, out: &mut dyn std::fmt::Write| {
                            // A bar that cannot be drawn must not stop the work.
                            write!(out, "{:.1}{rate_unit}", state.per_sec()).ok();
                        },
                    );
                state.bar = Some(ProgressBar::new(total).with_style(style));
            }
            Mode::Lines => {
                let now = Instant::now();
                state.count = Some(Count {
                    what: what.to_owned(),
                    unit: unit.to_owned(),
                    rate_unit,
                    done: 0,
                    skipped: 0,
                    total,
                    said: String::new(),
                    started: now,
                    last_line: now,
                });
            }
        }
    }

    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Progress for Bars {
    fn start(&self, what: &str, unit: &str, total: u64) {
        self.begin(what, unit, total, "/s");
    }

    fn start_audio(&self, what: &str, total_s: u64) {
        self.begin(what, "s of audio", total_s, "× real time");
    }

    fn skip(&self, n: u64) {
        let mut state = self.lock();
        if let Some(bar) = &state.bar {
            bar.set_position(n);
            bar.reset_eta();
        }
        if let Some(count) = &mut state.count {
            (count.done, count.skipped) = (count.done + n, count.skipped + n);
        }
    }

    fn advance(&self, n: u64) {
        let mut state = self.lock();
        if let Some(bar) = &state.bar {
            bar.inc(n);
        }
        if let Some(count) = &mut state.count {
            count.done += n;
            if count.last_line.elapsed() >= LINE_EVERY {
                count.last_line = Instant::now();
                let line = count.line(count.started.elapsed());
                drop(state);
                tell(&line);
            }
        }
    }

    fn say(&self, text: &str) {
        let mut state = self.lock();
        if let Some(bar) = &state.bar {
            bar.set_message(one_line(text));
        }
        if let Some(count) = &mut state.count {
            count.said = one_line(text);
        }
    }

    fn note(&self, line: &str) {
        if self.mode != Mode::Silent {
            self.suspend(|| tell(&one_line(&redacted(line))));
        }
    }

    fn is_interrupted(&self) -> bool {
        interrupt::is_asked_for()
    }

    fn finish(&self) {
        let mut state = self.lock();
        if let Some(bar) = state.bar.take() {
            bar.finish_and_clear();
        }
        state.count = None;
    }
}

impl Count {
    fn line(&self, elapsed: Duration) -> String {
        let Count { what, unit, rate_unit, done, skipped, total, said, .. } = self;
        let rate = (done - skipped) as f64 / elapsed.as_secs_f64().max(1e-9);
        let eta_s = total.saturating_sub(*done) as f64 / rate.max(1e-9);
        let said = if said.is_empty() { String::new() } else { format!(", {said}") };
        let eta = duration(eta_s);
        format!("{what}: {done} of {total} {unit}, {rate:.1}{rate_unit}, ETA {eta}{said}")
    }
}

fn duration(seconds: f64) -> String {
    let s = seconds.round() as u64;
    match (s / 3600, s / 60 % 60, s % 60) {
        (0, 0, s) => format!("{s} s"),
        (0, m, s) => format!("{m} min {s} s"),
        (h, m, _) => format!("{h} h {m} min"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_tells_count_rate_and_eta() {
        let now = Instant::now();
        let count = Count {
            what: "ingest".into(),
            unit: "phrases".into(),
            rate_unit: "/s",
            done: 300,
            skipped: 0,
            total: 1200,
            said: String::new(),
            started: now,
            last_line: now,
        };
        let line = count.line(Duration::from_secs(20));
        assert_eq!(line, "ingest: 300 of 1200 phrases, 15.0/s, ETA 1 min 0 s");
        // What was done before the program began is no work of these 20 s.
        let resumed = Count { done: 500, skipped: 200, said: "loss 0.5".into(), ..count };
        let line = resumed.line(Duration::from_secs(20));
        assert_eq!(line, "ingest: 500 of 1200 phrases, 15.0/s, ETA 47 s, loss 0.5");
        assert_eq!(duration(7384.0), "2 h 3 min");
        assert_eq!(duration(9.6), "10 s");
    }
}
