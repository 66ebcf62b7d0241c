//! What a run learned, measured on songs that it never saw.
//!
//!     cargo run --release --no-default-features --example learned -- --store URL --run NAME
//!
//! Motion is sampled for phrases of the validation and test songs, and asked: does its vertical velocity
//! follow the bar (R² of a regression on four harmonics of the bar's phase, against the same at wrong
//! tempi, with a fit for each phrase of four seconds and with one for all phrases of a song)? A control
//! gets the music of another song. See docs/training.md.

#![allow(clippy::print_stdout, clippy::print_stderr, reason = "a program of its own")]

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::Arc;

use motiongen::autodiff::{Arena, Eager, Interpreter as _, Stream, Threads};
use motiongen::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use motiongen::model::{MotionDecoder, UNet1D};
use motiongen::motion::locking::bar_locking;
use motiongen::motion::{Channel, MOTION_DIM};
use motiongen::store::{ClientOptions, Location, Patience};
use motiongen::training::{
    Augmentation, Checkpoints, Condition, Dataset, Denoiser, Kind, Phrase, Reading, Split, State,
    TrainConfig, Windows,
};
use ndarray::Array3;

/// Wrong tempi that the true one is held against.
const N_WRONG: usize = 199;
const BATCH: usize = 16;
/// Constructed phrases begin so many frames apart.
const HOP_FRAMES: f64 = 60.0;

struct Arguments {
    store: String,
    run: String,
    /// `diffusion` (the UNet and the decoder as trained) or `finetune`.
    stage: String,
    n_windows: usize,
    n_steps: usize,
    threads: usize,
    guidance: f64,
    /// Whether songs that were trained on are asked instead.
    trained: bool,
}

fn arguments() -> Arguments {
    let mut found = Arguments {
        store: String::new(),
        run: String::new(),
        stage: "diffusion".to_owned(),
        guidance: 1.0,
        trained: false,
        n_windows: 128,
        n_steps: 20,
        threads: std::thread::available_parallelism().map_or(1, NonZeroUsize::get),
    };
    let mut words = std::env::args().skip(1);
    while let (Some(flag), Some(value)) = (words.next(), words.next()) {
        let number = || value.parse().expect("a number");
        match flag.as_str() {
            "--store" => found.store = value,
            "--run" => found.run = value,
            "--stage" => found.stage = value,
            "--guidance" => found.guidance = value.parse().expect("a number"),
            "--songs" => found.trained = value == "trained",
            "--windows" => found.n_windows = number(),
            "--steps" => found.n_steps = number(),
            "--threads" => found.threads = number(),
            _ => panic!("unknown flag {flag}"),
        }
    }
    found
}

/// A phrase of a song that training did not see.
struct HeldOut {
    song: String,
    /// Where it begins in its song.
    start_frames: f64,
    /// \[frames, 163\]
    audio: Vec<f32>,
    /// Bar phase of each frame.
    phase: Vec<f64>,
    /// As captured: vertical velocity, m/s.
    real: Vec<f64>,
}

fn column(frames: &[f32], channel: usize) -> Vec<f64> {
    frames.chunks_exact(MOTION_DIM).map(|frame| f64::from(frame[channel])).collect()
}

/// The number of a constructed phrase within its take.
fn number_of(id: &str) -> f64 {
    id.rsplit('.').next().and_then(|number| number.parse().ok()).expect("SONG.tTAKE.NUMBER")
}

fn held_out(
    dataset: &Dataset,
    state: &State<TrainConfig>,
    n: usize,
    trained: bool,
) -> Vec<HeldOut> {
    let n_frames = state.config.network.window_frames;
    let phrases: Vec<&Phrase> = dataset
        .phrases()
        .iter()
        .filter(|phrase| (phrase.split == Split::Train) == trained && phrase.n_frames >= n_frames)
        .collect();
    let stride = phrases.len().div_ceil(n).max(1);
    phrases
        .into_iter()
        .step_by(stride)
        .map(|phrase| {
            let motion = dataset.motion(phrase, 0, n_frames).expect("frames at hand");
            let mut audio = dataset.features(phrase, 0, n_frames).expect("frames at hand");
            state.scales.features.apply(audio.view_mut());
            let frames: Vec<f32> = motion.iter().copied().collect();
            HeldOut {
                song: phrase.id.split(".t").next().unwrap_or_default().to_owned(),
                start_frames: number_of(&phrase.id) * HOP_FRAMES,
                audio: audio.iter().copied().collect(),
                phase: column(&frames, Channel::Phase.range().start),
                real: column(&frames, Channel::Velocity.range().start + 1),
            }
        })
        .collect()
}

