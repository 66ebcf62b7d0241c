//! Arbitrary bytes through the reader of beat lists: no panic, times in order, and phases within the bar.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/motion"]
#[allow(dead_code, reason = "this target reaches a part of the modules")]
mod motion {
    mod beat_list;
    pub mod phase;
    pub mod quantile;
}

use motion::phase::{Beats, bar_phase};

fuzz_target!(|bytes: &[u8]| {
    let beats = match Beats::parse(&String::from_utf8_lossy(bytes)) {
        Ok(beats) => beats,
        Err(error) => {
            assert!(error.to_string().len() < 1000);
            return;
        }
    };
    let times_s = beats.times_s();
    assert!(times_s.len() >= 2 && times_s.windows(2).all(|pair| pair[0] < pair[1]));
    assert!(beats.beats_per_bar() > 0 && beats.tempo_bpm() > 0.0);
    let last_s = times_s[times_s.len() - 1];
    for phase in bar_phase(&[-1.0, 0.0, times_s[0], last_s, last_s + 1.0], &beats) {
        assert!((0.0..1.0).contains(&phase), "{phase}");
    }
});
