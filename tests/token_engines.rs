//! The engines of a model of tokens, and its frames as they come.

use std::path::Path;
use std::process::Command;

use motiongen::motion::npy::read_f32;

use crate::onnx::python;
use crate::planner::{AUTOREGRESSIVE, MASKED, export, generate, song, store_with_tokenizer};
use crate::support::{Dir, finish, motiongen};
use crate::tokens::train;

#[test]
fn frames_are_streamed_as_they_are_planned_and_are_those_of_the_file() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    assert_eq!(train(&store, "next", &AUTOREGRESSIVE).code, 0);
    assert_eq!(export(&store, "next", "next").code, 0);
    let (audio, out) = (song(&dir), dir.at("out"));
    let text = |path: &Path| std::fs::read_to_string(path).expect("text");
    // Without post-processing the file has what was streamed.
    let flags = ["--raw", "--limits=wide", "--format=csv"];
    let (csv, ndjson) = (dir.at("s.csv"), dir.at("s.ndjson"));
    let stream = ["--stream", &csv.display().to_string()];
    let output = generate(&store, "next", &audio, &out, &[&flags[..], &stream].concat());
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.contains("; first frames after "), "{output:?}");
    assert_eq!(text(&csv), text(&out.join("song.csv")));
    assert_eq!(text(&csv).lines().count(), 1 + 211);
    let stream = ["--stream", &ndjson.display().to_string(), "--stream-format=ndjson"];
    let more = [&flags[..], &stream, &["--threads=1"]].concat();
    let output = generate(&store, "next", &audio, &out, &more);
    assert_eq!(output.code, 0, "{output:?}");
    let (lines, objects) = (text(&csv), text(&ndjson));
    let header: Vec<&str> = lines.lines().next().expect("a header").split(',').collect();
    assert_eq!(objects.lines().count(), 211);
    for (line, object) in lines.lines().skip(1).zip(objects.lines()) {
        let object: serde_json::Value = serde_json::from_str(object).expect("an object");
        for (name, cell) in header.iter().zip(line.split(',')) {
            let (cell, found): (f64, _) = (cell.parse().expect("a number"), object[name].as_f64());
            assert_eq!(found, Some(cell), "{name}");
        }
    }
    // Of shorter windows there are more, and other motion; the stream is still the file.
    let stream = ["--stream", &csv.display().to_string(), "--window=12", "--overlap=4"];
    let short: Vec<&str> = [&flags[..], &stream].concat();
    let mut command = motiongen();
    command.arg("generate").arg("--model").arg(store.join("models/next")).arg("--quiet");
    command.arg("--audio").arg(&audio).arg("--output").arg(&out).args(short);
    let output = finish(&mut command);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(text(&csv), text(&out.join("song.csv")));
    assert_ne!(text(&csv), lines);
    for (window, overlap) in [("25", "9"), ("48", "9"), ("8", "9"), ("10", "4")] {
        let flags = [&format!("--window={window}"), &format!("--overlap={overlap}")];
        let mut command = motiongen();
        command.arg("generate").arg("--model").arg(store.join("models/next")).arg("--quiet");
        command.arg("--audio").arg(&audio).arg("--output").arg(&out).args(flags);
        let output = finish(&mut command);
        assert_eq!(output.code, 2, "{output:?}");
        let expected = format!(
            "--window {window} does not do for model next: give a multiple of the 4 frames of a token, up to the 24 of \
             training and more than the {overlap} of --overlap"
        );
        assert!(output.stderr.contains(&expected), "{output:?}");
    }
    let mut command = motiongen();
    command.args(["generate", "--window=60", "--quiet", "--audio"]).arg(&audio);
    let output = finish(command.arg("--output").arg(&out));
    assert_eq!(output.code, 2, "{output:?}");
    let expected = "is a model of the family unet, whose windows are as long as in training; leave it out, or name a \
                    model of the family tokens";
    assert!(output.stderr.contains(expected), "{output:?}");
    // Without a stream the same file.
    let unstreamed = dir.at("unstreamed");
    assert_eq!(generate(&store, "next", &audio, &unstreamed, &flags).code, 0);
    assert_eq!(text(&unstreamed.join("song.csv")), lines);
    let output = generate(&store, "next", &audio, &out, &["--stream-format=ndjson"]);
    assert_eq!(output.code, 2, "{output:?}");
}

