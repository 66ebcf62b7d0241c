//! `query`: SQL over a local store, every format, and every mistake that a user can make.

mod answers;
mod refusals;

use std::path::{Path, PathBuf};

use motiongen::store::tables::{FailureRow, PhraseRow, motion};
use motiongen::store::{
    ClientOptions, Commit, DataFormat, Item, Ledger, Location, Row as _, StoreError, TableSchema,
    TimestampUs, query, table_infos,
};
use ndarray::Array2;
use polars::prelude::{ParquetReader, SerReader as _};

use crate::support::files::{Frame, beats, coherent, features_npz, trajectory, wav};
use crate::support::{Dir, Output, ingest, run};

/// Names, frames and whether there is audio of the phrases in [`sound_store`].
const PHRASES: [(&str, usize, bool); 5] = [
    ("mBR0", 31, true),
    ("a/ü, \"quoted\"", 47, false),
    ("gLO 2", 17, true),
    ("z", 59, false),
    ("gLO_3", 23, false),
];

/// The tables that are empty until there are models.
const OF_MODELS: [&str; 11] = [
    "training_log",
    "onnx_checks",
    "generations",
    "generated",
    "decoded",
    "tokens",
    "tokenizations",
    "sanity_checks",
    "metrics",
    "verdicts",
    "song_metrics",
];

fn write_phrase(dir: &Dir, i: usize, n_frames: usize) -> Vec<Frame> {
    let (id, _, has_audio) = PHRASES[i];
    let frames = coherent(n_frames, i as u32);
    dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&frames));
    if has_audio {
        dir.write(format!("source/audio/{id}.wav"), wav(n_frames as f64 / 30.0));
        dir.write(format!("source/audio/{id}.beats.txt"), beats(7, 125.0, Some(3)));
    }
    frames
}

/// Ingests five phrases and one that cannot be read.
fn sound_store() -> (Dir, Vec<Vec<Frame>>) {
    let dir = Dir::new();
    let frames = (0..PHRASES.len()).map(|i| write_phrase(&dir, i, PHRASES[i].1)).collect();
    dir.write("source/audio_features/z/features.npz", features_npz(59));
    dir.write("source/motion/broken/trajectory.npy", "no array");
    let output = ingest(&dir.at("source"), &dir.at("store"), &["--batch-phrases", "2"]);
    assert_eq!(output.code, 1, "{output:?}");
    (dir, frames)
}

fn ask(store: &Path, more: &[&str]) -> Output {
    let store = store.display().to_string();
    run(["query", "--store", &store].into_iter().chain(more.iter().copied()))
}

/// Asks for CSV and returns it.
#[track_caller]
fn csv(store: &Path, sql: &str) -> String {
    let output = ask(store, &["--format", "csv", sql]);
    assert_eq!((output.code, output.stderr.as_str()), (0, ""), "{sql}");
    output.stdout
}

/// Asks something wrong and returns the one sentence that comes back.
#[track_caller]
fn refusal(store: &Path, sql: &str) -> String {
    let output = ask(store, &[sql]);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{sql}: {}", output.stderr);
    assert_eq!(output.stderr.lines().count(), 1, "{sql}: {}", output.stderr);
    let sentence = output.stderr.strip_prefix("error: ").expect("an error");
    sentence.trim_end().to_owned()
}

/// Returns a store with two failures at known times, and their commit.
fn failures_at(store: &Location, rows: &[(&str, &str, i64)]) {
    let mut commit = Commit::new(store, "ingest", "rules", "file:///source");
    let rows: Vec<_> = rows
        .iter()
        .map(|(id, message, time_us)| FailureRow {
            stage: "ingest".to_owned(),
            phrase_id: (*id).to_owned(),
            source: format!("file:///source/{id}"),
            kind: "shape".to_owned(),
            message: (*message).to_owned(),
            time: TimestampUs(*time_us),
        })
        .collect();
    let part = commit.part("failures", FailureRow::schema).expect("a temporary file");
    part.write_rows(&rows).expect("rows");
    let ledger = Ledger::read(store, "ingest").expect("commits");
    for row in &rows {
        let (id, input_hash) = (row.phrase_id.clone(), row.message.clone());
        let item = Item { id, fingerprint: String::new(), input_hash, failure: Some("x".into()) };
        commit.settle(item, &ledger);
    }
    commit.publish().expect("published");
}

