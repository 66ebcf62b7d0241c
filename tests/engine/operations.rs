//! Single operations against PyTorch in f64: values and gradients.

use std::collections::BTreeSet;

use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::op::softmax::CrossEntropy;
use motiongen::autodiff::{Arena, Eager, Gradients, Interpreter, Parameters, Tape, Tensor};
use motiongen::model::{
    Activation, Attention, Channels, Convolution, Graph, GroupNormalization, Init, Outline,
    ParameterId, ParameterList, Result, Role, Scope,
};

use super::golden::{Golden, assert_near};

/// In f64 only the order of sums differs.
const TOLERANCE: f64 = 1e-12;

type T = Tensor<f64>;

/// Runs one case: inputs named in `inputs` go through the tape, those in `weights` are parameters.
fn check(
    case: &str,
    inputs: &[&str],
    weights: &[(&str, Role)],
    f: impl Fn(&mut Tape<f64>, &[T], &[ParameterId]) -> Result<T>,
) {
    let golden = Golden::open("ops.safetensors");
    let golden_name = |name: &str| format!("{case}/{name}");
    let mut list = ParameterList::default();
    let mut scope = Scope::root(&mut list);
    let ids: Vec<_> = weights
        .iter()
        .map(|(name, role)| {
            scope.parameter(name, golden.shape(&golden_name(name)), Init::Zeros, *role)
        })
        .collect();
    let parameters = Parameters::<f64>::from_fn(list, |parameter| {
        golden.values(&golden_name(&parameter.name)).to_vec()
    });
    let arena = Arena::default();
    let mut tape = Tape::new(&parameters, &arena, None);
    let tensors: Vec<_> = inputs
        .iter()
        .map(|name| tape.input(golden.shape(&golden_name(name)), golden.values(&golden_name(name))))
        .collect();
    let y = f(&mut tape, &tensors, &ids).expect("shapes fit");
    assert_eq!(y.shape(), golden.shape(&golden_name("output")), "{case}");
    assert_near(case, y.data(), golden.values(&golden_name("output")), TOLERANCE);
    let cotangent = tape.constant(y.shape(), golden.values(&golden_name("cotangent")));
    let mut gradients = Gradients::new(&parameters);
    let found = tape.backward_from(y, cotangent, &mut gradients).expect("finite");
    for (name, tensor) in inputs.iter().zip(&tensors) {
        if let Some(wanted) = golden.get(&golden_name(&format!("grad_{name}"))) {
            let got = found.of(tensor).expect("a gradient").data();
            assert_near(&format!("{case}, gradient of {name}"), got, wanted, TOLERANCE);
        }
    }
    for ((name, _), &id) in weights.iter().zip(&ids) {
        let got = gradients.unpacked(id);
        let wanted = golden.values(&golden_name(&format!("grad_{name}")));
        assert_near(&format!("{case}, gradient of {name}"), &got, wanted, TOLERANCE);
    }
}

const LAYER: [(&str, Role); 2] = [("weight", Role::Weight), ("bias", Role::Vector)];
const NORM: [(&str, Role); 2] = [("weight", Role::Vector), ("bias", Role::Vector)];

#[test]
fn convolutions_are_pytorchs() {
    for (case, taps, stride, padding, dilation) in
        [("conv1d_stride2", 3, 2, 1, 1), ("conv1d_dilation3", 5, 1, 6, 3)]
    {
        let convolution = Convolution { taps, stride, padding, dilation };
        check(case, &["x"], &LAYER, |g, x, p| g.conv1d(&x[0], p[0], Some(p[1]), convolution));
    }
}

#[test]
fn norms_are_pytorchs() {
    let norm = |p: &[ParameterId]| GroupNormalization {
        groups: 5,
        epsilon: 1e-5,
        weight: p[0],
        bias: p[1],
    };
    check("group_norm", &["x"], &NORM, |g, x, p| {
        g.group_norm(&x[0], norm(p), None, Activation::Identity)
    });
    check("group_norm_film_silu", &["x", "film"], &NORM, |g, x, p| {
        g.group_norm(&x[0], norm(p), Some(&x[1]), Activation::Silu)
    });
    check("layer_norm", &["x"], &NORM, |g, x, p| g.layer_norm(&x[0], Some([p[0], p[1]]), 1e-5));
}

#[test]
fn attention_is_pytorchs() {
    fn attention<'a>(x: &'a [T], key_mask: Option<&'a T>) -> Attention<'a, T> {
        let [query, key, value] = [0, 1, 2].map(|i| Channels { tensor: &x[i], first: 0 });
        Attention { query, key, value, width: 15, heads: 3, key_mask, causal: key_mask.is_none() }
    }
    check("attention_key_mask", &["query", "key", "value", "mask"], &[], |g, x, _| {
        g.attention(attention(x, Some(&x[3])))
    });
    check("attention_causal", &["query", "key", "value"], &[], |g, x, _| {
        g.attention(attention(x, None))
    });
}

