//! Parameters as safetensors, named and shaped as PyTorch has them.
//!
//! A PyTorch state dict of the same network, saved as safetensors, loads unchanged. Bytes in, bytes
//! out; what is too large for that goes into a file that the store made.

use std::borrow::Cow;
use std::collections::{BTreeMap, HashMap};

use half::{bf16, f16};
use safetensors::SafeTensors;
use safetensors::tensor::{Dtype, SafeTensorError, TensorView, View};
use tempfile::NamedTempFile;

use crate::autodiff::{Element, Parameters, Plan};
use crate::model::{ParameterId, ParameterList};

/// Why weights could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum WeightsError {
    #[error("{0}; save the state dict as safetensors again")]
    Format(#[from] SafeTensorError),
    /// Everything that does not fit, at once.
    #[error("the weights are not those of this network: {}", .0.join("; "))]
    Mismatch(Vec<String>),
}

/// How numbers are written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    F32,
    F64,
}

/// Parameters, or what lies as they do, under a common beginning of their names.
#[derive(Clone, Copy, Debug)]
pub struct Section<'a, E: Element> {
    /// What stands before each name, `ema.` for example; may be empty.
    pub prefix: &'a str,
    pub plan: &'a Plan,
    pub values: &'a [E],
}

/// One parameter on its way to a file.
struct SavedParameter<'a, E: Element> {
    section: Section<'a, E>,
    id: ParameterId,
    precision: Precision,
}

impl<E: Element> View for SavedParameter<'_, E> {
    fn dtype(&self) -> Dtype {
        match self.precision {
            Precision::F32 => Dtype::F32,
            Precision::F64 => Dtype::F64,
        }
    }

    fn shape(&self) -> &[usize] {
        &self.section.plan.list().get(self.id).shape
    }

    fn data(&self) -> Cow<'_, [u8]> {
        let values = self.section.plan.unpack(self.id, self.section.values);
        let values = values.into_iter().map(Element::to_f64);
        Cow::Owned(match self.precision {
            Precision::F32 => values.flat_map(|x| (x as f32).to_le_bytes()).collect(),
            Precision::F64 => values.flat_map(f64::to_le_bytes).collect(),
        })
    }

    fn data_len(&self) -> usize {
        self.section.plan.list().get(self.id).len() * self.dtype().bitsize() / 8
    }
}

fn tensors<'a, E: Element>(
    sections: &[Section<'a, E>],
    precision: Precision,
) -> Vec<(String, SavedParameter<'a, E>)> {
    let parameters_of = |&section: &Section<'a, E>| {
        section.plan.list().iter().map(move |(id, parameter)| {
            (
                format!("{}{}", section.prefix, parameter.name),
                SavedParameter { section, id, precision },
            )
        })
    };
    sections.iter().flat_map(parameters_of).collect()
}

fn header(metadata: &BTreeMap<String, String>) -> Option<HashMap<String, String>> {
    (!metadata.is_empty()).then(|| metadata.clone().into_iter().collect())
}

/// Writes parameters, or what lies as they do, as a safetensors file.
///
/// # Errors
/// If the format cannot hold them.
pub fn save<E: Element>(
    plan: &Plan,
    values: &[E],
    precision: Precision,
    metadata: &BTreeMap<String, String>,
) -> Result<Vec<u8>, WeightsError> {
    let section = Section { prefix: "", plan, values };
    Ok(safetensors::serialize(tensors(&[section], precision), header(metadata))?)
}

/// Writes several sections in place of a file that the caller made, one tensor in memory at a time, and
/// returns the file that is there then.
///
/// # Errors
/// If the format cannot hold them, or the disk is full.
pub fn save_to_file<E: Element>(
    sections: &[Section<E>],
    precision: Precision,
    metadata: &BTreeMap<String, String>,
    file: NamedTempFile,
) -> Result<NamedTempFile, WeightsError> {
    let path = file.into_temp_path();
    let tensors = tensors(sections, precision);
    safetensors::serialize_to_file(tensors, header(metadata), &path)?;
    // The library writes another file and renames it: what was open is not what lies there now.
    let open = std::fs::File::options().read(true).write(true).open(&path);
    let open = open.map_err(SafeTensorError::IoError)?;
    Ok(NamedTempFile::from_parts(open, path))
}

