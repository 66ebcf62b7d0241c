//! The engine's side of `benches/training.py`: steps of end-to-end fine-tuning and of training groups, asked for in
//! lines of JSON.
//!
//!     training-bench      one request per line on standard input, one answer per line

#![allow(clippy::print_stdout, reason = "answers go to standard output")]

use std::io::{BufRead as _, Write as _};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, bail};
use motiongen::audio::FeatureScale;
use motiongen::autodiff::{Parameters, Stream, Threads};
use motiongen::diffusion::{DiffusionConfig, Prediction, SamplerConfig, Schedule};
use motiongen::generation::{
    ConsistencyForm, EngineError, GroupEngine, GroupGenerator, GroupTrack,
};
use motiongen::model::{DecoderConfig, GroupConfig, GroupNetworks, MotionDecoder, Preset, UNet1D};
use motiongen::motion::{MOTION_DIM, Normalizer};
use motiongen::training::{
    Augmentation, Batch, Chances, Dataset, EmaConfig, FinetuneConfig, FinetuneLearner,
    GroupLearner, GroupLosses, GroupNetworkConfig, GroupTraining, Learner, LearningRate,
    LearningRateSchedule, NetworkConfig, Objective, OptimizerConfig, PartedLearner, TemporalConfig,
    Windows, WithholdProbabilities,
};
use ndarray::Array2;
use serde_json::{Value, json};

fn main() -> anyhow::Result<()> {
    let mut bench: Option<Box<dyn Steps>> = None;
    for line in std::io::stdin().lock().lines() {
        let request: Value = serde_json::from_str(&line?)?;
        let answer = match request["cmd"].as_str() {
            Some("init") => {
                let (made, n_parameters) = match request["family"].as_str() {
                    Some("group") => of_group(&request)?,
                    Some("group_generation") => of_group_generation(&request)?,
                    _ => of_soloist(&request)?,
                };
                bench = Some(made);
                json!({ "ok": true, "parameters": n_parameters })
            }
            Some("step") => bench.as_mut().context("init comes first")?.step()?,
            Some("quit") => break,
            other => bail!("unknown cmd {other:?}"),
        };
        println!("{answer}");
        std::io::stdout().flush()?;
    }
    Ok(())
}

/// Training that goes on step by step.
trait Steps {
    fn step(&mut self) -> anyhow::Result<Value>;
}

/// A learner with a batch of random numbers.
struct Bench<L> {
    learner: L,
    batch: Batch,
    n_steps: u64,
}

fn preset_of(request: &Value) -> anyhow::Result<Preset> {
    let name = request["preset"].as_str().context("preset")?;
    let preset = Preset::ALL.into_iter().find(|preset| preset.name() == name);
    preset.with_context(|| format!("no preset {name}"))
}

fn random(stream: u64, len: usize) -> Vec<f32> {
    let mut values = vec![0.0; len];
    Stream::new(1, stream).normal(0, &mut values);
    values
}

