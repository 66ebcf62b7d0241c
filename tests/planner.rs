//! Planners of tokens from training to motion, as a user makes and uses them.

mod evaluation;
mod group;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Duration;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::read_f32;
use motiongen::store::tables::{GenerationRow, OnnxCheckRow, TrainingLogRow};

use crate::ingest_kill::Running;
use crate::support::files::{beats, wav};
use crate::support::{Dir, Output, finish, motiongen, rows};
use crate::tokens::{make_store, train, train_command};

/// A planner of the tokens of the run `tok`.
pub const MASKED: [&str; 1] = ["--tokenizer=tok"];
pub const AUTOREGRESSIVE: [&str; 3] = ["--tokenizer=tok", "--planner=autoregressive", "--style"];

pub fn store_with_tokenizer(dir: &Dir) -> PathBuf {
    let store = make_store(dir);
    // Until it has learned something, a decoder makes the same of all tokens and all noise: nothing.
    let output = train(&store, "tok", &["--steps=60"]);
    assert_eq!(output.code, 0, "{output:?}");
    store
}

pub fn export(store: &Path, run: &str, model: &str) -> Output {
    let mut command = motiongen();
    command.arg("export").arg("--store").arg(store);
    command.args(["--run", run, "--model", model, "--quiet"]);
    finish(&mut command)
}

/// A song of 7 s with its beats.
pub fn song(dir: &Dir) -> PathBuf {
    dir.write("songs/song.beats.txt", beats(14, 120.0, Some(4)));
    dir.write("songs/song.wav", wav(7.0))
}

pub fn generate(store: &Path, model: &str, audio: &Path, into: &Path, more: &[&str]) -> Output {
    let mut command = motiongen();
    command.arg("generate").arg("--model").arg(store.join("models").join(model));
    command.arg("--audio").arg(audio).arg("--output").arg(into);
    command.args(["--overlap=9", "--quiet"]).args(more);
    finish(&mut command)
}

fn bulk(store: &Path, model: &str, more: &[&str]) -> Output {
    let mut command = motiongen();
    command.arg("generate").arg("--store").arg(store);
    command.args(["--model", model, "--overlap=9", "--steps=3", "--tracks=all", "--quiet"]);
    finish(command.args(more))
}

