//! Tokens of motion, as a user trains and writes them.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::write;
use motiongen::store::tables::{PhraseRow, TokenRow, TokenizationRow, TrainingLogRow};
use motiongen::store::{Commit, Item, Ledger, Location, Row as _};
use ndarray::{Array2, Array3};
use zip::CompressionMethod;

use crate::ingest_kill::Running;
use crate::support::files::{coherent, npz, trajectory};
use crate::support::{Dir, Output, failures, finish, motiongen, phrases, rows};
use crate::train::features;

/// A network that learns in milliseconds.
const SMALL: [&str; 9] = [
    "--family=tokens",
    "--preset=tiny",
    "--window-frames=24",
    "--batch-size=5",
    "--threads=2",
    "--steps=7",
    "--codes=16",
    "--validate-every=2",
    "--max-failed=1",
];
/// Codes of that network.
const CODES: i32 = 16;

/// Writes phrases of 29 to 61 frames of soloists, 13 to train and 3 to validate, and a group of two.
pub fn make_store(dir: &Dir) -> PathBuf {
    let (source, store) = (dir.at("source"), dir.at("store"));
    let names = |split: &'static str, n: usize| {
        let all = (0..).map(|i| format!("phrase {i:03}"));
        all.filter(move |id| motiongen::store::split_of(id) == split).take(n)
    };
    for (i, id) in names("train", 13).chain(names("validation", 3)).enumerate() {
        let frames = coherent(29 + 16 * (i % 3), 7 * i as u32);
        crate::support::write(
            &source.join(format!("motion/{id}/trajectory.npy")),
            trajectory(&frames),
        );
        // Every third phrase is named, two of three of those alike; names are trimmed.
        if i % 3 == 0 {
            let name = if i % 9 == 0 { "break" } else { " middle hip-hop\n" };
            crate::support::write(&source.join(format!("motion/{id}/style.txt")), name);
        }
        let heard = npz(&features(&frames), CompressionMethod::Deflated);
        crate::support::write(&source.join(format!("audio_features/{id}/features.npz")), heard);
    }
    let mut pair = Array3::zeros((2, 31, MOTION_DIM));
    for (dancer, mut of_dancer) in pair.outer_iter_mut().enumerate() {
        let values = coherent(31, 100 + dancer as u32);
        of_dancer.assign(&Array2::from_shape_fn((31, MOTION_DIM), |(t, c)| values[t][c]));
    }
    let bytes = write(&[2, 31, MOTION_DIM], pair.as_slice().expect("in order"));
    crate::support::write(&source.join("motion/pair/trajectory.npy"), bytes);
    let output = crate::support::ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = finish(motiongen().arg("extract").arg("--store").arg(&store));
    assert_eq!(output.code, 0, "{output:?}");
    store
}

pub fn train_command(store: &Path, run: &str, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg("train").arg("--store").arg(store).args(["--run", run, "--quiet"]);
    let flag = |argument: &str| argument.split('=').next().unwrap_or_default().to_owned();
    let given: Vec<String> = more.iter().map(|argument| flag(argument)).collect();
    command.args(SMALL.iter().filter(|argument| !given.contains(&flag(argument)))).args(more);
    command
}

pub fn train(store: &Path, run: &str, more: &[&str]) -> Output {
    finish(&mut train_command(store, run, more))
}

fn tokenize_command(store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg("tokenize").arg("--store").arg(store).args(["--run", "run", "--quiet"]).args(more);
    command
}

fn tokenize(store: &Path, more: &[&str]) -> Output {
    finish(&mut tokenize_command(store, more))
}

/// Returns the tokens of each dancer of each phrase.
fn tokens(store: &Path) -> BTreeMap<(String, i32), Vec<i32>> {
    let mut found: BTreeMap<_, Vec<_>> = BTreeMap::new();
    let mut all: Vec<TokenRow> = rows(store);
    all.sort_by_key(|row| row.position);
    for row in all {
        assert_eq!(row.tokenization, format!("{}/{}", row.run, row.phrase_id));
        let of_dancer = found.entry((row.phrase_id, row.dancer)).or_default();
        assert_eq!(row.position as usize, of_dancer.len());
        assert!((0..CODES).contains(&row.token), "{}", row.token);
        of_dancer.push(row.token);
    }
    found
}

