//! What the program neither reads, nor removes, nor says: what is not its own.

use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::path::Path;
use std::time::{Duration, SystemTime};

use motiongen::store::tables::PhraseRow;
use motiongen::store::{Commit, Item, Ledger, Location, Row as _};

use crate::library::{clicks, constructed, from, library, write_captures, write_songs};
use crate::support::files::{coherent, trajectory, wav};
use crate::support::{
    Dir, MEMORY_BYTES, confined, failures, finish, ingest, ingest_command, phrases, run, tree,
    write,
};

/// Something that only its owner may know.
const SECRET: &str = "root:x:0:0:root:/root:/bin/bash";

/// Makes a source of one song beside a folder that is not part of it, with links from one to the other.
fn with_links(dir: &Dir) {
    dir.write("source/songs/own.wav", wav(0.5));
    dir.write("elsewhere/secret", SECRET);
    dir.write("elsewhere/album/song.wav", wav(1.0));
    let link = |target: &Path, path: &str| symlink(target, dir.at(path)).expect("a link");
    link(&dir.at("elsewhere/secret"), "source/passwords.wav");
    link(Path::new("../elsewhere/album"), "source/album");
    link(Path::new("songs/own.wav"), "source/again.wav");
    link(Path::new("songs"), "source/same");
    link(&dir.at("source/passwords.wav"), "source/songs/twice.wav");
}

#[test]
fn links_that_leave_the_source_are_failures() {
    let dir = Dir::new();
    with_links(&dir);
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 1, "{output:?}");
    let found = failures(&dir.at("store"));
    let found: Vec<_> =
        found.values().map(|row| (row.phrase_id.as_str(), &*row.kind, &*row.message)).collect();
    let sentence = |path: &str| {
        format!(
            "{path} is a symbolic link that leads out of the source; copy what it names into the source, or pass \
             --follow-links"
        )
    };
    let expected = ["album", "passwords.wav", "same/twice.wav", "songs/twice.wav"];
    let sentences = expected.map(sentence);
    let expected: Vec<_> = expected
        .iter()
        .zip(&sentences)
        .map(|(id, sentence)| (*id, "symlink", &**sentence))
        .collect();
    assert_eq!(found, expected);
    let found = phrases(&dir.at("store"));
    assert_eq!(found.keys().collect::<Vec<_>>(), ["again.wav", "same/own.wav", "songs/own.wav"]);
    for (path, (bytes, _)) in tree(&dir.at("store")) {
        let text = String::from_utf8_lossy(&bytes);
        assert!(!text.contains("root:x"), "{}", path.display());
    }
}

#[test]
fn links_are_followed_out_of_the_source_where_that_is_asked_for() {
    let dir = Dir::new();
    with_links(&dir);
    let output = ingest(&dir.at("source"), &dir.at("store"), &["--follow-links"]);
    assert_eq!(output.code, 1, "{output:?}");
    let found = phrases(&dir.at("store"));
    let expected = ["again.wav", "album/song.wav", "same/own.wav", "songs/own.wav"];
    assert_eq!(found.keys().collect::<Vec<_>>(), expected);
    let extract =
        ["extract", "--store", dir.at("store").to_str().expect("UTF-8")].map(str::to_owned);
    let output = run(&extract);
    assert_eq!(output.code, 0, "{output:?}");
}

#[test]
fn a_walk_does_not_leave_the_source_by_a_folder() {
    let dir = Dir::new();
    dir.write("source/own.wav", wav(0.5));
    symlink("/proc/self", dir.at("source/proc")).expect("a link");
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 1, "{output:?}");
    assert_eq!(failures(&dir.at("store")).keys().collect::<Vec<_>>(), ["proc"]);
    assert_eq!(phrases(&dir.at("store")).len(), 1);
}

