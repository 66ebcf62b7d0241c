//! What evaluate says of tokenizers, and of motion by tokens.

use std::collections::BTreeMap;
use std::path::Path;

use motiongen::store::tables::{GenerationRow, MetricRow, TrainingLogRow, VerdictRow};

use super::{MASKED, bulk, export};
use crate::evaluate::make_store;
use crate::support::{Dir, Output, finish, motiongen, rows};
use crate::tokens::train;

fn evaluate(store: &Path, more: &[&str]) -> Output {
    let mut command = motiongen();
    command.arg("evaluate").arg("--store").arg(store).args(["--quiet", "--baseline-windows=6"]);
    finish(command.args(more))
}

/// Numbers of a run by subject, metric and variant, of whatever split.
fn numbers(store: &Path, run: &str) -> BTreeMap<[String; 3], Option<f64>> {
    let mut metrics: Vec<MetricRow> = rows(store);
    metrics.retain(|row| row.run == run);
    metrics.into_iter().map(|row| ([row.subject, row.metric, row.variant], row.value)).collect()
}

#[track_caller]
fn number(of: &BTreeMap<[String; 3], Option<f64>>, key: [&str; 3]) -> f64 {
    let found = of.get(&key.map(str::to_owned));
    found.unwrap_or_else(|| panic!("no {key:?}")).unwrap_or_else(|| panic!("nothing for {key:?}"))
}

/// Puts the codebook of one run into the checkpoint of another.
fn take_codebook(store: &Path, from: &str, into: &str) {
    let read = |run: &str| {
        let folder = store.join(format!("runs/{run}/tokens"));
        let mut files = std::fs::read_dir(folder)
            .expect("checkpoints")
            .map(|file| file.expect("a file").path());
        let best = files.find(|path| {
            path.file_name().is_some_and(|name| name.to_string_lossy().starts_with("best-"))
        });
        let path = best.expect("a checkpoint");
        (std::fs::read(&path).expect("bytes"), path)
    };
    let place = |bytes: &[u8]| {
        let length = u64::from_le_bytes(bytes[..8].try_into().expect("eight bytes")) as usize;
        let header: serde_json::Value =
            serde_json::from_slice(&bytes[8..8 + length]).expect("JSON");
        let tensors = header.as_object().expect("tensors");
        let is_codebook =
            |name: &&String| name.ends_with(".codebook") || name.as_str() == "codebook";
        // The weights that count are the averaged ones; all of that name are replaced alike.
        let found = tensors.keys().filter(is_codebook).map(|name| {
            let offsets = &tensors[name]["data_offsets"];
            let at = |i: usize| 8 + length + offsets[i].as_u64().expect("an offset") as usize;
            (name.clone(), at(0)..at(1))
        });
        found.collect::<BTreeMap<_, _>>()
    };
    let ((source, _), (mut target, path)) = (read(from), read(into));
    let (in_source, in_target) = (place(&source), place(&target));
    assert!(!in_target.is_empty() && in_source.keys().eq(in_target.keys()), "{in_target:?}");
    for (name, range) in in_target {
        target[range].copy_from_slice(&source[in_source[&name].clone()]);
    }
    std::fs::write(path, target).expect("written");
}

#[test]
fn a_tokenizer_is_held_against_motion_that_it_did_not_learn_from() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "tok", &["--steps=150"]).code, 0);
    let output = evaluate(&store, &["--tokenizer=tok"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("  5 phrases (42.8 s) evaluated;"), "{output:?}");
    let own = numbers(&store, "tok");
    // Ten windows of 24 frames and one of 17 are 60 and 5 tokens.
    let per_frame = number(&own, ["reconstructed", "tokens_per_frame", ""]);
    assert!((per_frame - 65.0 / 257.0).abs() < 1e-12, "{per_frame}");
    let share = number(&own, ["reconstructed", "code_perplexity", "share"]);
    let codes = number(&own, ["reconstructed", "code_perplexity", "codes"]);
    assert!(
        (share - codes / 16.0).abs() < 1e-12 && (1.0..=16.0).contains(&codes),
        "{share} {codes}"
    );
    let off = |of: &BTreeMap<_, _>, subject| number(of, [subject, "reconstruction_position", ""]);
    let found = off(&own, "reconstructed");
    // Thirteen phrases of chance teach nothing of where another is; what networks make without training, or of tokens in
    // another order, is other motion all the same. Motion as it is is compared with nothing.
    for subject in ["untrained", "shuffled_plan"] {
        let other = off(&own, subject);
        assert!(found > 0.0 && found != other, "{found} cm, {subject} {other} cm");
    }
    // Of what it learns from, tokens tell ever more.
    let log: Vec<TrainingLogRow> = rows(&store);
    let drafts: Vec<f64> =
        log.iter().filter(|row| row.kind == "step").filter_map(|row| row.reconstruction).collect();
    assert_eq!(drafts.len(), 150);
    let mean = |steps: &[f64]| steps.iter().sum::<f64>() / steps.len() as f64;
    let (first, last) = (mean(&drafts[..15]), mean(&drafts[135..]));
    // 0.72 was seen; who learns nothing stays at 1.
    assert!(last < 0.85 * first, "{first} at first, {last} at last");
    let drafted = off(&own, "draft");
    assert!(drafted > 0.0 && drafted != found, "{drafted} cm without the diffusion decoder");
    assert!(
        !own.contains_key(&["held_out_truth", "reconstruction_position", ""].map(str::to_owned))
    );
    assert!(number(&own, ["held_out_truth", "position_jerk", ""]) > 0.0);
    assert!(number(&own, ["reconstructed", "position_jerk", ""]) > 0.0);
    let again = evaluate(&store, &["--tokenizer=tok"]);
    assert!(again.stdout.contains("evaluated before"), "{again:?}");
    assert_eq!(numbers(&store, "tok"), own);

    // The codes of another run say other things to the decoder of this one.
    assert_eq!(train(&store, "other", &["--steps=150", "--seed=5"]).code, 0);
    take_codebook(&store, "other", "tok");
    let output = evaluate(&store, &["--tokenizer=tok"]);
    assert!(output.stdout.contains(" evaluated;"), "weights have changed: {output:?}");
    let mixed = off(&numbers(&store, "tok"), "reconstructed");
    assert!(mixed != found, "{mixed} cm by the codes of another run, as by its own");
}

