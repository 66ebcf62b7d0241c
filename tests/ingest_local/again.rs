//! Running ingest again: what is done stays untouched, what changed is done anew.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use super::write_motion;
use crate::support::files::{coherent, trajectory, wav};
use crate::support::{
    Dir, MEMORY_BYTES, Output, confined, failures, finish, ingest, ingest_command, motion, phrases,
    tree,
};

const IDS: [(&str, usize); 5] = [("a", 31), ("b", 3), ("c/d", 17), ("e", 1), ("f g", 60)];

/// A source of five phrases of motion and one of audio, ingested.
fn ingested() -> (Dir, PathBuf, PathBuf) {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    for (seed, (id, n_frames)) in (1..).zip(IDS) {
        write_motion(&source, id, n_frames, seed);
    }
    dir.write("source/audio/song.wav", wav(0.61));
    let output = ingest(&source, &store, &["--batch-phrases", "2"]);
    says(
        &output,
        "6 ingested (4.3 s of music or motion, 112 motion frames), 0 up to date, 0 failed",
    );
    (dir, source, store)
}

#[track_caller]
fn says(output: &Output, sentence: &str) {
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains(&format!("\n  {sentence}")), "{}", output.stdout);
    assert_eq!(output.stderr, "");
}

/// Sets a file's modification time to another moment, always later than before.
fn touch(path: &Path) -> SystemTime {
    let file = std::fs::File::options().write(true).open(path).unwrap();
    let later = file.metadata().unwrap().modified().unwrap() + Duration::from_secs(7);
    file.set_modified(later).unwrap();
    later
}

#[test]
fn a_second_run_does_nothing_and_says_so() {
    let (_dir, source, store) = ingested();
    let before = tree(&store);
    let output = ingest(&source, &store, &[]);
    assert_eq!(
        output.stdout,
        format!(
            "ingest {} → {}\n  nothing to do: 6 phrases are up to date\n",
            source.display(),
            store.display()
        )
    );
    says(&output, "nothing to do: 6 phrases are up to date\n");
    assert_eq!(tree(&store), before);
}

#[test]
fn a_file_that_was_only_touched_is_read_once_and_not_written() {
    let (_dir, source, store) = ingested();
    let before = tree(&store);
    touch(&source.join("motion/c/d/trajectory.npy"));
    let output = ingest(&source, &store, &[]);
    says(
        &output,
        "0 ingested (0.0 s of music or motion, 0 motion frames), 6 up to date, 0 failed; ",
    );
    // All that is new says under which time the file was seen.
    let mut after = tree(&store);
    let seen: Vec<_> =
        after.keys().filter(|p| p.starts_with("commits/ingest-seen")).cloned().collect();
    assert_eq!(seen.len(), 1);
    let again = ingest(&source, &store, &[]);
    says(&again, "nothing to do: 6 phrases are up to date\n");
    assert_eq!(tree(&store), after);
    after.remove(&seen[0]);
    assert_eq!(after, before);
}

#[test]
fn a_changed_file_supersedes_its_rows() {
    let (dir, source, store) = ingested();
    let before = tree(&store);
    write_motion(&source, "c/d", 22, 9);
    dir.write("source/audio/song.wav", wav(0.8));
    let output = ingest(&source, &store, &[]);
    says(
        &output,
        "2 ingested (1.5 s of music or motion, 22 motion frames), 4 up to date, 0 failed; ",
    );
    let (rows, frames) = (phrases(&store), motion(&store));
    assert_eq!(rows.keys().collect::<Vec<_>>(), ["a", "b", "c/d", "e", "f g", "song"]);
    assert_eq!(rows["c/d"].n_frames, Some(22));
    assert_eq!(rows["song"].duration_s, 0.8);
    assert_eq!(frames["c/d"], coherent(22, 9));
    for (seed, (id, n_frames)) in (1..).zip(IDS) {
        if id != "c/d" {
            assert_eq!(frames[id], coherent(n_frames, seed), "{id}");
        }
    }
    // What was there is not rewritten.
    let after = tree(&store);
    assert!(after.len() > before.len());
    assert!(before.iter().all(|(path, file)| after.get(path) == Some(file)));
    says(&ingest(&source, &store, &[]), "nothing to do: 6 phrases are up to date\n");
}

#[test]
fn a_new_phrase_is_added_to_the_others() {
    let (_dir, source, store) = ingested();
    write_motion(&source, "z", 5, 8);
    says(
        &ingest(&source, &store, &[]),
        "1 ingested (0.2 s of music or motion, 5 motion frames), 6 up to date, 0 failed; ",
    );
    assert_eq!(phrases(&store).len(), 7);
    assert_eq!(motion(&store)["z"], coherent(5, 8));
}

#[test]
fn a_change_that_keeps_size_and_time_is_seen_by_verify_alone() {
    let (_dir, source, store) = ingested();
    let path = source.join("motion/a/trajectory.npy");
    let modified = std::fs::metadata(&path).unwrap().modified().unwrap();
    std::fs::write(&path, trajectory(&coherent(31, 7))).unwrap();
    std::fs::File::options().write(true).open(&path).unwrap().set_modified(modified).unwrap();
    says(&ingest(&source, &store, &[]), "nothing to do: 6 phrases are up to date\n");
    assert_eq!(motion(&store)["a"], coherent(31, 1));
    says(
        &ingest(&source, &store, &["--verify"]),
        "1 ingested (1.0 s of music or motion, 31 motion frames), 5 up to date, 0 failed; ",
    );
    assert_eq!(motion(&store)["a"], coherent(31, 7));
}

