//! Every operation's gradient against central differences, in f64, on odd and unequal shapes.
//!
//! The scalar is Σ probe · y, so that each number of the result counts differently. Steps of 1e-5 leave
//! an error of about 1e-10 from the third derivative and 1e-11 from rounding, relative to values of
//! order one; 1e-6 of the largest gradient is a hundred times what both give together. Gradients that are
//! all smaller than 1e-3 (zero, where one key takes all attention) are held to 1e-9.

mod rows;

use std::sync::Arc;

use ndarray::Array2;
use proptest::prelude::*;

use super::op::binary::{AddToFrames, Binary, Pair};
use super::op::dancers::TakeSamples;
use super::op::elementwise::{Function, Map};
use super::op::frames::TakeFrames;
use super::op::loss::{Cost, Loss};
use super::op::matmul::BatchProduct;
use super::op::reduce::{Over, Reduce};
use super::op::shape::{Reshape, Transpose};
use super::op::softmax::{CrossEntropy, Softmax};
use super::*;
use crate::model::{
    Activation, Attention, Channels, Convolution, Graph, GroupNormalization, Init, Mirror,
    ParameterId, ParameterList, Result, Role, Scope,
};

const STEP: f64 = 1e-5;
const TOLERANCE: f64 = 1e-6;
/// Dropout draws the same numbers each time.
const SEED: Option<u64> = Some(5);

type T = Tensor<f64>;

/// An input: its shape, its values, and whether its gradient is checked.
struct Input {
    shape: Vec<usize>,
    values: Vec<f64>,
    differentiate: bool,
}

fn numbers(n: usize, seed: u64) -> Vec<f64> {
    let mut values = vec![0.0; n];
    Stream::new(seed, 7).uniform(0, &mut values);
    values.iter().map(|x| 2.0 * x - 1.0).collect()
}

fn input(shape: &[usize], seed: u64) -> Input {
    let n = shape.iter().product();
    Input { shape: shape.to_vec(), values: numbers(n, seed), differentiate: true }
}

fn fixed(shape: &[usize], values: Vec<f64>) -> Input {
    Input { shape: shape.to_vec(), values, differentiate: false }
}

/// Parameters of given shapes, filled with numbers that look random.
fn parameters(specs: &[(&str, &[usize], Role)]) -> (Parameters<f64>, Vec<ParameterId>) {
    let mut list = ParameterList::default();
    let mut scope = Scope::root(&mut list);
    let ids =
        specs.iter().map(|(name, shape, role)| scope.parameter(name, shape, Init::Zeros, *role));
    let ids = ids.collect();
    (Parameters::from_fn(list, |p| numbers(p.len(), p.name.len() as u64 + 100)), ids)
}

fn probe<G: Interpreter<Element = f64>>(g: &mut G, y: &T, probe: &T) -> Result<T> {
    let y = g.apply(Binary::new(Pair::Multiply), &[y, probe])?;
    g.apply(Reduce::sum(Over::All), &[&y])
}

/// Runs `f` on a tape, with one number of one input changed, down to the scalar.
fn begin(
    tape: &mut Tape<f64>,
    inputs: &[Input],
    f: &impl Fn(&mut Tape<f64>, &[T]) -> Result<T>,
    changed: Option<(usize, usize, f64)>,
) -> (Vec<T>, T) {
    let mut tensors = Vec::new();
    for (i, input) in inputs.iter().enumerate() {
        let mut values = input.values.clone();
        match changed {
            Some((which, at, by)) if which == i => values[at] += by,
            _ => {}
        }
        tensors.push(if input.differentiate {
            tape.input(&input.shape, &values)
        } else {
            tape.constant(&input.shape, &values)
        });
    }
    let y = f(tape, &tensors).expect("shapes fit");
    let weights = tape.constant(y.shape(), &numbers(y.len(), 99));
    let scalar = probe(tape, &y, &weights).expect("shapes fit");
    (tensors, scalar)
}

/// Some channels of a tensor.
fn part(tensor: &T, first: usize) -> Channels<'_, T> {
    Channels { tensor, first }
}

