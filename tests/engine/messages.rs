//! What is said where sizes do not fit, or numbers are not finite.

use motiongen::autodiff::op::binary::{Binary, Pair};
use motiongen::autodiff::op::elementwise::{Function, Map};
use motiongen::autodiff::op::loss::{Cost, Loss};
use motiongen::autodiff::op::matmul::BatchProduct;
use motiongen::autodiff::op::shape::{Reshape, Transpose};
use motiongen::autodiff::op::softmax::{CrossEntropy, Softmax};
use motiongen::autodiff::{Arena, Eager, Gradients, Interpreter, Parameters, Tape, Tensor};
use motiongen::model::{
    Activation, Attention, Channels, Convolution, Graph, GroupNormalization, Init, ParameterId,
    ParameterList, Result, Role, Scope,
};

fn network() -> (Parameters<f32>, [ParameterId; 4]) {
    let mut list = ParameterList::default();
    let mut scope = Scope::root(&mut list);
    let ids = [
        scope.parameter("conv.weight", &[7, 25, 3], Init::fan_in(75), Role::Weight),
        scope.parameter("norm.weight", &[12], Init::Ones, Role::Vector),
        scope.parameter("norm.bias", &[12], Init::Zeros, Role::Vector),
        scope.parameter("table", &[5, 3], Init::Zeros, Role::Table),
    ];
    (Parameters::new(list, 1), ids)
}

/// Something that is refused.
type Attempt = dyn Fn(&mut Eager<f32>, &[ParameterId; 4]) -> Result<Tensor<f32>>;

/// Runs `f` and returns what it says.
fn refusal(f: &Attempt) -> String {
    let (parameters, ids) = network();
    let arena = Arena::default();
    let mut eager = Eager::new(&parameters, &arena);
    f(&mut eager, &ids).expect_err("refused").to_string()
}

fn zeros(g: &Eager<f32>, shape: &[usize]) -> Tensor<f32> {
    g.input(shape, &vec![0.0; shape.iter().product()])
}

#[test]
fn shape_errors_name_the_operation_and_both_sizes() {
    fn conv(taps: usize) -> Convolution {
        Convolution { taps, stride: 1, padding: 0, dilation: 1 }
    }
    let said = refusal;
    for (got, wanted) in [
        (
            said(&|g, p| g.conv1d(&zeros(g, &[2, 9, 24]), p[0], None, conv(3))),
            "conv1d: input has 24 channels, weight expects 25",
        ),
        (
            said(&|g, p| g.conv1d(&zeros(g, &[2, 25]), p[0], None, conv(3))),
            "conv1d: input has shape [2, 25], expected [batch, frames, channels]",
        ),
        (
            said(&|g, p| g.conv1d(&zeros(g, &[2, 9, 25]), p[0], None, conv(5))),
            "conv1d: weight has 3 taps, convolution expects 5",
        ),
        (
            said(&|g, p| g.conv1d(&zeros(g, &[1, 2, 25]), p[0], None, conv(3))),
            "conv1d: input has 2 frames and 0 of padding at either end, weight spans 3",
        ),
        (
            said(&|g, p| g.linear(&zeros(g, &[2, 12]), p[1], None)),
            "linear: norm.weight is not a weight",
        ),
        (
            said(&|g, p| {
                let [weight, bias] = [p[1], p[2]];
                let norm = GroupNormalization { groups: 5, epsilon: 1e-5, weight, bias };
                g.group_norm(&zeros(g, &[2, 9, 12]), norm, None, Activation::Silu)
            }),
            "group_norm: 12 channels cannot be split into 5 groups",
        ),
        (
            said(&|g, p| {
                let [weight, bias] = [p[1], p[2]];
                let norm = GroupNormalization { groups: 4, epsilon: 1e-5, weight, bias };
                let film = zeros(g, &[2, 12]);
                g.group_norm(&zeros(g, &[2, 9, 12]), norm, Some(&film), Activation::Silu)
            }),
            "group_norm: scale and shift have shape [2, 12], input expects [2, 24]",
        ),
        (
            said(&|g, p| g.layer_norm(&zeros(g, &[2, 9]), Some([p[1], p[2]]), 1e-5)),
            "layer_norm: input has 9 channels, weight expects 12",
        ),
        (
            said(&|g, _| {
                let (x, y) = (zeros(g, &[2, 5, 10]), zeros(g, &[2, 4, 10]));
                let [query, key, value] = [&x, &x, &y].map(|tensor| Channels { tensor, first: 0 });
                let (width, heads, key_mask, causal) = (10, 2, None, false);
                g.attention(Attention { query, key, value, width, heads, key_mask, causal })
            }),
            "attention: value has 4 frames, key expects 5",
        ),
        (
            said(&|g, _| g.add(&zeros(g, &[2, 3]), &zeros(g, &[2, 4]))),
            "add: [2, 3] and [2, 4] cannot be repeated to one shape",
        ),
        (
            said(&|g, _| g.apply(Binary::new(Pair::Subtract), &[&zeros(g, &[3]), &zeros(g, &[4])])),
            "subtract: [3] and [4] cannot be repeated to one shape",
        ),
        (
            said(&|g, _| g.add_to_frames(&zeros(g, &[2, 5, 3]), &zeros(g, &[2, 4]))),
            "add_to_frames: vector has shape [2, 4], input expects [2, 3]",
        ),
        (
            said(&|g, _| g.concat(&[&zeros(g, &[2, 5, 3]), &zeros(g, &[2, 6, 3])])),
            "concat: shapes [2, 5, 3] and [2, 6, 3] differ before the last axis",
        ),
        (
            said(&|g, _| g.channels(&zeros(g, &[2, 5]), 3..6)),
            "channels: input has shape [2, 5], channels 3..6 asked for",
        ),
        (
            said(&|g, p| g.embedding(p[3], &g.input(&[2], &[1.0, 5.0]))),
            "embedding: index 5 is not a whole number below 5, the rows of the table",
        ),
        (
            said(&|g, _| g.crop_frames(&zeros(g, &[1, 4, 2]), &zeros(g, &[1, 5, 2]))),
            "crop_frames: input has 4 frames, 5 asked for",
        ),
        (
            said(&|g, _| g.frames_behind(&zeros(g, &[1, 4, 2]), &zeros(g, &[1, 4, 3]))),
            "frames_behind: input has 4 frames, those behind 4 asked for",
        ),
        (
            said(&|g, _| g.rotary(&zeros(g, &[1, 2, 6]), 3, Some(&zeros(g, &[1, 2])))),
            "rotary: the past has shape [1, 2], expected [batch, frames, channels]",
        ),
        (
            said(&|g, _| g.frame_mask(&zeros(g, &[2, 4, 3]), Some(&zeros(g, &[2, 5])), 4)),
            "frame_mask: mask has shape [2, 5], input expects [2, 4]",
        ),
        (
            said(&|g, _| g.rotary(&zeros(g, &[1, 2, 9]), 3, None)),
            "rotary: 9 channels cannot be split into pairs of 3 heads",
        ),
        (
            said(&|g, _| g.apply(Reshape::new(&[7]), &[&zeros(g, &[2, 3])])),
            "reshape: [2, 3] and [7] differ in length",
        ),
        (
            said(&|g, _| g.apply(Transpose::new(&[0, 0]), &[&zeros(g, &[2, 3])])),
            "transpose: input has shape [2, 3], axes [0, 0] asked for",
        ),
        (
            said(&|g, _| {
                g.apply(BatchProduct::default(), &[&zeros(g, &[1, 2, 3]), &zeros(g, &[1, 4, 5])])
            }),
            "matmul: second input has 4 rows, first expects 3",
        ),
        (
            said(&|g, _| {
                g.apply(Loss::new(Cost::Squared), &[&zeros(g, &[2, 3]), &zeros(g, &[3, 2])])
            }),
            "mse_loss: prediction has shape [2, 3], target [3, 2]",
        ),
        (
            said(&|g, _| {
                g.apply(CrossEntropy::default(), &[&zeros(g, &[1, 3]), &g.input(&[1], &[3.0])])
            }),
            "cross_entropy: label 3 is not a whole number below 3, the classes",
        ),
    ] {
        assert_eq!(got, wanted);
    }
}

