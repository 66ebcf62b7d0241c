//! Arbitrary bytes through the `.npz` reader, as an archive and as a member of one: no panic,
//! memory within the limit, and a member reads as the same bytes do outside the archive.
#![no_main]

use std::io::{Cursor, Write};

use libfuzzer_sys::fuzz_target;
use zip::{CompressionMethod, ZipWriter, write::SimpleFileOptions};

#[path = "../../src/excerpt.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod excerpt;
#[path = "../../src/motion"]
#[allow(dead_code, reason = "this target reaches a part of the modules")]
mod motion {
    pub mod npy;
    pub mod npz;
}

use motion::{npy, npz::Npz};

const LIMIT_BYTES: u64 = 1 << 20;

fuzz_target!(|bytes: &[u8]| {
    match Npz::open_limited(bytes, LIMIT_BYTES) {
        Err(error) => assert!(!error.to_string().is_empty() && !error.kind().is_empty()),
        Ok(mut npz) => {
            // A table of members costs 46 bytes each; reading a few shows as much as reading all.
            let keys: Vec<String> = npz.keys().iter().take(4).cloned().collect();
            for key in keys.iter().map(String::as_str).chain(["absent"]) {
                match npz.read_f32(key) {
                    Ok(array) => assert!(array.values.len() as u64 <= LIMIT_BYTES / 4),
                    Err(error) => {
                        assert!(!error.to_string().is_empty() && !error.kind().is_empty());
                    }
                }
                let _ = npz.read_f64(key);
            }
        }
    }

    let Some((&choice, member)) = bytes.split_first() else { return };
    let method =
        if choice % 2 == 0 { CompressionMethod::Stored } else { CompressionMethod::Deflated };
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    writer.start_file("a.npy", options).expect("a valid name");
    writer.write_all(member).expect("memory");
    let archive = writer.finish().expect("memory").into_inner();
    let inside = Npz::open(&archive).expect("written by zip").read_f32("a");
    match (npy::read_f32(member), inside) {
        (Ok(outside), Ok(inside)) => {
            assert_eq!(outside.shape, inside.shape);
            let bits = |values: &[f32]| values.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
            assert_eq!(bits(&outside.values), bits(&inside.values));
        }
        (Err(outside), Err(inside)) => assert_eq!(outside.kind(), inside.kind()),
        (outside, inside) => panic!("{outside:?} outside and {inside:?} inside the archive"),
    }
});