fn query(store: &Path, sql: &str) -> Vec<Vec<String>> {
    let mut command = motiongen();
    command.arg("query").arg("--store").arg(store).args(["--format", "csv", sql]);
    let output = finish(&mut command);
    assert_eq!(output.code, 0, "{output:?}");
    let cells = |line: &str| line.split(',').map(str::to_owned).collect();
    output.stdout.lines().skip(1).map(cells).collect()
}

#[test]
fn motion_of_soloists_and_groups_becomes_tokens_and_motion_again() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let output = train(&store, "run", &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let log: Vec<TrainingLogRow> = rows(&store);
    let steps: Vec<&TrainingLogRow> = log.iter().filter(|row| row.kind == "step").collect();
    assert_eq!(steps.len(), 7);
    for row in log.iter().filter(|row| row.kind != "epoch") {
        assert_eq!(row.stage, "tokens");
        let number = |value: Option<f64>| value.expect("a number");
        let [loss, simple, commitment] = [row.loss, row.diffusion, row.commitment].map(number);
        let draft = number(row.reconstruction);
        assert!((loss - (simple + draft + 0.02 * commitment)).abs() < 1e-5 * loss, "{row:?}");
        assert!((1.0..=f64::from(CODES)).contains(&number(row.perplexity)), "{row:?}");
    }

    let output = tokenize(&store, &["--summary", "json"]);
    assert_eq!(output.code, 0, "{output:?}");
    let told: serde_json::Value = serde_json::from_str(&output.stdout).expect("an object");
    assert_eq!((&told["n_done"], &told["n_codes"]), (&17.into(), &CODES.into()));
    assert!(told["position_error_m"].is_null(), "{told}");
    let found = tokens(&store);
    assert_eq!(found.len(), 18, "sixteen soloists and a pair");
    let receipts: Vec<TokenizationRow> = rows(&store);
    assert_eq!(receipts.len(), 18);
    for row in &receipts {
        // Windows of 24 frames, a token for each 4 of a window, and one for what is left of the last.
        let n_tokens = row.n_frames / 24 * 6 + (row.n_frames % 24 + 3) / 4;
        let own = &found[&(row.phrase_id.clone(), row.dancer)];
        assert_eq!((row.n_tokens, own.len() as i64), (n_tokens, n_tokens), "{row:?}");
        assert_eq!((row.n_codes, row.frames_per_token, row.position_error_m), (CODES, 4, None));
    }
    let used: BTreeSet<i32> = found.values().flatten().copied().collect();
    assert!(used.len() > 1, "{used:?}");
    let again = tokenize(&store, &[]);
    assert!(again.stdout.contains("nothing to do: 17 phrases are up to date"), "{again:?}");

    // Usage and perplexity as docs/tokens.md asks for them.
    let counts = query(&store, "select count(*), count(distinct token) from tokens");
    let n_tokens: usize = found.values().map(Vec::len).sum();
    assert_eq!(counts, [[n_tokens.to_string(), used.len().to_string()]]);
    let sql = "with usage as (select token, count(*) as n from tokens where run = 'run' group by token), \
               total as (select sum(n) as n from usage) \
               select exp(-sum(usage.n * 1.0 / total.n * ln(usage.n * 1.0 / total.n))) as perplexity \
               from usage cross join total";
    let perplexity: f64 = query(&store, sql)[0][0].parse().expect("a number");
    let share = |token: i32| {
        let n = found.values().flatten().filter(|&&other| other == token).count();
        n as f64 / n_tokens as f64
    };
    let entropy: f64 = used.iter().map(|&token| -share(token) * share(token).ln()).sum();
    assert!((perplexity - entropy.exp()).abs() < 1e-6, "{perplexity} {}", entropy.exp());
    let told = told["perplexity"].as_f64().expect("a number");
    assert!((perplexity - told).abs() < 1e-6, "{perplexity} {told}");

    // Made again, by one worker and by three, with the same errors; tokens stay.
    let output = tokenize(&store, &["--reconstruct", "--workers=1"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("made again, positions are off by"), "{output:?}");
    let errors = |store: &Path| -> BTreeMap<(String, i32), [u64; 2]> {
        let receipts: Vec<TokenizationRow> = rows(store);
        let error = |x: Option<f64>| {
            // Bodies that never turn are made again without an error of orientation.
            let x = x.expect("an error");
            assert!(x.is_finite() && x >= 0.0, "{x}");
            x.to_bits()
        };
        let both =
            |row: &TokenizationRow| [row.position_error_m, row.orientation_error_deg].map(error);
        receipts.iter().map(|row| ((row.phrase_id.clone(), row.dancer), both(row))).collect()
    };
    let by_one = errors(&store);
    assert_eq!((by_one.len(), tokens(&store)), (18, found.clone()));
    let output = tokenize(&store, &["--reconstruct", "--workers=3", "--force"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(errors(&store), by_one);
    // A run for tokens alone leaves those with errors as they are.
    let again = tokenize(&store, &[]);
    assert!(again.stdout.contains("nothing to do: 17 phrases are up to date"), "{again:?}");
    let other = tokenize(&store, &["--reconstruct", "--seed=1"]);
    assert!(other.stdout.contains("17 phrases tokenized"), "{other:?}");
}

#[test]
fn shards_write_what_one_process_writes_and_a_broken_phrase_stops_nothing() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "run", &[]).code, 0);
    let alone = dir.at("alone");
    for (path, (bytes, _)) in crate::support::tree(&store) {
        crate::support::write(&alone.join(path), bytes);
    }
    assert_eq!(tokenize(&alone, &[]).code, 0);
    for shard in ["--shard=2/3", "--shard=0/3", "--shard=1/3"] {
        let output = tokenize(&store, &[shard, "--workers=3"]);
        assert_eq!(output.code, 0, "{output:?}");
    }
    assert_eq!(tokens(&store), tokens(&alone));
    let split = tokenize(&alone, &["--split=validation", "--force"]);
    assert!(split.stdout.contains("3 phrases tokenized"), "{split:?}");
    let one = tokenize(&alone, &["--phrase", "pair", "--force"]);
    assert!(one.stdout.contains("1 phrases tokenized (62 frames, 16 tokens)"), "{one:?}");
    assert_eq!(tokens(&store), tokens(&alone));

    // A phrase that is said to have motion, of which the table has none.
    let location = Location::local(&alone).expect("a folder");
    let ledger = Ledger::read(&location, "ingest").expect("commits");
    let mut commit = Commit::new(&location, "ingest", "", "nowhere");
    let lost = PhraseRow { phrase_id: "lost".to_owned(), ..phrases(&alone)["pair"].clone() };
    let part = commit.part(PhraseRow::schema().name, PhraseRow::schema).expect("a part");
    part.write_rows(&[lost]).expect("written");
    let item = Item {
        id: "lost".to_owned(),
        fingerprint: String::new(),
        input_hash: "lost".to_owned(),
        failure: None,
    };
    commit.settle(item, &ledger);
    commit.publish().expect("published");
    for _ in 0..2 {
        let output = tokenize(&alone, &[]);
        assert_eq!(output.code, 1, "{output:?}");
        assert!(output.stdout.contains("0 phrases tokenized"), "{output:?}");
        let failed = &failures(&alone)["run/lost"];
        assert_eq!((&*failed.stage, &*failed.kind), ("tokenize", "no_motion"));
        let sentence = "phrase lost: has no motion in the table; ingest it again";
        assert_eq!(failed.message, sentence);
    }
    assert_eq!(tokens(&store), tokens(&alone));
}

