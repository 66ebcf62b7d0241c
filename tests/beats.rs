//! Beats: a beat list counts in every stage, whatever came first, also in stores of release 0.1.

use std::fs::File;
use std::path::{Path, PathBuf};

use motiongen::motion::{Beats, bar_phase};
use motiongen::stages::beats::{BeatSource, PhraseBeats, of_phrases};
use motiongen::store::tables::{BeatRow, ExtractionRow};
use motiongen::store::{Location, StoreSnapshot};
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::Value;

use crate::library::clicks;
use crate::support::files::{coherent, trajectory};
use crate::support::plots::svg;
use crate::support::{Dir, Output, failures, ingest, phrases, rows, run};

const LIST: &str = "source/audio/song.beats.txt";

/// Nineteen beats at 150 beats/min, of which the third is the first downbeat.
fn list() -> String {
    (0..19).map(|i| format!("{} {}\n", 0.1 + 0.4 * f64::from(i), (i + 2) % 4 + 1)).collect()
}

/// Writes a song of 120 beats/min with motion and a list that says otherwise, and a song without a list.
fn write_source(dir: &Dir) {
    dir.write("source/audio/song.wav", clicks(120.0, 8.5));
    dir.write("source/motion/song/trajectory.npy", trajectory(&coherent(255, 1)));
    dir.write("source/audio/other.wav", clicks(93.7, 6.0));
    dir.write(LIST, list());
}

#[track_caller]
fn ingested(dir: &Dir) -> String {
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    output.stdout
}

#[track_caller]
fn extracted(dir: &Dir) -> String {
    let output = stage(dir, "extract", &[]);
    assert_eq!(output.code, 0, "{output:?}");
    output.stdout
}

fn stage(dir: &Dir, name: &str, more: &[&str]) -> Output {
    let store = dir.at("store").display().to_string();
    run([name, "--store", &store].iter().chain(more))
}

fn csv(dir: &Dir, sql: &str) -> String {
    let output = stage(dir, "query", &["--format", "csv", sql]);
    assert_eq!(output.code, 0, "{output:?}");
    output.stdout
}

/// Returns the rows of a phrase, in order.
fn rows_of(dir: &Dir, id: &str) -> Vec<BeatRow> {
    let mut rows: Vec<BeatRow> = rows(&dir.at("store"));
    rows.retain(|row| row.phrase_id == id);
    rows.sort_by(|a, b| (&a.source, a.beat).cmp(&(&b.source, b.beat)));
    rows
}

/// Returns the beats of a phrase as every stage reads them.
fn read(store: &Path, id: &str) -> PhraseBeats {
    let store = Location::local(store).expect("a folder");
    let store = StoreSnapshot::take(&store).expect("commits");
    of_phrases(&store, |name| name == id).expect("beats").remove(id).unwrap_or_default()
}

fn n_tracked(dir: &Dir) -> usize {
    let rows: Vec<ExtractionRow> = rows(&dir.at("store"));
    let row = rows.iter().find(|row| row.phrase_id == "song").expect("an extraction");
    usize::try_from(row.n_beats).expect("a number of beats")
}

/// Checks that the table has the list's beats of the song and no others.
#[track_caller]
fn assert_listed(dir: &Dir) {
    let list = Beats::parse(&list()).expect("a list");
    let (rows, numbers) = (rows_of(dir, "song"), list.numbers().expect("numbers"));
    assert_eq!(rows.len(), 19);
    for ((i, row), (&time_s, &number)) in
        rows.iter().enumerate().zip(list.times_s().iter().zip(numbers))
    {
        assert_eq!((row.beat, row.time_s), (i as i32, time_s));
        assert_eq!(row.frame, (time_s * 30.0).round() as i32);
        assert_eq!(row.number.map(i64::from), Some(number));
        assert_eq!(row.source.as_deref(), Some("beats_file"));
    }
}

