//! What operations over the frames of a motion are in ONNX.

use ndarray::Array2;

use super::builder::{Axes, Builder, Form, Value, expect};
use super::literals::{integer, integers, word};
use super::proto::DataType;
use crate::model::{GraphError, Mirror, Result};

/// Repeats the last frame until the number of frames is a multiple.
pub(super) fn hold(g: &mut Builder<'_>, x: Value, multiple: usize) -> Result<Value> {
    g.begin("hold_frames", None);
    expect("hold_frames", x, Axes::Frames)?;
    if multiple == 1 {
        return Ok(x);
    }
    let frames = g.n_frames(x)?;
    let missing = g.n_missing(&frames, multiple);
    let name = g.last(x)?;
    let (none, axes) = (g.integers(&[0]), g.integers(&[1]));
    let pads = g.node("Concat", &[&none, &missing], vec![integer("axis", 0)]);
    let y = g.node("Pad", &[&name, &pads, "", &axes], vec![word("mode", "edge")]);
    Ok(g.new_last(Axes::Frames, x.channels, y))
}

/// Drops as many of the first frames as another value has.
pub(super) fn behind(g: &mut Builder<'_>, x: Value, past: Value) -> Result<Value> {
    g.begin("frames_behind", None);
    expect("frames_behind", x, Axes::Frames)?;
    let starts = g.n_frames(past)?;
    let axis = if g.has_last(x) { 1 } else { g.frames_axis() };
    let [ends, axes] = [i64::MAX, axis].map(|n| g.integers(&[n]));
    g.map(x, x.channels, |g, x| g.node("Slice", &[x, &starts, &ends, &axes], vec![]))
}

/// Turns pairs of channels of each head by the number of their frame, counted from those of `past` on.
pub(super) fn rotary(
    g: &mut Builder<'_>,
    x: Value,
    heads: usize,
    past: Option<Value>,
) -> Result<Value> {
    g.begin("rotary", None);
    let name = g.last(x)?;
    let dim = x.channels / heads;
    let rates: Vec<f32> =
        (0..dim / 2).map(|i| 10_000_f64.powf(-2.0 * i as f64 / dim as f64) as f32).collect();
    let rates = g.numbers(&format!("constant/rates_{dim}"), &[rates.len()], &rates);
    let frames = g.n_frames(x)?;
    let mut places = g.places(&frames);
    if let Some(past) = past {
        let first = g.n_frames(past)?;
        places = g.node("Add", &[&places, &first], vec![]);
    }
    let places = g.cast(&places, DataType::Float);
    let axes = g.integers(&[1]);
    let places = g.node("Unsqueeze", &[&places, &axes], vec![]);
    // [frames, d / 2] → [frames, 1, d / 2], beside the heads.
    let angles = g.node("Mul", &[&places, &rates], vec![]);
    let angles = g.node("Unsqueeze", &[&angles, &axes], vec![]);
    let (cos, sin) = (g.node("Cos", &[&angles], vec![]), g.node("Sin", &[&angles], vec![]));
    let shape = g.integers(&[0, 0, heads as i64, (dim / 2) as i64, 2]);
    let pairs = g.node("Reshape", &[&name, &shape], vec![]);
    let halves = vec![integer("axis", -1), integer("num_outputs", 2)];
    let halves = g.nodes_of("Split", &[&pairs], halves, 2);
    let last = g.integers(&[4]);
    let [a, b] = [0, 1].map(|i| g.node("Squeeze", &[&halves[i], &last], vec![]));
    let times = |g: &mut Builder<'_>, x: &str, y: &str| g.node("Mul", &[x, y], vec![]);
    let (a_cos, b_sin) = (times(g, &a, &cos), times(g, &b, &sin));
    let (a_sin, b_cos) = (times(g, &a, &sin), times(g, &b, &cos));
    let turned =
        [g.node("Sub", &[&a_cos, &b_sin], vec![]), g.node("Add", &[&a_sin, &b_cos], vec![])]
            .map(|x| g.node("Unsqueeze", &[&x, &last], vec![]));
    let pairs = g.node("Concat", &[&turned[0], &turned[1]], vec![integer("axis", -1)]);
    let shape = g.integers(&[0, 0, x.channels as i64]);
    let y = g.node("Reshape", &[&pairs, &shape], vec![]);
    Ok(g.new_last(Axes::Frames, x.channels, y))
}

