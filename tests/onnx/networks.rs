//! The two networks of an export, against the interpreter, over sizes and configurations.

use std::collections::BTreeMap;
use std::ops::Range;

use motiongen::audio::{FEATURE_DIM, FeatureScale};
use motiongen::autodiff::{Arena, Eager, Parameters};
use motiongen::evaluation::checks;
use motiongen::model::{
    DecoderConfig, MotionDecoder, Parameter, ParameterList, Preset, UNet1D, UNetConfig, UNetInputs,
};
use motiongen::motion::postprocess::{Coherence, FusionVariances, PostProcessConfig, process};
use motiongen::motion::{Channel, ChannelLimits, MOTION_DIM};
use motiongen::onnx::{
    DecoderNames, Form, ModelFile, NamedTensor, Session, Storage, UNetNames, decoder, unet,
    values_of,
};
use ndarray::{Array2, ArrayViewMut2, s};

use super::{OPTIONS, floats, integers, max_difference, normal, runtime, session, write};

/// Weights as before training, and where training begins at zero, anything.
pub fn random(list: ParameterList, seed: u64) -> Parameters<f32> {
    let drawn = Parameters::<f32>::new(list.clone(), seed);
    let ids = list.by_name();
    Parameters::from_fn(list.clone(), |parameter: &Parameter| {
        let id = ids[parameter.name.as_str()];
        let values = drawn.unpacked(id);
        let is_zero = values.iter().all(|&x| x == 0.0);
        let noise = normal(values.len(), id.0 as u64 + 1);
        if is_zero { noise.iter().map(|x| 0.1 * x).collect() } else { values }
    })
}

pub fn scale() -> FeatureScale {
    let centre = (0..FEATURE_DIM).map(|i| 0.1 * (i % 7) as f32).collect();
    let scale = (0..FEATURE_DIM).map(|i| 0.2 + 0.3 * (i % 5) as f32).collect();
    FeatureScale { centre, scale }
}

pub fn file(graph: motiongen::onnx::Graph) -> ModelFile {
    ModelFile { graph, metadata: BTreeMap::new(), description: "for a test".to_owned() }
}

struct Case {
    batch: usize,
    frames: usize,
    drop_audio: Vec<f32>,
}

fn compare(config: &UNetConfig, parameters: &Parameters<f32>, session: &mut Session, case: &Case) {
    let (unet, _) = UNet1D::new(config);
    let Case { batch, frames, drop_audio } = case;
    let x = normal(batch * frames * MOTION_DIM, 3);
    let audio = normal(batch * frames * FEATURE_DIM, 4);
    let style = normal(batch * config.style_dim, 5);
    let t: Vec<i64> = (0..*batch).map(|i| (i as i64 * 499 + 998) % 1000).collect();
    let shape = [*batch, *frames];
    let mut inputs = vec![
        floats(UNetNames::X, &[shape[0], shape[1], MOTION_DIM], &x),
        integers(UNetNames::T, &t),
        floats(UNetNames::AUDIO, &[shape[0], shape[1], FEATURE_DIM], &audio),
    ];
    if !drop_audio.is_empty() {
        inputs.push(floats(UNetNames::DROP_AUDIO, &[*batch], drop_audio));
    }
    if config.style_dim > 0 {
        inputs.push(floats(UNetNames::STYLE, &[*batch, config.style_dim], &style));
    }
    let (found_shape, found) = session.run(&inputs, UNetNames::PREDICTION).expect("a prediction");

    let mut scaled = audio.clone();
    let rows = ArrayViewMut2::from_shape((batch * frames, FEATURE_DIM), &mut scaled).expect("rows");
    scale().apply(rows);
    let arena = Arena::default();
    let mut g = Eager::new(parameters, &arena);
    let steps: Vec<f32> = t.iter().map(|&t| t as f32).collect();
    let x = g.input(&[*batch, *frames, MOTION_DIM], &x);
    let t = g.input(&[*batch], &steps);
    let audio = g.input(&[*batch, *frames, FEATURE_DIM], &scaled);
    let drop = (!drop_audio.is_empty()).then(|| g.input(&[*batch], drop_audio));
    let style = (config.style_dim > 0).then(|| g.input(&[*batch, config.style_dim], &style));
    let inputs = UNetInputs {
        x: &x,
        t: &t,
        audio: &audio,
        drop_audio: drop.as_ref(),
        mask: None,
        style: style.as_ref(),
    };
    let wanted = unet.forward(&mut g, inputs).expect("a prediction");
    assert_eq!(found_shape, wanted.shape(), "{batch} × {frames}");
    let difference = max_difference(&found, wanted.data());
    // The specification's bound for one forward in f32.
    assert!(difference <= 1e-4, "{batch} × {frames} of {:?}: {difference:e}", config.widths);
    let spread = wanted.data().iter().map(|x| x * x).sum::<f32>() / wanted.len() as f32;
    assert!(spread > 1e-3, "a prediction of nothing would agree with anything: {spread}");
}

