//! Songs that library composes and plays, and tunes that it arranges.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use motiongen::motion::Beats;
use motiongen::store::tables::{BeatRow, PhraseRow};

use super::{bytes, constructed, contents, from, library, write_captures, write_songs};
use crate::support::{Dir, Output, failures, rows};

/// Composes songs, two takes of each.
fn compose(dir: &Dir, store: &Path, more: &[&str]) -> Output {
    let mut flags: Vec<std::ffi::OsString> =
        vec!["--captures".into(), dir.at("captures").into(), "--takes".into(), "2".into()];
    flags.extend(more.iter().map(std::convert::Into::into));
    library(store, &flags)
}

/// Rows of phrases by the song that they are of.
fn by_song(store: &Path) -> BTreeMap<String, Vec<PhraseRow>> {
    let mut found: BTreeMap<String, Vec<PhraseRow>> = BTreeMap::new();
    for row in constructed(store).into_values() {
        found.entry(row.source.clone()).or_default().push(row);
    }
    found
}

#[test]
fn composed_songs_are_danced_to_on_the_beats_that_they_were_written_with() {
    let dir = Dir::new();
    write_captures(&dir);
    let (store, audio) = (dir.at("store"), dir.at("audio"));
    let audio_flag = audio.to_str().expect("UTF-8");
    let done = compose(&dir, &store, &["--compose", "3", "--compose-audio", audio_flag]);
    assert_eq!(done.code, 0, "{}{}", done.stdout, done.stderr);
    assert!(done.stdout.contains("3 songs danced to"), "{}", done.stdout);

    let songs = by_song(&store);
    assert_eq!(songs.keys().collect::<Vec<_>>(), ["composed:0/0", "composed:0/1", "composed:0/2"]);
    let beats: Vec<BeatRow> = rows(&store);
    for (i, phrases) in songs.values().enumerate() {
        let first = &phrases[0];
        let slug = first.phrase_id.split(".t0").next().expect("a slug");
        assert!(slug.starts_with(&format!("composed-{i:05}-")) && slug.ends_with("bpm"), "{slug}");
        // The identity of the music is that of the file that people hear.
        let wav = std::fs::read(audio.join(format!("{slug}.wav"))).expect("a WAV file");
        let hash = motiongen::store::digest(&wav);
        let text = std::fs::read_to_string(audio.join(format!("{slug}.beats.txt"))).expect("beats");
        let written = Beats::parse(&text).expect("a beat list");
        for row in phrases {
            assert_eq!((row.split.as_str(), row.song_hash.as_ref()), ("train", Some(&hash)));
            let sources = (row.tempo_source.as_deref(), row.beats_per_bar_source.as_deref());
            assert_eq!(sources, (Some("composed"), Some("composed")));
            assert_eq!(row.beats_per_bar, Some(written.beats_per_bar() as i32));
            let start_s = row.start_s.expect("a begin");
            let end_s = start_s + row.duration_s;
            let inside = |t: f64| (start_s..end_s).contains(&t);
            let numbers = written.numbers().expect("numbers");
            let listed = written.times_s().iter().zip(numbers).filter(|(t, _)| inside(**t));
            // Before the first written beat and after the last one the count goes on.
            let stored: Vec<&BeatRow> =
                beats.iter().filter(|beat| beat.phrase_id == row.phrase_id).collect();
            assert!(!stored.is_empty(), "{}", row.phrase_id);
            assert!(stored.iter().all(|beat| beat.source.as_deref() == Some("composed")));
            for (t, number) in listed {
                let is_it = |beat: &&&BeatRow| (beat.time_s + start_s - t).abs() < 1e-9;
                let beat = stored.iter().find(is_it).expect("a written beat is in the table");
                assert_eq!(beat.number, i32::try_from(*number).ok(), "{}", row.phrase_id);
            }
        }
    }

    // Again there is nothing to do; one song more is one song; fewer are fewer.
    let before = contents(&store);
    let again = compose(&dir, &store, &["--compose", "3"]);
    assert!(again.stdout.contains("nothing to do: 3 songs"), "{}", again.stdout);
    assert_eq!(contents(&store), before);
    let more = compose(&dir, &store, &["--compose", "4"]);
    assert!(more.stdout.contains("1 songs danced to"), "{}", more.stdout);
    let fewer = compose(&dir, &store, &["--compose", "1"]);
    assert!(fewer.stdout.contains("phrases left with their songs"), "{}", fewer.stdout);
    assert_eq!(by_song(&store).len(), 1);
    // The same songs elsewhere, with other threads: the same bytes.
    let (other, elsewhere) = (dir.at("other"), dir.at("elsewhere"));
    let flag = elsewhere.to_str().expect("UTF-8");
    compose(&dir, &other, &["--compose", "3", "--workers", "1", "--compose-audio", flag]);
    assert_eq!(bytes(&elsewhere), bytes(&audio));
}

