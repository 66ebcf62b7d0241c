//! What is done is known by content: of files, of music, of models, of configurations.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::store::tables::{ExtractionRow, GenerationRow, TrainingLogRow};
use zip::CompressionMethod;

use super::{stage, succeed};
use crate::generate::modelled;
use crate::support::files::{coherent, npz, wav};
use crate::support::{Dir, failures, finish, ingest, motiongen, phrases, rows, tree};
use crate::train::{features, losses, train};

/// Returns the usual flags that are not given otherwise, and those that are.
fn unless_given<'a>(usual: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
    let flag = |argument: &'a str| argument.split('=').next().unwrap_or_default();
    let given: Vec<&str> = more.iter().map(|argument| flag(argument)).collect();
    let kept = usual.iter().filter(|argument| !given.contains(&flag(argument)));
    kept.chain(more).copied().collect()
}

fn generate(store: &Path, more: &[&str]) -> Command {
    let usual = ["--engine=eager", "--steps=3", "--overlap=7", "--quiet"];
    stage("generate", store, &unless_given(&usual, more))
}

fn generations(store: &Path) -> Vec<GenerationRow> {
    let mut rows: Vec<GenerationRow> = rows(store);
    rows.sort_by(|a, b| a.generation.cmp(&b.generation));
    rows
}

/// Gives a phrase other features of the same length, and ingests it again.
fn replace_features(dir: &Dir, store: &Path, id: &str) {
    let path = dir.at(format!("source/audio_features/{id}/features.npz"));
    let n_frames = phrases(store)[id].n_frames.expect("motion") as usize;
    let other = npz(&features(&coherent(n_frames, 77)), CompressionMethod::Stored);
    std::fs::write(path, other).expect("written");
    let output = ingest(&dir.at("source"), store, &[]);
    assert!(output.stdout.contains("  1 ingested ("), "{output:?}");
}

#[test]
fn features_and_motions_of_replaced_files_are_not_taken() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let place = store.display();
    let id = phrases(&store).into_keys().next().expect("a phrase");
    succeed(&mut generate(&store, &["--model=m"]));
    let before = generations(&store);
    assert!(
        before
            .iter()
            .all(|row| row.content_hash
                == Some(phrases(&store)[&row.phrase_id].content_hash.clone()))
    );

    replace_features(&dir, &store, &id);
    let old: Vec<ExtractionRow> = rows(&store);
    let old = old.into_iter().find(|row| row.phrase_id == id).expect("a row");
    assert_ne!(old.content_hash.as_ref(), Some(&phrases(&store)[&id].content_hash));
    // What was made for the replaced file is neither shown nor judged.
    let evaluated = finish(&mut stage("evaluate", &store, &["--run=m", "--quick"]));
    assert_eq!(
        (evaluated.code, evaluated.stderr),
        (
            2,
            format!(
                "error: store {place}: 1 of 16 motions of run \"m\" were made for files that were replaced since; run \
                 motiongen extract and generate again. The first: m/{id}/0\n"
            )
        )
    );
    let page = dir.at("page.html").display().to_string();
    let shown = ["--phrase", &id, "--run=m", "--output", &page];
    let shown = finish(&mut stage("view", &store, &shown));
    assert_eq!(
        (shown.code, shown.stderr),
        (
            2,
            format!(
                "error: store {place}: the motion of run \"m\" for phrase \"{id}\" was made for files that were \
                 replaced since; run motiongen extract and generate again\n"
            )
        )
    );
    // Nobody learns from old features, nor dances to them.
    let planned = train(&store, "other", &["--dry-run", "--max-failed=0.5"]);
    assert!(planned.stdout.ends_with("; 1 phrases are left out\n"), "{planned:?}");
    let refused = train(&store, "other", &["--max-failed=0"]);
    assert!(
        refused.stderr.ends_with(&format!(
            "The first: phrase {id} has features of files that were replaced since; run extract again\n"
        )),
        "{refused:?}"
    );
    let danced = finish(&mut generate(&store, &["--model=m"]));
    assert_eq!(danced.code, 1, "{danced:?}");
    let failed = &failures(&store)[&format!("m/{id}/0")];
    assert_eq!(failed.kind, "stale_features");
    assert_eq!(
        failed.message,
        format!(
            "phrase {id}: its features are of files that were replaced since; run motiongen extract --store {place} \
             first"
        )
    );
    // And with the present ones everything goes its way.
    succeed(&mut stage("extract", &store, &[]));
    let danced = succeed(&mut generate(&store, &["--model=m"]));
    assert!(danced.stdout.contains("  1 motions made ("), "{danced:?}");
    assert!(danced.stdout.contains(", 15 up to date, 0 failed"), "{danced:?}");
    let now = generations(&store);
    let hash_in = |rows: &[GenerationRow]| {
        rows.iter().find(|row| row.phrase_id == id).expect("a row").content_hash.clone()
    };
    assert_ne!(hash_in(&now), hash_in(&before));
    assert_eq!(hash_in(&now), Some(phrases(&store)[&id].content_hash.clone()));
    succeed(&mut stage("evaluate", &store, &["--run=m", "--quick"]));
    assert_eq!(train(&store, "other", &["--dry-run", "--max-failed=0"]).code, 0);
}