#[test]
fn a_run_goes_on_to_the_bits_of_one_that_was_never_stopped() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let newest = |run: &str| {
        let folder = store.join(format!("runs/{run}/tokens"));
        let mut found: Vec<PathBuf> = std::fs::read_dir(folder)
            .expect("checkpoints")
            .map(|entry| entry.expect("an entry").path())
            .filter(|path| path.to_string_lossy().contains("/step-"))
            .collect();
        found.sort();
        found.pop().expect("a checkpoint")
    };
    // The numbers of a checkpoint, codebook and its averages among them, without times.
    let numbers = |run: &str| -> BTreeMap<String, Vec<u8>> {
        let bytes = std::fs::read(newest(run)).expect("a file");
        let file = safetensors::SafeTensors::deserialize(&bytes).expect("a checkpoint");
        file.iter().map(|(name, tensor)| (name.to_owned(), tensor.data().to_vec())).collect()
    };
    let steps = ["--steps=60", "--save-every-steps=7"];
    let whole = train(&store, "whole", &steps);
    assert_eq!(whole.code, 0, "{whole:?}");
    let known = numbers("whole");
    for name in ["tokens.codebook", "ema.codebook", "codebook.usage", "codebook.sums"] {
        assert!(known.contains_key(name), "{name}");
    }
    for (run, threads) in [("one", "--threads=1"), ("three", "--threads=3")] {
        assert_eq!(train(&store, run, &[&steps[..], &[threads]].concat()).code, 0);
        assert!(numbers(run) == known, "{run}: other numbers");
    }
    let mut n_cut = 0;
    for at in [7, 28, 49] {
        let mut running = Running::start(train_command(&store, "parts", &steps));
        let place = store.join(format!("runs/parts/tokens/step-{at:08}.safetensors"));
        while !place.exists() && running.is_running() {
            std::thread::sleep(Duration::from_micros(300));
        }
        std::thread::sleep(Duration::from_millis(3));
        n_cut += usize::from(running.kill());
    }
    assert!(n_cut >= 1, "no kill hit");
    let rest = train(&store, "parts", &[&steps[..], &["--resume"]].concat());
    assert_eq!(rest.code, 0, "{rest:?}");
    assert!(numbers("parts") == known, "other numbers after kills");
    let log: Vec<TrainingLogRow> = rows(&store);
    let losses = |run: &str| {
        let mut found: Vec<_> = log
            .iter()
            .filter(|row| row.run == run && row.kind == "step")
            .map(|row| (row.step, row.loss.map(f64::to_bits), row.perplexity.map(f64::to_bits)))
            .collect();
        found.sort_unstable();
        found
    };
    assert_eq!(losses("whole").len(), 60);
    assert_eq!(losses("whole"), losses("parts"));
}