#[test]
fn a_library_takes_songs_and_captures_of_its_folders_alone() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    dir.write("elsewhere/song.wav", clicks(104.0, 8.5));
    let capture = std::fs::read(captures.join("cmu.npy")).expect("a capture");
    dir.write("elsewhere/walk.npy", capture);
    symlink(dir.at("elsewhere"), songs.join("album")).expect("a link");
    symlink(dir.at("elsewhere"), captures.join("moves")).expect("a link");
    let output = library(&store, &from(&songs, &captures, &["--takes", "1"]));
    assert_eq!(output.code, 1, "{output:?}");
    let failed: Vec<_> =
        failures(&store).into_values().map(|row| (row.phrase_id, row.kind)).collect();
    let expected = ["album", "moves"].map(|id| (id.to_owned(), "symlink".to_owned()));
    assert_eq!(failed, expected);
    let n_songs = |store: &Path| {
        let songs = constructed(store).into_values().filter_map(|row| row.song_hash);
        songs.collect::<std::collections::BTreeSet<_>>().len()
    };
    assert_eq!(n_songs(&store), 3);
    let followed = dir.at("followed");
    let flags = from(&songs, &captures, &["--takes", "1", "--follow-links"]);
    let output = library(&followed, &flags);
    assert_eq!((output.code, n_songs(&followed)), (0, 4), "{output:?}");
}

/// Makes a file that nobody has touched for three days.
fn old(path: &Path) {
    write(path, "mine");
    let then = SystemTime::now() - Duration::from_secs(3 * 24 * 3600);
    std::fs::File::options().write(true).open(path).unwrap().set_modified(then).unwrap();
}

#[test]
fn files_of_others_below_the_store_stay_and_one_that_cannot_be_read_stops_nothing() {
    let dir = Dir::new();
    dir.write("source/own.wav", wav(0.5));
    let store = dir.at("store");
    let (notes, page) = (store.join(".tmp_important_notes"), store.join("projects/a/.tmpl.html"));
    let (other, ours) =
        (store.join("projects/.partial-a1B2c3"), store.join("phrases/.partial-a1B2c3"));
    for path in [&notes, &page, &other, &ours] {
        old(path);
    }
    let locked = store.join("lost+found");
    std::fs::create_dir(&locked).unwrap();
    let lock = |mode| {
        std::fs::set_permissions(&locked, std::fs::Permissions::from_mode(mode)).unwrap();
    };
    lock(0);
    let command = ingest_command(&dir.at("source"), &store, &[]);
    let output = finish(&mut confined(&command, MEMORY_BYTES));
    lock(0o755);
    assert_eq!(output.code, 0, "{output:?}");
    for path in [notes, page, other] {
        assert_eq!(std::fs::read_to_string(&path).ok().as_deref(), Some("mine"), "{path:?}");
    }
    assert!(!ours.exists(), "a file of ours that was left behind");
}

#[test]
fn what_is_written_has_the_permissions_of_new_files() {
    let dir = Dir::new();
    dir.write("source/own.wav", wav(0.5));
    let command = ingest_command(&dir.at("source"), &dir.at("store"), &[]);
    let mut masked = std::process::Command::new("sh");
    masked.args(["-c", "umask 027 && exec \"$0\" \"$@\""]);
    masked.arg(command.get_program()).args(command.get_args());
    assert_eq!(finish(&mut masked).code, 0);
    let modes: Vec<u32> = walkdir::WalkDir::new(dir.at("store"))
        .into_iter()
        .map(|entry| entry.unwrap())
        .filter(|entry| entry.file_type().is_file())
        .map(|entry| entry.metadata().unwrap().permissions().mode() & 0o777)
        .collect();
    assert!(modes.len() >= 2 && modes.iter().all(|&mode| mode == 0o640), "{modes:?}");
}

#[test]
fn messages_have_neither_signatures_nor_passwords() {
    let dir = Dir::new();
    let store = dir.at("store").display().to_string();
    for url in [
        "https://USER:SECRET@host/songs",
        "https://host/songs?X-Amz-Signature=SECRET",
        "az://container/songs?sig=SECRET&se=2030",
        "nothing://host/a b?token=SECRET",
        "s3://KEY:SECRET@/songs",
    ] {
        let output = run(["ingest", "--source", url, "--store", &store]);
        assert_eq!(output.code, 2, "{output:?}");
        let host = ["host", "container", "songs"].iter().any(|known| output.stderr.contains(known));
        assert!(host && !output.stderr.contains("SECRET"), "{url}: {}", output.stderr);
        assert_eq!(output.stderr.lines().count(), 1, "{}", output.stderr);
    }
}