/// Bytes before the header of a safetensors file, which tell its length.
pub const N_LENGTH_BYTES: u64 = 8;

/// Returns the length of the header, in bytes, that the first bytes of a file tell; none where there are too few.
pub fn header_length(start: &[u8]) -> Option<u64> {
    start.get(..N_LENGTH_BYTES as usize)?.try_into().ok().map(u64::from_le_bytes)
}

/// Returns what was written beside the tensors, of a file that is read up to the end of its header.
///
/// # Errors
/// If the bytes are not the start of a safetensors file.
pub fn metadata(start: &[u8]) -> Result<BTreeMap<String, String>, WeightsError> {
    /// The part of the header that tells of no tensor. The crate's own reader asks for all of the file.
    #[derive(serde::Deserialize)]
    struct Header {
        #[serde(rename = "__metadata__", default)]
        metadata: BTreeMap<String, String>,
    }
    let header = header_length(start)
        .and_then(|n| N_LENGTH_BYTES.checked_add(n))
        .and_then(|end| start.get(N_LENGTH_BYTES as usize..usize::try_from(end).ok()?))
        .ok_or(SafeTensorError::InvalidHeaderLength)?;
    let header: Header =
        serde_json::from_slice(header).map_err(SafeTensorError::InvalidHeaderDeserialization)?;
    Ok(header.metadata)
}

/// A safetensors file that was read.
pub struct Archive<'a> {
    file: SafeTensors<'a>,
    metadata: BTreeMap<String, String>,
}

impl<'a> Archive<'a> {
    /// Reads the header.
    ///
    /// # Errors
    /// If the bytes are no safetensors file.
    pub fn open(bytes: &'a [u8]) -> Result<Self, WeightsError> {
        Ok(Self { file: SafeTensors::deserialize(bytes)?, metadata: metadata(bytes)? })
    }

    /// Returns what was written beside the tensors.
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// Reads the parameters whose names begin with `prefix`; half precision becomes the element's own.
    ///
    /// # Errors
    /// If they are not those of the list: every missing, extra and misshaped tensor is listed.
    pub fn section<E: Element>(
        &self,
        prefix: &str,
        list: ParameterList,
    ) -> Result<Parameters<E>, WeightsError> {
        let within = |name: &'_ str| name.strip_prefix(prefix).map(str::to_owned);
        let found: BTreeMap<_, _> =
            self.file.iter().filter_map(|(name, tensor)| Some((within(name)?, tensor))).collect();
        let mut problems = Vec::new();
        for (_, parameter) in list.iter() {
            let name = &parameter.name;
            match found.get(name.as_str()) {
                None => problems.push(format!("{name} is missing")),
                Some(tensor) if tensor.shape() != parameter.shape => problems.push(format!(
                    "{name} has shape {:?}, the network expects {:?}",
                    tensor.shape(),
                    parameter.shape
                )),
                Some(tensor) if !is_float(tensor.dtype()) => problems
                    .push(format!("{name} holds {:?}, not floating-point numbers", tensor.dtype())),
                Some(_) => {}
            }
        }
        let known = list.by_name();
        for name in found.keys().filter(|name| !known.contains_key(name.as_str())) {
            problems.push(format!("{name} is not a parameter of the network"));
        }
        if !problems.is_empty() {
            return Err(WeightsError::Mismatch(problems));
        }
        Ok(Parameters::from_fn(list, |parameter| {
            let tensor = found.get(parameter.name.as_str()).and_then(numbers);
            tensor.expect("checked above")
        }))
    }
}

/// Reads the parameters of a network; half precision becomes the element's own.
///
/// # Errors
/// As [`Archive::open`] and [`Archive::section`].
pub fn load<E: Element>(bytes: &[u8], list: ParameterList) -> Result<Parameters<E>, WeightsError> {
    Archive::open(bytes)?.section("", list)
}

fn is_float(dtype: Dtype) -> bool {
    matches!(dtype, Dtype::F64 | Dtype::F32 | Dtype::F16 | Dtype::BF16)
}

