//! Channels of any sample format to mono f32.
//!
//! Integers become v / 2^(bits - 1), as in libsndfile. The mean is bit-equal to NumPy's
//! `y.mean(axis=0)` over the transposed array of interleaved samples that librosa reads: pairwise
//! summation from 8 channels on (numpy, `pairwise_sum` in `loops_utils.h.src`).

use symphonia::core::audio::sample::{Sample, i24, u24};
use symphonia::core::audio::{Audio, AudioBuffer, GenericAudioBufferRef};

/// Appends mean_c x_c of each frame to `mono`.
pub(super) fn append_mono(buffer: &GenericAudioBufferRef<'_>, mono: &mut Vec<f32>) {
    // Scales are powers of two: a product and a quotient round alike.
    const I8: f32 = 1.0 / (1_u32 << 7) as f32;
    const I16: f32 = 1.0 / (1_u32 << 15) as f32;
    const I24: f32 = 1.0 / (1_u32 << 23) as f32;
    const I32: f32 = 1.0 / (1_u32 << 31) as f32;
    match buffer {
        GenericAudioBufferRef::U8(b) => append(b, |x| f32::from(i16::from(x) - 0x80) * I8, mono),
        GenericAudioBufferRef::U16(b) => {
            append(b, |x| (i32::from(x) - 0x8000) as f32 * I16, mono);
        }
        GenericAudioBufferRef::U24(b) => {
            append(b, |x: u24| (x.inner() as i32 - 0x80_0000) as f32 * I24, mono);
        }
        GenericAudioBufferRef::U32(b) => {
            append(b, |x| (x ^ 0x8000_0000).cast_signed() as f32 * I32, mono);
        }
        GenericAudioBufferRef::S8(b) => append(b, |x| f32::from(x) * I8, mono),
        GenericAudioBufferRef::S16(b) => append(b, |x| f32::from(x) * I16, mono),
        GenericAudioBufferRef::S24(b) => append(b, |x: i24| x.inner() as f32 * I24, mono),
        GenericAudioBufferRef::S32(b) => append(b, |x| x as f32 * I32, mono),
        GenericAudioBufferRef::F32(b) => append(b, |x| x, mono),
        GenericAudioBufferRef::F64(b) => append(b, |x| x as f32, mono),
    }
}

/// Appends mean_c x_c of each frame of interleaved samples to `mono`.
pub(super) fn append_interleaved(values: &[f32], n_channels: u16, mono: &mut Vec<f32>) {
    let mean = |sum: f32| sum / f32::from(n_channels);
    match n_channels {
        0 => {}
        1 => mono.extend_from_slice(values),
        2 => mono.extend(values.as_chunks::<2>().0.iter().map(|[l, r]| (0.0 + l + r) / 2.0)),
        3..8 => {
            let frames = values.chunks_exact(usize::from(n_channels));
            mono.extend(frames.map(|frame| mean(frame.iter().fold(0.0, |sum, x| sum + x))));
        }
        _ => {
            let frames = values.chunks_exact(usize::from(n_channels));
            mono.extend(frames.map(|frame| mean(0.0 + pairwise_sum(frame))));
        }
    }
}

fn append<S: Sample>(
    buffer: &AudioBuffer<S>,
    to_f32: impl Fn(S) -> f32 + Copy,
    mono: &mut Vec<f32>,
) {
    let planes: Vec<&[S]> = buffer.iter_planes().collect();
    let n_channels = planes.len() as f32;
    match planes.as_slice() {
        [] => {}
        [plane] => mono.extend(plane.iter().map(|&x| to_f32(x))),
        [left, right] => {
            let frames = left.iter().zip(*right);
            mono.extend(frames.map(|(&l, &r)| (0.0 + to_f32(l) + to_f32(r)) / 2.0));
        }
        planes if planes.len() < 8 => {
            let start = mono.len();
            mono.resize(start + buffer.frames(), 0.0);
            let sums = &mut mono[start..];
            for plane in planes {
                sums.iter_mut().zip(*plane).for_each(|(sum, &x)| *sum += to_f32(x));
            }
            sums.iter_mut().for_each(|sum| *sum /= n_channels);
        }
        planes => {
            let mut frame = vec![0.0; planes.len()];
            for t in 0..buffer.frames() {
                for (x, plane) in frame.iter_mut().zip(planes) {
                    *x = to_f32(plane[t]);
                }
                mono.push((0.0 + pairwise_sum(&frame)) / n_channels);
            }
        }
    }
}

/// Returns the sum of 8 or more values in NumPy's order.
fn pairwise_sum(values: &[f32]) -> f32 {
    if values.len() > 128 {
        let half = values.len() / 2;
        let (first, second) = values.split_at(half - half % 8);
        return pairwise_sum(first) + pairwise_sum(second);
    }
    let mut lanes = [0.0; 8];
    let mut eights = values.chunks_exact(8);
    if let Some(first) = eights.next() {
        lanes.copy_from_slice(first);
    }
    for eight in eights.by_ref() {
        for (lane, x) in lanes.iter_mut().zip(eight) {
            *lane += x;
        }
    }
    let [a, b, c, d, e, f, g, h] = lanes;
    let sum = ((a + b) + (c + d)) + ((e + f) + (g + h));
    eights.remainder().iter().fold(sum, |sum, x| sum + x)
}