#[test]
fn onnxruntime_makes_the_motion_of_the_interpreter_and_models_are_told_of() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    let (audio, out) = (song(&dir), dir.at("out"));
    for (run, flags) in [("plan", &MASKED[..]), ("next", &AUTOREGRESSIVE)] {
        assert_eq!(train(&store, run, &[flags, &["--steps=30"]].concat()).code, 0);
        assert_eq!(export(&store, run, run).code, 0);
        let motion = |engine: &str, more: &[&str]| {
            let into = out.join(format!("{run}{engine}"));
            let engine = format!("--engine={engine}");
            let flags = [&["--format=npy", "--force", &engine], more].concat();
            let output = generate(&store, run, &audio, &into, &flags);
            assert_eq!(output.code, 0, "{output:?}");
            let bytes = std::fs::read(into.join("song.npy")).expect("a file");
            (read_f32(&bytes).expect("an array"), output.stdout)
        };
        for more in [&[][..], &["--guidance=2.5", "--seed=4"]] {
            let (wanted, told) = motion("eager", more);
            assert!(told.contains("), eager (1), plans"), "{told}");
            let (found, told) = motion("onnx", more);
            assert!(told.contains("), onnx (1), plans"), "{told}");
            assert_eq!(found.shape, wanted.shape);
            let apart = found.values.iter().zip(&wanted.values).map(|(a, b)| (a - b).abs());
            let apart = apart.fold(0.0, f32::max);
            // The same tokens, and 27 steps of f32 that are summed in another order.
            assert!(apart < 2e-2, "{run}: {apart}");
        }
        let folder = store.join("models").join(run);
        for engine in ["--engine=eager", "--engine=onnx"] {
            let mut command = motiongen();
            command.arg("model").arg("--model").arg(&folder).args(["--frames=24", engine]);
            let output = finish(command.arg("--quiet"));
            assert_eq!(output.code, 0, "{output:?}");
            let n_files = output.stdout.matches(", as it should be").count();
            let (expected, planned) = match run {
                "plan" => (4, "6 tokens in 10 iterations: "),
                _ => (6, "6 tokens one after the other: "),
            };
            assert_eq!(n_files, expected, "{output:?}");
            for text in [
                planned,
                "27 steps of DDPM: ",
                "16, one for 4 frames",
                &engine[2..].replace('=', " "),
            ] {
                assert!(output.stdout.contains(text), "{text}: {output:?}");
            }
        }
        // A byte of a file is another.
        let file = folder.join("signal.onnx");
        let mut bytes = std::fs::read(&file).expect("a file");
        let at = bytes.len() / 2;
        bytes[at] ^= 1;
        std::fs::write(&file, bytes).expect("written");
        for engine in ["--engine=eager", "--engine=onnx"] {
            let mut command = motiongen();
            command.arg("model").arg("--model").arg(&folder).args([engine, "--quiet"]);
            let output = finish(&mut command);
            assert_eq!(output.code, 2, "{output:?}");
            assert!(output.stderr.contains("signal.onnx"), "{output:?}");
            let into = out.join("damaged");
            let output = generate(&store, run, &audio, &into, &["--format=npy", engine]);
            assert_eq!(output.code, 2, "{output:?}");
            assert!(output.stderr.contains("signal.onnx"), "{output:?}");
        }
    }
    let mut command = motiongen();
    let output = finish(command.args(["model", "--model", "nowhere", "--quiet"]));
    assert_eq!(output.code, 2, "{output:?}");
    let expected = "there is no model in the folder nowhere; name the folder of a model (STORE/models/NAME), or give \
                    --store beside its name";
    assert!(output.stderr.contains(expected), "{output:?}");
}

#[test]
fn the_documented_python_plans_what_the_whole_planner_says() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    assert_eq!(train(&store, "next", &AUTOREGRESSIVE).code, 0);
    assert_eq!(export(&store, "next", "plan").code, 0);
    let text = include_str!("../docs/onnx.md");
    let blocks = text.split("```python\n").skip(1).map(|rest| rest.split("```").next());
    let block = blocks.flatten().find(|block| block.contains("planner_")).expect("a block");
    let code = format!(
        "import json, numpy as np, onnx, onnxruntime as ort\nrng = np.random.default_rng(1)\n\
         audio, clock = (rng.standard_normal((1, 23, n), dtype=np.float32) for n in (163, 10))\n{block}\n\
         assert len(tokens) == 6 and past.shape[1] == 6, (tokens, past.shape)\n\
         for name in ('planner', 'planner_music', 'planner_step'):\n    \
         onnx.checker.check_model(f'models/plan/{{name}}.onnx', full_check=True)\n\
         whole = ort.InferenceSession('models/plan/planner.onnx')\n\
         given = {{'tokens': np.array([tokens]), **heard}}\n\
         said = whole.run(None, given)[0]\n\
         assert abs(said[0, -1] - logits[0, -1]).max() < 1e-4, (said[0, -1], logits)\n\
         assert said[0].argmax(-1).tolist() == tokens, (said[0].argmax(-1), tokens)\n"
    );
    let output = Command::new(python()).current_dir(&store).arg("-c").arg(code).output();
    let output = output.expect("Python");
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}
