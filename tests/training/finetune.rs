//! End-to-end fine-tuning: every loss and its gradient through the sampler, and one step of both networks.

use std::collections::BTreeMap;

use motiongen::autodiff::{Arena, Eager, Gradients, Parameters, Tape, Tensor};
use motiongen::diffusion::{BetaSchedule, DiffusionConfig, LossType, Prediction};
use motiongen::model::{DecoderConfig, MotionDecoder, Preset, UNet1D, UNetConfig};
use motiongen::training::{
    Batch, EndToEndLosses, FinetuneConfig, FinetuneLearner, Learner, NetworkConfig, Objective,
    OptimizerConfig, TemporalConfig, WithholdProbabilities,
};

use super::given;
use crate::engine::golden::{Golden, assert_near, parameters, uniform};

/// What is allowed.
const SINGLE: f64 = 1e-4;
/// Of what one step of AdamW changes: where a gradient is near zero its rounding decides which way, and
/// of the position's bias the larger part cancels.
const CHANGE: f64 = 3e-2;

/// A hundred times the defaults, so that a change is above the rounding of weights near 1.
const LR_UNET: f64 = 1e-4;
const LR_DECODER: f64 = 5e-3;

const NAMES: [&str; 10] = [
    "diffusion",
    "position",
    "quaternion",
    "velocity_coherence",
    "acceleration_coherence",
    "jerk",
    "quaternion_delta",
    "phase_monotonic",
    "position_smoothness",
    "total",
];

/// A case of `tests/golden/training/finetune.py`.
struct Case {
    golden: Golden,
    batch: Batch,
    learner: FinetuneLearner,
}

impl Case {
    fn new(
        name: &str,
        style_dim: usize,
        diffusion: DiffusionConfig,
        objective: &Objective,
        config: &FinetuneConfig,
    ) -> Self {
        let golden = given::open(name);
        let network = NetworkConfig {
            unet: UNetConfig { dropout: 0.0, style_dim, ..Preset::Tiny.config() },
            decoder: DecoderConfig {
                hidden_dim: 48,
                n_blocks: 2,
                dropout: 0.0,
                ..DecoderConfig::default()
            },
            diffusion,
            window_frames: 13,
        };
        let n = golden.values("mask").len();
        let draw = golden.values("draw")[0];
        let name = |of: &str| format!("{name}.{draw}.{of}");
        let motion = given::motion(&name("motion"), n * 25);
        let noise = given::drawn(&name("noise"), 1.75, n * 25);
        let audio = given::drawn(&name("audio"), 1.0, n * 163);
        let mut batch = given::batch(&golden, motion, noise, audio);
        batch.style = given::drawn(&name("style"), 1.0, batch.n_windows * 8);
        let windows = given::windows(given::normalizer(), network.window_frames);
        let unet = parameters(UNet1D::new(&network.unet).1);
        let decoder = parameters(MotionDecoder::new(&network.decoder).1);
        let both = [&unet, &decoder];
        let learner = FinetuneLearner::new(
            &network,
            (objective, WithholdProbabilities::default()),
            config,
            &windows,
            both,
        );
        Self { golden, batch, learner: learner.expect("networks that fit") }
    }

    /// With the defaults: predictions of ε, most estimates clipped.
    fn of_noise() -> Self {
        let diffusion = DiffusionConfig::default();
        Self::new(
            "finetune_tiny",
            0,
            diffusion,
            &Objective::default(),
            &config(5, [0.1, 1.0, 10.0]),
        )
    }

    /// Predictions of v, few estimates clipped, a style, four steps.
    fn of_velocity() -> Self {
        let diffusion = DiffusionConfig {
            beta_schedule: BetaSchedule::Linear,
            prediction: Prediction::Velocity,
            clip_range: Some(1.0),
            ..DiffusionConfig::default()
        };
        let objective =
            Objective { loss: LossType::Huber, min_snr_gamma: Some(5.0), ..Objective::default() };
        Self::new("finetune_tiny_v", 8, diffusion, &objective, &config(4, [2.0, 0.75, 0.125]))
    }

    /// Compares the values of all losses, and the motion that they are of.
    fn check_values(&self) {
        let arena = Arena::default();
        let mut g = Eager::new(self.learner.parameters(), &arena);
        let found = self.learner.losses(&mut g, &self.batch).expect("shapes fit");
        assert_near("decoded", found.decoded.data(), self.golden.values("decoded"), SINGLE);
        for (i, loss) in all(&found).into_iter().enumerate() {
            let wanted = self.golden.values("loss")[i];
            assert!(wanted > 0.0, "{} is not tried", NAMES[i]);
            assert_near(NAMES[i], loss.data(), &[wanted], SINGLE);
        }
    }

    /// Compares the gradient of each loss alone.
    fn check_gradients(&self) {
        let parameters = self.learner.parameters();
        let arena = Arena::default();
        for (i, name) in NAMES.iter().enumerate() {
            let mut tape = Tape::new(parameters, &arena, None);
            let found = self.learner.losses(&mut tape, &self.batch).expect("shapes fit");
            let loss = all(&found)[i].clone();
            drop(found);
            let mut gradients = Gradients::new(parameters);
            tape.backward(loss, &mut gradients).expect("finite");
            let by_name = by_name(parameters, gradients);
            self.check_gradient(i, name, &by_name);
            if *name == "total" {
                self.golden.compare("grad", 0, SINGLE, |name| by_name[name].clone());
            }
        }
    }

