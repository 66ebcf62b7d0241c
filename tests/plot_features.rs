//! `plot features`: pictures of audio files and of phrases in a store, and every mistake with them.

use std::path::{Path, PathBuf};

use motiongen::store::tables::{self, ExtractionRow};
use motiongen::store::{Commit, Item, ItemTables, Ledger, Location, Row as _};
use ndarray::Array2;

use crate::support::files::{coherent, trajectory, wav};
use crate::support::plots::{self, png_size, svg, text};
use crate::support::{Dir, finish, ingest, motiongen, run};

fn golden(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/audio").join(name)
}

fn music() -> String {
    golden("music_48k_stereo.ogg").display().to_string()
}

/// Draws, and returns the summary.
#[track_caller]
fn drawn(arguments: &[&str]) -> String {
    plots::drawn("features", arguments)
}

/// Returns the sentence with which the program refuses.
#[track_caller]
fn refusal(arguments: &[&str]) -> String {
    plots::refusal("features", arguments)
}

#[test]
fn a_png_has_all_panels_at_two_pixels_for_one() {
    let dir = Dir::new();
    let path = dir.at("pictures/song.png");
    let summary = drawn(&["--audio", &music(), "--output", &text(&path)]);
    assert_eq!(summary, format!("121 frames (4.03 s) → {} (2000 × 2574 px)\n", path.display()));
    assert_eq!(png_size(&path), (2000, 2574));
    // Nothing else is left in the folder.
    assert_eq!(std::fs::read_dir(dir.at("pictures")).expect("the folder").count(), 1);
}

#[test]
fn an_svg_has_the_labels_of_its_panels_in_the_order_asked_for() {
    let dir = Dir::new();
    let path = text(&dir.at("song.SVG"));
    let flags = ["--panel", "rms", "--panel", "mel", "--width", "600"];
    let summary = drawn(&[&["--audio", &music(), "--output", &path], &flags[..]].concat());
    assert_eq!(summary, format!("121 frames (4.03 s) → {path} (600 × 615 px)\n"));
    let svg = svg(Path::new(&path));
    for label in [
        "<title>music_48k_stereo.ogg</title>",
        "width=\"600\" height=\"615\"",
        ">121 frames at 30 fps<",
        ">5000<",
        ">time (s)<",
        ">4.0<",
    ] {
        assert!(svg.contains(label), "no {label} in the picture");
    }
    let at = |heading: &str| svg.find(&format!(">{heading}<"));
    assert!(at("RMS").expect("a panel") < at("Mel spectrum").expect("a panel"));
    for heading in ["Chroma", "MFCC", "Spectral centroid", "Onset strength"] {
        assert_eq!(at(heading), None, "{heading}");
    }
}

#[test]
fn an_excerpt_has_its_own_frames_and_the_times_of_the_file() {
    let dir = Dir::new();
    let path = text(&dir.at("a.svg"));
    let flags = ["--audio", &music(), "--output", &path, "--panel", "mfcc"];
    let summary = drawn(&[&flags[..], &["--start", "1.5", "--duration", "0.7"]].concat());
    assert_eq!(summary, format!("21 frames (0.70 s) → {path} (1000 × 447 px)\n"));
    let svg = svg(Path::new(&path));
    assert!(svg.contains(">1.50<") && svg.contains(">2.15<") && !svg.contains(">0.5"));
    // Longer than what is left, and shorter than a frame.
    let long = drawn(&[&flags[..], &["--start", "4", "--duration", "1e300"]].concat());
    assert!(long.starts_with("1 frame (0.03 s) "), "{long}");
    let short = drawn(&[&flags[..], &["--duration", "1e-9"]].concat());
    assert!(short.starts_with("1 frame (0.03 s) "), "{short}");
}

