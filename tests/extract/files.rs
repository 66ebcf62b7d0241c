//! Without a store: what is written where, and what the command line says of mistakes.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use motiongen::audio::feature_names;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use super::{Archive, extract_files, features_in, golden};
use crate::support::files::wav;
use crate::support::{Dir, Output, run, tree};

/// Returns the names of the files in a folder.
fn names(folder: &Path) -> Vec<String> {
    tree(folder).into_keys().map(|path| path.display().to_string()).collect()
}

#[track_caller]
fn assert_error(output: &Output, sentence: &str) {
    assert_eq!((output.code, output.stderr.as_str()), (2, format!("error: {sentence}\n").as_str()));
    assert_eq!(output.stdout, "");
}

#[test]
fn a_parquet_file_holds_all_files_in_their_order() {
    let dir = Dir::new();
    let audio = [
        dir.write("b.wav", wav(0.4)),
        golden("audio/one_sample.wav"),
        dir.write("a.wav", wav(0.2)),
    ];
    let table = dir.at("features.parquet");
    let output = extract_files(&audio, &table, &["--workers", "3"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.contains("  3 files extracted (0.6 s, 21 frames), 0 up to date, 0 failed; "),
        "{}",
        output.stdout
    );
    let reader = ParquetRecordBatchReaderBuilder::try_new(File::open(&table).unwrap()).unwrap();
    let schema = reader.schema().clone();
    let columns: Vec<_> = schema.fields().iter().map(|field| field.name().as_str()).collect();
    let feature_names: Vec<_> = feature_names().map(|(name, _)| name).collect();
    assert_eq!(columns[..2], ["phrase_id", "frame"]);
    assert_eq!(columns[2..], feature_names);
    let batches: Vec<_> = reader.build().unwrap().map(Result::unwrap).collect();
    let mut ids = Vec::new();
    for batch in &batches {
        use arrow_array::cast::AsArray as _;
        let column = batch.column_by_name("phrase_id").unwrap().as_string::<i32>();
        ids.extend(column.iter().map(|id| id.unwrap().to_owned()));
    }
    ids.dedup();
    assert_eq!(ids, ["b", "one_sample", "a"]);

    let alone = dir.at("alone");
    assert_eq!(extract_files(&audio, &alone, &[]).code, 0);
    assert_eq!(names(&alone), ["a.npz", "b.npz", "one_sample.npz"]);
    let expected: BTreeMap<_, _> = ["a", "b", "one_sample"]
        .into_iter()
        .map(|id| (id.to_owned(), Archive::read(&alone.join(format!("{id}.npz"))).frames()))
        .collect();
    let counts: Vec<_> = expected.values().map(Vec::len).collect();
    assert_eq!(counts, [7, 13, 1]);
    assert!(features_in(batches.into_iter()) == expected, "frames differ");
}

#[test]
fn an_npz_file_holds_one_file_and_is_replaced() {
    let dir = Dir::new();
    let song = dir.write("song.wav", wav(0.3));
    let output = extract_files(&[&song], &dir.write("out.npz", "old"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let archive = Archive::read(&dir.at("out.npz"));
    let keys = [
        "mel",
        "chroma",
        "mfcc",
        "rms",
        "spectral_centroid",
        "onset_strength",
        "features",
        "tempo",
        "beat_times",
        "beat_frames",
        "tuning",
        "n_samples",
    ];
    assert_eq!(archive.keys(), keys);
    assert_eq!((archive.frames().len(), archive.f64s("n_samples")), (10, vec![13_230.0]));
    // The same input gives the same bytes.
    assert_eq!(extract_files(&[&song], &dir.at("again.npz"), &["--workers", "1"]).code, 0);
    assert!(super::read(&dir.at("again.npz")) == archive.0, "bytes differ");
    assert_eq!(names(dir.path()), ["again.npz", "out.npz", "song.wav"]);
}

#[test]
fn mistakes_on_the_command_line_leave_nothing_behind() {
    let dir = Dir::new();
    let (a, b) = (dir.write("a.wav", wav(0.1)), dir.write("b/a.flac", wav(0.1)));
    let c = dir.write("c.wav", wav(0.1));
    let before = tree(dir.path());
    let output = dir.at("out.npz");
    assert_error(
        &extract_files(&[&a, &c], &output, &[]),
        &format!(
            "--output {} holds the features of one file, but --audio names 2; name a folder, or a \
             .parquet file, which holds any number",
            output.display()
        ),
    );
    let twice = format!(
        "{} and {} would both be called a; extract them into two folders",
        a.display(),
        b.display()
    );
    assert_error(&extract_files(&[&a, &b], &dir.at("out"), &[]), &twice);
    assert_error(&extract_files(&[&a, &b], &dir.at("out.parquet"), &[]), &twice);
    for flag in ["--timeout", "--max-duration", "--memory"] {
        let sentence = format!("{flag} 0 is not above 0; give a positive number");
        assert_error(&extract_files(&[&a], &output, &[flag, "0"]), &sentence);
    }
    let dry = extract_files(&[&a, &c], &dir.at("out"), &["--dry-run"]);
    let expected = format!(
        "extract → {}\n  would extract 2 files (0.2 s of audio), leave 0 as they are\n",
        dir.at("out").display()
    );
    assert_eq!((dry.code, dry.stdout), (0, expected));
    let output = extract_files(&[&a], &output, &["--tuning", "0.5"]);
    let sentence = "error: invalid value '0.5' for '--tuning <BINS>': tuning 0.5 is outside -0.5 <= \
                    tuning < 0.5 (in bins of 1/36 octave); give the nearest bin's\n";
    assert_eq!((output.code, output.stderr.starts_with(sentence)), (2, true), "{}", output.stderr);
    let a = a.to_str().unwrap();
    let output = run(["extract", "--audio", a]);
    let sentence =
        "error: the following required arguments were not provided:\n  --output <FILE|DIR>\n";
    assert_eq!((output.code, output.stderr.starts_with(sentence)), (2, true), "{}", output.stderr);
    assert!(tree(dir.path()) == before, "something was written");
}

#[test]
fn files_that_cannot_be_read_fail_alone() {
    let dir = Dir::new();
    let sound = dir.write("sound.wav", wav(0.1));
    dir.write("folder.wav/x.txt", "");
    let (missing, folder) = (dir.at("missing.wav"), dir.at("folder.wav"));
    let output = extract_files(&[&missing, &sound, &folder], &dir.at("out"), &[]);
    assert_eq!(output.code, 1, "{output:?}");
    let lines: Vec<_> = output.stdout.lines().collect();
    assert_eq!(lines[0], format!("extract → {}", dir.at("out").display()));
    assert!(
        lines[1].starts_with("  1 files extracted (0.1 s, 4 frames), 0 up to date, 2 failed; ")
    );
    assert!(lines[2].starts_with("  sound: 0.1 s, 4 frames, "), "{}", lines[2]);
    let expected = [
        format!(
            "  failed [not_a_file] folder: {}: is a folder; name the files in it",
            folder.display()
        ),
        format!(
            "  failed [unreadable] missing: {}: could not read (No such file or directory (os error \
             2))",
            missing.display()
        ),
    ];
    assert_eq!(lines[3..], expected);
    assert_eq!(names(&dir.at("out")), ["sound.npz"]);
}
