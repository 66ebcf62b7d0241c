//! `motiongen export` and `motiongen model`, as a user runs them.

use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::store::tables::OnnxCheckRow;

use super::{floats, integers, max_difference, python, runtime};
use crate::support::{Dir, Output, finish, motiongen, rows};
use crate::train::{make_store, train};

const TRAINED: [&str; 4] =
    ["--steps=30", "--decoder-steps=20", "--warmup-steps=5", "--prediction=x0"];

fn trained(dir: &Dir) -> PathBuf {
    let store = make_store(dir);
    let output = train(&store, "run", &TRAINED);
    assert_eq!(output.code, 0, "{output:?}");
    store
}

fn export_command(store: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg("export").arg("--store").arg(store).args(["--run", "run", "--model", "m"]);
    command.args(["--quiet"]).args(more);
    command
}

fn export(store: &Path, more: &[&str]) -> Output {
    finish(&mut export_command(store, more))
}

fn model_command(store: &Path, cache: &Path, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg("model").arg("--store").arg(store).args(["--model", "m", "--quiet"]);
    command.arg("--model-cache").arg(cache).args(more);
    command
}

fn bytes(path: &Path) -> Vec<u8> {
    std::fs::read(path).unwrap_or_else(|e| panic!("{}: {e}", path.display()))
}

fn card(store: &Path) -> serde_json::Value {
    serde_json::from_slice(&bytes(&store.join("models/m/model.json"))).expect("JSON")
}

