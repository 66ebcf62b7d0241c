//! Ingest over phrases broken in every way that we could think of, beside sound ones.

mod audio;
mod case;
mod features;
mod motion;
mod tree;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use motiongen::store::TimestampUs;

use crate::support::files::{Frame, beats, coherent, features_npz, trajectory, wav};
use crate::support::{
    self, Dir, MEMORY_BYTES, Output, confined, failures, finish, ingest, ingest_command, phrases,
};
use case::Case;

fn every_case() -> Vec<Case> {
    [motion::cases(), features::cases(), audio::cases(), tree::cases()]
        .into_iter()
        .flatten()
        .collect()
}

/// A sound phrase and what the tables must hold of it.
struct Sound {
    id: String,
    /// Role, path below the source and content; sorted by role.
    files: Vec<(&'static str, String, Vec<u8>)>,
    frames: Vec<Frame>,
    duration_s: f64,
    n_feature_frames: Option<i64>,
    /// Tempo and beats in a bar, with where each comes from.
    tempo: Option<(f64, &'static str)>,
    beats_per_bar: Option<(i32, &'static str)>,
}

impl Sound {
    /// A phrase of motion alone.
    fn motion(id: &str, n_frames: usize, seed: u32) -> Self {
        let frames = coherent(n_frames, seed);
        Self {
            id: id.to_owned(),
            files: vec![("motion", format!("motion/{id}/trajectory.npy"), trajectory(&frames))],
            frames,
            duration_s: n_frames as f64 / 30.0,
            n_feature_frames: None,
            tempo: None,
            beats_per_bar: None,
        }
    }

    fn with(mut self, role: &'static str, path: &str, bytes: impl AsRef<[u8]>) -> Self {
        self.files.push((role, path.replace("{id}", &self.id), bytes.as_ref().to_vec()));
        self.files.sort();
        self
    }

    /// The digest of the files as the table's documentation describes it.
    fn content_hash(&self) -> String {
        let lines: String = self
            .files
            .iter()
            .map(|(role, _, bytes)| format!("{role} {}\n", blake3::hash(bytes)))
            .collect();
        blake3::hash(lines.as_bytes()).to_string()
    }
}

/// Sound phrases, some of them under names that look like trouble.
fn sound() -> Vec<Sound> {
    let all = Sound::motion("all", 45, 1)
        .with("audio", "audio/{id}.wav", wav(1.5))
        .with("beats", "audio/{id}.beats.txt", beats(3, 125.0, Some(3)))
        .with("features", "audio_features/{id}/features.npz", features_npz(45));
    let all = Sound {
        n_feature_frames: Some(45),
        tempo: Some((125.0, "beats_file")),
        beats_per_bar: Some((3, "beats_file")),
        ..all
    };
    // The audio is almost one frame longer than the motion, which is allowed, and is the length.
    let with_audio = Sound {
        duration_s: 0.73275,
        tempo: Some((80.0, "beats_file")),
        beats_per_bar: Some((4, "default")),
        ..Sound::motion("with-audio", 21, 2).with("audio", "audio/{id}.wav", wav(0.73275)).with(
            "beats",
            "beats/{id}.beats.txt",
            beats(2, 80.0, None),
        )
    };
    let with_features = Sound {
        n_feature_frames: Some(32),
        tempo: Some((97.5, "features")),
        ..Sound::motion("with-features", 31, 3).with(
            "features",
            "audio_features/{id}/features.npz",
            features_npz(32),
        )
    };
    let odd_names = [
        "one frame",
        "a \"quoted\" 'name'",
        "-leading-dash",
        "two\nlines",
        "nfc-\u{e9}",
        "nfd-e\u{301}",
        "100%41 #1?&=;\\",
        "人・🕺",
        &"long".repeat(50),
        "album/disc 1/track",
    ];
    let odd = odd_names.iter().zip(1..).map(|(name, n)| Sound::motion(name, 2 * n - 1, n as u32));
    [all, with_audio, with_features].into_iter().chain(odd).collect()
}

fn make(source: &Path, sound: &[Sound], broken: &[Case]) {
    for phrase in sound {
        for (_, path, bytes) in &phrase.files {
            support::write(&source.join(path), bytes);
        }
    }
    for case in broken {
        case.make(source);
    }
}

/// Runs ingest so that permissions bind it and a bomb that goes off ends it.
fn ingest_confined(source: &Path, store: &Path) -> Output {
    finish(&mut confined(&ingest_command(source, store, &[]), MEMORY_BYTES))
}

/// The URL of a path below the source, as tables hold it.
fn url(source: &Path, path: &str) -> String {
    url::Url::from_file_path(source.join(path)).unwrap().into()
}

fn assert_failures_are(store: &Path, source: &Path, broken: &[Case]) {
    let rows = failures(store);
    let found: BTreeMap<_, _> = rows
        .values()
        .map(|row| (row.phrase_id.as_str(), (row.kind.as_str(), row.message.as_str())))
        .collect();
    let messages: Vec<_> = broken
        .iter()
        .map(|case| case.message.replace("{source}", source.to_str().unwrap()))
        .collect();
    let expected: BTreeMap<_, _> = broken
        .iter()
        .zip(&messages)
        .map(|(case, message)| (case.id.as_str(), (case.kind, message.as_str())))
        .collect();
    assert_eq!(expected.len(), broken.len(), "two cases have one id");
    let ids = found.keys().chain(expected.keys()).collect::<BTreeSet<_>>();
    let wrong: Vec<_> = ids
        .into_iter()
        .map(|id| (id, found.get(id), expected.get(id)))
        .filter(|(_, found, expected)| found != expected)
        .collect();
    assert!(wrong.is_empty(), "phrase, found, expected: {wrong:#?}");
    for case in broken {
        let row = &rows[&case.id];
        assert_eq!(row.source, url(source, &case.at_fault), "{}", case.id);
        assert_eq!(row.stage, "ingest");
        let age_us = TimestampUs::now().0 - row.time.0;
        assert!((0..3_600_000_000).contains(&age_us), "{} failed {age_us} µs ago", case.id);
    }
}

fn assert_phrases_are(store: &Path, source: &Path, sound: &[Sound]) {
    let (rows, motion) = (phrases(store), support::motion(store));
    let mut expected: Vec<_> = sound.iter().map(|phrase| phrase.id.as_str()).collect();
    expected.sort_unstable();
    assert_eq!(rows.keys().collect::<Vec<_>>(), expected);
    assert_eq!(motion.keys().collect::<Vec<_>>(), expected);
    for phrase in sound {
        let (id, row) = (&phrase.id, &rows[&phrase.id]);
        assert_eq!(motion[id], phrase.frames, "{id}");
        assert_eq!(row.source, url(source, "").trim_end_matches('/'), "{id}");
        assert_eq!(row.content_hash, phrase.content_hash(), "{id}");
        assert_eq!(row.n_frames, Some(phrase.frames.len() as i64), "{id}");
        assert_eq!(row.n_feature_frames, phrase.n_feature_frames, "{id}");
        assert_eq!(row.duration_s, phrase.duration_s, "{id}");
        assert_eq!(row.split, motiongen::store::split_of(id), "{id}");
        assert_eq!(row.motion_format.as_deref(), Some("npy"), "{id}");
        let file = |role| phrase.files.iter().find(|(r, ..)| *r == role);
        let expected_url = |role| file(role).map(|(_, path, _)| url(source, path));
        let expected_bytes = |role| file(role).map(|(.., bytes)| bytes.len() as i64);
        for (role, has, url, n_bytes) in [
            ("audio", row.has_audio, &row.audio_url, row.audio_bytes),
            ("features", row.has_features, &row.features_url, row.features_bytes),
            ("motion", row.has_motion, &row.motion_url, row.motion_bytes),
        ] {
            assert_eq!(has, file(role).is_some(), "{id}: {role}");
            assert_eq!(*url, expected_url(role), "{id}: {role}");
            assert_eq!(n_bytes, expected_bytes(role), "{id}: {role}");
        }
        assert_eq!(row.beats_url, expected_url("beats"), "{id}");
        assert_eq!(row.has_beats, phrase.tempo.is_some(), "{id}");
        let has_audio = row.has_audio;
        assert_eq!(row.audio_codec.as_deref(), has_audio.then_some("pcm_s16le"), "{id}");
        assert_eq!((row.sample_rate_hz, row.n_channels).0, has_audio.then_some(8_000), "{id}");
        assert_eq!(row.n_channels, has_audio.then_some(1), "{id}");
        let tempo = row.tempo_bpm.zip(row.tempo_source.as_deref());
        assert_eq!(tempo.map(|t| t.1), phrase.tempo.map(|t| t.1), "{id}");
        let (found_bpm, bpm) = (tempo.map_or(0.0, |t| t.0), phrase.tempo.map_or(0.0, |t| t.0));
        // Beat times are written in full and subtracted in double precision: a few units in the
        // 16th digit of times below 10 s.
        assert!((found_bpm - bpm).abs() < 1e-9, "{id}: {found_bpm} is not {bpm}");
        let in_a_bar = row.beats_per_bar.zip(row.beats_per_bar_source.as_deref());
        assert_eq!(in_a_bar, phrase.beats_per_bar, "{id}");
    }
}

#[test]
fn broken_phrases_are_one_failure_each_and_sound_ones_beside_them_are_kept() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    let (sound, broken) = (sound(), every_case());
    assert!(broken.len() >= 45, "{} kinds", broken.len());
    make(&source, &sound, &broken);

    let output = ingest_confined(&source, &store);
    assert_eq!(output.code, 1, "{output:?}");
    let counted = format!("  {} ingested (", sound.len()).into_boxed_str();
    assert!(output.stdout.contains(&*counted), "{}", output.stdout);
    assert_failures_are(&store, &source, &broken);
    let failed = format!(" up to date, {} failed; ", broken.len());
    assert!(output.stdout.contains(&failed), "{}", output.stdout);
    let more = format!("\n  … and {} more\n", broken.len() - 10);
    assert!(output.stdout.contains(&more), "{}", output.stdout);
    assert_phrases_are(&store, &source, &sound);

    // Every failure is tried again, and says nothing new.
    let before = support::tree(&store);
    let output = ingest_confined(&source, &store);
    assert_eq!(output.code, 1, "{output:?}");
    let counted = format!(
        "  0 ingested (0.0 s of music or motion, 0 motion frames), {} up to date, {} failed; ",
        sound.len(),
        broken.len()
    );
    assert!(output.stdout.contains(&counted), "{}", output.stdout);
    assert_eq!(support::tree(&store), before);
    unlock(&source);
}

/// Lets the user that runs the tests remove the source.
fn unlock(source: &Path) {
    use std::os::unix::fs::PermissionsExt as _;
    let folder = source.join("motion/folder-locked");
    std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o755)).unwrap();
}

