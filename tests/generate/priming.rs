//! Sampling that begins from the library's nearest phrases: `--prime`.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::process::Command;

use motiongen::motion::{MOTION_DIM, Normalizer, Placement};
use motiongen::store::tables::{self, GenerationRow};
use motiongen::store::{Location, Snapshot, StoreError};
use ndarray::Array2;

use super::{TRAINED, command, copy, generate, generations, modelled, modelled_with};
use crate::support::files::{coherent, trajectory, wav};
use crate::support::{Dir, finish, run};

#[test]
fn sampling_can_begin_from_the_librarys_nearest_phrases() {
    let dir = Dir::new();
    let store = modelled(&dir);
    generate(&store, &["--run=plain"]);
    generate(&store, &["--run=primed", "--prime=0.5", "--threads=1"]);
    let by_run = |name: &str| -> Vec<GenerationRow> {
        generations(&store).into_iter().filter(|row| row.run == name).collect()
    };
    assert!(by_run("plain").iter().all(|row| row.primed_by.is_none()));
    let train: BTreeSet<String> = crate::support::phrases(&store)
        .into_values()
        .filter(|row| row.split == "train" && row.n_frames >= Some(24))
        .map(|row| row.phrase_id)
        .collect();
    for row in by_run("primed") {
        let names: Vec<&str> = row.primed_by.as_deref().expect("named").split(',').collect();
        assert_eq!(names.len(), row.n_windows as usize, "{row:?}");
        assert!(names.iter().all(|name| train.contains(*name)), "{names:?} of {train:?}");
        // A phrase of the library is nearest to itself.
        if train.contains(&row.phrase_id) {
            assert_eq!(names[0], row.phrase_id);
        }
    }
    let frames_of_run = |name: &str| {
        let sql = format!("select * from generated where run = '{name}' order by phrase_id, frame");
        let output =
            run(["query", "--store", &store.display().to_string(), &sql, "--format", "csv"]);
        output.stdout.replace(name, "")
    };
    assert_ne!(frames_of_run("primed"), frames_of_run("plain"));
    generate(&store, &["--run=again", "--prime=0.5", "--threads=2"]);
    assert_eq!(frames_of_run("again"), frames_of_run("primed"), "whatever the number of threads");

    let refused = |more: &[&str]| {
        let output = finish(&mut command(&store, more));
        assert_eq!(output.code, 2, "{output:?}");
        output.stderr
    };
    assert_eq!(
        refused(&["--prime=1.5"]),
        "error: --prime 1.5 is no share; give a number from 0 to 1\n"
    );
    assert_eq!(
        refused(&["--prime=0.999"]),
        "error: --prime 0.999 leaves 1 of 1000 steps, fewer than the 4 of the sampler; give up to 0.996, or \
         fewer --steps\n"
    );
    let model = store.join("models/m").display().to_string();
    let song = dir.write("song.wav", wav(2.0)).display().to_string();
    let out = dir.at("out").display().to_string();
    let alone = run([
        "generate",
        "--model",
        &model,
        "--audio",
        &song,
        "--output",
        &out,
        "--prime=0.5",
        "--overlap=7",
    ]);
    assert_eq!(
        (alone.code, alone.stderr.as_str()),
        (
            2,
            "error: --prime begins from the motion of a library, and there is none without --store; name \
             the store of one, or leave --prime out\n"
        )
    );
}

/// Motion of the first `n` frames, placed over the origin.
fn placed(frames: &[[f32; MOTION_DIM]], n: usize) -> Array2<f32> {
    let mut motion = Array2::from_shape_fn((n, MOTION_DIM), |(t, i)| frames[t][i]);
    Placement::of_first(motion.view()).expect("frames").remove(&mut motion);
    motion
}

/// The generated frames of a run, by phrase.
fn motions(store: &Path, name: &str) -> BTreeMap<String, Vec<[f32; MOTION_DIM]>> {
    let location = Location::local(store).expect("a folder");
    let rows = generations(store).into_iter().filter(|row| row.run == name);
    let names: BTreeMap<_, _> = rows.map(|row| (row.generation, row.phrase_id)).collect();
    let wanted = names.keys().cloned().collect();
    let mut found = BTreeMap::new();
    Snapshot::take(&location, tables::generated())
        .expect("a table")
        .visit_items(&wanted, |id, frames| {
            let rows = frames.rows().into_iter();
            let rows = rows.map(|row| std::array::from_fn(|i| row[i])).collect();
            found.insert(names[id].clone(), rows);
            Ok::<_, StoreError>(())
        })
        .expect("frames");
    found
}

