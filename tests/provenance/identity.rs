//! The identity of music: the same under any name, beside any other file, and in any store.

use motiongen::store::digest;

use super::*;
use crate::library::{clicks, constructed, from, library, write_captures, write_songs};
use crate::support::files::{coherent, features_npz, trajectory, wav};
use crate::support::{ingest, motion, phrases};

#[test]
fn music_is_its_audio_else_its_features() {
    let dir = Dir::new();
    let (audio, features, motion) = (wav(0.61), features_npz(19), trajectory(&coherent(19, 1)));
    dir.write("a/song.wav", &audio);
    dir.write("b/album/another name.wav", &audio);
    dir.write("b/album/another name.beats.txt", "0.1 1\n0.4 2\n");
    dir.write("c/audio_features/x/features.npz", &features);
    dir.write("c/audio_features/y/features.npz", &features);
    dir.write("c/audio/y.wav", wav(19.0 / 30.0));
    dir.write("c/motion/y/trajectory.npy", &motion);
    dir.write("c/motion/z/trajectory.npy", &motion);
    let store = dir.at("store");
    for source in ["a", "b", "c"] {
        succeeds(ingest(&dir.at(source), &store, &[]));
    }
    let rows = phrases(&store);
    let song = |id: &str| rows[id].song_hash.clone();
    assert_eq!(song("song.wav"), Some(digest(&audio)));
    assert_eq!(song("album/another name.wav"), Some(digest(&audio)));
    assert!(rows["album/another name.wav"].has_beats);
    assert_ne!(rows["album/another name.wav"].content_hash, rows["song.wav"].content_hash);
    assert_eq!(song("x"), Some(digest(&features)));
    assert_eq!(song("y"), Some(digest(&wav(19.0 / 30.0))));
    assert_eq!(song("z"), None);
}

#[test]
fn constructed_phrases_are_to_the_music_of_their_song() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    let by_folder = dir.at("by folder");
    succeeds(library(&by_folder, &from(&songs, &captures, &["--takes", "2"])));
    let by_store = dir.at("by store");
    dir.write("takes/motion/walk/trajectory.npy", trajectory(&coherent(200, 1)));
    for source in [&songs, &dir.at("takes")] {
        succeeds(ingest(source, &by_store, &[]));
    }
    extract(&by_store);
    succeeds(library(&by_store, &["--takes", "2"]));
    for store in [by_folder, by_store] {
        let rows = constructed(&store);
        assert_eq!(rows.len(), 20);
        for (id, row) in &rows {
            let name = row.source.rsplit_once("/songs/").expect("a song").1.replace("%20", " ");
            let audio = std::fs::read(songs.join(name)).expect("a song");
            assert_eq!(row.song_hash, Some(digest(&audio)), "{id}");
        }
    }
}

#[test]
fn songs_of_release_0_1_are_identified_and_no_others_are_read() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    dir.write("source/a.wav", wav(0.61));
    dir.write("source/b/c.wav", wav(0.4));
    succeeds(ingest(&source, &store, &["--batch-phrases=1"]));
    dir.write("takes/motion/m/trajectory.npy", trajectory(&coherent(31, 2)));
    succeeds(ingest(&dir.at("takes"), &store, &[]));
    let (rows, frames) = (phrases(&store), motion(&store));
    assert_eq!(release_0_1::downgrade(&store, "ingest"), 3);
    let old = phrases(&store);
    assert!(old.len() == 3 && old.values().all(|row| row.song_hash.is_none()));
    // One that this release writes.
    dir.write("source/z.wav", wav(0.5));
    succeeds(ingest(&source, &store, &["--batch-phrases=1"]));
    let rows = {
        let mut rows = rows;
        rows.insert("z.wav".to_owned(), phrases(&store)["z.wav"].clone());
        rows
    };
    assert_eq!(phrases(&store), rows);

    // Half done: one of three songs lacks its identity.
    assert_eq!(release_0_1::downgrade_one(&store, "b/c.wav"), 1);
    let planned = succeeds(ingest(&source, &store, &["--dry-run"]));
    let expected = "\n  would read 1 phrases (0 of them cannot be read), leave 2 as they are\n";
    assert!(planned.stdout.contains(expected), "{planned:?}");
    let done = succeeds(ingest(&source, &store, &[]));
    let expected = "\n  1 ingested (0.4 s of music or motion, 0 motion frames), 2 up to date, 0 ";
    assert!(done.stdout.contains(expected), "{done:?}");
    assert_eq!((phrases(&store), motion(&store)), (rows, frames));
    for source in [&source, &dir.at("takes")] {
        let again = succeeds(ingest(source, &store, &[]));
        assert!(again.stdout.contains("\n  nothing to do: "), "{again:?}");
    }
}

#[test]
fn dances_of_release_0_1_are_danced_again_once_their_song_is_known() {
    let dir = Dir::new();
    let (songs, store) = (dir.at("songs"), dir.at("store"));
    dir.write("songs/one.wav", clicks(120.0, 4.5));
    dir.write("songs/two.wav", clicks(101.0, 4.2));
    dir.write("takes/motion/walk/trajectory.npy", trajectory(&coherent(200, 1)));
    for source in [&songs, &dir.at("takes")] {
        succeeds(ingest(source, &store, &[]));
    }
    extract(&store);
    let dance = || succeeds(library(&store, &["--takes=1"])).stdout;
    dance();
    let (rows, frames) = (phrases(&store), motion(&store));
    release_0_1::downgrade(&store, "ingest");
    release_0_1::downgrade(&store, "library");
    // The songs are not known yet, so dancing again would tell nothing.
    assert!(dance().contains("\n  nothing to do: 2 songs are up to date"));
    succeeds(ingest(&songs, &store, &[]));
    assert!(dance().contains("\n  2 songs danced to (2 phrases), 0 up to date, 0 failed; "));
    assert_eq!((phrases(&store), motion(&store)), (rows, frames));
    assert!(dance().contains("\n  nothing to do: 2 songs are up to date"));
}
