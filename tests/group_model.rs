//! A model of groups from training to files, as a user makes and uses it.

use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::{read_f32, write};
use motiongen::store::tables::{GenerationRow, OnnxCheckRow, TrainingLogRow};
use ndarray::{Array2, Array3, s};
use zip::CompressionMethod;

use crate::support::files::{beats, coherent, npz, wav};
use crate::support::{Dir, Output, finish, motiongen, rows};
use crate::train::features;

/// A network that learns in milliseconds.
const SMALL: [&str; 8] = [
    "--family=group",
    "--preset=tiny",
    "--window-frames=24",
    "--batch-size=6",
    "--negatives=2",
    "--threads=2",
    "--steps=7",
    "--validate-every=100",
];

/// Writes phrases of 2 to 4 dancers, 13 to train and 3 to validate, and a soloist.
pub fn make_store(dir: &Dir) -> PathBuf {
    let (source, store) = (dir.at("source"), dir.at("store"));
    let names = |split: &'static str, n: usize| {
        let all = (0..).map(|i| format!("phrase {i:03}"));
        all.filter(move |id| motiongen::store::split_of(id) == split).take(n)
    };
    for (i, id) in names("train", 13).chain(names("validation", 3)).enumerate() {
        let (n_dancers, n_frames) = (1 + i % 4, 29 + 16 * (i % 3));
        let mut group = Array3::zeros((n_dancers, n_frames, MOTION_DIM));
        for (dancer, mut of_dancer) in group.outer_iter_mut().enumerate() {
            let values = coherent(n_frames, (7 * i + dancer) as u32);
            of_dancer.assign(&Array2::from_shape_fn((n_frames, MOTION_DIM), |(t, c)| values[t][c]));
            of_dancer.slice_mut(s![.., 0]).mapv_inplace(|x| x + 1.5 * dancer as f32);
        }
        let shape = [n_dancers, n_frames, MOTION_DIM];
        let bytes = match n_dancers {
            1 => write(&shape[1..], group.as_slice().expect("in order")),
            _ => write(&shape, group.as_slice().expect("in order")),
        };
        crate::support::write(&source.join(format!("motion/{id}/trajectory.npy")), bytes);
        let heard = npz(&features(&coherent(n_frames, 7 * i as u32)), CompressionMethod::Deflated);
        crate::support::write(&source.join(format!("audio_features/{id}/features.npz")), heard);
    }
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

fn train(store: &Path, run: &str, more: &[&str]) -> Output {
    finish(&mut train_command(store, run, more))
}

fn export(store: &Path, run: &str, more: &[&str]) -> Output {
    let mut command = motiongen();
    command.arg("export").arg("--store").arg(store);
    command.args(["--run", run, "--model", "group", "--quiet"]).args(more);
    finish(&mut command)
}

/// A song of 7 s with its beats.
fn song(dir: &Dir) -> PathBuf {
    dir.write("songs/song.beats.txt", beats(14, 120.0, Some(4)));
    dir.write("songs/song.wav", wav(7.0))
}

fn generate(store: &Path, audio: &Path, into: &Path, more: &[&str]) -> Output {
    let mut command = motiongen();
    command.arg("generate").arg("--model").arg(store.join("models/group"));
    command.arg("--audio").arg(audio).arg("--output").arg(into);
    command.args(["--steps=4", "--quiet"]).args(more);
    if !more.iter().any(|flag| flag.starts_with("--overlap")) {
        command.arg("--overlap=9");
    }
    finish(&mut command)
}

fn motion(path: &Path) -> Array3<f32> {
    let array = read_f32(&std::fs::read(path).expect("a file")).expect("an array");
    let [n, frames, channels] = array.shape[..] else { panic!("{:?}", array.shape) };
    Array3::from_shape_vec((n, frames, channels), array.values).expect("as many")
}