#[test]
fn planners_of_both_kinds_are_trained_exported_and_danced_in_files() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    let (audio, out) = (song(&dir), dir.at("out"));
    for (run, flags) in [("plan", &MASKED[..]), ("next", &AUTOREGRESSIVE)] {
        let output = train(&store, run, &[flags, &["--steps=30"]].concat());
        assert_eq!(output.code, 0, "{output:?}");
        let log: Vec<TrainingLogRow> = rows(&store);
        let losses: Vec<f64> = log
            .iter()
            .filter(|row| row.run == run && row.kind == "step")
            .map(|row| {
                assert_eq!((row.stage.as_str(), row.diffusion), ("planner", None));
                row.loss.expect("a loss")
            })
            .collect();
        assert_eq!(losses.len(), 30);
        // Of 16 tokens nothing is known at first: ln 16.
        assert!((2.2..3.5).contains(&losses[0]), "{run}: {losses:?}");
        assert!(losses[25..].iter().sum::<f64>() < losses[..5].iter().sum::<f64>(), "{losses:?}");

        let output = export(&store, run, run);
        assert_eq!(output.code, 0, "{output:?}");
        let checks: Vec<OnnxCheckRow> = rows(&store);
        let of_steps = if run == "next" { &["planner_step"][..] } else { &[] };
        for name in [&["tokens", "signal", "forward", "planner"], of_steps].concat() {
            let found = checks.iter().filter(|row| row.model == run && row.check == name);
            let found: Vec<_> = found.collect();
            assert_eq!(found.len(), 3, "{name}");
            assert!(
                found.iter().all(|row| row.passed && row.max_abs <= row.tolerance),
                "{found:?}"
            );
        }
        let again = export(&store, run, run);
        assert!(again.stdout.contains("up to date"), "{again:?}");

        let into = out.join(run);
        let output = generate(&store, run, &audio, &into, &["--format=npy,csv"]);
        assert_eq!(output.code, 0, "{output:?}");
        assert!(output.stdout.contains("DDPM in 27 steps"), "{output:?}");
        let bytes = std::fs::read(into.join("song.npy")).expect("a file");
        let motion = read_f32(&bytes).expect("an array");
        assert_eq!(motion.shape, [211, MOTION_DIM]);
        assert!(motion.values.iter().all(|x| x.is_finite()));
        let again = generate(&store, run, &audio, &into, &["--format=npy,csv"]);
        assert!(again.stdout.contains("nothing to do: 1 motions are up to date"), "{again:?}");
        for same in [&["--threads=1"][..], &["--threads=3"]] {
            let flags = [&["--format=npy,csv", "--force"], same].concat();
            let output = generate(&store, run, &audio, &into, &flags);
            assert_eq!(output.code, 0, "{output:?}");
            assert!(std::fs::read(into.join("song.npy")).expect("a file") == bytes, "{same:?}");
        }
        if run == "next" {
            // A name stands for the mean of its phrases, and gives the motion that these eight values give.
            let named: BTreeMap<String, [f32; 8]> = styles_of_card(&store, run);
            let names: Vec<&String> = named.keys().collect();
            assert_eq!(names, ["break", "middle hip-hop"]);
            assert_ne!(named["break"], named["middle hip-hop"]);
            let values = named["break"].map(|x| x.to_string()).join(",");
            let [by_name, by_values] = ["break", values.as_str()].map(|style| {
                let flags =
                    [format!("--style={style}"), "--format=npy".to_owned(), "--force".to_owned()];
                let flags: Vec<&str> = flags.iter().map(String::as_str).collect();
                let output = generate(&store, run, &audio, &into, &flags);
                assert_eq!(output.code, 0, "{output:?}");
                std::fs::read(into.join("song.npy")).expect("a file")
            });
            assert!(by_name == by_values, "a name and its values give other motion");
            let output = generate(&store, run, &audio, &into, &["--style=polka"]);
            let expected = "error: model next has no style \"polka\"; it has break, middle hip-hop";
            assert!(output.code == 2 && output.stderr.starts_with(expected), "{output:?}");
        }
        let of_style = "--style=1,0,0,0,-1,0,0.5,0";
        for other in [
            "--seed=5",
            "--plan-top=1",
            "--guidance=7",
            "--steps=4",
            "--plan-temperature=0",
            of_style,
        ] {
            if other == of_style && run != "next" {
                continue;
            }
            let output = generate(&store, run, &audio, &into, &["--format=npy,csv", other]);
            assert_eq!(output.code, 0, "{output:?}");
            let found = std::fs::read(into.join("song.npy")).expect("a file");
            // What has hardly learned anything may say the same of the music whatever is made of it.
            let may_be_same = other == "--guidance=7" || other == of_style;
            assert!(found != bytes || may_be_same, "{other}: the same bytes");
        }
    }
}

/// Returns the named styles of a model of a store.
fn styles_of_card(store: &Path, model: &str) -> BTreeMap<String, [f32; 8]> {
    let text = std::fs::read(store.join(format!("models/{model}/model.json"))).expect("a card");
    let card: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
    serde_json::from_value(card["styles"].clone()).expect("styles by name")
}

