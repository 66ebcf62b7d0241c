//! `motiongen compact` and `vacuum`, as a user runs them: killed, raced by ingest, and read by other engines.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::time::Duration;

use motiongen::store::{Location, StoreSnapshot};

use crate::ingest_kill::Running;
use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, Output, ingest, motion, motiongen, phrases, run, tree};

const N_PHRASES: usize = 90;

fn write_phrase(dir: &Dir, i: usize, seed: u32) {
    let frames = coherent(17 + i % 5, seed);
    dir.write(format!("source/motion/p{i:03}/trajectory.npy"), trajectory(&frames));
}

/// A store that was written in four rounds, each with a third of the phrases changed.
fn worn_store(dir: &Dir) {
    for round in 0..4 {
        for i in (0..N_PHRASES).filter(|i| round == 0 || i % 3 == round % 3) {
            write_phrase(dir, i, (100 * round + i) as u32);
        }
        let output = ingest(&dir.at("source"), &dir.at("store"), &["--batch-phrases", "4"]);
        assert_eq!(output.code, 0, "{output:?}");
    }
}

fn ask(stage: &str, store: &Path, more: &[&str]) -> Output {
    let store = store.display().to_string();
    run([stage, "--store", &store].into_iter().chain(more.iter().copied()))
}

fn copy(from: &Path, to: &Path) {
    let status = Command::new("cp").arg("-r").arg(from).arg(to).status().expect("cp");
    assert!(status.success());
}