/// Rows of older versions do not say what they were made from; the commits that wrote them do.
#[test]
fn rows_without_the_column_are_known_by_their_commits() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let id = phrases(&store).into_keys().next().expect("a phrase");
    for part in std::fs::read_dir(store.join("extractions")).expect("parts") {
        without_column(&part.expect("a part").path(), "content_hash");
    }
    for manifest in std::fs::read_dir(store.join("commits/extract")).expect("manifests") {
        let path = manifest.expect("a manifest").path();
        let text = std::fs::read_to_string(&path).expect("text");
        let mut manifest: serde_json::Value = serde_json::from_str(&text).expect("JSON");
        for part in manifest["parts"].as_array_mut().expect("parts") {
            if part["table"] == "extractions" {
                part["schema_version"] = 1.into();
            }
        }
        std::fs::write(&path, manifest.to_string()).expect("written");
    }
    let read: Vec<ExtractionRow> = rows(&store);
    assert!(read.len() == 16 && read.iter().all(|row| row.content_hash.is_none()));
    assert_eq!(train(&store, "other", &["--dry-run", "--max-failed=0"]).code, 0);
    replace_features(&dir, &store, &id);
    let planned = train(&store, "other", &["--dry-run", "--max-failed=0.5"]);
    assert!(planned.stdout.ends_with("; 1 phrases are left out\n"), "{planned:?}");
}

/// Writes a part again without a column.
fn without_column(path: &Path, column: &str) {
    use parquet::arrow::ArrowWriter;
    use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
    let bytes = bytes::Bytes::from(std::fs::read(path).expect("a part"));
    let reader = ParquetRecordBatchReaderBuilder::try_new(bytes).expect("parquet");
    let batches: Vec<_> =
        reader.build().expect("a reader").map(|batch| batch.expect("a batch")).collect();
    let kept: Vec<usize> = (0..batches[0].num_columns())
        .filter(|i| batches[0].schema_ref().field(*i).name() != column)
        .collect();
    let schema = batches[0].project(&kept).expect("columns").schema();
    let file = std::fs::File::create(path).expect("a file");
    let mut writer = ArrowWriter::try_new(file, schema, None).expect("a writer");
    for batch in &batches {
        writer.write(&batch.project(&kept).expect("columns")).expect("written");
    }
    writer.close().expect("closed");
}

