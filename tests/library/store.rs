//! What the tables hold, and what a second run does.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use motiongen::motion::{Beats, bar_phase};
use motiongen::stages::beats::of_phrases;
use motiongen::store::tables::{BeatRow, PhraseRow};
use motiongen::store::{Location, StoreSnapshot};
use motiongen::units::frames_to_s;

use super::{beat_list, clicks, constructed, contents, from, library, write_captures, write_songs};
use crate::extract::features;
use crate::support::files::{coherent, trajectory};
use crate::support::{Dir, failures, finish, ingest, motion, motiongen, phrases, rows, tree};

/// Ingests and extracts songs and captures into one store.
fn make(dir: &Dir) -> (PathBuf, PathBuf) {
    let songs = write_songs(dir);
    for (id, frames) in [("walk", coherent(200, 1)), ("run", coherent(150, 2))] {
        dir.write(format!("takes/motion/{id}/trajectory.npy"), trajectory(&frames));
    }
    let store = dir.at("store");
    for source in [&songs, &dir.at("takes")] {
        assert_eq!(ingest(source, &store, &[]).code, 0);
    }
    assert_eq!(finish(motiongen().args(["extract", "--store"]).arg(&store)).code, 0);
    (songs, store)
}

fn url(folder: &Path, path: &str) -> String {
    url::Url::from_file_path(folder.join(path)).unwrap().to_string()
}

fn beats(store: &Path) -> BTreeMap<String, Vec<BeatRow>> {
    let mut by_phrase: BTreeMap<String, Vec<BeatRow>> = BTreeMap::new();
    for row in rows::<BeatRow>(store) {
        by_phrase.entry(row.phrase_id.clone()).or_default().push(row);
    }
    by_phrase
}

#[test]
fn tables_hold_dances_to_the_songs_of_the_store() {
    let dir = Dir::new();
    let (songs, store) = make(&dir);
    let others = phrases(&store);
    let output = library(&store, &["--takes", "2"]);
    assert_eq!(output.code, 0, "{output:?}");
    let start = format!(
        "library → {}\n  3 songs danced to (20 phrases), 0 up to date, 0 failed; ",
        store.display()
    );
    assert!(output.stdout.starts_with(&start), "{}", output.stdout);
    let end = " primitives of 2 captures; songs split into 1 train, 1 validation, 1 test\n";
    assert!(output.stdout.ends_with(end), "{}", output.stdout);

    // 9, 11 and 8.5 s: 271, 331 and 256 frames, in phrases of 120 every 60.
    let rows = constructed(&store);
    let ids: Vec<&str> = rows.keys().map(String::as_str).collect();
    let expected = |song: &str, n: usize| -> Vec<String> {
        (0..2).flat_map(|t| (0..n).map(move |i| format!("{song}.t{t:02}.{i:04}"))).collect()
    };
    let all = [expected("a waltz.wav", 3), expected("marches-one.wav", 4)].concat();
    assert_eq!(ids, [all, expected("tracked.wav", 3)].concat());

    let (frames, features, beats) = (motion(&store), features(&store), beats(&store));
    let snapshot = StoreSnapshot::take(&Location::local(&store).unwrap()).unwrap();
    let known = of_phrases(&snapshot, |_| true).unwrap();
    let mut n_upbeats = 0;
    for (id, row) in &rows {
        let (song, rest) = id.split_once(".t").unwrap();
        let first = 60 * rest.split_once('.').unwrap().1.parse::<usize>().unwrap();
        let song = if song.starts_with("marches") { "marches/one.wav" } else { song };
        assert_eq!(row.source, url(&songs, song), "{id}");
        assert_eq!((row.n_frames, row.n_feature_frames), (Some(120), Some(120)));
        assert!(row.has_motion && row.has_features && row.has_beats && !row.has_audio);
        assert_eq!(
            (row.duration_s, row.motion_url.as_ref(), row.audio_url.as_ref()),
            (4.0, None, None)
        );
        assert!(features[id][..] == features[song][first..first + 120], "{id}: features differ");
        assert_eq!(frames[id].len(), 120);

        // Wherever in a bar it begins, the numbers of its beats say so.
        let numbers: Vec<i32> = beats[id].iter().map(|row| row.number.unwrap()).collect();
        let n = row.beats_per_bar.unwrap();
        assert!(numbers.windows(2).all(|pair| pair[1] == pair[0] % n + 1), "{id}: {numbers:?}");
        n_upbeats += usize::from(numbers[0] != 1);
        let counted = known[id].in_bars(row).unwrap();
        let (first_s, last_s) =
            (counted.times_s()[0], counted.times_s()[counted.times_s().len() - 1]);
        for (i, frame) in frames[id].iter().enumerate() {
            let time_s = frames_to_s(i);
            // Beyond its first and last beat a phrase does not know the song's.
            if (first_s..=last_s).contains(&time_s) {
                let phase = bar_phase(&[time_s], &counted)[0];
                let off = (phase - f64::from(frame[16])).abs();
                assert!(off.min(1.0 - off) < 1e-6, "{id}: {phase} for {} at {i}", frame[16]);
            }
        }

        let (tempo_bpm, beats_per_bar, source) = match song {
            "a waltz.wav" => (141.3, 3, ("beats_file", "beats_file")),
            "marches/one.wav" => (93.7, 4, ("beats_file", "beats_file")),
            _ => (row.tempo_bpm.unwrap(), 4, ("beat_tracker", "default")),
        };
        assert!((row.tempo_bpm.unwrap() - tempo_bpm).abs() < 1e-9, "{id}: {:?}", row.tempo_bpm);
        assert_eq!(row.beats_per_bar, Some(beats_per_bar));
        let found = (row.tempo_source.as_deref(), row.beats_per_bar_source.as_deref());
        assert_eq!(found, (Some(source.0), Some(source.1)));
        if source.0 == "beats_file" {
            // Clicks of the phrase, continued beyond the ends of the list.
            let click = |i: i32| 0.25 + f64::from(i) * 60.0 / tempo_bpm - frames_to_s(first);
            let clicks: Vec<f64> =
                (-9..90).map(click).filter(|t| (-1e-9..4.0 - 1e-9).contains(t)).collect();
            let found = &beats[id];
            assert_eq!(found.len(), clicks.len(), "{id}");
            for (i, (row, t)) in found.iter().zip(clicks).enumerate() {
                assert_eq!((row.beat, row.source.as_deref()), (i as i32, Some("beats_file")));
                assert!((row.time_s - t).abs() < 1e-9, "{id}: {row:?} for {t}");
                assert_eq!(row.frame, (row.time_s * 30.0).round().min(119.0) as i32);
            }
            let list = beat_list(
                tempo_bpm,
                if song == "a waltz.wav" { 9.0 } else { 11.0 },
                beats_per_bar as usize,
            );
            let times: Vec<f64> = (first..first + 120).map(frames_to_s).collect();
            let phase = bar_phase(&times, &Beats::parse(&list).unwrap());
            assert!(frames[id].iter().zip(phase).all(|(f, p)| f[16] == p as f32), "{id}: phase");
        }
    }
    assert!(n_upbeats > 3, "{n_upbeats} phrases begin within a bar");
    assert!(beats["tracked.wav.t00.0000"].iter().all(|b| b.source.as_deref() == Some("tracker")));
    let by_song: BTreeSet<_> = rows.values().map(|r| (&r.source, &r.split)).collect();
    let splits: BTreeSet<_> = by_song.iter().map(|(_, split)| split.as_str()).collect();
    assert_eq!((by_song.len(), splits.len()), (3, 3), "{by_song:?}");
    // Takes are other dances; what was there before is as it was.
    assert!(frames["tracked.wav.t00.0000"] != frames["tracked.wav.t01.0000"]);
    let rest = phrases(&store).into_iter().filter(|(_, row)| !row.is_constructed());
    assert_eq!(rest.collect::<BTreeMap<_, _>>(), others);
    assert!(failures(&store).is_empty());
}