    /// Compares norm and product with a probe of each network's gradient, and of each parameter's.
    ///
    /// Errors are relative to the norm of the network's gradient, those of a product to what it is of a
    /// direction by chance: the norm times 1/√3, the deviation of the probe's numbers. A parameter is
    /// held to its own norm, or to 1e-3 of the network's where it has less: that of the position's bias,
    /// which changes no difference, is zero but for the rounding of terms that cancel.
    fn check_gradient(&self, row: usize, loss: &str, got: &BTreeMap<String, Vec<f64>>) {
        let names = &self.golden.parameters;
        assert_eq!(got.len(), names.len(), "parameters by name");
        let stored = |kind: &str| {
            let all = self.golden.values(&format!("losses.{kind}"));
            &all[row * names.len()..(row + 1) * names.len()]
        };
        let (norms, dots) = (stored("norm"), stored("dot"));
        let check = |what: &str, got: f64, wanted: f64, scale: f64| {
            // A loss that a network has no part in: nothing, to the last bit.
            let error = if got == wanted { 0.0 } else { (got - wanted).abs() / scale };
            let off = format!("got {got}, wanted {wanted}, off by {error:.2e} of {scale:.3e}");
            assert!(error <= SINGLE, "{loss}, {what}: {off}");
        };
        for part in ["unet.", "decoder."] {
            let own = || names.iter().enumerate().filter(|(_, name)| name.starts_with(part));
            let wanted = own().map(|(i, _)| norms[i].powi(2)).sum::<f64>().sqrt();
            let (mut square, mut product) = (0.0, 0.0);
            for (i, name) in own() {
                let (norm, dot) = norm_and_product(name, &got[name]);
                square += norm * norm;
                product += dot;
                let scale = norms[i].max(1e-3 * wanted);
                check(name, norm, norms[i], scale);
                let length = got[name].len() as f64;
                check(name, dot, dots[i], scale * (length / 3.0).sqrt());
            }
            check(part, square.sqrt(), wanted, wanted);
            let wanted_product = own().map(|(i, _)| dots[i]).sum::<f64>();
            check(part, product, wanted_product, wanted / 3.0_f64.sqrt());
        }
    }

    /// Compares a step of the learner: both networks move, each at its own rate.
    fn check_step(mut self) {
        let start = given::section(&self.learner, "model.");
        let step = self.learner.step(&self.batch, 0, 10).expect("shapes fit");
        let golden = &self.golden;
        assert_eq!((step.learning_rate, step.lr_decoder), (LR_UNET, Some(LR_DECODER)));
        for (i, (_, value)) in step.losses.parts.iter().enumerate() {
            assert_near(NAMES[i], &[*value], &golden.values("loss")[i..=i], SINGLE);
        }
        assert_near("total", &[step.losses.total], &golden.values("loss")[9..], SINGLE);
        let norm = step.gradient_norm;
        assert_near("norm of the gradient", &[norm], golden.values("grad_norm"), SINGLE);
        let gradients = given::first_gradient(&self.learner, norm);
        golden.compare("grad", 0, SINGLE, |name| gradients[name].clone());
        let weights = given::section(&self.learner, "model.");
        golden.compare("change", 0, CHANGE, |name| {
            weights[name].iter().zip(&start[name]).map(|(a, b)| a - b).collect()
        });
    }
}

fn config(num_steps: usize, [diffusion, decoder, temporal]: [f64; 3]) -> FinetuneConfig {
    FinetuneConfig {
        seed: 5,
        batch_size: 3,
        lr_diffusion: LR_UNET,
        lr_decoder: LR_DECODER,
        diffusion_weight: diffusion,
        decoder_weight: decoder,
        temporal_weight: temporal,
        temporal: TemporalConfig::reference(),
        num_steps,
        start: 1.0,
        optimizer: OptimizerConfig::default(),
        num_phrases: None,
    }
}

/// Returns all losses in the order of their names.
fn all(found: &EndToEndLosses<Tensor<f32>>) -> Vec<&Tensor<f32>> {
    let EndToEndLosses { total, diffusion, position, quaternion, temporal, .. } = found;
    [diffusion, position, quaternion].into_iter().chain(temporal.all()).chain([total]).collect()
}

fn by_name(parameters: &Parameters<f32>, mut of: Gradients<f32>) -> BTreeMap<String, Vec<f64>> {
    let list = parameters.list().iter();
    list.map(|(id, parameter)| {
        (parameter.name.clone(), of.unpacked(id).into_iter().map(f64::from).collect())
    })
    .collect()
}

fn norm_and_product(name: &str, values: &[f64]) -> (f64, f64) {
    let probe = uniform(&format!("probe.{name}"), values.len());
    let norm = values.iter().map(|x| x * x).sum::<f64>().sqrt();
    (norm, values.iter().zip(&probe).map(|(x, p)| x * p).sum())
}

#[test]
fn every_loss_of_fine_tuning_is_pytorchs() {
    Case::of_noise().check_values();
    Case::of_velocity().check_values();
}

#[test]
fn the_gradient_of_every_loss_through_the_sampler_is_pytorchs() {
    Case::of_noise().check_gradients();
    Case::of_velocity().check_gradients();
}

#[test]
fn a_step_of_fine_tuning_is_pytorchs() {
    Case::of_noise().check_step();
    Case::of_velocity().check_step();
}