#[test]
fn a_beat_list_takes_the_place_of_what_the_tracker_finds() {
    let dir = Dir::new();
    write_source(&dir);
    ingested(&dir);
    assert_listed(&dir);
    extracted(&dir);
    assert_listed(&dir);
    // `extractions` counts the beats that belong to the features, which are others.
    assert!((5..17).contains(&n_tracked(&dir)), "{}", n_tracked(&dir));
    let others = rows_of(&dir, "other");
    assert!(others.len() > 5);
    for row in &others {
        assert_eq!((row.number, row.source.as_deref()), (None, Some("tracker")));
        // The song's clicks, to 20 ms.
        let click = (row.time_s - 0.25) * 93.7 / 60.0;
        assert!((click - click.round()).abs() * 60.0 / 93.7 < 0.02, "{row:?}");
        assert_eq!(f64::from(row.frame), (row.time_s * 30.0).round());
    }

    // The phase is the list's, with its downbeat at 0.9 s.
    let (store, list) = (dir.at("store"), Beats::parse(&list()).expect("a list"));
    let beats = read(&store, "song").in_bars(&phrases(&store)["song"]).expect("beats");
    let times_s: Vec<f64> = (0..255).map(|i| f64::from(i) / 30.0).collect();
    assert_eq!(bar_phase(&times_s, &beats), bar_phase(&times_s, &list));
    assert!(bar_phase(&[0.9], &beats)[0] < 1e-9 && bar_phase(&[0.1], &beats) == [0.5]);

    // Pages and plots show it, too.
    let page = dir.at("song.html").display().to_string();
    let output = stage(&dir, "view", &["--phrase", "song", "--no-audio", "--output", &page]);
    assert!(output.stdout.contains(", 19 beats, "), "{output:?}");
    let shown = crate::view::data(&crate::view::page(&page));
    let shown: Vec<f64> = shown["beats"]
        .as_array()
        .expect("beats")
        .iter()
        .map(|t| t.as_f64().expect("a time"))
        .collect();
    assert!(
        shown.len() == 19 && shown.iter().zip(list.times_s()).all(|(a, b)| (a - b).abs() < 1e-3)
    );
    let picture = dir.at("song.svg").display().to_string();
    let store = store.display().to_string();
    for kind in ["features", "motion"] {
        let flags = ["plot", kind, "--store", &store, "--phrase", "song", "--output", &picture];
        let output = run(flags);
        assert_eq!(output.code, 0, "{output:?}");
        if kind == "features" {
            let svg = svg(&picture);
            assert!(svg.contains(">150.0 bpm<") && svg.contains(">19 beats<"), "{svg}");
        }
    }
}

#[test]
fn beats_follow_a_list_that_comes_and_goes() {
    let dir = Dir::new();
    write_source(&dir);
    std::fs::remove_file(dir.at(LIST)).expect("the list");
    ingested(&dir);
    extracted(&dir);
    let tracked = rows_of(&dir, "song");
    // Seventeen clicks, of which the first and the last are hardly heard.
    assert!((14..=17).contains(&tracked.len()), "{}", tracked.len());
    assert!(tracked.iter().all(|row| row.source.as_deref() == Some("tracker")));
    let store = dir.at("store");
    assert_eq!(read(&store, "song").source(), Some(BeatSource::Tracker));

    // It comes: until extract runs again the table has both, and every stage reads the list's.
    dir.write(LIST, list());
    assert!(ingested(&dir).contains("  1 ingested ("));
    assert_eq!(rows_of(&dir, "song").len(), 19 + tracked.len());
    let found = read(&store, "song");
    assert_eq!((found.source(), found.times_s().len()), (Some(BeatSource::BeatsFile), 19));
    assert!(extracted(&dir).contains("  1 phrases extracted ("));
    assert_listed(&dir);
    assert!(ingested(&dir).contains("nothing to do: 2 phrases are up to date"));
    assert!(extracted(&dir).contains("nothing to do: 2 phrases are up to date"));

    // It goes, and the tracker's beats are back.
    std::fs::remove_file(dir.at(LIST)).expect("the list");
    ingested(&dir);
    assert_eq!(rows_of(&dir, "song"), []);
    assert!(extracted(&dir).contains("  1 phrases extracted ("));
    assert_eq!(rows_of(&dir, "song"), tracked);
}

/// Changes every commit of a stage.
fn change_commits(store: &Path, stage: &str, mut change: impl FnMut(&mut Value)) {
    for entry in std::fs::read_dir(store.join("commits").join(stage)).expect("commits") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read_to_string(&path).expect("a commit");
        let mut commit: Value = serde_json::from_str(&text).expect("JSON");
        change(&mut commit);
        std::fs::write(&path, commit.to_string()).expect("written");
    }
}

/// Writes a part again with its first four columns.
fn shorten(path: &Path) -> u64 {
    let file = File::open(path).expect("a part");
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).expect("Parquet").build();
    let batches: Vec<_> = reader
        .expect("a reader")
        .map(|batch| batch.expect("a batch").project(&[0, 1, 2, 3]).expect("four columns"))
        .collect();
    let file = File::create(path).expect("a part");
    let mut writer = ArrowWriter::try_new(file, batches[0].schema(), None).expect("a writer");
    batches.iter().for_each(|batch| writer.write(batch).expect("written"));
    writer.close().expect("written");
    path.metadata().expect("a part").len()
}

