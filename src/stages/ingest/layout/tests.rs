//! Which files make which phrase, case by case.

use super::*;

/// A listing of files, and of folders where a path ends with `/`.
fn listing(paths: &[&str]) -> Listing {
    let mut listing = Listing::default();
    for path in paths {
        match path.strip_suffix('/') {
            Some(folder) => listing.folders.push(folder.to_owned()),
            None => {
                listing.files.push(SourceFile {
                    path: (*path).to_owned(),
                    size_bytes: 7,
                    fingerprint: String::new(),
                });
                let above = at_and_above(path).skip(1).map(str::to_owned);
                listing.folders.extend(above);
            }
        }
    }
    listing.files.sort_by(|a, b| a.path.cmp(&b.path));
    listing.folders.sort();
    listing.folders.dedup();
    listing
}

/// One line per phrase: its id and its files' roles, or its failure's kind and path.
fn lines(plan: &IngestPlan) -> Vec<String> {
    let line = |phrase: &PlannedPhrase| match &phrase.problem {
        Some(failure) => format!("{}: {} {}", phrase.id, failure.kind.name(), failure.path),
        None => {
            let roles: Vec<_> = phrase.files.iter().map(|(role, _)| role.name()).collect();
            format!("{}: {}", phrase.id, roles.join(" "))
        }
    };
    plan.phrases.iter().map(line).collect()
}

#[test]
fn files_of_the_phrase_layout_meet_under_one_id() {
    let plan = plan(
        listing(&[
            "audio/a.wav",
            "audio/b/c.beats.txt",
            "audio/b/c.mp3",
            "audio_features/a/features.npz",
            "beats/a.beats.txt",
            "motion/a/motion.bvh",
            "motion/b/c/trajectory.npy",
            "motion/b/c/readme.md",
            "license.txt",
        ]),
        Layout::Auto,
    );
    assert_eq!(lines(&plan), ["a: audio beats features motion", "b/c: audio beats motion"]);
    assert_eq!(plan.ignored, ["license.txt", "motion/b/c/readme.md"]);
}

#[test]
fn a_source_is_a_library_unless_its_folders_say_phrases() {
    for (paths, id) in [
        (&["motion/a/trajectory.npy"][..], "a"),
        (&["audio_features/a/features.npz"], "a"),
        (&["audio/a.wav"], "a"),
        (&["audio/a.wav", "beats/a.beats.txt", "readme.txt"], "a"),
        (&["audio/a.wav", "more/b.wav"], "audio/a.wav"),
        (&["audiobooks/a.wav"], "audiobooks/a.wav"),
        (&["motions/a.wav"], "motions/a.wav"),
        (&["a.wav", "beats/a.beats.txt"], "a.wav"),
    ] {
        assert_eq!(plan(listing(paths), Layout::Auto).phrases[0].id, id, "{paths:?}");
    }
}

#[test]
fn a_folder_without_its_file_fails_unless_it_only_holds_folders() {
    let plan = plan(
        listing(&[
            "motion/empty/",
            "motion/group/take/trajectory.npy",
            "motion/group-b/",
            "motion/group/",
            "motion/misnamed/trajectory.NPY",
            "audio_features/take/features.txt",
        ]),
        Layout::Auto,
    );
    assert_eq!(
        lines(&plan),
        [
            "empty: layout motion/empty",
            "group-b: layout motion/group-b",
            "group/take: motion",
            "misnamed: layout motion/misnamed",
            "take: layout audio_features/take",
        ]
    );
    assert_eq!(
        plan.ignored,
        ["audio_features/take/features.txt", "motion/misnamed/trajectory.NPY"]
    );
}

#[test]
fn a_folder_in_the_place_of_a_file_fails_once_whatever_it_holds() {
    let plan = plan(
        listing(&[
            "motion/a/trajectory.npy/",
            "motion/b/trajectory.npy/0.npy",
            "motion/c/trajectory.npy/deep/er/0.npy",
            "motion/c/trajectory.npy/empty/",
            "motion/d/motion.bvh/",
            "motion/d/trajectory.npy",
            "audio/e.wav/",
        ]),
        Layout::Auto,
    );
    assert_eq!(
        lines(&plan),
        [
            "a: not_a_file motion/a/trajectory.npy",
            "b: not_a_file motion/b/trajectory.npy",
            "c: not_a_file motion/c/trajectory.npy",
            "d: not_a_file motion/d/motion.bvh",
            "e: not_a_file audio/e.wav",
        ]
    );
}