/// Takes frame t + `shift` as frame t, held within what is there, `spare` frames from the end.
pub(super) fn shift(g: &mut Builder<'_>, x: Value, shift: isize, spare: usize) -> Result<Value> {
    g.begin("shift_frames", None);
    expect("shift_frames", x, Axes::Frames)?;
    let frames = g.n_frames(x)?;
    let places = g.places(&frames);
    let [shift, spare, zero] = [shift as i64, spare as i64 + 1, 0].map(|n| g.integers(&[n]));
    let last = g.node("Sub", &[&frames, &spare], vec![]);
    let last = g.node("Max", &[&last, &zero], vec![]);
    let places = g.node("Add", &[&places, &shift], vec![]);
    let places = g.node("Max", &[&places, &zero], vec![]);
    let places = g.node("Min", &[&places, &last], vec![]);
    let axis = if g.has_last(x) { 1 } else { g.frames_axis() };
    g.map(x, x.channels, |g, x| g.node("Gather", &[x, &places], vec![integer("axis", axis)]))
}

/// Puts the frames of `first` and `last` in the place of the first and the last frame.
pub(super) fn replace_ends(
    g: &mut Builder<'_>,
    x: Value,
    first: Value,
    last: Value,
) -> Result<Value> {
    g.begin("replace_ends", None);
    let frames = g.n_frames(x)?;
    let places = g.places(&frames);
    let [zero, one] = [0, 1].map(|n| g.integers(&[n]));
    let end = g.node("Sub", &[&frames, &one], vec![]);
    let is_first = g.node("Equal", &[&places, &zero], vec![]);
    let is_last = g.node("Equal", &[&places, &end], vec![]);
    // Frames are the last axis in either form.
    let [x_name, first, last] = [
        g.first("replace_ends", x)?,
        g.first("replace_ends", first)?,
        g.first("replace_ends", last)?,
    ];
    let y = g.node("Where", &[&is_first, &first, &x_name], vec![]);
    let y = g.node("Where", &[&is_last, &last, &y], vec![]);
    Ok(g.new_first(x.channels, y))
}

/// Filters every channel by its own kernel, \[channels, taps\], mirrored at the ends.
pub(super) fn filter(
    g: &mut Builder<'_>,
    x: Value,
    kernel: &Array2<f64>,
    mirror: Mirror,
) -> Result<Value> {
    g.begin("filter_frames", None);
    let (channels, taps) = kernel.dim();
    if x.channels != channels || taps % 2 == 0 {
        let problem = format!(
            "input has {} channels, the filter has {channels} with {taps} taps, of which an odd number is asked",
            x.channels
        );
        return Err(GraphError::shape("filter_frames", problem));
    }
    let name = g.first("filter_frames", x)?;
    let frames = g.n_frames(x)?;
    let name = g.mirrored(&name, &frames, (taps / 2) as i64, mirror);
    let numbers: Vec<f32> = kernel.iter().map(|&h| h as f32).collect();
    let (dims, shape) = match g.form {
        Form::Line => (vec![channels, 1, taps], vec![taps as i64]),
        Form::Image => (vec![channels, 1, 1, taps], vec![1, taps as i64]),
    };
    let kernel = g.table(&dims, &numbers);
    let attributes = vec![integers("kernel_shape", &shape), integer("group", channels as i64)];
    let y = g.node("Conv", &[&name, &kernel], attributes);
    Ok(g.new_first(channels, y))
}

