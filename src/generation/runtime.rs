//! The engine that runs a model's files in onnxruntime.

use std::borrow::Cow;
use std::path::Path;

use ndarray::{Array3, ArrayView3, s};

use crate::audio::FEATURE_DIM;
use crate::model::UNetConfig;
use crate::onnx::{
    DecoderNames, Device, NamedTensor, Numbers, OnnxError, Runtime, Session, SessionOptions,
    UNetNames,
};

use super::engine::{Engine, EngineError, EngineInputs};
use super::pool::Pool;

/// Workers and their threads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SessionPlan {
    pub n_workers: usize,
    /// Threads of each worker.
    pub n_threads: usize,
    pub device: Device,
}

/// Runs a model by onnxruntime: a pair of sessions for each worker.
///
/// A session does one run at a time, so a job that keeps N cores busy has N workers of one thread; a single
/// motion is fastest with one worker of N threads.
pub struct OnnxEngine {
    workers: Pool<OnnxWorker>,
    config: UNetConfig,
}

struct OnnxWorker {
    unet: Session,
    decoder: Session,
}

impl OnnxEngine {
    /// Loads the files, as many times as there are workers.
    ///
    /// # Errors
    /// Errors of onnxruntime about a file, or inputs and outputs that are not those of a model.
    pub fn open(
        runtime: &Runtime,
        (unet, is_optimized): (&Path, bool),
        decoder: &Path,
        config: &UNetConfig,
        plan: SessionPlan,
    ) -> Result<Self, OnnxError> {
        let options = |is_optimized| SessionOptions {
            n_threads: plan.n_threads,
            is_alone: plan.n_workers == 1,
            device: plan.device,
            is_optimized,
        };
        let worker = |_| {
            let worker = OnnxWorker {
                unet: Session::open(runtime, unet, options(is_optimized))?,
                decoder: Session::open(runtime, decoder, options(false))?,
            };
            let mut needed = vec![UNetNames::X, UNetNames::T, UNetNames::AUDIO];
            needed.extend(config.clock.then_some(UNetNames::CLOCK));
            worker.unet.expect(&needed, UNetNames::PREDICTION)?;
            worker.decoder.expect(&[DecoderNames::LATENT], DecoderNames::MOTION)?;
            Ok(worker)
        };
        let workers = (0..plan.n_workers.max(1)).map(worker).collect::<Result<Vec<_>, _>>()?;
        Ok(Self { workers: Pool::new(workers), config: config.clone() })
    }
}

impl Engine for OnnxEngine {
    fn name(&self) -> &'static str {
        "onnx"
    }

    fn n_workers(&self) -> usize {
        self.workers.len()
    }

    fn predict(&self, inputs: &EngineInputs) -> Result<Array3<f32>, EngineError> {
        inputs.check(self.config.condition_dim())?;
        let batch = inputs.x.dim().0;
        let t: Vec<i64> = inputs.t.iter().map(|&t| t as i64).collect();
        let mut given = vec![
            floats(UNetNames::X, inputs.x),
            NamedTensor {
                name: UNetNames::T,
                shape: vec![batch],
                numbers: Numbers::Integer(t.into()),
            },
            floats(UNetNames::AUDIO, inputs.audio.slice_move(s![.., .., ..FEATURE_DIM])),
        ];
        if self.config.clock {
            let clock = inputs.audio.slice_move(s![.., .., FEATURE_DIM..]);
            given.push(floats(UNetNames::CLOCK, clock));
        }
        if inputs.drop_audio.contains(&true) {
            let drop: Vec<f32> =
                inputs.drop_audio.iter().map(|&d| f32::from(u8::from(d))).collect();
            let numbers = Numbers::Float(drop.into());
            given.push(NamedTensor { name: UNetNames::DROP_AUDIO, shape: vec![batch], numbers });
        }
        if let Some(style) = inputs.style.filter(|_| self.config.style_dim > 0) {
            let numbers = Numbers::Float(style.iter().copied().collect::<Vec<_>>().into());
            given.push(NamedTensor {
                name: UNetNames::STYLE,
                shape: style.shape().to_vec(),
                numbers,
            });
        }
        let made = self.workers.with(|worker| worker.unet.run(&given, UNetNames::PREDICTION))?;
        to_array("the shape of the prediction", made, inputs.x.shape())
    }

    fn decode(&self, latent: ArrayView3<f32>) -> Result<Array3<f32>, EngineError> {
        let given = [floats(DecoderNames::LATENT, latent)];
        let made = self.workers.with(|worker| worker.decoder.run(&given, DecoderNames::MOTION))?;
        to_array("the shape of the motion", made, latent.shape())
    }
}

fn floats<'a>(name: &'static str, x: ArrayView3<'a, f32>) -> NamedTensor<'a> {
    let shape = x.shape().to_vec();
    let numbers = match x.to_slice() {
        Some(numbers) => Cow::Borrowed(numbers),
        None => Cow::Owned(x.iter().copied().collect()),
    };
    NamedTensor { name, shape, numbers: Numbers::Float(numbers) }
}

fn to_array(
    what: &'static str,
    (shape, numbers): (Vec<usize>, Vec<f32>),
    expected: &[usize],
) -> Result<Array3<f32>, EngineError> {
    let refuse =
        |found: Vec<usize>| EngineError::Shape { what, found, expected: expected.to_vec() };
    let &[a, b, c] = expected else { return Err(refuse(shape)) };
    if shape != expected {
        return Err(refuse(shape));
    }
    Array3::from_shape_vec((a, b, c), numbers).map_err(|_| refuse(shape))
}
