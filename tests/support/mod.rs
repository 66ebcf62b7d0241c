//! What the integration tests share: temporary folders, the program, and tables read back.
//!
//! ```ignore
//! let dir = Dir::new();
//! dir.write("source/motion/a/trajectory.npy", files::trajectory(&files::coherent(31, 1)));
//! let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
//! assert_eq!(output.code, 0, "{output:?}");
//! assert_eq!(phrases(&dir.at("store"))["a"].n_frames, Some(31));
//! ```

// Each module uses another part of it.
#![allow(dead_code)]

pub mod files;
pub mod plots;

use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::SystemTime;

use arrow_array::cast::AsArray as _;
use arrow_array::types::{Float32Type, Int32Type};
use motiongen::motion::{CHANNEL_NAMES, MOTION_DIM};
use motiongen::store::tables::{self, FailureRow, PhraseRow};
use motiongen::store::{Location, Row, Snapshot};

/// Beginnings of the environment variables that change what the program does.
const VARIABLES: [&str; 8] = [
    "MOTIONGEN_",
    "AWS_",
    "GOOGLE_",
    "AZURE_",
    "SLURM_",
    "JOB_COMPLETION_",
    "BATCH_TASK_",
    "RUST_LOG",
];

/// A temporary folder that goes away with the test.
pub struct Dir(tempfile::TempDir);

impl Dir {
    pub fn new() -> Self {
        Self(tempfile::tempdir().unwrap())
    }

    pub fn path(&self) -> &Path {
        self.0.path()
    }

    pub fn at(&self, path: impl AsRef<Path>) -> PathBuf {
        self.path().join(path)
    }

    /// Writes a file and the folders above it; returns its path.
    pub fn write(&self, path: impl AsRef<Path>, bytes: impl AsRef<[u8]>) -> PathBuf {
        write(&self.at(path), bytes)
    }
}

