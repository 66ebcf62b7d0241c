//! `motiongen generate`, as a user runs it: tables and files, killed, sharded, and with bad input.

mod priming;
mod requests;
mod songs;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use motiongen::motion::npy::write as npy;
use motiongen::motion::{Beats, CHANNEL_NAMES, bar_phase};
use motiongen::store::tables::{BeatRow, DECODED, GENERATED, GenerationRow};
use motiongen::store::{Commit, Item, Ledger, Location, Row as _};
use ndarray::Array2;

use crate::support::{Dir, Output, failures, finish, motiongen, rows, run, write};
use crate::train::{make_store, train};

const TRAINED: [&str; 4] =
    ["--steps=20", "--decoder-steps=15", "--warmup-steps=5", "--prediction=x0"];

/// A store of 16 phrases of 19 to 67 frames, with a model of windows of 24.
pub fn modelled(dir: &Dir) -> PathBuf {
    modelled_with(dir, &TRAINED)
}

fn modelled_with(dir: &Dir, trained: &[&str]) -> PathBuf {
    let store = make_store(dir);
    let output = train(&store, "run", trained);
    assert_eq!(output.code, 0, "{output:?}");
    let export = ["export", "--run=run", "--model=m", "--quiet", "--store"];
    let output = run(export.iter().map(AsRef::as_ref).chain([store.as_os_str()]));
    assert_eq!(output.code, 0, "{output:?}");
    store
}

fn command(store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    let flag = |argument: &str| argument.split('=').next().unwrap_or_default().to_owned();
    let given: Vec<String> = more.iter().map(|argument| flag(argument)).collect();
    let usual = ["--model=m", "--quiet", "--overlap=7", "--engine=eager", "--steps=4"];
    let usual = usual.iter().filter(|argument| !given.contains(&flag(argument)));
    command.arg("generate").arg("--store").arg(store).args(usual).args(more);
    command
}

#[track_caller]
fn generate(store: &Path, more: &[&str]) -> Output {
    let output = finish(&mut command(store, more));
    assert_eq!(output.code, 0, "{output:?}");
    output
}

/// The parts of generated and decoded motion: names and bytes.
///
/// A process killed while it writes a part leaves a file whose name begins with a dot, which no reader
/// lists and a later run sweeps away when it is a day old.
fn parts(store: &Path) -> BTreeMap<String, Vec<u8>> {
    let of_table = |table: &'static str| {
        let entries = std::fs::read_dir(store.join(table)).into_iter().flatten();
        entries
            .map(|entry| entry.expect("an entry").path())
            .map(|path| (path.file_name().expect("a name").to_string_lossy().into_owned(), path))
            .filter(|(name, _)| !name.starts_with(".partial-"))
            .map(move |(name, path)| {
                (format!("{table}/{name}"), std::fs::read(path).expect("a part"))
            })
    };
    of_table(GENERATED).chain(of_table(DECODED)).collect()
}

/// All frames of a table as the query says them: by motion and frame, every number in full.
fn frames_of(store: &Path, table: &str, condition: &str) -> String {
    let sql = format!("select * from {table} where {condition} order by generation, frame");
    let output = run(["query", "--store", &store.display().to_string(), &sql, "--format", "csv"]);
    assert_eq!(output.code, 0, "{output:?}");
    output.stdout
}

fn frames(store: &Path) -> [String; 2] {
    [GENERATED, DECODED].map(|table| frames_of(store, table, "sample >= 0"))
}

fn generations(store: &Path) -> Vec<GenerationRow> {
    let mut rows: Vec<GenerationRow> = rows(store);
    rows.sort_by(|a, b| (&a.generation, a.candidate).cmp(&(&b.generation, b.candidate)));
    rows
}

fn copy(from: &Path, to: &Path) {
    let status = Command::new("cp").arg("-r").arg(from).arg(to).status().expect("cp");
    assert!(status.success());
}

