//! Windows and batches: what is cut, what is padded, and that nobody is left out.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::Arc;

use motiongen::model::{Preset, UNetConfig};
use motiongen::motion::{Channel, MOTION_DIM, Normalizer};
use motiongen::training::{Augmentation, Dataset, Loader, Split, Windows, fit_scales};
use ndarray::{Array2, s};
use proptest::prelude::*;

use crate::support::files::coherent;

const PLAIN: Augmentation =
    Augmentation { condition_noise: 0.0, mirror: false, yaw_deg: 0.0, stretch: 0.0 };

/// Phrases of these lengths; features of frame t are t, so that they tell where a window begins.
fn dataset(lengths: &[usize], split: Split) -> Arc<Dataset> {
    let names: Vec<String> = (0..lengths.len()).map(|i| format!("{i:02}")).collect();
    let phrases = names.iter().zip(lengths).enumerate().map(|(i, (name, &n))| {
        let motion: Vec<f32> = coherent(n, i as u32).into_iter().flatten().collect();
        let motion = Array2::from_shape_vec((n, MOTION_DIM), motion).expect("n × 25");
        let features = Array2::from_shape_fn((n, 163), |(t, _)| t as f32);
        (name.as_str(), split, motion, features)
    });
    Arc::new(Dataset::in_memory(phrases).expect("in memory"))
}

fn windows(lengths: &[usize], augmentation: Augmentation, n_frames: usize) -> Windows {
    let dataset = dataset(lengths, Split::Train);
    Windows::new(dataset, Normalizer::identity(), augmentation, n_frames, 7)
}

