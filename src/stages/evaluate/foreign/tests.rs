use ndarray::{Array2, s};

use super::*;
use crate::motion::{CHANNEL_NAMES, Channel, MOTION_DIM, exchange, npy};
use crate::store::{PartWriter, parquet_of, tables};

/// A folder of motions.
struct Bench(tempfile::TempDir);

impl Bench {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("a folder"))
    }

    fn dir(&self) -> &Path {
        self.0.path()
    }

    fn put(&self, name: &str, bytes: impl AsRef<[u8]>) -> String {
        let path = self.dir().join(name);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("made");
        std::fs::write(&path, bytes).expect("written");
        path.display().to_string()
    }

    fn read(&self, phrases: &[ForeignPhrase]) -> ForeignMotions {
        read(self.dir(), phrases).expect("motions")
    }

    /// Reads the only motion, which is for phrase `a`.
    fn only(&self) -> Result<ForeignMotion, Failure> {
        let found = self.read(&[phrase("a")]);
        assert_eq!((found.files.len(), found.failures.len()), (1, 0), "{found:?}");
        found.files[0].read()
    }

    /// Writes one file, and returns why it holds no motion, without its place.
    fn refused(name: &str, bytes: &[u8]) -> (FailureKind, String) {
        let bench = Self::new();
        let place = bench.put(name, bytes);
        let failure = bench.only().expect_err("no motion");
        assert_eq!(failure.path, place);
        let message = failure.message.strip_prefix(&place).expect("the file's name");
        (failure.kind, message.to_owned())
    }
}

fn phrase(id: &str) -> ForeignPhrase<'_> {
    ForeignPhrase { id, url: "", n_frames: None }
}

/// Motion whose values are all different.
fn ramp(n: usize) -> Array2<f32> {
    Array2::from_shape_fn((n, MOTION_DIM), |(t, i)| t as f32 - 0.25 * i as f32)
}

fn npy_of(frames: &Array2<f32>) -> Vec<u8> {
    npy::write(frames.shape(), frames.as_slice().expect("in order"))
}

fn csv_of(frames: &Array2<f32>) -> Vec<u8> {
    let mut bytes = Vec::new();
    exchange::write_csv(frames.view(), &mut bytes).expect("memory");
    bytes
}

/// As generate writes it.
fn part_of(frames: &Array2<f32>) -> Vec<u8> {
    let file = tempfile::NamedTempFile::new().expect("a file");
    let mut writer = PartWriter::new(tables::motion(), file).expect("a part");
    writer.write_frames("a", frames.view()).expect("written");
    let file = writer.finish(&[]).expect("finished").file;
    std::fs::read(file.path()).expect("the file")
}

/// Positions (0.1 t², 1, −0.2 t) and turns of 0.05 rad a frame about the vertical, \[n, 7\].
fn poses(n: usize) -> Array2<f64> {
    let mut poses = Array2::zeros((n, 7));
    for (t, mut row) in poses.rows_mut().into_iter().enumerate() {
        let half = 0.025 * t as f64;
        let values = [0.1 * (t * t) as f64, 1.0, -0.2 * t as f64, half.cos(), 0.0, half.sin(), 0.0];
        row.assign(&ndarray::Array1::from(values.to_vec()));
    }
    poses
}

#[test]
fn all_channels_are_read_as_they_are_from_three_formats() {
    let mut frames = ramp(7);
    // What is not finite stays, for the checks to judge.
    (frames[[3, 5]], frames[[4, 6]]) = (f32::NAN, f32::NEG_INFINITY);
    for (name, bytes) in
        [("a.npy", npy_of(&frames)), ("a.CSV", csv_of(&frames)), ("a.parquet", part_of(&frames))]
    {
        let bench = Bench::new();
        bench.put(name, bytes);
        let motion = bench.only().expect("a motion");
        let bits = |frames: &Array2<f32>| frames.mapv(|x| if x.is_nan() { 1 } else { x.to_bits() });
        assert_eq!(bits(&motion.frames), bits(&frames), "{name}");
        assert_eq!((motion.content, motion.has_phase), (FileContent::Channels, true));
        assert_eq!((motion.phrase_id.as_str(), motion.sample, motion.note), ("a", 0, None));
        assert_eq!(motion.content.derived(), None);
    }
}

