//! A model held against the interpreter that trained it, on real music.

use std::num::NonZeroUsize;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context as _, bail};
use bytes::Bytes;
use ndarray::{Array3, ArrayView3, Axis, s};

use super::Params;
use super::files::ExportedFiles;
use crate::autodiff::{Parameters, Stream};
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::generation::{
    EagerEngine, Engine, EngineInputs, ModelCard, ModelFileName, OnnxEngine, Sampling, SessionPlan,
    file_names, sample,
};
use crate::model::{MotionDecoder, Parameter, ParameterList, UNet1D, condition};
use crate::motion::MOTION_DIM;
use crate::onnx::{Device, Model, Runtime, Session, SessionOptions, Storage, values_of};
use crate::stages::Progress;
use crate::stages::trained::TrainedRun;
use crate::store::tables::OnnxCheckRow;
use crate::store::{TimestampUs, write_file};
use crate::training::Dataset;

/// Name of the check of rounded weights.
pub const ROUNDING: &str = "rounding";
/// Steps of the sampling that is held against another.
const N_STEPS: usize = 20;
const GUIDANCE: f64 = 2.5;
/// Phrases whose music the checks hear.
const N_PHRASES: usize = 16;

/// f32 of another order of summation: 2e-5 at most was seen over a forward of the largest preset.
pub(super) const FORWARD_TOLERANCE: f64 = 1e-4;
/// Twenty forwards, each fed by the one before.
const SAMPLE_TOLERANCE: f64 = 1e-3;
/// Accelerations that are derived are 900 times second differences of positions: of 2 m the last digit in f32 is
/// 2.4e-7 m, four of which make 9e-4 m/s², and a filter over 121 frames loses some more: 2e-3 of a spread was seen.
const DERIVED_TOLERANCE: f64 = 1e-2;
/// Rounded weights: the rms that a whole sample may move, in units of the data's spread.
const ROUNDING_TOLERANCE: f64 = 0.05;

/// The trained networks and exported files to compare.
pub struct ExportChecks<'a> {
    pub dataset: &'a Dataset,
    pub params: &'a Params,
    pub trained: &'a TrainedRun,
    pub files: &'a ExportedFiles<ModelCard>,
}

/// The results of the checks.
pub struct CheckResults {
    pub rows: Vec<OnnxCheckRow>,
    pub runtime: String,
}

impl CheckResults {
    /// Refuses a model that failed a check.
    ///
    /// # Errors
    /// One sentence about the first that failed.
    pub fn require(&self, model: &str) -> anyhow::Result<()> {
        let Some(failed) = self.rows.iter().find(|row| !row.passed) else { return Ok(()) };
        bail!(
            "model {model} was not written: check {} on {} × {} frames differs by {:.2e}, {:.0e} is allowed; \
             all checks are in the table onnx_checks",
            failed.check,
            failed.n_samples,
            failed.n_frames,
            if failed.check == ROUNDING { failed.rms } else { failed.max_abs },
            failed.tolerance
        );
    }
}

/// How far two answers are apart.
#[derive(Clone, Copy)]
pub(super) struct Difference {
    pub max_abs: f64,
    pub rms: f64,
}

/// Returns how far two lists of numbers are apart.
pub(super) fn difference<'a>(
    a: impl IntoIterator<Item = &'a f32>,
    b: impl IntoIterator<Item = &'a f32>,
) -> Difference {
    let (mut max_abs, mut squares, mut n) = (0.0_f64, 0.0, 0);
    for (a, b) in a.into_iter().zip(b) {
        let d = f64::from(a - b).abs();
        // NaN stays: f64::max would drop it.
        max_abs = if d > max_abs || d.is_nan() { d } else { max_abs };
        squares += d * d;
        n += 1;
    }
    Difference { max_abs, rms: (squares / f64::from(n.max(1))).sqrt() }
}