#[test]
fn a_run_becomes_a_model_that_was_checked() {
    let dir = Dir::new();
    let store = trained(&dir);
    let planned = export(&store, &["--dry-run"]);
    assert_eq!(planned.code, 0, "{planned:?}");
    assert!(planned.stdout.starts_with("would check and write unet.onnx ("), "{planned:?}");
    assert!(!store.join("models").exists());

    let output = export(&store, &["--licence", "CC-BY-4.0"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("guided_sample"), "{output:?}");
    let checks: Vec<OnnxCheckRow> = rows(&store);
    let mut kinds: Vec<&str> = checks.iter().map(|row| row.check.as_str()).collect();
    kinds.sort_unstable();
    assert_eq!(
        kinds,
        ["decode", "forward", "forward", "forward", "forward", "guided_sample", "sample"]
    );
    for row in &checks {
        assert!(row.passed && row.max_abs <= row.tolerance && row.rms <= row.max_abs, "{row:?}");
        // Two programs that add in different orders do not agree in every bit.
        assert!(row.max_abs > 0.0, "{row:?}");
        assert_eq!(
            (row.model.as_str(), row.run.as_str(), row.precision.as_str()),
            ("m", "run", "fp32")
        );
    }
    let card = card(&store);
    assert_eq!(card["licence"], "CC-BY-4.0");
    assert_eq!(card["provenance"]["run"], "run");
    assert_eq!(card["channels"].as_array().map(Vec::len), Some(25));
    for file in card["files"].as_array().expect("files") {
        let name = file["name"].as_str().expect("a name");
        let content = bytes(&store.join("models/m").join(name));
        assert_eq!(file["n_bytes"], content.len());
        assert_eq!(file["sha256"], sha256_by_python(&store.join("models/m").join(name)).as_str());
    }

    let again = export(&store, &["--licence", "CC-BY-4.0"]);
    assert_eq!(again.code, 0, "{again:?}");
    assert!(again.stdout.starts_with("model m, up to date → "), "{again:?}");
    let other = export(&store, &["--precision", "fp16"]);
    assert_eq!(other.code, 2);
    assert_eq!(
        other.stderr,
        format!(
            "error: store {} has a model \"m\" of other weights or settings; give another --model name, or \
             replace it with --force\n",
            store.display()
        )
    );
    let forced = export(&store, &["--precision", "fp16", "--force"]);
    assert_eq!(forced.code, 0, "{forced:?}");
    let checks: Vec<OnnxCheckRow> = rows(&store);
    assert_eq!(checks.len(), 8, "the new checks take the place of the old ones");
    let rounding: Vec<_> = checks.iter().filter(|row| row.check == "rounding").collect();
    assert!(rounding.len() == 1 && rounding[0].rms > 0.0 && rounding[0].precision == "fp16");
}

/// A style that is not asked for is one of zeros in the files and in the interpreter: the projection has a bias.
#[test]
fn a_run_with_a_style_becomes_a_model_too() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let output = train(&store, "run", &[&TRAINED[..], &["--style", "--no-clock"]].concat());
    assert_eq!(output.code, 0, "{output:?}");
    let output = export(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(card(&store)["unet"]["style_dim"], 8);
    assert_eq!(card(&store)["unet"]["clock"], false);
}

fn sha256_by_python(path: &Path) -> String {
    let code =
        "import hashlib, sys; print(hashlib.sha256(open(sys.argv[1], 'rb').read()).hexdigest())";
    let output = Command::new(python()).arg("-c").arg(code).arg(path).output().expect("Python");
    String::from_utf8_lossy(&output.stdout).trim().to_owned()
}

#[test]
fn a_model_is_told_of_and_a_changed_file_is_refused() {
    let dir = Dir::new();
    let store = trained(&dir);
    assert_eq!(export(&store, &[]).code, 0);
    let cache = dir.at("cache");
    for engine in ["onnx", "eager"] {
        for _ in 0..2 {
            let told =
                finish(&mut model_command(&store, &cache, &["--engine", engine, "--frames=24"]));
            assert_eq!(told.code, 0, "{told:?}");
            assert!(told.stdout.contains("SHA-256 ") && told.stdout.contains(", as it should be"));
            assert!(told.stdout.contains(&format!("\nengine {engine}, ready in ")), "{told:?}");
        }
    }
    assert_eq!(std::fs::read_dir(&cache).expect("a folder").count(), 1, "one optimised copy");

    let unet = store.join("models/m/unet.onnx");
    let mut content = bytes(&unet);
    let at = content.len() / 2;
    content[at] ^= 1;
    std::fs::write(&unet, &content).expect("written");
    let digest = sha256_by_python(&unet);
    let expected = card(&store)["files"][0]["sha256"].as_str().expect("a digest").to_owned();
    for engine in ["onnx", "eager"] {
        let told = finish(&mut model_command(&store, &cache, &["--engine", engine, "--frames=24"]));
        assert_eq!(told.code, 2, "{told:?}");
        assert_eq!(
            told.stderr,
            format!(
                "error: file://{}/unet.onnx: SHA-256 is {digest}, model.json says {expected}; the file was changed or \
                 damaged; copy it again or export the model again\n",
                store.join("models/m").display()
            )
        );
    }
}

#[test]
fn cards_of_another_kind_are_refused() {
    let dir = Dir::new();
    let store = trained(&dir);
    assert_eq!(export(&store, &[]).code, 0);
    let path = store.join("models/m/model.json");
    let text = String::from_utf8(bytes(&path)).expect("text");
    let place = format!("file://{}", path.display());
    let cache = dir.at("cache");
    let refused = |text: &str, expected: &str| {
        std::fs::write(&path, text).expect("written");
        let told = finish(&mut model_command(&store, &cache, &["--engine=eager"]));
        assert_eq!(
            (told.code, told.stderr.as_str()),
            (2, format!("error: {place}: {expected}\n").as_str())
        );
    };
    refused(
        &text.replacen("\"format\": 1", "\"format\": 9", 1),
        "has format 9, this program reads format 1; use the version of motiongen that wrote it, or export the \
         model again",
    );
    refused(
        &text.replacen("\"velocity_x\"", "\"speed_x\"", 1),
        "is a model of other channels: 25 of them instead of 25, and number 3 is speed_x instead of velocity_x; \
         train and export a model with this version of motiongen",
    );
    refused(
        &text.replacen("\"onset_strength\"", "\"onset_strength\", \"tempo\"", 1),
        "is a model of other features: 164 of them instead of 163, and number 163 is tempo instead of none; \
         train and export a model with this version of motiongen",
    );
    refused(
        "{}",
        "is no description of a model (missing field `format` at line 1 column 2); export the model again",
    );
}

#[test]
fn what_is_missing_is_named_with_the_way_out() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let output = export(&store, &[]);
    assert_eq!(output.code, 2);
    assert!(output.stderr.ends_with("run motiongen train --run run first\n"), "{output:?}");
    assert_eq!(train(&store, "run", &TRAINED).code, 0);
    let tuned = export(&store, &["--weights=finetune"]);
    assert_eq!(tuned.code, 2);
    assert!(tuned.stderr.ends_with("run motiongen finetune --run run first\n"), "{tuned:?}");
    let told = finish(&mut model_command(&store, &dir.at("cache"), &[]));
    assert_eq!(told.code, 2);
    assert_eq!(
        told.stderr,
        format!(
            "error: store {0} has no model \"m\"; run motiongen export --store {0} --run RUN --model m first\n",
            store.display()
        )
    );
    let named = export(&store, &["--ort-lib=/nowhere/libonnxruntime.so"]);
    assert_eq!(named.code, 2);
    assert_eq!(
        named.stderr,
        "error: /nowhere/libonnxruntime.so: cannot be used as onnxruntime (there is no such file); run `make \
         setup` for version 1.32.0, or use --engine eager\n"
    );
    let text = dir.at("libonnxruntime.so");
    crate::support::write(&text, b"no library");
    let foreign = export(&store, &[&format!("--ort-lib={}", text.display())]);
    assert_eq!(
        foreign.stderr,
        format!(
            "error: {}: cannot be used as onnxruntime (it is no shared library for this machine); run `make \
             setup` for version 1.32.0, or use --engine eager\n",
            text.display()
        )
    );
    assert!(!store.join("models").exists(), "nothing is left behind");
    let mut lost = export_command(&store, &[]);
    lost.env("MOTIONGEN_DEVICE", "abacus");
    assert_eq!(finish(&mut lost).code, 0, "checks are made on the processor, whatever the device");
    let mut device = model_command(&store, &dir.at("cache"), &["--engine=onnx"]);
    device.env("MOTIONGEN_DEVICE", "abacus");
    assert_eq!(
        finish(&mut device).stderr,
        "error: MOTIONGEN_DEVICE is \"abacus\"; it must be one of auto, cpu, cuda, tensorrt, coreml, directml\n"
    );
    let mut device = model_command(&store, &dir.at("cache"), &["--engine=onnx", "--frames=24"]);
    device.env("MOTIONGEN_DEVICE", "cuda");
    let told = finish(&mut device);
    assert_eq!(told.code, 0, "a device that is not there is no reason to stop: {told:?}");
}

