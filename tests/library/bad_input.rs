//! Songs and captures that cannot be used are failures with a sentence, and the job goes on.

use std::collections::BTreeMap;
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use super::{clicks, constructed, from, library, library_command, write_captures, write_songs};
use crate::support::files::{coherent, trajectory, wav_of};
use crate::support::{Dir, confined, failures, finish, ingest, motion, motiongen};

/// Kind and message of every failure.
fn told(store: &Path) -> BTreeMap<String, (String, String)> {
    let rows = failures(store).into_iter();
    rows.map(|(id, row)| (id, (row.kind, row.message))).collect()
}

fn said(kind: &str, message: &str) -> (String, String) {
    (kind.to_owned(), message.to_owned())
}

#[test]
fn bad_songs_and_captures_are_told_and_the_others_danced() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    dir.write("songs/a waltz.beats.txt", "0.5\nnever\n");
    dir.write("songs/broken.ogg", "OggS, and no more");
    dir.write("songs/fast.wav", clicks(120.0, 6.0));
    dir.write("songs/fast.beats.txt", "1.0\n1.1\n1.2\n1.3\n");
    dir.write("songs/late.wav", clicks(120.0, 6.0));
    dir.write("songs/late.beats.txt", "4.0\n60.0\n61.0\n");
    dir.write("songs/marches-one.wav", clicks(120.0, 6.0));
    dir.write("songs/short.wav", clicks(120.0, 2.0));
    dir.write("songs/silent.wav", wav_of(8_000, 1, &[0; 80_000]));
    let lying: Vec<_> = coherent(40, 1)
        .into_iter()
        .map(|mut frame| {
            frame[9..13].copy_from_slice(&[0.0, 1.0, 0.0, 0.0]);
            frame
        })
        .collect();
    dir.write("captures/lying.npy", trajectory(&lying));
    dir.write("captures/short.npy", trajectory(&coherent(5, 1)));
    dir.write("captures/text.bvh", "HIERARCHY\n");
    dir.write("captures/wide.npy", motiongen::motion::npy::write(&[4, 3], &[0.0_f32; 12]));
    let mut far = coherent(40, 1);
    far[7][1] = 101.0;
    dir.write("captures/far.npy", trajectory(&far));
    let store = dir.at("store");
    let flags = from(&songs, &captures, &["--takes", "1"]);
    let output = library(&store, &flags);
    assert_eq!(output.code, 1, "{output:?}");
    let found = "  2 songs danced to (5 phrases), 0 up to date, 12 failed; ";
    assert!(output.stdout.contains(found), "{}", output.stdout);
    assert!(output.stdout.contains("\n  … and 2 more\n"), "{}", output.stdout);

    let told_first = told(&store);
    let expected = BTreeMap::from([
        (
            "a waltz.wav",
            said(
                "beats_format",
                "a waltz.beats.txt: beats line 2 reads `never`, expected a time in seconds; write one \
             beat per line as `time_s` or `time_s beat_number`",
            ),
        ),
        ("broken.ogg", told_first["broken.ogg"].clone()),
        (
            "fast.wav",
            said(
                "tempo",
                "fast.wav: song has 600.0 beats/min, and 20 to 320 are danced to; correct its .beats.txt \
             file",
            ),
        ),
        (
            "late.wav",
            said(
                "no_beats",
                "late.wav: song has 1 beats within its 6.0 s, and a dance needs at least 2; write its \
             beats, one time in seconds per line, into a .beats.txt file beside it",
            ),
        ),
        (
            "marches/one.wav",
            said(
                "duplicate_id",
                "phrases of marches/one.wav and of marches-one.wav would both be called \
             marches-one.wav.t…; rename one of them",
            ),
        ),
        (
            "short.wav",
            said(
                "too_short",
                "short.wav: has 61 frames (2.0 s), and a phrase takes 120 (4.0 s); lower --phrase-frames \
             or leave the song out",
            ),
        ),
        (
            "silent.wav",
            said(
                "no_beats",
                "silent.wav: song has 0 beats within its 5.0 s, and a dance needs at least 2; write its \
             beats, one time in seconds per line, into a .beats.txt file beside it",
            ),
        ),
        (
            "far.npy",
            said(
                "channel_limit",
                "far.npy: channel position_y is 101.0 m at frame 7, allowed -100 to 100 m (1 values \
             outside their limits in all); correct the unit or remove the phrase",
            ),
        ),
        (
            "lying.npy",
            said(
                "no_primitive",
                "lying.npy: capture is never upright long enough: the body's up axis is -1.00 of the \
             vertical on average, and a primitive begins and ends at 0.5 or more; check that +Y is \
             up and that the root's orientation is body to world",
            ),
        ),
        (
            "short.npy",
            said(
                "too_short",
                "short.npy: capture has 5 frames, and a primitive needs at least 13 (0.4 s); use a \
             longer take",
            ),
        ),
        ("text.bvh", told_first["text.bvh"].clone()),
        ("wide.npy", said("shape", "wide.npy has shape [4, 3], expected [frames, 25]")),
    ]);
    let expected: BTreeMap<String, _> =
        expected.into_iter().map(|(id, said)| (id.to_owned(), said)).collect();
    assert_eq!(told_first, expected);
    assert!(told_first["broken.ogg"].0.starts_with("audio_"), "{:?}", told_first["broken.ogg"]);
    assert_eq!(told_first["text.bvh"].0, "bvh_format");

    // They fail in the same way again, which writes nothing; mended, they leave the table.
    let before = super::contents(&store);
    assert_eq!(library(&store, &flags).code, 1);
    super::contents(&store).assert_same_as(&before);
    dir.write("songs/a waltz.beats.txt", super::beat_list(141.3, 9.0, 3));
    for gone in ["broken.ogg", "fast.wav", "late.wav", "marches-one.wav", "short.wav", "silent.wav"]
    {
        std::fs::remove_file(songs.join(gone)).unwrap();
    }
    for gone in ["far.npy", "lying.npy", "short.npy", "text.bvh"] {
        std::fs::remove_file(captures.join(gone)).unwrap();
    }
    dir.write("captures/wide.npy", trajectory(&coherent(90, 3)));
    let output = library(&store, &flags);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(failures(&store).is_empty(), "{:?}", told(&store));
    assert_eq!(constructed(&store).len(), 10);
}

