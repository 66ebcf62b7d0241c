//! `motiongen model` tells the truth.

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{Arena, Gradients, Interpreter, Parameters, Tape};
use motiongen::model::{Graph, Outline, Preset, UNet1D, UNetConfig, UNetInputs};

use crate::support::{finish, motiongen};

/// Runs a UNet on inputs of one value.
fn forward<G: Graph>(
    g: &mut G,
    unet: &UNet1D,
    batch: usize,
    make: impl Fn(&mut G, &[usize]) -> G::Tensor,
) -> G::Tensor {
    let x = make(g, &[batch, 120, 25]);
    let audio = make(g, &[batch, 120, 163]);
    let t = make(g, &[batch]);
    let (drop_audio, mask, style) = (Some(&t), None, None);
    let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
    unet.forward(g, inputs).expect("shapes fit")
}

/// Returns the bytes that a training step takes from the arena at most, and those that were foretold.
fn activations(use_checkpoint: bool) -> (usize, usize) {
    let batch = 3;
    let config = UNetConfig { use_checkpoint, ..Preset::Small.config() };
    let (unet, list) = UNet1D::new(&config);
    let mut outline = Outline::new(&list);
    forward(&mut outline, &unet, batch, |g, shape| g.input(shape));
    let kept = outline.kept();
    let foretold = 4 * (kept.numbers + kept.within_part);

    let parameters = Parameters::<f32>::new(list.clone(), 1);
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, Some(1));
    let y = forward(&mut tape, &unet, batch, |g, shape| {
        g.constant(shape, &vec![1.0; shape.iter().product()])
    });
    let target = tape.constant(y.shape(), &vec![0.0; y.len()]);
    let loss = tape.apply(Loss::new(Cost::Squared), &[&y, &target]).expect("shapes fit");
    drop((y, target));
    tape.backward(loss, &mut Gradients::new(&parameters)).expect("finite");
    let usage = arena.usage();
    assert_eq!(usage.in_use_bytes, 0, "everything returns to the arena");
    (usage.peak_bytes, foretold)
}

#[test]
fn activations_take_about_what_is_foretold() {
    for use_checkpoint in [false, true] {
        let (taken, foretold) = activations(use_checkpoint);
        // The estimate counts every result; some are not kept, and a backward adds its own.
        let ratio = taken as f64 / foretold as f64;
        assert!((0.6..1.2).contains(&ratio), "checkpoints {use_checkpoint}: {taken} of {foretold}");
    }
    let (plain, checkpointed) = (activations(false).0, activations(true).0);
    assert!(checkpointed * 2 < plain, "{checkpointed} with checkpoints, {plain} without");
}

#[test]
fn model_prints_layers_parameters_flops_and_memory() {
    let output = finish(motiongen().args(["model", "--preset", "tiny", "--frames", "8"]));
    assert_eq!(output.code, 0, "{}", output.stderr);
    let lines: Vec<_> = output.stdout.lines().map(str::trim_end).collect();
    assert_eq!(lines[0], "UNet1D, preset tiny, one motion of 8 frames");
    let conv = lines.iter().find(|line| line.starts_with("encoder.1.res.0.conv1 "));
    let words: Vec<_> = conv.expect("a layer").split_whitespace().collect();
    // 48 × 40 × 3 weights and 48 biases; 2 · 4 frames · 5,760 = 46,080 operations.
    let wanted = ["encoder.1.res.0.conv1", "conv1d", "[1,", "4,", "48]", "5,808", "0.0"];
    assert_eq!(words, wanted);
    assert!(lines.contains(&"parameters                      413,241  (1.7 MB)"), "{lines:?}");
    assert!(lines.contains(&"  weights, gradients, moments   6.6 MB"), "{lines:?}");

    let output = finish(motiongen().args(["model", "--network", "decoder"]));
    assert_eq!(output.code, 0, "{}", output.stderr);
    assert!(output.stdout.starts_with("MotionDecoder, one motion of 120 frames\n"));
    assert!(output.stdout.contains("parameters                      2,117,401  (8.5 MB)"));
}

#[test]
fn model_refuses_sizes_of_zero() {
    let output = finish(motiongen().args(["model", "--frames", "0"]));
    assert_eq!(output.code, 2);
    assert_eq!(output.stderr.trim(), "error: --frames is 0; a motion has at least one frame");
}