/// Attention of four queries over five keys of their own, with a mask of the keys.
fn attend<G: Graph>(g: &mut G, x: [&G::Tensor; 4], causal: bool) -> G::Tensor {
    let [query, key, value] = [0, 1, 2].map(|i| Channels { tensor: x[i], first: 0 });
    let key_mask = Some(x[3]);
    g.attention(Attention { query, key, value, width: 6, heads: 2, key_mask, causal })
        .expect("shapes fit")
}

#[test]
fn a_query_without_keys_gets_zeros_and_gives_no_gradient() {
    let shapes = [&[2, 4, 6][..], &[2, 5, 6], &[2, 5, 6]];
    let numbers =
        |n: usize, k: usize| (0..n).map(|i| ((i * 37 + k * 11) % 23) as f64 / 9.0 - 1.2).collect();
    let values: [Vec<f64>; 3] =
        std::array::from_fn(|k| numbers(shapes[k].iter().product::<usize>(), k));
    // The first sample has no key at all, the second none before its third.
    let mask = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0];
    let parameters = Parameters::<f64>::new(ParameterList::default(), 0);
    let arena = Arena::default();
    for causal in [false, true] {
        // Queries of the second sample that see no key: the last query sees the last key, the first the first two.
        let n_blind = if causal { 1 } else { 0 };
        let mut tape = Tape::new(&parameters, &arena, None);
        let x = [0, 1, 2].map(|k| tape.input(shapes[k], &values[k]));
        let of_keys = tape.constant(&[2, 5], &mask);
        let y = attend(&mut tape, [&x[0], &x[1], &x[2], &of_keys], causal);
        let is_zero = |row: &[f64]| row.iter().all(|x| *x == 0.0);
        let rows: Vec<bool> = y.data().chunks(6).map(is_zero).collect();
        let wanted: Vec<bool> = (0..8).map(|row| row < 4 + n_blind).collect();
        assert_eq!(rows, wanted, "tape, causal {causal}");

        let ones = tape.constant(y.shape(), &vec![1.0; y.len()]);
        let shown = y.clone();
        let found = tape.backward_from(y, ones, &mut Gradients::new(&parameters)).expect("finite");
        let gradients = x.each_ref().map(|x| found.of(x).expect("a gradient").data().to_vec());
        assert!(is_zero(&gradients[0][..(4 + n_blind) * 6]), "of queries, causal {causal}");
        for gradient in &gradients[1..] {
            // Keys of the first sample, and the masked ones of the second.
            assert!(is_zero(&gradient[..7 * 6]), "of keys and values, causal {causal}");
        }
        assert!(!is_zero(&gradients[2][7 * 6..]));

        let mut eager = Eager::new(&parameters, &arena);
        let x = [0, 1, 2].map(|k| eager.input(shapes[k], &values[k]));
        let of_keys = eager.constant(&[2, 5], &mask);
        let y = attend(&mut eager, [&x[0], &x[1], &x[2], &of_keys], causal);
        assert_eq!(y.data(), shown.data(), "eager, causal {causal}");

        // An outline has no numbers: a mask changes neither shapes nor costs.
        let mut outline = Outline::new(parameters.list());
        let x = shapes.map(|shape| outline.input(shape));
        let of_keys = outline.input(&[2, 5]);
        let shape = attend(&mut outline, [&x[0], &x[1], &x[2], &of_keys], causal);
        assert_eq!(shape, shown.shape(), "outline, causal {causal}");
    }
}

#[test]
fn activations_are_pytorchs() {
    for (case, activation) in [("gelu", Activation::Gelu), ("mish", Activation::Mish)] {
        check(case, &["x"], &[], |g, x, _| g.activation(&x[0], activation));
    }
}

#[test]
fn losses_are_pytorchs() {
    check("cross_entropy", &["x", "label"], &[], |g, x, _| {
        g.apply(CrossEntropy::default(), &[&x[0], &x[1]])
    });
    for (case, cost) in
        [("smooth_l1", Cost::SmoothL1 { beta: 1.0 }), ("huber", Cost::Huber { delta: 0.5 })]
    {
        check(case, &["x", "target"], &[], |g, x, _| g.apply(Loss::new(cost), &[&x[0], &x[1]]));
    }
}

#[test]
fn embedding_is_pytorchs() {
    check("embedding", &["index"], &[("weight", Role::Table)], |g, x, p| g.embedding(p[0], &x[0]));
}

#[test]
fn the_golden_operations_are_those_that_the_tests_above_name() {
    let golden = Golden::open("ops.safetensors");
    let found: BTreeSet<_> = golden.names().filter_map(|name| name.split('/').next()).collect();
    let checked = [
        "attention_causal",
        "attention_key_mask",
        "conv1d_dilation3",
        "conv1d_stride2",
        "cross_entropy",
        "embedding",
        "gelu",
        "group_norm",
        "group_norm_film_silu",
        "huber",
        "layer_norm",
        "mish",
        "smooth_l1",
    ];
    assert_eq!(found, BTreeSet::from(checked), "add a test for what is new");
}
