//! Ctrl-C and signals to terminate: the first asks for an end, the second ends the program at once.

use std::sync::atomic::{AtomicBool, Ordering};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::iterator::Signals;
use signal_hook::low_level;

use super::exit;

/// Added to the number of a signal, the exit code of a program that it ended, as shells have it.
const ENDED_BY_SIGNAL: i32 = 128;

/// Whether the user asked to stop.
static ASKED: AtomicBool = AtomicBool::new(false);
/// Whether the stage reads [`ASKED`], and finishes the work that has begun.
static HEEDED: AtomicBool = AtomicBool::new(false);

/// Listens to signals from now on. Before the stage looks for the first time, a signal ends the program at once
/// with the exit code of a job that was stopped, after `stopped`.
pub fn listen(stopped: impl Fn() + Send + 'static) {
    // Where the system refuses, signals end the program as ever.
    let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
    let handle = signals.handle();
    let listener = std::thread::Builder::new().name("signals".to_owned()).spawn(move || {
        for signal in signals.forever() {
            if ASKED.swap(true, Ordering::Relaxed) {
                low_level::exit(ENDED_BY_SIGNAL + signal);
            }
            if !HEEDED.load(Ordering::Relaxed) {
                stopped();
                low_level::exit(i32::from(exit::STOPPED));
            }
        }
    });
    if listener.is_err() {
        handle.close();
    }
}

/// Returns whether the user asked for an end; from the first call on, that is all that a first signal does.
pub fn is_asked_for() -> bool {
    HEEDED.store(true, Ordering::Relaxed);
    ASKED.load(Ordering::Relaxed)
}
