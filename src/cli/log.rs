//! Logging: `tracing` events on standard error, above the progress bar.

use std::io::{self, Write};

use tracing_subscriber::EnvFilter;
use tracing_subscriber::fmt::MakeWriter;

use super::progress::Bars;
use crate::stages::redacted;

pub const VERBOSE: &str = "verbose";
pub const QUIET: &str = "quiet";
/// Overrides the flags with a filter such as `motiongen=debug,object_store=trace`.
const FILTER_VARIABLE: &str = "MOTIONGEN_LOG";

/// Starts logging for the process; a second start is left without effect.
pub fn start(verbosity: u8, quiet: bool, bars: Bars) {
    let level = match (quiet, verbosity) {
        (true, _) => "error",
        (_, 0) => "warn",
        (_, 1) => "warn,motiongen=info",
        (_, 2) => "warn,motiongen=debug",
        (_, _) => "debug,motiongen=trace,object_store=debug",
    };
    let filter = std::env::var(FILTER_VARIABLE)
        .ok()
        .and_then(|filter| EnvFilter::try_new(filter).ok())
        .unwrap_or_else(|| EnvFilter::new(level));
    let subscriber = tracing_subscriber::fmt()
        .with_env_filter(filter)
        .with_target(false)
        .with_ansi(io::IsTerminal::is_terminal(&io::stderr()))
        .with_writer(AboveBars(bars));
    subscriber.try_init().ok();
    // A panic is a defect of ours, even where the stage survives it; it goes to the log like the rest.
    std::panic::set_hook(Box::new(|panic| tracing::error!("defect: {panic}")));
}

struct AboveBars(Bars);

impl<'a> MakeWriter<'a> for AboveBars {
    type Writer = Line<'a>;

    fn make_writer(&'a self) -> Line<'a> {
        Line { bars: &self.0, bytes: Vec::new() }
    }
}

/// One event, written at once when it is complete.
struct Line<'a> {
    bars: &'a Bars,
    bytes: Vec<u8>,
}

impl Write for Line<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.bytes.extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Drop for Line<'_> {
    fn drop(&mut self) {
        // A log that cannot be written must not stop the work.
        let line = redacted(&String::from_utf8_lossy(&self.bytes));
        self.bars.suspend(|| io::stderr().write_all(line.as_bytes()).ok());
    }
}
