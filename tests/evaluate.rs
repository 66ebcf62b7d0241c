//! `motiongen evaluate`, as a user runs it, on motions whose numbers are known by construction.

mod requests;
mod verdicts;

use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::path::{Path, PathBuf};

use motiongen::generation::{LearnedFrom, Purpose};
use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::write as array;
use motiongen::report;
use motiongen::store::tables::{
    self, DECODED, GENERATED, GenerationRow, MetricRow, SanityCheckRow, SongMetricRow,
};
use motiongen::store::{Commit, Item, Label, Ledger, Location, Row as _, TimestampUs, split_of};
use motiongen::units::FPS;
use ndarray::Array2;
use zip::CompressionMethod;

use crate::support::files::{coherent, features, npz, trajectory};
use crate::support::{Dir, Output, phrases, rows, run};

/// Two windows of 120 frames, and some.
const N_FRAMES: usize = 257;
/// Enough phrases for 80 windows: what a Fréchet distance of eight features needs.
const N_TRAIN: usize = 41;
const N_HELD_OUT: usize = 5;
/// Songs that motion is made for, from the first on and from those that were held out.
const N_LEARNED_DANCED: usize = 3;

/// Names of `n` phrases that the stable hash puts into a split.
fn names(split: &str, n: usize) -> Vec<String> {
    (0..).map(|i| format!("song {i:03}")).filter(|id| split_of(id) == split).take(n).collect()
}

fn all_names() -> Vec<String> {
    let mut all = names("train", N_TRAIN);
    all.extend(names("validation", N_HELD_OUT));
    all
}

/// Beats of a song: each has a tempo of its own.
fn interval_s(song: usize) -> f64 {
    0.4 + 0.05 * ((5 * song) % 9) as f64
}

/// A store of songs with motion, features and beats.
pub fn make_store(dir: &Dir) -> PathBuf {
    let (source, store) = (dir.at("source"), dir.at("store"));
    for (i, id) in all_names().iter().enumerate() {
        let frames = coherent(N_FRAMES, i as u32);
        dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&frames));
        let mut members = features(N_FRAMES);
        members.retain(|(name, _)| !["tempo", "beat_times", "mel"].contains(name));
        let beats: Vec<f32> =
            (0..40).map(|beat| (f64::from(beat) * interval_s(i)) as f32).collect();
        members.push(("beat_times", array(&[beats.len()], &beats)));
        // Every song sounds like itself.
        let mel: Vec<f32> =
            (0..128 * N_FRAMES).map(|k| ((k * (i + 3)) % 97) as f32 / 97.0).collect();
        members.push(("mel", array(&[128, N_FRAMES], &mel)));
        let bytes = npz(&members, CompressionMethod::Deflated);
        dir.write(format!("source/audio_features/{id}/features.npz"), bytes);
    }
    let output = crate::support::ingest(&source, &store, &["--quiet"]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = run(["extract", "--quiet", "--store", &store.display().to_string()]);
    assert_eq!(output.code, 0, "{output:?}");
    put_card(&store, "m");
    store
}

/// Puts the card of a model there that learned from the training split; its networks are nobody's.
fn put_card(store: &Path, model: &str) {
    let golden =
        Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/release_0_1/store/models");
    let text = std::fs::read(golden.join("m/model.json")).expect("a card of 0.1");
    let mut card: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    let all = phrases(store);
    let learned = all
        .values()
        .filter(|row| row.split == "train")
        .map(|row| (Purpose::Training, row.song_hash.as_deref(), row.content_hash.as_str()));
    let learned_from = LearnedFrom::new("data", learned);
    card["name"] = model.into();
    card["provenance"]["learned_from"] = serde_json::to_value(learned_from).expect("JSON");
    let text = serde_json::to_vec(&card).expect("JSON");
    crate::support::write(&store.join(format!("models/{model}/model.json")), text);
}

