//! Models that somebody else made: what their cards cannot do.

use std::path::{Path, PathBuf};
use std::process::Command;

use motiongen::store::Location;
use serde_json::{Value, json};
use sha2::{Digest as _, Sha256};

use crate::servers;
use crate::support::{Dir, MEMORY_BYTES, Output, confined, finish, motiongen, write};

/// The model that ships with the program, as a folder.
fn pretrained() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("models/pretrained")
}

fn card() -> Value {
    let text = std::fs::read(pretrained().join("model.json")).expect("a card");
    serde_json::from_slice(&text).expect("JSON")
}

fn entry(name: &str, content: &[u8]) -> Value {
    let digest: String = Sha256::digest(content).iter().map(|byte| format!("{byte:02x}")).collect();
    json!({ "name": name, "n_bytes": content.len(), "sha256": digest })
}

/// Makes a store with the model "m": its card, and the files of the one that ships.
fn store_with(dir: &Dir, card: &Value) -> PathBuf {
    let model = dir.at("store/models/m");
    for name in ["unet.onnx", "decoder.onnx"] {
        write(&model.join(name), std::fs::read(pretrained().join(name)).expect("a file"));
    }
    write(&model.join("model.json"), card.to_string());
    dir.at("store")
}

fn model_command(store: &str, cache: &Path) -> Command {
    let mut command = motiongen();
    command.args([
        "model",
        "--engine=eager",
        "--frames=8",
        "--model=m",
        "--quiet",
        "--store",
        store,
    ]);
    command.arg("--model-cache").arg(cache);
    command
}

/// Asks for the model "m" in little memory.
fn model(dir: &Dir, card: &Value) -> Output {
    let store = store_with(dir, card).display().to_string();
    finish(&mut confined(&model_command(&store, &dir.at("cache")), 2 * MEMORY_BYTES))
}

/// Returns what is wrong with the card of the model "m".
#[track_caller]
fn refusal(dir: &Dir, card: &Value) -> String {
    let output = model(dir, card);
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{}", output.stderr);
    let place = format!("error: file://{}: ", dir.at("store/models/m/model.json").display());
    output.stderr.strip_prefix(&place).unwrap_or(&output.stderr).trim_end().to_owned()
}

#[test]
fn a_card_in_a_bucket_names_no_file_outside_the_cache() {
    let Some(stores) = servers::s3() else { return };
    let dir = Dir::new();
    let bucket = stores.create_bucket("foreign-models");
    let location = Location::with_client(&stores.url(&bucket, "st"), stores.client(&bucket), "st");
    let absolute = dir.at("absolute.txt").display().to_string();
    let above = format!("../../../../../../../../../../../..{}", dir.at("above.txt").display());
    let mut evil = card();
    let files = evil["files"].as_array_mut().expect("files");
    for name in [&absolute, &above] {
        files.push(entry(name, b"written by a model"));
        let path = format!("models/m/{name}");
        location.put_new(&path, (&b"written by a model"[..]).into()).expect("put");
    }
    for name in ["unet.onnx", "decoder.onnx"] {
        let content = std::fs::read(pretrained().join(name)).expect("a file");
        location.put_new(&format!("models/m/{name}"), content.into()).expect("put");
    }
    let text = evil.to_string().into_bytes();
    location.put_new("models/m/model.json", text.into()).expect("put");
    let mut command = model_command(&stores.url(&bucket, "st"), &dir.at("cache"));
    stores.env().apply(&mut command);
    let output = finish(&mut command);
    assert!(!dir.at("absolute.txt").exists() && !dir.at("above.txt").exists(), "{output:?}");
    assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{}", output.stderr);
    let start = format!(
        "error: {}: is no description of a model (a model has no file {absolute:?}, only unet.onnx, \
         unet.weights.bin, decoder.onnx, decoder.weights.bin, denoiser.onnx, score.onnx, encoder.onnx, signal.onnx, \
         planner.onnx, planner_music.onnx, planner_step.onnx at line 1 column ",
        stores.url(&bucket, "st/models/m/model.json")
    );
    assert!(output.stderr.starts_with(&start), "{}", output.stderr);
}

#[test]
fn a_sound_card_is_taken() {
    let dir = Dir::new();
    let output = model(&dir, &card());
    assert_eq!(output.code, 0, "{output:?}");
}

