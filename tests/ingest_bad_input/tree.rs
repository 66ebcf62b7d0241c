//! Names, folders, links and permissions that no phrase can have.

use std::ffi::OsStr;
use std::fs::{File, Permissions, create_dir_all, set_permissions};
use std::os::unix::ffi::OsStrExt as _;
use std::os::unix::fs::{PermissionsExt as _, symlink};
use std::os::unix::net::UnixListener;
use std::path::Path;
use std::process::Command;

use super::case::Case;
use crate::support::files::{coherent, trajectory, wav};
use crate::support::{MEMORY_BYTES, write};

pub fn cases() -> Vec<Case> {
    [doubles(), styles(), folders(), no_files(), links(), large_files(), permissions(), names()]
        .into_iter()
        .flatten()
        .collect()
}

#[rustfmt::skip]
fn doubles() -> Vec<Case> {
    vec![
        Case::files("two-songs",
            [("audio/two-songs.wav", wav(0.5)), ("audio/two-songs.flac", wav(0.5))],
            "audio/two-songs.wav", "duplicate_id",
            "audio comes twice, from audio/two-songs.flac and {path}; keep one of them"),
        Case::files("two-motions",
            [("motion/two-motions/trajectory.npy", trajectory(&coherent(9, 1))),
             ("motion/two-motions/motion.bvh", b"HIERARCHY".to_vec())],
            "motion/two-motions/trajectory.npy", "duplicate_id",
            "motion comes twice, from motion/two-motions/motion.bvh and {path}; keep one of them"),
        Case::files("two-beats",
            [("audio/two-beats.wav", wav(0.5)),
             ("audio/two-beats.beats.txt", b"0\n1\n".to_vec()),
             ("beats/two-beats.beats.txt", b"0\n1\n".to_vec())],
            "beats/two-beats.beats.txt", "duplicate_id",
            "beats comes twice, from audio/two-beats.beats.txt and {path}; keep one of them"),
    ]
}

#[rustfmt::skip]
fn styles() -> Vec<Case> {
    let case = |id: &str, name: &[u8], sentence: &str| {
        let path = format!("motion/{id}/style.txt");
        let motion = (format!("motion/{id}/trajectory.npy"), trajectory(&coherent(9, 1)));
        Case::files(id, [motion, (path.clone(), name.to_vec())], &path, "layout", sentence)
    };
    let no_name = "{path} has no name of a style; write one in a line: at most 64 letters, digits, spaces, -, _ and ', and no \
                   number";
    vec![
        case("style-number", b"0.5\n", no_name),
        case("style-empty", b" \n", no_name),
        case("style-lines", b"house\nbreak\n", no_name),
        case("style-bytes", b"caf\xe9 \xff", "{path} is not UTF-8 text; write the name of one style in a line"),
        Case::files("style-alone", [("motion/style-alone/style.txt", b"house".to_vec())],
            "motion/style-alone", "layout",
            "folder {path} holds no trajectory.npy or motion.bvh (or .npz, .npy, .vmd); add it or remove the folder"),
    ]
}

#[rustfmt::skip]
fn folders() -> Vec<Case> {
    vec![
        Case::tree("folder-for-npy", "motion/folder-for-npy/trajectory.npy",
            |source| create_dir_all(source.join("motion/folder-for-npy/trajectory.npy")).unwrap(),
            "not_a_file",
            "{path} is a folder where a file is expected; rename or remove it"),
        Case::files("filled-folder-for-npy",
            [("motion/filled-folder-for-npy/trajectory.npy/part/0.npy", vec![1]),
             ("motion/filled-folder-for-npy/trajectory.npy/1.npy", vec![2])],
            "motion/filled-folder-for-npy/trajectory.npy", "not_a_file",
            "{path} is a folder where a file is expected; rename or remove it"),
        Case::tree("folder-for-wav", "audio/folder-for-wav.wav",
            |source| create_dir_all(source.join("audio/folder-for-wav.wav")).unwrap(),
            "not_a_file",
            "{path} is a folder where a file is expected; rename or remove it"),
        Case::tree("folder-empty", "motion/folder-empty",
            |source| create_dir_all(source.join("motion/folder-empty")).unwrap(),
            "layout",
            "folder {path} holds no trajectory.npy or motion.bvh (or .npz, .npy, .vmd); add it or remove the folder"),
        Case::tree("features-folder-empty", "audio_features/features-folder-empty",
            |source| create_dir_all(source.join("audio_features/features-folder-empty")).unwrap(),
            "layout",
            "folder {path} holds no features.npz; add it or remove the folder"),
        Case::files("file-misnamed",
            [("motion/file-misnamed/Trajectory.npy", trajectory(&coherent(9, 1)))],
            "motion/file-misnamed", "layout",
            "folder {path} holds no trajectory.npy or motion.bvh (or .npz, .npy, .vmd); add it or remove the folder"),
    ]
}