fn exported(config: &UNetConfig, form: Form, storage: Storage) -> (Parameters<f32>, ModelFile) {
    let parameters = random(UNet1D::new(config).1, 5);
    let weights = |id| parameters.unpacked(id);
    let graph = unet(config, &weights, &scale(), form, storage).expect("a graph");
    (parameters, file(graph))
}

#[test]
fn a_unet_predicts_what_the_interpreter_predicts() {
    let tiny = Preset::Tiny.config();
    let configs = [
        tiny.clone(),
        UNetConfig { style_dim: 8, add_audio: false, ..tiny.clone() },
        UNetConfig { use_scale_shift_norm: false, num_head_channels: Some(8), ..tiny.clone() },
        UNetConfig { widths: vec![20, 28], num_res_blocks: 1, num_heads: 2, ..tiny },
        Preset::Small.config(),
    ];
    let folder = tempfile::tempdir().expect("a folder");
    for config in configs {
        let (parameters, file) = exported(&config, Form::default(), Storage::Fp32);
        let mut session = session(file, folder.path(), "unet.onnx");
        for (batch, frames, drop_audio) in [
            (1, 120, vec![]),
            (3, 77, vec![0.0, 1.0, 0.0]),
            (2, 8, vec![1.0, 0.0]),
            (1, 1, vec![0.0]),
            (5, 13, vec![]),
        ] {
            compare(&config, &parameters, &mut session, &Case { batch, frames, drop_audio });
        }
    }
}

#[test]
fn weights_beside_the_file_and_a_line_of_frames_give_the_same() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = Preset::Tiny.config();
    let (parameters, file) = exported(&config, Form::Line, Storage::Fp32);
    let path = folder.path().join("unet.onnx");
    write(file, &path, 1000);
    let size = |path: &std::path::Path| std::fs::metadata(path).expect("a file").len();
    assert!(size(&path) < 400_000 && size(&path.with_extension("bin")) > 1_000_000);
    let mut session = Session::open(runtime(), &path, OPTIONS).expect("a session");
    let case = Case { batch: 2, frames: 23, drop_audio: vec![] };
    compare(&config, &parameters, &mut session, &case);
}

#[test]
fn an_optimised_copy_predicts_the_same() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = Preset::Tiny.config();
    let (parameters, file) = exported(&config, Form::default(), Storage::Fp32);
    let path = folder.path().join("unet.onnx");
    write(file, &path, usize::MAX);
    let copy = folder.path().join("copy.onnx");
    Session::optimize(runtime(), &path, &copy).expect("optimised");
    let options = motiongen::onnx::SessionOptions { is_optimized: true, ..OPTIONS };
    let mut session = Session::open(runtime(), &copy, options).expect("a session");
    for frames in [120, 5] {
        let case = Case { batch: 2, frames, drop_audio: vec![1.0, 0.0] };
        compare(&config, &parameters, &mut session, &case);
    }
}