/// Returns the row of a check of so many samples and frames, without times and runtime.
pub(super) fn check_row(
    params: &Params,
    check: &str,
    (n_samples, n_frames): (usize, usize),
    difference: Difference,
    tolerance: f64,
) -> OnnxCheckRow {
    OnnxCheckRow {
        model: params.model.clone(),
        run: params.run.clone(),
        check: check.to_owned(),
        precision: params.precision.name().to_owned(),
        n_samples: n_samples as i32,
        n_frames: n_frames as i32,
        n_steps: None,
        guidance: None,
        max_abs: difference.max_abs,
        rms: difference.rms,
        tolerance,
        // NaN is not within any tolerance.
        passed: difference.max_abs <= tolerance,
        onnx_s: None,
        eager_s: 0.0,
        runtime: String::new(),
        time: TimestampUs::now(),
    }
}

/// Writes files into a folder.
fn write_into(folder: &Path, files: &[(ModelFileName, Bytes)]) -> anyhow::Result<()> {
    for (name, bytes) in files {
        let path = folder.join(name.name());
        write_file(&path, |out| out.write_all(bytes))
            .with_context(|| format!("while writing {}", path.display()))?;
    }
    Ok(())
}

/// Opens each file of a model by itself, with all threads and as the file has it.
///
/// # Errors
/// When a file cannot be written, or the runtime refuses it.
pub(super) fn sessions(
    files: &[(ModelFileName, Bytes)],
    params: &Params,
    runtime: &Runtime,
) -> anyhow::Result<Vec<Session>> {
    let folder = tempfile::tempdir().context("while making a temporary folder")?;
    write_into(folder.path(), files)?;
    let options = SessionOptions {
        n_threads: params.machine.threads.get(),
        is_alone: true,
        device: Device::Cpu,
        is_optimized: false,
    };
    let open = |(name, _): &(ModelFileName, Bytes)| {
        Ok(Session::open(runtime, &folder.path().join(name.name()), options)?)
    };
    files.iter().map(open).collect()
}

/// A batch that both engines are asked about.
struct Case {
    n_samples: usize,
    n_frames: usize,
}