#[test]
fn the_first_operation_with_a_number_that_is_not_finite_is_named() {
    let (parameters, ids) = network();
    let arena = Arena::default();
    let mut values = vec![0.0; 2 * 5 * 25];
    values[3] = f32::INFINITY;
    let convolution = Convolution { taps: 3, stride: 1, padding: 1, dilation: 1 };
    let mut eager = Eager::new(&parameters, &arena).checking_finite();
    let x = eager.input(&[2, 5, 25], &values);
    let error = eager.conv1d(&x, ids[0], None, convolution).expect_err("refused").to_string();
    let place = " at [0, 0, 0] of [2, 5, 7]";
    assert!(error.starts_with("conv1d of conv.weight: result has "), "{error}");
    assert!(error.ends_with(place), "{error}");

    // √0 is finite, its slope is not.
    let mut tape = Tape::new(&parameters, &arena, None).checking_finite();
    let x = tape.input(&[], &[0.0]);
    let y = tape.apply(Map::new(Function::Sqrt), &[&x]).expect("finite");
    let Err(error) = tape.backward(y, &mut Gradients::new(&parameters)) else {
        panic!("an infinite gradient was not seen");
    };
    assert_eq!(error.to_string(), "sqrt: gradient has inf at [] of []");
}

#[test]
fn no_function_hides_what_is_not_a_number() {
    let (parameters, _) = network();
    let arena = Arena::default();
    let mut g = Eager::new(&parameters, &arena);
    let x = g.input(&[2, 2], &[1.0, f32::NAN, 0.5, -0.5]);
    for activation in [
        Activation::Identity,
        Activation::Silu,
        Activation::Gelu,
        Activation::Relu,
        Activation::LeakyRelu { slope: 0.2 },
        Activation::Mish,
        Activation::Tanh,
        Activation::Sigmoid,
    ] {
        let y = g.activation(&x, activation).expect("shapes fit");
        assert!(y.data()[1].is_nan(), "{activation:?}: {y:?}");
    }
    for function in [
        Function::Affine { scale: 2.0, shift: 1.0 },
        Function::Exp,
        Function::Ln,
        Function::Sqrt,
        Function::Square,
        Function::Abs,
        Function::Clamp { low: -1.0, high: 1.0 },
    ] {
        let y = g.apply(Map::new(function), &[&x]).expect("shapes fit");
        assert!(y.data()[1].is_nan(), "{function:?}: {y:?}");
    }
    let y = g.normalize(&x, 1e-12).expect("shapes fit");
    assert!(y.data()[..2].iter().all(|y| y.is_nan()), "normalize: {y:?}");
    assert!(y.data()[2..].iter().all(|y| y.is_finite()), "normalize: {y:?}");
    let y = g.apply(Softmax::default(), &[&x]).expect("shapes fit");
    assert!(y.data()[..2].iter().all(|y| y.is_nan()), "softmax: {y:?}");
}