#[test]
fn mistakes_are_named() {
    let dir = Dir::new();
    let store = make_store(&dir);
    for (flags, expected) in [
        (
            &["--preset=large"][..],
            "--preset large is none of the family tokens; give tiny, small or base",
        ),
        (
            &["--frames-per-token=3"],
            "a token stands for 3 frames; it must be 1, 2, 4, 8 or 16, since each level of the encoder halves them",
        ),
        (&["--codes=1"], "codes is 1; it must be at least 2"),
        (
            &["--window-frames=26"],
            "a window has 26 frames; it must have a multiple of the 4 that a token stands for",
        ),
        (
            &["--prediction=epsilon"],
            "a decoder of tokens predicts clean motion; leave --prediction x0",
        ),
        (
            &["--codebook-decay=1"],
            "--codebook-decay 1 is no share; give a number from 0 to below 1",
        ),
        (&["--least-usage=0"], "--least-usage 0 is not above 0; give a positive number"),
    ] {
        let output = train(&store, "run", flags);
        assert_eq!(output.code, 2, "{output:?}");
        assert!(output.stderr.contains(expected), "{flags:?}: {output:?}");
    }
    let output = tokenize(&store, &[]);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(
        output.stderr.contains(
            "run run has no trained tokenizer; run motiongen train --family tokens --run run first"
        ),
        "{output:?}"
    );
    assert_eq!(train(&store, "run", &[]).code, 0);
    let output = tokenize(&store, &["--phrase", "phrase of another"]);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(output.stderr.contains("has no phrase phrase of another"), "{output:?}");
    let mut command = motiongen();
    command.arg("export").arg("--store").arg(&store).args(["--run", "run", "--model", "m"]);
    let output = finish(&mut command);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(
        output.stderr.contains(
            "run run has a tokenizer, which makes no motion for music; train a planner of its tokens (motiongen \
             train --family tokens --tokenizer run --run NAME) and export that run"
        ),
        "{output:?}"
    );
}
