//! Same seed, same bytes, whatever the number of threads.

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{AdamW, AdamWConfig, Arena, Gradients, Interpreter, Parameters, Tape};
use motiongen::model::{Preset, UNet1D, UNetInputs};

use super::golden::{given, steps};

/// Trains tiny for 20 steps, dropout and all, and returns the bits of its weights.
fn train(threads: usize, use_checkpoint: bool) -> Vec<u32> {
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads");
    let config = motiongen::model::UNetConfig { use_checkpoint, ..Preset::Tiny.config() };
    let (unet, list) = UNet1D::new(&config);
    let mut parameters = Parameters::<f32>::new(list, 11);
    let (batch, frames) = (5, 43);
    let values = |name: &str, channels: usize| given::<f32>(name, batch * frames * channels);
    pool.install(|| {
        let arena = Arena::default();
        let mut optimizer = AdamW::new(AdamWConfig::default(), &parameters);
        let mut gradients = Gradients::new(&parameters);
        for step in 0..20 {
            let mut tape = Tape::new(&parameters, &arena, Some(step));
            let x = tape.constant(&[batch, frames, 25], &values("input.x", 25));
            let audio = tape.constant(&[batch, frames, 163], &values("input.audio", 163));
            let t = tape.constant(&[batch], &steps(batch));
            let (drop_audio, mask, style) = (None, None, None);
            let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
            let y = unet.forward(&mut tape, inputs).expect("shapes fit");
            let target = tape.constant(y.shape(), &values("input.target", 25));
            let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target]).expect("shapes fit");
            gradients.clear();
            tape.backward(loss, &mut gradients).expect("finite");
            optimizer.step(&mut parameters, &mut gradients, 1e-3);
        }
    });
    parameters.all().iter().map(|x| x.to_bits()).collect()
}

#[test]
fn twenty_steps_give_the_same_bytes_with_1_2_and_4_threads() {
    let one = train(1, false);
    assert!(train(2, false) == one, "2 threads");
    assert!(train(4, false) == one, "4 threads");
}

#[test]
fn checkpoints_give_the_same_bytes_with_any_number_of_threads() {
    // Not those without checkpoints: a level's gradients of what all levels share are summed first.
    assert!(train(1, true) == train(4, true), "4 threads");
}