#[test]
fn what_cannot_be_drawn_is_said_in_a_sentence() {
    let dir = Dir::new();
    let (folder, music) = (text(dir.path()), music());
    let older = dir.write("x.png", "an older picture");
    let no_audio = text(&dir.write("notes.wav", "remember the milk"));
    let (png, gif) = (text(&older), text(&dir.at("x.gif")));
    let nowhere = text(&dir.at("nix.ogg"));
    let output = ["--output", &png];
    let cases: [(&[&str], String); 14] = [
        (
            &["--audio", &music, "--output", &gif],
            format!(
                "--output {gif} has the extension .gif, which is no format of plots; name it .png \
                 or .svg"
            ),
        ),
        (
            &["--audio", &music, "--output", &folder],
            format!(
                "--output {folder} has no extension, which is no format of plots; name it .png or \
                 .svg"
            ),
        ),
        (
            &["--audio", &nowhere],
            format!(
                "{nowhere}: cannot be opened (No such file or directory (os error 2)); check that \
                 it is still there"
            ),
        ),
        (&["--audio", &folder], format!("{folder}: is a folder; name a file in it")),
        (
            &["--audio", &no_audio],
            format!(
                "{no_audio}: not audio: it starts with \"remember the milk\"; WAV, AIFF, FLAC, MP3, \
                 Ogg, MP4, AAC, CAF and AU are read, was another format saved under the name .wav?"
            ),
        ),
        (
            &["--audio", &music, "--panel", "mels"],
            "invalid value 'mels' for '--panel <PANEL>': panel \"mels\" is unknown; the panels are \
             mel, chroma, mfcc, rms, spectral_centroid, onset_strength"
                .to_owned(),
        ),
        (
            &["--audio", &music, "--width", "319"],
            "invalid value '319' for '--width <PX>': 319 is not in 320..=8192".to_owned(),
        ),
        (
            &["--audio", &music, "--start", "4.1"],
            "--start 4.1 is after the end of music_48k_stereo.ogg, whose last frame of 121 is at \
             4.00 s; begin earlier"
                .to_owned(),
        ),
        (
            &["--audio", &music, "--start", "-1"],
            "--start -1 is no time in a file; give seconds from 0 on".to_owned(),
        ),
        (
            &["--audio", &music, "--duration", "0"],
            "--duration 0 is not above 0; give a positive number of seconds".to_owned(),
        ),
        (
            &["--audio", &music, "--duration", "NaN"],
            "--duration NaN is not above 0; give a positive number of seconds".to_owned(),
        ),
        (
            &["--audio", &music, "--phrase", "a"],
            "--audio and --phrase a name two things to draw; give one of them".to_owned(),
        ),
        (
            &["--phrase", "a"],
            "--phrase a is a name in a store; say which with --store".to_owned(),
        ),
        (
            &["--store", &folder],
            "nothing to draw: give --audio FILE, or --store URL and --phrase ID".to_owned(),
        ),
    ];
    for (flags, expected) in cases {
        let flags =
            if flags.contains(&"--output") { flags.to_vec() } else { [flags, &output].concat() };
        assert_eq!(refusal(&flags), expected, "{flags:?}");
    }
    assert_eq!(std::fs::read_to_string(&older).expect("still there"), "an older picture");
    let below_a_file = text(&older.join("x.png"));
    let sentence = refusal(&["--audio", &music, "--output", &below_a_file]);
    assert!(sentence.starts_with(&format!("while writing {below_a_file}: ")), "{sentence}");
}

/// Ingests and extracts a store with songs, a phrase without audio and one that cannot be decoded.
fn store(dir: &Dir) -> String {
    let song = |name: &str| std::fs::read(golden(name)).expect("a golden file");
    for (id, frames) in [("song", 121), ("clicks", 31), ("mute", 31), ("broken", 120)] {
        let path = format!("source/motion/{id}/trajectory.npy");
        dir.write(path, trajectory(&coherent(frames, 1)));
    }
    dir.write("source/motion/refused/trajectory.npy", "no array");
    dir.write("source/audio/song.ogg", song("music_48k_stereo.ogg"));
    dir.write("source/audio/clicks.wav", wav(1.0));
    // A FLAC file that is whole by its header and damaged behind it.
    let mut flac = song("noise_with_gap.flac");
    let middle = flac.len() / 2;
    flac[middle..middle + 2000].fill(0x55);
    dir.write("source/audio/broken.flac", flac);
    let store = dir.at("store");
    let output = ingest(&dir.at("source"), &store, &[]);
    assert!(output.code <= 1, "{output:?}");
    let store = text(&store);
    let output = run(["extract", "--store", &store]);
    assert!(output.code <= 1, "{output:?}");
    store
}