/// Steps of training a model of groups: denoiser and score with all losses of the defaults.
fn of_group(request: &Value) -> anyhow::Result<(Box<dyn Steps>, usize)> {
    let number = |key: &str| request[key].as_u64().map(|n| n as usize).context(key.to_owned());
    let (n, n_dancers, frames) = (number("batch")?, number("dancers")?, number("frames")?);
    let group = GroupConfig::of(preset_of(request)?).context("no preset of groups")?;
    // The peer drops nothing.
    let group = GroupConfig { dropout: 0.0, ..group };
    let n_parameters = GroupNetworks::new(&group).1.n_elements();
    let width = group.condition().dim();
    let diffusion = DiffusionConfig { prediction: Prediction::Sample, ..Default::default() };
    let network = GroupNetworkConfig { group, diffusion, window_frames: frames };
    let config = GroupTraining {
        objective: Objective::default(),
        losses: GroupLosses::default(),
        augmentation: Augmentation::default(),
        condition_dropout: 0.0,
        clock_dropout: 0.0,
        batch_size: n,
        accumulate: 1,
        side_by_side: number("side_by_side").unwrap_or(1),
        learning_rate: LearningRate {
            peak: 1e-4,
            course: LearningRateSchedule::Constant,
            warmup_steps: 0,
        },
        optimizer: OptimizerConfig::default(),
        ema: EmaConfig::default(),
    };
    let mut normalizer = Normalizer::identity();
    normalizer.scale.fill(0.5);
    let dataset = Arc::new(Dataset::in_memory([])?);
    let windows = Windows::new(dataset, normalizer, Augmentation::default(), frames, 1);
    let n_threads = NonZeroUsize::new(number("threads")?).context("threads")?;
    let threads = Arc::new(Threads::start(n_threads)?);
    let learner = GroupLearner::new(&network, &config, &Arc::new(windows), 1)?.on(&threads);
    let numbers = n * n_dancers * frames * MOTION_DIM;
    let batch = Batch {
        n_windows: n,
        n_slots: n_dancers,
        n_dancers: vec![n_dancers; n],
        n_frames: frames,
        motion: random(1, numbers),
        audio: random(2, n * frames * width),
        mask: vec![1.0; n * frames],
        style: vec![0.0; n * 8],
        noise: random(3, numbers),
        chances: chances(n),
        phrase_ids: vec!["bench".into(); n],
    };
    Ok((Box::new(Bench { learner, batch, n_steps: 0 }), n_parameters))
}

/// Generation of groups with an untrained network, whose speed is that of a trained one.
struct Generation {
    engine: GroupEngine,
    config: GroupConfig,
    n_dancers: usize,
    condition: Array2<f32>,
    consistency: f64,
}

fn of_group_generation(request: &Value) -> anyhow::Result<(Box<dyn Steps>, usize)> {
    let number = |key: &str| request[key].as_u64().map(|n| n as usize).context(key.to_owned());
    let (n_dancers, frames) = (number("dancers")?, number("frames")?);
    let config = GroupConfig::of(preset_of(request)?).context("no preset of groups")?;
    let list = GroupNetworks::new(&config).1.without_zero_layers();
    let n_parameters = list.n_elements();
    let n_threads = NonZeroUsize::new(number("threads")?).context("threads")?;
    let scale = FeatureScale::identity(config.audio_cond_dim);
    let workers = (NonZeroUsize::MIN, n_threads);
    let engine = GroupEngine::new(&config, Parameters::new(list, 0), &scale, workers)?;
    let width = config.condition().dim();
    let condition = Array2::from_shape_vec((frames, width), random(2, frames * width))?;
    let consistency = request["consistency"].as_f64().unwrap_or(0.0);
    let made = Generation { engine, config, n_dancers, condition, consistency };
    Ok((Box::new(made), n_parameters))
}

impl Steps for Generation {
    fn step(&mut self) -> anyhow::Result<Value> {
        let diffusion = DiffusionConfig {
            n_steps: self.config.n_steps,
            prediction: Prediction::Sample,
            ..Default::default()
        };
        let schedule = Schedule::new(&diffusion)?;
        let normalizer = Normalizer::identity();
        let generator = GroupGenerator {
            engine: &self.engine,
            sampler: &SamplerConfig::default(),
            schedule: &schedule,
            guidance: 1.0,
            consistency: self.consistency,
            form: ConsistencyForm::Direction,
            normalizer: &normalizer,
            window_frames: 120,
            overlap_frames: 30,
        };
        let track = GroupTrack {
            condition: self.condition.view(),
            phase: None,
            seed: 0,
            n_dancers: self.n_dancers,
        };
        let cpu = cpu_s()?;
        let started = Instant::now();
        let mut n_frames = 0;
        generator.run(&track, |part| {
            n_frames += part.dim().1;
            Ok::<_, EngineError>(())
        })?;
        Ok(json!({
            "wall_s": started.elapsed().as_secs_f64(),
            "cpu_s": cpu_s()? - cpu,
            "frames": n_frames,
        }))
    }
}

