//! Arbitrary bytes through the audio decoder: no panic of ours, no endless stream, finite samples,
//! no block out of proportion, and the same answer twice.
//!
//! A panic inside symphonia is its own; stages catch those.
#![no_main]

use std::io::Cursor;

use libfuzzer_sys::fuzz_target;

#[path = "../../src/instructions.rs"]
#[allow(dead_code, unused_imports, unused_macros, reason = "this target reaches a part of the module")]
mod instructions;
#[path = "../../src/excerpt.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod excerpt;
#[path = "../../src/audio/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod audio;
#[path = "../../src/units.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod units;

use audio::decode::{DecodeError, Decoder};
use audio::recording::{Options, Recording};

/// More than a packet of any codec has: FLAC blocks have 65,535 samples, held Vorbis pages 2^20.
const MAX_BLOCK: usize = 4 << 20;

/// Counts the samples, and adds them up in a way that their order matters to.
fn decode(bytes: &[u8]) -> Result<(u64, u64), DecodeError> {
    let mut decoder = Decoder::open(Cursor::new(bytes), "")?;
    assert!(decoder.sample_rate_hz() > 0 && decoder.n_channels() > 0);
    assert!(!decoder.codec().is_empty());
    let (mut n_samples, mut sum) = (0, 0_u64);
    let mut block = Vec::new();
    while decoder.next_block(&mut block)? {
        assert!(!block.is_empty() && block.len() <= MAX_BLOCK, "{} samples", block.len());
        assert!(block.iter().all(|x| x.is_finite()));
        n_samples += block.len() as u64;
        sum = block.iter().fold(sum, |sum, x| sum.rotate_left(5) ^ u64::from(x.to_bits()));
        block.clear();
    }
    assert!(n_samples > 0 && block.is_empty());
    Ok((n_samples, sum))
}

/// Longest audio that goes on to features, in seconds: longer inputs say nothing new.
const MAX_DURATION_S: f64 = 2.0;

/// Extracts the features, holding all samples or none, which must not matter.
fn features(bytes: &[u8], max_held_samples: usize) -> Result<Vec<f32>, String> {
    let options = Options {
        tuning: None,
        max_duration_s: MAX_DURATION_S,
        is_late: &|| false,
        max_held_samples,
    };
    let recording = Recording::analyse(|| Ok(Cursor::new(bytes)), "", &options);
    let features = recording.map_err(|e| e.to_string())?.raw.normalize();
    assert_eq!(features.frames.nrows() as u64, 1 + features.n_samples / 1470);
    let frames: Vec<f32> = features.frames.iter().copied().collect();
    assert!(frames.iter().all(|x| x.is_finite()));
    Ok(frames)
}

fuzz_target!(|bytes: &[u8]| {
    assert_eq!(features(bytes, usize::MAX), features(bytes, 0));
    let answer = decode(bytes);
    if let Err(error) = &answer {
        let message = error.to_string();
        assert!(message.len() < 1000 && !error.kind().is_empty(), "{message}");
    }
    let text = |answer: Result<(u64, u64), DecodeError>| answer.map_err(|e| e.to_string());
    assert_eq!(text(decode(bytes)), text(answer));
});