#[test]
fn every_phrase_gets_motion_of_its_length_and_again_nothing_is_done() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let planned = generate(&store, &["--dry-run", "--samples=2"]);
    assert!(planned.stdout.contains("would make 32 motions"), "{planned:?}");
    assert!(parts(&store).is_empty());

    let output = generate(&store, &["--samples=2", "--run=first", "--seed=9"]);
    assert!(output.stdout.contains("  32 motions made ("), "{output:?}");
    let rows = generations(&store);
    assert_eq!(rows.len(), 32);
    for row in &rows {
        assert_eq!(row.generation, format!("first/{}/{}", row.phrase_id, row.sample));
        assert!(row.selected && row.candidate == 0 && row.engine == "eager", "{row:?}");
        assert_eq!((row.n_steps, row.sampler.as_str(), row.guidance), (4, "DPM-Solver++", 4.0));
        let n_windows = (row.n_frames - 24).max(0).div_euclid(17)
            + 1
            + i64::from((row.n_frames - 24).max(0).rem_euclid(17) > 0);
        assert_eq!(i64::from(row.n_windows), n_windows, "{row:?}");
        assert!(row.velocity_error > 0.0 && row.real_time_factor > 0.0);
    }
    let seeds: std::collections::BTreeSet<i64> = rows.iter().map(|row| row.seed).collect();
    assert_eq!(seeds.len(), 32, "every motion has noise of its own");
    let store_url = store.display().to_string();
    let sql = "select generation, count(*) as n from generated group by generation";
    let counted = run(["query", "--store", &store_url, sql, "--format", "csv"]);
    let counts: BTreeMap<&str, i64> = counted
        .stdout
        .lines()
        .skip(1)
        .map(|line| line.rsplit_once(',').expect("two columns"))
        .map(|(name, n)| (name, n.parse().expect("a number")))
        .collect();
    let expected: BTreeMap<&str, i64> =
        rows.iter().map(|row| (row.generation.as_str(), row.n_frames)).collect();
    assert_eq!(counts, expected, "as many frames as the music has");

    let before = parts(&store);
    let again = generate(&store, &["--samples=2", "--run=first", "--seed=9"]);
    assert!(again.stdout.contains("  nothing to do: 32 motions are up to date"), "{again:?}");
    assert_eq!(parts(&store), before);
    // One sample more is all that is missing; another name has motions of its own.
    let more = generate(&store, &["--samples=3", "--run=first", "--seed=9"]);
    assert!(more.stdout.contains("  16 motions made (") && more.stdout.contains(", 32 up to date"));
    let other = generate(&store, &["--run=second", "--seed=9"]);
    assert!(other.stdout.contains("  16 motions made ("), "{other:?}");
    assert_eq!(generations(&store).len(), 64);
}

#[test]
fn shards_threads_and_a_kill_change_no_byte() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let [one, sharded, killed] = ["one", "sharded", "killed"].map(|name| dir.at(name));
    for to in [&one, &sharded, &killed] {
        copy(&store, to);
    }
    generate(&one, &["--threads=1", "--samples=2"]);
    for shard in ["--shard=1/2", "--shard=0/2"] {
        generate(&sharded, &["--threads=2", "--samples=2", shard]);
    }
    assert_eq!(frames(&sharded), frames(&one));
    for wait_ms in [30, 90, 200, 400] {
        let mut child = command(&killed, &["--samples=2"]).spawn().expect("started");
        std::thread::sleep(Duration::from_millis(wait_ms));
        // It may have ended by itself; then there is nothing left to kill.
        let _ = child.kill();
        child.wait().expect("ended");
    }
    generate(&killed, &["--samples=2"]);
    assert_eq!(parts(&killed), parts(&one));
    let without_times = |store: &Path| {
        let mut rows = generations(store);
        for row in &mut rows {
            (row.generate_s, row.real_time_factor) = (0.0, 0.0);
            row.time = motiongen::store::TimestampUs(0);
        }
        rows
    };
    assert_eq!(without_times(&killed), without_times(&one));
}