/// The digest of the weights of that card, as `generations` has it.
fn weights(store: &Path) -> String {
    let text = std::fs::read(store.join("models/m/model.json")).expect("a card");
    let card: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    let digest_of =
        |network: &str| card["weights_sha256"][network].as_str().expect("a digest").to_owned();
    let both = format!("{}\n{}\n", digest_of("unet"), digest_of("decoder"));
    let digest = <sha2::Sha256 as sha2::Digest>::digest(both.as_bytes());
    digest.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// A body that sways along x and rises with the bars of a song (four beats), coherent to the last frame.
fn locked(song: usize, sample: usize) -> Array2<f32> {
    let bar_s = 4.0 * interval_s(song);
    let position = |t: usize| {
        let s = t as f64 / FPS;
        // The fourth harmonic makes the jerk that of a body rather than of a pendulum.
        let rise = 0.1 * (TAU * s / bar_s).sin() + 0.02 * (4.0 * TAU * s / bar_s).sin();
        [0.25 * (0.9 * s + sample as f64).sin(), 1.0 + rise, 0.02 * sample as f64 * s]
    };
    let difference =
        |a: [f64; 3], b: [f64; 3]| -> [f64; 3] { std::array::from_fn(|i| FPS * (b[i] - a[i])) };
    let velocity = |t: usize| difference(position(t), position(t + 1));
    let mut frames = Array2::zeros((N_FRAMES, MOTION_DIM));
    for t in 0..N_FRAMES {
        let acceleration = difference(velocity(t), velocity(t + 1));
        let values = [position(t), velocity(t), acceleration].concat();
        for (i, x) in values.into_iter().enumerate() {
            frames[[t, i]] = x as f32;
        }
        frames[[t, 9]] = 1.0;
        frames[[t, 16]] = (t as f64 / FPS / bar_s).fract() as f32;
    }
    frames
}

/// A motion as generate would have left it in a store.
struct Motion {
    phrase: String,
    sample: usize,
    frames: Array2<f32>,
}

/// Writes motions under the name of a run.
fn put(store: &Path, name: &str, motions: &[Motion]) {
    put_asked(store, name, motions, &|_| None);
}

/// The same of motions that were asked to do something.
fn put_asked(
    store: &Path,
    name: &str,
    motions: &[Motion],
    asked: &dyn Fn(&Motion) -> Option<String>,
) {
    let weights = weights(store);
    let known = crate::support::phrases(store);
    let store = Location::local(store).expect("a store");
    let ledger = Ledger::read(&store, "generate").expect("a ledger");
    let mut commit = Commit::new(&store, "generate", name, "phrases");
    let mut found = Vec::new();
    for motion in motions {
        let Motion { phrase, sample, frames } = motion;
        let id = format!("{name}/{phrase}/{sample}");
        let labels = [
            Label::Text(name.to_owned()),
            Label::Text(phrase.clone()),
            Label::Number(*sample as i32),
        ];
        let part = commit.part(GENERATED, tables::generated).expect("a part");
        part.write_labelled_frames(&id, &labels, frames.view()).expect("written");
        // As it was decoded the velocity is off by 0.3 m/s, and the phase a quarter of a bar late.
        let mut raw = frames.clone();
        raw.column_mut(3).mapv_inplace(|v| v + 0.3);
        raw.column_mut(16).mapv_inplace(|phase| (phase + 0.75).fract());
        let part = commit.part(DECODED, tables::decoded).expect("a part");
        part.write_labelled_frames(&id, &labels, raw.view()).expect("written");
        found.push(GenerationRow {
            generation: id.clone(),
            run: name.to_owned(),
            phrase_id: phrase.clone(),
            sample: *sample as i32,
            candidate: 0,
            selected: true,
            seed: 5,
            model: "m".to_owned(),
            weights: weights.clone(),
            engine: "eager".to_owned(),
            sampler: "DDIM".to_owned(),
            n_steps: 7,
            guidance: 1.5,
            eta: Some(0.0),
            primed_by: None,
            n_frames: frames.nrows() as i64,
            n_windows: 2,
            score: Some(0.5),
            checks_passed: 13,
            n_checks: 13,
            locking: None,
            velocity_error: 0.0,
            control_error_mm: (*sample == 0).then_some(12.0),
            control_error_deg: None,
            constraints: asked(motion),
            generate_s: 0.1,
            real_time_factor: 0.01,
            settings: None,
            content_hash: None,
            n_dancers: Some(1),
            consistency: None,
            time: TimestampUs(1_700_000_000_000_000),
        });
        // As rows of older versions: the commit alone says what the motion was made for.
        let hash = known.get(phrase).map_or("h".to_owned(), |row| row.content_hash.clone());
        commit.settle(
            Item { id, fingerprint: hash.clone(), input_hash: hash, failure: None },
            &ledger,
        );
    }
    commit
        .part(GenerationRow::schema().name, GenerationRow::schema)
        .expect("a part")
        .write_rows(&found)
        .expect("written");
    commit.publish().expect("published");
}

/// Two motions for each of some songs, of which the last five were held out.
fn put_locked(store: &Path, name: &str) {
    let songs = all_names();
    let mut motions = Vec::new();
    for song in (0..N_LEARNED_DANCED).chain(N_TRAIN..N_TRAIN + N_HELD_OUT) {
        for sample in 0..2 {
            let phrase = songs[song].clone();
            motions.push(Motion { phrase, sample, frames: locked(song, sample) });
        }
    }
    motions.sort_by(|a, b| (&a.phrase, a.sample).cmp(&(&b.phrase, b.sample)));
    put(store, name, &motions);
}

fn evaluate(store: &Path, name: &str, more: &[&str]) -> Output {
    let store = store.display().to_string();
    let fixed = ["evaluate", "--quiet", "--baseline-windows=0", "--store", &store, "--run", name];
    run(fixed.iter().chain(more))
}

/// Metrics of a run by subject, split, metric and variant.
fn metrics(store: &Path, name: &str) -> BTreeMap<[String; 4], MetricRow> {
    let mut rows: Vec<MetricRow> = rows(store);
    rows.retain(|row| row.run == name);
    rows.into_iter()
        .map(|row| {
            let key = [&row.subject, &row.split, &row.metric, &row.variant].map(String::clone);
            (key, row)
        })
        .collect()
}

#[track_caller]
fn value(of: &BTreeMap<[String; 4], MetricRow>, key: [&str; 4]) -> Option<f64> {
    of.get(&key.map(str::to_owned)).unwrap_or_else(|| panic!("no {key:?}")).value
}

#[test]
fn numbers_and_baselines_are_what_the_motions_were_made_to_have() {
    let dir = Dir::new();
    let store = make_store(&dir);
    put_locked(&store, "locked");
    let page = dir.at("report.html");
    let shown = page.display().to_string();
    let output = evaluate(&store, "locked", &["--report", &shown]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("  16 motions (137.1 s) evaluated;"), "{output:?}");
    let found = metrics(&store, "locked");

    // The card says what was learned from, whatever the store's split is called.
    for split in ["trained_on", "held_out"] {
        let own =
            |metric: &str, variant: &str| value(&found, ["generated", split, metric, variant]);
        // By construction the velocity belongs to the positions; as it was decoded it does not.
        assert_eq!(
            own("pass_rate", "strict"),
            Some(0.0),
            "it turns and jerks as no training window"
        );
        assert_eq!(own("pass_rate", "reference"), Some(1.0));
        assert_eq!(own("pass_rate", "strict_raw"), Some(0.0));
        let off = own("velocity_error", "raw").expect("decoded");
        assert!((off - 0.1).abs() < 1e-6, "one axis of three is off by 0.3 m/s: {off}");
        // The phase was set to the music's; as it was decoded it is a quarter of a bar late.
        assert_eq!(own("phase_error", ""), None);
        assert!((own("phase_error", "raw").expect("decoded") - 0.25).abs() < 1e-6);
        // Every one of the 199 wrong tempi does worse, and no rotation of the bars as well.
        assert_eq!(own("locking_wrong_share", "per_song"), Some(0.005));
        // Real motion of this store is coupled to the bar in a way of its own, which this motion hardly shares.
        let p = own("locking_p", "per_song").expect("songs");
        assert!((0.001..0.5).contains(&p), "{split}: {p}");
        assert!(own("locking_r2", "per_song") > Some(0.99), "{split}");
        // The music of another song has another tempo.
        let shuffled = value(&found, ["shuffled", split, "locking_r2", "per_song"]);
        assert!(shuffled < Some(0.5), "{shuffled:?}");
        assert_eq!(value(&found, ["mean_motion", split, "mean_speed", ""]), Some(0.0));
        assert!(value(&found, ["retrieval", split, "mean_speed", ""]) > Some(0.1));
        assert_eq!(own("control_position", "largest"), Some(12.0));
    }
    let n = |key: [&str; 4]| found[&key.map(str::to_owned)].n;
    assert_eq!(n(["generated", "held_out", "locking_r2", "per_song"]), 5);
    assert_eq!(n(["generated", "all", "locking_r2", "per_song"]), 8);
    assert_eq!(n(["generated", "held_out", "mean_speed", ""]), 20, "two windows of ten motions");
    assert_eq!(n(["training_truth", "all", "mean_speed", ""]), 2 * N_TRAIN as i64);
    assert_eq!(n(["held_out_truth", "held_out", "mean_speed", ""]), 2 * N_HELD_OUT as i64);
    // Real motion is not measured against itself.
    assert!(!found.contains_key(&["training_truth", "all", "fid_k", "axes"].map(str::to_owned)));
    // Ten features of each chunk for every dimension: 20 chunks are too few to tell.
    assert_eq!(value(&found, ["generated", "held_out", "fid_k", "axes"]), None);

    // Mean speed of the windows themselves.
    let speed = |frames: &Array2<f32>, first: usize| {
        let step = |t: usize| {
            let d = |i| f64::from(frames[[t + 1, i]]) - f64::from(frames[[t, i]]);
            FPS * (0..3).map(d).map(|x| x * x).sum::<f64>().sqrt()
        };
        (first..first + 119).map(step).sum::<f64>() / 119.0
    };
    let songs = (0..N_LEARNED_DANCED).chain(N_TRAIN..N_TRAIN + N_HELD_OUT);
    let speeds: Vec<f64> = songs
        .flat_map(|song| [0, 1].map(|sample| locked(song, sample)))
        .flat_map(|frames| [0, 120].map(|first| speed(&frames, first)))
        .collect();
    let expected = speeds.iter().sum::<f64>() / speeds.len() as f64;
    let own = value(&found, ["generated", "all", "mean_speed", ""]).expect("a speed");
    // Windows are moved to the origin in single precision.
    assert!((own - expected).abs() < 1e-5 * expected, "{own} {expected}");

    let unknown: Vec<_> =
        found.values().map(|row| &row.metric).filter(|metric| !report::knows(metric)).collect();
    assert!(unknown.is_empty(), "the report cannot say what {unknown:?} mean");

    let checks: Vec<SanityCheckRow> = rows(&store);
    assert_eq!(checks.len(), 2 * 16 * 19);
    assert!(checks.iter().all(|row| row.value.is_some() && row.run == "locked"));
    let passes_of = |stage: &str, check: &str| {
        let is_it =
            |row: &&SanityCheckRow| row.stage.as_deref() == Some(stage) && row.check_name == check;
        let found: Vec<_> = checks.iter().filter(is_it).collect();
        let n_passed = found.iter().filter(|row| row.passed).count();
        (n_passed, found.iter().all(|row| row.by_construction == Some(true)))
    };
    assert_eq!(passes_of("final", "velocity"), (16, true));
    assert_eq!(passes_of("raw", "velocity"), (0, false));
    assert_eq!(passes_of("final", "finite"), (16, false));

    // What the songs are paired by, in a comparison.
    let songs: Vec<SongMetricRow> = rows(&store);
    let r2 = songs.iter().filter(|row| row.metric == "locking_r2" && row.split == "held_out");
    assert_eq!(r2.count(), N_HELD_OUT);

    let page = std::fs::read_to_string(page).expect("a page");
    for text in ["Strict checks", "<svg", "songs that nothing was learned from"] {
        assert!(page.contains(text), "{text}");
    }
    assert!(!page.contains("Motion follows the bar"));
    // What is queried is what the report shows.
    let sql = "select value from metrics where run = 'locked' and subject = 'shuffled' and split = \
               'held_out' and metric = 'locking_r2' and variant = 'per_song'";
    let answer = run(["query", "--store", &store.display().to_string(), sql, "--format", "csv"]);
    let queried: f64 = answer.stdout.lines().nth(1).and_then(|x| x.parse().ok()).expect("a number");
    assert_eq!(Some(queried), value(&found, ["shuffled", "held_out", "locking_r2", "per_song"]));
}

#[test]
fn evaluating_again_does_nothing_and_with_force_finds_the_same() {
    let dir = Dir::new();
    let store = make_store(&dir);
    put_locked(&store, "locked");
    let without_time = |store: &Path| -> Vec<MetricRow> {
        let found = metrics(store, "locked").into_values();
        found.map(|row| MetricRow { time: TimestampUs(0), ..row }).collect()
    };
    assert_eq!(evaluate(&store, "locked", &["--threads=1"]).code, 0);
    let first = without_time(&store);
    let again = evaluate(&store, "locked", &[]);
    assert!(again.stdout.contains("  16 motions (137.1 s), evaluated before\n"), "{again:?}");
    let forced = evaluate(&store, "locked", &["--force", "--threads=3"]);
    assert!(forced.stdout.contains("  16 motions (137.1 s) evaluated;"), "{forced:?}");
    assert_eq!(without_time(&store), first, "whatever the number of threads");
    // A motion more is another evaluation, which takes the place of the first.
    let less = evaluate(&store, "locked", &["--num-samples=3", "--num-frames=150"]);
    assert!(less.stdout.contains("  3 motions ("), "{less:?}");
    assert_eq!(rows::<SanityCheckRow>(&store).len(), 2 * 3 * 19);
    // A quick one leaves the numbers.
    let quick = evaluate(&store, "locked", &["--quick"]);
    assert_eq!(quick.code, 0, "{quick:?}");
    // Without real motion nobody knows its bounds: 13 checks of each stage.
    assert_eq!(rows::<SanityCheckRow>(&store).len(), 2 * 16 * 13);
    assert!(!metrics(&store, "locked").is_empty());
    // A whole one is good for a quick one, not the other way round.
    let motions_seen = |output: Output| output.stdout.lines().nth(1).map(str::to_owned);
    let whole = motions_seen(evaluate(&store, "locked", &[])).expect("a line");
    assert!(whole.starts_with("  16 motions (137.1 s) evaluated;"), "{whole}");
    assert_eq!(rows::<SanityCheckRow>(&store).len(), 2 * 16 * 19);
    let quick = motions_seen(evaluate(&store, "locked", &["--quick"])).expect("a line");
    assert_eq!(quick, "  16 motions (137.1 s), evaluated before");
    assert_eq!(rows::<SanityCheckRow>(&store).len(), 2 * 16 * 19);

    put_locked(&store, "other");
    let missing = evaluate(&store, "locked", &["--against=other"]);
    assert_eq!(missing.code, 2);
    assert_eq!(evaluate(&store, "other", &[]).code, 0);
    let compared = evaluate(&store, "locked", &["--force", "--against=other"]);
    assert!(
        compared.stdout.contains(
            "compared with other, 310 numbers: 282 equal, 28 not measured\n  No number is paired song by \
             song, so that none is called better or worse\n"
        ),
        "{compared:?}"
    );
}

#[test]
fn noise_passes_the_reference_and_fails_what_is_strict() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let songs = names("validation", 4);
    let mut motions: Vec<Motion> = (0..4)
        .map(|i| Motion { phrase: songs[i].clone(), sample: 0, frames: locked(N_TRAIN + i, 0) })
        .collect();
    // One metre per second up and down in the velocity channel alone, and a value that is none.
    for t in 0..N_FRAMES {
        motions[1].frames[[t, 3]] += if t % 2 == 0 { 1.0 } else { -1.0 };
    }
    motions[2].frames[[40, 17]] = f32::NAN;
    motions.sort_by(|a, b| a.phrase.cmp(&b.phrase));
    put(&store, "noisy", &motions);

    // Quick: bounds of windows are those of other motion than this.
    let least = ["--quick", "--min-pass-rate=0.7", "--min-strict-pass-rate=0.75"];
    let output = evaluate(&store, "noisy", &least);
    assert_eq!(output.code, 1, "{output:?}");
    assert!(
        output.stdout.contains("  strict checks: 0.500 of the motions pass all, below 0.75\n"),
        "{output:?}"
    );
    assert!(!output.stdout.contains("reference checks: 0."), "{output:?}");
    let relaxed = evaluate(&store, "noisy", &["--quick", "--min-strict-pass-rate=0.5"]);
    assert_eq!(relaxed.code, 0, "{relaxed:?}");
    let failed: Vec<(String, String)> = rows::<SanityCheckRow>(&store)
        .into_iter()
        .filter(|row| !row.passed && row.stage.as_deref() == Some("final"))
        .map(|row| (row.phrase_id, row.check_name))
        .collect();
    let failed_checks = |song: usize, checks: &[&str]| -> Vec<(String, String)> {
        checks.iter().map(|check| (songs[song].clone(), (*check).to_owned())).collect()
    };
    let mut expected = failed_checks(1, &["velocity", "acceleration"]);
    expected.extend(failed_checks(2, &["finite", "ranges"]));
    expected.sort();
    let mut found = failed;
    found.sort();
    assert_eq!(found, expected);
    assert_eq!(evaluate(&store, "noisy", &[]).code, 0);
    let found = metrics(&store, "noisy");
    // All of it is for music that was held out, so that there is one split.
    assert!(!found.keys().any(|[subject, split, ..]| subject == "generated" && split == "all"));
}

#[test]
fn what_cannot_be_evaluated_is_told_in_a_sentence() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let place = Location::local(&store).expect("a store").to_string();
    let refused = |name: &str, more: &[&str]| {
        let output = evaluate(&store, name, more);
        assert_eq!(output.code, 2, "{output:?}");
        output.stderr
    };
    assert_eq!(
        refused("locked", &[]),
        format!(
            "error: store {place} has no generated motion; run first: motiongen generate --store {place} \
             --model NAME\n"
        )
    );
    put_locked(&store, "locked");
    assert_eq!(
        refused("loked", &[]),
        format!("error: store {place} has no generated motion of run \"loked\"; nearest: locked\n")
    );
    assert_eq!(
        refused("locked", &["--against=other"]),
        format!(
            "error: run \"other\" has no metrics to compare with; run first: motiongen evaluate --store \
             {place} --run other\n"
        )
    );
    assert_eq!(
        refused("locked", &["--min-pass-rate=1.5"]),
        "error: --min-pass-rate 1.5 is no share; give a number from 0 to 1\n"
    );
    assert_eq!(
        refused("locked", &["--report=page.pdf"]),
        "error: --report page.pdf is not named like a page; name it .html\n"
    );
}