#[test]
fn groups_are_learned_from_and_danced_in_files() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let output = train(&store, "run", &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let log: Vec<TrainingLogRow> = rows(&store);
    let steps: Vec<&TrainingLogRow> = log.iter().filter(|row| row.kind == "step").collect();
    assert_eq!(steps.len(), 7);
    for row in &steps {
        assert_eq!(row.stage, "group");
        let loss_of = |value: Option<f64>| value.expect("a loss");
        let [simple, markers, contrast] =
            [loss_of(row.diffusion), loss_of(row.markers), loss_of(row.contrast)];
        let total = simple + markers + 0.01 * contrast;
        assert!((loss_of(row.loss) - total).abs() < 1e-5 * total, "{row:?}");
        // Of one group and two mixed ones nothing is known at first: ln 3.
        assert!((0.5..2.5).contains(&contrast), "{contrast}");
    }

    let output = export(&store, "run", &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let checks: Vec<OnnxCheckRow> = rows(&store);
    let names: Vec<&str> = checks.iter().map(|row| row.check.as_str()).collect();
    assert_eq!(names.iter().filter(|name| **name == "forward").count(), 4, "{names:?}");
    for check in ["score", "agreement"] {
        assert_eq!(names.iter().filter(|name| **name == check).count(), 4, "{check}: {names:?}");
    }
    assert!(checks.iter().all(|row| row.passed && row.max_abs <= 1e-4), "{checks:?}");
    let again = export(&store, "run", &[]);
    assert!(again.stdout.contains("up to date"), "{again:?}");

    let (audio, out) = (song(&dir), dir.at("out"));
    let formats = "--format=npy,csv,glb,html";
    let asked = ["--dancers=5", "--consistency=0.5", formats];
    let output = generate(&store, &audio, &out, &asked);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("5 dancers, consistency 0.5"), "{output:?}");
    let five = motion(&out.join("song.npy"));
    assert_eq!(five.dim(), (5, 211, MOTION_DIM));
    assert!(five.iter().all(|x| x.is_finite()));
    // Bodies of 0.35 m that do not touch.
    for (i, a) in five.outer_iter().enumerate() {
        for b in five.outer_iter().skip(i + 1) {
            for (a, b) in a.rows().into_iter().zip(b.rows()) {
                let apart = f64::from(a[0] - b[0]).hypot(f64::from(a[2] - b[2]));
                assert!(apart >= 0.7 - 1e-5, "{apart}");
            }
        }
    }
    let again = generate(&store, &audio, &out, &asked);
    assert!(again.stdout.contains("nothing to do: 1 motions are up to date"), "{again:?}");
    let bytes = std::fs::read(out.join("song.npy")).expect("a file");
    let one_thread = ["--threads=1", "--force", "--dancers=5", "--consistency=0.5", formats];
    let output = generate(&store, &audio, &out, &one_thread);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(std::fs::read(out.join("song.npy")).expect("a file") == bytes, "other bytes");
    // Another consistency is another motion; one dancer is a soloist's file.
    let output = generate(&store, &audio, &out, &["--dancers=5", "--consistency=-1", formats]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(std::fs::read(out.join("song.npy")).expect("a file") != bytes, "the same bytes");
    let output = generate(&store, &audio, &dir.at("one"), &["--dancers=1", "--format=npy"]);
    assert_eq!(output.code, 0, "{output:?}");
    let one = read_f32(&std::fs::read(dir.at("one/song.npy")).expect("a file")).expect("an array");
    assert_eq!(one.shape, [211, MOTION_DIM]);
}

#[test]
fn a_run_goes_on_to_the_bits_of_one_that_was_never_stopped() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let whole = train(&store, "whole", &["--save-every-steps=3"]);
    assert_eq!(whole.code, 0, "{whole:?}");
    let parts = ["--save-every-steps=3", "--threads=1"];
    assert_eq!(train(&store, "parts", &parts).code, 0);
    // As if it had been killed after its sixth step.
    let checkpoint = |step: u32| store.join(format!("runs/parts/group/step-{step:08}.safetensors"));
    assert!(checkpoint(6).exists());
    std::fs::remove_file(checkpoint(7)).expect("removed");
    let rest = train(&store, "parts", &["--save-every-steps=3", "--resume"]);
    assert_eq!(rest.code, 0, "{rest:?}");
    assert!(checkpoint(7).exists());
    let log: Vec<TrainingLogRow> = rows(&store);
    let losses = |run: &str| {
        let mut found: Vec<(i64, Option<u64>)> = log
            .iter()
            .filter(|row| row.run == run && row.kind == "step")
            .map(|row| (row.step, row.loss.map(f64::to_bits)))
            .collect();
        found.sort_unstable();
        found
    };
    assert_eq!(losses("whole").len(), 7);
    assert_eq!(losses("whole"), losses("parts"));
}