#[test]
fn decoded_motion_is_kept_as_raw_motion_is() {
    let dir = Dir::new();
    let store = modelled(&dir);
    // The best of two: the decoded frames must be those of the candidate that was kept.
    generate(&store, &["--run=usual", "--best-of=2"]);
    let frames_in = |table: &str, run: &str| frames_of(&store, table, &format!("run = '{run}'"));
    assert_eq!(
        frames_in(DECODED, "usual").lines().count(),
        frames_in(GENERATED, "usual").lines().count(),
        "a row for every frame"
    );
    assert_ne!(frames_in(DECODED, "usual"), frames_in(GENERATED, "usual"));
    generate(&store, &["--run=rough", "--raw"]);
    assert_eq!(frames_in(DECODED, "rough"), frames_in(GENERATED, "rough"));
    let selected: Vec<String> = generations(&store)
        .into_iter()
        .filter(|row| row.run == "usual" && row.selected && row.candidate == 0)
        .map(|row| row.phrase_id)
        .collect();
    assert!((1..16).contains(&selected.len()), "either candidate is the best of some phrases");
    for phrase in selected {
        // The first candidate has the noise of the only one.
        let named = |run: &str| format!("run = '{run}' and phrase_id = '{phrase}'");
        let usual = frames_of(&store, DECODED, &named("usual")).replace("usual", "rough");
        assert_eq!(usual, frames_of(&store, GENERATED, &named("rough")), "{phrase}");
    }
}

#[test]
fn settings_are_kept_and_a_run_of_release_0_1_has_none() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let constraints = dir.write("c.toml", "[start]\nposition_y = 0.5\n").display().to_string();
    generate(&store, &["--run=old", "--guidance=2.5", "--constraints", &constraints, "--soft"]);
    let settings: Vec<serde_json::Value> = generations(&store)
        .iter()
        .map(|row| serde_json::from_str(row.settings.as_deref().expect("settings")).expect("JSON"))
        .collect();
    assert!(settings.iter().all(|other| *other == settings[0]));
    let said = &settings[0];
    assert_eq!(said["sampler"]["n_steps"], 4);
    assert_eq!(said["sampler"]["spacing"], "trailing");
    assert_eq!((&said["guidance"], &said["soft"]), (&2.5.into(), &true.into()));
    assert_eq!((&said["overlap_frames"], &said["best_of"]), (&7.into(), &1.into()));
    assert_eq!(said["postprocess"]["coherence"], "fuse");
    assert_eq!(said["constraints"].as_str().map(str::len), Some(64), "a digest");
    assert!(said.get("seed").is_none() && said.get("weights").is_none(), "{said}");

    // The same rows as release 0.1 wrote them: version 1, without the column.
    let rows = generations(&store);
    let batch = GenerationRow::to_batch(&rows);
    let known = batch.schema_ref().index_of("settings").expect("the column");
    let others: Vec<usize> = (0..batch.num_columns()).filter(|i| *i != known).collect();
    let batch = batch.project(&others).expect("columns");
    for entry in std::fs::read_dir(store.join("commits/generate")).expect("commits") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read_to_string(&path).expect("a commit");
        let mut commit: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        for part in commit["parts"].as_array_mut().expect("parts") {
            if part["table"] == "generations" {
                part["schema_version"] = 1.into();
                let path = store.join(part["path"].as_str().expect("a path"));
                let file = std::fs::File::create(path).expect("the part");
                let mut writer =
                    parquet::arrow::ArrowWriter::try_new(file, batch.schema(), None).expect("made");
                writer.write(&batch).expect("written");
                writer.close().expect("closed");
            }
        }
        std::fs::write(&path, commit.to_string()).expect("written");
    }
    let read = generations(&store);
    let without: Vec<GenerationRow> =
        rows.into_iter().map(|row| GenerationRow { settings: None, ..row }).collect();
    assert_eq!(read, without);
    // It is not made again, and a run of today stands beside it.
    let flags = ["--run=old", "--guidance=2.5", "--constraints", &constraints, "--soft"];
    let again = generate(&store, &flags);
    assert!(again.stdout.contains("  nothing to do: 16 motions are up to date"), "{again:?}");
    generate(&store, &["--run=new"]);
    let sql =
        "select run, count(*) n, count(settings) known from generations group by run order by run";
    let output = run(["query", "--store", &store.display().to_string(), sql, "--format", "csv"]);
    assert_eq!(output.stdout, "run,n,known\nnew,16,16\nold,16,0\n", "{output:?}");
}

#[test]
fn the_best_candidate_is_kept_and_all_are_known() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let output = generate(&store, &["--best-of=3"]);
    assert!(output.stdout.contains("  the best of 48 candidates"), "{output:?}");
    let rows = generations(&store);
    assert_eq!(rows.len(), 48);
    for candidates in rows.chunks(3) {
        assert!(candidates.iter().all(|row| row.generation == candidates[0].generation));
        let selected: Vec<_> = candidates.iter().filter(|row| row.selected).collect();
        assert_eq!(selected.len(), 1);
        let best = candidates.iter().filter_map(|row| row.score).fold(f64::NEG_INFINITY, f64::max);
        assert_eq!(selected[0].score, Some(best), "{candidates:?}");
    }
}

