//! The features of the golden clips, against librosa's.

use motiongen::audio::BLOCKS;
use serde_json::Value;

use super::{Archive, extract_files, golden, read};
use crate::support::Dir;

/// The largest and the mean absolute error of each block over all clips; all values are of the order
/// of 1. As in `compare.py`, about four times what an independent implementation in double precision
/// reaches: room for another order of rounding (librosa's FFT and matrix products are in single
/// precision), none for another definition.
const TOLERANCES: [(&str, f64, f64); 6] = [
    ("mel", 1e-4, 2e-6),
    ("chroma", 1e-4, 2e-6),
    ("mfcc", 4e-3, 1e-4),
    ("rms", 2e-5, 5e-7),
    ("spectral_centroid", 1e-3, 2e-5),
    ("onset_strength", 2e-4, 5e-6),
];

/// Errors of a block so far.
#[derive(Clone, Copy, Debug, Default)]
struct Errors {
    largest: f64,
    sum: f64,
    n: usize,
}

fn indices(clip: &Value, key: &str) -> Vec<usize> {
    let list = clip[key].as_array().unwrap();
    list.iter().map(|i| usize::try_from(i.as_u64().unwrap()).unwrap()).collect()
}

#[test]
fn features_tuning_tempo_and_beats_of_every_clip_are_librosas() {
    let dir = Dir::new();
    let manifest: Value = serde_json::from_slice(&read(&golden("audio/manifest.json"))).unwrap();
    let clips = manifest["clips"].as_array().unwrap();
    assert_eq!(clips.len(), 12);
    let text = |clip: &Value, key: &str| clip[key].as_str().unwrap().to_owned();
    let audio: Vec<_> =
        clips.iter().map(|clip| golden(&format!("audio/{}", text(clip, "file")))).collect();
    let output = extract_files(&audio, &dir.at("features"), &[]);
    assert_eq!(output.code, 0, "{output:?}");

    let mut errors = [Errors::default(); 6];
    for clip in clips {
        let name = text(clip, "name");
        let theirs = Archive::read(&golden(&format!("audio/{name}.npz")));
        let ours = Archive::read(&dir.at(format!("features/{name}.npz")));
        let (shape, expected) = theirs.f32s("features");
        let (our_shape, all) = ours.f32s("features");
        assert_eq!(our_shape, shape, "{name}");
        let n_frames = shape[1];
        let (undefined_rows, undefined_frames) =
            (indices(clip, "undefined_rows"), indices(clip, "undefined_chroma_frames"));

        let mut first = 0;
        for ((block, errors), (tolerance_of, _, _)) in
            BLOCKS.into_iter().zip(&mut errors).zip(TOLERANCES)
        {
            assert_eq!(block.name, tolerance_of);
            let values = first * n_frames..(first + block.len) * n_frames;
            let (shape, in_block) = ours.f32s(block.name);
            let expected_shape = [block.len, n_frames];
            let n_axes = if block.len == 1 { 1 } else { 2 };
            assert_eq!(shape, expected_shape[2 - n_axes..], "{name}, {}", block.name);
            assert_eq!(in_block, all[values.clone()], "{name}, {}", block.name);
            for i in values {
                let (row, frame) = (i / n_frames, i % n_frames);
                let is_undefined = undefined_rows.contains(&row)
                    || block.name == "chroma" && undefined_frames.contains(&frame);
                if is_undefined {
                    continue;
                }
                assert!(all[i].is_finite(), "{name}: {} at frame {frame}", block.name);
                let error = (f64::from(all[i]) - f64::from(expected[i])).abs();
                errors.largest = errors.largest.max(error);
                errors.sum += error;
                errors.n += 1;
            }
            first += block.len;
        }

        assert_eq!(ours.f64s("n_samples"), theirs.f64s("n_samples"), "{name}");
        assert_eq!(ours.f64s("tuning"), theirs.f64s("tuning"), "{name}");
        assert_eq!(ours.f64s("beat_frames"), theirs.f64s("beat_frames"), "{name}");
        // Theirs are 60 · 44100 / (1470 · lag), rounded in another order.
        let (tempo, expected) = (ours.f64s("tempo")[0], theirs.f64s("tempo")[0]);
        assert!((tempo - expected).abs() <= 1e-9, "{name}: {tempo} bpm, {expected} bpm");
        // librosa's times were stored in single precision.
        let times = |archive: &Archive| archive.f32s("beat_times").1;
        assert_eq!(times(&ours), times(&theirs), "{name}");
    }
    for ((name, largest, mean), errors) in TOLERANCES.into_iter().zip(errors) {
        assert!(errors.n > 900, "{name}: {errors:?}");
        let found = (errors.largest, errors.sum / errors.n as f64);
        assert!(found.0 <= largest && found.1 <= mean, "{name}: {found:?}, {largest} and {mean}");
    }
}