#[test]
fn motion_is_planned_for_the_phrases_of_a_store_and_measured() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    assert_eq!(train(&store, "plan", &MASKED).code, 0);
    assert_eq!(export(&store, "plan", "m").code, 0);
    let output = bulk(&store, "m", &["--run=one"]);
    // One phrase is a motion of two dancers without music.
    assert_eq!(output.code, 1, "{output:?}");
    assert!(output.stdout.contains("16 motions made"), "{output:?}");
    assert!(output.stdout.contains("failed [no_music] one/pair/0"), "{output:?}");
    let made: Vec<GenerationRow> = rows(&store);
    assert_eq!(made.len(), 16);
    assert!(made.iter().all(|row| row.n_dancers == Some(1) && row.engine == "eager"));
    let output = bulk(&store, "m", &["--run=one"]);
    assert!(output.stdout.contains("16 up to date"), "{output:?}");
    // Two shards write the bytes of one process.
    for shard in ["--shard=0/2", "--shard=1/2"] {
        let output = bulk(&store, "m", &["--run=two", shard, "--threads=1"]);
        assert!(output.code <= 1, "{output:?}");
    }
    let sums = |run: &str| {
        let sql = format!(
            "select count(*) as n, sum(position_x) as x, sum(quaternion_w) as w from generated where generation \
             like '{run}/%'"
        );
        let mut command = motiongen();
        command.arg("query").arg("--store").arg(&store).args(["--format", "csv", &sql]);
        let output = finish(&mut command);
        assert_eq!(output.code, 0, "{output:?}");
        output.stdout.lines().nth(1).expect("a row").to_owned()
    };
    let (one, two) = (sums("one"), sums("two"));
    let numbers = |row: &str| -> Vec<f64> {
        row.split(',').map(|cell| cell.parse().expect("a number")).collect()
    };
    for (a, b) in numbers(&one).into_iter().zip(numbers(&two)) {
        // Rows are summed in another order.
        assert!((a - b).abs() <= 1e-6 * a.abs().max(1.0), "{one} {two}");
    }
    let mut command = motiongen();
    command.arg("evaluate").arg("--store").arg(&store).args(["--run", "one", "--quick", "--quiet"]);
    let output = finish(&mut command);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("16 motions"), "{output:?}");
}

#[test]
fn a_planner_goes_on_to_the_bits_of_one_that_was_never_stopped() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    let numbers = |run: &str| -> BTreeMap<String, Vec<u8>> {
        let folder = store.join(format!("runs/{run}/planner"));
        let mut found: Vec<PathBuf> = std::fs::read_dir(folder)
            .expect("checkpoints")
            .map(|entry| entry.expect("an entry").path())
            .filter(|path| path.to_string_lossy().contains("/step-"))
            .collect();
        found.sort();
        let bytes = std::fs::read(found.pop().expect("a checkpoint")).expect("a file");
        let file = safetensors::SafeTensors::deserialize(&bytes).expect("a checkpoint");
        file.iter().map(|(name, tensor)| (name.to_owned(), tensor.data().to_vec())).collect()
    };
    for (kind, flags) in [("masked", &MASKED[..]), ("autoregressive", &AUTOREGRESSIVE)] {
        let steps = [flags, &["--steps=40", "--save-every-steps=7"]].concat();
        let whole = format!("whole-{kind}");
        let output = train(&store, &whole, &steps);
        assert_eq!(output.code, 0, "{output:?}");
        let known = numbers(&whole);
        assert!(known.contains_key("planner.table") && known.contains_key("ema.table"));
        for threads in ["--threads=1", "--threads=3"] {
            let run = format!("{kind}{threads}").replace("--threads=", "-");
            assert_eq!(train(&store, &run, &[&steps[..], &[threads]].concat()).code, 0);
            assert!(numbers(&run) == known, "{run}: other numbers");
        }
        let parts = format!("parts-{kind}");
        for at in [7, 21] {
            let mut running = Running::start(train_command(&store, &parts, &steps));
            let place = store.join(format!("runs/{parts}/planner/step-{at:08}.safetensors"));
            while !place.exists() && running.is_running() {
                std::thread::sleep(Duration::from_micros(300));
            }
            running.kill();
        }
        let rest = train(&store, &parts, &[&steps[..], &["--resume"]].concat());
        assert_eq!(rest.code, 0, "{rest:?}");
        assert!(numbers(&parts) == known, "{kind}: other numbers after kills");
    }
}

