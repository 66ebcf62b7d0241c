//! With a store: what the tables hold, and what a second run does.

use std::path::{Path, PathBuf};

use motiongen::store::tables::ExtractionRow;

use super::{
    Archive, Values, assert_consistent, beats, contents, copy, extract, extract_files, extractions,
    features, golden, read,
};
use crate::support::files::{self, coherent, features_npz, trajectory, wav};
use crate::support::{Dir, failures, ingest, tree};

const SONGS: [&str; 4] = ["clicks.flac", "a b/ü.wav", "one.wav", "sine.wav"];

/// Writes four songs, one of them with motion and a feature file, a feature file alone, and motion
/// alone; ingests them.
fn make(dir: &Dir) -> (PathBuf, PathBuf) {
    let audio = [
        read(&golden("audio/clicks_120bpm.flac")),
        wav(1.0),
        read(&golden("audio/one_sample.wav")),
        wav(0.5),
    ];
    for (name, bytes) in SONGS.iter().zip(audio) {
        dir.write(format!("source/audio/{name}"), bytes);
    }
    dir.write("source/motion/sine/trajectory.npy", trajectory(&coherent(15, 1)));
    dir.write("source/audio_features/sine/features.npz", features_npz(15));
    dir.write("source/audio_features/imported/features.npz", features_npz(40));
    dir.write("source/motion/still/trajectory.npy", trajectory(&coherent(9, 2)));
    let (source, store) = (dir.at("source"), dir.at("store"));
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    (source, store)
}

fn url(source: &Path, path: &str) -> String {
    url::Url::from_file_path(source.join(path)).unwrap().to_string()
}