#[test]
fn a_song_that_breaks_loses_its_phrases() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    let store = dir.at("store");
    let flags = from(&songs, &captures, &["--takes", "1"]);
    assert_eq!(library(&store, &flags).code, 0);
    let whole = motion(&store);
    let constructed_splits: BTreeMap<String, String> =
        constructed(&store).into_iter().map(|(id, row)| (id, row.split)).collect();
    dir.write("songs/tracked.wav", "no longer a song");
    let output = library(&store, &flags);
    assert_eq!(output.code, 1, "{output:?}");
    let split = &constructed_splits["tracked.wav.t00.0000"];
    let warning = format!("no song of the {split} split could be danced to, so it has no phrases");
    assert!(output.stderr.contains(&warning), "{}", output.stderr);
    let left = motion(&store);
    assert_eq!(left.len(), 7);
    assert!(left.iter().all(|(id, frames)| whole[id] == *frames));
    dir.write("songs/tracked.wav", clicks(120.0, 8.5));
    assert_eq!(library(&store, &flags).code, 0);
    assert!(motion(&store) == whole && failures(&store).is_empty());
}

#[test]
fn a_song_out_of_reach_keeps_its_phrases() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    let flags = from(&songs, &captures, &["--takes", "1"]);
    assert_eq!(library(&store, &flags).code, 0);
    let whole = motion(&store);
    let locked = ["a waltz.beats.txt", "tracked.wav"].map(|name| songs.join(name));
    let set_mode = |path: &std::path::PathBuf, mode| {
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    locked.iter().for_each(|path| set_mode(path, 0o000));
    let forced = from(&songs, &captures, &["--takes", "1", "--force"]);
    let output = finish(&mut confined(&library_command(&store, &forced), 2_000_000_000));
    assert_eq!(output.code, 1, "{output:?}");
    assert!(output.stdout.contains("1 songs danced to (4 phrases), 0 up to date, 2 failed; "));
    let told = told(&store);
    assert_eq!(told.keys().collect::<Vec<_>>(), ["a waltz.wav", "tracked.wav"]);
    assert!(told.values().all(|(kind, _)| kind == "unreadable"), "{told:?}");
    assert!(motion(&store) == whole);
    locked.iter().for_each(|path| set_mode(path, 0o644));
    let output = library(&store, &flags);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(motion(&store) == whole && failures(&store).is_empty());
}