#[test]
fn groups_are_made_for_the_phrases_of_a_store_and_measured() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "run", &[]).code, 0);
    assert_eq!(export(&store, "run", &[]).code, 0);
    let bulk = |more: &[&str]| {
        let mut command = motiongen();
        command.arg("generate").arg("--store").arg(&store);
        command.args(["--model", "group", "--steps=3", "--overlap=9", "--quiet"]).args(more);
        finish(&mut command)
    };
    let output = bulk(&["--dancers=3", "--tracks=all"]);
    assert_eq!(output.code, 0, "{output:?}");
    let made: Vec<GenerationRow> = rows(&store);
    assert_eq!(made.len(), 16);
    assert!(made.iter().all(|row| row.n_dancers == Some(3) && row.consistency == Some(0.0)));
    let sql = "select generation, count(*) as n, max(dancer) as last from generated group by generation limit 1";
    let mut command = motiongen();
    command.arg("query").arg("--store").arg(&store).args(["--format", "csv", sql]);
    let output = finish(&mut command);
    assert!(output.stdout.lines().nth(1).is_some_and(|line| line.ends_with(",2")), "{output:?}");
    let output = bulk(&["--dancers=3", "--tracks=all"]);
    assert!(output.stdout.contains("nothing to do: 16 motions are up to date"), "{output:?}");
}

#[test]
fn mistakes_are_named() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let output = train(&store, "run", &["--preset=large"]);
    assert_eq!(output.code, 2);
    assert!(
        output
            .stderr
            .contains("--preset large is none of the family group; give tiny, small or base"),
        "{output:?}"
    );
    let output = train(&store, "run", &["--batch-size=5"]);
    assert_eq!(output.code, 2);
    let odd = "--batch-size 5 is odd; groups are told from mixed ones in pairs to the same music, so give 4 or 6";
    assert!(output.stderr.contains(odd), "{output:?}");
    assert_eq!(train(&store, "run", &[]).code, 0);
    assert_eq!(export(&store, "run", &[]).code, 0);
    let (audio, out) = (song(&dir), dir.at("out"));
    for (flags, expected) in [
        (&["--dancers=17"][..], "--dancers 17 is none of 1 to 16; make larger groups of several"),
        (
            &["--consistency=1.5"],
            "--consistency 1.5 is not from -1 to 1; give -1 for dancers who go each a way of their own, 1 for unison",
        ),
        (
            &["--best-of=2"],
            "--best-of: model group is of the family group, which does not know it; leave it out, or name a model \
             of the family unet",
        ),
        (&["--overlap=24"], "--overlap 24 is not below the 24 frames of a window of model group"),
    ] {
        let output = generate(&store, &audio, &out, &[flags, &["--dry-run"]].concat());
        assert_eq!(output.code, 2, "{output:?}");
        assert!(output.stderr.contains(expected), "{output:?}");
    }
    // A model of one dancer makes no group, and a command for soloists takes no model of groups.
    let mut command = motiongen();
    command.arg("generate").arg("--audio").arg(&audio).arg("--output").arg(&out);
    let output = finish(command.args(["--model=pretrained", "--dancers=5", "--quiet"]));
    assert_eq!(output.code, 2, "{output:?}");
    assert!(
        output.stderr.contains(
            "--dancers 5: model pretrained is of the family unet, which makes one dancer; name one of the family \
             group with --model, or leave --dancers out"
        ),
        "{output:?}"
    );
    let mut command = motiongen();
    command.arg("model").arg("--store").arg(&store).args(["--model", "group", "--quiet"]);
    let output = finish(&mut command);
    assert_eq!(output.code, 2, "{output:?}");
    assert!(
        output
            .stderr
            .contains("is a model of the family group, and one of the family unet is needed"),
        "{output:?}"
    );
}

#[test]
fn what_is_no_card_of_a_group_is_refused() {
    use motiongen::generation::{FamilyCard as _, GroupCard};
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "run", &[]).code, 0);
    assert_eq!(export(&store, "run", &[]).code, 0);
    let text = std::fs::read_to_string(store.join("models/group/model.json")).expect("a card");
    assert!(GroupCard::read(text.as_bytes(), "card").is_ok());
    let refusal = |from: &str, to: &str| {
        assert!(text.contains(from), "{from}");
        let changed = text.replacen(from, to, 1);
        GroupCard::read(changed.as_bytes(), "card").expect_err(to).to_string()
    };
    assert_eq!(
        refusal("\"family\": \"group\"", "\"family\": \"tokens\""),
        "card: is a model of the family tokens, and one of the family group is needed"
    );
    assert!(
        refusal("\"n_steps\": 1000", "\"n_steps\": 30000000")
            .contains("make a table of 1440000000 values")
    );
    assert_eq!(
        refusal("\"width\": 48", "\"width\": 4800000"),
        "card: width is 4800000; it must be at most 16384"
    );
    assert!(refusal("\"denoiser.onnx\"", "\"../denoiser.onnx\"").contains("a model has no file"));
    assert_eq!(
        refusal("\"denoiser.onnx\"", "\"unet.onnx\""),
        "card: unet.onnx is no file of a model of the family group; export the model again"
    );
}
