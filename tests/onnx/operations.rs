//! Every operation, written as ONNX and run by onnxruntime, against the interpreter.

use std::collections::BTreeMap;
use std::sync::Arc;

use motiongen::autodiff::{Arena, Eager, Parameters};
use motiongen::model::{
    Activation, Attention, Channels, Convolution, Graph, GroupNormalization, Init, Mirror,
    Parameter, ParameterId, ParameterList, Result, Role,
};
use motiongen::onnx::{Axes, Builder, Form, ModelFile, NamedTensor, Storage};
use ndarray::Array2;

use super::{floats, integers, max_difference, normal, session};

/// A call of one operation, or of a few that belong together.
#[derive(Clone, Copy, Debug)]
enum Call {
    Linear,
    LinearAfterConvolution,
    Convolution(Convolution),
    GroupNorm {
        groups: usize,
        film: bool,
        activation: Activation,
    },
    LayerNorm {
        affine: bool,
    },
    Activate(Activation),
    SelfAttention {
        masked: bool,
        causal: bool,
    },
    /// A sample without keys, and queries that see none yet.
    AttentionWithoutKeys {
        causal: bool,
    },
    CrossAttention,
    /// Of the last places of a row of keys.
    AttentionBehindAPast,
    Add,
    AddChannels,
    MultiplyAcross,
    AddToFrames,
    Scale,
    Concat,
    ConcatAfterConvolution,
    TakeChannels,
    Upsample,
    Gather,
    Embedding,
    Select,
    Normalize,
    Rotary,
    RotaryBehindAPast,
    HoldAndCrop,
    ShiftFrames {
        shift: isize,
        spare: usize,
    },
    ShiftFramesOfConvolution,
    ReplaceEnds,
    FilterFrames {
        taps: usize,
        mirror: Mirror,
    },
    FilterFramesOfConvolution,
    HeldMask,
    StridedMask,
    NearestRows,
    NearestRowsOfSamples,
    Modulate {
        bias: f64,
        of_frames: bool,
    },
}

/// Sizes: odd, and all different.
const BATCH: usize = 3;
const FRAMES: usize = 13;
const KEYS: usize = 7;
const WIDTH: usize = 12;
const OUTPUTS: usize = 10;
const HEADS: usize = 2;
const ROWS: usize = 9;

/// The inputs of a call, by the names that all calls share.
struct CallInputs<T> {
    x: T,
    other: T,
    context: T,
    samples: T,
    film: T,
    choice: T,
    mask: T,
    /// Without the first keys of a sample, and without any of another.
    few: T,
    index: T,
}

struct Ids {
    weight: ParameterId,
    bias: ParameterId,
    taps: ParameterId,
    gain: ParameterId,
    shift: ParameterId,
    table: ParameterId,
    codes: ParameterId,
}

fn parameters() -> (ParameterList, Ids) {
    let mut list = ParameterList::default();
    let mut add = |name: &str, shape: &[usize], role| {
        let init = Init::Normal { deviation: 0.5 };
        list.add(Parameter { name: name.to_owned(), shape: shape.to_vec(), init, role })
    };
    let ids = Ids {
        weight: add("layer.weight", &[OUTPUTS, WIDTH], Role::Weight),
        bias: add("layer.bias", &[OUTPUTS], Role::Vector),
        taps: add("conv.weight", &[WIDTH, WIDTH, 3], Role::Weight),
        gain: add("norm.weight", &[WIDTH], Role::Vector),
        shift: add("norm.bias", &[WIDTH], Role::Vector),
        table: add("embed.weight", &[ROWS, WIDTH], Role::Table),
        codes: add("codes", &[ROWS + 8, WIDTH], Role::Code),
    };
    (list, ids)
}

const SAME: Convolution = Convolution { taps: 3, stride: 1, padding: 1, dilation: 1 };

fn filter(taps: usize) -> Arc<Array2<f64>> {
    let tap = |(c, j)| (0.1 * c as f64 - 0.07 * j as f64 + 0.02) / taps as f64;
    Arc::new(Array2::from_shape_fn((WIDTH, taps), tap))
}