/// A phase that counts bars on.
fn unwrapped(phase: &[f64]) -> Vec<f64> {
    let mut bars = 0.0;
    let mut last = phase.first().copied().unwrap_or(0.0);
    phase
        .iter()
        .map(|&x| {
            if last - x > 0.5 {
                bars += 1.0;
            }
            last = x;
            bars + x
        })
        .collect()
}

/// Tempo ratios from 0.55 to 1.8 that are none of small whole numbers, evenly on a log scale.
fn wrong_ratios() -> Vec<f64> {
    let simple: Vec<f64> =
        (1..=4).flat_map(|a| (1..=4).map(move |b| f64::from(a) / f64::from(b))).collect();
    let all = (0..4000).map(|i| 0.55 * (1.8_f64 / 0.55).powf(f64::from(i) / 3999.0));
    let apart: Vec<f64> =
        all.filter(|r| simple.iter().all(|s| (r / s).ln().abs() > 0.04)).collect();
    (0..N_WRONG).map(|i| apart[i * (apart.len() - 1) / (N_WRONG - 1)]).collect()
}

/// Bars since the song began, by the tempo of a phrase and where it begins.
///
/// Wrong tempi then drift from the music over the whole song, not over four seconds.
fn bars_of_song(window: &HeldOut) -> Vec<f64> {
    let bars = unwrapped(&window.phase);
    let n = bars.len();
    let bars_per_frame = (bars[n - 1] - bars[0]) / (n - 1) as f64;
    let before = (window.start_frames * bars_per_frame - bars[0]).round();
    bars.iter().map(|x| x + before).collect()
}

struct Lock {
    r2: f64,
    wrong_mean: f64,
    p: f64,
}

/// R² at the true tempo, against wrong ones: one fit per group of windows, mean over groups.
fn lock(windows: &[HeldOut], signals: &[Vec<f64>], groups: &[Vec<usize>]) -> Lock {
    let bars: Vec<Vec<f64>> = windows.iter().map(bars_of_song).collect();
    let mean = |ratio: f64| {
        let of = |group: &Vec<usize>| {
            let signal: Vec<f64> = group.iter().flat_map(|&i| signals[i].clone()).collect();
            let phase: Vec<f64> =
                group.iter().flat_map(|&i| bars[i].iter().map(|x| x * ratio)).collect();
            bar_locking(&signal, &phase)
        };
        groups.iter().map(of).sum::<f64>() / groups.len() as f64
    };
    let r2 = mean(1.0);
    let wrong: Vec<f64> = wrong_ratios().into_iter().map(mean).collect();
    let n_as_good = wrong.iter().filter(|&&w| w >= r2).count();
    Lock {
        r2,
        wrong_mean: wrong.iter().sum::<f64>() / wrong.len() as f64,
        p: (1 + n_as_good) as f64 / (1 + wrong.len()) as f64,
    }
}

/// Windows by song.
fn songs(windows: &[HeldOut]) -> Vec<Vec<usize>> {
    let mut of: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (i, window) in windows.iter().enumerate() {
        of.entry(&window.song).or_default().push(i);
    }
    of.into_values().collect()
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let n = a.len() as f64;
    let mean = |x: &[f64]| x.iter().sum::<f64>() / n;
    let (ma, mb) = (mean(a), mean(b));
    let dot = |x: &[f64], mx: f64, y: &[f64], my: f64| {
        x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>()
    };
    dot(a, ma, b, mb) / (dot(a, ma, a, ma) * dot(b, mb, b, mb)).sqrt().max(1e-12)
}

/// Prints the validation loss beside that of the best constant and of a network that says nothing.
fn baselines(dataset: &Arc<Dataset>, state: &State<TrainConfig>, schedule: &Schedule) {
    const N: usize = 256;
    let frames = state.config.network.window_frames;
    let windows =
        Windows::new(Arc::clone(dataset), state.scales.clone(), Augmentation::default(), frames, 0);
    let batch = windows.validation(0..N).expect("at hand");
    let view = |values: &[f32]| {
        Array3::from_shape_vec((N, frames, MOTION_DIM), values.to_vec()).expect("as its shape")
    };
    let t: Vec<usize> =
        batch.chances.iter().map(|c| (c.step * schedule.len() as f64) as usize).collect();
    let target = schedule.target(view(&batch.motion).view(), view(&batch.noise).view(), &t);
    let (mut sums, mut squares, mut n) = ([0.0; MOTION_DIM], [0.0; MOTION_DIM], 0.0);
    let rows = target.as_slice().expect("in order").chunks_exact(MOTION_DIM);
    for (row, _) in rows.zip(&batch.mask).filter(|(_, w)| **w > 0.0) {
        n += 1.0;
        for (i, &x) in row.iter().enumerate() {
            sums[i] += f64::from(x);
            squares[i] += f64::from(x).powi(2);
        }
    }
    let mean_square = squares.iter().sum::<f64>() / (n * MOTION_DIM as f64);
    let explained = sums.iter().map(|s| (s / n).powi(2)).sum::<f64>() / MOTION_DIM as f64;
    let constant = mean_square - explained;
    let loss = state.progress.best.map_or(f64::NAN, |best| best.loss);
    println!(
        "validation loss {loss:.4} (averaged weights, step {}); the best constant has {constant:.4}, an \
         untrained network {mean_square:.4}: {:.0} % and {:.0} % lower",
        state.progress.step,
        100.0 * (1.0 - loss / constant),
        100.0 * (1.0 - loss / mean_square)
    );
}

