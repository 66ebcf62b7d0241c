//! Planners of tokens: logits, loss and every gradient against PyTorch in f64.

use motiongen::autodiff::op::softmax::CrossEntropy;
use motiongen::autodiff::{
    Arena, Eager, Element, Gradients, Interpreter, Parameters, Tape, Tensor,
};
use motiongen::model::{
    Planner, PlannerConfig, PlannerInputs, PlannerKind, Preset, Result, TokensConfig,
};

use super::golden::{Golden, assert_near, given, parameters};

const BATCH: usize = 3;
const FRAMES: usize = 22;
const N_TOKENS: usize = 6;
const STYLE_DIM: usize = 8;

struct Inputs<E: Element> {
    tokens: Tensor<E>,
    audio: Tensor<E>,
    drop_audio: Tensor<E>,
    style: Tensor<E>,
    mask: Tensor<E>,
}

impl<E: Element> Inputs<E> {
    fn new<I: Interpreter<Element = E>>(
        g: &mut I,
        golden: &Golden,
        condition_dim: usize,
        mut differentiated: impl FnMut(&mut I, &[usize], &[E]) -> Tensor<E>,
    ) -> Self {
        let known = |name: &str| -> Vec<E> {
            golden.values(&format!("input/{name}")).iter().map(|&x| E::from_f64(x)).collect()
        };
        let audio = given::<E>("input.audio", BATCH * FRAMES * condition_dim);
        let style = given::<E>("input.style", BATCH * STYLE_DIM);
        Self {
            tokens: g.constant(&[BATCH, N_TOKENS], &known("tokens")),
            audio: differentiated(g, &[BATCH, FRAMES, condition_dim], &audio),
            drop_audio: g.constant(&[BATCH], &known("drop")),
            style: differentiated(g, &[BATCH, STYLE_DIM], &style),
            mask: g.constant(&[BATCH, N_TOKENS], &known("mask")),
        }
    }

    fn logits<I: Interpreter<Element = E>>(
        &self,
        g: &mut I,
        planner: &Planner,
    ) -> Result<Tensor<E>> {
        let inputs = PlannerInputs {
            tokens: &self.tokens,
            audio: &self.audio,
            drop_audio: Some(&self.drop_audio),
            style: Some(&self.style),
            mask: Some(&self.mask),
        };
        planner.forward(g, &inputs)
    }
}

fn config(kind: PlannerKind) -> PlannerConfig {
    let tokens = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
    let tiny = PlannerConfig::of(Preset::Tiny, kind, &tokens).expect("a preset of the family");
    PlannerConfig { style_dim: STYLE_DIM, ..tiny }
}

fn check<E: Element>(name: &str, kind: PlannerKind, tolerance: f64) {
    let golden = Golden::open(name);
    let config = config(kind);
    let condition_dim = config.condition().dim();
    let (planner, list) = Planner::new(&config);
    let parameters: Parameters<E> = parameters(list);
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let of_tape = |g: &mut Tape<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let given = Inputs::new(&mut tape, &golden, condition_dim, of_tape);
    let logits = given.logits(&mut tape, &planner).expect("shapes fit");
    assert_near("logits", logits.data(), golden.values("output"), tolerance);

    let known = |name: &str| -> Vec<E> {
        golden.values(&format!("input/{name}")).iter().map(|&x| E::from_f64(x)).collect()
    };
    let labels = tape.constant(&[BATCH, N_TOKENS], &known("labels"));
    let weights = tape.constant(&[BATCH, N_TOKENS], &known("weights"));
    let loss = tape.apply(CrossEntropy::default(), &[&logits, &labels, &weights]).expect("fits");
    assert_near("loss", loss.data(), golden.values("loss"), tolerance);

    let mut gradients = Gradients::new(&parameters);
    let of_inputs = tape.backward(loss, &mut gradients).expect("finite");
    for (name, input) in [("audio", &given.audio), ("style", &given.style)] {
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

    let mut eager = Eager::new(&parameters, &arena);
    let of_eager = |g: &mut Eager<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let given = Inputs::new(&mut eager, &golden, condition_dim, of_eager);
    let logits = given.logits(&mut eager, &planner).expect("shapes fit");
    assert_near("eager logits", logits.data(), golden.values("output"), tolerance);
}

#[test]
fn planners_of_both_kinds_and_what_they_make_small_are_pytorchs() {
    for (name, kind) in [
        ("planner_masked.safetensors", PlannerKind::Masked),
        ("planner_autoregressive.safetensors", PlannerKind::Autoregressive),
    ] {
        check::<f64>(name, kind, 1e-9);
        check::<f32>(name, kind, 1e-4);
    }
}

/// Returns the logits of tokens to music of zeros, of tokens 0, 1, 2, … but for one of them.
fn logits_with(kind: PlannerKind, changed: usize) -> Vec<f64> {
    let config = config(kind);
    let (planner, list) = Planner::new(&config);
    let parameters: Parameters<f64> = parameters(list);
    let arena = Arena::default();
    let mut g = Eager::new(&parameters, &arena);
    let tokens: Vec<f64> =
        (0..N_TOKENS).map(|i| if i == changed { 29.0 } else { i as f64 }).collect();
    let tokens = g.constant(&[1, N_TOKENS], &tokens);
    let shape = [1, FRAMES, config.condition().dim()];
    let audio = g.constant(&shape, &vec![0.0; FRAMES * shape[2]]);
    let inputs =
        PlannerInputs { tokens: &tokens, audio: &audio, drop_audio: None, style: None, mask: None };
    planner.forward(&mut g, &inputs).expect("shapes fit").data().to_vec()
}

#[test]
fn a_position_of_the_autoregressive_kind_sees_no_token_from_its_own_on() {
    for changed in 0..N_TOKENS {
        let (plain, other) = (
            logits_with(PlannerKind::Autoregressive, N_TOKENS),
            logits_with(PlannerKind::Autoregressive, changed),
        );
        let seen = 32 * (changed + 1);
        assert_eq!(plain[..seen], other[..seen], "token {changed}");
        assert!(changed + 1 == N_TOKENS || plain[seen..] != other[seen..], "token {changed}");
    }
    let (plain, other) =
        (logits_with(PlannerKind::Masked, N_TOKENS), logits_with(PlannerKind::Masked, 4));
    assert!(plain.chunks(32).zip(other.chunks(32)).all(|(a, b)| a != b), "all see all");
}

#[test]
fn a_token_that_the_table_does_not_have_is_refused() {
    for (kind, token, rows) in
        [(PlannerKind::Masked, 33.0, 33), (PlannerKind::Autoregressive, 32.0, 32)]
    {
        let config = config(kind);
        let (planner, list) = Planner::new(&config);
        let parameters: Parameters<f64> = parameters(list);
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        let tokens = g.constant(&[1, 2], &[0.0, token]);
        let audio = g.constant(&[1, 8, 173], &vec![0.0; 8 * 173]);
        let inputs = PlannerInputs {
            tokens: &tokens,
            audio: &audio,
            drop_audio: None,
            style: None,
            mask: None,
        };
        let error = planner.forward(&mut g, &inputs).expect_err("no such token").to_string();
        let expected = format!(
            "embedding: index {token} is not a whole number below {rows}, the rows of the table"
        );
        assert_eq!(error, expected);
    }
}
