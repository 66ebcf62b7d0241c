//! Three steps of AdamW with clipping, as PyTorch takes them.

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{
    AdamW, AdamWConfig, Arena, Element, Gradients, Interpreter, Parameters, Tape,
};
use motiongen::model::{Preset, UNet1D, UNetInputs};

use super::golden::{Golden, assert_near, given, parameters};

/// `tolerances`: of losses and gradient norms, of weights, and of how far the weights moved.
///
/// The first step of AdamW moves a weight by its gradient's sign: where a gradient is near zero its
/// rounding decides, so that what moved agrees less closely than the weights.
fn check<E: Element>([tolerance, of_weights, of_changes]: [f64; 3]) {
    let golden = Golden::open("adamw_tiny.safetensors");
    let config = Preset::Tiny.config();
    let (batch, frames) = (3, 24);
    let (unet, list) = UNet1D::new(&config);
    let mut parameters: Parameters<E> = parameters(list);
    let start = parameters.clone();
    let arena = Arena::default();
    let settings = AdamWConfig { weight_decay: 1e-2, ..AdamWConfig::default() };
    let mut optimizer = AdamW::new(settings, &parameters);
    let mut gradients = Gradients::new(&parameters);
    let shape = |channels| [batch, frames, channels];
    let values = |name: &str, channels: usize| given::<E>(name, batch * frames * channels);
    let stored =
        |name: &str| -> Vec<E> { golden.values(name).iter().map(|&x| E::from_f64(x)).collect() };
    for step in 0..3 {
        let mut tape = Tape::new(&parameters, &arena, None);
        let grown = E::from_f64(1.0 + 0.25 * step as f64);
        let x: Vec<_> = values("input.x", 25).into_iter().map(|x| x * grown).collect();
        let x = tape.constant(&shape(25), &x);
        let audio = tape.constant(&shape(163), &values("input.audio", 163));
        let t = tape.constant(&[batch], &stored("input/t"));
        let drop_audio = tape.constant(&[batch], &stored("input/drop"));
        let inputs = UNetInputs {
            x: &x,
            t: &t,
            audio: &audio,
            drop_audio: Some(&drop_audio),
            mask: None,
            style: None,
        };
        let y = unet.forward(&mut tape, inputs).expect("shapes fit");
        let target = tape.constant(&shape(25), &values("input.target", 25));
        let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target]).expect("shapes fit");
        assert_near("loss", loss.data(), &golden.values("loss")[step..=step], tolerance);
        gradients.clear();
        tape.backward(loss, &mut gradients).expect("finite");
        let norm = optimizer.step(&mut parameters, &mut gradients, 1e-3);
        assert_near("norm", &[norm], &golden.values("grad_norm")[step..=step], tolerance);
        let places = parameters.list().by_name();
        let double = |values: Vec<E>| values.into_iter().map(Element::to_f64);
        let weight = |name: &str| double(parameters.unpacked(places[name])).collect();
        golden.compare("weight", step, of_weights, weight);
        golden.compare("change", step, of_changes, |name| {
            let id = places[name];
            double(parameters.unpacked(id))
                .zip(double(start.unpacked(id)))
                .map(|(a, b)| a - b)
                .collect()
        });
    }
}

#[test]
fn three_steps_are_pytorchs() {
    check::<f64>([1e-9, 1e-9, 1e-7]);
    check::<f32>([1e-4, 1e-4, 1e-2]);
}