fn main() {
    let arguments = arguments();
    let store = Location::open(&arguments.store, &ClientOptions::default()).expect("a store");
    let threads =
        Threads::start(NonZeroUsize::new(arguments.threads).expect("some")).expect("threads");
    let reading = Reading {
        in_memory: true,
        n_threads: NonZeroUsize::new(arguments.threads).expect("some"),
        patience: Patience::default(),
        max_train_phrases: None,
    };
    let (dataset, _) =
        Dataset::read(&store, &reading, &|e, _| eprintln!("{e}"), &|_, _| ()).expect("phrases");
    let dataset = Arc::new(dataset);

    let trained = Checkpoints::new(&store, &arguments.run, "diffusion");
    let last = |checkpoints: &Checkpoints| {
        *checkpoints.steps(Kind::Best).expect("listed").last().expect("a checkpoint")
    };
    let state: State<TrainConfig> =
        trained.read(Kind::Best, last(&trained), State::of).expect("a state");
    let network = &state.config.network;
    let (unet, unet_list) = UNet1D::new(&network.unet);
    let (decoder, decoder_list) = MotionDecoder::new(&network.decoder);
    let (from_unet, from_decoder) = match arguments.stage.as_str() {
        "finetune" => {
            let tuned = Checkpoints::new(&store, &arguments.run, "finetune");
            (tuned.clone(), tuned)
        }
        _ => (trained, Checkpoints::new(&store, &arguments.run, "decoder")),
    };
    let read = |checkpoints: &Checkpoints, prefix: &str, list: motiongen::model::ParameterList| {
        checkpoints
            .read(Kind::Best, last(checkpoints), |archive, _| {
                Ok(archive.section::<f32>(prefix, list.clone()).expect("weights"))
            })
            .expect("read")
    };
    let weights = read(&from_unet, "unet.", unet_list);
    let decoder_weights = read(&from_decoder, "decoder.", decoder_list);
    let schedule = Schedule::new(&network.diffusion).expect("a schedule");
    let windows = held_out(&dataset, &state, arguments.n_windows, arguments.trained);
    let n_songs = {
        let mut songs: Vec<_> = windows.iter().map(|w| w.song.as_str()).collect();
        songs.dedup();
        songs.len()
    };
    println!(
        "run {} ({}), {} phrases of {n_songs} held-out songs, DDIM {} steps",
        arguments.run,
        arguments.stage,
        windows.len(),
        arguments.n_steps
    );

    baselines(&dataset, &state, &schedule);

    let sample = |audio_of: &dyn Fn(usize) -> usize, seed: u64| -> Vec<Vec<f32>> {
        let frames = network.window_frames;
        let arena = Arena::default();
        let takes_style = network.unet.style_dim > 0;
        let denoiser = Denoiser { unet: &unet, parameters: &weights, arena: &arena, takes_style };
        let config = SamplerConfig {
            sampler: Sampler::Ddim { eta: 0.0 },
            n_steps: arguments.n_steps,
            spacing: Spacing::Trailing,
            clip: true,
        };
        let mut motions = Vec::new();
        for first in (0..windows.len()).step_by(BATCH) {
            let n = BATCH.min(windows.len() - first);
            let mut noise = Array3::<f32>::zeros((n, frames, MOTION_DIM));
            let values = noise.as_slice_mut().expect("in order");
            Stream::new(seed, first as u64).normal(0, values);
            let audio: Vec<f32> =
                (first..first + n).flat_map(|i| windows[audio_of(i)].audio.clone()).collect();
            let mask = vec![1.0; n * frames];
            let style = vec![0.0; n * 8];
            let condition =
                Condition { audio: &audio, mask: &mask, style: &style, drop_audio: &[] };
            let latent = threads.run(|| {
                let guidance = arguments.guidance;
                denoiser
                    .sample(&config, &schedule, noise, &condition, guidance, |_, _| ())
                    .expect("sampled")
            });
            let latent = latent.as_standard_layout().into_owned();
            let mut g = Eager::new(&decoder_weights, &arena);
            let x = g.constant(latent.shape(), latent.as_slice().expect("in order"));
            let y = decoder.forward(&mut g, &x).expect("decoded");
            motions.extend(y.data().chunks_exact(frames * MOTION_DIM).map(<[f32]>::to_vec));
        }
        motions
    };
    let up = Channel::Velocity.range().start + 1;
    let signals = |motions: &[Vec<f32>]| -> Vec<Vec<f64>> {
        motions.iter().map(|motion| column(motion, up)).collect()
    };
    let real: Vec<Vec<f64>> = windows.iter().map(|w| w.real.clone()).collect();
    let generated = sample(&|i| i, 1);
    // The music of a phrase half the list away, which is another song's.
    let n = windows.len();
    let shuffled = sample(&|i| (i + n / 2) % n, 1);

    // The phase that a model speaks of, against the music's: |⟨e^{2πi(φ̂ − φ)}⟩| over a phrase is 1 where it
    // runs at the right tempo, wherever it puts the downbeat; beats are its fourth harmonic.
    let coherence = |motions: &[Vec<f32>], harmonic: f64| {
        let of = |(window, motion): (&HeldOut, &Vec<f32>)| {
            let said = column(motion, Channel::Phase.range().start);
            let angles = said.iter().zip(&window.phase);
            let angles: Vec<f64> =
                angles.map(|(a, b)| std::f64::consts::TAU * harmonic * (a - b)).collect();
            let n = angles.len() as f64;
            let (c, s): (f64, f64) =
                (angles.iter().map(|a| a.cos()).sum(), angles.iter().map(|a| a.sin()).sum());
            (c * c + s * s).sqrt() / n
        };
        windows.iter().zip(motions).map(of).sum::<f64>() / windows.len() as f64
    };
    for (name, motions) in [("generated", &generated), ("shuffled", &shuffled)] {
        println!(
            "phase channel, {name}: coherence of bars {:.3}, of beats {:.3}",
            coherence(motions, 1.0),
            coherence(motions, 4.0)
        );
    }
    let alone: Vec<Vec<usize>> = (0..n).map(|i| vec![i]).collect();
    for (what, groups) in [("a fit per phrase", &alone), ("a fit per song", &songs(&windows))] {
        println!("{what:<22} {:>8} {:>12} {:>8}", "R²", "wrong tempi", "p");
        let show = |name: &str, signals: &[Vec<f64>]| {
            let Lock { r2, wrong_mean, p } = lock(&windows, signals, groups);
            println!("{name:<22} {r2:>8.3} {wrong_mean:>12.3} {p:>8.3}");
        };
        show("constructed (truth)", &real);
        show("generated", &signals(&generated));
        show("shuffled condition", &signals(&shuffled));
    }

    let speed = |motion: &[f32]| {
        let v = Channel::Velocity.range();
        let frames = motion.chunks_exact(MOTION_DIM);
        let n = frames.len() as f64;
        frames
            .map(|f| f[v.clone()].iter().map(|x| f64::from(*x).powi(2)).sum::<f64>().sqrt())
            .sum::<f64>()
            / n
    };
    let onset = |window: &HeldOut| {
        let dim = window.audio.len() / window.phase.len();
        let frames = window.audio.chunks_exact(dim);
        let n = frames.len() as f64;
        frames.map(|f| f64::from(f[dim - 1]) + f64::from(f[dim - 3])).sum::<f64>() / n
    };
    let onsets: Vec<f64> = windows.iter().map(onset).collect();
    let speeds = |motions: &[Vec<f32>]| motions.iter().map(|m| speed(m)).collect::<Vec<_>>();
    println!(
        "speed against onset strength and loudness: generated {:.2}, shuffled {:.2}; mean speed {:.2} m/s",
        correlation(&speeds(&generated), &onsets),
        correlation(&speeds(&shuffled), &onsets),
        speeds(&generated).iter().sum::<f64>() / n as f64
    );
    let errors = |motions: &[Vec<f32>], of: Channel, derivative: Channel| {
        let mut sum = 0.0;
        for motion in motions {
            let frames = motion.chunks_exact(MOTION_DIM).collect::<Vec<_>>();
            let mut error = 0.0;
            for pair in frames.windows(2) {
                for i in 0..3 {
                    let (x, d) = (of.range().start + i, derivative.range().start + i);
                    error += f64::from((pair[0][d] - 30.0 * (pair[1][x] - pair[0][x])).abs()) / 3.0;
                }
            }
            sum += error / (frames.len() - 1) as f64;
        }
        sum / motions.len() as f64
    };
    println!(
        "coherence of generated motion: |v - dp/dt| {:.4} m/s, |a - dv/dt| {:.3} m/s²",
        errors(&generated, Channel::Position, Channel::Velocity),
        errors(&generated, Channel::Velocity, Channel::Acceleration)
    );
}
