//! Files that are damaged, foreign or of another version.

use bytes::Bytes;
use motiongen::model::Preset;
use motiongen::onnx::{
    EncodedModel, Form, Model, Session, Storage, UNetNames, check, unet, values_of,
};
use proptest::prelude::*;
use prost::Message as _;

use super::networks::{file, random, scale};
use super::{OPTIONS, floats, runtime, write};

fn tiny() -> EncodedModel {
    let config = Preset::Tiny.config();
    let parameters = random(motiongen::model::UNet1D::new(&config).1, 5);
    let weights = |id| parameters.unpacked(id);
    let graph = unet(&config, &weights, &scale(), Form::default(), Storage::Fp32).expect("a graph");
    file(graph).encode("unet.weights.bin", usize::MAX)
}

/// Changes a model and returns what the rules say of it.
fn broken(change: impl FnOnce(&mut Model)) -> String {
    let mut model = Model::read(tiny().model, None, "m.onnx").expect("a model");
    change(&mut model);
    check(&model, "m.onnx").expect_err("a broken rule").to_string()
}

#[test]
fn a_file_that_was_written_keeps_the_rules_and_the_same_bytes() {
    let (first, second) = (tiny(), tiny());
    assert_eq!(first.model, second.model);
    let model = Model::read(first.model, None, "m.onnx").expect("a model");
    check(&model, "m.onnx").expect("the rules are kept");
    assert_eq!(model.opset(), 21);
}

#[test]
fn foreign_bytes_are_refused_in_one_sentence() {
    let read = |bytes: Bytes| Model::read(bytes, None, "m.onnx").expect_err("no model").to_string();
    assert_eq!(
        read(Bytes::from_static(b"\x50\x4b\x03\x04 a zip")),
        "m.onnx: is no ONNX file, or is cut off (failed to decode Protobuf message: invalid wire type \
         value: 6); export the model again"
            .replace("invalid wire type value: 6", &reason_of(b"\x50\x4b\x03\x04 a zip"))
    );
    assert_eq!(
        read(Bytes::new()),
        "m.onnx: is no ONNX file, or is cut off (there is no graph); export the model again"
    );
    let whole = tiny().model;
    let cut = read(whole.slice(..whole.len() - 7));
    assert!(
        cut.starts_with("m.onnx: is no ONNX file, or is cut off (") && cut.ends_with("again"),
        "{cut}"
    );
    let mut newer = Model::decode(whole).expect("a model");
    newer.opset_import[0].version = 26;
    assert_eq!(
        read(newer.encode_to_vec().into()),
        "m.onnx: is written in opset 26, this program reads opset 21; export the model again"
    );
}

fn reason_of(bytes: &[u8]) -> String {
    let said = Model::decode(bytes).expect_err("no message").to_string();
    said.trim_start_matches("failed to decode Protobuf message: ").to_owned()
}

#[test]
fn rules_that_are_broken_are_named() {
    assert_eq!(broken(|m| m.ir_version = 3), "m.onnx: has IR version 3, opset 21 goes with 10");
    assert_eq!(
        broken(|m| m.graph.as_mut().expect("a graph").node[4].op_type = "Einsum".into()),
        "m.onnx: node time_mlp.0/Add is a Einsum, which this program does not write"
    );
    let unknown = broken(|m| m.graph.as_mut().expect("a graph").node[1].input[0] = "nobody".into());
    assert!(unknown.ends_with("reads nobody before it is made"), "{unknown}");
    let twice = broken(|m| {
        let graph = m.graph.as_mut().expect("a graph");
        let name = graph.node[0].output[0].clone();
        graph.node[1].output[0] = name;
    });
    assert!(twice.contains(" writes ") && twice.ends_with(", which exists"), "{twice}");
    let short = broken(|m| {
        let tensor = &mut m.graph.as_mut().expect("a graph").initializer[0];
        tensor.raw_data = tensor.raw_data.slice(..tensor.raw_data.len() - 1);
    });
    assert!(short.contains(" bytes for the shape "), "{short}");
    let unused = broken(|m| {
        let graph = m.graph.as_mut().expect("a graph");
        let mut tensor = graph.initializer[0].clone();
        tensor.name = "spare".to_owned();
        graph.initializer.push(tensor);
    });
    assert_eq!(unused, "m.onnx: initializer spare is used by no node");
    let output = broken(|m| m.graph.as_mut().expect("a graph").output[0].name = "z".into());
    assert_eq!(output, "m.onnx: output z is made by no node");
}

#[test]
fn weights_lie_beside_their_file() {
    let model = Model::read(tiny().model, None, "m.onnx").expect("a model");
    let EncodedModel { model, weights } =
        file(model.graph.expect("a graph")).encode("unet.weights.bin", 0);
    let mut model = Model::read(model, weights.as_ref(), "m.onnx").expect("a model");
    check(&model, "m.onnx").expect("the rules are kept");
    for place in ["/etc/passwd", "../weights.bin", ".."] {
        let graph = model.graph.as_mut().expect("a graph");
        let outside = graph.initializer.iter_mut().find(|tensor| !tensor.external_data.is_empty());
        let outside = outside.expect("a large weight");
        place.clone_into(&mut outside.external_data[0].value);
        let expected = format!(
            "m.onnx: initializer {} lies in {place:?}, which is not beside the file",
            outside.name
        );
        assert_eq!(check(&model, "m.onnx").expect_err("outside").to_string(), expected);
    }
}

#[test]
fn a_missing_weight_is_named() {
    let mut model = Model::read(tiny().model, None, "m.onnx").expect("a model");
    let graph = model.graph.as_mut().expect("a graph");
    graph.initializer.retain(|tensor| tensor.name != "conv_in.weight");
    let (_, list) = motiongen::model::UNet1D::new(&Preset::Tiny.config());
    let id = list.by_name()["conv_in.weight"];
    assert_eq!(
        values_of(&model, list.get(id), "m.onnx").expect_err("no weight").to_string(),
        "m.onnx: has no weight conv_in.weight; it was not written by motiongen export, or by another \
         version; export the model again"
    );
}

#[test]
fn onnxruntime_is_asked_only_for_what_the_model_has() {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join("unet.onnx");
    let model = Model::read(tiny().model, None, "m.onnx").expect("a model");
    let graph = model.graph.expect("a graph");
    write(file(graph), &path, usize::MAX);
    let mut session = Session::open(runtime(), &path, OPTIONS).expect("a session");
    assert_eq!(
        session.expect(&["latent"], "motion").expect_err("another kind").to_string(),
        format!(
            "{}: has the inputs and outputs x_t, t, audio, prediction; latent, motion are needed; it \
             is a model of another kind",
            path.display()
        )
    );
    let wrong = [floats(UNetNames::X, &[1, 8, 24], &[0.0; 192])];
    let said = session.run(&wrong, UNetNames::PREDICTION).expect_err("a wrong shape").to_string();
    assert!(said.starts_with(&format!("{}: onnxruntime stopped (", path.display())), "{said}");
    assert_eq!(said.lines().count(), 1);
    std::fs::write(&path, b"no model").expect("written");
    let said = Session::open(runtime(), &path, OPTIONS).err().expect("refused").to_string();
    assert!(said.starts_with(&format!("{}: onnxruntime refuses it (", path.display())), "{said}");
}

proptest! {
    #[test]
    fn no_bytes_break_the_reader(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        if let Ok(model) = Model::read(bytes.into(), None, "m.onnx") {
            let _ = check(&model, "m.onnx");
        }
    }
}