#[test]
fn what_is_hardly_made_noisy_stays_near_the_librarys_motion() {
    let dir = Dir::new();
    // A model of noise leaves what is not noisy as it is, however little it was trained.
    let trained = ["--steps=20", "--decoder-steps=400", "--warmup-steps=5", "--prediction=epsilon"];
    let store = modelled_with(&dir, &trained);
    let usual = ["--raw", "--guidance=1", "--sampler=ddim"];
    let generate_with = |more: &[&str]| generate(&store, &[&usual, more].concat());
    generate_with(&["--run=plain"]);
    generate_with(&["--run=primed", "--prime=0.99"]);
    let library = crate::support::motion(&store);
    let all: Vec<f32> =
        library.values().flat_map(|frames| frames.as_flattened().to_vec()).collect();
    let all = Array2::from_shape_vec((all.len() / MOTION_DIM, MOTION_DIM), all).expect("frames");
    let scale = Normalizer::fit(all.view()).0.scale;
    let (plain, primed) = (motions(&store, "plain"), motions(&store, "primed"));
    let (mut squares, mut n_nearer) = ([[0.0_f64; MOTION_DIM]; 2], 0);
    for row in generations(&store).into_iter().filter(|row| row.run == "primed") {
        let id = row.primed_by.as_deref().and_then(|names| names.split(',').next());
        let n = usize::try_from(row.n_frames).expect("frames").min(24);
        let wanted = placed(&library[id.expect("named")], n);
        let mut sums = [0.0; 2];
        for (k, made) in [&plain, &primed].into_iter().enumerate() {
            for ((t, i), x) in wanted.indexed_iter() {
                let off = f64::from((x - made[&row.phrase_id][t][i]) / scale[i]).powi(2);
                squares[k][i] += off;
                sums[k] += off;
            }
        }
        n_nearer += usize::from(sums[1] < sums[0]);
    }
    assert_eq!(n_nearer, 16, "every motion is nearer to its phrase than without it");
    let nearer: Vec<bool> = (0..MOTION_DIM).map(|i| squares[1][i] < squares[0][i]).collect();
    assert!(nearer.iter().all(|is_nearer| *is_nearer), "in every channel: {nearer:?}");
}

#[test]
fn primed_motion_belongs_to_its_strength_and_its_library() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let made = |more: &[&str]| {
        let output = generate(&store, more);
        let line = output.stdout.lines().nth(2).unwrap_or_default().trim().to_owned();
        line.split(" (").next().unwrap_or_default().to_owned()
    };
    assert_eq!(made(&["--prime=0.25"]), "16 motions made");
    assert_eq!(made(&["--prime=0.25"]), "nothing to do: 16 motions are up to date");
    assert_eq!(made(&["--prime=0.75"]), "16 motions made");
    // One phrase more is another library; without it nothing depends on the library.
    assert_eq!(made(&["--run=plain"]), "16 motions made");
    let source = dir.at("source");
    let mut names = (0..).map(|i| format!("new {i}"));
    let new = names.find(|name| motiongen::store::split_of(name) == "train").expect("a name");
    for kind in ["motion", "audio_features"] {
        let known = std::fs::read_dir(source.join(kind)).expect("phrases");
        let mut known: Vec<_> = known.map(|entry| entry.expect("an entry").path()).collect();
        known.sort();
        copy(&known[1], &source.join(kind).join(&new));
    }
    let output = crate::support::ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(made(&["--prime=0.75"]), "17 motions made");
    assert_eq!(made(&["--run=plain"]), "1 motions made");
}

#[test]
fn a_store_without_a_library_is_refused_with_the_way_out() {
    let dir = Dir::new();
    let longer = [&TRAINED[..], &["--window-frames=72"]].concat();
    let store = modelled_with(&dir, &longer);
    let refused = |command: &mut Command| {
        let output = finish(command);
        assert_eq!(output.code, 2, "{output:?}");
        output.stderr
    };
    let url = Location::local(&store).expect("a folder").to_string();
    assert_eq!(
        refused(&mut command(&store, &["--prime=0.5"])),
        format!(
            "error: store {url} has no training phrases of 72 frames, which sampling could begin from; leave \
             --prime out, or build a library with motiongen library --store {url}\n"
        )
    );
    // A store of motion alone, and the model of another.
    let capture = trajectory(&coherent(31, 1));
    dir.write("captures/motion/a/trajectory.npy", capture);
    let other = dir.at("other");
    assert_eq!(crate::support::ingest(&dir.at("captures"), &other, &[]).code, 0);
    let model = format!("--model={}", store.join("models/m").display());
    let url = Location::local(&other).expect("a folder").to_string();
    assert_eq!(
        refused(&mut command(&other, &[&model, "--prime=0.5"])),
        format!(
            "error: store {url} has no phrases with both motion and features; run ingest and extract (or \
             library) on it first\n"
        )
    );
}
