//! Files that the user names: what is there is written into, and standard output is one of them.

use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::support::files::{coherent, trajectory, wav};
use crate::support::{Dir, finish, ingest, motiongen};

/// The first bytes of a picture.
const PNG: &[u8] = b"\x89PNG\r\n\x1a\n";
const SQL: &str = "select phrase_id, n_frames from phrases";
const CSV: &str = "phrase_id,n_frames\na,31\n";

/// Makes a store with one phrase.
fn store(dir: &Dir) -> PathBuf {
    dir.write("source/motion/a/trajectory.npy", trajectory(&coherent(31, 1)));
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    dir.at("store")
}

fn query(store: &Path, output: &Path) -> Command {
    let mut command = motiongen();
    command.args(["query", "--format", "csv", "--store"]).arg(store);
    command.arg("--output").arg(output).arg(SQL);
    command
}

#[test]
fn links_stay_and_permissions_are_kept() {
    let dir = Dir::new();
    let store = store(&dir);
    let target = dir.write("there/target.csv", "old");
    std::fs::set_permissions(&target, std::fs::Permissions::from_mode(0o604)).unwrap();
    symlink("there/target.csv", dir.at("link.csv")).unwrap();
    let output = finish(&mut query(&store, &dir.at("link.csv")));
    assert_eq!(output.code, 0, "{output:?}");
    assert!(std::fs::symlink_metadata(dir.at("link.csv")).unwrap().is_symlink());
    assert_eq!(std::fs::read_to_string(&target).unwrap(), CSV);
    assert_eq!(std::fs::metadata(&target).unwrap().permissions().mode() & 0o777, 0o604);
    assert_eq!(std::fs::read_dir(dir.at("there")).unwrap().count(), 1);
    // A new file gets what the user's mask leaves.
    let plain = query(&store, &dir.at("new.csv"));
    let mut masked = Command::new("sh");
    masked.args(["-c", "umask 077 && exec \"$0\" \"$@\""]);
    masked.arg(plain.get_program()).args(plain.get_args());
    assert_eq!(finish(&mut masked).code, 0);
    assert_eq!(std::fs::metadata(dir.at("new.csv")).unwrap().permissions().mode() & 0o777, 0o600);
}

#[test]
fn a_pipe_is_written_to() {
    let dir = Dir::new();
    let store = store(&dir);
    let pipe = dir.at("pipe");
    assert!(Command::new("mkfifo").arg(&pipe).status().unwrap().success());
    // A reader that gives up where nobody ever writes.
    let reader =
        Command::new("timeout").arg("60").arg("cat").arg(&pipe).stdout(Stdio::piped()).spawn();
    let output = finish(&mut query(&store, &pipe));
    assert_eq!(output.code, 0, "{output:?}");
    let read = reader.unwrap().wait_with_output().unwrap();
    assert_eq!(String::from_utf8(read.stdout).unwrap(), CSV);
    assert_eq!(output.stdout, format!("1 rows → {}\n", pipe.display()));
    use std::os::unix::fs::FileTypeExt as _;
    assert!(std::fs::symlink_metadata(&pipe).unwrap().file_type().is_fifo());
}

#[test]
fn what_the_shell_opened_is_written_to() {
    let dir = Dir::new();
    let store = store(&dir);
    // Process substitution: a name of a pipe that is open already.
    let plain = query(&store, Path::new("/dev/fd/9"));
    let mut shell = Command::new("bash");
    shell.args(["-c", "\"$0\" \"$@\" 9> >(cat >&2)"]);
    shell.arg(plain.get_program()).args(plain.get_args());
    let output = finish(&mut shell);
    assert_eq!((output.code, output.stderr.as_str()), (0, CSV), "{output:?}");
}

#[test]
fn standard_output_is_a_file_like_others() {
    let dir = Dir::new();
    let store = store(&dir);
    for name in ["-", "/dev/stdout"] {
        let mut command = query(&store, Path::new(name));
        // Nothing is made beside it.
        let output = finish(command.current_dir(dir.path()));
        assert_eq!((output.code, output.stdout.as_str()), (0, CSV), "{output:?}");
        assert_eq!(output.stderr, format!("1 rows → {name}\n"));
    }
    assert!(std::fs::symlink_metadata("/dev/stdout").unwrap().is_symlink());
    assert!(!dir.at("-").exists());

    let motion = dir.at("source/motion/a/trajectory.npy");
    let bytes = |words: &[&str]| {
        let mut command = motiongen();
        command.args(words).arg("--motion").arg(&motion).args(["--output", "-"]);
        let output = command.output().unwrap();
        assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
        output.stdout
    };
    assert!(bytes(&["plot", "motion"]).starts_with(PNG));
    let page = String::from_utf8(bytes(&["view"])).unwrap();
    assert!(page.starts_with("<!DOCTYPE html>") && page.trim_end().ends_with("</html>"));

    let song = dir.write("song.wav", wav(1.0));
    let mut command = motiongen();
    command.arg("extract").arg("--audio").arg(&song).args(["--output", "-"]);
    let output = command.current_dir(dir.path()).output().unwrap();
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(output.stdout.starts_with(b"PK"), "an archive of arrays");
    assert!(!dir.at("-").exists());
}

#[test]
fn a_device_stays_a_device() {
    let dir = Dir::new();
    let store = store(&dir);
    symlink("/dev/null", dir.at("nothing.csv")).unwrap();
    let output = finish(&mut query(&store, &dir.at("nothing.csv")));
    assert_eq!(output.code, 0, "{output:?}");
    assert!(std::fs::symlink_metadata(dir.at("nothing.csv")).unwrap().is_symlink());
}
