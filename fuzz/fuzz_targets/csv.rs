//! Arbitrary bytes through the reader of motion as text: no panic, and what was read survives a write and a
//! read, bit for bit.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/chance.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod chance;
#[path = "../../src/excerpt.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod excerpt;
#[path = "../../src/motion/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod motion;
#[path = "../../src/units.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod units;

use motion::exchange::{csv_header, read_csv, write_csv};

fuzz_target!(|bytes: &[u8]| {
    // The header alone would take a fuzzer days.
    let text = format!("{}{}", csv_header(), String::from_utf8_lossy(bytes));
    let _ = read_csv(&String::from_utf8_lossy(bytes));
    let frames = match read_csv(&text) {
        Ok(frames) => frames,
        Err(error) => {
            assert!(error.to_string().len() < 1000);
            return;
        }
    };
    let mut written = Vec::new();
    write_csv(frames.view(), &mut written).expect("memory");
    let again = read_csv(std::str::from_utf8(&written).expect("text")).expect("written by us");
    assert_eq!(again.dim(), frames.dim());
    for (a, b) in again.iter().zip(&frames) {
        assert!(a.to_bits() == b.to_bits() || (a.is_nan() && b.is_nan()));
    }
});