#[test]
fn sizes_of_a_card_can_neither_hang_nor_abort() {
    let dir = Dir::new();
    type Change = fn(&mut Value);
    let cases: [(Change, &str); 12] = [
        (
            |card| card["unet"]["n_steps"] = json!(10_u64.pow(15)),
            "n_steps is 1000000000000000; it must be at most 33554432",
        ),
        (
            |card| card["diffusion"]["n_steps"] = json!(999),
            "n_steps of the network is 1000, expected 999; export the model again",
        ),
        (
            |card| card["unet"]["widths"] = json!([48, 96, 160, 4_000_000_000_u64]),
            "widths has 4000000000; use at most 16384 channels",
        ),
        (
            |card| card["unet"]["widths"] = json!(vec![16_384; 10]),
            "the UNet has 40010188288 parameters, at most 2147483648 are read; export the model again",
        ),
        (
            |card| card["unet"]["num_res_blocks"] = json!(1_000_000_000),
            "num_res_blocks is 1000000000; it must be at most 64",
        ),
        (
            |card| card["unet"]["num_head_channels"] = json!(0),
            "num_head_channels is 0; it must be at least 1",
        ),
        (
            |card| card["unet"]["in_channels"] = json!(24),
            "in_channels is 24, expected 25; export the model again",
        ),
        (
            |card| card["decoder"]["hidden_dim"] = json!(1_000_000_000),
            "hidden_dim of the decoder is 1000000000; it must be 1 to 16384",
        ),
        (
            |card| card["window_frames"] = json!(1_000_000_000_000_u64),
            "window_frames is 1000000000000; it must be 2 to 65536; export the model again",
        ),
        (
            |card| card["normalizer"]["scale"][3] = json!(0.0),
            "a scale is 0; it must be above 0; export the model again",
        ),
        (
            |card| card["name"] = json!("../m"),
            "name \"../m\" is none of a model: 1 to 100 letters, digits, -, _ and ., and no . at the beginning; \
             export the model again",
        ),
        (
            |card| card["files"][1] = card["files"][0].clone(),
            "unet.onnx is listed twice; export the model again",
        ),
    ];
    for (change, expected) in cases {
        let mut changed = card();
        change(&mut changed);
        let found = refusal(&dir, &changed);
        let is_same = found == expected
            || expected.starts_with("the UNet has") && found.starts_with("the UNet has");
        assert!(is_same, "{found}\n{expected}");
    }
}

#[test]
fn files_are_measured_before_they_are_read() {
    let dir = Dir::new();
    let store = store_with(&dir, &card());
    let unet = store.join("models/m/unet.onnx");
    let place = format!("file://{}", unet.display());
    let said = || {
        let command = model_command(&store.display().to_string(), &dir.at("cache"));
        let output = finish(&mut confined(&command, 2 * MEMORY_BYTES));
        assert_eq!((output.code, output.stdout.as_str()), (2, ""), "{}", output.stderr);
        output.stderr.trim_end().to_owned()
    };
    let n_bytes = std::fs::metadata(&unet).expect("a file").len();
    let large = std::fs::File::options().write(true).open(&unet).expect("a file");
    large.set_len(1 << 40).expect("a file with a hole");
    assert_eq!(
        said(),
        format!(
            "error: {place}: has 1099511627776 bytes, model.json says {n_bytes}; the file was changed or damaged; \
             copy it again or export the model again"
        )
    );
    std::fs::remove_file(&unet).expect("removed");
    std::os::unix::fs::symlink("/dev/zero", &unet).expect("a link");
    assert_eq!(
        said(),
        format!("error: {place}: is no regular file; remove it or put the file in its place")
    );
    // A card says how large a file is, too.
    let mut changed = card();
    changed["files"][0]["n_bytes"] = json!(1_u64 << 40);
    let found = refusal(&dir, &changed);
    assert!(
        found.starts_with("unet.onnx has 1099511627776 bytes, a network of these sizes at most "),
        "{found}"
    );
    let text = dir.at("store/models/m/model.json");
    std::fs::File::create(&text).expect("a card").set_len(1 << 40).expect("a hole");
    assert_eq!(
        said(),
        format!(
            "error: file://{}: has 1099511627776 bytes, at most 268435456 are read; it is not what it should be",
            text.display()
        )
    );
}