/// Makes the store that release 0.1 made of the source: ingest wrote no beats, extract the tracker's of every
/// song, without numbers and sources.
fn old_store(dir: &Dir) -> PathBuf {
    let store = dir.at("store");
    ingested(dir);
    let content = phrases(&store)["song"].content_hash.clone();
    change_commits(&store, "ingest", |commit| {
        commit["parts"].as_array_mut().expect("parts").retain(|part| part["table"] != "beats");
        for item in commit["items"].as_array_mut().expect("items") {
            if item["id"] == "song" {
                item["input_hash"] = content.clone().into();
                item["fingerprint"] = "of the files alone".into();
            }
        }
    });
    extracted(dir);
    change_commits(&store, "extract", |commit| {
        for part in commit["parts"].as_array_mut().expect("parts") {
            if part["table"] == "beats" {
                let path = store.join(part["path"].as_str().expect("a path"));
                part["n_bytes"] = shorten(&path).into();
                part["schema_version"] = 1.into();
            }
        }
    });
    store
}

#[test]
fn a_store_of_release_0_1_is_read_and_gets_the_beats_of_its_lists() {
    let dir = Dir::new();
    write_source(&dir);
    let store = old_store(&dir);
    let (old, others) = (rows_of(&dir, "song"), rows_of(&dir, "other"));
    assert!(old.len() > 5);
    assert!(old.iter().chain(&others).all(|row| row.number.is_none() && row.source.is_none()));
    assert_eq!(read(&store, "song").source(), None);
    let (n, m) = (old.len(), others.len());
    let of_each = "select phrase_id, count(*) n, count(number) k, count(source) s from beats \
                   group by phrase_id order by phrase_id";
    assert_eq!(csv(&dir, of_each), format!("phrase_id,n,k,s\nother,{m},0,0\nsong,{n},0,0\n"));

    // library does not take the tracker's beats for the list's.
    dir.write("captures/walk.npy", trajectory(&coherent(200, 3)));
    let captures = dir.at("captures").display().to_string();
    let flags = ["--captures", &captures, "--takes", "1", "--quiet"];
    let output = stage(&dir, "library", &flags);
    assert_eq!(output.code, 1, "{output:?}");
    let url = url::Url::from_file_path(dir.at(LIST)).expect("a path");
    let failure = &failures(&store)["song"];
    let message = format!(
        "song: the store does not have the beats of {url}, which an older motiongen ingested; run \
         ingest again, then extract and library"
    );
    assert_eq!((failure.kind.as_str(), &failure.message), ("version", &message));

    // Only the phrase with a list is ingested and extracted again.
    let said = ingested(&dir);
    assert!(said.contains("  1 ingested (") && said.contains(", 1 up to date"), "{said}");
    // The other song was danced to: without the phrases of that.
    let of_sources = "select source, count(*) n, count(number) k from beats where phrase_id in \
                      ('song', 'other') group by source order by source nulls first";
    let both = n + m;
    assert_eq!(csv(&dir, of_sources), format!("source,n,k\n,{both},0\nbeats_file,19,19\n"));
    assert_eq!(read(&store, "song").source(), Some(BeatSource::BeatsFile));
    let said = extracted(&dir);
    assert!(said.contains("  1 phrases extracted (") && said.contains(", 1 up to date"), "{said}");
    assert_listed(&dir);
    assert_eq!(rows_of(&dir, "other"), others);
    assert_eq!(csv(&dir, of_sources), format!("source,n,k\n,{m},0\nbeats_file,19,19\n"));
    let sql =
        "select time_s, number from beats where phrase_id = 'song' and beat < 3 order by beat";
    assert_eq!(csv(&dir, sql), "time_s,number\n0.1,3\n0.5,4\n0.9,1\n");
    assert!(ingested(&dir).contains("nothing to do: 2 phrases are up to date"));
    assert!(extracted(&dir).contains("nothing to do: 2 phrases are up to date"));

    let output = stage(&dir, "library", &flags);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(failures(&store).is_empty());
    let sql = "select b.source, count(*) n, count(number) k from beats b join phrases p on b.phrase_id \
               = p.phrase_id where p.motion_format = 'constructed' group by b.source order by b.source";
    let counted = csv(&dir, sql);
    let counts: Vec<Vec<&str>> = counted.lines().skip(1).map(|l| l.split(',').collect()).collect();
    assert_eq!(counts.iter().map(|c| c[0]).collect::<Vec<_>>(), ["beats_file", "tracker"]);
    assert!(counts.iter().all(|c| c[1] == c[2]), "every beat has a number: {counted}");
}

#[test]
fn the_same_phrases_from_another_folder_are_the_same_in_a_store_of_release_0_1() {
    let dir = Dir::new();
    write_source(&dir);
    old_store(&dir);
    std::fs::rename(dir.at("source"), dir.at("moved")).expect("moved");
    let output = ingest(&dir.at("moved"), &dir.at("store"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(read(&dir.at("store"), "song").source(), Some(BeatSource::BeatsFile));
}