#[test]
fn poses_of_double_precision_give_all_channels() {
    let bench = Bench::new();
    let mut wanted = poses(9);
    // The sign of a quaternion says nothing of how a body is turned, and stays as it was.
    wanted.slice_mut(s![4, 3..]).mapv_inplace(|x| -x);
    let values: Vec<f64> = wanted.iter().copied().collect();
    bench.put("a.npy", npy::write(&[9, 7], &values));
    let ForeignMotion { frames, content, has_phase, .. } = bench.only().expect("a motion");
    assert_eq!((frames.dim(), content, has_phase), ((9, MOTION_DIM), FileContent::Poses, false));
    let pose = frames.slice(s![.., 9..13]);
    assert_eq!(pose[[4, 0]], wanted[[4, 3]] as f32);
    // Δ(0.1 t²) = 0.1 (2t + 1), Δ² = 0.2, at 30 fps; single precision of values up to 180.
    assert!((frames[[3, 3]] - 21.0).abs() < 1e-3, "{}", frames[[3, 3]]);
    assert!((frames[[3, 5]] + 6.0).abs() < 1e-3, "{}", frames[[3, 5]]);
    assert!((frames[[5, 6]] - 180.0).abs() < 1e-2, "{}", frames[[5, 6]]);
    // 0.05 rad a frame, across the change of sign as well; f32 of half angles.
    assert!(frames.column(14).iter().all(|w| (w - 1.5).abs() < 1e-4), "{}", frames.column(14));
    assert!(frames.slice(s![.., 16..]).iter().all(|x| *x == 0.0));
    assert_eq!(
        content.derived(),
        Some(
            "velocity, acceleration and angular velocity are derived from its poses, phase and style are 0"
        )
    );
    // A pose that is not finite spoils what follows from it, and nothing else.
    let mut broken = wanted.mapv(|x| x as f32);
    broken[[2, 0]] = f32::NAN;
    bench.put("a.npy", npy_of(&broken));
    let frames = bench.only().expect("a motion").frames;
    assert!(frames[[2, 0]].is_nan() && frames[[1, 3]].is_nan() && frames[[4, 3]].is_finite());
}

#[test]
fn a_table_is_read_by_the_names_of_its_columns() {
    let poses = poses(6);
    let names = Channel::Position.range().chain(Channel::Quaternion.range());
    let mut columns: Vec<(&str, Vec<f64>)> =
        names.zip(poses.columns()).map(|(i, x)| (CHANNEL_NAMES[i], x.to_vec())).collect();
    // The order of columns means nothing, and what is no channel is left alone.
    columns.reverse();
    columns.push(("loss", vec![0.0; 6]));
    let bench = Bench::new();
    bench.put("a.parquet", parquet_of(&columns));
    let motion = bench.only().expect("a motion");
    std::fs::remove_file(bench.dir().join("a.parquet")).expect("removed");
    let values: Vec<f64> = poses.iter().copied().collect();
    bench.put("a.npy", npy::write(&[6, 7], &values));
    assert_eq!(motion.frames, bench.only().expect("a motion").frames);
    assert_eq!(motion.content, FileContent::Poses);

    let refused = |columns: &[(&str, Vec<f64>)]| {
        let (kind, message) = Bench::refused("a.parquet", &parquet_of(columns));
        assert_eq!(kind, FailureKind::ParquetFormat);
        message
    };
    columns.push(("frame", vec![3.0, 4.0, 5.0, 0.0, 1.0, 2.0]));
    assert_eq!(
        refused(&columns),
        ": has frame 0 in row 3, where frame 6 should be; write one motion into a file, sorted by frame"
    );
    let all = |but: &[usize]| -> Vec<(&str, Vec<f64>)> {
        let kept = (0..MOTION_DIM).filter(|i| !but.contains(i));
        kept.map(|i| (CHANNEL_NAMES[i], vec![0.5; 2])).collect()
    };
    assert_eq!(
        refused(&all(&[4, 16])),
        ": lacks columns velocity_y, phase; write all 25 channels, or positions and quaternions alone"
    );
    assert!(refused(&[("x", vec![1.0])]).starts_with(": lacks columns position_x, position_y, "));
    let empty: Vec<(&str, Vec<f64>)> = CHANNEL_NAMES.map(|name| (name, Vec::new())).to_vec();
    let no_frames = ": has no frames; write it again".to_owned();
    assert_eq!(Bench::refused("a.parquet", &parquet_of(&empty)), (FailureKind::Shape, no_frames));
}

