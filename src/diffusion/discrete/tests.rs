use std::collections::BTreeMap;
use std::sync::LazyLock;

use ndarray::Array2;

use super::*;

/// Codes of the toy, and tokens of a window.
const K: usize = 3;
const N: usize = 3;
/// Windows that are drawn.
const DRAWS: u64 = 20_000;

/// Every window of the toy and its probability: weights 1 to 5 that no product of three marginals has.
static TOY: LazyLock<Vec<(Vec<u32>, f64)>> = LazyLock::new(|| {
    let weight = |i: usize| (1 + (i * i * 7 + i * 3) % 5) as f64;
    let sum: f64 = (0..K.pow(N as u32)).map(weight).sum();
    (0..K.pow(N as u32)).map(|i| (window(i), weight(i) / sum)).collect()
});

fn joint() -> Vec<f64> {
    TOY.iter().map(|(_, p)| *p).collect()
}

/// The number of a window in base K.
fn number(window: &[u32]) -> usize {
    window.iter().fold(0, |i, &token| i * K + token as usize)
}

fn window(number: usize) -> Vec<u32> {
    (0..N).rev().map(|n| (number / K.pow(n as u32) % K) as u32).collect()
}

/// ln p(z_n = k | the tokens that are known), by summing the joint.
fn conditional(known: &[Option<u32>], n: usize) -> Vec<f32> {
    let mut p = vec![0.0; K];
    for (window, joint) in TOY.iter() {
        let agrees = |m: usize| m == n || known[m].is_none_or(|token| window[m] == token);
        if (0..N).all(agrees) {
            p[window[n] as usize] += joint;
        }
    }
    p.into_iter().map(|p: f64| p.ln() as f32 + 0.75).collect()
}

/// A masked planner that knows the joint.
fn masked_planner(tokens: &[u32]) -> Result<Array2<f32>, DiffusionError> {
    let known: Vec<_> = tokens.iter().map(|&t| (t < K as u32).then_some(t)).collect();
    let rows = (0..N).flat_map(|n| conditional(&known, n)).collect();
    Ok(Array2::from_shape_vec((N, K), rows).expect("as many as its shape says"))
}

/// Number i of a draw of a seed, in [0, 1): the finalizer of SplitMix64 (Steele, Lea and Flood, 2014).
fn number_of(seed: u64, draw: usize, i: usize) -> f64 {
    let place = (seed << 16) + ((draw as u64) << 8) + i as u64 + 1;
    let z = place.wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((z ^ (z >> 31)) >> 11) as f64 * 2.0_f64.powi(-53)
}

fn uniform(seed: u64) -> impl FnMut(usize, &mut [f64]) {
    move |draw, numbers| {
        numbers.iter_mut().enumerate().for_each(|(i, u)| *u = number_of(seed, draw, i));
    }
}

fn all(n_iterations: usize, confidence_temperature: f64) -> TokenSampling {
    TokenSampling { n_iterations, confidence_temperature, temperature: 1.0, top_share: 1.0 }
}

/// Total variation ½ Σ |p̂ − p| of the windows that `draw` gives.
fn total_variation(wanted: &[f64], mut draw: impl FnMut(u64) -> usize) -> f64 {
    let mut counts = BTreeMap::<usize, u64>::new();
    for seed in 0..DRAWS {
        *counts.entry(draw(seed)).or_default() += 1;
    }
    let share = |i| counts.get(&i).map_or(0.0, |&n| n as f64 / DRAWS as f64);
    let apart = wanted.iter().enumerate().map(|(i, p)| (share(i) - p).abs());
    apart.sum::<f64>() / 2.0
}

/// What the total variation of so many draws stays below, but for one time in a million.
///
/// Its mean is at most ½ Σ √(p (1 − p) / n), and one draw changes it by at most 1 / n, so that it is above its mean by
/// more than ε with a probability of at most exp(−2 n ε²) (McDiarmid, "On the Method of Bounded Differences", 1989).
fn bound(wanted: &[f64]) -> f64 {
    let n = DRAWS as f64;
    let mean: f64 = wanted.iter().map(|p| (p * (1.0 - p) / n).sqrt()).sum::<f64>() / 2.0;
    mean + (1e6_f64.ln() / (2.0 * n)).sqrt()
}