#[rustfmt::skip]
fn no_files() -> Vec<Case> {
    vec![
        Case::tree("pipe", "motion/pipe/trajectory.npy",
            |source| {
                create_dir_all(source.join("motion/pipe")).unwrap();
                let path = source.join("motion/pipe/trajectory.npy");
                assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
            },
            "not_a_file", "{path} is a pipe, socket or device, not a file; remove it"),
        Case::tree("socket", "audio/socket.wav",
            |source| {
                create_dir_all(source.join("audio")).unwrap();
                drop(UnixListener::bind(source.join("audio/socket.wav")).unwrap());
            },
            "not_a_file", "{path} is a pipe, socket or device, not a file; remove it"),
        Case::tree("link-to-a-device", "audio/link-to-a-device.wav",
            |source| {
                create_dir_all(source.join("audio")).unwrap();
                symlink("/dev/zero", source.join("audio/link-to-a-device.wav")).unwrap();
            },
            "symlink",
            "{path} is a symbolic link that leads out of the source; copy what it names into the \
             source, or pass --follow-links"),
    ]
}

#[rustfmt::skip]
fn links() -> Vec<Case> {
    vec![
        Case::tree("link-to-nowhere", "motion/link-to-nowhere/trajectory.npy",
            |source| {
                create_dir_all(source.join("motion/link-to-nowhere")).unwrap();
                let path = source.join("motion/link-to-nowhere/trajectory.npy");
                symlink("gone.npy", path).unwrap();
            },
            "symlink",
            "{path} is a symbolic link to something that does not exist; remove or repair it"),
        Case::tree("link-to-its-own-folder", "motion/link-to-its-own-folder",
            |source| {
                create_dir_all(source.join("motion")).unwrap();
                symlink("../motion", source.join("motion/link-to-its-own-folder")).unwrap();
            },
            "symlink", "{path} is a symbolic link back to its own folder \"motion\"; remove it"),
        Case::tree("link-to-itself", "audio/link-to-itself.wav",
            |source| {
                create_dir_all(source.join("audio")).unwrap();
                symlink("link-to-itself.wav", source.join("audio/link-to-itself.wav")).unwrap();
            },
            "unreadable",
            "{path} could not be listed (IO error for operation on {source}/{path}: Too many \
             levels of symbolic links (os error 40))"),
    ]
}

/// Makes a file of zeros that takes no room on the disk.
fn zeros(path: &Path, n_bytes: u64) {
    create_dir_all(path.parent().unwrap()).unwrap();
    File::create(path).unwrap().set_len(n_bytes).unwrap();
}

#[rustfmt::skip]
fn large_files() -> Vec<Case> {
    vec![
        Case::tree("npy-of-1-gb", "motion/npy-of-1-gb/trajectory.npy",
            |source| zeros(&source.join("motion/npy-of-1-gb/trajectory.npy"), (1 << 30) + 1),
            "too_large",
            "{path} has 1073741825 bytes, more than the 1073741824 that are read; split the \
             phrase"),
        // Larger than the memory that the program may have.
        Case::tree("wav-of-zeros", "audio/wav-of-zeros.wav",
            |source| zeros(&source.join("audio/wav-of-zeros.wav"), MEMORY_BYTES + (100 << 20)),
            "audio_header",
            "{path}: not audio: it starts with bytes 00 00 00 00 00 00 00 00; WAV, AIFF, FLAC, \
             MP3, Ogg, MP4, AAC, CAF and AU are read, was another format saved under the name .wav?"),
    ]
}

fn forbid(path: &Path) {
    set_permissions(path, Permissions::from_mode(0o0)).unwrap();
}

#[rustfmt::skip]
fn permissions() -> Vec<Case> {
    vec![
        Case::tree("file-locked", "motion/file-locked/trajectory.npy",
            |source| {
                let bytes = trajectory(&coherent(9, 1));
                forbid(&write(&source.join("motion/file-locked/trajectory.npy"), bytes));
            },
            "unreadable", "{source}/{path}: could not read (Permission denied (os error 13))"),
        Case::tree("folder-locked", "motion/folder-locked",
            |source| {
                let bytes = trajectory(&coherent(9, 1));
                write(&source.join("motion/folder-locked/trajectory.npy"), bytes);
                forbid(&source.join("motion/folder-locked"));
            },
            "unreadable", "{path} may not be read (permission denied); grant read access"),
    ]
}

#[rustfmt::skip]
fn names() -> Vec<Case> {
    vec![
        Case::tree("caf\u{fffd}", "audio/caf\u{fffd}.wav",
            |source| {
                write(&source.join("audio").join(OsStr::from_bytes(b"caf\xe9.wav")), wav(0.5));
            },
            "name", "{path} has a name that is not UTF-8; rename it"),
        Case::tree("folder-\u{fffd}", "motion/folder-\u{fffd}",
            |source| {
                let folder = source.join("motion").join(OsStr::from_bytes(b"folder-\xff"));
                write(&folder.join("trajectory.npy"), trajectory(&coherent(9, 1)));
            },
            "name", "{path} has a name that is not UTF-8; rename it"),
    ]
}
