//! The engine's side of `benches/engine.py`: a network that is asked in lines of JSON, and products alone.
//!
//!     engine-bench serve               one request per line on standard input, one answer per line
//!     engine-bench gemm --threads 2    GFLOP/s of products of the network's shapes, and of FMA alone
//!     engine-bench elementwise         time of functions of one number, one thread; with
//!                                      MOTIONGEN_SIMD=avx2 or portable, whether vectors gain

#![allow(clippy::print_stdout, reason = "answers go to standard output")]

use std::io::{BufRead as _, Write as _};
use std::time::Instant;

use anyhow::{Context as _, bail};
use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{
    AdamW, AdamWConfig, Arena, Eager, Gradients, Interpreter as _, Parameters, Stream, Tape,
    Tensor, keep_awake,
};
use motiongen::model::{
    Activation, Graph as _, GroupNormalization, Init, ParameterList, Preset, Role, Scope, UNet1D,
    UNetConfig, UNetInputs,
};
use motiongen::weights::{Precision, save};
use serde_json::{Value, json};

#[path = "../tests/engine/golden_values.rs"]
mod golden_values;

fn main() -> anyhow::Result<()> {
    let arguments: Vec<_> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>().as_slice() {
        ["serve"] => serve(),
        ["gemm", "--threads", threads] => gemm(threads.parse()?),
        ["elementwise"] => elementwise(),
        _ => bail!("usage: engine-bench serve | gemm --threads N | elementwise"),
    }
}

fn serve() -> anyhow::Result<()> {
    let mut network = None;
    for line in std::io::stdin().lock().lines() {
        let request: Value = serde_json::from_str(&line?)?;
        let answer = match request["cmd"].as_str() {
            Some("init") => {
                let made = Network::new(&request)?;
                let n = made.parameters.list().n_elements();
                network = Some(made);
                json!({ "ok": true, "parameters": n, "rss_mb": memory_mb("VmRSS:")? })
            }
            Some("quit") => break,
            Some(command) => {
                let network = network.as_mut().context("init comes first")?;
                network.answer(command, &request)?
            }
            None => bail!("no cmd in {request}"),
        };
        println!("{answer}");
        std::io::stdout().flush()?;
    }
    Ok(())
}

/// A network with what its training needs.
struct Network {
    unet: UNet1D,
    config: UNetConfig,
    parameters: Parameters<f32>,
    training: Option<(Gradients<f32>, AdamW<f32>)>,
    arena: Arena<f32>,
    pool: rayon::ThreadPool,
    batch: usize,
    frames: usize,
    accumulate: usize,
    n_steps: u64,
}

impl Network {
    fn new(request: &Value) -> anyhow::Result<Self> {
        let number = |key: &str| request[key].as_u64().map(|n| n as usize).context(key.to_owned());
        let name = request["preset"].as_str().context("preset")?;
        let preset = Preset::ALL.into_iter().find(|preset| preset.name() == name);
        let mut config = preset.with_context(|| format!("no preset {name}"))?.config();
        config.use_checkpoint = request["checkpoint"].as_bool().unwrap_or(false);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(number("threads")?).build()?;
        let (unet, list) = UNet1D::new(&config);
        let golden = request["golden"].as_bool().unwrap_or(false);
        let parameters = pool.install(|| match golden {
            true => golden_values::parameters(list),
            false => Parameters::new(list, 1),
        });
        Ok(Self {
            unet,
            config,
            parameters,
            training: None,
            arena: Arena::default(),
            pool,
            batch: number("batch")?,
            frames: number("frames")?,
            accumulate: number("accumulate").unwrap_or(1),
            n_steps: 0,
        })
    }

    fn answer(&mut self, command: &str, request: &Value) -> anyhow::Result<Value> {
        let cpu = cpu_s()?;
        let started = Instant::now();
        let mut answer = match command {
            "forward" => self.forward()?,
            "step" => self.step()?,
            "gradients" => self.gradients(request)?,
            "memory" => {
                let arena = self.arena.usage();
                json!({
                    "rss_mb": memory_mb("VmRSS:")?,
                    "peak_mb": memory_mb("VmHWM:")?,
                    "arena_mb": arena.reserved_bytes as f64 / 1e6,
                    "arena_in_use_mb": arena.peak_bytes as f64 / 1e6,
                })
            }
            _ => bail!("unknown cmd {command}"),
        };
        answer["wall_s"] = json!(started.elapsed().as_secs_f64());
        answer["cpu_s"] = json!(cpu_s()? - cpu);
        Ok(answer)
    }