#[test]
fn force_writes_the_same_bytes_again() {
    let (_dir, source, store) = ingested();
    let (rows, frames) = (phrases(&store), motion(&store));
    let parts = |store: &Path| -> Vec<(PathBuf, Vec<u8>)> {
        let parquet = |path: &Path| path.extension().is_some_and(|e| e == "parquet");
        let files = tree(store).into_iter().filter(|(path, _)| parquet(path));
        files.map(|(path, (bytes, _))| (path, bytes)).collect()
    };
    let first = parts(&store);
    for round in 2..4 {
        let output = ingest(&source, &store, &["--force", "--batch-phrases", "2"]);
        says(
            &output,
            "6 ingested (4.3 s of music or motion, 112 motion frames), 0 up to date, 0 failed",
        );
        let all = parts(&store);
        assert_eq!(all.len(), round * first.len());
        for (path, bytes) in &first {
            let same = all.iter().filter(|(p, b)| p.parent() == path.parent() && b == bytes);
            assert_eq!(same.count(), round, "{}", path.display());
        }
        assert_eq!((phrases(&store), motion(&store)), (rows.clone(), frames.clone()));
    }
}

#[test]
fn a_dry_run_says_what_would_be_done_and_writes_nothing() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    write_motion(&source, "a", 31, 1);
    write_motion(&source, "b", 9, 2);
    std::fs::create_dir_all(source.join("motion/empty")).unwrap();
    let output = ingest(&source, &store, &["--dry-run"]);
    says(&output, "would read 3 phrases (1 of them cannot be read), leave 0 as they are\n");
    let failed = "\n  failed [layout] phrase empty: folder motion/empty holds no trajectory.npy or \
                  motion.bvh (or .npz, .npy, .vmd); add it or remove the folder\n";
    assert!(output.stdout.contains(failed), "{}", output.stdout);
    assert!(!store.exists());

    assert_eq!(ingest(&source, &store, &[]).code, 1);
    write_motion(&source, "b", 10, 2);
    let before = tree(&store);
    let output = ingest(&source, &store, &["--dry-run"]);
    says(&output, "would read 2 phrases (1 of them cannot be read), leave 1 as they are\n");
    assert_eq!(tree(&store), before);
}

#[test]
fn a_failure_goes_with_its_phrase_and_a_success_stays() {
    let (dir, source, store) = ingested();
    dir.write("source/motion/bad/trajectory.npy", b"");
    dir.write("source/motion/worse/trajectory.npy", b"");
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(failures(&store).into_keys().collect::<Vec<_>>(), ["bad", "worse"]);

    std::fs::remove_dir_all(source.join("motion/bad")).unwrap();
    std::fs::remove_dir_all(source.join("motion/a")).unwrap();
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(failures(&store).into_keys().collect::<Vec<_>>(), ["worse"]);
    assert!(phrases(&store).contains_key("a"), "a record was lost because its file went away");
    let settled = tree(&store);
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(tree(&store), settled, "the failure was forgotten twice");

    // What comes back is read again, broken or not.
    dir.write("source/motion/bad/trajectory.npy", b"");
    assert_eq!(ingest(&source, &store, &[]).code, 1);
    assert_eq!(failures(&store).into_keys().collect::<Vec<_>>(), ["bad", "worse"]);
    write_motion(&source, "bad", 5, 9);
    write_motion(&source, "worse", 7, 9);
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    assert_eq!(phrases(&store)["bad"].n_frames, Some(5));
}

#[test]
fn a_phrase_that_cannot_be_read_just_now_keeps_its_rows() {
    let (_dir, source, store) = ingested();
    let lock = |mode| {
        let path = source.join("motion/a/trajectory.npy");
        std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    lock(0o0);
    let arguments = ["--verify"];
    let command = ingest_command(&source, &store, &arguments);
    let output = finish(&mut confined(&command, MEMORY_BYTES));
    assert_eq!(output.code, 1, "{output:?}");
    assert_eq!(phrases(&store)["a"].n_frames, Some(31), "rows went with the permission");
    assert_eq!(motion(&store)["a"].len(), 31);
    let failures_then = failures(&store);
    let name = format!("a @ file://{}", source.canonicalize().unwrap().display());
    assert_eq!(failures_then.keys().collect::<Vec<_>>(), [&name]);
    assert_eq!(failures_then[&name].kind, "unreadable");

    lock(0o644);
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    assert_eq!(failures(&store).len(), 0, "the failure outlived its cause");
    assert_eq!(phrases(&store).len(), 6);
}

#[test]
fn extras_inside_a_phrase_folder_and_hidden_files_are_left_alone() {
    let (dir, source, store) = ingested();
    dir.write("source/motion/a/extras/thumb.png", b"png");
    dir.write("source/audio/._song.wav", b"resource fork");
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.contains("2 files belong to no phrase and were left alone"),
        "{}",
        output.stdout
    );
}