#[test]
fn rounded_weights_are_read_back_as_onnxruntime_sees_them() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = Preset::Tiny.config();
    let mut sizes = Vec::new();
    for storage in [Storage::Fp32, Storage::Fp16, Storage::Int8] {
        let (parameters, file) = exported(&config, Form::default(), storage);
        let path = folder.path().join(format!("{}.onnx", storage.name()));
        let model = write(file, &path, usize::MAX);
        sizes.push(std::fs::metadata(&path).expect("a file").len());
        let list = parameters.list().clone();
        let read = Parameters::from_fn(list.clone(), |parameter| {
            values_of(&model, parameter, "m.onnx").expect("a weight")
        });
        // Relative to the largest weight: 2^-11 of a number for f16, half of 1/127 for 8 bits.
        let allowed = match storage {
            Storage::Fp32 => 0.0,
            Storage::Fp16 => 1.0 / 2048.0,
            Storage::Int8 => 0.51 / 127.0,
        };
        for (id, parameter) in list.iter() {
            let (a, b) = (parameters.unpacked(id), read.unpacked(id));
            let most = a.iter().fold(0.0_f32, |most, x| most.max(x.abs()));
            let difference = max_difference(&a, &b);
            assert!(difference <= allowed * most, "{} {storage:?}: {difference:e}", parameter.name);
        }
        let mut session = Session::open(runtime(), &path, OPTIONS).expect("a session");
        let case = Case { batch: 2, frames: 31, drop_audio: vec![] };
        compare(&config, &read, &mut session, &case);
    }
    assert!(sizes[1] < sizes[0] * 6 / 10 && sizes[2] < sizes[0] * 4 / 10, "{sizes:?}");
}

#[test]
fn a_decoder_that_fuses_is_the_same_network_in_onnx() {
    let folder = tempfile::tempdir().expect("a folder");
    let config =
        DecoderConfig { fusion: Some(FusionVariances::default()), ..DecoderConfig::default() };
    let (network, list) = MotionDecoder::new(&config);
    let parameters = random(list, 9);
    let weights = |id| parameters.unpacked(id);
    let graph = decoder(&config, &weights, Storage::Fp32).expect("a graph");
    let mut session = session(file(graph), folder.path(), "decoder.onnx");
    for (batch, frames) in [(2, 121), (3, 7), (1, 1)] {
        let latent = slow_waves(batch, frames);
        let shape = [batch, frames, MOTION_DIM];
        let inputs: [NamedTensor; 1] = [floats(DecoderNames::LATENT, &shape, &latent)];
        let (found_shape, found) = session.run(&inputs, DecoderNames::MOTION).expect("motion");
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        let x = g.input(&shape, &latent);
        let wanted = network.forward(&mut g, &x).expect("motion");
        assert_eq!(found_shape, shape);
        for (i, (a, b)) in found.iter().zip(wanted.data()).enumerate() {
            // Second differences of positions of some metres, 900 of which make an acceleration.
            let tolerance =
                if Channel::Acceleration.range().contains(&(i % MOTION_DIM)) { 5e-3 } else { 2e-4 };
            assert!((a - b).abs() <= tolerance, "{batch} × {frames}, {i}: {a} against {b}");
        }
    }
}

#[test]
fn a_decoder_that_fuses_does_what_post_processing_does() {
    let variances = FusionVariances::default();
    let plain = DecoderConfig::default();
    let fusing = DecoderConfig { fusion: Some(variances), ..plain.clone() };
    let (n, frames) = (1, 331);
    let latent = slow_waves(n, frames);
    let decoded = |config: &DecoderConfig| {
        let (network, list) = MotionDecoder::new(config);
        let parameters = slow_body(list);
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        let x = g.input(&[n, frames, MOTION_DIM], &latent);
        let motion = network.forward(&mut g, &x).expect("motion").data().to_vec();
        Array2::from_shape_vec((frames, MOTION_DIM), motion).expect("one motion")
    };
    let (mut wanted, found) = (decoded(&plain), decoded(&fusing));
    let before = wanted.clone();
    let only_fuse = PostProcessConfig {
        coherence: Coherence::Fuse,
        fusion_variances: Some(variances),
        ..PostProcessConfig::nothing()
    };
    process(&only_fuse, &mut wanted, None);
    let difference = |a: &Array2<f32>, b: &Array2<f32>, channel: Channel, frames: Range<usize>| {
        let part = s![frames, channel.range()];
        max_difference(
            &a.slice(part).to_owned().into_raw_vec_and_offset().0,
            &b.slice(part).to_owned().into_raw_vec_and_offset().0,
        )
    };
    for (channel, tolerance) in [
        (Channel::Position, 1e-4),
        (Channel::Velocity, 1e-3),
        // Turns of a hundredth of a radian.
        (Channel::Quaternion, 5e-4),
        (Channel::Phase, 0.0),
        (Channel::Style, 0.0),
    ] {
        let inner = 70..frames - 70;
        let off = difference(&found, &wanted, channel, inner.clone());
        let moved = difference(&before, &wanted, channel, inner);
        assert!(off <= tolerance, "{channel:?}: off by {off}, moved by {moved}");
        assert!(moved > 3.0 * tolerance || tolerance == 0.0, "{channel:?}: moved by {moved} alone");
        // The slope at the ends is found by repetition, which leaves a thirtieth.
        let off = difference(&found, &wanted, channel, 0..frames);
        let moved = difference(&before, &wanted, channel, 0..frames);
        assert!(off <= 0.03 * moved, "{channel:?}, with its ends: off by {off}, moved by {moved}");
    }
    for name in ["velocity", "acceleration", "angular_velocity"] {
        let check = |motion: &Array2<f32>| {
            let checks = checks(motion.view(), ChannelLimits::Wide);
            checks.into_iter().find(|check| check.name == name).expect("a strict check")
        };
        let (fused, apart) = (check(&found), check(&before));
        assert!(fused.passed && !apart.passed, "{}; {}", fused.message, apart.message);
    }
}