#[test]
fn names_of_files_cannot_steer_a_terminal() {
    let dir = Dir::new();
    let name = "\u{1b}]0;pwned\u{7}\u{1b}[31mred\nnext.wav";
    dir.write(Path::new("source").join(name), "no audio");
    dir.write("source/good.wav", wav(0.5));
    dir.write(Path::new("source").join("\u{1b}[2Jleft alone"), "x");
    let output = ingest(&dir.at("source"), &dir.at("my store"), &[]);
    assert_eq!(output.code, 1, "{output:?}");
    for text in [&output.stdout, &output.stderr] {
        assert!(!text.contains(['\u{1b}', '\u{7}']), "{text:?}");
    }
    let shown = "phrase \\u{1b}]0;pwned\\u{7}\\u{1b}[31mred\\nnext.wav: ";
    assert!(output.stdout.contains(shown), "{}", output.stdout);
    // The hint can be pasted into a shell.
    let hint = format!("motiongen query --store '{}' \"select", dir.at("my store").display());
    assert!(output.stdout.contains(&hint), "{}", output.stdout);
    let store = dir.at("my store").display().to_string();
    let output = run(["query", "--store", &store, "select phrase_id from failures"]);
    assert!(output.stdout.contains("\\u{1b}]0;pwned"), "{}", output.stdout);
    // Data stay what they are.
    let sql = "select phrase_id from failures";
    let output = run(["query", "--store", &store, "--format", "csv", sql]);
    assert_eq!(output.stdout, format!("phrase_id\n\"{name}\"\n"));
}

/// Puts a phrase into a store whose table says that its audio is `audio`, below `source`.
fn phrase_of(dir: &Dir, source: &str, audio: &Path, origin: &str) -> String {
    let store = dir.at("store");
    let location = Location::local(&store).expect("a location");
    let mut row = phrases(&store).remove("walk").expect("the phrase");
    row.source = source.to_owned();
    row.audio_url = Some(format!("file://{}", audio.display()));
    let mut commit = Commit::new(&location, "ingest", "rules", origin);
    commit.part("phrases", PhraseRow::schema).expect("a file").write_rows(&[row]).expect("rows");
    let motion = commit.part("motion", motiongen::store::tables::motion).expect("a file");
    motion.write_frames("walk", ndarray::Array2::zeros((31, 25)).view()).expect("frames");
    let fingerprint = audio.display().to_string();
    let input_hash = format!("{fingerprint} {source} {origin}");
    let item = Item { id: "walk".to_owned(), fingerprint, input_hash, failure: None };
    commit.settle(item, &Ledger::read(&location, "ingest").expect("commits"));
    commit.publish().expect("published");
    store.display().to_string()
}

#[test]
fn a_page_embeds_audio_of_the_sources_alone() {
    let dir = Dir::new();
    dir.write("source/motion/walk/trajectory.npy", trajectory(&coherent(31, 1)));
    dir.write("source/audio/walk.wav", wav(31.0 / 30.0));
    let secret = dir.write("secret.wav", SECRET);
    let other = dir.write("other.wav", wav(2.0));
    symlink(&other, dir.at("source/audio/link.wav")).expect("a link");
    assert_eq!(ingest(&dir.at("source"), &dir.at("store"), &["--layout", "phrases"]).code, 1);
    let source = format!("file://{}", dir.at("source").display());
    let own = dir.at("source/audio/walk.wav");
    let secret_inside = dir.write("source/notes", SECRET);
    let link = dir.at("source/audio/link.wav");
    for (base, audio, origin, expected) in [
        (&*source, &own, &*source, None),
        (
            "file:///",
            &secret,
            &*source,
            Some("is in none of the sources that the store was ingested from"),
        ),
        (
            "file:///",
            &other,
            &*source,
            Some("is in none of the sources that the store was ingested from"),
        ),
        (
            &*source,
            &other,
            &*source,
            Some("is in none of the sources that the store was ingested from"),
        ),
        (&*source, &secret_inside, &*source, Some("is no audio")),
        ("file:///", &secret, "file:///", Some("is no audio")),
        (&*source, &link, &*source, Some("is a symbolic link that leads out of the source")),
    ] {
        let store = phrase_of(&dir, base, audio, origin);
        let page = dir.at("page.html").display().to_string();
        let output = run(["view", "--store", &store, "--phrase", "walk", "--output", &page]);
        assert_eq!(output.code, 0, "{output:?}");
        match expected {
            None => assert!(output.stdout.contains("with audio"), "{output:?}"),
            Some(reason) => {
                assert!(output.stdout.contains("without audio"), "{audio:?}: {output:?}");
                assert!(output.stderr.contains(reason), "{audio:?}: {output:?}");
            }
        }
    }
}