fn run<G: Graph>(call: Call, g: &mut G, x: &CallInputs<G::Tensor>, ids: &Ids) -> Result<G::Tensor> {
    let convolved = |g: &mut G| g.conv1d(&x.x, ids.taps, Some(ids.gain), SAME);
    match call {
        Call::Linear => g.linear(&x.x, ids.weight, Some(ids.bias)),
        Call::LinearAfterConvolution => {
            let h = convolved(g)?;
            g.linear(&h, ids.weight, Some(ids.bias))
        }
        Call::Convolution(convolution) => g.conv1d(&x.x, ids.taps, Some(ids.gain), convolution),
        Call::GroupNorm { groups, film, activation } => {
            let norm =
                GroupNormalization { groups, epsilon: 1e-5, weight: ids.gain, bias: ids.shift };
            g.group_norm(&x.x, norm, film.then_some(&x.film), activation)
        }
        Call::LayerNorm { affine } => {
            g.layer_norm(&x.x, affine.then_some([ids.gain, ids.shift]), 1e-5)
        }
        Call::Activate(activation) => g.activation(&x.x, activation),
        Call::SelfAttention { masked, causal } => {
            // Query, key and value are parts of one tensor.
            let qkv = g.concat(&[&x.x, &x.other, &x.x])?;
            let part = |i| Channels { tensor: &qkv, first: i * WIDTH };
            g.attention(Attention {
                query: part(0),
                key: part(1),
                value: part(2),
                width: WIDTH,
                heads: HEADS,
                key_mask: masked.then_some(&x.mask),
                causal,
            })
        }
        Call::AttentionWithoutKeys { causal } => {
            let part = |tensor| Channels { tensor, first: 0 };
            g.attention(Attention {
                query: part(&x.x),
                key: part(&x.other),
                value: part(&x.other),
                width: WIDTH,
                heads: HEADS,
                key_mask: Some(&x.few),
                causal,
            })
        }
        Call::CrossAttention => g.attention(Attention {
            query: Channels { tensor: &x.x, first: 0 },
            key: Channels { tensor: &x.context, first: 0 },
            value: Channels { tensor: &x.context, first: 0 },
            width: WIDTH,
            heads: HEADS,
            key_mask: None,
            causal: false,
        }),
        Call::AttentionBehindAPast => {
            let keys = g.concat_frames(&[&x.context, &x.x])?;
            let query = g.frames_behind(&keys, &x.context)?;
            let part = |tensor| Channels { tensor, first: 0 };
            g.attention(Attention {
                query: part(&query),
                key: part(&keys),
                value: part(&keys),
                width: WIDTH,
                heads: HEADS,
                key_mask: None,
                causal: true,
            })
        }
        Call::Add => {
            let h = convolved(g)?;
            g.add(&h, &x.x)
        }
        Call::AddChannels => {
            let v = g.parameter(ids.gain)?;
            g.add(&x.x, &v)
        }
        Call::MultiplyAcross => g.mul(&x.x, &x.other),
        Call::AddToFrames => g.add_to_frames(&x.x, &x.samples),
        Call::Scale => g.scale(&x.x, -2.5),
        Call::Concat => g.concat(&[&x.x, &x.other, &x.x]),
        Call::ConcatAfterConvolution => {
            let h = convolved(g)?;
            g.concat(&[&h, &x.x])
        }
        Call::TakeChannels => {
            let h = convolved(g)?;
            let h = g.channels(&h, 2..9)?;
            let y = g.channels(&x.x, 1..8)?;
            g.add(&h, &y)
        }
        Call::Upsample => g.upsample(&x.x, 2),
        Call::Gather => {
            let table = Array2::from_shape_fn((ROWS, 5), |(i, j)| i as f64 + 0.1 * j as f64);
            g.gather(&Arc::new(table), &x.index)
        }
        Call::Embedding => g.embedding(ids.table, &x.index),
        Call::Select => {
            let other = g.parameter(ids.gain)?;
            g.select(&x.choice, &other, &x.x)
        }
        Call::Normalize => g.normalize(&x.x, 1e-12),
        Call::Rotary => g.rotary(&x.x, HEADS, None),
        Call::RotaryBehindAPast => {
            let h = convolved(g)?;
            let h = g.concat_frames(&[&x.context, &h])?;
            let h = g.conv1d(&h, ids.taps, None, SAME)?;
            let h = g.frames_behind(&h, &x.context)?;
            g.rotary(&h, HEADS, Some(&x.context))
        }
        Call::ShiftFrames { shift, spare } => g.shift_frames(&x.x, shift, spare),
        Call::ShiftFramesOfConvolution => {
            let h = convolved(g)?;
            g.shift_frames(&h, 1, 2)
        }
        Call::ReplaceEnds => {
            let h = convolved(g)?;
            g.replace_ends(&x.x, &h, &x.other)
        }
        Call::FilterFrames { taps, mirror } => g.filter_frames(&x.x, &filter(taps), mirror),
        Call::FilterFramesOfConvolution => {
            let h = convolved(g)?;
            g.filter_frames(&h, &filter(3), Mirror::Odd)
        }
        Call::HoldAndCrop => {
            let h = g.hold_frames(&x.x, 4)?;
            let h = g.conv1d(&h, ids.taps, None, SAME)?;
            let h = g.dropout(&h, 0.5)?;
            g.crop_frames(&h, &x.x)
        }
        Call::HeldMask => {
            // A mask of all frames is one for the whole batch; beside another it has that one's size.
            let all = g.frame_mask(&x.x, None, 8)?;
            let given = g.frame_mask(&x.x, Some(&x.mask), 8)?;
            g.mul(&all, &given)
        }
        Call::StridedMask => {
            let mask = g.frame_mask(&x.x, Some(&x.mask), 4)?;
            g.stride_mask(&mask, 2)
        }
        Call::NearestRows => {
            let h = convolved(g)?;
            let index = g.nearest_row(&h, ids.codes)?;
            let rows = g.embedding(ids.codes, &index)?;
            g.straight_through(&h, &rows)
        }
        Call::NearestRowsOfSamples => {
            let index = g.nearest_row(&x.samples, ids.codes)?;
            g.embedding(ids.codes, &index)
        }
        Call::Modulate { bias, of_frames } => {
            let h = convolved(g)?;
            let film = if of_frames { g.concat(&[&x.other, &h])? } else { x.film.clone() };
            g.modulate(&h, &film, bias)
        }
    }
}

