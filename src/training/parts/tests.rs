//! Gradients and steps of 1, 2, 3, 4 and 6 processes, threads in their place, against those of one that adds up by itself.

use std::sync::Arc;

use super::*;
use crate::autodiff::op::reduce::{Over, Reduce};
use crate::autodiff::{Interpreter as _, SHARD_CHUNK};
use crate::model::{Activation, Graph as _, Init, ParameterList, Role, Scope};
use crate::training::averaged::NetworkState;
use crate::training::config::OptimizerConfig;
use crate::training::ema::EmaConfig;
use crate::training::learner::CheckpointState as _;
use crate::training::ranks::{EXCHANGED_CHUNKS, together};

/// Windows of a batch and numbers of each.
const N: usize = 13;
const WIDTH: usize = 24;
/// Wide enough that a gradient takes two exchanges, the second of them short.
const HIDDEN: usize = 1200;

/// Four layers, of which the second is run again for its gradient and serves twice, and a vector that plays no part.
///
/// It lies first, so that the numbers before the middle of the second layer leave at the end alone, and those behind it as
/// soon as that layer has been passed for the second time.
fn network() -> (ParameterList, [ParameterId; 8]) {
    let mut list = ParameterList::default();
    let mut root = Scope::root(&mut list);
    let mut weight = |name: &str, shape: &[usize], role| {
        root.parameter(name, shape, Init::Uniform { bound: 0.05 }, role)
    };
    weight("idle", &[40], Role::Vector);
    let ids = [
        weight("first.weight", &[HIDDEN, WIDTH], Role::Weight),
        weight("first.bias", &[HIDDEN], Role::Vector),
        weight("third.weight", &[HIDDEN, HIDDEN], Role::Weight),
        weight("third.bias", &[HIDDEN], Role::Vector),
        weight("second.weight", &[HIDDEN, HIDDEN], Role::Weight),
        weight("second.bias", &[HIDDEN], Role::Vector),
        weight("last.weight", &[1, HIDDEN], Role::Weight),
        weight("last.bias", &[1], Role::Vector),
    ];
    (list, ids)
}

fn windows() -> Vec<f32> {
    (0..N * WIDTH).map(|i| (i as f32 * 0.37).sin()).collect()
}

/// Computes the gradient of a batch; returns the values that parts found, in order of parts.
fn differentiate(
    parts: &mut Parts,
    parameters: &Parameters<f32>,
    ids: [ParameterId; 8],
) -> Vec<f64> {
    let x = windows();
    let n_parts = parts.number(N);
    let at = |part: usize| part * N / n_parts;
    let weights = parts.weights(n_parts, |part| (at(part + 1) - at(part)) as f64).expect("all");
    assert_eq!(weights.iter().sum::<f64>(), N as f64);
    let found = parts
        .differentiate(n_parts, |part| {
            let number = part.number;
            let (first, end) = (at(number), at(number + 1));
            let mut tape = Tape::new(parameters, part.arena, Some(number as u64));
            let [w1, b1, w3, b3, w2, b2, w4, b4] = ids;
            let x = tape.constant(&[end - first, WIDTH], &x[first * WIDTH..end * WIDTH]);
            let h = tape.linear(&x, w1, Some(b1))?;
            let mut h = tape.activation(&h, Activation::Silu)?;
            for _ in 0..2 {
                h = tape.run_part(&[&h], move |g, x| {
                    let h = g.linear(&x[0], w2, Some(b2))?;
                    g.activation(&h, Activation::Silu)
                })?;
            }
            let h = tape.linear(&h, w3, Some(b3))?;
            let h = tape.activation(&h, Activation::Silu)?;
            let y = tape.linear(&h, w4, Some(b4))?;
            let y = tape.mul(&y, &y)?;
            let loss = tape.apply(Reduce::mean(Over::All), &[&y])?;
            let value = f64::from(loss.scalar());
            part.backward(tape, loss, weights[number] / N as f64)?;
            Ok(vec![value])
        })
        .expect("shapes fit");
    parts.of_all(n_parts, found).expect("all").into_iter().flatten().collect()
}

/// What one process has after some steps: values of parts, norms of gradients, and the bits of weights, average and
/// moments.
type TrainedNumbers = (Vec<f64>, Vec<f64>, Vec<Vec<u32>>);

fn train(ranks: &Arc<Ranks>, (accumulate, side_by_side): (usize, usize)) -> TrainedNumbers {
    let (list, ids) = network();
    let parameters = Parameters::<f32>::new(list, 7);
    let mut parts = Parts::new(&parameters, accumulate, side_by_side);
    parts.among(ranks).expect("shared out evenly");
    let ema = EmaConfig { decay: 0.9, every: 2 };
    let mut network = NetworkState::new("x.", parameters, &OptimizerConfig::default(), ema);
    network.among(ranks);
    let (mut values, mut norms) = (Vec::new(), Vec::new());
    for step in 0..3 {
        values = differentiate(&mut parts, network.live(), ids);
        let loss = values.iter().sum();
        norms.push(network.step(parts.gradients(), loss, 1e-2, step).expect("all"));
        // As a checkpoint does, after which training goes on.
        network.collect().expect("all");
        network.release();
    }
    network.collect().expect("all");
    let bits = |values: &[f32]| values.iter().map(|x| x.to_bits()).collect();
    let sections = network.sections();
    (values, norms, sections.iter().map(|section| bits(section.values)).collect())
}

