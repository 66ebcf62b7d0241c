//! What can be wrong with a model file or the runtime.

/// Why a model file or onnxruntime cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum OnnxError {
    #[error("{place}: is no ONNX file, or is cut off ({reason}); export the model again")]
    Unreadable { place: String, reason: String },
    #[error(
        "{place}: is written in opset {found}, this program reads opset {expected}; export the model again"
    )]
    Opset { place: String, found: i64, expected: i64 },
    #[error("{place}: {problem}")]
    Check { place: String, problem: String },
    #[error(
        "{place}: has no weight {name}; it was not written by motiongen export, or by another version; \
         export the model again"
    )]
    Missing { place: String, name: String },
    #[error(
        "{place}: weight {name} has {found} numbers, {expected} are needed; export the model again"
    )]
    Size { place: String, name: String, found: usize, expected: usize },
    #[error(
        "onnxruntime {needed} or newer was not found (looked for {name} in {looked}); run `make setup`, \
         name the library by --ort-lib or ORT_DYLIB_PATH, or use --engine eager"
    )]
    NoRuntime { needed: String, name: String, looked: String },
    #[error(
        "{place}: cannot be used as onnxruntime ({reason}); run `make setup` for version {pinned}, or use \
         --engine eager"
    )]
    BadRuntime { place: String, reason: String, pinned: &'static str },
    #[error("{place}: onnxruntime refuses it ({reason}); export the model again")]
    Refused { place: String, reason: String },
    #[error("{place}: onnxruntime stopped ({reason})")]
    Run { place: String, reason: String },
    #[error(
        "{place}: has the inputs and outputs {found}; {expected} are needed; it is a model of another kind"
    )]
    Inputs { place: String, found: String, expected: String },
    #[error("MOTIONGEN_DEVICE is \"{found}\"; it must be one of {known}")]
    Device { found: String, known: String },
}