#[test]
fn a_capture_is_read_as_ingest_reads_it() {
    let bench = Bench::new();
    let mut frames = ramp(40);
    for (mut row, pose) in frames.rows_mut().into_iter().zip(poses(40).rows()) {
        for (i, x) in Channel::Position.range().chain(Channel::Quaternion.range()).zip(pose) {
            row[i] = *x as f32 * if i < 3 { 0.01 } else { 1.0 };
        }
    }
    let mut bytes = Vec::new();
    exchange::write_bvh(frames.view(), &mut bytes).expect("memory");
    bench.put("a.bvh", &bytes);
    let motion = bench.only().expect("a motion");
    let ingested =
        crate::stages::ingest::read_bvh("a.bvh", &bytes, None, None).expect("a capture").trajectory;
    assert_eq!(motion.frames, ingested.into_array());
    assert_eq!((motion.content, motion.has_phase), (FileContent::Capture, false));
    assert!(motion.frames.column(16).iter().all(|phase| *phase == 0.0));
    assert!(
        motion.content.derived().is_some_and(|told| told.starts_with("it is a motion capture"))
    );
}

/// Returns the phrase and sample that a file of each name is for, by the file's name.
fn matched(names: &[&str], phrases: &[ForeignPhrase]) -> BTreeMap<String, (String, usize)> {
    let bench = Bench::new();
    for name in names {
        bench.put(name, "x");
    }
    let found = bench.read(phrases);
    let to_entry = |file: &ForeignFile| {
        let below = file.path.strip_prefix(bench.dir()).expect("below").display().to_string();
        (below, (file.phrase_id.clone(), file.sample))
    };
    found.files.iter().map(to_entry).collect()
}

#[test]
fn files_belong_to_phrases_by_their_names() {
    let phrases = [
        phrase("gunroar/gr2.ogg"),
        phrase("gunroar/gr3.ogg"),
        phrase("other/gr3.ogg"),
        phrase("gBR_d04_ch01"),
        phrase("song.t1.2"),
        phrase("song"),
        phrase("x/0"),
        ForeignPhrase { url: "file:///music/deep/Tune.flac", ..phrase("tune of June") },
    ];
    let cases = [
        // The name, with and without the extension of the audio.
        ("gunroar/gr3.ogg.npy", "gunroar/gr3.ogg", 0),
        ("other/gr3.csv", "other/gr3.ogg", 0),
        ("gBR_d04_ch01.bvh", "gBR_d04_ch01", 0),
        // Numbered samples; a constructed phrase ends in a number itself.
        ("gunroar/gr3.1.npy", "gunroar/gr3.ogg", 1),
        ("gunroar/gr3.ogg.2.npy", "gunroar/gr3.ogg", 2),
        ("gunroar/gr3/03.npy", "gunroar/gr3.ogg", 3),
        ("song.t1.2.npy", "song.t1.2", 0),
        ("song.t1.2.7.npy", "song.t1.2", 7),
        // Not the phrase x/0.
        ("song/0.npy", "song", 0),
        // Alone among the phrases.
        ("gr2.npy", "gunroar/gr2.ogg", 0),
        ("results/gr2.5.npy", "gunroar/gr2.ogg", 5),
        ("Tune.npy", "tune of June", 0),
        ("Tune/4.npy", "tune of June", 4),
    ];
    let names: Vec<&str> = cases.iter().map(|case| case.0).collect();
    let expected: BTreeMap<String, (String, usize)> = cases
        .iter()
        .map(|(name, phrase, sample)| ((*name).to_owned(), ((*phrase).to_owned(), *sample)))
        .collect();
    assert_eq!(matched(&names, &phrases), expected);
    // Two phrases have the name, none has it, the number is none, and an underscore is part of a name.
    let unknown = ["gr3.npy", "nobody.npy", "song.-1.npy", "song.1234567890.npy", "song_1.npy"];
    assert_eq!(matched(&unknown, &phrases), BTreeMap::new());
    // The audio extension is left out in favour of a phrase that is called so.
    let phrases = [phrase("a.ogg"), phrase("a")];
    assert_eq!(matched(&["a.npy"], &phrases)["a.npy"], ("a".to_owned(), 0));
}