#[test]
fn a_phrase_is_drawn_as_its_audio_file_is() {
    let dir = Dir::new();
    let store = store(&dir);
    let (from_file, from_store) = (dir.at("file.svg"), dir.at("store.svg"));
    drawn(&["--audio", &music(), "--output", &text(&from_file)]);
    let out = ["--output", &text(&from_store)];
    let summary = drawn(&[&["--store", &store, "--phrase", "song"], &out[..]].concat());
    assert_eq!(
        summary,
        format!("121 frames (4.03 s) → {} (1000 × 1287 px)\n", from_store.display())
    );
    let expected = svg(&from_file).replace(">music_48k_stereo.ogg<", ">song<");
    assert_eq!(svg(&from_store), expected);
    // A store in the environment does not stand in the way of a file.
    let mut command = motiongen();
    command.args(["plot", "features", "--audio", &music()]).args(out);
    let output = finish(command.env("MOTIONGEN_STORE", &store));
    assert_eq!(output.code, 0, "{output:?}");
}

#[test]
fn a_phrase_without_features_is_told_why() {
    let dir = Dir::new();
    let store = store(&dir);
    let ask = |store: &str, phrase: &str, more: &[&str]| {
        let flags = ["--store", store, "--phrase", phrase, "--output", "x.png"];
        refusal(&[&flags[..], more].concat())
    };
    assert_eq!(
        ask(&store, "songs", &[]),
        format!("store {store} has no phrase \"songs\"; nearest: song, clicks")
    );
    assert_eq!(
        ask(&store, "mute", &[]),
        format!(
            "store {store}: phrase \"mute\" has neither audio nor a feature file, so there are no \
             features to draw; ingest it with its audio, then run extract"
        )
    );
    let broken = ask(&store, "broken", &[]);
    let start =
        format!("store {store} has no features of phrase \"broken\", since extract failed on it: ");
    assert!(broken.starts_with(&start) && broken.contains("audio/broken.flac: "), "{broken}");
    let refused = ask(&store, "refused", &[]);
    let start =
        format!("store {store} has no features of phrase \"refused\", since ingest failed on it: ");
    assert!(refused.starts_with(&start), "{refused}");
    let tuned = ask(&store, "clicks", &["--tuning", "0.33"]);
    let start = format!("store {store} has the features of phrase \"clicks\" with tuning ");
    assert!(tuned.starts_with(&start), "{tuned}");
    let end = ", not with --tuning 0.33; leave the flag out, or draw the audio file itself with \
               --audio";
    assert!(tuned.ends_with(end), "{tuned}");

    let nothing = text(&dir.at("nothing"));
    let extract_first = |store: &str| {
        format!(
            "store {store} has no features of phrase \"song\"; run motiongen extract --store \
             {store} first"
        )
    };
    assert_eq!(ask(&nothing, "song", &[]), extract_first(&nothing));
    let ingested = text(&dir.at("ingested"));
    ingest(&dir.at("source"), &dir.at("ingested"), &[]);
    assert_eq!(ask(&ingested, "song", &[]), extract_first(&ingested));
}

