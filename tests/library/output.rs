//! `--output`: the same phrases as files, which ingest reads.

use std::collections::BTreeSet;

use motiongen::motion::Beats;

use super::{bytes, constructed, from, library, write_captures, write_songs};
use crate::extract::features;
use crate::support::{Dir, finish, ingest, motion, motiongen, phrases};

#[test]
fn files_come_back_through_ingest_as_they_went() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    let (store, again, files) = (dir.at("store"), dir.at("again"), dir.at("files"));
    let path = files.to_str().unwrap().to_owned();
    let flags = from(&songs, &captures, &["--takes", "1", "--output", &path]);
    let output = library(&store, &flags);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains(&format!("\n  files: {path}\n")), "{}", output.stdout);

    let output = ingest(&files, &again, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.contains("  10 ingested (40.0 s of music or motion, 1200 motion frames)")
    );
    assert!(
        output
            .stdout
            .contains("  2 files belong to no phrase and were left alone, such as README.txt")
    );
    assert_eq!(finish(motiongen().args(["extract", "--store"]).arg(&again)).code, 0);
    assert!(motion(&again) == motion(&store), "motion differs");
    assert!(features(&again) == features(&store), "features differ");
    let made = constructed(&store);
    for (id, row) in phrases(&again) {
        let made = &made[&id];
        assert_eq!((row.n_frames, row.n_feature_frames), (Some(120), Some(120)));
        assert_eq!(row.beats_per_bar, made.beats_per_bar, "{id}");
        // Beat times were rounded to nanoseconds.
        let bpm = (row.tempo_bpm.unwrap(), made.tempo_bpm.unwrap());
        assert!((bpm.0 - bpm.1).abs() < 1e-4 * bpm.1 || id.starts_with("tracked"), "{id}: {bpm:?}");
        // Numbered beats fit the phase of the motion.
        let list = std::fs::read_to_string(files.join(format!("beats/{id}.beats.txt"))).unwrap();
        let beats = Beats::parse(&list).unwrap();
        let numbers = beats.numbers().unwrap();
        let frames = &motion(&store)[&id];
        for (time_s, number) in beats.times_s().iter().zip(numbers) {
            let frame = (time_s * 30.0).ceil() as usize;
            let Some(frame) = frames.get(frame) else { continue };
            let bars = f64::from(made.beats_per_bar.unwrap());
            let since = (f64::from(frame[16]) - (*number - 1) as f64 / bars).rem_euclid(1.0);
            // Up to a frame after the beat: a thirtieth of a second of a beat of 0.4 s or more.
            assert!(
                since < 0.09 / bars || since > 1.0 - 1e-5,
                "{id}: {number} at {time_s}: {since}"
            );
        }
    }
    let table = std::fs::read_to_string(files.join("splits.tsv")).unwrap();
    let lines: BTreeSet<String> = table.lines().skip(1).map(str::to_owned).collect();
    let song = |id: &str| match id.split_once(".t").unwrap().0 {
        "marches-one.wav" => "marches/one.wav".to_owned(),
        song => song.to_owned(),
    };
    let line = |(id, row): (&String, &_)| {
        let row: &motiongen::store::tables::PhraseRow = row;
        format!("{id}\t{}\t{}", row.split, song(id))
    };
    assert_eq!(lines, made.iter().map(line).collect());
    let readme = std::fs::read_to_string(files.join("README.txt")).unwrap();
    assert!(readme.starts_with("These phrases are constructed, not captured"), "{readme}");

    // The store has everything already; the files are written all the same, byte for byte.
    let before = bytes(&files);
    std::fs::remove_dir_all(&files).unwrap();
    let output = library(&store, &flags);
    assert!(output.stdout.contains("  0 songs danced to (0 phrases), 3 up to date"), "{output:?}");
    assert!(bytes(&files) == before, "files differ");
}

#[test]
fn a_folder_that_cannot_be_made_is_said_at_once() {
    let dir = Dir::new();
    let (songs, captures) = (write_songs(&dir), write_captures(&dir));
    dir.write("file", "in the way");
    let path = dir.at("file/out");
    let flags = from(&songs, &captures, &["--output", path.to_str().unwrap()]);
    let output = library(&dir.at("store"), &flags);
    assert_eq!(output.code, 2);
    let start = format!("error: while making {}: ", path.display());
    assert!(output.stderr.starts_with(&start), "{}", output.stderr);
}