/// Checks all gradients of `f` with respect to its inputs and to all parameters.
fn check(
    inputs: &[Input],
    parameters: &Parameters<f64>,
    f: impl Fn(&mut Tape<f64>, &[T]) -> Result<T>,
) {
    let arena = Arena::default();
    let slope = |plus: f64, minus: f64| (plus - minus) / (2.0 * STEP);

    let mut gradients = Gradients::new(parameters);
    let mut tape = Tape::new(parameters, &arena, SEED);
    let (tensors, scalar) = begin(&mut tape, inputs, &f, None);
    let found = tape.backward(scalar, &mut gradients).expect("finite");
    for (i, input) in inputs.iter().enumerate().filter(|(_, input)| input.differentiate) {
        let wanted: Vec<_> = (0..input.values.len())
            .map(|at| {
                let value = |by| {
                    let mut tape = Tape::new(parameters, &arena, SEED);
                    begin(&mut tape, inputs, &f, Some((i, at, by))).1.scalar()
                };
                slope(value(STEP), value(-STEP))
            })
            .collect();
        let got = found.of(&tensors[i]).expect("the result depends on it");
        assert_near(got.data(), &wanted, &format!("input {i}, {:?}", input.shape));
    }
    for (id, parameter) in parameters.list().iter() {
        let values = parameters.unpacked(id);
        let wanted: Vec<_> = (0..values.len())
            .map(|at| {
                let value = |by| {
                    let mut values = values.clone();
                    values[at] += by;
                    let mut changed = parameters.clone();
                    let plan = std::sync::Arc::clone(changed.plan());
                    plan.pack(id, &values, changed.all_mut());
                    let mut tape = Tape::new(&changed, &arena, SEED);
                    begin(&mut tape, inputs, &f, None).1.scalar()
                };
                slope(value(STEP), value(-STEP))
            })
            .collect();
        assert_near(&gradients.unpacked(id), &wanted, &parameter.name);
    }
}

fn assert_near(got: &[f64], wanted: &[f64], what: &str) {
    let scale = wanted.iter().fold(1e-3_f64, |a, x| a.max(x.abs()));
    for (i, (got, wanted)) in got.iter().zip(wanted).enumerate() {
        let near = (got - wanted).abs() <= TOLERANCE * scale;
        assert!(near, "gradient of {what} at {i}: got {got}, wanted {wanted}");
    }
    assert_eq!(got.len(), wanted.len(), "gradient of {what}");
}

fn none() -> Parameters<f64> {
    parameters(&[]).0
}

/// Few cases: each takes two forwards per number.
fn config() -> ProptestConfig {
    ProptestConfig { cases: 6, failure_persistence: None, ..ProptestConfig::default() }
}