const SOME: &str =
    "select phrase_id, n_frames, tempo_bpm, has_audio from phrases order by phrase_id";

#[test]
fn csv_quotes_what_needs_it_and_leaves_nulls_empty() {
    let (dir, _) = sound_store();
    let expected = "phrase_id,n_frames,tempo_bpm,has_audio\n\
                    \"a/ü, \"\"quoted\"\"\",47,,false\n\
                    gLO 2,17,125.0,true\n\
                    gLO_3,23,,false\n\
                    mBR0,31,125.0,true\n\
                    z,59,97.5,false\n";
    assert_eq!(csv(&dir.at("store"), SOME), expected);
}

#[test]
fn json_is_an_array_of_rows_with_nulls() {
    let (dir, _) = sound_store();
    let output = ask(&dir.at("store"), &["--format", "json", SOME]);
    assert_eq!((output.code, output.stderr.as_str()), (0, ""));
    let expected = serde_json::json!([
        {"phrase_id": "a/ü, \"quoted\"", "n_frames": 47, "tempo_bpm": null, "has_audio": false},
        {"phrase_id": "gLO 2", "n_frames": 17, "tempo_bpm": 125.0, "has_audio": true},
        {"phrase_id": "gLO_3", "n_frames": 23, "tempo_bpm": null, "has_audio": false},
        {"phrase_id": "mBR0", "n_frames": 31, "tempo_bpm": 125.0, "has_audio": true},
        {"phrase_id": "z", "n_frames": 59, "tempo_bpm": 97.5, "has_audio": false},
    ]);
    let found: serde_json::Value = serde_json::from_str(&output.stdout).expect("JSON");
    assert_eq!(found, expected);
    assert!(output.stdout.ends_with("]\n"), "{}", output.stdout);
}

#[test]
fn a_table_aligns_numbers_right_and_shows_every_digit() {
    let (dir, _) = sound_store();
    let sql = "select phrase_id, n_frames, duration_s, tempo_bpm, has_audio from phrases \
               order by phrase_id";
    let output = ask(&dir.at("store"), &[sql]);
    let expected = "\
┌───────────────┬──────────┬────────────────────┬───────────┬───────────┐
│ phrase_id     ┆ n_frames ┆         duration_s ┆ tempo_bpm ┆ has_audio │
╞═══════════════╪══════════╪════════════════════╪═══════════╪═══════════╡
│ a/ü, \"quoted\" ┆       47 ┆ 1.5666666666666667 ┆      null ┆ false     │
│ gLO 2         ┆       17 ┆           0.566625 ┆       125 ┆ true      │
│ gLO_3         ┆       23 ┆ 0.7666666666666667 ┆      null ┆ false     │
│ mBR0          ┆       31 ┆           1.033375 ┆       125 ┆ true      │
│ z             ┆       59 ┆ 1.9666666666666666 ┆      97.5 ┆ false     │
└───────────────┴──────────┴────────────────────┴───────────┴───────────┘
";
    assert_eq!((output.code, output.stdout.as_str()), (0, expected), "{}", output.stderr);
}

#[test]
fn parquet_keeps_types_and_replaces_the_output_file_whole() {
    let (dir, _) = sound_store();
    let (store, output_file) = (dir.at("store"), dir.write("answers/a.parquet", "an older answer"));
    let flags = ["--format", "parquet", "--output", output_file.to_str().expect("UTF-8"), SOME];
    let output = ask(&store, &flags);
    let expected = format!("5 rows → {}\n", output_file.display());
    assert_eq!((output.code, output.stdout), (0, expected), "{}", output.stderr);
    let file = std::fs::File::open(&output_file).expect("the answer");
    let frame = ParquetReader::new(file).finish().expect("a Parquet file");
    let types: Vec<_> = frame.dtypes().iter().map(ToString::to_string).collect();
    assert_eq!(types, ["str", "i64", "f64", "bool"]);
    let n_frames: Vec<_> = frame.column("n_frames").expect("a column").i64().expect("i64").into();
    assert_eq!(n_frames, [47, 17, 23, 31, 59].map(Some));
    // Nothing else is left in the folder.
    assert_eq!(std::fs::read_dir(dir.at("answers")).expect("the folder").count(), 1);
}