#[test]
fn one_role_twice_is_a_conflict_and_beats_alone_are_too() {
    let plan = plan(
        listing(&[
            "audio/a.flac",
            "audio/a.wav",
            "audio/b.beats.txt",
            "audio/b.ogg",
            "beats/b.beats.txt",
            "beats/c.beats.txt",
            "motion/d/motion.bvh",
            "motion/d/trajectory.npy",
        ]),
        Layout::Auto,
    );
    assert_eq!(
        lines(&plan),
        [
            "a: duplicate_id audio/a.wav",
            "b: duplicate_id beats/b.beats.txt",
            "c: layout beats/c.beats.txt",
            "d: duplicate_id motion/d/trajectory.npy",
        ]
    );
}

#[test]
fn the_name_of_a_style_belongs_to_its_motion_and_is_none() {
    let plan = plan(
        listing(&[
            "motion/a/style.txt",
            "motion/a/trajectory.npy",
            "motion/b/style.txt",
            "motion/style.txt",
        ]),
        Layout::Auto,
    );
    assert_eq!(lines(&plan), ["a: motion style", "b: layout motion/b"]);
    assert_eq!(plan.ignored, ["motion/style.txt"]);
}

#[test]
fn songs_of_a_library_keep_their_extension_and_share_beats() {
    let plan = plan(
        listing(&[
            "a.wav",
            "a.flac",
            "a.beats.txt",
            "b/A.WAV",
            "b/.trash.wav",
            "b/.a.beats.txt",
            "b/lone.beats.txt",
            "live.wav/c.opus",
            "empty.wav/",
            "empty/",
            "cover.png",
        ]),
        Layout::Library,
    );
    assert_eq!(
        lines(&plan),
        [
            "a.flac: audio beats",
            "a.wav: audio beats",
            "b/A.WAV: audio",
            "empty.wav: not_a_file empty.wav",
            "live.wav/c.opus: audio",
        ]
    );
    assert_eq!(plan.ignored, ["b/.a.beats.txt", "b/.trash.wav", "b/lone.beats.txt", "cover.png"]);
}

#[test]
fn problems_belong_to_the_phrase_whose_file_or_folder_they_are() {
    let mut listing = listing(&["motion/a/", "motion/b/", "audio/d.wav"]);
    for (path, kind) in [
        ("audio/d.wav", SourceProblemKind::Unreadable),
        ("motion/a/trajectory.npy", SourceProblemKind::NotAFile),
        ("motion/b", SourceProblemKind::Unreadable),
        ("motion/c", SourceProblemKind::Symlink),
        ("stray.fifo", SourceProblemKind::NotAFile),
    ] {
        let message = "is wrong".to_owned();
        listing.problems.push(SourceProblem { path: path.to_owned(), kind, message });
    }
    let plan = plan(listing, Layout::Auto);
    assert_eq!(
        lines(&plan),
        [
            "a: not_a_file motion/a/trajectory.npy",
            "b: unreadable motion/b",
            "c: symlink motion/c",
            "d: unreadable audio/d.wav",
            "stray.fifo: not_a_file stray.fifo",
        ]
    );
    assert_eq!(
        plan.phrases[0].problem.as_ref().map(|p| p.message.as_str()),
        Some("motion/a/trajectory.npy is wrong")
    );
}

#[test]
fn siblings_whose_names_sort_between_a_folder_and_its_content_do_not_hide_it() {
    // `-` and `.` sort before `/`.
    let paths = ["a", "a-b", "a.c", "a/b", "a0"].map(str::to_owned);
    assert!(any_below(&paths, String::as_str, "a"));
    assert!(!any_below(&paths, String::as_str, "a-b"));
    assert!(!any_below(&paths, String::as_str, "a0"));
    assert!(!any_below(&[], String::as_str, "a"));
}