proptest! {
    #![proptest_config(config())]

    #[test]
    fn linear_and_conv1d(
        batch in 1..3_usize, frames in 5..9_usize, inputs in 1..6_usize, outputs in 1..20_usize,
        taps in 1..5_usize, stride in 1..4_usize, padding in 0..3_usize, dilation in 1..3_usize,
    ) {
        let taps = if dilation * (taps - 1) < frames + 2 * padding { taps } else { 1 };
        let shape = [outputs, inputs, taps];
        let (p, ids) = parameters(&[("w", &shape, Role::Weight), ("bias", &[outputs], Role::Vector)]);
        let convolution = Convolution { taps, stride, padding, dilation };
        check(&[input(&[batch, frames, inputs], 1)], &p, |g, x| {
            g.conv1d(&x[0], ids[0], Some(ids[1]), convolution)
        });
        let (p, ids) = parameters(&[("w", &[outputs, inputs], Role::Weight)]);
        check(&[input(&[batch, frames, inputs], 1)], &p, |g, x| g.linear(&x[0], ids[0], None));
    }

    #[test]
    fn norms(batch in 1..4_usize, frames in 2..8_usize, groups in 1..4_usize, width in 1..4_usize) {
        let channels = groups * width;
        let specs: [(&str, &[usize], Role); 2] =
            [("gamma", &[channels], Role::Vector), ("beta_", &[channels], Role::Vector)];
        let (p, ids) = parameters(&specs);
        let norm = GroupNormalization { groups, epsilon: 1e-2, weight: ids[0], bias: ids[1] };
        let x = || input(&[batch, frames, channels], 1);
        for activation in [Activation::Identity, Activation::Silu, Activation::Tanh] {
            check(&[x()], &p, |g, x| g.group_norm(&x[0], norm, None, activation));
            check(&[x(), input(&[batch, 2 * channels], 2)], &p, |g, x| {
                g.group_norm(&x[0], norm, Some(&x[1]), activation)
            });
        }
        check(&[x()], &p, |g, x| g.layer_norm(&x[0], Some([ids[0], ids[1]]), 1e-2));
        check(&[x()], &none(), |g, x| g.layer_norm(&x[0], None, 1e-2));
    }

    #[test]
    fn attention(
        batch in 1..3_usize, queries in 1..5_usize, keys in 1..6_usize, heads in 1..3_usize,
        dim in 1..5_usize, causal: bool,
    ) {
        let width = heads * dim;
        let mask: Vec<_> = (0..batch * keys).map(|i| f64::from(i % 3 != 1)).collect();
        let cross = [
            input(&[batch, queries, width], 1),
            input(&[batch, keys, 2 * width + 1], 2),
            fixed(&[batch, keys], mask),
        ];
        check(&cross, &none(), |g, x| {
            let key_mask = Some(&x[2]);
            let [query, key, value] = [part(&x[0], 0), part(&x[1], 0), part(&x[1], width)];
            g.attention(Attention { query, key, value, width, heads, key_mask, causal })
        });
        check(&[input(&[batch, keys, 3 * width], 3)], &none(), |g, x| {
            let [query, key, value] = [0, 1, 2].map(|i| part(&x[0], i * width));
            g.attention(Attention { query, key, value, width, heads, key_mask: None, causal })
        });
    }

    #[test]
    fn pairs_of_tensors(batch in 1..4_usize, frames in 1..5_usize, channels in 1..5_usize) {
        let a = || input(&[batch, frames, channels], 1);
        for pair in [Pair::Add, Pair::Subtract, Pair::Multiply] {
            for shape in [&[batch, frames, channels][..], &[batch, 1, channels], &[channels], &[frames, 1]] {
                check(&[a(), input(shape, 2)], &none(), |g, x| {
                    g.apply(Binary::new(pair), &[&x[0], &x[1]])
                });
                check(&[input(shape, 2), a()], &none(), |g, x| {
                    g.apply(Binary::new(pair), &[&x[0], &x[1]])
                });
            }
        }
        check(&[a(), input(&[batch, channels], 3)], &none(), |g, x| {
            g.apply(AddToFrames::default(), &[&x[0], &x[1]])
        });
        check(&[a(), input(&[batch, frames, 3], 4)], &none(), |g, x| g.concat(&[&x[0], &x[1], &x[0]]));
        check(&[a(), input(&[batch, channels, 4], 5)], &none(), |g, x| {
            g.apply(BatchProduct::default(), &[&x[0], &x[1]])
        });
    }

    #[test]
    fn changes_of_shape(batch in 1..3_usize, frames in 1..6_usize, channels in 2..6_usize) {
        let x = || input(&[batch, frames, channels], 1);
        check(&[x()], &none(), |g, x| g.channels(&x[0], 1..channels));
        check(&[x()], &none(), |g, x| g.upsample(&x[0], 2));
        check(&[x()], &none(), |g, x| {
            // Frames that are taken twice gather the gradients of both.
            let held = g.hold_frames(&x[0], 2)?;
            let head = g.apply(TakeFrames::inner(0, 1), &[&held])?;
            let tail = g.apply(TakeFrames::inner(1, 0), &[&held])?;
            g.mul(&head, &tail)
        });
        check(&[x()], &none(), |g, x| g.hold_frames(&x[0], 4));
        for (shift, spare) in [(0, 1), (1, 0), (-2, 0), (2, 3)] {
            check(&[x()], &none(), |g, x| g.shift_frames(&x[0], shift, spare));
        }
        let other = |seed| input(&[batch, frames, channels], seed);
        check(&[x(), other(2), other(3)], &none(), |g, x| g.replace_ends(&x[0], &x[1], &x[2]));
        let kernel = std::sync::Arc::new(ndarray::Array2::from_shape_fn((channels, 5), |(c, j)| {
            0.3 * c as f64 - 0.2 * j as f64 + 0.1
        }));
        for mirror in [Mirror::Even, Mirror::Odd] {
            check(&[x()], &none(), |g, x| g.filter_frames(&x[0], &kernel, mirror));
        }
        check(&[x(), fixed(&[batch, 1, 2], vec![0.0; 2 * batch])], &none(), |g, x| {
            g.crop_frames(&x[0], &x[1])
        });
        check(&[x()], &none(), |g, x| {
            g.apply(Reshape::new(&[frames, batch * channels]), &[&x[0]])
        });
        check(&[x()], &none(), |g, x| g.apply(Transpose::new(&[2, 0, 1]), &[&x[0]]));
        for over in [Over::All, Over::Axis(0), Over::Axis(1), Over::Axis(2)] {
            check(&[x()], &none(), |g, x| g.apply(Reduce::sum(over), &[&x[0]]));
            check(&[x()], &none(), |g, x| g.apply(Reduce::mean(over), &[&x[0]]));
        }
        check(&[input(&[batch, frames, 2 * channels], 2)], &none(), |g, x| g.rotary(&x[0], channels, None));
        check(&[input(&[batch, frames, 4 * channels], 2)], &none(), |g, x| g.rotary(&x[0], channels, None));
        let past = || fixed(&[batch, 3, 1], vec![0.0; 3 * batch]);
        check(&[input(&[batch, frames, 4 * channels], 2), past()], &none(), |g, x| {
            g.rotary(&x[0], channels, Some(&x[1]))
        });
        check(&[input(&[batch, frames + 3, channels], 3), past()], &none(), |g, x| {
            g.frames_behind(&x[0], &x[1])
        });
    }

    #[test]
    fn dancers_and_tokens(
        batch in 1..3_usize, n_dancers in 1..4_usize, frames in 1..5_usize, channels in 1..4_usize,
    ) {
        let rows = batch * n_dancers;
        let x = || input(&[rows, frames, channels], 1);
        let like = || fixed(&[batch], vec![0.0; batch]);
        check(&[x(), like()], &none(), |g, x| g.rebatch(&x[0], &x[1]));
        check(&[x(), like()], &none(), |g, x| g.mean_dancers(&x[0], &x[1], None));
        check(&[input(&[batch, channels], 6)], &none(), |g, x| g.mean_channels(&x[0]));
        let mut there = vec![1.0; rows];
        (1..rows).step_by(3).for_each(|row| there[row] = 0.0);
        let there = fixed(&[batch, n_dancers], there);
        check(&[x(), like(), there], &none(), |g, x| g.mean_dancers(&x[0], &x[1], Some(&x[2])));
        check(&[input(&[batch, frames, channels], 2), x()], &none(), |g, x| {
            let repeated = g.repeat_batch(&x[0], &x[1])?;
            g.mul(&repeated, &x[1])
        });
        check(&[input(&[batch, channels], 3), fixed(&[rows, 1], vec![0.0; rows])], &none(), |g, x| {
            g.repeat_batch(&x[0], &x[1])
        });
        check(&[x(), input(&[rows, channels], 4), input(&[rows, 2, channels], 5)], &none(), |g, x| {
            let joined = g.concat_frames(&[&x[1], &x[0], &x[2], &x[1]])?;
            let head = g.frames(&joined, 0, Some(frames + 1))?;
            let tail = g.frames(&joined, 3, None)?;
            g.mul(&head, &tail)
        });
        let mask: Vec<_> = (0..rows * frames).map(|i| [1.0, 0.0, 1.0, 2.5][i % 4]).collect();
        let mask = || fixed(&[rows, frames], mask.clone());
        check(&[x()], &none(), |g, x| {
            g.apply(TakeSamples::new(vec![rows - 1, 0, rows - 1]), &[&x[0]])
        });
        for bias in [0.0, 1.0] {
            check(&[x(), input(&[rows, 2 * channels], 6)], &none(), |g, x| {
                g.modulate(&x[0], &x[1], bias)
            });
            check(&[x(), input(&[rows, frames, 2 * channels], 6)], &none(), |g, x| {
                g.modulate(&x[0], &x[1], bias)
            });
        }
        check(&[x(), mask()], &none(), |g, x| g.normalize_frames(&x[0], Some(&x[1]), 1e-2));
        check(&[x()], &none(), |g, x| g.normalize_frames(&x[0], None, 1e-2));
        check(&[x(), mask()], &none(), |g, x| g.mean_frames(&x[0], Some(&x[1])));
        check(&[x()], &none(), |g, x| g.mean_frames(&x[0], None));
        check(&[input(&[rows, frames + 2, channels], 7), mask()], &none(), |g, x| {
            let mask = g.token_mask(&x[1], 2)?;
            g.mean_frames(&x[0], Some(&mask))
        });
    }

    #[test]
    fn functions_of_one_number(rows in 1..4_usize, channels in 1..7_usize) {
        // Away from zero, where |x|, ReLU and the clamp have corners.
        let mut x = input(&[rows, channels], 1);
        x.values.iter_mut().for_each(|x| *x = 2.0 * *x + 0.3 * x.signum());
        let again = || Input { shape: x.shape.clone(), values: x.values.clone(), differentiate: true };
        for activation in [
            Activation::Identity, Activation::Silu, Activation::Gelu, Activation::Relu,
            Activation::LeakyRelu { slope: 0.2 }, Activation::Mish, Activation::Tanh,
            Activation::Sigmoid,
        ] {
            check(&[again()], &none(), |g, x| g.activation(&x[0], activation));
        }
        for function in [
            Function::Affine { scale: -1.5, shift: 0.5 }, Function::Exp, Function::Square,
            Function::Abs, Function::Clamp { low: -0.2, high: 0.25 },
        ] {
            check(&[again()], &none(), |g, x| g.apply(Map::new(function), &[&x[0]]));
        }
        for function in [Function::Ln, Function::Sqrt] {
            check(&[again()], &none(), |g, x| {
                let positive = g.apply(Map::new(Function::Square), &[&x[0]])?;
                g.apply(Map::new(function), &[&positive])
            });
        }
        check(&[again()], &none(), |g, x| g.normalize(&x[0], 1e-12));
        check(&[again()], &none(), |g, x| g.normalize(&x[0], 100.0));
        check(&[again()], &none(), |g, x| g.apply(Softmax::default(), &[&x[0]]));
        check(&[again()], &none(), |g, x| g.dropout(&x[0], 0.3));
    }

    #[test]
    fn losses(batch in 1..3_usize, frames in 1..5_usize, channels in 1..5_usize) {
        let p = || input(&[batch, frames, channels], 1);
        let t = || input(&[batch, frames, channels], 2);
        let weights: Vec<_> = (0..batch * frames).map(|i| [1.0, 0.0, 2.5][i % 3]).collect();
        let w = || fixed(&[batch, frames], weights.clone());
        for cost in [
            Cost::Squared, Cost::Absolute, Cost::Huber { delta: 0.4 }, Cost::SmoothL1 { beta: 0.3 },
        ] {
            check(&[p(), t()], &none(), |g, x| g.apply(Loss::new(cost), &[&x[0], &x[1]]));
            check(&[p(), t(), w()], &none(), |g, x| {
                g.apply(Loss::new(cost), &[&x[0], &x[1], &x[2]])
            });
        }
        let labels: Vec<_> = (0..batch * frames).map(|i| (i % channels) as f64).collect();
        let labels = || fixed(&[batch, frames], labels.clone());
        check(&[p(), labels()], &none(), |g, x| g.apply(CrossEntropy::default(), &[&x[0], &x[1]]));
        check(&[p(), labels(), w()], &none(), |g, x| {
            g.apply(CrossEntropy::default(), &[&x[0], &x[1], &x[2]])
        });
    }

    #[test]
    fn lookups_and_choices(batch in 1..4_usize, frames in 1..4_usize, channels in 1..5_usize) {
        let (p, ids) =
            parameters(&[("table", &[5, channels], Role::Table), ("n", &[channels], Role::Vector)]);
        let index: Vec<_> = (0..batch * frames).map(|i| [4.0, 1.0, 4.0][i % 3]).collect();
        let choice: Vec<_> = (0..batch).map(|b| (b % 2) as f64).collect();
        let inputs = [
            input(&[batch, frames, channels], 1),
            fixed(&[batch, frames], index),
            fixed(&[batch], choice),
        ];
        check(&inputs, &p, |g, x| {
            let null = g.parameter(ids[1])?;
            let y = g.select(&x[2], &null, &x[0])?;
            let rows = g.embedding(ids[0], &x[1])?;
            g.mul(&y, &rows)
        });
    }

    #[test]
    fn a_part_that_is_run_again_has_the_same_gradients(frames in 1..5_usize, channels in 1..5_usize) {
        let (p, ids) =
            parameters(&[("w", &[channels, channels, 3], Role::Weight), ("b", &[channels], Role::Vector)]);
        let convolution = Convolution { taps: 3, stride: 1, padding: 1, dilation: 1 };
        let (w, b) = (ids[0], ids[1]);
        check(&[input(&[2, frames, channels], 1), input(&[2, frames, channels], 2)], &p, |g, x| {
            g.checkpoint(&[&x[0], &x[1]], move |g, x| {
                let y = g.conv1d(&x[0], w, Some(b), convolution)?;
                let y = g.dropout(&y, 0.3)?;
                let y = g.activation(&y, Activation::Silu)?;
                g.mul(&y, &x[1])
            })
        });
    }
}

