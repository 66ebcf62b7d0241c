//! Killing `library` at any moment costs time and nothing else; nor does it matter who does what when.

use std::path::Path;
use std::time::Duration;

use super::{clicks, contents, from, library, library_command, write_captures};
use crate::ingest_kill::Running;
use crate::support::Dir;

const N_SONGS: usize = 12;

fn n_commits(store: &Path) -> usize {
    let Ok(entries) = std::fs::read_dir(store.join("commits/library")) else { return 0 };
    let names = entries.map(|e| e.unwrap().file_name());
    names.filter(|name| name.as_encoded_bytes().ends_with(b".json")).count()
}

fn write(dir: &Dir, folder: &str, order: impl Iterator<Item = usize>) {
    for i in order {
        let bytes = clicks(80.0 + 7.3 * i as f64, 5.0 + 0.3 * i as f64);
        dir.write(format!("{folder}/song {i:02}.wav"), bytes);
    }
    dir.write(format!("{folder}/broken.wav"), "text");
}

#[test]
fn runs_killed_again_and_again_commit_what_one_undisturbed_run_commits() {
    let dir = Dir::new();
    write(&dir, "songs", 0..N_SONGS);
    let captures = write_captures(&dir);
    dir.write("captures/short.npy", crate::support::files::trajectory(&[[0.0; 25]; 3]));
    let flags = from(&dir.at("songs"), &captures, &["--takes", "2", "--workers", "1"]);
    let (store, whole) = (dir.at("store"), dir.at("whole"));
    let output = library(&whole, &flags);
    assert_eq!(output.code, 1, "{output:?}");
    // One commit for each song, one for the captures that failed, one for the song that failed.
    assert_eq!(n_commits(&whole), N_SONGS + 2);

    let (mut n_cut, mut history) = (0, Vec::new());
    for round in 0..5 {
        let before = n_commits(&store);
        let mut running = Running::start(library_command(&store, &flags));
        while n_commits(&store) < before + 2 && running.is_running() {
            std::thread::sleep(Duration::from_micros(300));
        }
        std::thread::sleep(Duration::from_millis(3 * round));
        n_cut += usize::from(running.kill());
        history.push(n_commits(&store));
    }
    // A kill that comes when everything is done proves nothing.
    let n_unfinished = history.iter().filter(|&&n| n < N_SONGS + 2).count();
    assert!(n_cut >= 2 && n_unfinished >= 2, "{history:?}, {n_cut} cut");
    assert!(history.is_sorted(), "committed work went away: {history:?}");
    assert_eq!(library(&store, &flags).code, 1);
    contents(&store).assert_same_as(&contents(&whole));
}

#[test]
fn workers_and_the_order_of_files_change_nothing() {
    let dir = Dir::new();
    write(&dir, "songs", 0..N_SONGS);
    let captures = write_captures(&dir);
    let songs = dir.at("songs");
    let one = dir.at("one");
    assert_eq!(
        library(&one, &from(&songs, &captures, &["--takes", "2", "--workers", "1"])).code,
        1
    );
    // The same folder, written the other way round.
    std::fs::remove_dir_all(&songs).unwrap();
    write(&dir, "songs", (0..N_SONGS).rev());
    let many = dir.at("many");
    assert_eq!(
        library(&many, &from(&songs, &captures, &["--takes", "2", "--workers", "5"])).code,
        1
    );
    // Fingerprints tell when files were written; all else is the same.
    let (mut one, mut many) = (contents(&one), contents(&many));
    for manifest in one.manifests.values_mut().chain(many.manifests.values_mut()) {
        manifest.items.iter_mut().for_each(|item| item.fingerprint.clear());
    }
    many.assert_same_as(&one);
}
