use std::sync::Arc;

use super::*;
use crate::model::{Preset, TokensConfig};
use crate::training::batch::Chances;

const FRAMES: usize = 38;
/// Tokens of a window: the last stands for two frames.
const N: usize = 10;
const WINDOWS: usize = 400;

fn sizes(kind: PlannerKind) -> PlannerConfig {
    let tokens = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
    let tiny = PlannerConfig::of(Preset::Tiny, kind, &tokens).expect("a preset of the family");
    PlannerConfig { style_dim: 8, clock: false, constraint_dim: 0, ..tiny }
}

fn given<'a>(
    batch: &'a Batch,
    tokens: &[u32],
    sizes: &PlannerConfig,
    chances: PlannerChances,
    seed: u64,
) -> PlannerBatch<'a> {
    PlannerBatch::of(batch, tokens, (sizes, &Normalizer::identity()), chances, seed)
}

/// Windows of which every other has 21 frames, six tokens.
fn batch() -> Batch {
    let mut batch = Batch::empty(WINDOWS, FRAMES, 1, 163);
    batch.n_windows = WINDOWS;
    for i in 0..WINDOWS {
        let n = if i % 2 == 0 { FRAMES } else { 21 };
        batch.mask.extend((0..FRAMES).map(|t| if t < n { 1.0 } else { 0.0 }));
        batch.style.extend([0.5; 8]);
        let u = (i as f64 + 0.5) / WINDOWS as f64;
        batch.chances.push(Chances { step: u, no_audio: u, no_style: u, no_clock: u });
        batch.n_dancers.push(1);
        batch.phrase_ids.push(Arc::from("a phrase"));
    }
    batch.audio = vec![0.0; WINDOWS * FRAMES * 163];
    batch
}

fn tokens() -> Vec<u32> {
    (0..WINDOWS * N).map(|i| (i * 7 % 32) as u32).collect()
}

const TRAINED: PlannerChances = PlannerChances {
    replacement: 0.1,
    shown: 0.12,
    audio: 0.25,
    clock: 0.0,
    style: 0.5,
    constraints: 0.5,
};

#[test]
fn masked_tokens_are_as_many_as_the_cosine_says_and_never_beyond_a_phrase() {
    let (batch, tokens) = (batch(), tokens());
    let sizes = sizes(PlannerKind::Masked);
    let given = given(&batch, &tokens, &sizes, TRAINED, 5);
    for (b, weights) in given.weights.chunks(N).enumerate() {
        let n_counting = if b % 2 == 0 { N } else { 6 };
        let n_asked = weights.iter().filter(|&&w| w == 1.0).count();
        assert_eq!(n_asked, n_masked(n_counting, batch.chances[b].step), "window {b}");
        assert!(weights[n_counting..].iter().all(|&w| w == 0.0), "window {b}");
    }
    assert_eq!(given.weight(0..2), f64::from(10 + 6), "at the beginning all are masked");
    // Tokens that are not asked for are seen as they are.
    let untouched = given.weights.iter().zip(given.seen.iter().zip(&given.labels));
    assert!(untouched.filter(|(w, _)| **w == 0.0).all(|(_, (seen, label))| seen == label));
    // Of those that are: a tenth is any of 32, 88 % of the rest hidden.
    let asked = given.weights.iter().zip(&given.seen).filter(|(w, _)| **w == 1.0);
    let seen: Vec<f32> = asked.map(|(_, &seen)| seen).collect();
    let hidden = seen.iter().filter(|&&z| z == 32.0).count() as f64 / seen.len() as f64;
    // Five deviations of a binomial of some 2,000.
    assert!(
        (hidden - 0.9 * 0.88).abs() < 5.0 * (0.79 * 0.21 / seen.len() as f64).sqrt(),
        "{hidden}"
    );
    assert!(seen.iter().all(|z| (0.0..=32.0).contains(z)));
}

