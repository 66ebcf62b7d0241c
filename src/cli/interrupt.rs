//! Ctrl-C and signals to terminate, for stages that finish what is under way first.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, OnceLock};

use signal_hook::consts::{SIGINT, SIGTERM};
use signal_hook::flag;

/// Exit code of a program that a second signal ended at once: 128 + SIGINT, as shells have it.
const ENDED_BY_SIGNAL: i32 = 130;

static ASKED: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Returns whether the user asked for an end; from the first call on, that is all that a signal does.
pub fn is_asked_for() -> bool {
    let asked = ASKED.get_or_init(|| {
        let asked = Arc::new(AtomicBool::new(false));
        for signal in [SIGINT, SIGTERM] {
            // In this order, so that the second signal finds the flag set and ends the program. Where
            // the system refuses, signals end it as ever.
            flag::register_conditional_shutdown(signal, ENDED_BY_SIGNAL, Arc::clone(&asked)).ok();
            flag::register(signal, Arc::clone(&asked)).ok();
        }
        asked
    });
    asked.load(Ordering::Relaxed)
}
