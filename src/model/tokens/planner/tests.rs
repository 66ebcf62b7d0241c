use super::*;
use crate::model::outline::Outline;
use crate::model::tokens::TokensConfig;
use crate::model::unet::Preset;

fn config(kind: PlannerKind, frames_per_token: usize, style_dim: usize) -> PlannerConfig {
    let tokens = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
    let tiny = PlannerConfig::of(Preset::Tiny, kind, &tokens).expect("a preset of the family");
    PlannerConfig { frames_per_token, style_dim, ..tiny }
}

#[test]
fn shapes_are_followed_at_every_rate_and_every_parameter_is_met() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        for frames_per_token in [1, 2, 4, 8, 16] {
            let config = config(kind, frames_per_token, 8);
            let (planner, list) = Planner::new(&config);
            let mut g = Outline::new(&list);
            let (batch, frames) = (3, 37);
            let n_tokens = config.n_tokens(frames);
            let tokens = g.input(&[batch, n_tokens]);
            let audio = g.input(&[batch, frames, config.condition().dim()]);
            let (drop_audio, style) = (g.input(&[batch]), g.input(&[batch, 8]));
            let constraints = g.input(&[batch, frames, CONSTRAINT_DIM]);
            let inputs = PlannerInputs {
                tokens: &tokens,
                audio: &audio,
                drop_audio: Some(&drop_audio),
                style: Some(&style),
                constraints: Some(&constraints),
                drop_constraints: Some(&drop_audio),
                mask: Some(&tokens),
            };
            let logits = planner.forward(&mut g, &inputs).expect("shapes fit");
            assert_eq!(logits, [batch, n_tokens, 32], "{} ρ = {frames_per_token}", kind.name());
            let met: usize = g.layers().iter().map(|layer| layer.n_parameters).sum();
            assert_eq!(met, list.n_elements(), "ρ = {frames_per_token}");
        }
    }
}

#[test]
fn a_network_without_constraints_is_that_of_release_0_2() {
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let own = config(kind, 4, 8);
        let names = |config: &PlannerConfig| -> Vec<String> {
            let (_, list) = Planner::new(config);
            list.iter().map(|(_, parameter)| parameter.name.clone()).collect()
        };
        let without = names(&PlannerConfig { constraint_dim: 0, ..own.clone() });
        let rest: Vec<_> =
            names(&own).into_iter().filter(|name| !name.contains("constraints")).collect();
        assert_eq!(without, rest);
        assert_ne!(names(&own), rest);
    }
}

#[test]
fn a_network_without_a_style_has_no_place_for_one() {
    let names = |style_dim| -> Vec<String> {
        let (_, list) = Planner::new(&config(PlannerKind::Masked, 4, style_dim));
        list.iter().map(|(_, parameter)| parameter.name.clone()).collect()
    };
    let with = names(8);
    let without: Vec<_> = with.iter().filter(|name| !name.starts_with("style.")).cloned().collect();
    assert_eq!(with.len(), without.len() + 2);
    assert_eq!(names(0), without);
}

/// Returns the operations of planning windows of N tokens position by position, and those of asking the whole network
/// for each token.
fn flops_of_a_plan(n_tokens: usize) -> [u64; 2] {
    let config = config(PlannerKind::Autoregressive, 4, 0);
    let (planner, list) = Planner::new(&config);
    let (batch, frames) = (2, 4 * n_tokens - 1);
    let mut whole = Outline::new(&list);
    let tokens = whole.input(&[batch, n_tokens]);
    let audio = whole.input(&[batch, frames, config.condition().dim()]);
    let inputs = PlannerInputs {
        tokens: &tokens,
        audio: &audio,
        drop_audio: None,
        style: None,
        constraints: None,
        drop_constraints: None,
        mask: None,
    };
    planner.forward(&mut whole, &inputs).expect("shapes fit");
    let mut steps = Outline::new(&list);
    let heard = ConditionInputs {
        audio: &audio,
        drop_audio: None,
        style: None,
        constraints: None,
        drop_constraints: None,
        mask: None,
    };
    let conditions = planner.conditions(&mut steps, &heard).expect("shapes fit");
    let mut past: Option<Vec<KeysAndValues<Vec<usize>>>> = None;
    for n in 1..=n_tokens {
        let tokens = steps.input(&[batch, n]);
        let inputs =
            PlannerStepInputs { tokens: &tokens, conditions: &conditions, past: past.as_deref() };
        let step = planner.step(&mut steps, &inputs).expect("shapes fit");
        assert_eq!(step.logits, [batch, 1, 32], "one position is evaluated for token {n}");
        assert!(step.present.iter().all(|known| known.keys == [batch, n, 48]));
        past = Some(step.present);
    }
    [steps.flops(), n_tokens as u64 * whole.flops()]
}

#[test]
fn twice_as_many_tokens_take_twice_the_operations() {
    let [[once, asked_once], [twice, asked_twice]] = [15, 30].map(flops_of_a_plan);
    // What grows with the square, attention, is a small part.
    let ratio = twice as f64 / once as f64;
    assert!((2.0..2.1).contains(&ratio), "{once} and {twice}: {ratio}");
    let ratio = asked_twice as f64 / asked_once as f64;
    assert!((4.0..4.2).contains(&ratio), "without what is kept: {ratio}");
    assert!(asked_twice > 20 * twice, "{twice} instead of {asked_twice}");
}