#[test]
fn a_refused_query_leaves_the_output_file_as_it_was() {
    let (dir, _) = sound_store();
    let kept = dir.write("a.csv", "an older answer");
    let path = kept.to_str().expect("UTF-8");
    let output = ask(&dir.at("store"), &["--format", "csv", "--output", path, "select x from y"]);
    assert_eq!(output.code, 2, "{output:?}");
    assert_eq!(std::fs::read_to_string(&kept).expect("still there"), "an older answer");
    let nowhere = dir.write("a file", "x").join("a.csv");
    let path = nowhere.to_str().expect("UTF-8");
    let output = ask(&dir.at("store"), &["--format", "csv", "--output", path, SOME]);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{output:?}");
    let start = format!("error: while writing {path}: ");
    assert!(output.stderr.starts_with(&start), "{}", output.stderr);
}

#[test]
fn tables_counts_rows_bytes_and_parts_of_what_is_live() {
    let (dir, _) = sound_store();
    let store = dir.at("store");
    let expected = |tables: [(&str, usize); 4]| {
        let mut text =
            String::from("table                    rows          bytes   parts  version\n");
        let of_extract = ["features", "extractions"].map(|name| (name, 0));
        let [phrases, motion, beats, failures] = tables;
        let rest = [beats, failures].into_iter().chain(OF_MODELS.map(|name| (name, 0)));
        for (name, n_rows) in [phrases, motion].into_iter().chain(of_extract).chain(rest) {
            let live = live_files(&store, name);
            let n_bytes: u64 = live.iter().sum();
            let version = match name {
                "phrases" => 5,
                "generations" => 5,
                "extractions" | "training_log" => 3,
                "motion" | "generated" | "decoded" | "beats" | "sanity_checks" => 2,
                _ => 1,
            };
            let n_parts = live.len();
            text += &format!("{name:<16} {n_rows:>12} {n_bytes:>14} {n_parts:>7} {version:>8}\n");
        }
        text
    };
    let output = ask(&store, &["--tables"]);
    let first = expected([("phrases", 5), ("motion", 177), ("beats", 14), ("failures", 1)]);
    assert_eq!((output.code, output.stdout), (0, first), "{}", output.stderr);

    // One phrase is replaced by a longer one, the broken one is repaired.
    write_phrase(&dir, 2, 19);
    dir.write("source/motion/broken/trajectory.npy", trajectory(&coherent(7, 7)));
    let output = ingest(&dir.at("source"), &store, &["--batch-phrases", "2"]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = ask(&store, &["--tables"]);
    let then = expected([("phrases", 6), ("motion", 186), ("beats", 14), ("failures", 0)]);
    assert_eq!((output.code, output.stdout), (0, then), "{}", output.stderr);
}

/// Returns the sizes of a table's live parts.
fn live_files(store: &Path, table: &str) -> Vec<u64> {
    let location = Location::local(store).expect("a location");
    let live = motiongen::store::live_parts(&location).expect("commits").remove(table);
    let size = |path: &str| std::fs::metadata(store.join(path)).expect("a part").len();
    live.unwrap_or_default().iter().map(|l| size(&l.part.path)).collect()
}

#[test]
fn rows_of_replaced_phrases_do_not_appear() {
    let (dir, _) = sound_store();
    let store = dir.at("store");
    write_phrase(&dir, 2, 19);
    dir.write("source/motion/broken/trajectory.npy", trajectory(&coherent(7, 7)));
    assert_eq!(ingest(&dir.at("source"), &store, &["--batch-phrases", "2"]).code, 0);
    let sql = "select phrase_id, n_frames from phrases order by phrase_id";
    let expected = "phrase_id,n_frames\n\"a/ü, \"\"quoted\"\"\",47\nbroken,7\ngLO 2,19\ngLO_3,23\n\
                    mBR0,31\nz,59\n";
    assert_eq!(csv(&store, sql), expected);
    let sql = "select phrase_id, count(*) n, max(frame) last from motion group by phrase_id \
               order by phrase_id";
    let expected = "phrase_id,n,last\n\"a/ü, \"\"quoted\"\"\",47,46\nbroken,7,6\ngLO 2,19,18\n\
                    gLO_3,23,22\nmBR0,31,30\nz,59,58\n";
    assert_eq!(csv(&store, sql), expected);
    assert_eq!(csv(&store, "select count(*) n from failures"), "n\n0\n");
}

#[test]
fn aggregates_over_many_parts_are_those_of_the_frames() {
    let (dir, frames) = sound_store();
    let sql = "select phrase_id, count(*) n, min(position_x) low, max(position_x) high, \
               avg(cast(style_3 as double)) mean from motion where frame >= 5 and frame < 20 \
               group by phrase_id order by phrase_id desc";
    let text = csv(&dir.at("store"), sql);
    let mut rows = text.lines().skip(1);
    for i in [3, 0, 4, 2, 1] {
        let (id, n_frames, _) = PHRASES[i];
        let part = &frames[i][5..20.min(n_frames)];
        let x: Vec<f32> = part.iter().map(|f| f[0]).collect();
        let mean = part.iter().map(|f| f64::from(f[20])).sum::<f64>() / part.len() as f64;
        let row = rows.next().expect("five rows");
        // The quoted name holds commas, the numbers do not.
        let mut cells = row.rsplit(',');
        let mut number = || cells.next().and_then(|c| c.parse::<f64>().ok()).expect("a number");
        let found_mean = number();
        // The order in which a mean is summed is polars' affair: a few units in the 16th digit.
        assert!((found_mean - mean).abs() < 1e-12, "{row}: mean {mean}");
        let high = x.iter().copied().fold(f32::MIN, f32::max);
        let low = x.iter().copied().fold(f32::MAX, f32::min);
        assert_eq!(number() as f32, high, "{row}");
        assert_eq!(number() as f32, low, "{row}");
        assert_eq!(number(), part.len() as f64, "{row}");
        assert!(row.contains(id.split('"').next().expect("a start")), "{row}: not {id}");
    }
    assert_eq!(rows.next(), None);
}

#[test]
fn joins_relate_the_tables_of_a_store() {
    let (dir, _) = sound_store();
    let sql = "select p.phrase_id, p.n_frames, count(*) n, p.audio_codec c from phrases p \
               join motion m on m.phrase_id = p.phrase_id where p.has_audio \
               group by p.phrase_id, p.n_frames, p.audio_codec order by p.phrase_id";
    let expected = "phrase_id,n_frames,n,c\ngLO 2,17,17,pcm_s16le\nmBR0,31,31,pcm_s16le\n";
    assert_eq!(csv(&dir.at("store"), sql), expected);
    // Case of keywords and tables does not matter, and two spellings are one table.
    let sql = "SELECT COUNT(*) AS n FROM Phrases LEFT JOIN PHRASES q USING (phrase_id)";
    assert_eq!(csv(&dir.at("store"), sql), "n\n5\n");
}

#[test]
fn timestamps_are_shown_in_utc_with_microseconds() {
    let dir = Dir::new();
    let store = Location::local(&dir.at("store")).expect("a location");
    failures_at(&store, &[("a", "first", 1_700_000_000_123_456), ("b", "second", -1)]);
    let sql = "select phrase_id, time from failures order by time";
    let expected = "phrase_id,time\nb,1969-12-31T23:59:59.999999+0000\n\
                    a,2023-11-14T22:13:20.123456+0000\n";
    assert_eq!(csv(&dir.at("store"), sql), expected);
    let output = ask(&dir.at("store"), &["select time from failures where phrase_id = 'a'"]);
    assert!(output.stdout.contains("│ 2023-11-14 22:13:20.123456 UTC │"), "{}", output.stdout);
}

#[test]
fn an_empty_store_has_every_table_without_rows() {
    let dir = Dir::new();
    let store = empty_store(&dir);
    let sql = "select phrase_id, duration_s, has_audio, n_frames from phrases";
    assert_eq!(csv(&store, sql), "phrase_id,duration_s,has_audio,n_frames\n");
    let sql = "select split, count(*) n, sum(duration_s) s from phrases group by split";
    assert_eq!(csv(&store, sql), "split,n,s\n");
    assert_eq!(csv(&store, "select count(*) n from motion"), "n\n0\n");
    assert_eq!(csv(&store, "select phrase_id, time from failures"), "phrase_id,time\n");
    let output = ask(&store, &["--format", "json", "select phrase_id from phrases"]);
    assert_eq!((output.code, output.stdout.as_str()), (0, "[]\n"), "{}", output.stderr);
    let expected = "\
table                    rows          bytes   parts  version
phrases                     0              0       0        5
motion                      0              0       0        2
features                    0              0       0        1
extractions                 0              0       0        3
beats                       0              0       0        2
failures                    0              0       0        1
training_log                0              0       0        3
onnx_checks                 0              0       0        1
generations                 0              0       0        5
generated                   0              0       0        2
decoded                     0              0       0        2
tokens                      0              0       0        1
tokenizations               0              0       0        1
sanity_checks               0              0       0        2
metrics                     0              0       0        1
verdicts                    0              0       0        1
song_metrics                0              0       0        1
";
    let output = ask(&store, &["--tables"]);
    assert_eq!((output.code, output.stdout.as_str()), (0, expected), "{}", output.stderr);
}

/// Makes a store in which nothing was ever settled.
fn empty_store(dir: &Dir) -> PathBuf {
    std::fs::create_dir_all(dir.at("store/commits")).expect("a folder");
    dir.at("store")
}

#[test]
fn folders_above_the_store_never_become_columns() {
    let dir = Dir::new();
    let path = dir.at("split=3/run=x[1]*/store ü");
    let store = Location::local(&path).expect("a location");
    failures_at(&store, &[("a", "1", 1)]);
    let sql = "select * from failures";
    let expected = "stage,phrase_id,source,kind,message,time\n\
                    ingest,a,file:///source/a,shape,1,1970-01-01T00:00:00.000001+0000\n";
    assert_eq!(csv(&path, sql), expected);
}

#[test]
fn a_store_in_memory_is_asked_inside_the_process() {
    let options = ClientOptions::default();
    let store = Location::open("memory://query-tables/ü", &options).expect("a store in memory");
    failures_at(&store, &[("a", "1", 1), ("b", "1", 2), ("c", "1", 3)]);
    failures_at(&store, &[("b", "2", 4)]);
    let ask = |sql| {
        let answer = query(&store, sql, &options).unwrap_or_else(|e| panic!("{e}"));
        let mut text = Vec::new();
        let n_rows = answer.write(DataFormat::Csv, &mut text).expect("written to memory");
        (n_rows, String::from_utf8(text).expect("UTF-8"))
    };
    let sql = "select phrase_id, message from failures order by phrase_id";
    assert_eq!(ask(sql), (3, "phrase_id,message\na,1\nb,2\nc,1\n".to_owned()));
    assert_eq!(ask("select count(*) n from phrases"), (1, "n\n0\n".to_owned()));
    let error = query(&store, "select id from failures", &options).expect_err("no such column");
    assert!(matches!(error, StoreError::Query(_)), "{error:?}");
    let infos = table_infos(&store, &options).expect("a store");
    let counts: Vec<_> = infos.iter().map(|i| (i.name, i.n_rows, i.n_parts)).collect();
    let empty = ["phrases", "motion", "features", "extractions", "beats"].map(|name| (name, 0, 0));
    let of_models = OF_MODELS.map(|name| (name, 0, 0));
    assert_eq!(counts, [&empty[..], &[("failures", 3, 2)], &of_models].concat());
}