#[test]
fn what_cannot_be_made_is_recorded_and_the_rest_is_made() {
    let dir = Dir::new();
    let store = modelled(&dir);
    // At 1.0 s (frame 30) only phrases of more than 30 frames can be asked for anything.
    let constraints = dir.write("c.toml", "[[keyframe]]\ntime_s = 1.0\nposition_y = 0.5\n");
    let asked = constraints.display().to_string();
    let output = finish(&mut command(&store, &["--constraints", &asked]));
    assert_eq!(output.code, 1, "{output:?}");
    let failed = failures(&store);
    let rows = generations(&store);
    assert_eq!((failed.len() + rows.len(), rows.iter().all(|row| row.n_frames > 30)), (16, true));
    for row in failed.values() {
        assert_eq!((row.stage.as_str(), row.kind.as_str()), ("generate", "constraint"));
        assert!(
            row.message.starts_with(
                "a constraint on position_y is at frame 30 (1.00 s), but the track has 19 frames (0.63 s); \
                 move it or leave it out"
            ),
            "{row:?}"
        );
    }
    for row in &rows {
        assert!(row.control_error_mm.is_some_and(|mm| mm < 0.01), "{row:?}");
    }
    // Without the constraint the failures are gone.
    generate(&store, &[]);
    assert!(failures(&store).is_empty());
}

#[test]
fn mistakes_are_named() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let said = |more: &[&str]| {
        let output = finish(&mut command(&store, more));
        assert_eq!(output.code, 2, "{output:?}");
        output.stderr.lines().next().unwrap_or_default().to_owned()
    };
    assert_eq!(
        said(&["--overlap=24"]),
        "error: --overlap 24 is not below the 24 frames of a window of model m; give a smaller number"
    );
    assert_eq!(
        said(&["--guidance=-1"]),
        "error: --guidance -1 is below 0; give 1 to follow the music, more to exaggerate it"
    );
    assert_eq!(
        said(&["--style=0,0,0,0,0,0,0,0"]),
        "error: model m takes no style; leave --style out, or train one with --style"
    );
    assert_eq!(
        said(&["--phrase", "nobody"]),
        format!("error: store {} has no phrase nobody", store.display())
    );
    assert!(said(&["--smooth-quaternions=4"]).contains("odd"));
    let contradiction = dir.write(
        "c.toml",
        "[[keyframe]]\nframe = 3\nposition_y = 0.5\n[[keyframe]]\nframe = 3\nposition_y = 0.75\n",
    );
    let asked = contradiction.display().to_string();
    let output = finish(&mut command(&store, &["--constraints", &asked]));
    assert_eq!(output.code, 1, "{output:?}");
    let row = failures(&store).into_values().next().expect("a failure");
    assert_eq!(
        row.message,
        "position_y at frame 3 must be 0.5 and 0.75 at once; keep one of the two"
    );
}

#[test]
fn a_motion_is_continued_and_a_broken_one_refused() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let mut before = Array2::<f32>::zeros((20, 25));
    before.column_mut(9).fill(1.0);
    before.column_mut(1).fill(0.9);
    before
        .column_mut(2)
        .assign(&Array2::from_shape_fn((20, 1), |(t, _)| 3.0 + t as f32 * 0.01).column(0));
    let values: Vec<f32> = before.iter().copied().collect();
    write(&dir.at("before.npy"), npy(&[20, 25], &values));
    let asked = dir.write("c.toml", "continue_from = { file = \"before.npy\", frames = 5 }\n");
    let asked = asked.display().to_string();
    generate(&store, &["--constraints", &asked]);
    let query = "select phrase_id, position_z from generated where frame = 4";
    let output = run(["query", "--store", &store.display().to_string(), query, "--format", "csv"]);
    for line in output.stdout.lines().skip(1) {
        let z: f64 = line.rsplit(',').next().expect("a number").parse().expect("a number");
        assert!((z - 3.19).abs() < 1e-4, "{line}");
    }
    let more = dir.write("more.toml", "continue_from = { file = \"before.npy\", frames = 21 }\n");
    let more = more.display().to_string();
    let output = finish(&mut command(&store, &["--constraints", &more]));
    assert_eq!(output.code, 2, "{output:?}");
    let expected = format!(
        "error: {more}: continue_from asks for 21 frames of before.npy, which has 20; ask for 20 or fewer\n"
    );
    assert_eq!(output.stderr, expected);
    write(&dir.at("before.npy"), b"no array");
    let output = finish(&mut command(&store, &["--constraints", &asked]));
    assert_eq!(output.code, 2, "{output:?}");
    assert!(output.stderr.contains("before.npy"), "{output:?}");
}