#[test]
fn a_worn_store_becomes_few_whole_parts() {
    let dir = Dir::new();
    worn_store(&dir);
    let store = dir.at("store");
    let (rows, frames) = (phrases(&store), motion(&store));
    let before = tree(&store);
    for (stage, said) in [("compact", "  would rewrite "), ("vacuum", "  would remove 0 files")] {
        let output = ask(stage, &store, &["--dry-run"]);
        assert!(output.code == 0 && output.stdout.contains(said), "{output:?}");
    }
    assert!(tree(&store) == before, "a dry run wrote something");
    let output = ask("compact", &store, &[]);
    assert!(output.code == 0 && output.stdout.contains(" parts as 2 ("), "{output:?}");
    let output = ask("compact", &store, &[]);
    assert!(output.stdout.contains("  nothing to do: 2 parts"), "{output:?}");
    assert!(rows == phrases(&store) && frames == motion(&store));
    let output = ask("vacuum", &store, &[]);
    assert!(output.stdout.contains("  removed 0 files, 0.0 MB\n"), "{output:?}");
    assert!(output.stdout.contains(" commits are dead for less than 7d"), "{output:?}");
    let output = ask("vacuum", &store, &["--older-than", "0s"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(rows == phrases(&store) && frames == motion(&store));
    let n_files = |table: &str| std::fs::read_dir(store.join(table)).expect("a folder").count();
    assert_eq!((n_files("phrases"), n_files("motion"), n_files("commits/ingest")), (1, 1, 1));
    // Nothing is left to ingest, and what changes replaces what it was.
    let output = ingest(&dir.at("source"), &store, &[]);
    assert!(output.stdout.contains("nothing to do"), "{output:?}");
    write_phrase(&dir, 7, 999);
    let output = ingest(&dir.at("source"), &store, &[]);
    let is_told = |what| output.stdout.contains(what);
    assert!(is_told("  1 ingested (") && is_told(", 89 up to date"), "{output:?}");
    assert_eq!(motion(&store)["p007"].len(), frames["p007"].len());
    assert!(motion(&store)["p007"] != frames["p007"]);
    let wrong = ask("vacuum", &store, &["--older-than", "a week"]);
    assert_eq!(wrong.code, 2);
    assert!(wrong.stderr.contains("use a number and s, m, h, d or w, such as 7d"), "{wrong:?}");
}

#[test]
fn compactions_and_vacuums_killed_fifty_times_lose_nothing() {
    let dir = Dir::new();
    worn_store(&dir);
    let store = dir.at("store");
    let (rows, frames) = (phrases(&store), motion(&store));
    copy(&store, &dir.at("worn"));
    let mut n_killed = 0;
    for round in 0..50_u64 {
        if round % 10 == 9 {
            // As worn as it was, with what kills left behind.
            copy(&dir.at("worn/."), &store);
        }
        let stage = if round % 3 == 2 { "vacuum" } else { "compact" };
        let mut command = motiongen();
        command.arg(stage).arg("--store").arg(&store);
        if stage == "vacuum" {
            command.args(["--older-than", "0s"]);
        }
        let running = Running::start(command);
        std::thread::sleep(Duration::from_micros(2_000 + 900 * (round * 7 % 50)));
        n_killed += usize::from(running.kill());
        assert!(rows == phrases(&store) && frames == motion(&store), "round {round}");
    }
    assert!(n_killed > 20, "{n_killed} were cut short");
    for _ in 0..2 {
        assert_eq!(ask("compact", &store, &[]).code, 0);
        assert_eq!(ask("vacuum", &store, &["--older-than", "0s"]).code, 0);
    }
    assert!(rows == phrases(&store) && frames == motion(&store));
}

#[test]
fn ingest_and_compact_at_the_same_time_give_what_ingest_alone_gives() {
    let dir = Dir::new();
    worn_store(&dir);
    let store = dir.at("store");
    for i in (0..N_PHRASES).step_by(2) {
        write_phrase(&dir, i, 5000 + i as u32);
    }
    let mut ingest = crate::support::ingest_command(
        &dir.at("source"),
        &store,
        &["--batch-phrases", "1", "--workers", "1"],
    );
    ingest.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null());
    let mut running = Running::start(ingest);
    let mut n_compactions = 0;
    while running.is_running() {
        let output = ask("compact", &store, &[]);
        assert_eq!(output.code, 0, "{output:?}");
        n_compactions += 1;
    }
    assert!(n_compactions > 0);
    let output = crate::support::ingest(&dir.at("source"), &dir.at("fresh"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(phrases(&store) == phrases(&dir.at("fresh")));
    assert!(motion(&store) == motion(&dir.at("fresh")));
}

/// Returns the parts that count by what the commits say, below each table.
fn live(store: &Path) -> BTreeMap<String, Vec<String>> {
    let store = Location::local(store).expect("a folder");
    let parts = StoreSnapshot::take(&store).and_then(|s| s.live_parts()).expect("parts");
    let of_table = |(table, parts): (String, Vec<motiongen::store::LivePart>)| {
        let name = |part: &motiongen::store::LivePart| {
            part.part.path.rsplit('/').next().unwrap_or_default().to_owned()
        };
        (table, parts.iter().map(name).collect())
    };
    parts.into_iter().map(of_table).collect()
}

/// Replays a log as its protocol says, and returns what counts.
fn replayed(store: &Path, table: &str) -> Vec<String> {
    let mut active = std::collections::BTreeSet::new();
    for version in 0.. {
        let path = store.join(table).join(format!("_delta_log/{version:020}.json"));
        let Ok(text) = std::fs::read_to_string(path) else { break };
        for line in text.lines() {
            let action: serde_json::Value = serde_json::from_str(line).expect("an action");
            assert_eq!(action.as_object().expect("an object").len(), 1, "{line}");
            if let Some(path) = action["add"]["path"].as_str() {
                let file = store.join(table).join(path);
                let n_bytes = std::fs::metadata(&file).expect("a part").len();
                assert_eq!(action["add"]["size"].as_u64(), Some(n_bytes));
                assert!(active.insert(path.to_owned()), "{path} is added twice");
            }
            if let Some(path) = action["remove"]["path"].as_str() {
                assert!(active.remove(path), "{path} is removed and was not there");
            }
        }
    }
    active.into_iter().collect()
}

#[test]
fn a_delta_lake_log_says_which_parts_count() {
    let dir = Dir::new();
    worn_store(&dir);
    let store = dir.at("store");
    let output = ask("compact", &store, &["--delta"]);
    assert!(output.stdout.contains("  Delta Lake logs written: phrases, motion\n"), "{output:?}");
    let log = std::fs::read_to_string(store.join("phrases/_delta_log/00000000000000000000.json"));
    let log = log.expect("a log");
    let protocol = r#"{"protocol":{"minReaderVersion":1,"minWriterVersion":2}}"#;
    assert!(log.contains(protocol), "{log}");
    for table in ["phrases", "motion"] {
        assert_eq!(replayed(&store, table), live(&store)[table], "{table}");
    }
    // Nothing changes, nothing is written; then one phrase does.
    assert!(!ask("compact", &store, &["--delta"]).stdout.contains("Delta"));
    write_phrase(&dir, 3, 777);
    assert_eq!(ingest(&dir.at("source"), &store, &[]).code, 0);
    // What the log names stays until it names it no more.
    assert!(ask("compact", &store, &[]).stdout.contains(" parts as 2 ("));
    let output = ask("vacuum", &store, &["--older-than", "0s"]);
    assert!(output.stdout.contains("still named by a Delta Lake log"), "{output:?}");
    for table in ["phrases", "motion"] {
        assert_eq!(replayed(&store, table).len(), 1);
    }
    assert!(ask("compact", &store, &["--delta"]).stdout.contains("written: phrases, motion"));
    assert_eq!(ask("vacuum", &store, &["--older-than", "0s"]).code, 0);
    for table in ["phrases", "motion"] {
        let of_table = live(&store)[table].clone();
        let version_1 = store.join(table).join("_delta_log/00000000000000000001.json");
        let text = std::fs::read_to_string(version_1).expect("a version");
        assert!(text.contains("\"remove\"") && text.contains("\"add\""), "{text}");
        let folder = std::fs::read_dir(store.join(table)).expect("a folder");
        let files = folder.filter(|e| e.as_ref().expect("an entry").path().is_file()).count();
        assert_eq!(files, of_table.len(), "{table}");
    }
    read_by_delta_rs(&store);
    // A log of somebody else is not written over.
    let foreign = r#"{"protocol":{"minReaderVersion":3,"minWriterVersion":7}}"#;
    std::fs::create_dir_all(store.join("features/_delta_log")).expect("a folder");
    let path = store.join("features/_delta_log/00000000000000000000.json");
    std::fs::write(&path, foreign).expect("written");
    let output = ask("compact", &store, &["--delta"]);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(
        output.stderr.contains("is of protocol 3/7, this program writes 1/2; move it away"),
        "{output:?}"
    );
}

/// Asks delta-rs for the rows, where Python has it (tests/requirements.txt).
fn read_by_delta_rs(store: &Path) {
    let python = std::env::var("MOTIONGEN_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let script = "import sys, deltalake\n\
                  for table in ('phrases', 'motion'):\n\
                  \x20   t = deltalake.DeltaTable(sys.argv[1] + '/' + table)\n\
                  \x20   rows = deltalake.QueryBuilder().register('t', t).execute(\n\
                  \x20       'select count(*) n, count(distinct phrase_id) k from t').read_all()\n\
                  \x20   print(t.version(), int(rows['n'][0].as_py()), int(rows['k'][0].as_py()))\n";
    let has_it = Command::new(&python).args(["-c", "import deltalake"]).output();
    if !has_it.is_ok_and(|output| output.status.success()) {
        return;
    }
    let output = Command::new(&python).args(["-c", script]).arg(store).output().expect("Python");
    let text = String::from_utf8_lossy(&output.stdout).into_owned();
    let n_frames: usize = motion(store).values().map(Vec::len).sum();
    let expected = format!("1 {N_PHRASES} {N_PHRASES}\n1 {n_frames} {N_PHRASES}\n");
    assert_eq!(text, expected, "{}", String::from_utf8_lossy(&output.stderr));
}
