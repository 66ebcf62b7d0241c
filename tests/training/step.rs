//! One step of the UNet `small`: loss, gradients and weights, and the loss of every objective.

use std::collections::BTreeMap;

use motiongen::autodiff::{
    AdamW, AdamWConfig, Arena, Eager, Element, Gradients, Interpreter, Parameters, Tape,
};
use motiongen::diffusion::{DiffusionConfig, LossType, Prediction, Schedule};
use motiongen::model::{DecoderConfig, Preset, UNet1D, UNetConfig, UNetInputs};
use motiongen::motion::{BODY, Normalizer};
use motiongen::training::{
    Augmentation, Batch, DiffusionInputs, DiffusionLearner, DiffusionTraining, EmaConfig, Learner,
    NetworkConfig, Objective, OptimizerConfig, WithholdProbabilities,
};

use super::given;
use crate::engine::golden::{Golden, assert_near, parameters};

const LEARNING_RATE: f64 = 1e-4;
const DROPPED: f64 = 0.1;

/// In f32 1e-4 is allowed; in f64, where only the order of sums differs, 1e-9 would show any
/// formula that is not PyTorch's.
const SINGLE: f64 = 1e-4;
const DOUBLE: f64 = 1e-9;
/// Of what one step of AdamW changes: where a gradient is near zero its rounding decides which way, and
/// weights near 1 are rounded to 6e-8, 1e-3 of the change.
const CHANGE: f64 = 1e-2;

fn unet_config() -> UNetConfig {
    UNetConfig { dropout: 0.0, ..Preset::Small.config() }
}

fn schedule(prediction: Prediction) -> Schedule {
    let config = DiffusionConfig { prediction, ..DiffusionConfig::default() };
    Schedule::new(&config).expect("a schedule")
}

/// The batch of the golden file; the second window goes without its music.
fn batch(golden: &Golden) -> Batch {
    let n = golden.values("mask").len();
    let x0 = given::drawn("step_small.x0", 1.5, n * 25);
    let noise = given::drawn("step_small.noise", 1.75, n * 25);
    let mut batch = given::batch(golden, x0, noise, given::drawn("step_small.audio", 1.0, n * 163));
    for (chances, &drop) in batch.chances.iter_mut().zip(golden.values("drop")) {
        // On either side of the probability; at it the music stays.
        chances.no_audio = if drop > 0.0 { DROPPED - 1e-9 } else { DROPPED };
    }
    batch
}

fn learner(accumulate: usize, side_by_side: usize) -> DiffusionLearner {
    let network = NetworkConfig {
        unet: unet_config(),
        decoder: DecoderConfig::default(),
        diffusion: DiffusionConfig::default(),
        window_frames: 37,
    };
    let training = DiffusionTraining {
        objective: Objective::default(),
        augmentation: Augmentation::default(),
        condition_dropout: DROPPED,
        clock_dropout: 0.0,
        style_dropout: 0.0,
        batch_size: 3,
        accumulate,
        side_by_side,
        learning_rate: given::constant_rate(LEARNING_RATE),
        optimizer: OptimizerConfig::default(),
        ema: EmaConfig::default(),
    };
    let windows = given::windows(Normalizer::identity(), network.window_frames);
    let mut learner = DiffusionLearner::new(&network, &training, &windows, 5).expect("a network");
    given::begin_with(&mut learner, &parameters(UNet1D::new(&network.unet).1));
    learner
}

#[test]
fn a_step_of_the_learner_is_pytorchs() {
    let golden = given::open("step_small");
    let batch = batch(&golden);
    for (accumulate, side_by_side) in [(1, 1), (2, 1), (1, 2), (2, 2)] {
        let mut learner = learner(accumulate, side_by_side);
        let start = given::section(&learner, "unet.");
        let step = learner.step(&batch, 0, 10).expect("shapes fit");
        assert_eq!(step.learning_rate, LEARNING_RATE);
        assert_near("loss", &[step.losses.total], golden.values("loss"), SINGLE);
        let norm = step.gradient_norm;
        assert_near("norm of the gradient", &[norm], golden.values("grad_norm"), SINGLE);
        let gradients = given::first_gradient(&learner, norm);
        golden.compare("grad", 0, SINGLE, |name| gradients[name].clone());
        let weights = given::section(&learner, "unet.");
        golden.compare("weight", 0, SINGLE, |name| weights[name].clone());
        golden.compare("change", 0, CHANGE, |name| difference(&weights[name], &start[name]));
    }
}