#[test]
fn every_place_is_masked_as_often_as_any_other() {
    let (batch, tokens) = (batch(), tokens());
    let mut counts = [0_u32; N];
    for seed in 0..20 {
        let sizes = sizes(PlannerKind::Masked);
        let given = given(&batch, &tokens, &sizes, TRAINED, seed);
        for weights in given.weights.chunks(N).step_by(2) {
            counts.iter_mut().zip(weights).for_each(|(n, &w)| *n += w as u32);
        }
    }
    let mean = f64::from(counts.iter().sum::<u32>()) / N as f64;
    // 4,000 windows, masked with 0.64 on average: a deviation of at most 32.
    assert!(counts.iter().all(|&n| (f64::from(n) - mean).abs() < 160.0), "{counts:?}");
}

#[test]
fn a_validation_hides_all_that_it_asks_for_and_withholds_nothing() {
    let (batch, tokens) = (batch(), tokens());
    let sizes = sizes(PlannerKind::Masked);
    let given = given(&batch, &tokens, &sizes, PlannerChances::VALIDATION, 5);
    let all = given.weights.iter().zip(given.seen.iter().zip(&given.labels));
    for (w, (seen, label)) in all {
        assert_eq!(*seen, if *w == 1.0 { 32.0 } else { *label });
    }
    assert!(given.drop_audio.iter().all(|&x| x == 0.0));
    assert!(given.style.expect("a style").iter().all(|&x| x == 0.5));
}

#[test]
fn of_the_autoregressive_kind_all_are_asked_for_and_a_share_is_replaced() {
    let (batch, tokens) = (batch(), tokens());
    let sizes = sizes(PlannerKind::Autoregressive);
    let chances = PlannerChances { replacement: 0.2, ..TRAINED };
    let given = given(&batch, &tokens, &sizes, chances, 5);
    assert_eq!(given.weights, given.mask);
    assert_eq!(given.weight(0..WINDOWS), (WINDOWS / 2 * (N + 6)) as f64);
    let counting = given.mask.iter().zip(given.seen.iter().zip(&given.labels));
    let counting: Vec<_> = counting.filter(|(w, _)| **w == 1.0).collect();
    let n_other = counting.iter().filter(|(_, (seen, label))| seen != label).count();
    let share = n_other as f64 / counting.len() as f64;
    // One of 32 is replaced by itself; five deviations of a binomial of 3,200.
    assert!((share - 0.2 * 31.0 / 32.0).abs() < 0.036, "{share}");
    // A quarter of the windows goes without music, half without a style.
    assert_eq!(given.drop_audio.iter().sum::<f32>(), 100.0);
    assert_eq!(given.style.expect("a style").iter().sum::<f32>(), 0.5 * 8.0 * 200.0);
}

#[test]
fn what_chance_does_follows_from_the_seed() {
    let (batch, tokens) = (batch(), tokens());
    for kind in [PlannerKind::Masked, PlannerKind::Autoregressive] {
        let sizes = sizes(kind);
        let seen = |seed| given(&batch, &tokens, &sizes, TRAINED, seed).seen;
        assert_eq!(seen(5), seen(5));
        assert_ne!(seen(5), seen(6));
    }
}

#[test]
fn constraints_are_drawn_for_networks_that_take_them_and_change_nothing_else() {
    let (mut batch, tokens) = (batch(), tokens());
    batch.motion = vec![0.5; WINDOWS * FRAMES * 25];
    let without = sizes(PlannerKind::Masked);
    let with = PlannerConfig { constraint_dim: crate::model::CONSTRAINT_DIM, ..without.clone() };
    let (plain, asked) =
        (given(&batch, &tokens, &without, TRAINED, 5), given(&batch, &tokens, &with, TRAINED, 5));
    assert_eq!(plain.constraints, None);
    assert_eq!((plain.seen, plain.weights), (asked.seen, asked.weights));
    let drawn = asked.constraints.expect("constraints");
    assert_eq!(drawn.channels.len(), WINDOWS * FRAMES * 12);
    let dropped: f32 = drawn.dropped.iter().sum();
    // Five deviations of a binomial of 400 and 1/2.
    assert!((dropped - 200.0).abs() < 50.0, "{dropped}");
}