#[test]
fn what_matches_nothing_or_comes_twice_is_told() {
    let bench = Bench::new();
    let places: Vec<String> = ["song.0.npy", "song.csv", "song/1.npy", "zong 2.npy"]
        .iter()
        .map(|name| bench.put(name, npy_of(&ramp(3))))
        .collect();
    bench.put("readme.txt", "");
    bench.put(".hidden.npy", "");
    let found = bench.read(&[phrase("song"), phrase("other song")]);
    let files: Vec<(&str, usize)> =
        found.files.iter().map(|file| (file.phrase_id.as_str(), file.sample)).collect();
    assert_eq!((files, found.n_others), (vec![("song", 0), ("song", 1)], 1));
    let told: Vec<(FailureKind, &str)> = found
        .failures
        .iter()
        .map(|(_, failure)| (failure.kind, failure.message.as_str()))
        .collect();
    let twice = format!(
        "{}: is a second motion for sample 0 of phrase song, beside {}; remove one of them, or number them \
         song.0, song.1 and so on",
        places[1], places[0]
    );
    let unknown = format!(
        "{}: is named after no phrase of the store; nearest: song, other song; name it PHRASE.npy, or \
         PHRASE.0.npy, PHRASE.1.npy and so on for several motions of one phrase",
        places[3]
    );
    let expected =
        [(FailureKind::DuplicateId, twice.as_str()), (FailureKind::Name, unknown.as_str())];
    assert_eq!(told, expected);
    assert_eq!(found.failures[1].0, PathBuf::from(&places[3]));
}

#[test]
fn a_folder_without_motions_is_refused() {
    let bench = Bench::new();
    let place = bench.dir().display().to_string();
    let said = |dir: &Path| read(dir, &[phrase("a")]).expect_err("no motions").to_string();
    assert_eq!(
        said(bench.dir()),
        format!(
            "--motions {place} has no motion files; put .npy, .csv, .bvh or .parquet files in it, named \
             after the store's phrases"
        )
    );
    let file = bench.put("a.npy", "");
    assert_eq!(
        said(Path::new(&file)),
        format!("--motions {file} is no folder; name the folder with a motion file for each song")
    );
}

#[test]
fn files_that_hold_no_motion_are_told_and_the_others_are_read() {
    let bench = Bench::new();
    bench.put("a.0.npy", npy_of(&ramp(3)));
    bench.put("a.1.npy", "no array");
    bench.put("a.2.csv", csv_of(&ramp(5)));
    let gone = bench.put("a.3.npy", npy_of(&ramp(3)));
    let mut found = bench.read(&[phrase("a")]);
    std::fs::remove_file(&gone).expect("removed");
    let (mut read, mut kinds) = (Vec::new(), Vec::new());
    for file in &found.files {
        match file.read() {
            Ok(motion) => read.push((motion.sample, motion.frames.nrows())),
            Err(failure) => kinds.push(failure.kind),
        }
    }
    assert_eq!(read, [(0, 3), (2, 5)]);
    assert_eq!(kinds, [FailureKind::NpyFormat, FailureKind::Unreadable]);
    found.keep(2);
    assert_eq!(found.files.len(), 2);
    assert!(found.files[0].sample < found.files[1].sample);
}

