//! The baseline of the ingest benchmark: what it costs to read a folder and compress it, no more.
//!
//! ```sh
//! plain-read FOLDER OUTPUT
//! ```
//!
//! One thread reads every file below FOLDER whole, in the order of their paths, and writes all
//! bytes through zstd level 1 into OUTPUT. Nothing is parsed, checked, digested or synced to disk.
//! `benches/bench.py` runs it beside `motiongen ingest`.

#![expect(clippy::print_stdout, clippy::print_stderr, reason = "a program of its own")]

use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

const LEVEL: i32 = 1;

fn main() -> ExitCode {
    let arguments: Vec<PathBuf> = std::env::args_os().skip(1).map(PathBuf::from).collect();
    let [folder, output] = arguments.as_slice() else {
        eprintln!("usage: plain-read FOLDER OUTPUT");
        return ExitCode::from(2);
    };
    match compress(folder, output) {
        Ok((n_files, n_bytes)) => {
            println!("{n_files} files, {n_bytes} bytes");
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("plain-read {} into {}: {error}", folder.display(), output.display());
            ExitCode::FAILURE
        }
    }
}

/// Returns the number of files read and their bytes.
fn compress(folder: &Path, output: &Path) -> std::io::Result<(u64, u64)> {
    let mut encoder = zstd::Encoder::new(BufWriter::new(File::create(output)?), LEVEL)?;
    let (mut n_files, mut n_bytes) = (0, 0);
    for entry in walkdir::WalkDir::new(folder).sort_by_file_name() {
        let entry = entry?;
        if entry.file_type().is_file() {
            let bytes = std::fs::read(entry.path())?;
            encoder.write_all(&bytes)?;
            n_files += 1;
            n_bytes += bytes.len() as u64;
        }
    }
    encoder.finish()?.flush()?;
    Ok((n_files, n_bytes))
}
