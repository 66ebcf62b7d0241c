//! The networks of a group: estimate, embedding, scores, loss and every gradient against PyTorch in f64.

use motiongen::autodiff::op::dancers::TakeSamples;
use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::op::shape::Reshape;
use motiongen::autodiff::op::softmax::CrossEntropy;
use motiongen::autodiff::{
    Arena, Eager, Element, Gradients, Interpreter, Parameters, Tape, Tensor,
};
use motiongen::model::{
    Graph, GroupConfig, GroupDenoiser, GroupInputs, GroupNetworks, GroupScore, GroupScoreInputs,
    ParameterList, Preset, Result,
};

use super::golden::{Golden, assert_near, given, parameters};

const FRAMES: usize = 9;
const N_DANCERS: usize = 3;
const BATCH: usize = 2;

/// Both networks with one list of parameters, as the golden file has them.
fn networks() -> (GroupConfig, GroupDenoiser, GroupScore, ParameterList) {
    let config = GroupConfig::of(Preset::Tiny).expect("a preset of the family");
    let (GroupNetworks { denoiser, score }, list) = GroupNetworks::new(&config);
    (config, denoiser, score, list)
}

struct Inputs<E: Element> {
    x: Tensor<E>,
    audio: Tensor<E>,
    z: Tensor<E>,
    t: Tensor<E>,
    drop: Tensor<E>,
    number: Tensor<E>,
    present: Vec<f64>,
    mask: Tensor<E>,
}

fn numbers<E: Element>(values: &[f64]) -> Vec<E> {
    values.iter().map(|&x| E::from_f64(x)).collect()
}

/// Repeats a number for each dancer as often as he has frames.
fn for_frames<E: Element>(present: &[f64], frames: usize) -> Vec<E> {
    present.iter().flat_map(|&x| std::iter::repeat_n(E::from_f64(x), frames)).collect()
}

fn inputs<E: Element, I: Interpreter<Element = E>>(
    g: &mut I,
    golden: &Golden,
    config: &GroupConfig,
    mut differentiated: impl FnMut(&mut I, &[usize], &[E]) -> Tensor<E>,
) -> Inputs<E> {
    let rows = BATCH * N_DANCERS;
    let x = given("input.x", rows * FRAMES * 25);
    let dim = config.condition().dim();
    let audio = given("input.audio", BATCH * FRAMES * dim);
    let z = given("input.z", BATCH * config.width);
    let present = golden.values("input/present").to_vec();
    let mask: Vec<E> = for_frames(&present, FRAMES);
    let stored = |g: &mut I, name: &str| {
        let values: Vec<E> = numbers(golden.values(&format!("input/{name}")));
        g.constant(&[BATCH], &values)
    };
    Inputs {
        t: stored(g, "t"),
        drop: stored(g, "drop"),
        number: stored(g, "number"),
        mask: g.constant(&[BATCH, N_DANCERS * FRAMES], &mask),
        present,
        x: differentiated(g, &[rows, FRAMES, 25], &x),
        audio: differentiated(g, &[BATCH, FRAMES, dim], &audio),
        z: differentiated(g, &[BATCH, config.width], &z),
    }
}

/// Returns the estimate, the embedding and the logits, \[B, 1 + K\].
fn forward<E: Element, I: Interpreter<Element = E>>(
    g: &mut I,
    golden: &Golden,
    (config, denoiser, score): (&GroupConfig, &GroupDenoiser, &GroupScore),
    given: &Inputs<E>,
) -> Result<[Tensor<E>; 3]> {
    let inputs = GroupInputs {
        x: &given.x,
        t: &given.t,
        audio: &given.audio,
        drop_audio: Some(&given.drop),
        number: &given.number,
        z: &given.z,
        mask: Some(&given.mask),
    };
    let found = denoiser.forward(g, &inputs)?;
    // The estimate itself, and then the mixed groups, group by group.
    let negatives = golden.values("input/negatives");
    let k = negatives.len() / (BATCH * N_DANCERS);
    let (mut taken, mut groups) = (Vec::new(), Vec::new());
    for b in 0..BATCH {
        taken.extend((0..N_DANCERS).map(|i| b * N_DANCERS + i));
        let of_group = &negatives[b * k * N_DANCERS..][..k * N_DANCERS];
        taken.extend(of_group.iter().map(|&i| i as usize));
        groups.extend(std::iter::repeat_n(b, 1 + k));
    }
    let steps = golden.values("input/t");
    let t: Vec<E> = taken.iter().map(|&i| E::from_f64(steps[i / N_DANCERS])).collect();
    let t = g.constant(&[taken.len()], &t);
    let patches = FRAMES.div_ceil(config.score_patch_frames);
    let present: Vec<f64> =
        groups.iter().flat_map(|&b| given.present[b * N_DANCERS..][..N_DANCERS].to_vec()).collect();
    let mask: Vec<E> = for_frames(&present, patches);
    let mask = g.constant(&[groups.len(), N_DANCERS * patches], &mask);
    let there = g.constant(&[groups.len(), N_DANCERS], &numbers(&present));
    let x0 = g.apply(TakeSamples::new(taken), &[&found.x0])?;
    let w = g.apply(TakeSamples::new(groups.clone()), &[&found.w])?;
    let number = g.apply(TakeSamples::new(groups), &[&given.number])?;
    let (mask, there) = (Some(&mask), Some(&there));
    let inputs = GroupScoreInputs { x0: &x0, t: &t, w: &w, number: &number, mask, there };
    let logits = score.forward(g, &inputs)?.log_ratio;
    let logits = g.apply(Reshape::new(&[BATCH, 1 + k]), &[&logits])?;
    Ok([found.x0, found.w, logits])
}