#[test]
fn dancers_are_folded_without_moving_a_number_and_refused_where_they_do_not_fit() {
    let p = none();
    let arena = Arena::default();
    let mut g = Eager::new(&p, &arena);
    let values: Vec<f64> = (0..12).map(f64::from).collect();
    let x = g.input(&[6, 2, 1], &values);
    let [two, four] = [2, 4].map(|n| g.input(&[n], &vec![0.0; n]));
    let y = g.rebatch(&x, &two).expect("shapes fit");
    assert_eq!((y.shape(), y.data()), (&[2, 6, 1][..], &values[..]));
    let back = g.rebatch(&y, &x).expect("shapes fit");
    assert_eq!((back.shape(), back.data()), (&[6, 2, 1][..], &values[..]));
    // Groups of 3: dancers 0 to 2 and 3 to 5, of whom 1 is not there, and nobody of a third mask.
    let there = g.input(&[2, 3], &[1.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
    let mean = g.mean_dancers(&x, &two, Some(&there)).expect("shapes fit");
    assert_eq!(mean.shape(), [2, 2, 1]);
    let all = g.mean_dancers(&x, &two, None).expect("shapes fit");
    for (found, expected) in
        mean.data().iter().chain(all.data()).zip([2.0, 3.0, 8.0, 9.0].repeat(2))
    {
        // Thirds are rounded.
        assert!((found - expected).abs() < 1e-14 * expected, "{found}, {expected}");
    }
    let nobody = g.input(&[2, 3], &[0.0; 6]);
    let mean = g.mean_dancers(&x, &two, Some(&nobody)).expect("shapes fit");
    assert_eq!(mean.data(), &[0.0; 4]);
    assert_eq!(
        g.mean_dancers(&x, &four, None).expect_err("4 does not divide 6").to_string(),
        "mean_dancers: 6 dancers cannot be split into 4 groups alike"
    );
    assert_eq!(
        g.mean_dancers(&x, &two, Some(&four)).expect_err("another mask").to_string(),
        "mean_dancers: mask has shape [4], input expects [2, 3]"
    );
    let five = g.input(&[5], &[0.0; 5]);
    assert_eq!(
        g.rebatch(&x, &five).expect_err("5 does not divide 12").to_string(),
        "rebatch: 6 × 2 frames cannot be split into 5 samples alike"
    );
    assert_eq!(
        g.repeat_batch(&four, &x).expect_err("4 does not divide 6").to_string(),
        "repeat_batch: 4 samples cannot be repeated to 6"
    );
    let z = g.input(&[2, 3, 1], &[0.0; 6]);
    assert_eq!(
        g.concat_frames(&[&x, &z]).expect_err("other batches").to_string(),
        "concat_frames: shapes [6, 2, 1] and [2, 3, 1] differ in batch or channels"
    );
    assert_eq!(
        g.frames(&x, 1, Some(2)).expect_err("there are two").to_string(),
        "frames: input has 2 frames, 2 from frame 1 on asked for"
    );
    let mask = g.input(&[2, 2], &[1.0; 4]);
    assert_eq!(
        g.mean_frames(&z, Some(&mask)).expect_err("another mask").to_string(),
        "mean_frames: mask has shape [2, 2], input expects [2, 3]"
    );
    let film = g.input(&[2, 1], &[1.0; 2]);
    assert_eq!(
        g.modulate(&z, &film, 1.0).expect_err("half a scale").to_string(),
        "modulate: scale and shift have shape [2, 1], input expects [2, 2]"
    );
}
