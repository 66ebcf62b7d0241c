//! A model file in onnxruntime.

use std::borrow::Cow;
use std::path::Path;

use ort::session::builder::{GraphOptimizationLevel, SessionBuilder};
use ort::value::{DynValue, Outlet, TensorRef};

use super::error::OnnxError;
use super::runtime::{Device, Runtime};

/// The sizes of an output and its numbers in order.
pub type ShapedNumbers = (Vec<usize>, Vec<f32>);

/// Name of the weights beside an optimised model.
const OPTIMIZED_WEIGHTS: &str = "weights.bin";
/// Tensors of fewer bytes stay within an optimised model.
const SMALL_BYTES: usize = 1024;

/// How a session runs.
#[derive(Clone, Copy, Debug)]
pub struct SessionOptions {
    /// Threads of one run.
    pub n_threads: usize,
    /// Whether threads wait awake between two operations: a tenth faster alone, a loss where others work.
    pub is_alone: bool,
    pub device: Device,
    /// Whether the file is one that [`Session::optimize`] wrote on this machine.
    pub is_optimized: bool,
}

/// A model that can be run; one run at a time.
pub struct Session {
    session: ort::session::Session,
    place: String,
}

/// An input: its name, sizes and numbers.
#[derive(Clone, Debug)]
pub struct NamedTensor<'a> {
    pub name: &'static str,
    pub shape: Vec<usize>,
    pub numbers: Numbers<'a>,
}