fn check<E: Element>(tolerance: f64) {
    let golden = Golden::open("group_tiny.safetensors");
    let (config, denoiser, score, list) = networks();
    let parameters: Parameters<E> = parameters(list);
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let inputs_of = |g: &mut Tape<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let given_inputs = inputs(&mut tape, &golden, &config, inputs_of);
    let networks = (&config, &denoiser, &score);
    let [x0, w, logits] = forward(&mut tape, &golden, networks, &given_inputs).expect("shapes fit");
    // Absent dancers are not looked at: what they say differs with how they are kept out.
    let present: Vec<E> = for_frames(&given_inputs.present, FRAMES * 25);
    let there = |values: &[f64]| -> Vec<f64> {
        values.iter().zip(&present).filter(|(_, p)| **p > E::ZERO).map(|(x, _)| *x).collect()
    };
    let found: Vec<f64> = x0.data().iter().map(|x| x.to_f64()).collect();
    let found: Vec<E> = numbers(&there(&found));
    assert_near("estimate", &found, &there(golden.values("output")), tolerance);
    assert_near("embedding", w.data(), golden.values("w"), tolerance);
    assert_near("logits", logits.data(), golden.values("logits"), tolerance);

    let rows = BATCH * N_DANCERS;
    let target = given::<E>("input.target", rows * FRAMES * 25);
    let target = tape.constant(&[rows, FRAMES, 25], &target);
    let weights: Vec<E> = for_frames(&given_inputs.present, FRAMES);
    let weights = tape.constant(&[rows, FRAMES], &weights);
    let simple = tape.apply(Loss::new(Cost::Squared), &[&x0, &target, &weights]).expect("fits");
    let labels = tape.constant(&[BATCH], &[E::ZERO; BATCH]);
    let contrast = tape.apply(CrossEntropy::default(), &[&logits, &labels]).expect("fits");
    let contrast = tape.scale(&contrast, 0.5).expect("fits");
    let loss = tape.add(&simple, &contrast).expect("fits");
    assert_near("loss", loss.data(), golden.values("loss"), tolerance);
    let mut gradients = Gradients::new(&parameters);
    let found = tape.backward(loss, &mut gradients).expect("finite");
    for (name, input) in
        [("x", &given_inputs.x), ("audio", &given_inputs.audio), ("z", &given_inputs.z)]
    {
        let got = found.of(input).expect("a gradient");
        let wanted = golden.values(&format!("grad.input/{name}"));
        assert_near(&format!("gradient of {name}"), got.data(), wanted, tolerance);
    }
    let places = parameters.list().by_name();
    assert_eq!(places.len(), golden.parameters.len(), "parameters by name");
    let gradients = std::cell::RefCell::new(gradients);
    golden.compare("grad", 0, tolerance, |name| {
        gradients.borrow_mut().unpacked(places[name]).into_iter().map(Element::to_f64).collect()
    });

    let mut eager = Eager::new(&parameters, &arena);
    let inputs_of = |g: &mut Eager<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let again = inputs(&mut eager, &golden, &config, inputs_of);
    let [x0, ..] = forward(&mut eager, &golden, networks, &again).expect("shapes fit");
    let found: Vec<f64> = x0.data().iter().map(|x| x.to_f64()).collect();
    let found: Vec<E> = numbers(&there(&found));
    assert_near("eager estimate", &found, &there(golden.values("output")), tolerance);
}

#[test]
fn a_group_with_an_absent_dancer_and_mixed_groups_are_pytorchs() {
    check::<f64>(1e-9);
    check::<f32>(1e-4);
}