fn values() -> BTreeMap<&'static str, (Vec<usize>, Vec<f32>)> {
    let normal_array = |shape: &[usize], seed| {
        let n = shape.iter().product();
        (shape.to_vec(), normal(n, seed))
    };
    let mut mask = vec![1.0; BATCH * FRAMES];
    mask[FRAMES - 4..FRAMES].fill(0.0);
    mask[2 * FRAMES - 1] = 0.0;
    let mut few = vec![1.0; BATCH * FRAMES];
    few[..3].fill(0.0);
    few[FRAMES..2 * FRAMES].fill(0.0);
    BTreeMap::from([
        ("few", (vec![BATCH, FRAMES], few)),
        ("x", normal_array(&[BATCH, FRAMES, WIDTH], 1)),
        ("other", normal_array(&[BATCH, FRAMES, WIDTH], 2)),
        ("context", normal_array(&[BATCH, KEYS, WIDTH], 3)),
        ("samples", normal_array(&[BATCH, WIDTH], 4)),
        ("film", normal_array(&[BATCH, 2 * WIDTH], 5)),
        ("choice", (vec![BATCH], vec![0.0, 1.0, 0.0])),
        ("mask", (vec![BATCH, FRAMES], mask)),
        ("index", (vec![BATCH], vec![8.0, 0.0, 3.0])),
    ])
}

fn by_interpreter(call: Call) -> (Vec<usize>, Vec<f32>) {
    let (list, ids) = parameters();
    let parameters = Parameters::new(list, 7);
    let arena = Arena::default();
    let mut g = Eager::new(&parameters, &arena);
    let values = values();
    let given = {
        let input = |name: &str| {
            let (shape, numbers) = &values[name];
            g.input(shape, numbers)
        };
        CallInputs {
            x: input("x"),
            other: input("other"),
            context: input("context"),
            samples: input("samples"),
            film: input("film"),
            choice: input("choice"),
            mask: input("mask"),
            few: input("few"),
            index: input("index"),
        }
    };
    let y = run(call, &mut g, &given, &ids).unwrap_or_else(|e| panic!("{call:?}: {e}"));
    (y.shape().to_vec(), y.data().to_vec())
}

fn by_onnxruntime(call: Call, form: Form) -> (Vec<usize>, Vec<f32>) {
    let (list, ids) = parameters();
    let parameters = Parameters::<f32>::new(list.clone(), 7);
    let weights = |id| parameters.unpacked(id);
    let mut g = Builder::new(&list, &weights, form, Storage::Fp32);
    let given = CallInputs {
        x: g.input("x", Axes::Frames, WIDTH, ""),
        other: g.input("other", Axes::Frames, WIDTH, ""),
        context: g.framed_input("context", "keys", WIDTH, ""),
        samples: g.input("samples", Axes::Samples, WIDTH, ""),
        film: g.input("film", Axes::Samples, 2 * WIDTH, ""),
        choice: g.input("choice", Axes::Batch, 0, ""),
        mask: g.input("mask", Axes::Mask, 0, ""),
        few: g.input("few", Axes::Mask, 0, ""),
        index: g.integer_input("index", Axes::Batch, ""),
    };
    let y = run(call, &mut g, &given, &ids).unwrap_or_else(|e| panic!("{call:?}: {e}"));
    g.output("y", y, "").expect("an output");
    let file = ModelFile {
        graph: g.finish("call"),
        metadata: BTreeMap::new(),
        description: String::new(),
    };
    let folder = tempfile::tempdir().expect("a folder");
    let mut session = session(file, folder.path(), "call.onnx");
    let values = values();
    let inputs: Vec<NamedTensor> =
        ["x", "other", "context", "samples", "film", "choice", "mask", "few"]
            .iter()
            .map(|&name| floats(name, &values[name].0, &values[name].1))
            .chain([integers("index", &[8, 0, 3])])
            .collect();
    session.run(&inputs, "y").unwrap_or_else(|e| panic!("{call:?}: {e}"))
}