#[test]
fn tables_hold_what_the_files_hold() {
    let dir = Dir::new();
    let (source, store) = make(&dir);
    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let start = format!(
        "extract → {}\n  5 phrases extracted (6.8 s, 209 frames), 0 up to date, 0 failed; ",
        store.display()
    );
    assert!(output.stdout.starts_with(&start), "{}", output.stdout);
    let end = "\n  1 of them brought in from feature files\n  1 phrases have neither audio nor features\n";
    assert!(output.stdout.ends_with(end), "{}", output.stdout);
    assert_consistent(&store);

    // Audio: the same as without a store, and the clicks as librosa has them.
    let songs: Vec<_> = SONGS.iter().map(|song| source.join("audio").join(song)).collect();
    let output = extract_files(&songs, &dir.at("files"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let (found, found_beats) = (features(&store), beats(&store));
    for (id, stem) in [("clicks", "clicks"), ("a b/ü", "ü"), ("one", "one"), ("sine", "sine")] {
        let alone = Archive::read(&dir.at(format!("files/{stem}.npz")));
        assert!(found[id] == alone.frames(), "{id}: frames differ");
        let (frames, times) = (alone.f64s("beat_frames"), alone.f64s("beat_times"));
        assert!(frames.iter().zip(times).all(|(frame, time_s)| time_s == frame / 30.0), "{id}");
    }
    let librosas = Archive::read(&golden("audio/clicks_120bpm.npz"));
    // The clicks are half a second apart from 0 s on; a long window hears them up to 10 ms early.
    let clicks = &found_beats["clicks"];
    assert!(clicks.len() >= 6, "{clicks:?}");
    for &(frame, time_s) in clicks {
        assert!((2.0 * time_s - (2.0 * time_s).round()).abs() < 0.04, "{time_s}");
        assert_eq!(f64::from(frame), (time_s * 30.0).round());
    }

    // The feature file: as it is, unnormalised though it be.
    let file = files::features(40);
    let mut expected = vec![[0.0; 163]; 40];
    let mut first = 0;
    for (_, bytes) in &file[..6] {
        let array = motiongen::motion::npy::read_f32(bytes).unwrap();
        for (i, value) in array.values.iter().enumerate() {
            expected[i % 40][first + i / 40] = *value;
        }
        first += array.values.len() / 40;
    }
    assert_eq!(first, 163);
    assert!(found["imported"] == expected, "imported frames differ");
    // 0.25 s, 0.75 s and 1.25 s lie between two frames; halves round up.
    assert_eq!(found_beats["imported"], [(8, 0.25), (23, 0.75), (38, 1.25)]);

    let rows = extractions(&store);
    assert_eq!(rows.keys().collect::<Vec<_>>(), ["a b/ü", "clicks", "imported", "one", "sine"]);
    let phrases = crate::support::phrases(&store);
    let expected = ExtractionRow {
        phrase_id: "clicks".into(),
        origin: "audio".into(),
        source_url: url(&source, "audio/clicks.flac"),
        n_frames: 121,
        n_samples: Some(176_400),
        duration_s: 4.0,
        tuning: Some(librosas.f64s("tuning")[0]),
        tuning_source: Some("estimated".into()),
        tempo_bpm: Some(librosas.f64s("tempo")[0]),
        n_beats: 7,
        audio_codec: Some("flac".into()),
        sample_rate_hz: Some(44_100),
        n_channels: Some(1),
        content_hash: Some(phrases["clicks"].content_hash.clone()),
        truncated: Some(false),
        lost_s: Some(0.0),
    };
    assert_eq!(rows["clicks"], expected);
    let expected = ExtractionRow {
        phrase_id: "imported".into(),
        origin: "feature_file".into(),
        source_url: url(&source, "audio_features/imported/features.npz"),
        n_frames: 40,
        n_samples: None,
        duration_s: 40.0 / 30.0,
        tuning: None,
        tuning_source: None,
        tempo_bpm: Some(97.5),
        n_beats: 3,
        audio_codec: None,
        sample_rate_hz: None,
        n_channels: None,
        content_hash: Some(phrases["imported"].content_hash.clone()),
        truncated: None,
        lost_s: None,
    };
    assert_eq!(rows["imported"], expected);
    let row = &rows["a b/ü"];
    assert_eq!((row.n_frames, row.n_samples, row.sample_rate_hz), (31, Some(44_100), Some(8_000)));
    let row = &rows["one"];
    assert_eq!((row.n_frames, row.n_samples, row.tempo_bpm, row.n_beats), (1, Some(1), None, 0));
    // Audio goes before a feature file.
    assert_eq!((rows["sine"].origin.as_str(), rows["sine"].n_samples), ("audio", Some(22_050)));
    assert!(failures(&store).is_empty());
}

#[test]
fn what_is_done_stays_until_parameters_or_files_change() {
    let dir = Dir::new();
    let (source, store) = make(&dir);
    let before = tree(&store);
    let output = extract(&store, &["--dry-run"]);
    let expected = format!(
        "extract → {}\n  would extract 5 phrases (6.8 s of audio), leave 0 as they are\n",
        store.display()
    );
    assert_eq!((output.code, output.stdout), (0, expected));
    assert!(tree(&store) == before, "a dry run changed the store");

    assert_eq!(extract(&store, &[]).code, 0);
    let (before, frames) = (tree(&store), features(&store));
    let output = extract(&store, &[]);
    let expected = format!(
        "extract → {}\n  nothing to do: 5 phrases are up to date\n  1 phrases have neither audio \
         nor features\n",
        store.display()
    );
    assert_eq!((output.code, output.stdout), (0, expected));
    assert!(tree(&store) == before, "a second run changed the store");

    // Another tuning changes the chroma of audio, and nothing else.
    let output = extract(&store, &["--tuning", "0.25"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.contains("  5 phrases extracted (6.8 s, 209 frames), 0 up to date, "),
        "{}",
        output.stdout
    );
    assert_consistent(&store);
    for (id, row) in extractions(&store) {
        let expected = match id.as_str() {
            "imported" => (None, None),
            _ => (Some(0.25), Some("given".to_owned())),
        };
        assert_eq!((row.tuning, row.tuning_source), expected, "{id}");
    }
    let tuned = features(&store);
    let without_chroma = |frames: &[Values]| -> Vec<Vec<f32>> {
        frames.iter().map(|frame| [&frame[..128], &frame[140..]].concat()).collect()
    };
    for (id, frames) in &frames {
        assert!(without_chroma(frames) == without_chroma(&tuned[id]), "{id}");
        assert_eq!(*frames == tuned[id], id == "imported", "{id}");
    }
    let song = [source.join("audio/sine.wav")];
    assert_eq!(extract_files(&song, &dir.at("tuned.npz"), &["--tuning", "0.25"]).code, 0);
    assert!(Archive::read(&dir.at("tuned.npz")).frames() == tuned["sine"], "chroma differs");

    // A new file under the old name.
    dir.write("source/audio/one.wav", wav(0.2));
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = extract(&store, &["--tuning", "0.25"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.contains("  1 phrases extracted (0.2 s, 7 frames), 4 up to date, 0 failed; "),
        "{}",
        output.stdout
    );
    assert_eq!(extractions(&store)["one"].n_samples, Some(8_820));
    assert_consistent(&store);

    // Asked to do everything again, it finds the same.
    let frames = features(&store);
    let output = extract(&store, &["--tuning", "0.25", "--force"]);
    assert!(
        output.stdout.contains("  5 phrases extracted (7.0 s, 215 frames), 0 up to date, "),
        "{}",
        output.stdout
    );
    assert!(features(&store) == frames, "frames differ");
    assert_consistent(&store);
}

#[test]
fn shards_and_workers_do_not_show() {
    let dir = Dir::new();
    let (_, store) = make(&dir);
    let (one, three, whole) = (dir.at("one"), dir.at("three"), dir.at("whole"));
    for to in [&one, &three, &whole] {
        copy(&store, to);
    }
    for (store, shards, workers) in [(&one, ["0/2", "1/2"], "1"), (&three, ["1/2", "0/2"], "3")] {
        for shard in shards {
            let output = extract(store, &["--shard", shard, "--workers", workers]);
            assert_eq!(output.code, 0, "{output:?}");
        }
    }
    contents(&three).assert_same_as(&contents(&one));

    // One process commits the same rows, though in other parts.
    assert_eq!(extract(&whole, &["--workers", "3"]).code, 0);
    assert_consistent(&one);
    assert!(features(&whole) == features(&one), "frames differ");
    assert_eq!(extractions(&whole), extractions(&one));
    assert_eq!(beats(&whole), beats(&one));
    assert_eq!(
        extract(&one, &[]).stdout.lines().nth(1),
        Some("  nothing to do: 5 phrases are up to date")
    );
    let again = dir.at("again");
    copy(&store, &again);
    assert_eq!(extract(&again, &["--workers", "1"]).code, 0);
    contents(&again).assert_same_as(&contents(&whole));
}

#[test]
fn a_store_without_phrases_says_what_to_run() {
    let dir = Dir::new();
    let output = extract(&dir.at("store"), &[]);
    let store = dir.at("store");
    let expected = format!(
        "error: store {0} has no phrases; run first: motiongen ingest --source … --store {0}\n",
        store.display()
    );
    assert_eq!((output.code, output.stderr), (2, expected));
}
