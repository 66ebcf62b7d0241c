//! The model that ships with the program, used where no model is named: `models/pretrained`.

use bytes::Bytes;

/// Its name, under which tables know it.
pub const NAME: &str = "pretrained";

/// The name in messages.
pub const PLACE: &str = "the model of the program";

/// Returns a file of the model; none where the program was built without it.
#[cfg(feature = "pretrained")]
pub fn file(name: &str) -> Option<Bytes> {
    use crate::generation::file_names;
    // The folder of `make pretrained`, its files as export writes them.
    macro_rules! file {
        ($name:literal) => {
            Bytes::from_static(include_bytes!(concat!(
                env!("CARGO_MANIFEST_DIR"),
                "/models/pretrained/",
                $name
            )))
        };
    }
    match name {
        file_names::CARD => Some(file!("model.json")),
        file_names::UNET => Some(file!("unet.onnx")),
        file_names::DECODER => Some(file!("decoder.onnx")),
        _ => None,
    }
}

/// Returns a file of the model; none where the program was built without it.
#[cfg(not(feature = "pretrained"))]
pub fn file(_name: &str) -> Option<Bytes> {
    None
}