    fn forward(&self) -> anyhow::Result<Value> {
        let mut eager = Eager::new(&self.parameters, &self.arena);
        let inputs = Inputs::new(self, 0, |shape, values| eager.input(shape, values));
        self.pool.install(|| keep_awake(|| self.unet.forward(&mut eager, inputs.of())))?;
        Ok(json!({}))
    }

    fn step(&mut self) -> anyhow::Result<Value> {
        let (mut gradients, mut optimizer) = match self.training.take() {
            Some(training) => training,
            None => {
                let optimizer = AdamW::new(AdamWConfig::default(), &self.parameters);
                (Gradients::new(&self.parameters), optimizer)
            }
        };
        gradients.clear();
        let mut times = [0.0; 3];
        let mut total = 0.0;
        for _ in 0..self.accumulate {
            self.n_steps += 1;
            let started = Instant::now();
            let mut tape = Tape::new(&self.parameters, &self.arena, Some(self.n_steps));
            let inputs = Inputs::new(self, self.n_steps, |s, values| tape.constant(s, values));
            let loss = self.pool.install(|| {
                keep_awake(|| {
                    let y = self.unet.forward(&mut tape, inputs.of())?;
                    tape.apply(Loss::new(Cost::Squared), &[&y, &inputs.noise])
                })
            })?;
            total += loss.scalar();
            times[0] += started.elapsed().as_secs_f64();
            let started = Instant::now();
            self.pool.install(|| keep_awake(|| tape.backward(loss, &mut gradients)))?;
            times[1] += started.elapsed().as_secs_f64();
        }
        let started = Instant::now();
        let (parameters, pool) = (&mut self.parameters, &self.pool);
        pool.install(|| optimizer.step(parameters, &mut gradients, 1e-4));
        times[2] = started.elapsed().as_secs_f64();
        self.training = Some((gradients, optimizer));
        let [forward, backward, step] = times;
        Ok(
            json!({ "forward_s": forward, "backward_s": backward, "optimizer_s": step, "loss": total }),
        )
    }

    fn gradients(&self, request: &Value) -> anyhow::Result<Value> {
        let t = request["t"].as_array().context("t")?;
        let t: Vec<_> = t.iter().filter_map(Value::as_f64).map(|t| t as f32).collect();
        let path = request["path"].as_str().context("path")?;
        let mut tape = Tape::new(&self.parameters, &self.arena, None);
        let c = &self.config;
        let tensor = |name: &str, channels: usize| {
            let n = self.batch * self.frames * channels;
            tape.constant(&[self.batch, self.frames, channels], &golden_values::given(name, n))
        };
        let x = tensor("input.x", c.in_channels);
        let audio = tensor("input.audio", c.audio_cond_dim);
        let target = tensor("input.target", c.out_channels);
        let t = tape.constant(&[self.batch], &t);
        let (drop_audio, mask, style) = (None, None, None);
        let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
        let mut gradients = Gradients::new(&self.parameters);
        let loss = self.pool.install(|| {
            let y = self.unet.forward(&mut tape, inputs)?;
            let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target])?;
            let value = loss.scalar();
            drop(y);
            tape.backward(loss, &mut gradients).map(|_| value)
        })?;
        let bytes = save(self.parameters.plan(), gradients.all(), Precision::F32, &[].into())?;
        std::fs::write(path, bytes)?;
        Ok(json!({ "loss": loss }))
    }
}

/// The inputs of one step.
struct Inputs {
    x: Tensor<f32>,
    t: Tensor<f32>,
    audio: Tensor<f32>,
    noise: Tensor<f32>,
}

impl Inputs {
    fn new(network: &Network, step: u64, make: impl Fn(&[usize], &[f32]) -> Tensor<f32>) -> Self {
        let (batch, frames, c) = (network.batch, network.frames, &network.config);
        let random = |stream: u64, channels: usize| {
            let mut values = vec![0.0; batch * frames * channels];
            Stream::new(step, stream).uniform(0, &mut values);
            make(&[batch, frames, channels], &values)
        };
        let t: Vec<_> =
            (0..batch).map(|b| ((b * 977 + 13 * step as usize) % c.n_steps) as f32).collect();
        Self {
            x: random(1, c.in_channels),
            t: make(&[batch], &t),
            audio: random(2, c.audio_cond_dim),
            noise: random(3, c.out_channels),
        }
    }