#[test]
fn a_motion_much_longer_or_shorter_than_its_music_has_a_note() {
    let note = |n_frames: usize, n_music: Option<usize>| {
        let bench = Bench::new();
        let place = bench.put("a.npy", npy_of(&ramp(n_frames)));
        let found = bench.read(&[ForeignPhrase { n_frames: n_music, ..phrase("a") }]);
        let note = found.files[0].read().expect("a motion").note?;
        Some(note.strip_prefix(&place).expect("the file's name").to_owned())
    };
    assert_eq!(note(11, Some(100)).as_deref(), Some(": has 11 frames, and the music of a has 100"));
    assert_eq!(
        note(111, Some(100)).as_deref(),
        Some(": has 111 frames, and the music of a has 100")
    );
    for n_frames in [90, 110] {
        assert_eq!(note(n_frames, Some(100)), None);
    }
    assert_eq!(note(11, None), None);
}

#[test]
fn bad_files_are_refused_with_what_is_wrong() {
    let refused = Bench::refused;
    for name in ["a.npy", "a.csv", "a.bvh", "a.parquet"] {
        let empty = ": is empty; write the motion again".to_owned();
        assert_eq!(refused(name, b""), (FailureKind::EmptyFile, empty));
    }
    let shape = |shape: &str, hint: &str| {
        let message = format!(
            ": has shape {shape}, expected [frames, 25], or [frames, 7] of position and quaternion (w, x, y, \
             z), or [dancers, frames, 25] of a group of 2 to 16{hint}"
        );
        (FailureKind::Shape, message)
    };
    let npy_of = |shape: &[usize]| npy::write(shape, &vec![0.5_f32; shape.iter().product()]);
    assert_eq!(refused("a.npy", &npy_of(&[3, 24])), shape("[3, 24]", ""));
    assert_eq!(refused("a.npy", &npy_of(&[25, 3])), shape("[25, 3]", "; transpose it"));
    assert_eq!(refused("a.npy", &npy_of(&[0, 25])), shape("[0, 25]", ""));
    assert_eq!(refused("a.npy", &npy_of(&[1, 3, 25])), shape("[1, 3, 25]", ""));
    assert_eq!(refused("a.npy", &npy_of(&[])), shape("[]", ""));

    let header = exchange::csv_header();
    let no_frames = ": has no frames; write it again".to_owned();
    assert_eq!(refused("a.csv", header.as_bytes()), (FailureKind::Shape, no_frames));
    assert_eq!(
        refused("a.csv", b"x,y\n1,2\n"),
        (
            FailureKind::CsvFormat,
            ": csv line 1 has 2 values, expected 27; write frame, time and 25 channels with commas between \
             them"
                .to_owned()
        )
    );
    assert_eq!(
        refused("a.csv", b"\xff\xfe"),
        (FailureKind::CsvFormat, ": is not UTF-8 text; write it as CSV again".to_owned())
    );
    assert_eq!(refused("a.bvh", b"MOTION").0, FailureKind::BvhFormat);

    let (kind, message) = refused("a.parquet", b"PAR1 and nothing else");
    assert_eq!(kind, FailureKind::ParquetFormat);
    assert!(
        message.starts_with(": is no readable Parquet file (")
            && message.ends_with("); write it again"),
        "{message}"
    );
}

/// Bytes of every format, changed at random: a failure or a motion, never an end of the program.
#[test]
fn no_bytes_break_the_reader() {
    let frames = ramp(5);
    let mut bvh = Vec::new();
    let mut poses = frames.clone();
    poses.slice_mut(s![.., 9..13]).fill(0.5);
    exchange::write_bvh(poses.view(), &mut bvh).expect("memory");
    let originals = [
        ("a.npy", npy_of(&frames)),
        ("a.csv", csv_of(&frames)),
        ("a.bvh", bvh),
        ("a.parquet", part_of(&frames)),
    ];
    let mut chance = 1_u64;
    let mut next = move |n: usize| {
        chance =
            chance.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (chance >> 33) as usize % n
    };
    for (name, bytes) in originals {
        let bench = Bench::new();
        let mut n_refused = 0;
        for _ in 0..150 {
            let mut broken = bytes.clone();
            for _ in 0..=next(4) {
                let at = next(broken.len());
                broken[at] = next(256) as u8;
            }
            if next(3) == 0 {
                broken.truncate(next(bytes.len()));
            }
            bench.put(name, broken);
            n_refused += usize::from(bench.only().is_err());
        }
        assert!(n_refused > 20, "{name}: {n_refused} of 150 were refused");
    }
}
