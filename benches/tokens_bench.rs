//! Our side of `benches/tokens.py`: a model of tokens that is asked in lines of JSON.
//!
//!     tokens-bench serve      one request a line, one answer a line
//!
//! Requests: `init` (preset, kind, engine, folder for the files of onnxruntime, threads), `plan` (answers: 2 where it is
//! guided), `decode`, `quit`. Weights are random.

#![allow(clippy::print_stdout, reason = "answers go to standard output")]

use std::collections::BTreeMap;
use std::io::{BufRead as _, Write as _};
use std::num::NonZeroUsize;
use std::path::Path;
use std::time::Instant;

use anyhow::{Context as _, bail};
use motiongen::audio::{FEATURE_DIM, FeatureScale};
use motiongen::autodiff::{Parameters, Stream};
use motiongen::diffusion::{DiffusionConfig, Prediction, SamplerConfig, Schedule, TokenSampling};
use motiongen::generation::{
    OnnxPlanner, OnnxTokenizer, PlanRequest, PlannerEngine, SessionPlan, TokenEngine,
};
use motiongen::model::{
    ParameterId, Planner, PlannerConfig, PlannerKind, Preset, Tokenizer, TokensConfig,
};
use motiongen::motion::{MOTION_DIM, Normalizer};
use motiongen::onnx::{
    Device, EMBEDDED_BYTES, Graph, ModelFile, Runtime, Storage, planner, planner_music,
    planner_step, token_denoiser, token_encoder, token_signal,
};
use ndarray::{Array2, Array3};
use serde_json::{Value, json};

const FRAMES: usize = 120;

fn main() -> anyhow::Result<()> {
    match std::env::args().skip(1).collect::<Vec<_>>().as_slice() {
        [command] if command == "serve" => serve(),
        _ => bail!("usage: tokens-bench serve"),
    }
}

fn serve() -> anyhow::Result<()> {
    let mut served = None;
    for line in std::io::stdin().lock().lines() {
        let request: Value = serde_json::from_str(&line?)?;
        let answer = match request["cmd"].as_str() {
            Some("init") => {
                served = Some(Served::new(&request)?);
                json!({})
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
    tokens: TokenEngine,
    planner: PlannerEngine,
    schedule: Schedule,
}

impl Served {
    fn new(request: &Value) -> anyhow::Result<Self> {
        let text = |key: &str| request[key].as_str().with_context(|| key.to_owned());
        let name = text("preset")?;
        let preset = Preset::ALL.into_iter().find(|preset| preset.name() == name);
        let preset = preset.context("preset")?;
        let kind = match text("kind")? {
            "masked" => PlannerKind::Masked,
            _ => PlannerKind::Autoregressive,
        };
        let threads = request["threads"].as_u64().and_then(|n| NonZeroUsize::new(n as usize));
        let threads = threads.context("threads")?;
        let sizes = TokensConfig::of(preset).context("a preset of the family")?;
        let config = PlannerConfig::of(preset, kind, &sizes).context("a preset of the family")?;
        let of_tokenizer =
            Parameters::<f32>::new(Tokenizer::new(&sizes).1.without_zero_layers(), 1);
        let of_planner = Parameters::<f32>::new(Planner::new(&config).1, 2);
        let scale = FeatureScale::identity(FEATURE_DIM);
        let normalizer = Normalizer::identity();
        let diffusion =
            DiffusionConfig { prediction: Prediction::Sample, ..DiffusionConfig::default() };
        let schedule = Schedule::new(&diffusion)?;
        if text("engine")? == "eager" {
            let workers = (NonZeroUsize::MIN, threads);
            let tokens = TokenEngine::new(&sizes, of_tokenizer, &normalizer, FRAMES, workers)?;
            let planner = PlannerEngine::new(&config, of_planner, &scale, workers)?;
            return Ok(Self { tokens, planner, schedule });
        }
        let folder = Path::new(text("folder")?);
        std::fs::create_dir_all(folder)?;
        let values = |id: ParameterId| of_tokenizer.unpacked(id);
        let storage = Storage::Fp32;
        write(token_encoder(&sizes, &values, storage)?, folder, "encoder.onnx")?;
        write(token_signal(&sizes, &values, storage)?, folder, "signal.onnx")?;
        write(token_denoiser(&sizes, &values, storage)?, folder, "denoiser.onnx")?;
        let values = |id: ParameterId| of_planner.unpacked(id);
        match kind {
            PlannerKind::Masked => {
                write(planner(&config, &values, &scale, storage)?, folder, "planner.onnx")?;
            }
            PlannerKind::Autoregressive => {
                let music = planner_music(&config, &values, &scale, storage)?;
                write(music, folder, "planner_music.onnx")?;
                write(planner_step(&config, &values, storage)?, folder, "planner_step.onnx")?;
            }
        }
        let runtime = Runtime::load(None)?;
        let plan = SessionPlan { n_workers: 1, n_threads: threads.get(), device: Device::Cpu };
        let tokenizer = OnnxTokenizer::open(&runtime, folder, &sizes, plan)?;
        let planner = OnnxPlanner::open(&runtime, folder, &config, plan)?;
        Ok(Self {
            tokens: TokenEngine::with(&sizes, Box::new(tokenizer), &normalizer, FRAMES),
            planner: PlannerEngine::with(&config, Box::new(planner)),
            schedule,
        })
    }

    fn answer(&self, command: &str, request: &Value) -> anyhow::Result<Value> {
        let started = Instant::now();
        match command {
            "plan" => {
                let music = Array2::from_shape_fn((FRAMES, FEATURE_DIM + 10), |(t, i)| {
                    ((t * 7 + i * 13) as f32 * 0.1).sin()
                });
                let request = PlanRequest {
                    condition: music.view(),
                    style: None,
                    constraints: None,
                    given: &[],
                    guidance: if request["answers"] == 1 { 1.0 } else { 2.0 },
                    seed: 3,
                    window: 0,
                };
                self.planner.plan(&TokenSampling::default(), &request)?;
            }
            "decode" => {
                let sizes = self.tokens.sizes();
                let n = sizes.n_tokens(FRAMES);
                let tokens: Vec<u32> = (0..n).map(|i| (i * 7 % sizes.codes) as u32).collect();
                let mut x = Array3::zeros((1, FRAMES, MOTION_DIM));
                let fill = |draw: usize, z: &mut [f32]| Stream::new(4, draw as u64).normal(0, z);
                fill(0, x.as_slice_mut().context("in order")?);
                let how = (&SamplerConfig::fast27(), &self.schedule);
                self.tokens.decode(&tokens, x, how, |draw, z| fill(draw + 1, z), None)?;
            }
            _ => bail!("unknown cmd {command}"),
        }
        Ok(json!({ "wall_s": started.elapsed().as_secs_f64() }))
    }
}

fn write(graph: Graph, folder: &Path, name: &str) -> anyhow::Result<()> {
    let file = ModelFile { graph, metadata: BTreeMap::new(), description: String::new() };
    let weights_name = format!("{name}.bin");
    let encoded = file.encode(&weights_name, EMBEDDED_BYTES);
    std::fs::write(folder.join(name), &encoded.model)?;
    if let Some(weights) = encoded.weights {
        std::fs::write(folder.join(weights_name), &weights)?;
    }
    Ok(())
}