/// The lines of a fenced block of the documentation.
fn documented(language: &str) -> String {
    let text = include_str!("../../docs/onnx.md");
    let from = text.find(&format!("```{language}\n")).expect("a block") + language.len() + 4;
    let end = from + text[from..].find("```").expect("an end");
    text[from..end].to_owned()
}

#[test]
fn the_documented_python_samples_what_motiongen_samples() {
    let dir = Dir::new();
    let store = trained(&dir);
    assert_eq!(export(&store, &[]).code, 0);
    let folder = dir.at("python");
    std::fs::create_dir_all(folder.join("models")).expect("a folder");
    std::os::unix::fs::symlink(store.join("models/m"), folder.join("models/demo")).expect("a link");
    // Music of the shape that extract writes.
    let code = format!(
        "import numpy as np\nrng = np.random.default_rng(1)\n\
         shapes = dict(mel=(128, 131), chroma=(12, 131), mfcc=(20, 131), rms=(131,), \
         spectral_centroid=(131,), onset_strength=(131,))\n\
         np.savez('song.npz', **{{k: rng.random(s, dtype=np.float32) for k, s in shapes.items()}})\n\
         {}\n\
         import onnx\n\
         for name in ('unet', 'decoder'):\n    onnx.checker.check_model(f'models/demo/{{name}}.onnx', full_check=True)\n\
         for name, x in dict(noise=noise, audio=audio, clock=clock, motion=motion).items():\n    \
         np.ascontiguousarray(x, dtype='<f4').tofile(name)\n",
        documented("python")
    );
    let output =
        Command::new(python()).current_dir(&folder).arg("-c").arg(code).output().expect("Python");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let floats_of = |name: &str| -> Vec<f32> {
        let bytes = bytes(&folder.join(name));
        bytes.chunks_exact(4).map(|b| f32::from_le_bytes([b[0], b[1], b[2], b[3]])).collect()
    };
    let [noise, audio, clock, motion] = ["noise", "audio", "clock", "motion"].map(floats_of);
    // 124 beats a minute in bars of four, a downbeat at 0.5 s.
    let bars = |t: u32| (f64::from(t) / 30.0 - 0.5) * 124.0 / 60.0 / 4.0;
    let phase: Vec<f64> = (0..120).map(|t| bars(t).rem_euclid(1.0)).collect();
    let own: Vec<f32> = motiongen::motion::clock(&phase, 4).into_iter().collect();
    // Of single precision.
    assert!(max_difference(&clock, &own) <= 1e-5, "{clock:?} {own:?}");
    let wanted = sampled_by_motiongen(&store.join("models/m"), &noise, [&audio, &clock]);
    assert_eq!(motion.len(), 120 * 25);
    // Twenty steps of single precision; accelerations reach 100 m/s².
    let difference = max_difference(&motion, &wanted);
    assert!(difference <= 2e-2, "{difference:e}");
    let spread = wanted.iter().fold(0.0_f32, |most, x| most.max(x.abs()));
    assert!(spread > 0.1, "{spread}");
}