#[test]
fn a_motion_in_a_folder_is_known_by_model_settings_and_song() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let model = store.join("models/m").display().to_string();
    let song = dir.write("song.wav", wav(1.3));
    let out = dir.at("out");
    let dance = |song: &Path, more: &[&str]| {
        let mut command = motiongen();
        command.args(["generate", "--model", &model, "--quiet", "--engine=eager", "--overlap=7"]);
        command.args(unless_given(&["--steps=3", "--format=npy"], more));
        succeed(command.arg("--output").arg(&out).arg("--audio").arg(song)).stdout
    };
    let motion = || std::fs::read(out.join("song.npy")).expect("a motion");
    let is_kept = |said: &str| said.contains("  nothing to do: 1 motions are up to date");
    assert!(!is_kept(&dance(&song, &[])));
    let first = motion();
    assert!(is_kept(&dance(&song, &[])));
    assert_eq!(motion(), first);
    // Another seed, other settings, another song of the same name, another format: none hides behind what is there.
    let mut seen = BTreeSet::from([first.clone()]);
    for more in [&["--seed=7"][..], &["--steps=5", "--guidance=1"], &["--raw"]] {
        assert!(!is_kept(&dance(&song, more)), "{more:?}");
        assert!(seen.insert(motion()), "{more:?}: the motion of before");
        assert!(is_kept(&dance(&song, more)), "{more:?}");
    }
    let other = dir.write("other/song.wav", wav(2.1));
    assert!(!is_kept(&dance(&other, &[])));
    assert!(seen.insert(motion()));
    assert!(!is_kept(&dance(&song, &[])));
    assert_eq!(motion(), first);
    assert!(!is_kept(&dance(&song, &["--format=npy,csv"])));
    assert!(is_kept(&dance(&song, &["--format=csv"])) && is_kept(&dance(&song, &[])));
    // A beat list beside the song is part of it.
    dir.write("song.beats.txt", "0.1 1\n0.6 2\n1.1 3\n");
    assert!(!is_kept(&dance(&song, &[])));
    std::fs::remove_file(dir.at("song.beats.txt")).expect("removed");
    assert!(!is_kept(&dance(&song, &[])));
    // A file that somebody else wrote is not ours.
    std::fs::write(out.join("song.npy"), b"mine").expect("written");
    assert!(!is_kept(&dance(&song, &[])));
    assert_eq!(motion(), first);
    // A stream holds the frames, made before or not.
    let stream = dir.at("s.csv").display().to_string();
    dance(&song, &["--stream", &stream]);
    assert_eq!(std::fs::read_to_string(&stream).expect("text").lines().count(), 1 + 40);
    let text = std::fs::read_to_string(out.join("song.motiongen.json")).expect("a receipt");
    let receipt: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    assert_eq!((&receipt["model"], &receipt["seed"]), (&"m".into(), &0.into()));
    assert_eq!(receipt["settings"]["sampler"]["n_steps"], 3);
}

#[test]
fn a_model_is_named_as_it_was_typed() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let id = phrases(&store).into_keys().next().expect("a phrase");
    succeed(&mut generate(&store, &["--model=m", "--phrase", &id]));
    let mut copy = Command::new("cp");
    copy.arg("-r").args([store.join("models/m"), store.join("models/other")]);
    assert!(copy.status().expect("cp").success());
    let output = succeed(&mut generate(&store, &["--model=other", "--phrase", &id, "--steps=2"]));
    assert!(output.stdout.contains("  model other (its card calls it m), eager ("), "{output:?}");
    let rows = generations(&store);
    let told: Vec<_> = rows.iter().map(|r| (&*r.run, &*r.model, r.n_steps)).collect();
    assert_eq!(told, [("m", "m", 3), ("other", "other", 2)]);
    succeed(&mut stage("evaluate", &store, &["--run=other", "--quick"]));
    // A folder has its own name.
    let folder = store.join("models/other").display().to_string();
    succeed(&mut generate(&store, &["--model", &folder, "--phrase", &id, "--steps=2", "--force"]));
    assert_eq!(generations(&store).len(), 2);
}

/// A part that was left by a kill between its two writes is not taken for that of another configuration.
#[test]
fn the_log_of_one_configuration_is_not_that_of_another() {
    let dir = Dir::new();
    let store = crate::train::make_store(&dir);
    let short = ["--steps=2", "--decoder-steps=1"];
    let with = |rate: &'static str, more: &[&'static str]| {
        let output = train(&store, "a", &[&short[..], &[rate], more].concat());
        assert_eq!(output.code, 0, "{output:?}");
    };
    let rates = || -> Vec<Option<f64>> {
        let mut rows: Vec<TrainingLogRow> = rows(&store);
        rows.retain(|row| row.stage == "diffusion" && row.kind == "step");
        rows.sort_by_key(|row| row.step);
        rows.into_iter().map(|row| row.learning_rate).collect()
    };
    with("--learning-rate=1e-3", &["--warmup-steps=0"]);
    let first = rates();
    std::fs::remove_dir_all(store.join("commits/train")).expect("commits");
    std::fs::remove_dir_all(store.join("runs/a")).expect("a run");
    with("--learning-rate=1e-5", &["--warmup-steps=0"]);
    let second = rates();
    assert_eq!(second.len(), 2);
    for (first, second) in first.into_iter().zip(second) {
        let ratio = first.expect("a rate") / second.expect("a rate");
        assert!((ratio - 100.0).abs() < 1e-6, "the rates of the run before: {ratio}");
    }
}