#[test]
fn a_store_has_all_that_its_songs_are_danced_to() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    assert_eq!(ingest(&songs, &store, &[]).code, 0);
    assert_eq!(finish(motiongen().args(["extract", "--store"]).arg(&store)).code, 0);
    let captures = captures.to_str().unwrap();
    assert_eq!(library(&store, &["--captures", captures, "--takes", "1"]).code, 0);
    let whole = motion(&store);
    std::fs::remove_dir_all(&songs).unwrap();
    let output = library(&store, &["--captures", captures, "--takes", "1", "--force"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("3 songs danced to (10 phrases)"), "{}", output.stdout);
    assert!(motion(&store) == whole);
}

#[test]
fn names_of_other_phrases_are_left_alone() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    let id = "tracked.wav.t00.0001";
    dir.write(format!("takes/motion/{id}/trajectory.npy"), trajectory(&coherent(9, 1)));
    assert_eq!(ingest(&dir.at("takes"), &store, &[]).code, 0);
    let output = library(&store, &from(&songs, &captures, &["--takes", "1"]));
    assert_eq!(output.code, 1, "{output:?}");
    let from = url::Url::from_file_path(dir.at("takes")).unwrap();
    let message = format!(
        "tracked.wav: its phrase {id} is in the store already, from {from}; rename the song or use \
         another store"
    );
    assert_eq!(told(&store)["tracked.wav"], said("duplicate_id", &message));
    assert_eq!(motion(&store)[id].len(), 9);
    assert_eq!(constructed(&store).len(), 7);
}

#[test]
fn nothing_to_dance_to_or_with_is_said_with_the_way_out() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    let place = store.display();
    let refused = |flags: &[std::ffi::OsString]| {
        let output = library(&store, flags);
        assert_eq!(output.code, 2, "{output:?}");
        output.stderr
    };
    assert_eq!(
        refused(&[]),
        format!(
            "error: store {place} has no songs: no phrase has audio and features; run first: motiongen \
             ingest --source MUSIC --store {place}, and then motiongen extract --store {place}; or name \
             a folder of music with --songs, or have some composed with --compose\n"
        )
    );
    assert_eq!(
        refused(&["--songs".into(), songs.clone().into()]),
        format!(
            "error: store {place} has no captures: no phrase has motion without audio; ingest some, or \
             name a folder of motion files with --captures\n"
        )
    );
    assert_eq!(
        refused(&from(&captures, &captures, &[])),
        format!(
            "error: songs folder {}: no audio among 3 files; name the folder of your music (WAV, AIFF, \
             FLAC, MP3, Ogg Vorbis, Opus, M4A or AAC)\n",
            captures.display()
        )
    );
    assert_eq!(
        refused(&from(&songs, &songs, &[])),
        format!(
            "error: captures folder {}: no .bvh, .npz, .npy or .vmd file anywhere below it; name the folder \
             of your motion captures\n",
            songs.display()
        )
    );
    dir.write("short/a.npy", trajectory(&coherent(5, 1)));
    assert_eq!(
        refused(&from(&songs, &dir.at("short"), &[])),
        format!(
            "error: none of the 1 captures can be danced (a.npy: capture has 5 frames, and a primitive \
             needs at least 13 (0.4 s); use a longer take); name others with --captures; all of them: \
             motiongen query --store {place} \"select phrase_id, kind, message from failures\"\n"
        )
    );
    dir.write("brief/a.wav", clicks(100.0, 1.0));
    dir.write("brief/a.beats.txt", "0.25\n0.85\n");
    let told = refused(&from(&dir.at("brief"), &captures, &["-q"]));
    let start = "error: none of the 1 songs can be danced to (a.wav: has 31 frames (1.0 s), ";
    assert!(told.starts_with(start), "{told}");
    let told = refused(&from(&songs, &captures, &["--test-songs", "3"]));
    let start =
        "error: 1 songs for validation and 3 for the test leave none of 3 to train on; lower ";
    assert!(told.starts_with(start), "{told}");
    let told = refused(&from(&songs, &captures, &["--validation-songs", "1.5"]));
    assert!(told.contains("give a number of songs such as 2, or a fraction such as 0.1"), "{told}");
}