#[test]
fn what_is_done_stays_until_songs_captures_or_parameters_change() {
    let dir = Dir::new();
    let (_, store) = make(&dir);
    let before = tree(&store);
    let output = library(&store, &["--takes", "2", "--dry-run"]);
    let expected = format!(
        "library → {}\n  would dance to 3 songs, leave 0 as they are (1 train, 1 validation, 1 \
         test)\n",
        store.display()
    );
    assert_eq!((output.code, output.stdout), (0, expected));
    assert!(tree(&store) == before, "a dry run changed the store");

    assert_eq!(library(&store, &["--takes", "2"]).code, 0);
    let (before, first) = (tree(&store), motion(&store));
    let output = library(&store, &["--takes", "2"]);
    let expected = format!(
        "library → {}\n  nothing to do: 3 songs are up to date (1 train, 1 validation, 1 test)\n",
        store.display()
    );
    assert_eq!((output.code, output.stdout), (0, expected));
    assert!(tree(&store) == before, "a second run changed the store");
    // Done again, it is the same; extract does not take constructed phrases for its own.
    let output = library(&store, &["--takes", "2", "--force"]);
    assert!(output.stdout.contains("3 songs danced to (20 phrases)"), "{}", output.stdout);
    assert!(motion(&store) == first, "--force changed the motion");
    let output = finish(motiongen().args(["extract", "--store"]).arg(&store));
    assert!(
        output.stdout.contains("nothing to do: 3 phrases are up to date\n  2 phrases have"),
        "{output:?}"
    );

    // Fewer takes: the others leave.
    assert_eq!(library(&store, &["--takes", "1"]).code, 0);
    let fewer = motion(&store);
    assert_eq!(fewer.len(), 2 + 10);
    assert!(fewer.iter().all(|(id, frames)| first[id] == *frames));
    // Another seed: other dances to the same music.
    assert_eq!(library(&store, &["--takes", "1", "--seed", "5"]).code, 0);
    let other = motion(&store);
    assert!(other.keys().eq(fewer.keys()));
    assert!(constructed(&store).keys().all(|id| other[id] != fewer[id]));
    assert_eq!(library(&store, &["--takes", "1"]).code, 0);
    assert!(motion(&store) == fewer, "the first seed gives the first dances");

    // One capture more: every song is danced again.
    dir.write("takes/motion/stroll/trajectory.npy", trajectory(&coherent(400, 7)));
    assert_eq!(ingest(&dir.at("takes"), &store, &[]).code, 0);
    let output = library(&store, &["--takes", "1"]);
    assert!(output.stdout.contains("3 songs danced to (10 phrases)"), "{}", output.stdout);
    assert!(output.stdout.contains(" of 3 captures; "), "{}", output.stdout);
}