/// Nor for that of other data, or of a run of other steps, on whose number learning rates depend.
#[test]
fn the_log_of_other_data_or_of_more_steps_is_not_that_of_a_run() {
    let dir = Dir::new();
    let store = crate::train::make_store(&dir);
    let with = |run: &str, more: &[&str]| {
        let usual = ["--steps=2", "--save-every-steps=2", "--decoder-steps=1", "--warmup-steps=0"];
        let output = train(&store, run, &unless_given(&usual, more));
        assert_eq!(output.code, 0, "{output:?}");
        losses(&store, run, "diffusion")
    };
    // What a kill leaves of a run that had written its parts and nothing else.
    let forget = || {
        std::fs::remove_dir_all(store.join("commits/train")).expect("commits");
        std::fs::remove_dir_all(store.join("runs/a")).expect("a run");
    };
    let first = with("a", &[]);
    forget();
    let of_rates = |rows: Vec<TrainingLogRow>| -> Vec<(i64, Option<f64>)> {
        let mut rates: Vec<_> = rows
            .into_iter()
            .filter(|row| row.run == "a" && row.stage == "diffusion" && row.kind == "step")
            .map(|row| (row.step, row.learning_rate))
            .collect();
        rates.sort_by_key(|(step, _)| *step);
        rates
    };
    with("a", &["--steps=4"]);
    let rates = of_rates(rows(&store));
    assert_eq!(rates.len(), 4);
    // Half way down a cosine: of two steps the second has half of the peak, of four the third.
    assert_eq!(rates[2].1, Some(1.5e-3), "the rates of a run of two steps: {rates:?}");
    assert!(rates[1].1 > Some(2.5e-3), "the rates of a run of two steps: {rates:?}");
    forget();
    let id = phrases(&store).into_values().find(|row| row.split == "train").expect("a phrase");
    replace_features(&dir, &store, &id.phrase_id);
    succeed(&mut stage("extract", &store, &[]));
    let again = with("a", &[]);
    assert_ne!(again, first, "the losses on what the files held before");
    assert_eq!(again, with("b", &[]));
}

fn touch(path: &Path) {
    let file = std::fs::File::options().write(true).open(path).expect("a file");
    file.set_modified(std::time::SystemTime::now()).expect("touched");
}

#[test]
fn a_file_that_was_only_touched_is_read_once() {
    let dir = Dir::new();
    let store = crate::train::make_store(&dir);
    let source = dir.at("source");
    let touched: Vec<PathBuf> = walkdir::WalkDir::new(source.join("motion"))
        .into_iter()
        .flatten()
        .filter(|entry| entry.file_type().is_file())
        .map(|entry| entry.into_path())
        .collect();
    assert_eq!(touched.len(), 16);
    let is_part = |path: &&PathBuf| !path.starts_with("commits");
    let parts: Vec<PathBuf> = tree(&store).keys().filter(is_part).cloned().collect();
    for round in 0..2 {
        touched.iter().for_each(|path| touch(path));
        let read = ingest(&source, &store, &[]);
        assert!(read.stdout.contains("  0 ingested (") && read.stdout.contains(", 16 up to date"));
        let before = tree(&store);
        let again = ingest(&source, &store, &[]);
        assert!(
            again.stdout.contains("  nothing to do: 16 phrases are up to date"),
            "round {round}: {again:?}"
        );
        assert!(tree(&store) == before);
        let now: Vec<PathBuf> = before.keys().filter(is_part).cloned().collect();
        assert_eq!(now, parts, "no row is written again");
        std::thread::sleep(std::time::Duration::from_millis(20));
    }
    assert_eq!(phrases(&store).len(), 16, "all rows are there");
    // Content that did change is seen as ever.
    let id = phrases(&store).into_keys().next().expect("a phrase");
    replace_features(&dir, &store, &id);
    let again = ingest(&source, &store, &[]);
    assert!(again.stdout.contains("  nothing to do: 16 phrases are up to date"), "{again:?}");
}
