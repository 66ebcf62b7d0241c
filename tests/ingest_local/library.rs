//! A music library: any tree of audio files.

use std::collections::BTreeMap;

use crate::support::files::{WAV_RATE_HZ, beats, wav, wav_of};
use crate::support::{Dir, failures, ingest, motion, phrases};

fn golden(name: &str) -> Vec<u8> {
    let path = format!("{}/tests/golden/audio_header/{name}", env!("CARGO_MANIFEST_DIR"));
    std::fs::read(&path).unwrap_or_else(|e| panic!("{path}: {e}"))
}

#[test]
fn every_song_of_a_tree_becomes_a_phrase_named_by_its_path() {
    let dir = Dir::new();
    dir.write("music/top.wav", wav(0.9));
    dir.write("music/LOUD.WAV", wav_of(WAV_RATE_HZ, 3, &[7; 6 * 400]));
    dir.write("music/album/disc 2/two.wav", wav(1.3));
    dir.write("music/album/disc 2/two.flac", golden("sine.flac"));
    dir.write("music/album/live.wav/encore.mp3", golden("cbr_lame.mp3"));
    dir.write("music/album/cover.jpg", "no song");
    dir.write("music/album/.hidden.wav", "no song either");
    dir.write("music/notes.txt", "1.0\n");
    let store = dir.at("store");
    let output = ingest(&dir.at("music"), &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let ignored =
        "\n  3 files belong to no phrase and were left alone, such as album/.hidden.wav\n";
    assert!(output.stdout.contains(ignored), "{}", output.stdout);

    let rows = phrases(&store);
    let found: Vec<_> = rows
        .values()
        .map(|row| {
            let codec = row.audio_codec.as_deref().unwrap();
            (row.phrase_id.as_str(), codec, row.sample_rate_hz.unwrap(), row.n_channels.unwrap())
        })
        .collect();
    assert_eq!(
        found,
        [
            ("LOUD.WAV", "pcm_s16le", 8_000, 3),
            ("album/disc 2/two.flac", "flac", 22_050, 1),
            ("album/disc 2/two.wav", "pcm_s16le", 8_000, 1),
            ("album/live.wav/encore.mp3", "mp3", 44_100, 1),
            ("top.wav", "pcm_s16le", 8_000, 1),
        ]
    );
    assert_eq!(rows["top.wav"].duration_s, 0.9);
    assert_eq!(rows["LOUD.WAV"].duration_s, 0.05);
    let url = rows["album/disc 2/two.wav"].audio_url.as_deref().unwrap();
    assert!(url.ends_with("/music/album/disc%202/two.wav"), "{url}");
    for row in rows.values() {
        assert!(row.has_audio && !row.has_motion && !row.has_features && !row.has_beats);
        assert_eq!((row.n_frames, row.motion_format.as_ref()), (None, None));
        assert_eq!((row.tempo_bpm, row.beats_per_bar), (None, None));
    }
    assert_eq!(motion(&store), BTreeMap::new());
    assert_eq!(failures(&store), BTreeMap::new());
}

#[test]
fn beats_beside_a_song_give_tempo_and_bar() {
    let dir = Dir::new();
    dir.write("music/waltz.wav", wav(0.9));
    dir.write("music/waltz.beats.txt", beats(7, 150.0, Some(3)));
    // One list serves both encodings of a song.
    dir.write("music/a/plain.wav", wav(0.5));
    dir.write("music/a/plain.flac", golden("sine.flac"));
    dir.write("music/a/plain.beats.txt", beats(5, 75.0, None));
    dir.write("music/b/alone.beats.txt", beats(5, 75.0, None));
    let store = dir.at("store");
    let output = ingest(&dir.at("music"), &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let ignored =
        "\n  1 files belong to no phrase and were left alone, such as b/alone.beats.txt\n";
    assert!(output.stdout.contains(ignored), "{}", output.stdout);
    let rows = phrases(&store);
    assert_eq!(rows.keys().collect::<Vec<_>>(), ["a/plain.flac", "a/plain.wav", "waltz.wav"]);
    for (id, bpm, beats_per_bar, source) in [
        ("a/plain.flac", 75.0, 4, "default"),
        ("a/plain.wav", 75.0, 4, "default"),
        ("waltz.wav", 150.0, 3, "beats_file"),
    ] {
        let row = &rows[id];
        // Multiples of 0.8 s and 0.4 s are exact to the last digits of a double.
        assert!((row.tempo_bpm.unwrap() - bpm).abs() < 1e-9, "{id}: {:?}", row.tempo_bpm);
        assert_eq!(row.tempo_source.as_deref(), Some("beats_file"), "{id}");
        assert_eq!(row.beats_per_bar, Some(beats_per_bar), "{id}");
        assert_eq!(row.beats_per_bar_source.as_deref(), Some(source), "{id}");
        assert!(row.has_beats && row.beats_url.is_some(), "{id}");
    }
}

#[test]
fn a_layout_given_by_name_is_not_guessed() {
    let dir = Dir::new();
    dir.write("source/audio/a.wav", wav(0.3));
    dir.write("source/audio/b/c.wav", wav(0.4));
    for (layout, ids) in [
        ("auto", ["a", "b/c"]),
        ("phrases", ["a", "b/c"]),
        ("library", ["audio/a.wav", "audio/b/c.wav"]),
    ] {
        let store = dir.at(layout);
        assert_eq!(ingest(&dir.at("source"), &store, &["--layout", layout]).code, 0);
        assert_eq!(phrases(&store).keys().collect::<Vec<_>>(), ids, "{layout}");
    }
}
