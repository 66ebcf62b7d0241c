//! Networks as ONNX files: written, checked, read back, and run through onnxruntime.
//!
//! [`Builder`] is the [`Graph`](crate::model::Graph) that writes nodes, so what is exported is what was
//! trained. [`Runtime`] finds and loads onnxruntime, [`Session`] runs a file. Only this room names `ort`
//! and `prost`.

mod builder;
mod check;
mod error;
mod file;
mod frames;
mod literals;
mod music;
mod networks;
mod operations;
mod parts;
mod planner;
mod proto;
mod runtime;
mod session;
mod storage;
mod tokens;
mod weights;

pub use builder::{Axes, Builder, Form, Value};
pub use check::check;
pub use error::OnnxError;
pub use file::{EMBEDDED_BYTES, EncodedModel, IR_VERSION, ModelFile, OPSET};
pub use networks::{
    DecoderNames, GroupNames, GroupScoreNames, UNetNames, decoder, group_denoiser, group_score,
    unet,
};
pub use planner::{
    PlannerMusicNames, PlannerNames, PlannerStepNames, planner, planner_music, planner_step,
};
pub use proto::{Graph, Model};
pub use runtime::{Device, PINNED_VERSION, Runtime};
pub use session::{NamedTensor, Numbers, Session, SessionOptions};
pub use storage::Storage;
pub use tokens::{
    SignalDenoiserNames, SignalNames, TokenEncoderNames, token_denoiser, token_encoder,
    token_signal,
};
pub use weights::values_of;
