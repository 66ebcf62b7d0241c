//! The engine's side of `benches/training.py`: steps of end-to-end fine-tuning, asked for in lines of JSON.
//!
//!     training-bench      one request per line on standard input, one answer per line

#![allow(clippy::print_stdout, reason = "answers go to standard output")]

use std::io::{BufRead as _, Write as _};
use std::num::NonZeroUsize;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context as _, bail};
use motiongen::autodiff::{Parameters, Stream, Threads};
use motiongen::diffusion::DiffusionConfig;
use motiongen::model::{DecoderConfig, MotionDecoder, Preset, UNet1D};
use motiongen::motion::{MOTION_DIM, Normalizer};
use motiongen::training::{
    Augmentation, Batch, Chances, Dataset, FinetuneConfig, FinetuneLearner, Learner as _,
    NetworkConfig, Objective, OptimizerConfig, TemporalConfig, Windows, WithholdProbabilities,
};
use serde_json::{Value, json};

fn main() -> anyhow::Result<()> {
    let mut bench = None;
    for line in std::io::stdin().lock().lines() {
        let request: Value = serde_json::from_str(&line?)?;
        let answer = match request["cmd"].as_str() {
            Some("init") => {
                let made = Bench::new(&request)?;
                let answer = json!({ "ok": true, "parameters": made.n_parameters });
                bench = Some(made);
                answer
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

/// A learner with a batch of random numbers.
struct Bench {
    learner: FinetuneLearner,
    batch: Batch,
    n_parameters: usize,
    n_steps: u64,
}

impl Bench {
    fn new(request: &Value) -> anyhow::Result<Self> {
        let number = |key: &str| request[key].as_u64().map(|n| n as usize).context(key.to_owned());
        let name = request["preset"].as_str().context("preset")?;
        let preset = Preset::ALL.into_iter().find(|preset| preset.name() == name);
        let unet = preset.with_context(|| format!("no preset {name}"))?.config();
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
        let windows =
            Arc::new(Windows::new(dataset, normalizer, Augmentation::default(), frames, 1));
        let n_threads = NonZeroUsize::new(number("threads")?).context("threads")?;
        let threads = Arc::new(Threads::start(n_threads)?);
        let (unet, decoder) =
            (UNet1D::new(&network.unet).1, MotionDecoder::new(&network.decoder).1);
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
        let random = |stream: u64, len: usize| {
            let mut values = vec![0.0; len];
            Stream::new(1, stream).normal(0, &mut values);
            values
        };
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
            chances: (0..n)
                .map(|i| Chances {
                    step: (i as f64 + 0.5) / n as f64,
                    no_audio: 1.0,
                    no_style: 1.0,
                    no_clock: 1.0,
                })
                .collect(),
            phrase_ids: vec!["bench".into(); n],
        };
        Ok(Self { learner, batch, n_parameters, n_steps: 0 })
    }

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