/// The numbers of an input.
#[derive(Clone, Debug)]
pub enum Numbers<'a> {
    Float(Cow<'a, [f32]>),
    Integer(Cow<'a, [i64]>),
}

impl Session {
    /// Loads a file.
    ///
    /// # Errors
    /// [`OnnxError::Refused`] with the message of onnxruntime.
    pub fn open(
        runtime: &Runtime,
        path: &Path,
        options: SessionOptions,
    ) -> Result<Self, OnnxError> {
        let place = path.display().to_string();
        let level = match options.is_optimized {
            true => GraphOptimizationLevel::Disable,
            false => GraphOptimizationLevel::All,
        };
        let open = || -> ort::Result<ort::session::Session> {
            builder(runtime, options)?.with_optimization_level(level)?.commit_from_file(path)
        };
        let session = open().map_err(|e| OnnxError::Refused {
            place: place.clone(),
            reason: one_line(e.message()),
        })?;
        Ok(Self { session, place })
    }

    /// Writes a model as this machine's processor likes it best, with its weights beside it in a form that
    /// is mapped into memory when it is loaded.
    ///
    /// # Errors
    /// [`OnnxError::Refused`] with the message of onnxruntime.
    pub fn optimize(runtime: &Runtime, path: &Path, to: &Path) -> Result<(), OnnxError> {
        let options = SessionOptions {
            n_threads: 1,
            is_alone: false,
            device: Device::Cpu,
            is_optimized: false,
        };
        let open = || -> ort::Result<ort::session::Session> {
            builder(runtime, options)?
                .with_optimization_level(GraphOptimizationLevel::All)?
                .with_config_entry(
                    "session.optimized_model_external_initializers_file_name",
                    OPTIMIZED_WEIGHTS,
                )?
                .with_config_entry(
                    "session.optimized_model_external_initializers_min_size_in_bytes",
                    SMALL_BYTES.to_string(),
                )?
                .with_optimized_model_path(to)?
                .commit_from_file(path)
        };
        open().map(drop).map_err(|e| OnnxError::Refused {
            place: path.display().to_string(),
            reason: one_line(e.message()),
        })
    }

    /// Refuses a model that does not have these inputs and this output, of three axes.
    ///
    /// # Errors
    /// [`OnnxError::Inputs`].
    pub fn expect(&self, inputs: &[&str], output: &str) -> Result<(), OnnxError> {
        self.expect_of(inputs, &[output], 3)
    }

    /// Refuses a model that does not have these inputs and these outputs, of so many axes.
    ///
    /// # Errors
    /// [`OnnxError::Inputs`].
    pub fn expect_of(
        &self,
        inputs: &[&str],
        outputs: &[&str],
        n_axes: usize,
    ) -> Result<(), OnnxError> {
        let mut found: Vec<&str> = self.session.inputs().iter().map(|input| input.name()).collect();
        let made = self.session.outputs();
        let is_there = |name: &&str| {
            let is_output = |value: &Outlet| {
                let axes = value.dtype().tensor_shape().map(|shape| shape.len());
                value.name() == *name && axes == Some(n_axes)
            };
            made.iter().any(is_output)
        };
        if inputs.iter().all(|name| found.contains(name)) && outputs.iter().all(is_there) {
            return Ok(());
        }
        found.extend(made.iter().map(|value| value.name()));
        Err(OnnxError::Inputs {
            place: self.place.clone(),
            found: found.join(", "),
            expected: [inputs, outputs].concat().join(", "),
        })
    }

    /// Runs the model: returns the sizes and the numbers of an output.
    ///
    /// # Errors
    /// [`OnnxError::Run`] with the message of onnxruntime.
    pub fn run(
        &mut self,
        inputs: &[NamedTensor],
        output: &str,
    ) -> Result<ShapedNumbers, OnnxError> {
        let [found] = self.run_for(inputs, [output])?;
        Ok(found)
    }

    /// Runs the model: returns the sizes and the numbers of several outputs.
    ///
    /// # Errors
    /// [`OnnxError::Run`] with the message of onnxruntime.
    pub fn run_for<const N: usize>(
        &mut self,
        inputs: &[NamedTensor],
        outputs: [&str; N],
    ) -> Result<[ShapedNumbers; N], OnnxError> {
        let Self { session, place } = self;
        let mut run = || -> ort::Result<[ShapedNumbers; N]> {
            let mut values: Vec<(&str, ort::session::SessionInputValue)> = Vec::new();
            for input in inputs {
                let shape = input.shape.clone();
                values.push((
                    input.name,
                    match &input.numbers {
                        Numbers::Float(x) => TensorRef::from_array_view((shape, &**x))?.into(),
                        Numbers::Integer(x) => TensorRef::from_array_view((shape, &**x))?.into(),
                    },
                ));
            }
            let made = session.run(values)?;
            let mut found = std::array::from_fn(|_| (Vec::new(), Vec::new()));
            for (found, output) in found.iter_mut().zip(outputs) {
                let value: &DynValue = made
                    .get(output)
                    .ok_or_else(|| ort::Error::new(format!("there is no output {output}")))?;
                *found = numbers_of(value)?;
            }
            Ok(found)
        };
        run().map_err(|e| OnnxError::Run { place: place.clone(), reason: one_line(e.message()) })
    }
}

/// Returns the sizes and the numbers of a value; whole numbers that networks return are indices, which f32 holds.
fn numbers_of(value: &DynValue) -> ort::Result<ShapedNumbers> {
    let sizes = |shape: &[i64]| shape.iter().map(|&n| n.max(0) as usize).collect();
    if let Ok((shape, numbers)) = value.try_extract_tensor::<i64>() {
        return Ok((sizes(shape), numbers.iter().map(|&x| x as f32).collect()));
    }
    let (shape, numbers) = value.try_extract_tensor::<f32>()?;
    Ok((sizes(shape), numbers.to_vec()))
}

fn builder(runtime: &Runtime, options: SessionOptions) -> ort::Result<SessionBuilder> {
    let builder = ort::session::Session::builder(runtime.environment())?
        .with_intra_threads(options.n_threads.max(1))?
        .with_intra_op_spinning(options.is_alone)?
        // Rounded weights are widened once; products of 8-bit numbers would round what they meet too.
        .with_config_entry("session.disable_quant_qdq", "1")?;
    let providers = options.device.providers();
    if providers.is_empty() {
        return Ok(builder);
    }
    Ok(builder.with_execution_providers(providers)?)
}

/// Returns the first line of what a library says, which is one sentence of ours.
fn one_line(message: &str) -> String {
    let line = message.lines().next().unwrap_or_default().trim().trim_end_matches('.');
    line.to_owned()
}
