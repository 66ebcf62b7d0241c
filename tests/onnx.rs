//! What is exported is what was trained: files written, read back, and run through onnxruntime.

mod export;
mod files;
mod group;
mod networks;
mod operations;

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use motiongen::onnx::{
    Device, EncodedModel, Model, ModelFile, NamedTensor, Numbers, Runtime, Session, SessionOptions,
    check,
};

/// Returns onnxruntime, which `make setup` obtains; nothing is skipped where it is missing.
pub fn runtime() -> &'static Runtime {
    static RUNTIME: OnceLock<Runtime> = OnceLock::new();
    RUNTIME.get_or_init(|| Runtime::load(None).unwrap_or_else(|e| panic!("{e}")))
}

pub const OPTIONS: SessionOptions =
    SessionOptions { n_threads: 2, is_alone: true, device: Device::Cpu, is_optimized: false };

/// Writes a graph into a file, checks it against the rules, and loads it.
pub fn session(file: ModelFile, folder: &Path, name: &str) -> Session {
    let path = folder.join(name);
    write(file, &path, usize::MAX);
    Session::open(runtime(), &path, OPTIONS).unwrap_or_else(|e| panic!("{e}"))
}

/// Writes a file, with weights of more than `embedded_bytes` beside it, and checks it.
pub fn write(file: ModelFile, path: &Path, embedded_bytes: usize) -> Model {
    let beside = path.with_extension("bin");
    let weights_name = beside.file_name().expect("a name").to_string_lossy().into_owned();
    let EncodedModel { model, weights } = file.encode(&weights_name, embedded_bytes);
    std::fs::write(path, &model).expect("written");
    if let Some(weights) = &weights {
        std::fs::write(&beside, weights).expect("written");
    }
    let read = Model::read(model, weights.as_ref(), "m.onnx").expect("what was written");
    check(&read, "m.onnx").unwrap_or_else(|e| panic!("{e}"));
    read
}

/// An input of numbers.
pub fn floats(name: &'static str, shape: &[usize], numbers: &[f32]) -> NamedTensor<'static> {
    NamedTensor { name, shape: shape.to_vec(), numbers: Numbers::Float(numbers.to_vec().into()) }
}

/// An input of whole numbers.
pub fn integers(name: &'static str, numbers: &[i64]) -> NamedTensor<'static> {
    let shape = vec![numbers.len()];
    NamedTensor { name, shape, numbers: Numbers::Integer(numbers.to_vec().into()) }
}

/// Numbers of a fixed sequence, about normal.
pub fn normal(n: usize, seed: u64) -> Vec<f32> {
    let mut values = vec![0.0; n];
    motiongen::autodiff::Stream::new(seed, 0).normal(0, &mut values);
    values
}

/// Returns the largest difference; NaN where one is.
pub fn max_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let differences = a.iter().zip(b).map(|(a, b)| (a - b).abs());
    differences.fold(0.0, |most, d| if d > most || d.is_nan() { d } else { most })
}

/// The Python of the tests' own environment.
pub fn python() -> PathBuf {
    std::env::var_os("MOTIONGEN_TEST_PYTHON").map_or_else(|| "python3".into(), PathBuf::from)
}
