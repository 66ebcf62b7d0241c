//! Killing `ingest` at any moment costs time and nothing else: what is committed in the end is what
//! a run without kills commits, byte for byte.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use motiongen::store::tables::{FailureRow, PhraseRow};
use motiongen::store::{Location, Manifest, Row as _, Snapshot, TimestampUs, live_parts};

use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, failures, finish, ingest, ingest_command, motion, phrases};

/// Everything that a store shows, without the moments at which failures happened.
#[derive(Debug, PartialEq)]
pub struct Contents {
    /// Paths and bytes of the live parts of every table but `failures`.
    pub parts: BTreeMap<String, Vec<u8>>,
    pub failures: Vec<FailureRow>,
    /// Manifests by path.
    pub manifests: BTreeMap<String, Manifest>,
}

impl Contents {
    /// Reads a store, checking that it holds no object that no commit names and that every part is
    /// as long as its commit says.
    pub fn of(store: &Location) -> Self {
        let mut listed = store.list("").expect("a listing");
        // Catalogues repeat what commits say.
        listed.retain(|l| !l.path.starts_with("catalogue/"));
        let sizes: BTreeMap<_, _> = listed.into_iter().map(|l| (l.path, l.size_bytes)).collect();
        let mut named = BTreeSet::new();
        let mut manifests = BTreeMap::new();
        for path in sizes.keys().filter(|path| path.starts_with("commits/")) {
            let text = store.read(path).expect("a manifest");
            let mut manifest: Manifest = serde_json::from_slice(&text).expect("a manifest");
            for part in &mut manifest.parts {
                assert_eq!(sizes.get(&part.path), Some(&part.n_bytes), "{store}: {}", part.path);
                named.insert(part.path.clone());
                if part.table == "failures" {
                    // The times compress to this many bytes or that.
                    part.n_bytes = 0;
                }
            }
            named.insert(path.clone());
            manifests.insert(path.clone(), manifest);
        }
        assert_eq!(named, sizes.into_keys().collect(), "{store}: objects that no commit names");

        let live = live_parts(store).expect("commits");
        let live = live.into_values().flatten().map(|l| l.part.path);
        let parts = live.filter(|path| !path.starts_with("failures/"));
        let parts = parts.map(|path| (path.clone(), store.read(&path).expect("a part").to_vec()));
        let failures = Snapshot::take(store, FailureRow::schema()).expect("a snapshot");
        let mut failures = failures.rows::<FailureRow>().expect("failures");
        failures.iter_mut().for_each(|row| row.time = TimestampUs(0));
        failures.sort_by(|a, b| a.phrase_id.cmp(&b.phrase_id));
        Self { parts: parts.collect(), failures, manifests }
    }

    /// Fails with names instead of megabytes of content.
    #[track_caller]
    pub fn assert_same_as(&self, expected: &Self) {
        let names = |contents: &Self| contents.parts.keys().cloned().collect::<Vec<_>>();
        assert_eq!(names(self), names(expected), "names of parts");
        for (path, bytes) in &expected.parts {
            assert!(self.parts[path] == *bytes, "{path}: bytes differ");
        }
        assert_eq!(self.failures, expected.failures);
        assert_eq!(self.manifests, expected.manifests);
    }
}

/// A program that is killed when the test is done with it, however the test ends.
pub struct Running(Child);

impl Running {
    pub fn start(mut command: Command) -> Self {
        command.stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap_or_else(|e| panic!("{command:?}: {e}")))
    }

    pub fn is_running(&mut self) -> bool {
        self.0.try_wait().expect("a child's status").is_none()
    }

    /// Waits for the program's end, and returns its exit code.
    #[cfg(feature = "mpi")]
    pub fn wait(mut self) -> Option<i32> {
        self.0.wait().expect("a child's status").code()
    }

    /// Ends the program at once, and returns whether that cut it short.
    pub fn kill(mut self) -> bool {
        self.0.kill().expect("a child that can be killed");
        self.0.wait().expect("a child's status").code().is_none()
    }
}

impl Drop for Running {
    fn drop(&mut self) {
        self.0.kill().ok();
        self.0.wait().ok();
    }
}

/// Numbers that repeat from run to run.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        self.0 % n
    }
}

const N_PHRASES: usize = 400;
const N_ROUNDS: usize = 12;

/// Writes phrases of 17 to 61 frames of which some cannot be read.
fn write_source(dir: &Dir) {
    for i in 0..N_PHRASES {
        let mut frames = coherent(17 + i * 7 % 45, i as u32);
        match i {
            _ if i % 53 == 5 => frames[3][11] = f32::NAN,
            _ if i % 71 == 9 => frames.iter_mut().for_each(|f| f[1] = 130.5),
            _ => {}
        }
        let folder = format!("source/motion/session {}/take-{i:03}", i % 9);
        dir.write(format!("{folder}/trajectory.npy"), trajectory(&frames));
    }
}

fn n_commits(store: &Path) -> usize {
    let Ok(entries) = std::fs::read_dir(store.join("commits/ingest")) else { return 0 };
    let names = entries.map(|e| e.expect("an entry").file_name());
    names.filter(|name| name.as_encoded_bytes().ends_with(b".json")).count()
}