#[test]
fn longer_phrases_have_several_windows_and_shorter_ones_are_held() {
    let windows = windows(&[10, 24, 49, 73], PLAIN, 24);
    assert_eq!(windows.n_train(), 1 + 1 + 2 + 3);
    let batch = windows.train(&[(0, 0), (1, 3)]).expect("at hand");
    assert_eq!((batch.n_windows, batch.n_frames), (2, 24));
    // The short phrase: its last frame is held, and does not count.
    let mask: Vec<f32> = (0..24).map(|t| if t < 10 { 1.0 } else { 0.0 }).collect();
    assert_eq!(batch.mask[..24], mask);
    let frame = |t: usize| &batch.motion[t * MOTION_DIM..(t + 1) * MOTION_DIM];
    for t in 10..24 {
        assert_eq!(frame(t), frame(9));
        assert_eq!(batch.audio[t * 163], 9.0);
    }
    // The long one: a run of frames from within it, placed over the origin and facing +Z.
    assert_eq!(batch.mask[24..], [1.0; 24]);
    let audio: Vec<f32> = (24..48).map(|t| batch.audio[t * 163]).collect();
    let first = audio[0];
    assert!((0.0..=49.0).contains(&first), "{first}");
    for (t, x) in audio.iter().enumerate() {
        assert_eq!(*x, first + t as f32);
    }
    let begin = frame(24);
    let q = Channel::Quaternion.range().start;
    assert!(begin[0].abs() + begin[2].abs() < 1e-6);
    assert!((begin[q] - 1.0).abs() < 1e-6 && begin[q + 2].abs() < 1e-6, "{:?}", &begin[q..q + 4]);
    // Noise of either window, and of both: standard normal within five standard errors.
    let n = batch.noise.len() as f32;
    let mean = batch.noise.iter().sum::<f32>() / n;
    let square = batch.noise.iter().map(|z| z * z).sum::<f32>() / n;
    assert!(mean.abs() < 5.0 / n.sqrt() && (square - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
}

#[test]
fn a_network_that_hears_the_clock_gets_that_of_the_frames_it_sees() {
    let hears = UNetConfig { clock: true, ..Preset::Tiny.config() };
    let stretched = Augmentation { stretch: 0.25, mirror: true, ..PLAIN };
    // Bars of 66 frames; motion of nothing else.
    let motion = |n: usize| {
        let mut frames = Array2::<f32>::zeros((n, MOTION_DIM));
        for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
            row[Channel::Quaternion.range().start] = 1.0;
            row[Channel::Phase.range().start] = (t as f32 / 66.0 + 0.3).fract();
        }
        frames
    };
    let phrase = |n: usize| ("a", Split::Train, motion(n), Array2::zeros((n, 163)));
    let dataset = Arc::new(Dataset::in_memory([phrase(200)]).expect("in memory"));
    let windows = Windows::new(dataset, Normalizer::identity(), stretched, 50, 7);
    assert_eq!(windows.train(&[(0, 0)]).expect("at hand").audio.len(), 50 * 163);
    let windows = windows.heard_by(&hears);
    let batch = windows.train(&[(0, 0), (1, 0), (2, 0)]).expect("at hand");
    assert_eq!(batch.audio.len(), 3 * 50 * hears.condition_dim());
    let mut tempi = Vec::new();
    for window in 0..3 {
        for t in 0..50 {
            let row = window * 50 + t;
            let phase = batch.motion[row * MOTION_DIM + Channel::Phase.range().start];
            let heard = &batch.audio[row * 173..(row + 1) * 173][163..];
            let angle = std::f32::consts::TAU * phase;
            // Single precision, four times.
            assert!((heard[0] - angle.cos()).abs() < 1e-5 && (heard[1] - angle.sin()).abs() < 1e-5);
            assert!((heard[6] - (4.0 * angle).cos()).abs() < 1e-5, "{heard:?}");
            assert_eq!(heard[9], 1.0);
            tempi.push(120.0 * f64::from(heard[8]).exp());
        }
    }
    // Four beats in 66 frames are 109.1 beats a minute, and a quarter faster or slower.
    assert!(tempi.iter().all(|tempo| (109.0 * 0.75..110.0 * 1.25).contains(tempo)), "{tempi:?}");
    assert!((tempi[0] - tempi[149]).abs() > 1.0, "windows of other rates have other tempi");
    // Validation sees phrases as they are.
    let phrase = ("a", Split::Validation, motion(50), Array2::zeros((50, 163)));
    let dataset = Arc::new(Dataset::in_memory([phrase]).expect("in memory"));
    let windows = Windows::new(dataset, Normalizer::identity(), PLAIN, 50, 7).heard_by(&hears);
    let heard = windows.validation(0..1).expect("at hand").audio[163 + 8];
    assert!((120.0 * f64::from(heard).exp() - 4.0 * 1800.0 / 66.0).abs() < 1e-2, "{heard}");
}

#[test]
fn validation_windows_follow_each_other_and_come_again_with_other_noise() {
    let dataset = dataset(&[49, 10, 24], Split::Validation);
    let windows = Windows::new(dataset, Normalizer::identity(), PLAIN, 24, 7);
    assert_eq!(windows.n_validation(), 2 + 1 + 1);
    let batch = windows.validation(0..9).expect("at hand");
    let firsts: Vec<f32> = (0..9).map(|i| batch.audio[i * 24 * 163]).collect();
    assert_eq!(firsts, [0.0, 24.0, 0.0, 0.0, 0.0, 24.0, 0.0, 0.0, 0.0]);
    assert_eq!(batch.motion[..24 * 25], batch.motion[4 * 24 * 25..5 * 24 * 25]);
    assert_ne!(batch.noise[..24 * 25], batch.noise[4 * 24 * 25..5 * 24 * 25]);
    // Steps are spread: no gap between the nine is wider than two of a tenth.
    let mut steps: Vec<f64> = batch.chances.iter().map(|c| c.step).collect();
    steps.extend([0.0, 1.0]);
    steps.sort_by(f64::total_cmp);
    assert!(steps.windows(2).all(|pair| pair[1] - pair[0] < 0.2), "{steps:?}");
    assert!(batch.chances.iter().all(|c| c.no_audio == 1.0 && c.no_style == 1.0));
    let again = windows.validation(4..5).expect("at hand");
    assert_eq!(again, batch.windows(4..5));
}

#[test]
fn windows_in_pairs_are_of_two_dances_to_the_same_music_cut_alike() {
    // Three dances to music a, two to music b, one to c; motion of dance i is a constant i in the style channels.
    let phrase = |name: &'static str, i: usize, music: f32, split: Split| {
        let mut motion = Array2::<f32>::zeros((61, MOTION_DIM));
        motion.column_mut(Channel::Quaternion.range().start).fill(1.0);
        motion.column_mut(Channel::Style.range().start).fill(i as f32);
        let features = Array2::from_shape_fn((61, 163), |(t, _)| 100.0 * music + t as f32);
        (name, split, motion, features)
    };
    let phrases = [
        phrase("a.t00", 0, 1.0, Split::Train),
        phrase("a.t01", 1, 1.0, Split::Train),
        phrase("a.t02", 2, 1.0, Split::Train),
        phrase("b.t00", 3, 2.0, Split::Train),
        phrase("b.t01", 4, 2.0, Split::Train),
        phrase("v.t00", 5, 3.0, Split::Validation),
        phrase("w.t00", 6, 4.0, Split::Validation),
        phrase("v.t01", 7, 3.0, Split::Validation),
    ];
    let dataset = Arc::new(Dataset::in_memory(phrases).expect("in memory"));
    let windows = Windows::new(dataset, Normalizer::identity(), PLAIN, 24, 7).paired();
    // Five phrases of two windows each.
    assert_eq!(windows.n_train(), 10);
    let music = |phrase: u32| u32::from(phrase >= 3);
    for epoch in 0..9 {
        let order = windows.order(epoch);
        let mut counts = BTreeMap::new();
        order.iter().for_each(|&phrase| *counts.entry(phrase).or_insert(0) += 1);
        assert_eq!(counts.into_values().collect::<Vec<_>>(), [2; 5]);
        let pairs: Vec<_> = order.chunks(2).collect();
        let of_one_music = |pair: &&&[u32]| pair[0] != pair[1] && music(pair[0]) == music(pair[1]);
        // Of six windows of a and four of b at most one pair is left over.
        assert!(pairs.iter().filter(of_one_music).count() >= 4, "{order:?}");
        let numbered: Vec<(u64, u32)> = (epoch * 10..).zip(order.iter().copied()).collect();
        let batch = windows.train(&numbered).expect("at hand");
        for (pair, phrases) in batch.chances.chunks(2).zip(&pairs) {
            assert_eq!(pair[0].step, pair[1].step);
            assert_ne!(pair[0].no_audio, pair[1].no_audio);
            assert_eq!(phrases.len(), 2);
        }
        let steps: Vec<f64> = batch.chances.iter().step_by(2).map(|c| c.step).collect();
        assert!(steps.windows(2).all(|pair| pair[0] != pair[1]), "{steps:?}");
        let size = 24 * 163;
        for (i, pair) in pairs.iter().enumerate() {
            let [a, b] = [2 * i, 2 * i + 1].map(|i| &batch.audio[i * size..][..size]);
            if music(pair[0]) == music(pair[1]) {
                assert_eq!(a, b, "partners hear the same frames");
            }
        }
        let size = 24 * MOTION_DIM;
        assert_ne!(batch.noise[..size], batch.noise[size..2 * size]);
    }
    // Validation: both windows of v with each other, and those of w, which nobody else dances to.
    let batch = windows.validation(0..windows.n_validation()).expect("at hand");
    let ids: Vec<&str> = batch.phrase_ids.iter().map(|id| &**id).collect();
    assert_eq!(ids, ["v.t00", "v.t01", "v.t00", "v.t01", "w.t00", "w.t00"]);
    let steps: Vec<f64> = batch.chances.iter().map(|c| c.step).collect();
    assert!(steps.chunks(2).all(|pair| pair[0] == pair[1]) && steps[0] != steps[2]);
}