fn difference(a: &[f64], b: &[f64]) -> Vec<f64> {
    a.iter().zip(b).map(|(a, b)| a - b).collect()
}

/// What AdamW and the objective make of the network in f64, with noise added in f64.
#[test]
fn a_step_in_double_precision_is_pytorchs() {
    let golden = given::open("step_small");
    let batch = batch(&golden);
    let (n, frames) = (batch.n_windows, batch.n_frames);
    let schedule = schedule(Prediction::Epsilon);
    let (unet, list) = UNet1D::new(&unet_config());
    let mut parameters: Parameters<f64> = parameters(list);
    let start = parameters.clone();
    let t: Vec<usize> = golden.values("t").iter().map(|&t| t as usize).collect();
    let x_t: Vec<f64> = (0..batch.motion.len())
        .map(|i| {
            let level = schedule.level(Some(t[i / (frames * 25)]));
            let (x0, noise) = (f64::from(batch.motion[i]), f64::from(batch.noise[i]));
            level.signal * x0 + level.noise * noise
        })
        .collect();

    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let double = |values: &[f32]| values.iter().map(|&x| x.into()).collect::<Vec<f64>>();
    let x = tape.constant(&[n, frames, 25], &x_t);
    let steps = tape.constant(&[n], golden.values("t"));
    let audio = tape.constant(&[n, frames, 163], &double(&batch.audio));
    let drop_audio = tape.constant(&[n], golden.values("drop"));
    let mask = tape.constant(&[n, frames], golden.values("mask"));
    let inputs = UNetInputs {
        x: &x,
        t: &steps,
        audio: &audio,
        drop_audio: Some(&drop_audio),
        mask: Some(&mask),
        style: None,
    };
    let y = unet.forward(&mut tape, inputs).expect("shapes fit");
    let noise = tape.constant(y.shape(), &double(&batch.noise));
    let loss = Objective::default().loss(&mut tape, BODY, &schedule, &t, [&y, &noise], &batch.mask);
    let loss = loss.expect("shapes fit");
    assert_near("loss", loss.data(), golden.values("loss"), DOUBLE);
    let mut gradients = Gradients::new(&parameters);
    tape.backward(loss, &mut gradients).expect("finite");
    let places = parameters.list().by_name().into_iter();
    let places: BTreeMap<_, _> = places.map(|(name, id)| (name.to_owned(), id)).collect();
    let by_name: BTreeMap<_, _> =
        places.iter().map(|(name, &id)| (name.as_str(), gradients.unpacked(id))).collect();
    golden.compare("grad", 0, DOUBLE, |name| by_name[name].clone());

    let mut optimizer = AdamW::new(AdamWConfig::default(), &parameters);
    let norm = optimizer.step(&mut parameters, &mut gradients, LEARNING_RATE);
    assert_near("norm of the gradient", &[norm], golden.values("grad_norm"), DOUBLE);
    golden.compare("weight", 0, DOUBLE, |name| parameters.unpacked(places[name]));
    golden.compare("change", 0, 1e-7, |name| {
        difference(&parameters.unpacked(places[name]), &start.unpacked(places[name]))
    });
}

#[test]
fn every_objective_is_pytorchs() {
    let golden = given::open("step_small");
    let batch = batch(&golden);
    let (unet, list) = UNet1D::new(&unet_config());
    let (parameters, arena): (Parameters<f32>, _) = (parameters(list), Arena::default());
    let predictions = [Prediction::Epsilon, Prediction::Sample, Prediction::Velocity];
    let losses = [LossType::Mse, LossType::L1, LossType::Huber];
    let normalizer = Normalizer::identity();
    let mut wanted = golden.values("objectives").iter();
    for prediction in predictions {
        let schedule = schedule(prediction);
        let withhold = WithholdProbabilities { audio: DROPPED, ..WithholdProbabilities::default() };
        let given = DiffusionInputs::of(&batch, &schedule, withhold, false);
        for loss in losses {
            for min_snr_gamma in [None, Some(5.0)] {
                let objective = Objective { loss, min_snr_gamma, ..Objective::default() };
                let mut g = Eager::new(&parameters, &arena);
                let got = given
                    .loss(&mut g, &unet, &normalizer, &schedule, &objective)
                    .expect("shapes fit");
                let wanted = [*wanted.next().expect("a loss of each objective")];
                let what = format!("{prediction:?} by {loss:?}, gamma {min_snr_gamma:?}");
                assert_near(&what, got.data(), &wanted, SINGLE);
                assert!(got.scalar().to_f64() > 0.0, "{what}");
            }
        }
    }
    assert!(wanted.next().is_none());
}