#[test]
fn any_number_of_processes_ends_with_the_same_bits() {
    let n = Parameters::<f32>::new(network().0, 7).plan().len();
    assert!(n > EXCHANGED_CHUNKS * SHARD_CHUNK && !n.is_multiple_of(SHARD_CHUNK), "{n}");
    for (plan, sizes) in [((1, 2), &[2][..]), ((2, 6), &[3, 6]), ((9, 2), &[2])] {
        let alone = train(&Ranks::alone(), plan);
        assert!(alone.1.iter().all(|norm| *norm > 0.0));
        for &size in sizes {
            let found = together(size, |ranks| train(&ranks, plan));
            for (rank, (values, norms, bits)) in found.into_iter().enumerate() {
                let which = format!("{plan:?}, rank {rank} of {size}");
                assert_eq!(values, alone.0, "{which}");
                assert_eq!(norms, alone.1, "{which}");
                assert!(bits[0] == alone.2[0], "weights, {which}");
                if rank == 0 {
                    assert!(bits == alone.2, "average and moments, {which}");
                }
            }
        }
    }
}

#[test]
fn what_processes_give_each_other_grows_with_steps_alone() {
    let (list, ids) = network();
    let n = Parameters::<f32>::new(list, 7).plan().len();
    let n_pieces = n.div_ceil(EXCHANGED_CHUNKS * SHARD_CHUNK);
    for (side_by_side, size) in [(2, 2), (6, 3)] {
        let found = together(size, |ranks| {
            let (list, _) = network();
            let parameters = Parameters::<f32>::new(list, 7);
            let mut parts = Parts::new(&parameters, 1, side_by_side);
            parts.among(&ranks).expect("shared out evenly");
            let (optimizer, ema) = (OptimizerConfig::default(), EmaConfig { decay: 0.9, every: 1 });
            let mut network = NetworkState::new("x.", parameters, &optimizer, ema);
            network.among(&ranks);
            let mut after = |n_steps: u64| {
                for step in 0..n_steps {
                    differentiate(&mut parts, network.live(), ids);
                    network.step(parts.gradients(), 1.0, 1e-2, step).expect("all");
                }
                ranks.traffic()
            };
            [after(0), after(3), after(6)]
        });
        let mut n_given = 0;
        for [none, three, nine] in found {
            assert_eq!((none.n_exchanges, none.n_numbers), (0, 0));
            // A step's: the pieces of gradient and weights, the weights of parts, the norm, and the losses.
            assert_eq!(three.n_exchanges, 3 * (2 * n_pieces + 3));
            assert_eq!(nine.n_exchanges, 3 * three.n_exchanges);
            assert_eq!(nine.n_numbers, 3 * three.n_numbers);
            n_given += three.n_numbers;
        }
        // Together they send each gradient but the share of the one that has it, and the new weights to all others.
        assert_eq!(n_given, 3 * n * (side_by_side * (size - 1) / size + size - 1));
    }
}

#[test]
fn a_process_keeps_its_share_of_the_moments_alone() {
    let found = together(2, |ranks| {
        let (list, ids) = network();
        let parameters = Parameters::<f32>::new(list, 7);
        let mut parts = Parts::new(&parameters, 1, 2);
        parts.among(&ranks).expect("shared out evenly");
        let (optimizer, ema) = (OptimizerConfig::default(), EmaConfig { decay: 0.9, every: 1 });
        let mut network = NetworkState::new("x.", parameters, &optimizer, ema);
        network.among(&ranks);
        for step in 0..2 {
            differentiate(&mut parts, network.live(), ids);
            network.step(parts.gradients(), 1.0, 1e-2, step).expect("all");
            network.collect().expect("all");
            network.release();
        }
        let (shard, sections) = (ranks.shard(), network.sections());
        let m = sections[2].values;
        let strange = (0..m.len().div_ceil(SHARD_CHUNK)).filter(|&chunk| !shard.owns(chunk));
        let zero =
            |chunk| m[crate::autodiff::chunk_range(chunk, m.len())].iter().all(|&x| x == 0.0);
        (strange.clone().count(), strange.filter(|&chunk| zero(chunk)).count())
    });
    for (n_strange, n_zero) in found {
        assert!(n_strange > 15 && n_strange == n_zero, "{n_zero} of {n_strange} chunks are zero");
    }
}

#[test]
fn parts_that_cannot_be_shared_out_are_refused_in_a_sentence() {
    let (list, _) = network();
    let parameters = Parameters::<f32>::new(list, 7);
    let found = together(3, |ranks| {
        Parts::new(&parameters, 1, 4).among(&ranks).map_err(|error| error.to_string())
    });
    let sentence = "--side-by-side 4 parts of a batch cannot be shared out among 3 ranks; give --side-by-side 6 (it is a \
                    part of the run: a run that was begun with 4 goes on with 4)";
    assert_eq!(found, vec![Err(sentence.to_owned()); 3]);
}

#[test]
fn windows_belong_to_the_process_that_learns_from_them_and_to_no_other() {
    for (n, accumulate, side_by_side, size) in
        [(13, 1, 2, 2), (13, 2, 6, 3), (4, 1, 6, 6), (5, 3, 4, 2)]
    {
        let (list, _) = network();
        let parameters = Parameters::<f32>::new(list, 7);
        let found = together(size, |ranks| {
            let mut parts = Parts::new(&parameters, accumulate, side_by_side);
            parts.among(&ranks).expect("shared out evenly");
            parts.ownership(1)(&vec![1; n])
        });
        for window in 0..n {
            let n_owners = found.iter().filter(|owned| owned[window]).count();
            assert_eq!(n_owners, 1, "window {window} of {n}, {size} processes");
        }
    }
}
