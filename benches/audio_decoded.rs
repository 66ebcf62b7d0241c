//! What the decoder makes of audio files: for each a line of JSON, and its samples as f32 in a file.
//!
//!     cargo run --example audio-decoded -- FOLDER song.mp3 …
//!
//! Samples of file number i are written to `FOLDER/i.f32`: mono, the mean of all channels, at the file's own rate.

#![allow(clippy::print_stdout, reason = "a benchmark prints its table")]

use std::fs::File;
use std::io::{self, BufWriter, Write as _};
use std::path::{Path, PathBuf};

use motiongen::audio::decode::{DecodeError, Decoder};
use serde_json::json;

/// Decodes a file and writes its samples to `to`.
fn decoded(path: &Path, to: &Path) -> io::Result<serde_json::Value> {
    let file = File::open(path)?;
    let extension = path.extension().and_then(|e| e.to_str()).unwrap_or_default();
    let refused = |e: DecodeError| json!({ "error": e.to_string(), "kind": e.kind() });
    let mut decoder = match Decoder::open(file, extension) {
        Ok(decoder) => decoder,
        Err(e) => return Ok(refused(e)),
    };
    let (mut samples, mut n_samples, mut out) = (Vec::new(), 0, BufWriter::new(File::create(to)?));
    loop {
        samples.clear();
        let goes_on = match decoder.next_block(&mut samples) {
            Ok(goes_on) => goes_on,
            Err(e) => return Ok(refused(e)),
        };
        n_samples += samples.len();
        for sample in &samples {
            out.write_all(&sample.to_le_bytes())?;
        }
        if !goes_on {
            break;
        }
    }
    out.flush()?;
    let loss = decoder.loss();
    Ok(json!({
        "codec": decoder.codec(),
        "sample_rate_hz": decoder.sample_rate_hz(),
        "n_channels": decoder.n_channels(),
        "n_samples": n_samples,
        "loss": format!("{loss:?}"),
        "is_whole": loss == Default::default(),
    }))
}

fn main() -> io::Result<()> {
    let mut arguments = std::env::args_os().skip(1).map(PathBuf::from);
    let folder = arguments.next().ok_or_else(|| io::Error::other("name a folder, then files"))?;
    for (i, path) in arguments.enumerate() {
        println!("{}", decoded(&path, &folder.join(format!("{i}.f32")))?);
    }
    Ok(())
}