#[test]
fn mistakes_are_named() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    let refused = |output: Output, expected: &str| {
        assert_eq!(output.code, 2, "{output:?}");
        assert!(output.stderr.contains(expected), "{expected}: {output:?}");
    };
    for (flags, expected) in [
        (
            &["--tokenizer=none"][..],
            "run none has no trained tokenizer; run motiongen train --family tokens --run none first",
        ),
        (
            &["--tokenizer=plan"],
            "--run and --tokenizer are both plan; give the planner a name of its own with --run",
        ),
        (
            &["--tokenizer=tok", "--window-frames=48"],
            "--window-frames 48 is not the 24 of tokenizer tok, whose tokens mean nothing in other windows; give \
             --window-frames 24",
        ),
        (
            &["--tokenizer=tok", "--codes=17"],
            "--codes 17 is not the 16 of tokenizer tok; leave --codes out",
        ),
        (
            &["--tokenizer=tok", "--preset=large"],
            "--preset large is none of a planner; give tiny, small or base",
        ),
        (
            &["--tokenizer=tok", "--token-replacement=1"],
            "--token-replacement 1 is no share; give a number from 0 to below 1",
        ),
    ] {
        refused(train(&store, "plan", flags), expected);
    }
    refused(
        train(&store, "tok", &["--tokenizer=other"]),
        "run tok is a tokenizer; give the planner a name of its own with --run",
    );
    assert_eq!(train(&store, "plan", &MASKED).code, 0);
    refused(
        train(&store, "plan", &[]),
        "run plan is a planner; give the tokenizer a name of its own with --run",
    );
    refused(
        train(&store, "other", &["--tokenizer=plan"]),
        "--tokenizer plan is a planner; name the run of the tokenizer that it was trained with",
    );
    let mut command = motiongen();
    command.arg("tokenize").arg("--store").arg(&store).args(["--run", "plan", "--quiet"]);
    refused(
        finish(&mut command),
        "run plan has no trained tokenizer; it is a planner, so name the run that it took with --tokenizer",
    );
    assert_eq!(export(&store, "plan", "m").code, 0);
    let (audio, out) = (song(&dir), dir.at("out"));
    for (flags, expected) in [
        (
            &["--best-of=3"][..],
            "--best-of: model m is of the family tokens, which does not know it; leave it out, or name a model of \
             the family unet",
        ),
        (
            &["--dancers=2", "--consistency-scale=0.5"],
            "--consistency-scale: model m is of the family tokens, which does not know it; leave it out, or name a model \
             of the family group",
        ),
        (
            &["--dancers=2", "--consistency-form=mean"],
            "--consistency-form: model m is of the family tokens, which does not know it; leave it out, or name a model \
             of the family group",
        ),
        (
            &["--plan-iterations=0"],
            "tokens are drawn in 0 iterations; it must be 1 to 100000, and 10 are usual",
        ),
        (
            &["--plan-top=1.5"],
            "the share of tokens that may be drawn is 1.5; it must lie above 0 and not above 1, and 0.1 is usual",
        ),
        (&["--overlap=24"], "--overlap 24 is not below the 24 frames of a window of model m"),
        (&["--style=0,0,0,0,0,0,0,0"], "model m takes no style; leave --style out"),
    ] {
        let flags = [flags, &["--dry-run"]].concat();
        let mut command = motiongen();
        command.arg("generate").arg("--model").arg(store.join("models/m"));
        command.arg("--audio").arg(&audio).arg("--output").arg(&out).arg("--quiet").args(&flags);
        if !flags.iter().any(|flag| flag.starts_with("--overlap")) {
            command.arg("--overlap=9");
        }
        refused(finish(&mut command), expected);
    }
    // A tokenizer that goes on learning has other tokens.
    assert_eq!(train(&store, "tok", &["--force", "--seed=3"]).code, 0);
    refused(export(&store, "plan", "n"), "run plan plans the tokens of tok with the weights ");
}