impl ExportChecks<'_> {
    /// Runs the checks.
    ///
    /// # Errors
    /// When onnxruntime refuses a file, or there is no music to check with.
    pub fn run(&self, runtime: &Runtime, progress: &dyn Progress) -> anyhow::Result<CheckResults> {
        let machine = &self.params.machine;
        let folder = tempfile::tempdir().context("while making a temporary folder")?;
        write_into(folder.path(), &self.files.bytes)?;
        let network = &self.trained.state.config.network;
        let plan =
            SessionPlan { n_workers: 1, n_threads: machine.threads.get(), device: Device::Cpu };
        let path = |name| folder.path().join(name);
        let unet = path(file_names::UNET);
        let decoder = path(file_names::DECODER);
        let onnx = OnnxEngine::open(runtime, (&unet, false), &decoder, &network.unet, plan)?;
        // What the files hold, which rounding has changed.
        let stored_weights = (
            self.read_back(
                file_names::UNET,
                file_names::UNET_WEIGHTS,
                UNet1D::new(&network.unet).1,
            )?,
            self.read_back(
                file_names::DECODER,
                file_names::DECODER_WEIGHTS,
                MotionDecoder::new(&network.decoder).1,
            )?,
        );
        let threads = machine.threads;
        let eager_of = |weights| eager(self.trained, weights, threads);
        let stored_weights = eager_of(stored_weights)?;
        let music = self.music()?;
        let schedule = Schedule::new(&network.diffusion)?;
        let window = network.window_frames;
        let cases = [(1, window), (3, window), (2, window / 2 + 17), (1, 2 * window + 1)]
            .map(|(n_samples, n_frames)| Case { n_samples, n_frames });
        let is_rounded = self.params.precision != Storage::Fp32;
        progress.start("check", "checks", cases.len() as u64 + 3 + u64::from(is_rounded));
        let mut rows = Vec::new();
        for case in &cases {
            rows.push(self.forward(&onnx, &stored_weights, &music, case, schedule.len())?);
            progress.advance(1);
        }
        let case = Case { n_samples: 2, n_frames: window };
        let config = SamplerConfig {
            sampler: Sampler::Ddim { eta: 0.0 },
            n_steps: N_STEPS.min(schedule.len()),
            spacing: Spacing::Trailing,
            clip: true,
        };
        let asked = |guidance| Sampling { config: &config, schedule: &schedule, guidance };
        let (row, latent) =
            self.sampled("sample", &onnx, &stored_weights, &music, &case, asked(1.0))?;
        rows.push(row);
        progress.advance(1);
        rows.push(self.decoded(&onnx, &stored_weights, latent.view())?);
        progress.advance(1);
        let guided = asked(GUIDANCE);
        rows.push(self.sampled("guided_sample", &onnx, &stored_weights, &music, &case, guided)?.0);
        progress.advance(1);
        if is_rounded {
            let TrainedRun { unet, decoder, .. } = self.trained;
            let trained = eager_of((unet.parameters.clone(), decoder.parameters.clone()))?;
            let (row, _) =
                self.sampled(ROUNDING, &trained, &stored_weights, &music, &case, asked(1.0))?;
            rows.push(OnnxCheckRow { onnx_s: None, ..row });
            progress.advance(1);
        }
        progress.finish();
        let build = runtime.build();
        for row in &mut rows {
            row.runtime.clone_from(&build);
        }
        Ok(CheckResults { rows, runtime: build })
    }

    /// Reads weights out of the files, as the eager engine does.
    fn read_back(
        &self,
        name: &str,
        weights_name: &str,
        list: ParameterList,
    ) -> anyhow::Result<Parameters<f32>> {
        let bytes = self.files.get(name).with_context(|| format!("there is no {name}"))?;
        let model = Model::read(bytes.clone(), self.files.get(weights_name), name)?;
        for (_, parameter) in list.iter() {
            values_of(&model, parameter, name)?;
        }
        let values =
            |parameter: &Parameter| values_of(&model, parameter, name).expect("looked up before");
        Ok(Parameters::from_fn(list, values))
    }

    /// Returns music of the store as the network hears it, frame after frame, \[frames, condition_dim\];
    /// held-out songs first.
    fn music(&self) -> anyhow::Result<ndarray::Array2<f32>> {
        let dataset = self.dataset;
        let mut order: Vec<_> = dataset.phrases().iter().collect();
        order.sort_by_key(|phrase| std::cmp::Reverse(phrase.split));
        let config = &self.trained.state.config.network.unet;
        let mut music = ndarray::Array2::zeros((0, config.condition_dim()));
        for phrase in order.into_iter().take(N_PHRASES) {
            let features = dataset.features(phrase, 0, phrase.n_frames)?;
            let clock = phrase.clock_of(dataset.motion(phrase, 0, phrase.n_frames)?.view());
            let heard = condition(config, features.view(), Some(clock.view()));
            music.append(Axis(0), heard.view()).context("features of another width")?;
        }
        Ok(music)
    }

    /// Returns the music of a case: excerpts that begin at different places, \[samples, frames, condition_dim\].
    fn audio(music: &ndarray::Array2<f32>, case: &Case) -> Array3<f32> {
        let n = music.nrows().max(1);
        Array3::from_shape_fn((case.n_samples, case.n_frames, music.ncols()), |(i, t, j)| {
            music[[(i * n / case.n_samples + t) % n, j]]
        })
    }

    fn noise(case: &Case, seed: u64) -> Array3<f32> {
        let mut x = Array3::zeros((case.n_samples, case.n_frames, MOTION_DIM));
        let values = x.as_slice_mut().expect("in order");
        Stream::new(seed, 0).normal(0, values);
        x
    }

    fn row(&self, check: &str, case: &Case, difference: Difference) -> OnnxCheckRow {
        let shape = (case.n_samples, case.n_frames);
        check_row(self.params, check, shape, difference, FORWARD_TOLERANCE)
    }

    fn forward(
        &self,
        onnx: &dyn Engine,
        eager: &dyn Engine,
        music: &ndarray::Array2<f32>,
        case: &Case,
        n_steps: usize,
    ) -> anyhow::Result<OnnxCheckRow> {
        let (x, audio) = (Self::noise(case, 11), Self::audio(music, case));
        // Steps from the least noisy to the noisiest; the last of several samples goes without music.
        let n = case.n_samples;
        let t: Vec<usize> = (0..n).map(|i| (i + 1) * (n_steps - 1) / n).collect();
        let drop: Vec<bool> = (0..n).map(|i| n > 1 && i + 1 == n).collect();
        let inputs = EngineInputs {
            x: x.view(),
            t: &t,
            audio: audio.view(),
            drop_audio: &drop,
            style: None,
        };
        let (a, onnx_s) = timed(|| onnx.predict(&inputs))?;
        let (b, eager_s) = timed(|| eager.predict(&inputs))?;
        let row = self.row("forward", case, difference(&a, &b));
        Ok(OnnxCheckRow { onnx_s: Some(onnx_s), eager_s, ..row })
    }

    fn sampled(
        &self,
        check: &str,
        onnx: &dyn Engine,
        eager: &dyn Engine,
        music: &ndarray::Array2<f32>,
        case: &Case,
        sampling: Sampling,
    ) -> anyhow::Result<(OnnxCheckRow, Array3<f32>)> {
        let (x, audio) = (Self::noise(case, 12), Self::audio(music, case));
        let run = |engine: &dyn Engine| {
            sample(
                engine,
                sampling,
                (x.clone(), sampling.schedule.len()),
                audio.view(),
                None,
                |_, _| (),
                None,
            )
        };
        let (a, onnx_s) = timed(|| run(onnx))?;
        let (b, eager_s) = timed(|| run(eager))?;
        let difference = difference(&a, &b);
        let (tolerance, found) = match check == ROUNDING {
            true => (ROUNDING_TOLERANCE, difference.rms),
            false => (SAMPLE_TOLERANCE, difference.max_abs),
        };
        let row = OnnxCheckRow {
            n_steps: Some(sampling.config.n_steps as i32),
            guidance: Some(sampling.guidance),
            tolerance,
            passed: found <= tolerance,
            onnx_s: Some(onnx_s),
            eager_s,
            ..self.row(check, case, difference)
        };
        Ok((row, b))
    }

    /// The decoder on what was sampled, its motion in units of each channel's spread.
    fn decoded(
        &self,
        onnx: &dyn Engine,
        eager: &dyn Engine,
        latent: ArrayView3<f32>,
    ) -> anyhow::Result<OnnxCheckRow> {
        let (mut a, onnx_s) = timed(|| onnx.decode(latent))?;
        let (mut b, eager_s) = timed(|| eager.decode(latent))?;
        let scale = &self.trained.state.scales.motion.scale;
        for motion in [&mut a, &mut b] {
            for (i, scale) in scale.iter().enumerate() {
                motion.slice_mut(s![.., .., i]).mapv_inplace(|x| x / scale);
            }
        }
        let (n_samples, n_frames, _) = latent.dim();
        let difference = difference(&a, &b);
        let row = self.row("decode", &Case { n_samples, n_frames }, difference);
        let fuses = self.trained.state.config.network.decoder.fusion.is_some();
        let tolerance = if fuses { DERIVED_TOLERANCE } else { FORWARD_TOLERANCE };
        let passed = difference.max_abs <= tolerance;
        Ok(OnnxCheckRow { tolerance, passed, onnx_s: Some(onnx_s), eager_s, ..row })
    }
}

/// Makes the engine of our own interpreter for a run's networks, with weights of UNet and decoder.
pub fn eager(
    trained: &TrainedRun,
    (unet, decoder): (Parameters<f32>, Parameters<f32>),
    n_threads: NonZeroUsize,
) -> anyhow::Result<EagerEngine> {
    let network = &trained.state.config.network;
    let engine = EagerEngine::new(
        (&network.unet, unet),
        (MotionDecoder::new(&network.decoder).0, decoder),
        &trained.state.scales.features,
        (NonZeroUsize::MIN, n_threads),
    );
    engine.context("while starting threads")
}

pub(super) fn timed<T, E>(work: impl FnOnce() -> Result<T, E>) -> Result<(T, f64), E> {
    let started = Instant::now();
    let made = work()?;
    Ok((made, started.elapsed().as_secs_f64()))
}