#[test]
fn every_augmentation_leaves_motion_coherent() {
    let all = Augmentation { condition_noise: 0.3, mirror: true, yaw_deg: 90.0, stretch: 0.2 };
    for augmentation in [
        all.clone(),
        Augmentation { mirror: true, ..PLAIN },
        Augmentation { yaw_deg: 45.0, ..PLAIN },
        Augmentation { stretch: 0.25, ..PLAIN },
    ] {
        let windows = windows(&[90, 41], augmentation.clone(), 32);
        let numbers: Vec<_> = (0..40).map(|i| (i, (i % 2) as u32)).collect();
        let batch = windows.train(&numbers).expect("at hand");
        let mut turned = 0;
        for window in 0..40 {
            let n = batch.mask[window * 32..(window + 1) * 32].iter().sum::<f32>() as usize;
            assert!(n >= 28, "{n} frames");
            let at = |t: usize, i: usize| batch.motion[(window * 32 + t) * MOTION_DIM + i];
            for t in 0..n - 1 {
                for i in 0..3 {
                    let v = at(t, 3 + i) - 30.0 * (at(t + 1, i) - at(t, i));
                    let a = at(t, 6 + i) - 30.0 * (at(t + 1, 3 + i) - at(t, 3 + i));
                    // Single precision of positions of 3 m, 30 and 900 times.
                    assert!(v.abs() < 3e-5 && a.abs() < 2e-3, "{augmentation:?}: {v}, {a}");
                }
            }
            // Walks turn to the left; in the mirror to the right.
            turned += i32::from(at(0, 14) < 0.0);
        }
        if augmentation.mirror {
            assert!((8..=32).contains(&turned), "{turned} of 40 were mirrored");
        } else {
            assert_eq!(turned, 0);
        }
    }
    let noisy = windows(&[90], Augmentation { condition_noise: 0.5, ..PLAIN }, 32);
    let plain = windows(&[90], PLAIN, 32);
    let [noisy, plain] = [noisy, plain].map(|w| w.train(&[(3, 0)]).expect("at hand"));
    assert_eq!(noisy.motion, plain.motion);
    let n = plain.audio.len() as f32;
    let square: f32 =
        noisy.audio.iter().zip(&plain.audio).map(|(a, b)| (a - b).powi(2)).sum::<f32>() / n;
    assert!((square.sqrt() - 0.5).abs() < 0.5 * 5.0 / (2.0 * n).sqrt(), "{}", square.sqrt());
}

