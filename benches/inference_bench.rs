//! Our side of `benches/inference.py`: a model that is asked in lines of JSON.
//!
//!     inference-bench export --preset base --output DIR   a model with random weights
//!     inference-bench serve                               one request a line, one answer a line
//!
//! Requests: `init` (engine, folder, workers, threads, form of the file: plain or optimized), `sample`
//! (sampler, steps, batch, guidance), `predict` (batch), `bulk` (samples, steps), `compare` (another
//! folder's inputs are not needed: noise and music come from a seed), `quit`.

#![allow(clippy::print_stdout, reason = "answers go to standard output")]

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Instant;

use anyhow::{Context as _, bail};
use motiongen::audio::{FEATURE_DIM, FeatureScale};
use motiongen::autodiff::{Parameters, Stream};
use motiongen::diffusion::{
    DiffusionConfig, Prediction, Sampler, SamplerConfig, Schedule, Spacing,
};
use motiongen::generation::{
    EagerEngine, Engine, EngineInputs, OnnxEngine, Sampling, SessionPlan, sample,
};
use motiongen::model::{DecoderConfig, MotionDecoder, Parameter, ParameterList, Preset, UNet1D};
use motiongen::motion::MOTION_DIM;
use motiongen::onnx::{Device, EMBEDDED_BYTES, Form, Model, ModelFile, Runtime, Session, Storage};
use motiongen::onnx::{decoder, unet, values_of};
use ndarray::Array3;
use serde_json::{Value, json};

const FRAMES: usize = 120;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        ["export", "--preset", preset, "--output", folder] => {
            for form in [Form::Image, Form::Line] {
                export(preset, form, Path::new(folder))?;
            }
            Ok(())
        }
        ["serve"] => serve(),
        _ => bail!("usage: inference-bench serve | export --preset NAME --output DIR"),
    }
}

fn preset_of(name: &str) -> anyhow::Result<Preset> {
    let found = Preset::ALL.into_iter().find(|preset| preset.name() == name);
    found.with_context(|| format!("no preset {name}"))
}

/// Weights as before training; where they are zero (the last convolution), small random ones.
fn random(list: ParameterList) -> Parameters<f32> {
    let drawn = Parameters::<f32>::new(list.clone(), 1);
    let ids = list.by_name();
    Parameters::from_fn(list.clone(), |parameter: &Parameter| {
        let id = ids[parameter.name.as_str()];
        let mut values = drawn.unpacked(id);
        if parameter.name.starts_with("out.conv.") {
            Stream::new(2, 0).normal(0, &mut values);
            values.iter_mut().for_each(|x| *x *= 0.02);
        }
        values
    })
}

fn name_of(form: Form) -> &'static str {
    match form {
        Form::Image => "unet.onnx",
        Form::Line => "unet-line.onnx",
    }
}

fn export(preset: &str, form: Form, folder: &Path) -> anyhow::Result<()> {
    std::fs::create_dir_all(folder)?;
    let config = preset_of(preset)?.config();
    let parameters = random(UNet1D::new(&config).1);
    let scale = FeatureScale::identity(FEATURE_DIM);
    let of_unet = |id| parameters.unpacked(id);
    let graph = unet(&config, &of_unet, &scale, form, Storage::Fp32)?;
    let write = |graph, name: &str| -> anyhow::Result<()> {
        let file = ModelFile { graph, metadata: BTreeMap::new(), description: String::new() };
        let encoded = file.encode(&format!("{name}.bin"), EMBEDDED_BYTES);
        std::fs::write(folder.join(name), &encoded.model)?;
        if let Some(weights) = encoded.weights {
            std::fs::write(folder.join(format!("{name}.bin")), &weights)?;
        }
        Ok(())
    };
    write(graph, name_of(form))?;
    let config = DecoderConfig::default();
    let parameters = random(MotionDecoder::new(&config).1);
    let of_decoder = |id| parameters.unpacked(id);
    write(decoder(&config, &of_decoder, Storage::Fp32)?, "decoder.onnx")
}

fn serve() -> anyhow::Result<()> {
    let mut served = None;
    for line in std::io::stdin().lock().lines() {
        let request: Value = serde_json::from_str(&line?)?;
        let answer = match request["cmd"].as_str() {
            Some("init") => {
                let (made, answer) = Served::new(&request)?;
                served = Some(made);
                answer
            }
            Some("quit") => break,
            Some(command) => {
                served.as_ref().context("init comes first")?.answer(command, &request)?
            }
            None => bail!("no cmd in {request}"),
        };
        println!("{answer}");
        std::io::stdout().flush()?;
    }
    Ok(())
}

struct Served {
    engine: Box<dyn Engine>,
    schedule: Schedule,
}

