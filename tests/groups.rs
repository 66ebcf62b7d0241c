//! Groups of dancers from files to tables, beside soloists, and who reads them.

use std::num::NonZeroUsize;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::exchange::write_bvh;
use motiongen::motion::npy::write;
use motiongen::store::{ItemTables, Location, Patience, tables};
use motiongen::training::{Dataset, DatasetError, DatasetOptions, Ensemble, Split};
use ndarray::{Array2, Array3, Axis, s};
use zip::CompressionMethod::Stored;

use crate::support::files::{coherent, features_npz, npz, trajectory};
use crate::support::{Dir, failures, ingest, phrases, run};

/// Frames of dancers that stand 1.5 m apart, `[N, T, 25]`.
fn group(n_dancers: usize, n_frames: usize) -> Array3<f32> {
    let mut frames = Array3::zeros((n_dancers, n_frames, MOTION_DIM));
    for (dancer, mut of_dancer) in frames.outer_iter_mut().enumerate() {
        let values = coherent(n_frames, dancer as u32 + 1);
        of_dancer.assign(&Array2::from_shape_fn((n_frames, MOTION_DIM), |(t, i)| values[t][i]));
        of_dancer.slice_mut(s![.., 0]).mapv_inplace(|x| x + 1.5 * dancer as f32);
    }
    frames
}

fn npy(frames: &Array3<f32>) -> Vec<u8> {
    let shape = [frames.len_of(Axis(0)), frames.len_of(Axis(1)), frames.len_of(Axis(2))];
    write(&shape, frames.as_slice().expect("in order"))
}

fn csv(dir: &Dir, sql: &str) -> String {
    let store = dir.at("store").display().to_string();
    let output = run(["query", "--store", &store, "--format", "csv", sql]);
    assert_eq!(output.code, 0, "{output:?}");
    output.stdout
}

fn stored(dir: &Dir, phrase: &str) -> Array3<f32> {
    let store = Location::local(&dir.at("store")).expect("a folder");
    let item = ItemTables::take(&store, phrase).expect("an item");
    item.group(tables::motion()).expect("frames").expect("some")
}