/// Weights with which a body turns slowly and turn rates are off by some tenths of a rad/s, as motion is: what is exact to
/// first order alone, in the turn and in its rate, can be held against what is exact.
fn slow_body(list: ParameterList) -> Parameters<f32> {
    let drawn = random(list.clone(), 9);
    let ids = list.by_name();
    Parameters::from_fn(list.clone(), |parameter: &Parameter| {
        let mut values = drawn.unpacked(ids[parameter.name.as_str()]);
        let factor = match parameter.name.split('.').next() {
            Some("angular_velocity_head") => 0.03,
            Some("quaternion_head") => 0.1,
            _ => 1.0,
        };
        values.iter_mut().for_each(|x| *x *= factor);
        if parameter.name == "quaternion_head.bias" {
            values[0] = 1.0;
        }
        values
    })
}

/// Latents of slow waves, of which no two channels are alike.
fn slow_waves(batch: usize, frames: usize) -> Vec<f32> {
    let wave = |i: usize| {
        let (t, c) = (i / MOTION_DIM % frames, i % MOTION_DIM);
        let b = i / (MOTION_DIM * frames);
        (t as f32 * (0.01 + 0.002 * c as f32) + (c * c + b) as f32).sin()
    };
    (0..batch * frames * MOTION_DIM).map(wave).collect()
}

#[test]
fn a_decoder_gives_motion_within_its_limits() {
    let folder = tempfile::tempdir().expect("a folder");
    let config = DecoderConfig::default();
    let (network, list) = MotionDecoder::new(&config);
    let parameters = random(list, 9);
    let weights = |id| parameters.unpacked(id);
    let graph = decoder(&config, &weights, Storage::Fp32).expect("a graph");
    let mut session = session(file(graph), folder.path(), "decoder.onnx");
    for (batch, frames) in [(1, 120), (3, 7)] {
        let latent = normal(batch * frames * MOTION_DIM, 6);
        let shape = [batch, frames, MOTION_DIM];
        let inputs: [NamedTensor; 1] = [floats(DecoderNames::LATENT, &shape, &latent)];
        let (found_shape, found) = session.run(&inputs, DecoderNames::MOTION).expect("motion");
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        let x = g.input(&shape, &latent);
        let wanted = network.forward(&mut g, &x).expect("motion");
        assert_eq!(found_shape, shape);
        // Accelerations reach 100 m/s², whose last digit in f32 is 8e-6.
        let difference = max_difference(&found, wanted.data());
        assert!(difference <= 2e-4, "{batch} × {frames}: {difference:e}");
        for frame in found.chunks_exact(MOTION_DIM) {
            let norm: f32 = frame[9..13].iter().map(|x| x * x).sum();
            assert!((norm - 1.0).abs() < 1e-5 && (0.0..=1.0).contains(&frame[16]));
        }
    }
}