#[test]
fn verdicts_rest_on_real_songs() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    let store = dir.at("store");
    let more = ["--compose", "2", "--takes", "1", "--validation-songs", "1", "--test-songs", "1"];
    let done = library(&store, &from(&songs, &captures, &more));
    assert_eq!(done.code, 0, "{}{}", done.stdout, done.stderr);
    assert!(done.stdout.contains("3 train, 1 validation, 1 test"), "{}", done.stdout);
    for row in constructed(&store).values().filter(|row| row.split != "train") {
        assert!(!row.source.starts_with("composed:"), "{}", row.phrase_id);
    }
    // Real songs alone: the composed ones leave.
    let done = library(
        &store,
        &from(&songs, &captures, &["--takes", "1", "--validation-songs", "1", "--test-songs", "1"]),
    );
    assert!(done.stdout.contains("left with their songs"), "{}", done.stdout);
}

#[test]
fn tunes_are_arranged_and_broken_ones_are_listed() {
    let dir = Dir::new();
    write_captures(&dir);
    let tunes = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/music/tunes.abc");
    dir.write("tunes/good.abc", std::fs::read(tunes).expect("tunes"));
    dir.write(
        "tunes/more/bad.ABC",
        "X:1\nK:C\nCDEFGABcdefg|\n\nX:2\nK:H\nC|\n\nX:3\nM:3/4\nL:1/4\nK:G\nGBd|gdB|\n",
    );
    dir.write("tunes/none.abc", "no tune at all");
    let store = dir.at("store");
    let done = compose(&dir, &store, &["--tunes", dir.at("tunes").to_str().expect("UTF-8")]);
    assert_eq!(done.code, 1, "{}{}", done.stdout, done.stderr);
    assert!(done.stdout.contains("7 songs danced to"), "{}", done.stdout);
    let refused: BTreeSet<(String, String)> =
        failures(&store).into_values().map(|row| (row.phrase_id, row.kind)).collect();
    let refusal = |name: &str| (name.to_owned(), "abc_format".to_owned());
    let expected =
        [refusal("more/bad.ABC-0001"), refusal("more/bad.ABC-0002"), refusal("none.abc")];
    assert_eq!(refused, expected.into_iter().collect());
    let found = by_song(&store);
    assert_eq!(found.len(), 7);
    let waltz = found.iter().find(|(url, _)| url.ends_with("good.abc#3")).expect("the waltz");
    assert!(waltz.1.iter().all(|row| row.beats_per_bar == Some(3) && row.split == "train"));

    // A tune that was mended is danced to, and its failure is gone.
    dir.write("tunes/none.abc", "X:1\nM:4/4\nL:1/4\nK:C\nCEGc|\n");
    let done = compose(&dir, &store, &["--tunes", dir.at("tunes").to_str().expect("UTF-8")]);
    assert!(done.stdout.contains("1 songs danced to"), "{}", done.stdout);
    assert!(!failures(&store).contains_key("none.abc"), "{}", done.stdout);
}

#[test]
fn wrong_flags_say_what_to_do() {
    let dir = Dir::new();
    write_captures(&dir);
    dir.write("empty/readme.txt", "nothing");
    dir.write("font.sf2", "RIFF");
    let store = dir.at("store");
    let empty = dir.at("empty");
    let done = compose(&dir, &store, &["--tunes", empty.to_str().expect("UTF-8")]);
    assert_eq!(done.code, 2);
    assert!(done.stderr.contains("no .abc file"), "{}", done.stderr);
    let font = dir.at("font.sf2");
    let done =
        compose(&dir, &store, &["--compose", "1", "--soundfont", font.to_str().expect("UTF-8")]);
    assert_eq!(done.code, 2);
    assert!(done.stderr.contains("font.sf2") && done.stderr.contains("SF2"), "{}", done.stderr);
}