#[test]
fn groups_and_soloists_are_told_apart_by_dancer() {
    let dir = Dir::new();
    let (four, pair, trio) = (group(4, 23), group(2, 31), group(3, 17));
    dir.write("source/motion/four/trajectory.npy", npy(&four));
    dir.write("source/motion/solo/trajectory.npy", trajectory(&coherent(29, 9)));
    dir.write("source/motion/one/trajectory.npy", npy(&group(1, 19)));
    for (dancer, frames) in trio.outer_iter().enumerate() {
        let bytes = npy(&frames.to_owned().insert_axis(Axis(0)));
        // A file for each dancer is a soloist's; the second is a frame longer.
        let n = 17 + usize::from(dancer == 1);
        let longer = trajectory(&coherent(n, dancer as u32 + 1));
        let name = format!("source/motion/trio/dancer_{dancer}.npy");
        dir.write(name, if dancer == 1 { longer } else { solo_of(&bytes, n) });
    }
    for (dancer, frames) in pair.outer_iter().enumerate() {
        let mut bvh = Vec::new();
        write_bvh(frames, &mut bvh).expect("written");
        dir.write(format!("source/motion/pair/dancer_{dancer}.bvh"), bvh);
    }
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let n_frames = 4 * 23 + 29 + 19 + 3 * 17 + 2 * 29;
    let expected = format!("{n_frames} motion frames, 3 groups of dancers)");
    assert!(output.stdout.contains(&expected), "{}", output.stdout);

    assert_eq!(
        csv(&dir, "select dancer, count(*) n from motion group by dancer order by dancer"),
        format!(
            "dancer,n\n0,{}\n1,{}\n2,{}\n3,23\n",
            23 + 29 + 19 + 17 + 29,
            23 + 17 + 29,
            23 + 17
        )
    );
    assert_eq!(
        csv(&dir, "select phrase_id, n_dancers, n_frames from phrases order by phrase_id"),
        "phrase_id,n_dancers,n_frames\nfour,4,23\none,1,19\npair,2,29\nsolo,1,29\ntrio,3,17\n"
    );
    assert_eq!(stored(&dir, "four"), four);
    assert_eq!(stored(&dir, "one"), group(1, 19));
    // What this program wrote stays where it is, so that the pair stands as it stood.
    let found = stored(&dir, "pair");
    assert_eq!(found.dim(), (2, 29, MOTION_DIM));
    for (found, written) in found.iter().zip(pair.slice(s![.., ..29, ..]).iter()).take(3) {
        assert!((found - written).abs() < 1e-3, "{found} {written}");
    }
    let apart = |frames: &Array3<f32>| frames[[1, 7, 0]] - frames[[0, 7, 0]];
    assert!((apart(&found) - apart(&pair)).abs() < 1e-3);

    let again = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert!(again.stdout.contains("nothing to do: 5 phrases are up to date"), "{}", again.stdout);
    // Another order of dancers is another phrase.
    let before = phrases(&dir.at("store"))["trio"].content_hash.clone();
    let [a, b] = [0, 2].map(|i| dir.at(format!("source/motion/trio/dancer_{i}.npy")));
    let first = std::fs::read(&a).expect("a file");
    std::fs::copy(&b, &a).expect("copied");
    std::fs::write(&b, first).expect("written");
    let output = ingest(&dir.at("source"), &dir.at("store"), &["--verify"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_ne!(phrases(&dir.at("store"))["trio"].content_hash, before);
}

/// Returns the `.npy` of the only dancer of a group as `[T, 25]`.
fn solo_of(bytes: &[u8], n_frames: usize) -> Vec<u8> {
    let array = motiongen::motion::npy::read_f32(bytes).expect("an array");
    write(&[n_frames, MOTION_DIM], &array.values)
}

#[test]
fn the_public_group_set_is_read_with_its_formation() {
    let dir = Dir::new();
    let (n_dancers, n_frames) = (3, 61);
    let place = |dancer: usize, t: usize| [dancer as f32 * 1.25 - 3.0, 1.1, 0.01 * t as f32];
    let all = || (0..n_dancers).flat_map(|d| (0..n_frames).map(move |t| (d, t)));
    let trans: Vec<f32> = all().flat_map(|(d, t)| place(d, t)).collect();
    let poses = vec![0.0_f32; n_dancers * n_frames * 72];
    let bytes = npz(
        &[
            ("smpl_poses", write(&[n_dancers, n_frames, 72], &poses)),
            ("root_trans", write(&[n_dancers, n_frames, 3], &trans)),
        ],
        Stored,
    );
    dir.write("source/motion/gdance/motion.npz", bytes);
    let rotations: Vec<f32> = all().flat_map(|_| [1.0, 0.0, 0.0, 0.0]).collect();
    let bytes = npz(
        &[
            ("positions", write(&[n_dancers, n_frames, 3], &trans)),
            ("rotations", write(&[n_dancers, n_frames, 4], &rotations)),
        ],
        Stored,
    );
    dir.write("source/motion/positions/motion.npz", bytes);
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let rows = phrases(&dir.at("store"));
    for (id, height) in [("gdance", 1.1 - 0.223_333_82), ("positions", 1.1)] {
        let row = &rows[id];
        assert_eq!((row.n_dancers, row.n_frames), (Some(3), Some(59)));
        assert_eq!(row.motion_format.as_deref(), Some(id));
        let frames = stored(&dir, id);
        for dancer in 0..n_dancers {
            // The centre of the first places is over the origin.
            let expected = [1.25 * (dancer as f32 - 1.0), height];
            for (axis, expected) in expected.into_iter().enumerate() {
                let found = frames[[dancer, 20, axis]];
                assert!((found - expected).abs() < 1e-3, "{id}, dancer {dancer}: {found}");
            }
        }
    }
}

#[test]
fn what_is_no_group_fails_with_one_sentence_and_stops_nothing() {
    let dir = Dir::new();
    let folder = dir.at("source").display().to_string();
    let sound = |n: usize| trajectory(&coherent(n, 2));
    let mut broken = group(2, 9);
    broken[[1, 4, 0]] = f32::NAN;
    let mut bvh = Vec::new();
    let frames = group(1, 12);
    write_bvh(frames.index_axis(Axis(0), 0), &mut bvh).expect("written");
    let files: Vec<(&str, Vec<u8>)> = vec![
        ("sound/trajectory.npy", npy(&group(2, 9))),
        ("crowd/trajectory.npy", npy(&group(17, 3))),
        ("hole/dancer_0.npy", sound(9)),
        ("hole/dancer_2.npy", sound(9)),
        ("late/dancer_1.bvh", bvh.clone()),
        ("unequal/dancer_0.npy", sound(20)),
        ("unequal/dancer_1.npy", sound(17)),
        ("mixed/dancer_0.npy", sound(9)),
        ("mixed/dancer_1.bvh", bvh.clone()),
        ("twice/dancer_0.npy", sound(9)),
        ("twice/dancer_0.bvh", bvh),
        ("both/trajectory.npy", sound(9)),
        ("both/dancer_0.npy", sound(9)),
        ("broken/trajectory.npy", npy(&broken)),
        ("wide/dancer_0.npy", npy(&group(2, 9))),
    ];
    for (path, bytes) in &files {
        dir.write(format!("source/motion/{path}"), bytes);
    }
    for dancer in 0..17 {
        dir.write(format!("source/motion/many/dancer_{dancer}.npy"), sound(5));
    }
    let output = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(output.code, 1, "{output:?}");
    assert_eq!(phrases(&dir.at("store")).into_keys().collect::<Vec<_>>(), ["sound"]);
    let found = failures(&dir.at("store"));
    let expected = [
        (
            "both",
            "duplicate_id",
            "motion comes twice, from motion/both/trajectory.npy and motion/both/dancer_0.npy; keep one of them",
        ),
        (
            "broken",
            "non_finite",
            "motion/broken/trajectory.npy: dancer 1: channel position_x is NaN at frame 4 (1 non-finite values in \
          all); repair or remove the phrase",
        ),
        (
            "crowd",
            "shape",
            "motion/crowd/trajectory.npy: motion has 17 dancers, expected 1 to 16; split it into several phrases",
        ),
        (
            "hole",
            "layout",
            "folder motion/hole has dancer_2.npy, but no dancer_1; number the dancers of a group 0, 1, 2 and so on",
        ),
        (
            "late",
            "layout",
            "folder motion/late has dancer_1.bvh, but no dancer_0; number the dancers of a group 0, 1, 2 and so on",
        ),
        (
            "many",
            "layout",
            "motion/many has 17 dancers, more than the 16 of a group; split it into several phrases",
        ),
        (
            "mixed",
            "motion_format",
            "motion/mixed has 1 dancers in .npy and 1 in .bvh, which do not share a frame of reference; write all \
          of them in one format",
        ),
        (
            "twice",
            "duplicate_id",
            "motion comes twice, from motion/twice/dancer_0.bvh and motion/twice/dancer_0.npy; keep one of them",
        ),
        (
            "unequal",
            "length_mismatch",
            "motion/unequal: dancer 1 has 17 frames and dancer 0 has 20; the dancers of a group may differ by 1 \
          frame, so cut them to one length",
        ),
        (
            "wide",
            "shape",
            "motion/wide/dancer_0.npy has shape [2, 9, 25], expected [frames, 25]; this is a group of dancers, and \
          one is read here",
        ),
    ];
    assert_eq!(
        found.keys().collect::<Vec<_>>(),
        expected.map(|case| case.0).iter().collect::<Vec<_>>()
    );
    for (id, kind, message) in expected {
        assert_eq!((found[id].kind.as_str(), found[id].message.as_str()), (kind, message), "{id}");
        assert!(found[id].source.starts_with(&format!("file://{folder}/motion/{id}")));
    }
}

fn options(ensemble: Ensemble) -> DatasetOptions {
    DatasetOptions {
        ensemble,
        in_memory: true,
        n_threads: NonZeroUsize::new(2).expect("above 0"),
        patience: Patience::default(),
        max_train_phrases: None,
    }
}

#[test]
fn learners_of_soloists_leave_groups_out_and_learners_of_groups_read_them() {
    let dir = Dir::new();
    let sizes = [("a", 1, 31), ("b", 3, 33), ("c", 5, 35)];
    for (id, n_dancers, n_frames) in sizes {
        dir.write(format!("source/motion/{id}/trajectory.npy"), npy(&group(n_dancers, n_frames)));
        let features = features_npz(n_frames);
        dir.write(format!("source/audio_features/{id}/features.npz"), features);
    }
    let ingested = ingest(&dir.at("source"), &dir.at("store"), &[]);
    assert_eq!(ingested.code, 0, "{ingested:?}");
    let store = dir.at("store").display().to_string();
    let extracted = run(["extract", "--store", &store]);
    assert_eq!(extracted.code, 0, "{extracted:?}");
    let location = Location::local(&dir.at("store")).expect("a folder");
    let read = |ensemble| {
        Dataset::read(&location, &options(ensemble), &|_, _| (), &|_, _| ()).expect("phrases")
    };
    let (dataset, left_out) = read(Ensemble::Soloists);
    let names = |dataset: &Dataset| -> Vec<(String, usize)> {
        dataset.phrases().iter().map(|p| (p.id.to_string(), p.n_dancers)).collect()
    };
    assert_eq!(names(&dataset), [("a".to_owned(), 1)]);
    let said: Vec<(&str, &str)> =
        left_out.iter().map(|one| (one.kind, one.message.as_str())).collect();
    assert_eq!(
        said,
        [
            ("group", "phrase b has 3 dancers; a model of one dancer learns from soloists"),
            ("group", "phrase c has 5 dancers; a model of one dancer learns from soloists"),
        ]
    );
    let (dataset, left_out) = read(Ensemble::Groups { most: 4 });
    assert_eq!(names(&dataset), [("a".to_owned(), 1), ("b".to_owned(), 3)]);
    assert_eq!(
        left_out[0].message,
        "phrase c has 5 dancers, more than the 4 of the largest group that is learned from"
    );
    let [solo, trio] = dataset.phrases() else { panic!("two phrases") };
    let frames = dataset.group(trio, 7, 12).expect("frames");
    assert_eq!(frames, group(3, 33).slice(s![.., 7..19, ..]));
    assert_eq!(dataset.group(solo, 3, 9).expect("frames"), group(1, 31).slice(s![.., 3..12, ..]));
    assert_eq!(dataset.motion(trio, 7, 12).expect("frames"), frames.index_axis(Axis(0), 0));

    let page = dir.at("page.html").display().to_string();
    let viewed = run(["view", "--store", &store, "--phrase", "b", "--no-audio", "--output", &page]);
    assert_eq!(viewed.code, 0, "{viewed:?}");
    assert!(viewed.stdout.starts_with("3 motions (1.10 s)"), "{}", viewed.stdout);
    let picture = dir.at("b.svg").display().to_string();
    let plotted = run(["plot", "motion", "--store", &store, "--phrase", "b", "--output", &picture]);
    assert_eq!(plotted.code, 0, "{plotted:?}");
}

#[test]
fn a_store_of_groups_alone_is_nothing_for_soloists() {
    let groups = [("a", Split::Train, group(2, 9), Array2::zeros((9, 163)))];
    let at_hand = Dataset::groups_in_memory(groups).expect("memory");
    let [pair] = at_hand.phrases() else { panic!("one phrase") };
    assert_eq!((pair.n_dancers, pair.n_frames), (2, 9));
    assert_eq!(at_hand.group(pair, 2, 5).expect("frames"), group(2, 9).slice(s![.., 2..7, ..]));
    let dir = Dir::new();
    dir.write("source/motion/a/trajectory.npy", npy(&group(2, 31)));
    dir.write("source/audio_features/a/features.npz", features_npz(31));
    assert_eq!(ingest(&dir.at("source"), &dir.at("store"), &[]).code, 0);
    let store = dir.at("store").display().to_string();
    assert_eq!(run(["extract", "--store", &store]).code, 0);
    let location = Location::local(&dir.at("store")).expect("a folder");
    let read = Dataset::read(&location, &options(Ensemble::Soloists), &|_, _| (), &|_, _| ());
    let error = read.expect_err("groups alone");
    assert!(matches!(error, DatasetError::GroupsAlone { n_groups: 1, .. }), "{error}");
    assert_eq!(
        error.to_string(),
        format!(
            "store {location} has 1 phrases with both motion and features, all of groups of dancers; a model of \
             one dancer learns from soloists"
        )
    );
}