#[test]
fn every_operation_gives_what_the_interpreter_gives() {
    let strided = Convolution { taps: 3, stride: 2, padding: 1, dilation: 1 };
    let dilated = Convolution { taps: 3, stride: 1, padding: 3, dilation: 2 };
    let mut calls = vec![
        Call::Linear,
        Call::LinearAfterConvolution,
        Call::Convolution(SAME),
        Call::Convolution(strided),
        Call::Convolution(dilated),
        Call::GroupNorm { groups: 4, film: false, activation: Activation::Identity },
        Call::GroupNorm { groups: 3, film: true, activation: Activation::Silu },
        Call::GroupNorm { groups: 1, film: true, activation: Activation::Relu },
        Call::LayerNorm { affine: true },
        Call::LayerNorm { affine: false },
        Call::SelfAttention { masked: false, causal: false },
        Call::SelfAttention { masked: true, causal: false },
        Call::SelfAttention { masked: false, causal: true },
        Call::AttentionWithoutKeys { causal: false },
        Call::AttentionWithoutKeys { causal: true },
        Call::CrossAttention,
        Call::AttentionBehindAPast,
        Call::Add,
        Call::AddChannels,
        Call::MultiplyAcross,
        Call::AddToFrames,
        Call::Scale,
        Call::Concat,
        Call::ConcatAfterConvolution,
        Call::TakeChannels,
        Call::Upsample,
        Call::Gather,
        Call::Embedding,
        Call::Select,
        Call::Normalize,
        Call::Rotary,
        Call::RotaryBehindAPast,
        Call::HoldAndCrop,
        Call::ShiftFrames { shift: 1, spare: 0 },
        Call::ShiftFrames { shift: -2, spare: 0 },
        Call::ShiftFrames { shift: 0, spare: 2 },
        // More than there are frames.
        Call::ShiftFrames { shift: 3, spare: FRAMES + 1 },
        Call::ShiftFramesOfConvolution,
        Call::ReplaceEnds,
        Call::FilterFrames { taps: 5, mirror: Mirror::Even },
        Call::FilterFrames { taps: 5, mirror: Mirror::Odd },
        Call::FilterFramesOfConvolution,
        // Longer than the period.
        Call::FilterFrames { taps: 4 * FRAMES + 3, mirror: Mirror::Even },
        Call::FilterFrames { taps: 4 * FRAMES + 3, mirror: Mirror::Odd },
        Call::HeldMask,
        Call::StridedMask,
        Call::NearestRows,
        Call::NearestRowsOfSamples,
        Call::Modulate { bias: 1.0, of_frames: false },
        Call::Modulate { bias: 0.0, of_frames: false },
        Call::Modulate { bias: 1.0, of_frames: true },
    ];
    calls.extend(
        [
            Activation::Identity,
            Activation::Silu,
            Activation::Gelu,
            Activation::Relu,
            Activation::LeakyRelu { slope: 0.2 },
            Activation::Mish,
            Activation::Tanh,
            Activation::Sigmoid,
        ]
        .map(Call::Activate),
    );
    for call in calls {
        let (shape, wanted) = by_interpreter(call);
        for form in [Form::Image, Form::Line] {
            let (found_shape, found) = by_onnxruntime(call, form);
            assert_eq!(found_shape, shape, "{call:?} {form:?}");
            // Sums of up to 36 products of numbers about 1, in f32 and in another order.
            let difference = max_difference(&found, &wanted);
            assert!(difference <= 1e-5, "{call:?} {form:?}: {difference:e}");
        }
    }
}

#[test]
fn a_query_without_keys_gets_zeros() {
    for (causal, n_zero) in [(false, FRAMES), (true, FRAMES + 3)] {
        let call = Call::AttentionWithoutKeys { causal };
        let (_, of_interpreter) = by_interpreter(call);
        for found in [of_interpreter, by_onnxruntime(call, Form::Line).1] {
            let rows: Vec<bool> =
                found.chunks(WIDTH).map(|row| row.iter().all(|x| *x == 0.0)).collect();
            assert_eq!(rows.iter().filter(|is_zero| **is_zero).count(), n_zero, "{call:?}");
            assert!(rows[FRAMES..2 * FRAMES].iter().all(|is_zero| *is_zero));
            assert_eq!(rows[..3], [causal; 3]);
        }
    }
}