impl Served {
    fn new(request: &Value) -> anyhow::Result<(Self, Value)> {
        let number = |key: &str| {
            let n = request[key].as_u64().and_then(|n| NonZeroUsize::new(n as usize));
            n.with_context(|| key.to_owned())
        };
        let text = |key: &str| request[key].as_str().with_context(|| key.to_owned());
        let folder = PathBuf::from(text("folder")?);
        let (n_workers, n_threads) = (number("workers")?, number("threads")?);
        let diffusion =
            DiffusionConfig { prediction: Prediction::Sample, ..DiffusionConfig::default() };
        let schedule = Schedule::new(&diffusion)?;
        let started = Instant::now();
        let engine: Box<dyn Engine> = match text("engine")? {
            "eager" => {
                let config = preset_of(text("preset")?)?.config();
                let read = |name: &str, list: ParameterList| -> anyhow::Result<Parameters<f32>> {
                    let model = Model::read(std::fs::read(folder.join(name))?.into(), None, name)?;
                    Ok(Parameters::from_fn(list, |p| values_of(&model, p, name).expect("a weight")))
                };
                let (_, list) = UNet1D::new(&config);
                let of_unet = read("unet.onnx", list)?;
                let (decoder, list) = MotionDecoder::new(&DecoderConfig::default());
                let of_decoder = read("decoder.onnx", list)?;
                Box::new(EagerEngine::new(
                    (&config, of_unet),
                    (decoder, of_decoder),
                    &FeatureScale::identity(FEATURE_DIM),
                    (n_workers, n_threads),
                )?)
            }
            _ => {
                let runtime = Runtime::load(None)?;
                let plan = SessionPlan {
                    n_workers: n_workers.get(),
                    n_threads: n_threads.get(),
                    device: Device::Cpu,
                };
                let name = request["file"].as_str().unwrap_or("unet.onnx");
                let is_optimized = request["optimized"].as_bool().unwrap_or(false);
                let plain = folder.join(name);
                let optimized = folder.join("optimized").join(name);
                if is_optimized && !optimized.exists() {
                    std::fs::create_dir_all(folder.join("optimized"))?;
                    Session::optimize(&runtime, &plain, &optimized)?;
                }
                let path = if is_optimized { optimized } else { plain };
                let decoder = folder.join("decoder.onnx");
                let unet = (path.as_path(), is_optimized);
                let config = preset_of(text("preset")?)?.config();
                Box::new(OnnxEngine::open(&runtime, unet, &decoder, &config, plan)?)
            }
        };
        let load_s = started.elapsed().as_secs_f64();
        let rss_mb = memory_mb("VmRSS:")?;
        Ok((Self { engine, schedule }, json!({ "load_s": load_s, "rss_mb": rss_mb })))
    }

    fn answer(&self, command: &str, request: &Value) -> anyhow::Result<Value> {
        let number =
            |key: &str, default: usize| request[key].as_u64().map_or(default, |n| n as usize);
        let batch = number("batch", 1);
        let n_steps = number("steps", 20);
        let guidance = request["guidance"].as_f64().unwrap_or(1.0);
        let sampler = match request["sampler"].as_str() {
            Some("dpm") => Sampler::DpmSolver,
            _ => Sampler::Ddim { eta: 0.0 },
        };
        let config = SamplerConfig { sampler, n_steps, spacing: Spacing::Trailing, clip: true };
        let started = Instant::now();
        let mut answer = match command {
            "predict" => {
                let (x, audio) = (noise(batch, 1), music(batch));
                let t = vec![500; batch];
                let started = Instant::now();
                let inputs = EngineInputs {
                    x: x.view(),
                    t: &t,
                    audio: audio.view(),
                    drop_audio: &[],
                    style: None,
                };
                let y = self.engine.predict(&inputs)?;
                let wall_s = started.elapsed().as_secs_f64();
                if let Some(path) = request["write"].as_str() {
                    for (name, values) in [("x", &x), ("audio", &audio), ("y", &y)] {
                        let bytes: Vec<u8> = values.iter().flat_map(|x| x.to_le_bytes()).collect();
                        std::fs::write(Path::new(path).join(name), bytes)?;
                    }
                }
                return Ok(json!({ "wall_s": wall_s }));
            }
            "sample" => {
                self.motion(batch, 1, &config, guidance)?;
                json!({})
            }
            "bulk" => {
                let n = number("samples", 4);
                let next = AtomicUsize::new(0);
                let work = || -> anyhow::Result<()> {
                    loop {
                        let i = next.fetch_add(1, Ordering::Relaxed);
                        if i >= n {
                            return Ok(());
                        }
                        self.motion(batch, i as u64, &config, guidance)?;
                    }
                };
                std::thread::scope(|scope| {
                    let workers: Vec<_> =
                        (0..self.engine.n_workers()).map(|_| scope.spawn(work)).collect();
                    workers.into_iter().try_for_each(|worker| worker.join().expect("no panic"))
                })?;
                json!({})
            }
            _ => bail!("unknown cmd {command}"),
        };
        answer["wall_s"] = json!(started.elapsed().as_secs_f64());
        answer["peak_mb"] = json!(memory_mb("VmHWM:")?);
        Ok(answer)
    }

    fn motion(
        &self,
        batch: usize,
        seed: u64,
        config: &SamplerConfig,
        guidance: f64,
    ) -> anyhow::Result<Array3<f32>> {
        let sampling = Sampling { config, schedule: &self.schedule, guidance };
        let (x, audio) = (noise(batch, seed), music(batch));
        let start = (x, self.schedule.len());
        let latent = sample(&*self.engine, sampling, start, audio.view(), None, |_, _| (), None)?;
        Ok(self.engine.decode(latent.view())?)
    }
}

fn noise(batch: usize, seed: u64) -> Array3<f32> {
    let mut x = Array3::zeros((batch, FRAMES, MOTION_DIM));
    Stream::new(seed, 0).normal(0, x.as_slice_mut().expect("in order"));
    x
}

fn music(batch: usize) -> Array3<f32> {
    let mut x = Array3::zeros((batch, FRAMES, FEATURE_DIM));
    Stream::new(99, 0).normal(0, x.as_slice_mut().expect("in order"));
    x
}

fn memory_mb(key: &str) -> anyhow::Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix(key)).context("no such line")?;
    let kilobytes: f64 = line.trim().trim_end_matches(" kB").parse()?;
    Ok(kilobytes * 1024.0 / 1e6)
}