fn masked(sampling: &TokenSampling, given: &[Option<u32>], seed: u64) -> Vec<u32> {
    sample_masked(sampling, given, K, masked_planner, uniform(seed)).expect("tokens")
}

fn autoregressive(sampling: &TokenSampling, given: &[Option<u32>], seed: u64) -> Vec<u32> {
    let next = |tokens: &[u32]| {
        let known: Vec<_> = (0..N).map(|n| tokens.get(n).copied()).collect();
        Ok::<_, DiffusionError>(conditional(&known, tokens.len()))
    };
    let uniform = |n| number_of(seed, 0, n);
    sample_autoregressive(sampling, given, K, next, uniform).expect("tokens")
}

#[test]
fn masking_follows_a_cosine_and_leaves_one_at_least() {
    assert_eq!([0.0, 1.0 / 3.0, 0.5, 2.0 / 3.0, 1.0].map(|r| n_masked(30, r)), [30, 26, 21, 15, 1]);
    assert_eq!([0.0, 0.5, 0.99].map(|r| n_masked(1, r)), [1, 1, 1]);
    assert_eq!(n_masked(0, 0.3), 0);
}

#[test]
fn tokens_in_any_order_one_at_a_time_have_the_joint_distribution() {
    // Ten iterations mask 3, 3, 3, 3, 2, 2, 2, 1, 1, 1: never two at once become final.
    let steps: Vec<_> = (0..10).map(|i| n_masked(N, f64::from(i) / 9.0)).collect();
    assert_eq!(steps, [3, 3, 3, 3, 2, 2, 2, 1, 1, 1]);
    let p = joint();
    let apart = total_variation(&p, |seed| number(&masked(&all(10, 1e9), &[None; N], seed)));
    assert!(apart < bound(&p), "{apart} of {}", bound(&p));
}

#[test]
fn tokens_one_after_the_other_have_the_joint_distribution() {
    let p = joint();
    let apart = total_variation(&p, |seed| number(&autoregressive(&all(1, 0.0), &[None; N], seed)));
    assert!(apart < bound(&p), "{apart} of {}", bound(&p));
}

#[test]
fn tokens_that_are_given_stay_and_the_others_have_what_they_leave() {
    let given = 2;
    let p: Vec<f64> = joint()
        .iter()
        .enumerate()
        .map(|(i, p)| if window(i)[0] == given { *p } else { 0.0 })
        .collect();
    let sum: f64 = p.iter().sum();
    let p: Vec<f64> = p.into_iter().map(|p| p / sum).collect();
    let apart = total_variation(&p, |seed| {
        number(&masked(&all(10, 1e9), &[Some(given), None, None], seed))
    });
    assert!(apart < bound(&p), "{apart}");
    let first_given = [Some(given), None, None];
    let apart =
        total_variation(&p, |seed| number(&autoregressive(&all(1, 0.0), &first_given, seed)));
    assert!(apart < bound(&p), "{apart}");
    let all_given = [Some(0), Some(2), Some(1)];
    assert_eq!(masked(&all(10, 0.0), &all_given, 5), [0, 2, 1]);
    assert_eq!(autoregressive(&all(1, 0.0), &all_given, 5), [0, 2, 1]);
}

#[test]
fn the_surest_of_two_stays_as_the_closed_form_has_it() {
    // Two independent tokens, 0 with q: both are drawn, the less sure (of equal ones the first) is drawn again.
    let q = 0.7_f64;
    let wanted = [
        q.powi(3) + 2.0 * q * q * (1.0 - q),
        2.0 * q * (1.0 - q).powi(2),
        q * q * (1.0 - q) + q * (1.0 - q).powi(2),
        (1.0 - q).powi(3),
    ];
    assert!((wanted.iter().sum::<f64>() - 1.0).abs() < 1e-12);
    let planner = |_: &[u32]| {
        let row = [q.ln() as f32, (1.0 - q).ln() as f32];
        Ok::<_, DiffusionError>(Array2::from_shape_fn((2, 2), |(_, k)| row[k]))
    };
    let draw = |seed| {
        let window =
            sample_masked(&all(2, 0.0), &[None, None], 2, planner, uniform(seed)).expect("tokens");
        (2 * window[0] + window[1]) as usize
    };
    let apart = total_variation(&wanted, draw);
    assert!(apart < bound(&wanted), "{apart} of {}", bound(&wanted));
    // Without a choice by confidence it would be this, which is farther off than chance can be.
    let plain = [q * q, q * (1.0 - q), q * (1.0 - q), (1.0 - q).powi(2)];
    assert!(total_variation(&plain, draw) > bound(&plain));
}

