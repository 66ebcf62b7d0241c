//! The notebooks run from their first cell to their last, and end with what the tables say.

use std::path::{Path, PathBuf};
use std::process::Command;

use crate::generate::modelled;
use crate::support::{Dir, motiongen, run};

/// Executes a notebook in a folder of its own and prints what its last cell printed.
const EXECUTE: &str = "
import sys, nbformat
from nbclient import NotebookClient
book = nbformat.read(sys.argv[1], as_version=4)
nbformat.validate(book)
assert all(not cell.get('outputs') for cell in book.cells), 'outputs are not kept'
NotebookClient(book, timeout=300, kernel_name='python3').execute()
outputs = book.cells[-1]['outputs']
print(''.join(output['text'] for output in outputs if output['output_type'] == 'stream'), end='')
";

/// A store that was trained on, generated from and evaluated.
fn store(dir: &Dir) -> PathBuf {
    let store = modelled(dir);
    let place = store.display().to_string();
    let fixed = ["--quiet", "--store", &place];
    let generate = ["generate", "--model=m", "--overlap=7", "--engine=eager", "--steps=4"];
    let output = run(generate.iter().chain(&fixed));
    assert_eq!(output.code, 0, "{output:?}");
    let output = run(["evaluate", "--run=m"].iter().chain(&fixed));
    assert_eq!(output.code, 0, "{output:?}");
    store
}

fn execute(name: &str, store: &Path, home: &Path) -> String {
    let python = std::env::var("MOTIONGEN_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let book = Path::new(env!("CARGO_MANIFEST_DIR")).join(format!("notebooks/{name}.ipynb"));
    let program = motiongen().get_program().to_owned();
    let output = Command::new(python)
        .args(["-c", EXECUTE])
        .arg(book)
        .current_dir(home)
        .env("HOME", home)
        .env("MPLBACKEND", "agg")
        .env("MOTIONGEN", program)
        .env("MOTIONGEN_STORE", store)
        .output()
        .expect("Python starts");
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{name}: {said}");
    String::from_utf8(output.stdout).expect("UTF-8")
}

/// Numbers that a query answers, in one row.
fn ask<const N: usize>(store: &Path, sql: &str) -> [i64; N] {
    let output = run(["query", "--store", &store.display().to_string(), sql, "--format", "csv"]);
    assert_eq!(output.code, 0, "{output:?}");
    let row = output.stdout.lines().nth(1).expect("a row");
    let numbers: Vec<i64> = row.split(',').map(|x| x.parse().expect("a number")).collect();
    numbers.try_into().expect("as many columns")
}

#[test]
fn every_notebook_runs_and_says_what_the_tables_say() {
    let dir = Dir::new();
    let store = store(&dir);
    let home = dir.at("home");
    std::fs::create_dir(&home).expect("a folder");
    let [frames, phrases] =
        ask(&store, "select count(*) n, count(distinct phrase_id) p from features");
    assert_eq!(
        execute("features", &store, &home),
        format!("{frames} frames of {phrases} phrases\n")
    );
    let [motions, frames] =
        ask(&store, "select count(*) n, sum(n_frames) f from generations where selected");
    assert_eq!(
        execute("training_and_generation", &store, &home),
        format!("{motions} motions, {frames} frames; 2 courses of training\n")
    );
    let [numbers] = ask(&store, "select count(*) n from metrics");
    let [checks] = ask(&store, "select count(*) n from sanity_checks");
    let [failed] = ask(&store, "select count(*) n from sanity_checks where not passed");
    assert!(numbers > 0 && failed > 0 && failed < checks, "{numbers} {failed} {checks}");
    assert_eq!(
        execute("evaluation", &store, &home),
        format!("{numbers} numbers; {failed} of {checks} checks failed\n")
    );
}