/// Returns the numbers of a tensor, `None` where they are not floating-point.
fn numbers<E: Element>(tensor: &TensorView) -> Option<Vec<E>> {
    fn each<const N: usize, E: Element>(data: &[u8], read: impl Fn([u8; N]) -> f64) -> Vec<E> {
        data.as_chunks::<N>().0.iter().map(|&bytes| E::from_f64(read(bytes))).collect()
    }
    let data = tensor.data();
    Some(match tensor.dtype() {
        Dtype::F64 => each(data, f64::from_le_bytes),
        Dtype::F32 => each(data, |b| f64::from(f32::from_le_bytes(b))),
        Dtype::F16 => each(data, |b| f16::from_le_bytes(b).to_f64()),
        Dtype::BF16 => each(data, |b| bf16::from_le_bytes(b).to_f64()),
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::{DecoderConfig, MotionDecoder};

    fn small() -> ParameterList {
        let config = DecoderConfig { hidden_dim: 5, n_blocks: 1, ..DecoderConfig::default() };
        MotionDecoder::new(&config).1
    }

    #[test]
    fn what_is_saved_loads_to_the_same_bits() {
        let parameters = Parameters::<f32>::new(small(), 3);
        let metadata = BTreeMap::from([("preset".to_owned(), "tiny".to_owned())]);
        let bytes = save(parameters.plan(), parameters.all(), Precision::F32, &metadata).unwrap();
        let back = load::<f32>(&bytes, small()).unwrap();
        assert_eq!(back.all(), parameters.all());
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        assert_eq!(header.metadata().as_ref().unwrap()["preset"], "tiny");
    }

    #[test]
    fn everything_that_does_not_fit_is_listed() {
        let zeros = vec![0_u8; 4 * 125];
        let view = |dtype, shape: &[usize], n| {
            TensorView::new(dtype, shape.to_vec(), &zeros[..n]).unwrap()
        };
        let mut tensors: BTreeMap<_, _> = small()
            .iter()
            .map(|(_, p)| (p.name.clone(), view(Dtype::F32, &p.shape, 4 * p.len())))
            .collect();
        tensors.remove("phase_head.bias");
        tensors.insert("input_proj.weight".to_owned(), view(Dtype::F32, &[5, 24], 4 * 120));
        tensors.insert("style_head.bias".to_owned(), view(Dtype::I32, &[8], 32));
        tensors.insert("extra".to_owned(), view(Dtype::F32, &[2], 8));
        let bytes = safetensors::serialize(&tensors, None).unwrap();
        let error = load::<f32>(&bytes, small()).unwrap_err();
        assert_eq!(
            error.to_string(),
            "the weights are not those of this network: input_proj.weight has shape [5, 24], the \
             network expects [5, 25]; phase_head.bias is missing; style_head.bias holds I32, not \
             floating-point numbers; extra is not a parameter of the network"
        );
    }

    #[test]
    fn sections_are_told_apart_by_their_prefix() {
        let weights = Parameters::<f32>::new(small(), 3);
        let average = Parameters::<f32>::new(small(), 4);
        let file = NamedTempFile::new().unwrap();
        let sections = [("model.", &weights), ("ema.", &average)].map(|(prefix, parameters)| {
            Section { prefix, plan: parameters.plan(), values: parameters.all() }
        });
        let metadata = BTreeMap::from([("step".to_owned(), "7".to_owned())]);
        let file = save_to_file(&sections, Precision::F32, &metadata, file).unwrap();
        let bytes = std::fs::read(file.path()).unwrap();
        assert_eq!(file.as_file().metadata().unwrap().len(), bytes.len() as u64);
        let archive = Archive::open(&bytes).unwrap();
        assert_eq!(archive.metadata(), &metadata);
        assert_eq!(archive.section::<f32>("ema.", small()).unwrap().all(), average.all());
        assert_eq!(archive.section::<f32>("model.", small()).unwrap().all(), weights.all());
        let error = archive.section::<f32>("moments.", small()).unwrap_err().to_string();
        assert!(error.contains("input_proj.weight is missing"), "{error}");
    }

    #[test]
    fn bytes_of_another_kind_are_refused() {
        let error = load::<f32>(b"PK\x03\x04", small()).unwrap_err();
        assert_eq!(error.to_string(), "header too small; save the state dict as safetensors again");
    }
}
