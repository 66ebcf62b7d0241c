//! Arbitrary bytes through the reader of model files: no panic in the reader, the rules or the weights, and
//! what keeps the rules survives a write and a read.
#![no_main]

use libfuzzer_sys::fuzz_target;
use prost::Message as _;

#[path = "../../src/model"]
#[allow(unused_imports, dead_code, reason = "this target reaches a part of the modules")]
mod model {
    mod parameter;
    pub use parameter::*;
}
#[path = "../../src/onnx"]
#[allow(unused_imports, dead_code, reason = "this target reaches a part of the modules")]
mod onnx {
    pub mod check;
    pub mod error;
    pub mod file;
    pub mod proto;
    pub mod weights;
}

use model::{Init, Parameter, Role};

fuzz_target!(|bytes: &[u8]| {
    // What lies beside the file is as foreign as the file.
    let beside = bytes::Bytes::copy_from_slice(bytes);
    let read = onnx::proto::Model::read(beside.clone(), Some(&beside), "m.onnx");
    let Ok(model) = read else { return };
    let parameter = Parameter {
        name: "layer.weight".to_owned(),
        shape: vec![3, 2],
        init: Init::Zeros,
        role: Role::Weight,
    };
    if let Ok(values) = onnx::weights::values_of(&model, &parameter, "m.onnx") {
        assert_eq!(values.len(), 6);
    }
    if onnx::check::check(&model, "m.onnx").is_ok() {
        let again = onnx::proto::Model::decode(model.encode_to_vec().as_slice());
        assert!(again.is_ok());
    }
});