fn chances(n: usize) -> Vec<Chances> {
    let chance = |i: usize| Chances {
        step: (i as f64 + 0.5) / n as f64,
        no_audio: 1.0,
        no_style: 1.0,
        no_clock: 1.0,
    };
    (0..n).map(chance).collect()
}

/// Steps of fine-tuning a model of one dancer end to end.
fn of_soloist(request: &Value) -> anyhow::Result<(Box<dyn Steps>, usize)> {
    let number = |key: &str| request[key].as_u64().map(|n| n as usize).context(key.to_owned());
    let unet = preset_of(request)?.config();
    let (n, frames) = (number("batch")?, number("frames")?);
    let network = NetworkConfig {
        unet,
        decoder: DecoderConfig::default(),
        diffusion: DiffusionConfig::default(),
        window_frames: frames,
    };
    let config = FinetuneConfig {
        seed: 1,
        batch_size: n,
        lr_diffusion: 1e-6,
        lr_decoder: 5e-5,
        diffusion_weight: 0.1,
        decoder_weight: 1.0,
        temporal_weight: 10.0,
        temporal: TemporalConfig::reference(),
        num_steps: 5,
        start: 1.0,
        optimizer: OptimizerConfig::default(),
        num_phrases: None,
    };
    let dataset = Arc::new(Dataset::in_memory([])?);
    let mut normalizer = Normalizer::identity();
    normalizer.scale.fill(0.5);
    let windows = Arc::new(Windows::new(dataset, normalizer, Augmentation::default(), frames, 1));
    let n_threads = NonZeroUsize::new(number("threads")?).context("threads")?;
    let threads = Arc::new(Threads::start(n_threads)?);
    let (unet, decoder) = (UNet1D::new(&network.unet).1, MotionDecoder::new(&network.decoder).1);
    let n_parameters = unet.n_elements() + decoder.n_elements();
    let learner = threads
        .run(|| {
            let (unet, decoder) = (Parameters::new(unet, 1), Parameters::new(decoder, 1));
            let networks = [&unet, &decoder];
            FinetuneLearner::new(
                &network,
                (&Objective::default(), WithholdProbabilities::default()),
                &config,
                &windows,
                networks,
            )
        })?
        .on(&threads);
    let batch = Batch {
        n_windows: n,
        n_slots: 1,
        n_dancers: vec![1; n],
        n_frames: frames,
        motion: random(1, n * frames * MOTION_DIM),
        audio: random(2, n * frames * network.unet.audio_cond_dim),
        mask: vec![1.0; n * frames],
        style: vec![0.0; n * 8],
        noise: random(3, n * frames * MOTION_DIM),
        chances: chances(n),
        phrase_ids: vec!["bench".into(); n],
    };
    Ok((Box::new(Bench { learner, batch, n_steps: 0 }), n_parameters))
}

impl<L: Learner> Steps for Bench<L> {
    fn step(&mut self) -> anyhow::Result<Value> {
        let Self { learner, batch, n_steps, .. } = self;
        let cpu = cpu_s()?;
        let started = Instant::now();
        let taken = learner.step(batch, *n_steps, 100)?;
        *n_steps += 1;
        Ok(json!({
            "wall_s": started.elapsed().as_secs_f64(),
            "cpu_s": cpu_s()? - cpu,
            "loss": taken.losses.total,
        }))
    }
}

/// Returns the CPU time of all threads so far.
fn cpu_s() -> anyhow::Result<f64> {
    let mut nanoseconds = 0.0;
    for task in std::fs::read_dir("/proc/self/task")? {
        let text = std::fs::read_to_string(task?.path().join("schedstat"))?;
        nanoseconds += text.split_whitespace().next().context("schedstat")?.parse::<f64>()?;
    }
    Ok(nanoseconds / 1e9)
}