    fn of(&self) -> UNetInputs<'_, Tensor<f32>> {
        let (drop_audio, mask, style) = (None, None, None);
        UNetInputs { x: &self.x, t: &self.t, audio: &self.audio, drop_audio, mask, style }
    }
}

/// Rows, outputs and inputs of the products of `base` at 120 frames: batch 1, then batch 8.
const SHAPES: [[usize; 3]; 8] = [
    [120, 256, 768],
    [60, 512, 1536],
    [30, 1024, 3072],
    [15, 1152, 3456],
    [960, 256, 768],
    [480, 512, 1536],
    [240, 1024, 3072],
    [120, 1152, 3456],
];

fn gemm(threads: usize) -> anyhow::Result<()> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let arena = Arena::default();
    for [m, n, k] in SHAPES {
        let mut list = ParameterList::default();
        let mut scope = Scope::root(&mut list);
        let weight = scope.parameter("weight", &[n, k], Init::fan_in(k), Role::Weight);
        let parameters = Parameters::<f32>::new(list, 1);
        let mut eager = Eager::new(&parameters, &arena);
        let x = eager.input(&[m, k], &vec![0.5; m * k]);
        let flops = 2.0 * (m * n * k) as f64;
        let runs = (2e10 / flops).ceil() as usize;
        let mut best = f64::INFINITY;
        for _ in 0..runs.max(5) {
            let started = Instant::now();
            pool.install(|| eager.linear(&x, weight, None))?;
            best = best.min(started.elapsed().as_secs_f64());
        }
        println!("{}", json!({ "shape": format!("{m}x{n}x{k}"), "gflops": flops / best / 1e9 }));
    }
    let peak: f64 = pool.broadcast(|_| motiongen::autodiff::peak_gflops()).into_iter().sum();
    println!("{}", json!({ "peak_fma_gflops": peak }));
    Ok(())
}

/// Times functions of one number over as many as a cache holds.
fn elementwise() -> anyhow::Result<()> {
    let (frames, channels) = (120, 256);
    let mut list = ParameterList::default();
    let mut scope = Scope::root(&mut list);
    let [weight, bias] =
        ["weight", "bias"].map(|name| scope.parameter(name, &[channels], Init::Ones, Role::Vector));
    let parameters = Parameters::<f32>::new(list, 1);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build()?;
    let mut eager = Eager::new(&parameters, &Arena::default());
    let mut values = vec![0.0; frames * channels];
    Stream::new(1, 1).normal(0, &mut values);
    let x = eager.input(&[1, frames, channels], &values);
    let norm = GroupNormalization { groups: 32, epsilon: 1e-5, weight, bias };
    type Run<'a> = dyn FnMut(&mut Eager<f32>) -> motiongen::model::Result<Tensor<f32>> + Send + 'a;
    let mut time = |name: &str, run: &mut Run| -> anyhow::Result<()> {
        let best = pool.install(|| {
            (0..2000).try_fold(f64::INFINITY, |best: f64, _| {
                let started = Instant::now();
                run(&mut eager)?;
                anyhow::Ok(best.min(started.elapsed().as_secs_f64()))
            })
        })?;
        let ns = best * 1e9 / values.len() as f64;
        println!("{}", json!({ "function": name, "ns_per_number": ns }));
        Ok(())
    };
    time("add", &mut |g| g.add(&x, &x))?;
    time("silu", &mut |g| g.activation(&x, Activation::Silu))?;
    time("gelu", &mut |g| g.activation(&x, Activation::Gelu))?;
    time("group_norm + silu", &mut |g| g.group_norm(&x, norm, None, Activation::Silu))
}

/// Reads a line of this process's status, in MB.
fn memory_mb(key: &str) -> anyhow::Result<f64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find(|line| line.starts_with(key)).context(key.to_owned())?;
    let kib: f64 = line.split_whitespace().nth(1).context(key.to_owned())?.parse()?;
    Ok(kib * 1024.0 / 1e6)
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