/// Writes a file and the folders above it; returns its path.
pub fn write(path: &Path, bytes: impl AsRef<[u8]>) -> PathBuf {
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(path, bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    path.to_owned()
}

/// What a finished program left behind.
#[derive(Debug)]
pub struct Output {
    pub code: i32,
    pub stdout: String,
    pub stderr: String,
}

/// Returns `motiongen` in an environment without anything that configures it.
pub fn motiongen() -> Command {
    program(env!("CARGO_BIN_EXE_motiongen"))
}

/// Returns `motiongen-ingest` in an environment without anything that configures it.
pub fn motiongen_ingest() -> Command {
    program(env!("CARGO_BIN_EXE_motiongen-ingest"))
}

fn program(path: &str) -> Command {
    let mut command = Command::new(path);
    clean(&mut command);
    command
}

fn clean(command: &mut Command) {
    for (name, _) in std::env::vars_os() {
        if VARIABLES.iter().any(|start| name.as_encoded_bytes().starts_with(start.as_bytes())) {
            command.env_remove(name);
        }
    }
    command.stdin(Stdio::null());
}

/// Returns `command` for a process that permissions bind, even where the tests run as root, and
/// that may have at most `limit_bytes` of memory of its own.
///
/// Root keeps its user but loses the capabilities that ignore permissions, so nothing needs to be
/// readable by others. The limit is Linux's on private writable memory: what goes beyond it ends
/// the process instead of being measured.
pub fn confined(command: &Command, limit_bytes: u64) -> Command {
    let mut words = Vec::new();
    if is_root() {
        words.extend(["setpriv", "--bounding-set=-dac_override,-dac_read_search"]);
    }
    let script = format!("ulimit -d {} && exec \"$0\" \"$@\"", limit_bytes / 1024);
    words.extend(["sh", "-c", &script]);
    let mut confined = Command::new(words[0]);
    confined.args(&words[1..]).arg(command.get_program()).args(command.get_args());
    clean(&mut confined);
    for (name, value) in command.get_envs() {
        match value {
            Some(value) => confined.env(name, value),
            None => confined.env_remove(name),
        };
    }
    confined
}

/// Memory that a confined program may have unless a test says otherwise.
pub const MEMORY_BYTES: u64 = 400_000_000;

fn is_root() -> bool {
    use std::os::unix::fs::MetadataExt as _;
    // The owner of a file that this process makes is the user that it runs as.
    tempfile::tempfile().unwrap().metadata().unwrap().uid() == 0
}

/// Runs `motiongen` with these arguments to its end.
pub fn run(arguments: impl IntoIterator<Item = impl AsRef<OsStr>>) -> Output {
    finish(motiongen().args(arguments))
}

/// Runs a command to its end.
///
/// # Panics
/// When a signal ended it.
pub fn finish(command: &mut Command) -> Output {
    let output = command.output().unwrap_or_else(|e| panic!("{command:?}: {e}"));
    let stdout = String::from_utf8(output.stdout).unwrap();
    let stderr = String::from_utf8(output.stderr).unwrap();
    let Some(code) = output.status.code() else {
        panic!("{command:?} was ended by a signal, {}: {stdout}{stderr}", output.status);
    };
    Output { code, stdout, stderr }
}

/// Runs `motiongen ingest` from one folder into another.
pub fn ingest(source: &Path, store: &Path, more: &[&str]) -> Output {
    finish(&mut ingest_command(source, store, more))
}

/// Returns `motiongen ingest` from one folder into another, not yet run.
pub fn ingest_command(source: &Path, store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg("ingest").arg("--source").arg(source).arg("--store").arg(store).args(more);
    command
}

/// Returns the rows of `phrases` by id, each id once.
pub fn phrases(store: &Path) -> BTreeMap<String, PhraseRow> {
    let rows = rows::<PhraseRow>(store);
    let n_rows = rows.len();
    let by_id: BTreeMap<_, _> = rows.into_iter().map(|r| (r.phrase_id.clone(), r)).collect();
    assert_eq!(by_id.len(), n_rows, "a phrase has two rows");
    by_id
}

/// Returns the rows of `failures` by id, each id once.
pub fn failures(store: &Path) -> BTreeMap<String, FailureRow> {
    let rows = rows::<FailureRow>(store);
    let n_rows = rows.len();
    let by_id: BTreeMap<_, _> = rows.into_iter().map(|r| (r.phrase_id.clone(), r)).collect();
    assert_eq!(by_id.len(), n_rows, "an item has two failures");
    by_id
}

/// Returns the live rows of a table with one row per item, part by part.
pub fn rows<R: Row>(store: &Path) -> Vec<R> {
    let location = Location::local(store).unwrap();
    Snapshot::take(&location, R::schema()).unwrap().rows::<R>().unwrap()
}

/// Returns the frames of `motion` by phrase, each phrase's frames counted from 0 without a gap.
pub fn motion(store: &Path) -> BTreeMap<String, Vec<[f32; MOTION_DIM]>> {
    let location = Location::local(store).unwrap();
    let snapshot = Snapshot::take(&location, tables::motion()).unwrap();
    let mut by_frame = BTreeMap::new();
    for batch in snapshot.batches() {
        let batch = batch.unwrap();
        let column = |name: &str| batch.column_by_name(name).unwrap();
        let ids = column("phrase_id").as_string::<i32>();
        let frames = column("frame").as_primitive::<Int32Type>();
        let channels = CHANNEL_NAMES.map(|name| column(name).as_primitive::<Float32Type>());
        for i in 0..batch.num_rows() {
            let key = (ids.value(i).to_owned(), frames.value(i));
            let values = channels.map(|channel| channel.value(i));
            assert!(by_frame.insert(key.clone(), values).is_none(), "{key:?} has two rows");
        }
    }
    let mut by_phrase: BTreeMap<String, Vec<_>> = BTreeMap::new();
    for ((id, frame), values) in by_frame {
        let of_phrase = by_phrase.entry(id).or_default();
        assert_eq!(usize::try_from(frame), Ok(of_phrase.len()), "frames have a gap");
        of_phrase.push(values);
    }
    by_phrase
}

/// Returns every file below a folder with its content and modification time; a missing folder is
/// empty.
pub fn tree(folder: &Path) -> BTreeMap<PathBuf, (Vec<u8>, SystemTime)> {
    let mut files = BTreeMap::new();
    for entry in walkdir::WalkDir::new(folder) {
        match entry {
            Ok(entry) if entry.file_type().is_file() => {
                let path = entry.path().strip_prefix(folder).unwrap().to_owned();
                let modified = entry.metadata().unwrap().modified().unwrap();
                files.insert(path, (std::fs::read(entry.path()).unwrap(), modified));
            }
            Ok(_) => {}
            Err(_) if !folder.exists() => {}
            Err(e) => panic!("{e}"),
        }
    }
    files
}
