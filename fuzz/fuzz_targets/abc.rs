//! Arbitrary bytes through the reader of tunes: no panic, notes within bars, and every tune that is read can be
//! arranged.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/chance.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod chance;

#[path = "../../src/music"]
#[allow(dead_code, reason = "this target reaches a part of the modules")]
mod music {
    pub mod abc;
    pub mod arrange;
    pub mod drums;
    pub mod harmony;
    pub mod parts;
    pub mod score;
    pub mod style;
    pub mod styles;
    pub mod tempo;
}

fuzz_target!(|bytes: &[u8]| {
    for found in music::abc::read(bytes) {
        match found.tune {
            Ok(tune) => {
                let end = i64::from(tune.meter.ticks()) * tune.n_bars as i64;
                assert!(tune.notes.iter().all(|note| note.onset < end && note.pitch < 128));
                let score = music::arrange::arrange(&tune, 1);
                assert!(score.notes.iter().all(|note| note.onset_beats >= 0.0));
                assert!(score.end_s().is_finite() && !score.beats().is_empty());
            }
            Err(error) => assert!(error.to_string().len() < 300),
        }
    }
});