#[test]
fn the_same_numbers_give_the_same_tokens_and_others_others() {
    let windows = |seed: u64| -> Vec<Vec<u32>> {
        (0..40).map(|i| masked(&all(10, 1.0), &[None; N], 100 * seed + i)).collect()
    };
    assert_eq!(windows(1), windows(1));
    assert_ne!(windows(1), windows(2));
}

#[test]
fn only_the_most_probable_tokens_are_drawn_and_a_temperature_of_0_takes_the_first() {
    let sampling = TokenSampling { top_share: 0.4, ..all(1, 0.0) };
    assert_eq!([1, 5, 10, 11].map(|k| sampling.n_allowed(k)), [1, 2, 4, 5]);
    assert_eq!(TokenSampling::default().n_allowed(30), 3);
    let logits = [0.0, 2.0, -1.0, 1.0, 2.0];
    for i in 0..100 {
        let (token, _) = sampling.draw(&logits, f64::from(i) / 100.0).expect("a token");
        assert_eq!(token, if i < 50 { 1 } else { 4 });
    }
    let cold = TokenSampling { temperature: 0.0, ..all(1, 0.0) };
    let (token, ln_p) = cold.draw(&logits, 0.99).expect("a token");
    let sum: f64 = logits.iter().map(|&x| f64::from(x).exp()).sum();
    assert_eq!(token, 1);
    assert!((ln_p - (2.0 - sum.ln())).abs() < 1e-12);
    // A token that cannot be is not drawn, whatever rounding leaves.
    let never = [f32::NEG_INFINITY, 0.0, f32::NEG_INFINITY];
    assert_eq!(all(1, 0.0).draw(&never, 1.0 - f64::EPSILON).expect("a token").0, 1);
}

#[test]
fn what_nothing_can_be_drawn_by_is_refused() {
    let refusal = |sampling: TokenSampling| sampling.check().expect_err("unsound").to_string();
    assert_eq!(
        refusal(all(0, 0.0)),
        "tokens are drawn in 0 iterations; it must be 1 to 100000, and 10 are usual"
    );
    assert_eq!(
        refusal(TokenSampling { temperature: -0.5, ..all(1, 0.0) }),
        "temperature is -0.5; it must be a number of at least 0, and 1 is usual"
    );
    assert_eq!(
        refusal(all(1, f64::NAN)),
        "confidence_temperature is NaN; it must be a number of at least 0, and 0 is usual"
    );
    assert_eq!(
        refusal(TokenSampling { top_share: 0.0, ..all(1, 0.0) }),
        "the share of tokens that may be drawn is 0; it must lie above 0 and not above 1, and 0.1 is usual"
    );
    let error = |given: &[Option<u32>], logits: Array2<f32>| {
        let planner = |_: &[u32]| Ok::<_, DiffusionError>(logits.clone());
        let found = sample_masked(&all(3, 0.0), given, K, planner, uniform(0));
        found.expect_err("refused").to_string()
    };
    assert_eq!(
        error(&[None, Some(3)], Array2::zeros((2, K))),
        "token 3 is none of the 3 that the planner knows, 0 to 2; give tokens of the tokenizer that it was trained with"
    );
    assert_eq!(
        error(&[None, None], Array2::zeros((2, K + 1))),
        "what the planner says has shape [2, 4]; [2, 3] is needed, the shape of tokens by codes"
    );
    assert_eq!(
        error(&[None], Array2::from_elem((1, K), f32::NAN)),
        "a planner says of a token what is no number; its weights are damaged, or its training went wrong"
    );
}
