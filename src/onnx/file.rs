//! A model file: graph, versions, metadata, and where its weights lie.

use std::collections::BTreeMap;

use bytes::Bytes;
use prost::Message as _;

use super::error::OnnxError;
use super::proto::{DataLocation, Entry, Graph, Model, OperatorSet};

/// Version of the standard operators: the first with everything that is used, run by onnxruntime 1.20
/// and newer.
pub const OPSET: i64 = 21;
/// Version of the file format that came with it.
pub const IR_VERSION: i64 = 10;
/// Weights of more bytes lie in a file of their own beside the model: a protocol buffer ends at 2 GB.
pub const EMBEDDED_BYTES: usize = 1_000_000_000;
/// Smaller tensors stay in the model: runtimes look into shapes and scales when they load it.
const SMALL_BYTES: usize = 1024;
/// Weights begin at multiples of this in their file, so that they can be mapped into memory.
const PAGE_BYTES: usize = 4096;

/// A model before it is bytes.
#[derive(Clone, Debug)]
pub struct ModelFile {
    pub graph: Graph,
    /// Metadata of the model: key and value.
    pub metadata: BTreeMap<String, String>,
    pub description: String,
}

/// A model as bytes.
#[derive(Clone, Debug)]
pub struct EncodedModel {
    pub model: Bytes,
    /// The weights, if they lie in a file of their own.
    pub weights: Option<Bytes>,
}

impl ModelFile {
    /// Returns the whole message.
    fn into_message(self) -> Model {
        let entry = |(key, value)| Entry { key, value };
        Model {
            ir_version: IR_VERSION,
            producer_name: env!("CARGO_PKG_NAME").to_owned(),
            producer_version: env!("CARGO_PKG_VERSION").to_owned(),
            doc_string: self.description,
            graph: Some(self.graph),
            opset_import: vec![OperatorSet { domain: String::new(), version: OPSET }],
            metadata_props: self.metadata.into_iter().map(entry).collect(),
        }
    }

    /// Returns the bytes; weights of more than `embedded_bytes` go into a file called `weights_name`.
    pub fn encode(self, weights_name: &str, embedded_bytes: usize) -> EncodedModel {
        let mut model = self.into_message();
        let tensors = model.graph.iter_mut().flat_map(|graph| &mut graph.initializer);
        let n_bytes: usize = tensors.map(|tensor| tensor.raw_data.len()).sum();
        let mut weights = None;
        if n_bytes > embedded_bytes {
            let mut file = Vec::with_capacity(n_bytes + n_bytes / 8);
            for tensor in model.graph.iter_mut().flat_map(|graph| &mut graph.initializer) {
                let n = tensor.raw_data.len();
                if n < SMALL_BYTES {
                    continue;
                }
                file.resize(file.len().next_multiple_of(PAGE_BYTES), 0);
                let entry = |key: &str, value: String| Entry { key: key.to_owned(), value };
                tensor.external_data = vec![
                    entry("location", weights_name.to_owned()),
                    entry("offset", file.len().to_string()),
                    entry("length", n.to_string()),
                ];
                tensor.data_location = DataLocation::External.into();
                file.extend_from_slice(&std::mem::take(&mut tensor.raw_data));
            }
            weights = Some(Bytes::from(file));
        }
        EncodedModel { model: Bytes::from(model.encode_to_vec()), weights }
    }
}

impl Model {
    /// Reads a model file; `place` is what messages call it.
    ///
    /// Weights in a file of their own are put in their places from `weights`.
    ///
    /// # Errors
    /// [`OnnxError::Unreadable`] for bytes that are none, [`OnnxError::Opset`] for operators of another
    /// version.
    pub fn read(bytes: Bytes, weights: Option<&Bytes>, place: &str) -> Result<Self, OnnxError> {
        let refuse = |reason: String| OnnxError::Unreadable { place: place.to_owned(), reason };
        let mut model = Self::decode(bytes).map_err(|e| refuse(e.to_string()))?;
        let Some(graph) = &mut model.graph else {
            return Err(refuse("there is no graph".to_owned()));
        };
        for tensor in &mut graph.initializer {
            if tensor.data_location != i32::from(DataLocation::External) {
                continue;
            }
            let number = |key: &str| {
                let entry = tensor.external_data.iter().find(|entry| entry.key == key);
                entry.and_then(|entry| entry.value.parse::<usize>().ok())
            };
            let all = weights.ok_or_else(|| refuse("the file of its weights is missing".into()))?;
            let range = number("offset").zip(number("length"));
            let range = range.and_then(|(first, n)| Some(first..first.checked_add(n)?));
            match range {
                Some(range) if range.end <= all.len() => tensor.raw_data = all.slice(range),
                _ => {
                    let name = &tensor.name;
                    return Err(refuse(format!("weight {name} lies outside of its file")));
                }
            }
        }
        let found = model.opset();
        if found != OPSET {
            return Err(OnnxError::Opset { place: place.to_owned(), found, expected: OPSET });
        }
        Ok(model)
    }

    /// Returns the version of the standard operators, 0 where none is named.
    pub fn opset(&self) -> i64 {
        self.opset_import.iter().find(|set| set.domain.is_empty()).map_or(0, |set| set.version)
    }

    /// Returns what is told of the model under a key.
    pub fn metadata(&self, key: &str) -> Option<&str> {
        self.metadata_props.iter().find(|entry| entry.key == key).map(|entry| entry.value.as_str())
    }
}