/// Samples by this program: the session of a file, the sampler of the room `diffusion`.
fn sampled_by_motiongen(folder: &Path, noise: &[f32], [audio, clock]: [&[f32]; 2]) -> Vec<f32> {
    use motiongen::diffusion::{DiffusionError, SamplerConfig, Schedule, Spacing, sample};
    use motiongen::generation::{FamilyCard as _, ModelCard};
    use motiongen::onnx::{DecoderNames, Session, UNetNames};
    use ndarray::{Array3, ArrayView3};

    let card = ModelCard::read(&bytes(&folder.join("model.json")), "m").expect("a card");
    let schedule = Schedule::new(&card.diffusion).expect("a schedule");
    let open = |name: &str| {
        Session::open(runtime(), &folder.join(name), super::OPTIONS).expect("a session")
    };
    let (mut unet, mut decoder) = (open("unet.onnx"), open("decoder.onnx"));
    let config =
        SamplerConfig { n_steps: 20, spacing: Spacing::Trailing, ..SamplerConfig::default() };
    let denoise = |x: ArrayView3<f32>, t: usize| -> Result<Array3<f32>, DiffusionError> {
        let x = x.as_standard_layout();
        let inputs = [
            floats(UNetNames::X, &[1, 120, 25], x.as_slice().expect("in order")),
            integers(UNetNames::T, &[t as i64]),
            floats(UNetNames::AUDIO, &[1, 120, 163], audio),
            floats(UNetNames::CLOCK, &[1, 120, 10], clock),
        ];
        let (_, y) = unet.run(&inputs, UNetNames::PREDICTION).expect("a prediction");
        Ok(Array3::from_shape_vec((1, 120, 25), y).expect("a motion"))
    };
    let x = Array3::from_shape_vec((1, 120, 25), noise.to_vec()).expect("noise");
    let latent = sample(&config, &schedule, x, denoise, |_, _| (), None).expect("a sample");
    let latent = latent.as_standard_layout();
    let inputs =
        [floats(DecoderNames::LATENT, &[1, 120, 25], latent.as_slice().expect("in order"))];
    decoder.run(&inputs, DecoderNames::MOTION).expect("motion").1
}