#[test]
fn values_come_from_the_environment_and_from_tables_for_the_stage_and_the_kind() {
    let dir = Dir::new();
    let picture = text(&dir.at("a.png"));
    let config = "width = 900\nquiet = true\nmax-retries = 3\n[ingest]\nlimits = 3\n[plot]\n\
                  panel = [\"rms\", \"mfcc\"]\nstart = 1\n[plot.features]\nwidth = 400\n";
    let config = text(&dir.write("all.toml", config));
    let command = |flags: &[&str]| {
        let mut command = motiongen();
        command.args(["plot", "--config", &config, "features", "--audio", &music()]);
        command.args(["--output", &picture]).args(flags);
        command
    };
    for (flags, variable, expected) in [
        (&[][..], None, "91 frames (3.03 s)"),
        (&["--start", "2"], Some("3"), "61 frames (2.03 s)"),
        (&[], Some("3"), "31 frames (1.03 s)"),
    ] {
        let mut command = command(flags);
        if let Some(start) = variable {
            command.env("MOTIONGEN_START", start);
        }
        let output = finish(&mut command);
        assert_eq!(output.code, 0, "{output:?}");
        assert_eq!(output.stdout, format!("{expected} → {picture} (800 × 910 px)\n"));
    }
    for (table, key) in [("plot.features", "widht"), ("plot", "widht"), ("plot", "feature")] {
        let wrong = dir.write("wrong.toml", format!("[{table}]\n{key} = 400\n"));
        let flags = ["--config", &text(&wrong), "--audio", &music(), "--output", &picture];
        let start =
            format!("configuration {}: [{table}] has no key \"{key}\"; nearest: ", wrong.display());
        let sentence = refusal(&flags);
        assert!(sentence.starts_with(&start), "{sentence}");
        assert!(sentence.contains(" knows ") && sentence.contains("panel, start"), "{sentence}");
    }
}

#[test]
fn help_lists_the_kinds_and_what_each_takes() {
    let output = run(["plot", "--help"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("Usage: motiongen plot [OPTIONS] <KIND>"), "{}", output.stdout);
    let output = run(["plot", "features", "--help-all"]);
    let wanted =
        ["MOTIONGEN_PANEL", "MOTIONGEN_VERBOSE", "[plot.features]", "Writes: an image file"];
    let found = wanted.map(|text| output.stdout.contains(text));
    assert_eq!(found, [true, false, true, true], "{}", output.stdout);
    assert_eq!(plots::plot("features", &[]).code, 2);
    assert_eq!(run(["plot"]).code, 2);
}

/// Commits frames of items, each filled with its own number.
fn commit_frames(store: &Location, params: &str, items: &[(&str, usize, f32)]) {
    let ledger = Ledger::read(store, "extract").expect("commits");
    let mut commit = Commit::new(store, "extract", params, "phrases");
    for &(id, n_frames, value) in items {
        let mut frames = Array2::from_elem((n_frames, 163), value);
        frames.column_mut(162).iter_mut().enumerate().for_each(|(t, x)| *x = t as f32);
        let part = commit.part(tables::FEATURES, tables::features).expect("a part");
        part.write_frames(id, frames.view()).expect("frames");
        let (fingerprint, input_hash) = (String::new(), format!("{params} {id}"));
        commit.settle(Item { id: id.to_owned(), fingerprint, input_hash, failure: None }, &ledger);
    }
    commit.publish().expect("published");
}

#[test]
fn an_items_frames_are_found_among_others_and_the_latest_count() {
    let dir = Dir::new();
    let long = "a name that is longer than what statistics keep of names, by some letters more";
    let places = [
        Location::local(&dir.at("store")).expect("a folder"),
        Location::open("memory://plot-features/store", &Default::default()).expect("a bucket"),
    ];
    for store in places {
        // More than a row group, so that items are in several.
        commit_frames(&store, "first", &[("a", 40_000, 1.0), (long, 40_000, 2.0), ("b", 7, 3.0)]);
        commit_frames(&store, "second", &[("b", 9, 4.0), ("c", 70_000, 5.0)]);
        for (id, expected) in [
            ("a", Some((40_000, 1.0))),
            (long, Some((40_000, 2.0))),
            ("b", Some((9, 4.0))),
            ("c", Some((70_000, 5.0))),
            ("", None),
            ("aa", None),
            (&long[..70], None),
            ("z", None),
        ] {
            let found = ItemTables::take(&store, id).expect("commits");
            let frames = found.frames(tables::features()).expect("parts");
            let summary = frames.as_ref().map(|f| (f.nrows(), f[[f.nrows() - 1, 0]]));
            assert_eq!(summary, expected, "{id:?} in {store}");
            if let Some(frames) = frames {
                assert!(frames.column(162).iter().enumerate().all(|(t, &x)| x == t as f32));
                assert_eq!(frames.ncols(), 163);
            }
            assert_eq!(found.rows::<ExtractionRow>().expect("no parts"), []);
        }
    }
    assert_eq!(ExtractionRow::schema().sorted_by, ["phrase_id"]);
}
