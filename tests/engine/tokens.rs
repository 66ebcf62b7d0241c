//! The tokenizer of motion: latents, tokens, signal, estimate, losses and every gradient against PyTorch in f64.

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::{
    Arena, Eager, Element, Gradients, Interpreter, Parameters, Tape, Tensor,
};
use motiongen::model::{Graph, Preset, Quantized, Result, Tokenizer, TokensConfig};

use super::golden::{Golden, assert_near, given, parameters};

const BATCH: usize = 3;
const FRAMES: usize = 22;
const COMMITMENT: f64 = 0.02;

struct Inputs<E: Element> {
    motion: Tensor<E>,
    x: Tensor<E>,
    t: Tensor<E>,
}

struct TokensOutputs<E: Element> {
    quantized: Quantized<Tensor<E>>,
    signal: Tensor<E>,
    draft: Option<Tensor<E>>,
    estimate: Tensor<E>,
}

fn forward<E: Element, I: Interpreter<Element = E>>(
    g: &mut I,
    tokenizer: &Tokenizer,
    given: &Inputs<E>,
) -> Result<TokensOutputs<E>> {
    let quantized = tokenizer.quantize(g, &given.motion)?;
    let q = g.straight_through(&quantized.latents, &quantized.codes)?;
    let signal = tokenizer.signal(g, &q, &given.motion)?;
    let estimate = tokenizer.denoise(g, &given.x, &given.t, &signal)?;
    let draft = tokenizer.draft(g, &signal)?;
    Ok(TokensOutputs { quantized, signal, draft, estimate })
}

fn inputs<E: Element, I: Interpreter<Element = E>>(
    g: &mut I,
    golden: &Golden,
    mut differentiated: impl FnMut(&mut I, &[usize], &[E]) -> Tensor<E>,
) -> Inputs<E> {
    let shape = [BATCH, FRAMES, 25];
    let values = |name: &str| given::<E>(name, BATCH * FRAMES * 25);
    let t: Vec<E> = golden.values("input/t").iter().map(|&t| E::from_f64(t)).collect();
    Inputs {
        motion: differentiated(g, &shape, &values("input.motion")),
        x: differentiated(g, &shape, &values("input.x")),
        t: g.constant(&[BATCH], &t),
    }
}

fn check<E: Element>(name: &str, config: &TokensConfig, tolerance: f64) {
    let golden = Golden::open(name);
    let (tokenizer, list) = Tokenizer::new(config);
    let parameters: Parameters<E> = parameters(list);
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let of_tape = |g: &mut Tape<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let given = inputs(&mut tape, &golden, of_tape);
    let found = forward(&mut tape, &tokenizer, &given).expect("shapes fit");
    let Quantized { latents, tokens, codes } = &found.quantized;
    assert_near("latents", latents.data(), golden.values("latents"), tolerance);
    let numbers: Vec<f64> = tokens.data().iter().map(|x| x.to_f64()).collect();
    assert_eq!(numbers, golden.values("tokens"));
    assert_near("signal", found.signal.data(), golden.values("signal"), tolerance);
    assert_near("estimate", found.estimate.data(), golden.values("output"), tolerance);

    let mask: Vec<E> = golden.values("input/mask").iter().map(|&w| E::from_f64(w)).collect();
    let mask = tape.constant(&[BATCH, FRAMES], &mask);
    let counts = tape.stride_mask(&mask, config.frames_per_token).expect("shapes fit");
    let of_frames = [&found.estimate, &given.motion, &mask];
    let simple = tape.apply(Loss::new(Cost::SmoothL1 { beta: 1.0 }), &of_frames).expect("fits");
    let codes = tape.constant(codes.shape(), codes.data());
    let of_tokens = [latents, &codes, &counts];
    let commitment = tape.apply(Loss::new(Cost::Squared), &of_tokens).expect("fits");
    assert_near("simple", simple.data(), golden.values("simple"), tolerance);
    assert_near("commitment", commitment.data(), golden.values("commitment"), tolerance);
    let commitment = tape.scale(&commitment, COMMITMENT).expect("fits");
    let mut loss = tape.add(&simple, &commitment).expect("fits");
    if let Some(draft) = &found.draft {
        assert_near("draft", draft.data(), golden.values("draft"), tolerance);
        let of_frames = [draft, &given.motion, &mask];
        let draft = tape.apply(Loss::new(Cost::SmoothL1 { beta: 1.0 }), &of_frames).expect("fits");
        assert_near("loss of the draft", draft.data(), golden.values("draft_loss"), tolerance);
        loss = tape.add(&loss, &draft).expect("fits");
    }
    assert_near("loss", loss.data(), golden.values("loss"), tolerance);

    let mut gradients = Gradients::new(&parameters);
    let of_inputs = tape.backward(loss, &mut gradients).expect("finite");
    for (name, input) in [("motion", &given.motion), ("x", &given.x)] {
        let got = of_inputs.of(input).expect("a gradient");
        let wanted = golden.values(&format!("grad.input/{name}"));
        assert_near(&format!("gradient of {name}"), got.data(), wanted, tolerance);
    }
    let places = parameters.list().by_name();
    assert_eq!(places.len(), golden.parameters.len(), "parameters by name");
    let gradients = std::cell::RefCell::new(gradients);
    golden.compare("grad", 0, tolerance, |name| {
        gradients.borrow_mut().unpacked(places[name]).into_iter().map(Element::to_f64).collect()
    });
    let of_codes = gradients.borrow_mut().unpacked(tokenizer.codebook());
    assert!(of_codes.iter().all(|&d| d == E::ZERO), "codes are not learned by gradients");

    let mut eager = Eager::new(&parameters, &arena);
    let of_eager = |g: &mut Eager<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let given = inputs(&mut eager, &golden, of_eager);
    let found = forward(&mut eager, &tokenizer, &given).expect("shapes fit");
    assert_near("eager estimate", found.estimate.data(), golden.values("output"), tolerance);
}

#[test]
fn a_tokenizer_and_what_it_makes_small_are_pytorchs() {
    let drafting = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
    let tiny = TokensConfig { draft: false, ..drafting.clone() };
    let halves = TokensConfig { frames_per_token: 2, taps: 7, ..tiny.clone() };
    for (name, config) in [
        ("tokens_tiny.safetensors", tiny),
        ("tokens_halves.safetensors", halves),
        ("tokens_draft.safetensors", drafting),
    ] {
        check::<f64>(name, &config, 1e-9);
        check::<f32>(name, &config, 1e-4);
    }
}