#[test]
fn the_normalizer_sees_the_training_split_alone() {
    let mut phrases = Vec::new();
    for (i, (split, factor)) in
        [(Split::Train, 1.0), (Split::Validation, 50.0), (Split::Test, 9.0)].into_iter().enumerate()
    {
        let motion: Vec<f32> = coherent(60, 3).into_iter().flatten().collect();
        let mut motion = Array2::from_shape_vec((60, MOTION_DIM), motion).expect("60 × 25");
        motion.slice_mut(s![.., 3..9]).map_inplace(|x| *x *= factor);
        phrases.push((["a", "b", "c"][i], split, motion, Array2::zeros((60, 163))));
    }
    let train = phrases[..1].to_vec();
    let fit = |phrases: Vec<(&str, Split, Array2<f32>, Array2<f32>)>| {
        let dataset = Dataset::in_memory(phrases).expect("in memory");
        fit_scales(&dataset, 24).expect("at hand")
    };
    assert_eq!(fit(phrases), fit(train));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    #[test]
    fn every_window_comes_once_an_epoch_whoever_loads(
        lengths in prop::collection::vec(5usize..60, 1..9),
        batch_size in 1usize..12, n_threads in 1usize..5, first in 0u64..9
    ) {
        let windows = Arc::new(windows(&lengths, PLAIN, 16));
        let n = windows.n_train();
        let threads = NonZeroUsize::new(n_threads).expect("above 0");
        let n_batches = 3 * n / batch_size + 3;
        let load = |first: u64, threads: NonZeroUsize| {
            let mut loader = Loader::start(&windows, batch_size, first, threads);
            (0..n_batches).map(|_| loader.next_batch().expect("at hand")).collect::<Vec<_>>()
        };
        let one = load(0, NonZeroUsize::MIN);
        let ids: Vec<_> = one.iter().flat_map(|batch| batch.phrase_ids.clone()).collect();
        for epoch in ids.chunks_exact(n) {
            let mut count: BTreeMap<&str, usize> = BTreeMap::new();
            epoch.iter().for_each(|id| *count.entry(id).or_default() += 1);
            for (i, length) in lengths.iter().enumerate() {
                let wanted = (length / 16).max(1);
                prop_assert_eq!(count.get(format!("{i:02}").as_str()), Some(&wanted));
            }
        }
        // Another number of threads, and a start in the middle: the same batches.
        let first = first.min(n_batches as u64 - 1);
        let other = load(first, threads);
        let rest = n_batches - first as usize;
        prop_assert!(other[..rest] == one[first as usize..]);
    }
}