#[test]
fn songs_that_leave_take_their_phrases_along() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    let flags = from(&songs, &captures, &["--takes", "1"]);
    assert_eq!(library(&store, &flags).code, 0);
    assert_eq!(constructed(&store).len(), 10);
    let whole = motion(&store);

    std::fs::remove_file(songs.join("marches/one.wav")).unwrap();
    let output = library(&store, &flags);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("\n  4 phrases left with their songs\n"), "{}", output.stdout);
    assert!(output.stderr.contains("2 songs are too few to split"), "{}", output.stderr);
    let rows = constructed(&store);
    assert_eq!(rows.len(), 6);
    assert!(rows.values().all(|row| row.split == "train"));
    assert!(motion(&store).iter().all(|(id, frames)| whole[id] == *frames));

    // Back again, with the same dance.
    dir.write("songs/marches/one.wav", clicks(93.7, 11.0));
    assert_eq!(library(&store, &flags).code, 0);
    assert!(motion(&store) == whole);
    // Touched, but not changed: nothing is written but under which time it was seen.
    let before = contents(&store);
    dir.write("songs/marches/one.wav", clicks(93.7, 11.0));
    let output = library(&store, &flags);
    assert!(output.stdout.contains("  0 songs danced to (0 phrases), 3 up to date"), "{output:?}");
    let mut after = contents(&store);
    after.manifests.retain(|path, _| !path.starts_with("commits/library-seen/"));
    after.assert_same_as(&before);
}

#[test]
fn songs_whose_files_were_replaced_wait_for_their_features() {
    let dir = Dir::new();
    let (songs, store) = make(&dir);
    assert_eq!(library(&store, &["--takes", "1"]).code, 0);
    let before = constructed(&store);
    let is_song =
        |row: &PhraseRow| row.audio_url.as_deref().is_some_and(|url| url.ends_with("/tracked.wav"));
    let song = phrases(&store).into_values().find(is_song).expect("a song");
    let id = &song.phrase_id;
    // Another song of the same name.
    dir.write("songs/tracked.wav", clicks(126.0, 8.5));
    assert_eq!(ingest(&songs, &store, &[]).code, 0);
    let output = library(&store, &["--takes", "1"]);
    assert_eq!(output.code, 1, "{output:?}");
    let failed = failures(&store);
    assert_eq!(failed[id].kind, "stale_features");
    assert_eq!(
        failed[id].message,
        format!(
            "{id}: its features are of a file that was replaced since; run motiongen extract --store {} first",
            store.display()
        )
    );
    assert_eq!(constructed(&store), before, "its phrases stay until then");
    assert_eq!(finish(motiongen().args(["extract", "--store"]).arg(&store)).code, 0);
    let output = library(&store, &["--takes", "1"]);
    assert!(output.stdout.contains("  1 songs danced to ("), "{output:?}");
    assert_eq!(output.code, 0, "{output:?}");
    assert!(failures(&store).is_empty());
}

#[test]
fn songs_that_were_only_touched_are_read_once() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    let store = dir.at("store");
    let run = || library(&store, &from(&songs, &captures, &["--takes", "1"]));
    assert_eq!(run().code, 0);
    let motions = motion(&store);
    let mut n_touched = 0;
    for entry in walkdir::WalkDir::new(&songs).into_iter().flatten() {
        if entry.path().extension().is_some_and(|e| e != "txt") {
            let file = std::fs::File::options().write(true).open(entry.path()).expect("a file");
            file.set_modified(std::time::SystemTime::now()).expect("touched");
            n_touched += 1;
        }
    }
    assert!(n_touched > 0);
    let read = run();
    assert!(read.stdout.contains("  0 songs danced to (0 phrases), "), "{read:?}");
    let before = tree(&store);
    let again = run();
    assert!(again.stdout.contains("  nothing to do: "), "{again:?}");
    assert!(tree(&store) == before && motion(&store) == motions);
}