#[test]
fn what_is_no_tokenizer_or_held_nothing_out_is_refused() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "tok", &["--steps=2"]).code, 0);
    assert_eq!(train(&store, "plan", &MASKED).code, 0);
    let refused = |more: &[&str], expected: &str| {
        let output = evaluate(&store, more);
        assert_eq!(output.code, 2, "{output:?}");
        assert!(output.stderr.starts_with(&format!("error: {expected}")), "{output:?}");
    };
    refused(
        &["--tokenizer=plan"],
        "run plan has no trained tokenizer; it is a planner, so name the run that it took with --tokenizer",
    );
    refused(
        &["--tokenizer=none"],
        "run none has no trained tokenizer; run motiongen train --family tokens --run none first",
    );
    let output = evaluate(&store, &["--tokenizer=tok", "--run=tok"]);
    assert!(output.stderr.contains("cannot be used with"), "{output:?}");
}

#[test]
fn motion_by_tokens_is_held_against_its_own_networks_and_loses_without_training() {
    let dir = Dir::new();
    let store = make_store(&dir);
    for (tokenizer, run, steps) in [("tok", "plan", "--steps=60"), ("tok0", "plan0", "--steps=1")] {
        assert_eq!(train(&store, tokenizer, &[steps]).code, 0);
        let tokenizer_flag = format!("--tokenizer={tokenizer}");
        assert_eq!(train(&store, run, &[&tokenizer_flag, steps]).code, 0);
        assert_eq!(export(&store, run, run).code, 0);
        let output = bulk(&store, run, &["--split=validation"]);
        assert_eq!(output.code, 0, "{output:?}");
    }
    let output = evaluate(&store, &["--run=plan"]);
    assert_eq!(output.code, 0, "{output:?}");
    let found = numbers(&store, "plan");
    for subject in
        ["generated", "shuffled", "untrained", "no_music", "shuffled_plan", "mean_motion"]
    {
        let key = match subject {
            "shuffled" => [subject, "locking_r2", "per_song"],
            _ => [subject, "axis_speed", "x"],
        };
        assert!(found.contains_key(&key.map(str::to_owned)), "no {key:?}");
    }
    let jerk = |subject| number(&found, [subject, "position_jerk", ""]);
    assert_ne!(jerk("untrained"), jerk("generated"));
    assert_ne!(jerk("shuffled_plan"), jerk("no_music"));
    // Baselines are kept: a second evaluation samples nothing.
    let kept = || std::fs::read_dir(store.join("baselines")).expect("baselines").count();
    assert_eq!(kept(), 3);
    assert_eq!(evaluate(&store, &["--run=plan", "--force"]).code, 0);
    assert_eq!((kept(), numbers(&store, "plan")), (3, found));
    // Dancers of groups have the baselines of soloists, and beside them the numbers of groups.
    let path = dir.write("path.csv", "frame,x,z\n3,0.5,0.25\n60,1,-0.5\n").display().to_string();
    let constraints = format!("--constraints={path}");
    let flags = ["--split=validation", "--run=trio", "--dancers=3", "--consistency=0.5"];
    assert_eq!(bulk(&store, "plan", &[&flags[..], &[&constraints]].concat()).code, 0);
    let output = evaluate(&store, &["--run=trio"]);
    assert_eq!(output.code, 0, "{output:?}");
    let of_groups = numbers(&store, "trio");
    for key in [
        ["generated", "least_separation", ""],
        ["copied", "least_separation", ""],
        ["untrained", "axis_speed", "x"],
        ["shuffled_plan", "axis_speed", "x"],
    ] {
        assert!(of_groups.contains_key(&key.map(str::to_owned)), "no {key:?}");
    }
    assert!(number(&of_groups, ["generated", "least_separation", ""]) >= 0.7 - 1e-5);
    // Every dancer is held against its own way: 1.6 m and more are between the outer ones and the middle.
    let missed_mm = number(&of_groups, ["generated", "control_average_error", "position"]);
    assert!(missed_mm < 0.01, "{missed_mm} mm");

    let output = evaluate(&store, &["--run=plan0", "--require=sound,follows-music"]);
    assert_eq!(output.code, 1, "{output:?}");
    let verdicts: Vec<VerdictRow> = rows(&store);
    let outcome = |verdict: &str| {
        let mut of = verdicts.iter().filter(|row| row.run == "plan0" && row.verdict == verdict);
        of.next().map(|row| row.verdict_outcome.clone())
    };
    assert_eq!(outcome("sound").as_deref(), Some("lost"));
    assert_ne!(outcome("follows_music").as_deref(), Some("won"));
    let made: Vec<GenerationRow> = rows(&store);
    assert!(made.iter().all(|row| row.constraints.is_some() == (row.run == "trio")));
}
