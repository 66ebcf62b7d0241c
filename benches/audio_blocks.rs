//! Where the time of `extract` goes: milliseconds of one core per second of audio, block by block,
//! next to what the block's Fourier transforms and matrix products alone take on this machine.
//!
//!     cargo run --example audio-blocks -- song.mp3

#![allow(clippy::print_stdout, reason = "a benchmark prints its table")]

use std::hint::black_box;
use std::io::Cursor;
use std::time::Instant;

use motiongen::audio::chroma::ChromaPass;
use motiongen::audio::cqt::octaves;
use motiongen::audio::decimate::Halver;
use motiongen::audio::decode::Decoder;
use motiongen::audio::mfcc::Dct;
use motiongen::audio::resample::Resampler;
use motiongen::audio::sliding_dft::SlidingDft;
use motiongen::audio::spectral::SpectralPass;
use motiongen::audio::tuning::TuningPass;
use motiongen::audio::{Tuning, beat, extract, onset};
use ndarray::Array2;
use realfft::RealFftPlanner;

const REPEATS: usize = 5;
const BLOCK: usize = 8192;

/// Returns the least time of some runs, in seconds.
fn best_s(mut work: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    for _ in 0..REPEATS {
        let started = Instant::now();
        work();
        best = best.min(started.elapsed().as_secs_f64());
    }
    best
}

/// Time of one transform of `n` real samples in f64, in seconds.
fn fft_s(n: usize) -> f64 {
    let fft = RealFftPlanner::<f64>::new().plan_fft_forward(n);
    let (mut input, mut output) = (fft.make_input_vec(), fft.make_output_vec());
    let mut scratch = fft.make_scratch_vec();
    let n_runs = 2000;
    let run = || {
        for _ in 0..n_runs {
            fft.process_with_scratch(&mut input, &mut output, &mut scratch)
                .expect("planned buffers");
        }
    };
    best_s(run) / f64::from(n_runs)
}

/// Time of a product [64, 368] · [368, rank] · [rank, 121] in f64, in seconds per row.
fn product_s(rank: usize) -> f64 {
    let (a, b) = (Array2::<f64>::ones((64, 368)), Array2::<f64>::ones((368, rank)));
    let c = Array2::<f64>::ones((rank, 121));
    let n_runs = 100;
    let run = || {
        for _ in 0..n_runs {
            black_box(a.dot(&b).dot(&c));
        }
    };
    best_s(run) / f64::from(n_runs) / 64.0
}

fn main() {
    let path = std::env::args().nth(1).expect("usage: audio-blocks FILE");
    let bytes = std::fs::read(&path).expect("a readable file");
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    let decode = || {
        let mut decoder = Decoder::open(Cursor::new(&bytes), extension).expect("audio");
        let mut samples = Vec::new();
        while decoder.next_block(&mut samples).expect("sound audio") {}
        (samples, decoder.sample_rate_hz())
    };
    let (samples, rate_hz) = decode();
    let resample = || {
        let (mut resampler, mut y) = (Resampler::new(rate_hz), Vec::new());
        samples.chunks(BLOCK).for_each(|block| resampler.push(block, &mut y));
        resampler.finish(&mut y);
        y
    };
    let y = resample();
    let seconds = y.len() as f64 / 44_100.0;
    // Plans and kernels are made once per process.
    black_box(extract(&y[..y.len().min(44_100)], None).expect("samples"));
    let row = |name: &str, time_s: f64, floor_s: Option<f64>| {
        let ms = |s: f64| s * 1e3 / seconds;
        match floor_s {
            Some(floor_s) => println!("{name:<28} {:7.3} {:7.3}", ms(time_s), ms(floor_s)),
            None => println!("{name:<28} {:7.3}       –", ms(time_s)),
        }
    };
    let n_frames = seconds * 30.0;
    let (fft_2048, fft_4096, fft_8192) = (fft_s(2048), fft_s(4096), fft_s(8192));
    println!("{path}: {seconds:.1} s at {rate_hz} Hz; ms of one core per second of audio\n");
    println!("{:<28} {:>7} {:>7}", "block", "ours", "floor");
    row("decode, mono", best_s(|| drop(black_box(decode()))), None);
    if rate_hz != 44_100 {
        row("resample", best_s(|| drop(black_box(resample()))), None);
    }
    let spectral = || {
        let mut pass = SpectralPass::new();
        y.chunks(BLOCK).for_each(|block| pass.push(block));
        pass.finish()
    };
    row(
        "STFT, mel, RMS, centroid",
        best_s(|| drop(black_box(spectral()))),
        Some(n_frames * fft_2048),
    );
    let tuning = best_s(|| {
        let mut pass = TuningPass::new();
        y.chunks(BLOCK).for_each(|block| pass.push(block));
        black_box(pass.finish());
    });
    row("tuning", tuning, Some(y.len() as f64 / 512.0 * fft_2048));
    let halve = || {
        let (mut halver, mut halved) = (Halver::new(), Vec::new());
        y.chunks(BLOCK).for_each(|block| halver.push(block, &mut halved));
        halver.finish(&mut halved);
        halved
    };
    let halving = y.len() as f64 / 7804.0 * (fft_8192 + fft_4096);
    let products = n_frames * 2.0 * [57, 40, 30, 22, 17].into_iter().map(product_s).sum::<f64>();
    let chroma = best_s(|| {
        let mut pass = ChromaPass::new(Tuning::STANDARD);
        y.chunks(BLOCK).for_each(|block| pass.push(block));
        black_box(pass.finish());
    });
    row("chroma", chroma, Some(halving + products + 2.0 * n_frames * fft_2048));
    row("  halving the rate", best_s(|| drop(black_box(halve()))), Some(halving));
    let halved = halve();
    let low = best_s(|| {
        for mut sliding in octaves().into_iter().filter_map(SlidingDft::new) {
            let mut sum = 0.0;
            halved.chunks(BLOCK).for_each(|block| sliding.push(block, |d| sum += d.re[0]));
            sliding.finish(|d| sum += d.re[0]);
            black_box(sum);
        }
    });
    row("  five low octaves", low, Some(products));
    let spectral = spectral();
    let onsets = best_s(|| drop(black_box(onset::onset_strength(&spectral.full_db))));
    row("onset strength", onsets, None);
    let onset = onset::onset_strength(&spectral.full_db);
    let beats = best_s(|| drop(black_box(beat::track_beats(&onset.median))));
    row("tempo, beats", beats, Some(n_frames * fft_s(512)));
    let dct = Dct::new();
    let mfcc = best_s(|| {
        for db in spectral.full_db.chunks_exact(128) {
            black_box(dct.of(db));
        }
    });
    row("MFCC", mfcc, None);
    let raw = extract(&y, None).expect("samples");
    row("normalisation", best_s(|| drop(black_box(raw.clone().normalize()))), None);
}