#[test]
fn the_use_of_codes_is_drawn() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    let plot = |more: &[&str]| {
        let mut command = motiongen();
        command.arg("plot").arg("tokens").arg("--store").arg(&store).args(more);
        finish(command.arg("--output").arg(dir.at("codes.svg")))
    };
    let output = plot(&["--run=tok"]);
    assert_eq!(output.code, 2, "{output:?}");
    let expected = "has no tokens of run tok; run motiongen tokenize --run tok first";
    assert!(output.stderr.contains(expected), "{output:?}");
    let mut command = motiongen();
    command.arg("tokenize").arg("--store").arg(&store).args(["--run", "tok", "--quiet"]);
    assert_eq!(finish(&mut command).code, 0);
    let output = plot(&["--run=tok"]);
    assert_eq!(output.code, 0, "{output:?}");
    let picture = std::fs::read_to_string(dir.at("codes.svg")).expect("a picture");
    assert!(picture.contains("of 17 phrases"), "{picture}");
    let output = plot(&["--run=tok", "--phrase=nobody"]);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(output.stderr.contains("has no tokens of phrase \"nobody\" by run tok"), "{output:?}");
}

#[test]
fn motion_passes_where_constraints_ask_it_to() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    assert_eq!(train(&store, "plan", &MASKED).code, 0);
    assert_eq!(export(&store, "plan", "m").code, 0);
    let (audio, out) = (song(&dir), dir.at("out"));
    let text = "[start]\nposition = [0.5, 0.9, -1.0]\n[[keyframe]]\ntime_s = 2.5\nposition = [1.0, 0.9, 0.5]\n\
                [[keyframe]]\nframe = 140\nheading_deg = 40.0\n";
    let asked = dir.write("c.toml", text).display().to_string();
    let output = generate(&store, "m", &audio, &out, &["--format=npy", "--constraints", &asked]);
    assert_eq!(output.code, 0, "{output:?}");
    let bytes = std::fs::read(out.join("song.npy")).expect("a file");
    let motion = read_f32(&bytes).expect("an array");
    let at = |frame: usize, channel: usize| motion.values[frame * MOTION_DIM + channel];
    for (frame, wanted) in [(0, [0.5, 0.9, -1.0]), (75, [1.0, 0.9, 0.5])] {
        for (axis, wanted) in wanted.into_iter().enumerate() {
            let found = at(frame, axis);
            assert!((found - wanted).abs() < 1e-3, "frame {frame}: {found} for {wanted}");
        }
    }
    // cos and sin of 20° about y.
    let (w, y) = (at(140, 9), at(140, 11));
    let turn = (2.0 * y.atan2(w)).to_degrees();
    assert!((turn - 40.0).abs() < 0.5 || (turn + 320.0).abs() < 0.5, "{turn}");
    // A whole path over the floor as a table and as an array, in a width that no table of motion has.
    let path = |t: usize| [0.3 + 0.01 * t as f64, 0.9, (0.05 * t as f64).sin()];
    let table: String = (0..211)
        .map(|t| {
            let [x, _, z] = path(t);
            format!("{t},{x},{z}\n")
        })
        .collect();
    let table = dir.write("path.csv", format!("frame,x,z\n{table}")).display().to_string();
    let values: Vec<f64> = (0..211).flat_map(path).collect();
    let array = dir.write("path.npy", motiongen::motion::npy::write(&[211, 3], &values));
    let array = array.display().to_string();
    let motion_of = |file: &str, more: &[&str]| -> Vec<f32> {
        let flags = [&["--format=npy", "--constraints", file], more].concat();
        let output = generate(&store, "m", &audio, &out, &flags);
        assert_eq!(output.code, 0, "{output:?}");
        read_f32(&std::fs::read(out.join("song.npy")).expect("a file")).expect("an array").values
    };
    let worst_mm = |motion: &[f32], axes: &[usize]| -> f64 {
        let errors = (0..211).flat_map(|t| axes.iter().map(move |&axis| (t, axis)));
        let errors = errors
            .map(|(t, axis)| (f64::from(motion[t * MOTION_DIM + axis]) - path(t)[axis]).abs());
        1e3 * errors.fold(0.0, f64::max)
    };
    for control in [&[][..], &["--control=both"], &["--control=decode"]] {
        let motion = motion_of(&table, control);
        assert!(worst_mm(&motion, &[0, 2]) < 0.01, "{control:?}: {}", worst_mm(&motion, &[0, 2]));
        let motion = motion_of(&array, control);
        assert!(worst_mm(&motion, &[0, 1, 2]) < 0.01, "{control:?}");
    }
    for control in ["--control=plan", "--control=none"] {
        let motion = motion_of(&array, &[control]);
        assert!(worst_mm(&motion, &[0, 1, 2]) > 20.0, "{control}: nothing is enforced");
    }
    let (both, again) = (motion_of(&array, &[]), motion_of(&array, &["--control=both"]));
    assert_eq!(both, again);
    let outside = dir.write("d.toml", "[[keyframe]]\nframe = 300\nposition_y = 0.5\n");
    let outside = outside.display().to_string();
    let output = generate(&store, "m", &audio, &out, &["--format=npy", "--constraints", &outside]);
    assert_eq!(output.code, 1, "{output:?}");
    assert!(output.stdout.contains("but the track has 211 frames"), "{output:?}");
}

