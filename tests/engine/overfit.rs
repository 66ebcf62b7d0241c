//! A network learns.

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{
    AdamW, AdamWConfig, Arena, Gradients, Interpreter, Parameters, Stream, Tape,
};
use motiongen::model::{Preset, UNet1D, UNetConfig, UNetInputs};

/// Noise at four fixed steps, four phrases of smooth motion: the network must learn them by heart.
#[test]
fn tiny_fits_four_phrases_to_a_hundredth_of_its_first_loss() {
    let config = UNetConfig { dropout: 0.0, ..Preset::Tiny.config() };
    let (unet, list) = UNet1D::new(&config);
    let mut parameters = Parameters::<f32>::new(list, 1);
    let (batch, frames) = (4, 40);
    let random = |stream: u64, channels: usize| {
        let mut values = vec![0.0_f32; batch * frames * channels];
        Stream::new(2, stream).normal(0, &mut values);
        values
    };
    let (noise, audio) = (random(1, 25), random(2, 163));
    let wave = |i: usize| {
        let (phrase, frame, channel) = (i / (25 * frames), i / 25 % frames, i % 25);
        (0.1 * frame as f32 * (1 + channel % 3) as f32 + phrase as f32).sin()
    };
    // x_t = √ᾱ x_0 + √(1 − ᾱ) ε with ᾱ = 1/2.
    let half = 0.5_f32.sqrt();
    let x_t: Vec<_> = noise.iter().enumerate().map(|(i, e)| half * (wave(i) + e)).collect();
    let arena = Arena::default();
    let settings = AdamWConfig { weight_decay: 0.0, ..AdamWConfig::default() };
    let mut optimizer = AdamW::new(settings, &parameters);
    let mut gradients = Gradients::new(&parameters);
    let mut first = None;
    for step in 0..3000 {
        let mut tape = Tape::new(&parameters, &arena, None);
        let x = tape.constant(&[batch, frames, 25], &x_t);
        let audio = tape.constant(&[batch, frames, 163], &audio);
        let t = tape.constant(&[batch], &[100.0, 300.0, 500.0, 700.0]);
        let (drop_audio, mask, style) = (None, None, None);
        let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
        let y = unet.forward(&mut tape, inputs).expect("shapes fit");
        let target = tape.constant(y.shape(), &noise);
        let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target]).expect("shapes fit");
        let value = Tape::finite_loss(&loss).expect("finite");
        let first = *first.get_or_insert(value);
        if value < 0.01 * first {
            // A fresh network predicts zero, so that its loss is the noise's mean square, about 1.
            assert!((first - 1.0).abs() < 0.1, "first loss {first}");
            return;
        }
        gradients.clear();
        tape.backward(loss, &mut gradients).expect("finite");
        let rate = 3e-3 * (1.0 - step as f64 / 3000.0).max(0.05);
        optimizer.step(&mut parameters, &mut gradients, rate);
    }
    panic!("the loss did not fall to a hundredth in 3,000 steps");
}