/// Returns which frames count once they are held to a multiple, \[batch, frames\] or \[1, frames\].
pub(super) fn mask(
    g: &mut Builder<'_>,
    x: Value,
    mask: Option<Value>,
    multiple: usize,
) -> Result<Value> {
    g.begin("frame_mask", None);
    let frames = g.n_frames(x)?;
    let missing = g.n_missing(&frames, multiple);
    let y = match mask {
        Some(mask) => {
            let mask = g.last(mask)?;
            let (none, axes) = (g.integers(&[0]), g.integers(&[1]));
            let pads = g.node("Concat", &[&none, &missing], vec![integer("axis", 0)]);
            g.node("Pad", &[&mask, &pads, "", &axes], vec![word("mode", "constant")])
        }
        None => {
            let held = g.node("Add", &[&frames, &missing], vec![]);
            let places = g.places(&held);
            let counts = g.node("Less", &[&places, &frames], vec![]);
            let counts = g.cast(&counts, DataType::Float);
            let axes = g.integers(&[0]);
            g.node("Unsqueeze", &[&counts, &axes], vec![])
        }
    };
    Ok(g.new_last(Axes::Mask, 0, y))
}

/// Joins frames in time; samples count as one frame.
pub(super) fn concat(g: &mut Builder<'_>, parts: &[&Value]) -> Result<Value> {
    g.begin("concat_frames", None);
    let Some(&&one) = parts.first() else {
        return Err(GraphError::shape("concat_frames", "there is nothing to join"));
    };
    let axes = g.integers(&[1]);
    let mut names = Vec::with_capacity(parts.len());
    for part in parts {
        let name = g.last(**part)?;
        names.push(match part.axes {
            Axes::Samples => g.node("Unsqueeze", &[&name, &axes], vec![]),
            _ => name,
        });
    }
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let y = g.node("Concat", &names, vec![integer("axis", 1)]);
    Ok(g.new_last(Axes::Frames, one.channels, y))
}

/// Averages every frame over the dancers of a group that are there.
pub(super) fn mean_dancers(
    g: &mut Builder<'_>,
    x: Value,
    like: Value,
    mask: Option<Value>,
) -> Result<Value> {
    g.begin("mean_dancers", None);
    expect("mean_dancers", x, Axes::Frames)?;
    let (name, batch) = (g.last(x)?, g.batch_of(like)?);
    let frames = g.node("Shape", &[&name], vec![integer("start", 1)]);
    let dancers = g.integers(&[-1]);
    // [batch · dancers, frames, channels] → [batch, dancers, frames, channels] → [batch, frames, channels]
    let shape = g.node("Concat", &[&batch, &dancers, &frames], vec![integer("axis", 0)]);
    let apart = g.node("Reshape", &[&name, &shape], vec![]);
    let axes = g.integers(&[1]);
    let drop = || vec![integer("keepdims", 0)];
    let y = match mask {
        None => g.node("ReduceMean", &[&apart, &axes], drop()),
        Some(mask) => {
            let (mask, last) = (g.last(mask)?, g.integers(&[2, 3]));
            let mask = g.node("Unsqueeze", &[&mask, &last], vec![]);
            let counted = g.node("Mul", &[&apart, &mask], vec![]);
            let sum = g.node("ReduceSum", &[&counted, &axes], drop());
            let n = g.node("ReduceSum", &[&mask, &axes], drop());
            let one = g.number(1.0);
            let n = g.node("Max", &[&n, &one], vec![]);
            g.node("Div", &[&sum, &n], vec![])
        }
    };
    Ok(g.new_last(Axes::Frames, x.channels, y))
}

/// Averages the channels of each sample.
pub(super) fn mean_channels(g: &mut Builder<'_>, x: Value) -> Result<Value> {
    g.begin("mean_channels", None);
    expect("mean_channels", x, Axes::Samples)?;
    let (name, axes) = (g.last(x)?, g.integers(&[1]));
    let y = g.node("ReduceMean", &[&name, &axes], vec![integer("keepdims", 1)]);
    Ok(g.new_last(Axes::Samples, 1, y))
}