#[test]
fn a_planner_without_constraints_is_used_as_before_and_says_what_it_cannot_do() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    assert_eq!(train(&store, "plan", &["--tokenizer=tok", "--no-constraints"]).code, 0);
    assert_eq!(export(&store, "plan", "m").code, 0);
    let card = std::fs::read_to_string(store.join("models/m/model.json")).expect("a card");
    assert!(!card.contains("constraint_dim"), "{card}");
    let (audio, out) = (song(&dir), dir.at("out"));
    let asked = dir.write("c.csv", "time_s,x,y,z\n2.5,1.0,0.9,0.5\n").display().to_string();
    let flags = ["--format=npy", "--constraints", &asked];
    let output = generate(&store, "m", &audio, &out, &flags);
    assert_eq!(output.code, 0, "{output:?}");
    let bytes = std::fs::read(out.join("song.npy")).expect("a file");
    let motion = read_f32(&bytes).expect("an array").values;
    for (axis, wanted) in [1.0_f32, 0.9, 0.5].into_iter().enumerate() {
        assert!((motion[75 * MOTION_DIM + axis] - wanted).abs() < 1e-5);
    }
    for control in ["plan", "both"] {
        let flag = format!("--control={control}");
        let output = generate(&store, "m", &audio, &out, &[&flags[..], &[&flag]].concat());
        assert_eq!(output.code, 2, "{output:?}");
        let expected = format!(
            "--control {control}: the planner of model m knows nothing of constraints; give decode or none, or train \
             a planner without --no-constraints"
        );
        assert!(output.stderr.contains(&expected), "{output:?}");
    }
    let broken = dir.write("d.csv", "time_s,x\n0,left\n").display().to_string();
    let output = generate(&store, "m", &audio, &out, &["--format=npy", "--constraints", &broken]);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(
        output
            .stderr
            .contains("d.csv has no constraints: line 2: x reads \"left\", which is no number"),
        "{output:?}"
    );
    let refused = train(&store, "other", &["--tokenizer=tok", "--constraint-dropout=1"]);
    assert_eq!(refused.code, 2, "{refused:?}");
    assert!(
        refused
            .stderr
            .contains("--constraint-dropout 1 is no share; give a number from 0 to below 1"),
        "{refused:?}"
    );
}
