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
    /// Of a network that takes them, with what is dropped.
    constraints: Option<(Tensor<E>, Tensor<E>)>,
    mask: Tensor<E>,
}

impl<E: Element> Inputs<E> {
    fn new<I: Interpreter<Element = E>>(
        g: &mut I,
        golden: &Golden,
        (condition_dim, constraint_dim): (usize, usize),
        mut differentiated: impl FnMut(&mut I, &[usize], &[E]) -> Tensor<E>,
    ) -> Self {
        let known = |name: &str| -> Vec<E> {
            golden.values(&format!("input/{name}")).iter().map(|&x| E::from_f64(x)).collect()
        };
        let audio = given::<E>("input.audio", BATCH * FRAMES * condition_dim);
        let style = given::<E>("input.style", BATCH * STYLE_DIM);
        let constraints = (constraint_dim > 0).then(|| {
            let values = given::<E>("input.constraints", BATCH * FRAMES * constraint_dim);
            let values = differentiated(g, &[BATCH, FRAMES, constraint_dim], &values);
            (values, g.constant(&[BATCH], &known("drop_constraints")))
        });
        Self {
            tokens: g.constant(&[BATCH, N_TOKENS], &known("tokens")),
            audio: differentiated(g, &[BATCH, FRAMES, condition_dim], &audio),
            drop_audio: g.constant(&[BATCH], &known("drop")),
            style: differentiated(g, &[BATCH, STYLE_DIM], &style),
            constraints,
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
            constraints: self.constraints.as_ref().map(|(asked, _)| asked),
            drop_constraints: self.constraints.as_ref().map(|(_, dropped)| dropped),
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

fn check<E: Element>(name: &str, config: &PlannerConfig, tolerance: f64) {
    let golden = Golden::open(name);
    let dims = (config.condition().dim(), config.constraint_dim);
    let (planner, list) = Planner::new(config);
    let parameters: Parameters<E> = parameters(list);
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let of_tape = |g: &mut Tape<E>, shape: &[usize], values: &[E]| g.input(shape, values);
    let given = Inputs::new(&mut tape, &golden, dims, of_tape);
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
    let asked = given.constraints.as_ref().map(|(asked, _)| ("constraints", asked));
    for (name, input) in [("audio", &given.audio), ("style", &given.style)].into_iter().chain(asked)
    {
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
    let given = Inputs::new(&mut eager, &golden, dims, of_eager);
    let logits = given.logits(&mut eager, &planner).expect("shapes fit");
    assert_near("eager logits", logits.data(), golden.values("output"), tolerance);
}

#[test]
fn planners_of_both_kinds_and_what_they_make_small_are_pytorchs() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let plain = PlannerConfig { constraint_dim: 0, ..config(kind) };
        let constrained = PlannerConfig { audio_cond_dim: 20, clock: false, ..config(kind) };
        for (of, config) in [("planner", plain), ("constrained", constrained)] {
            let name = format!("{of}_{}.safetensors", kind.name());
            check::<f64>(&name, &config, 1e-9);
            check::<f32>(&name, &config, 1e-4);
        }
    }
}

/// What a planner says of four tokens where floor and height are asked of a frame, or withheld, or nothing is said.
fn logits_under(constraints: Option<(f64, f64)>) -> Vec<f64> {
    let config = config(PlannerKind::Masked);
    let (planner, list) = Planner::new(&config);
    let parameters: Parameters<f64> = parameters(list);
    let arena = Arena::default();
    let mut g = Eager::new(&parameters, &arena);
    let tokens = g.constant(&[1, 4], &[32.0; 4]);
    let audio = g.constant(&[1, 16, 173], &vec![0.25; 16 * 173]);
    let asked = constraints.map(|(x, dropped)| {
        let mut channels = vec![0.0; 16 * config.constraint_dim];
        channels[9 * config.constraint_dim] = x;
        (g.constant(&[1, 16, config.constraint_dim], &channels), g.constant(&[1], &[dropped]))
    });
    let inputs = PlannerInputs {
        tokens: &tokens,
        audio: &audio,
        drop_audio: None,
        style: None,
        constraints: asked.as_ref().map(|(asked, _)| asked),
        drop_constraints: asked.as_ref().map(|(_, dropped)| dropped),
        mask: None,
    };
    planner.forward(&mut g, &inputs).expect("shapes fit").data().to_vec()
}

#[test]
fn constraints_that_are_withheld_are_constraints_that_are_not_there() {
    let nothing = logits_under(None);
    assert_eq!(logits_under(Some((1.5, 1.0))), nothing);
    assert_eq!(logits_under(Some((-4.0, 1.0))), nothing);
    assert_ne!(logits_under(Some((1.5, 0.0))), nothing);
    assert_ne!(logits_under(Some((1.5, 0.0))), logits_under(Some((-4.0, 0.0))));
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
    let inputs = PlannerInputs {
        tokens: &tokens,
        audio: &audio,
        drop_audio: None,
        style: None,
        constraints: None,
        drop_constraints: None,
        mask: None,
    };
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
            constraints: None,
            drop_constraints: None,
            mask: None,
        };
        let error = planner.forward(&mut g, &inputs).expect_err("no such token").to_string();
        let expected = format!(
            "embedding: index {token} is not a whole number below {rows}, the rows of the table"
        );
        assert_eq!(error, expected);
    }
}
