//! What was held out is decided by what a model learned from, wherever the model and the music lie.

mod identity;
mod learned;
mod release_0_1;

use std::path::Path;
use std::process::Command;

use crate::support::{Dir, Output, run, write};

fn copy(from: &Path, to: &Path) {
    let status = Command::new("cp").arg("-r").arg(from).arg(to).status().expect("cp");
    assert!(status.success());
}

fn extract(store: &Path) {
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
}

#[track_caller]
fn succeeds(output: Output) -> Output {
    assert_eq!(output.code, 0, "{output:?}");
    output
}