/// Checks that the store shows whole phrases of the finished one, each once, and returns how many.
fn check_subset(store: &Path, finished: &Finished) -> usize {
    let rows = phrases(store);
    for (id, row) in &rows {
        assert_eq!(finished.phrases.get(id), Some(row));
    }
    let frames = motion(store);
    assert!(frames.keys().eq(rows.keys()), "motion and phrases differ in their phrases");
    for (id, frames) in &frames {
        assert!(finished.motion[id] == *frames, "{id}: frames differ");
    }
    for (id, row) in failures(store) {
        assert_eq!(finished.failures.get(&id), Some(&row.message), "{id}");
    }
    rows.len()
}

/// What a run without kills leaves.
struct Finished {
    phrases: BTreeMap<String, PhraseRow>,
    motion: BTreeMap<String, Vec<[f32; 25]>>,
    failures: BTreeMap<String, String>,
}

#[test]
fn three_processes_killed_twelve_times_commit_what_one_undisturbed_run_commits() {
    let dir = Dir::new();
    write_source(&dir);
    let (source, store, whole) = (dir.at("source"), dir.at("store"), dir.at("whole"));
    let flags = |shard| ["--batch-phrases", "8", "--workers", "1", "--shard", shard];
    let output = ingest(&source, &whole, &flags("0/1"));
    assert_eq!(output.code, 1, "{output:?}");
    let finished = Finished {
        phrases: phrases(&whole),
        motion: motion(&whole),
        failures: failures(&whole).into_iter().map(|(id, row)| (id, row.message)).collect(),
    };
    // 5, 58, … 376 and 9, 80, … 364.
    assert_eq!((finished.failures.len(), finished.phrases.len()), (8 + 6, 386));
    let n_whole = n_commits(&whole);

    let mut random = Random(20_240_229);
    let (mut n_cut, mut history) = (0, Vec::new());
    for _ in 0..N_ROUNDS {
        let before = n_commits(&store);
        let enough = before + 1 + random.below(3) as usize;
        let delay = Duration::from_micros(random.below(9_000));
        let mut all: Vec<Running> = ["0/2", "1/2", "0/2"]
            .map(|shard| Running::start(ingest_command(&source, &store, &flags(shard))))
            .into();
        while n_commits(&store) < enough && all.iter_mut().any(Running::is_running) {
            std::thread::sleep(Duration::from_micros(300));
        }
        std::thread::sleep(delay);
        let cut: Vec<bool> = all.into_iter().map(Running::kill).collect();
        n_cut += usize::from(cut.contains(&true));
        history.push((n_commits(&store), check_subset(&store, &finished)));
    }
    // A kill that comes when everything is done proves nothing.
    let n_unfinished = history.iter().filter(|(n, _)| *n < n_whole).count();
    assert!(n_unfinished >= 8 && n_cut >= 8, "of {n_whole} commits: {history:?}, {n_cut} cut");
    assert!(history.is_sorted(), "committed work went away: {history:?}");

    for shard in ["1/2", "0/2"] {
        let output = finish(&mut ingest_command(&source, &store, &flags(shard)));
        assert_eq!(output.code, 1, "{output:?}");
    }
    assert_eq!(check_subset(&store, &finished), 386);
    let contents = |path| Contents::of(&Location::local(path).expect("a location"));
    contents(&store).assert_same_as(&contents(&whole));

    // Nobody finds anything left to do; what failed is tried again and fails the same.
    let before = contents(&store);
    let output = ingest(&source, &store, &flags("0/1"));
    assert_eq!(output.code, 1, "{output:?}");
    assert!(output.stdout.contains("386 up to date, 14 failed"), "{}", output.stdout);
    contents(&store).assert_same_as(&before);
}

#[test]
fn a_run_killed_under_other_shards_and_batch_sizes_gives_the_same_rows() {
    let dir = Dir::new();
    write_source(&dir);
    let (source, store, whole) = (dir.at("source"), dir.at("store"), dir.at("whole"));
    assert_eq!(ingest(&source, &whole, &[]).code, 1);
    for (shard, batch_phrases) in [("2/3", "5"), ("0/3", "41"), ("1/2", "8")] {
        let flags = ["--shard", shard, "--batch-phrases", batch_phrases, "--workers", "2"];
        let enough = n_commits(&store) + 2;
        let mut running = Running::start(ingest_command(&source, &store, &flags));
        while n_commits(&store) < enough && running.is_running() {
            std::thread::sleep(Duration::from_micros(300));
        }
        running.kill();
    }
    let output = ingest(&source, &store, &["--batch-phrases", "13"]);
    assert_eq!(output.code, 1, "{output:?}");
    assert_eq!(phrases(&store), phrases(&whole));
    assert!(motion(&store) == motion(&whole), "frames differ");
    let messages = |store: &Path| -> Vec<_> {
        failures(store).into_iter().map(|(id, row)| (id, row.kind, row.message)).collect()
    };
    assert_eq!(messages(&store), messages(&whole));
}