/// Commits numbered beats of a phrase as ingest does for a beat list.
fn commit_list(store: &Path, phrase: &str, beats: &[(f64, i32)]) {
    let store = Location::local(store).expect("a folder");
    let mut commit = Commit::new(&store, "beats of a list", "", "lists");
    let rows: Vec<BeatRow> = (0..)
        .zip(beats)
        .map(|(beat, &(time_s, number))| BeatRow {
            phrase_id: phrase.to_owned(),
            beat,
            frame: (time_s * 30.0).round() as i32,
            time_s,
            number: Some(number),
            source: Some("beats_file".to_owned()),
        })
        .collect();
    let schema = BeatRow::schema;
    commit.part(schema().name, schema).expect("a part").write_rows(&rows).expect("rows");
    let (id, input_hash) = (phrase.to_owned(), phrase.to_owned());
    let item = Item { id, fingerprint: String::new(), input_hash, failure: None };
    commit.settle(item, &Ledger::default());
    commit.publish().expect("published");
}

#[test]
fn motions_have_the_phase_of_a_beat_list_and_follow_it_when_it_changes() {
    let dir = Dir::new();
    let store = modelled(&dir);
    generate(&store, &[]);
    let longest = generations(&store).into_iter().max_by_key(|row| row.n_frames).expect("rows");
    let list = [(0.2, 3), (0.7, 1), (1.3, 2), (1.7, 3)];
    commit_list(&store, &longest.phrase_id, &list);
    let output = generate(&store, &[]);
    assert!(output.stdout.contains("  1 motions made ("), "{output:?}");
    let output = generate(&store, &[]);
    assert!(output.stdout.contains("nothing to do"), "{output:?}");
    let phase = CHANNEL_NAMES[16];
    let store = store.display().to_string();
    let sql = format!(
        "select {phase} from generated where phrase_id = '{}' order by frame",
        longest.phrase_id
    );
    let output = run(["query", "--store", &store, &sql, "--format", "csv"]);
    let found: Vec<f32> =
        output.stdout.lines().skip(1).map(|x| x.parse().expect("a phase")).collect();
    let beats = Beats::parse("0.2 3\n0.7 1\n1.3 2\n1.7 3\n").expect("beats");
    let times_s: Vec<f64> = (0..found.len()).map(motiongen::units::frames_to_s).collect();
    let expected: Vec<f32> = bar_phase(&times_s, &beats).iter().map(|&x| x as f32).collect();
    assert_eq!((found.len() as i64, found), (longest.n_frames, expected));
}

#[test]
fn features_of_another_version_fail_with_their_sentence_and_the_job_goes_on() {
    let dir = Dir::new();
    let store = modelled(&dir);
    for entry in std::fs::read_dir(store.join("commits/extract")).expect("commits") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read_to_string(&path).expect("a commit");
        let mut commit: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        for part in commit["parts"].as_array_mut().expect("parts") {
            if part["table"] == "features" {
                part["schema_version"] = 7.into();
            }
        }
        std::fs::write(&path, commit.to_string()).expect("written");
    }
    let output = finish(&mut command(&store, &[]));
    assert_eq!(output.code, 1, "{output:?}");
    let found = failures(&store);
    assert_eq!(found.len(), 16);
    for (id, row) in found {
        let phrase = &id["m/".len()..id.len() - "/0".len()];
        let start = format!(
            "phrase {phrase}: has no features that this program reads: table features: file://"
        );
        let end = "has schema version 7, this program reads version 1; install a newer motiongen";
        assert!(row.message.starts_with(&start) && row.message.ends_with(end), "{}", row.message);
        assert_eq!(row.kind, "version");
    }
}