#[test]
fn a_repaired_phrase_loses_its_failure_and_gets_its_rows() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    let sound = [Sound::motion("a", 13, 1), Sound::motion("b", 7, 2), Sound::motion("c", 5, 3)];
    make(&source, &sound, &[]);
    dir.write("source/motion/b/trajectory.npy", "");
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(failures(&store)["b"].kind, "empty_file");
    assert_eq!(phrases(&store).keys().collect::<Vec<_>>(), ["a", "c"]);

    make(&source, &sound[1..2], &[]);
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.contains(
            "  1 ingested (0.2 s of music or motion, 7 motion frames), 2 up to date, 0 failed; "
        ),
        "{}",
        output.stdout
    );
    assert_eq!(failures(&store), BTreeMap::new());
    assert_phrases_are(&store, &source, &sound);
}

#[test]
fn a_sound_phrase_that_breaks_loses_its_rows_and_gets_a_failure() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    let sound = [Sound::motion("a", 13, 1), Sound::motion("c", 5, 3), Sound::motion("b", 7, 2)];
    make(&source, &sound, &[]);
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    assert_phrases_are(&store, &source, &sound);

    dir.write("source/motion/b/trajectory.npy", "not any more");
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_phrases_are(&store, &source, &sound[..2]);
    let broken = Case::npy(
        "b",
        b"not any more".to_vec(),
        "npy_format",
        "not an npy file: it starts with \"not any more\"; save the array with numpy.save",
    );
    assert_failures_are(&store, &source, &[broken]);

    // And back again: the first content is not mistaken for the first commit.
    make(&source, &sound[2..], &[]);
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    assert_phrases_are(&store, &source, &sound);
    assert_eq!(failures(&store), BTreeMap::new());
}

#[test]
fn a_failure_that_changes_replaces_the_one_before() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    dir.write("source/motion/a/trajectory.npy", "");
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(failures(&store)["a"].kind, "empty_file");
    std::fs::rename(dir.at("source/motion/a/trajectory.npy"), dir.at("source/motion/a/x")).unwrap();
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(failures(&store)["a"].kind, "layout");
}
