//! The two networks of a model of groups, against the interpreter, over numbers of groups, dancers and frames.

use motiongen::audio::FEATURE_DIM;
use motiongen::autodiff::{Arena, Eager, Interpreter as _, Parameters};
use motiongen::model::{
    GroupConfig, GroupDenoiser, GroupInputs, GroupScore, GroupScoreInputs, Preset,
};
use motiongen::motion::{CLOCK_DIM, MOTION_DIM};
use motiongen::onnx::{GroupNames, GroupScoreNames, Storage, group_denoiser, group_score};
use ndarray::ArrayViewMut2;

use super::networks::{file, random, scale};
use super::{floats, integers, max_difference, normal, session};

fn tiny() -> GroupConfig {
    GroupConfig::of(Preset::Tiny).expect("a preset of the family")
}

/// Groups, dancers of each, frames, and which groups go without music.
const CASES: [(usize, usize, usize, &[f32]); 4] =
    [(1, 5, 120, &[]), (3, 2, 77, &[0.0, 1.0, 0.0]), (2, 1, 9, &[1.0, 0.0]), (1, 16, 13, &[0.0])];

#[test]
fn a_denoiser_of_groups_predicts_what_the_interpreter_predicts() {
    let folder = tempfile::tempdir().expect("a folder");
    for config in [tiny(), GroupConfig { clock: false, add_audio: false, blocks: 1, ..tiny() }] {
        let parameters: Parameters<f32> = random(GroupDenoiser::new(&config).1, 5);
        let weights = |id| parameters.unpacked(id);
        let graph = group_denoiser(&config, &weights, &scale(), Storage::Fp32).expect("a graph");
        let mut session = session(file(graph), folder.path(), "denoiser.onnx");
        let (denoiser, _) = GroupDenoiser::new(&config);
        for (groups, dancers, frames, drop) in CASES {
            let x = normal(groups * dancers * frames * MOTION_DIM, 3);
            let features = normal(groups * frames * FEATURE_DIM, 4);
            let clock = normal(groups * frames * CLOCK_DIM, 5);
            let z = normal(groups * config.width, 6);
            let t: Vec<i64> = (0..groups).map(|i| (i as i64 * 499 + 998) % 1000).collect();
            let number = vec![config.embedded_number(dancers) as i64; groups];
            let mut inputs = vec![
                floats(GroupNames::X, &[groups * dancers, frames, MOTION_DIM], &x),
                integers(GroupNames::T, &t),
                floats(GroupNames::AUDIO, &[groups, frames, FEATURE_DIM], &features),
                integers(GroupNames::NUMBER, &number),
                floats(GroupNames::Z, &[groups, config.width], &z),
            ];
            if config.clock {
                inputs.push(floats(GroupNames::CLOCK, &[groups, frames, CLOCK_DIM], &clock));
            }
            if !drop.is_empty() {
                inputs.push(floats(GroupNames::DROP_AUDIO, &[groups], drop));
            }

            let mut scaled = features.clone();
            let rows = ArrayViewMut2::from_shape((groups * frames, FEATURE_DIM), &mut scaled);
            scale().apply(rows.expect("rows"));
            let mut heard = Vec::new();
            for (features, clock) in scaled.chunks(FEATURE_DIM).zip(clock.chunks(CLOCK_DIM)) {
                heard.extend(features);
                heard.extend(clock.iter().filter(|_| config.clock));
            }
            let arena = Arena::default();
            let mut g = Eager::new(&parameters, &arena);
            let x = g.constant(&[groups * dancers, frames, MOTION_DIM], &x);
            let steps: Vec<f32> = t.iter().map(|&t| t as f32).collect();
            let t = g.constant(&[groups], &steps);
            let audio = g.constant(&[groups, frames, config.condition().dim()], &heard);
            let number: Vec<f32> = number.iter().map(|&n| n as f32).collect();
            let number = g.constant(&[groups], &number);
            let z = g.constant(&[groups, config.width], &z);
            let drop = (!drop.is_empty()).then(|| g.constant(&[groups], drop));
            let given = GroupInputs {
                x: &x,
                t: &t,
                audio: &audio,
                drop_audio: drop.as_ref(),
                number: &number,
                z: &z,
                mask: None,
            };
            let wanted = denoiser.forward(&mut g, &given).expect("shapes fit");
            for (name, wanted) in [(GroupNames::X0, &wanted.x0), (GroupNames::W, &wanted.w)] {
                let (shape, found) = session.run(&inputs, name).expect("an answer");
                assert_eq!(shape, wanted.shape(), "{name} of {groups} × {dancers} × {frames}");
                let difference = max_difference(&found, wanted.data());
                assert!(difference <= 1e-4, "{name} of {groups} × {dancers}: {difference:e}");
                let spread = wanted.data().iter().map(|x| x * x).sum::<f32>() / wanted.len() as f32;
                assert!(spread > 1e-4, "an answer of nothing would agree with anything: {spread}");
            }
        }
    }
}

#[test]
fn a_score_of_groups_is_what_the_interpreter_says() {
    let folder = tempfile::tempdir().expect("a folder");
    for config in [tiny(), GroupConfig { score_patch_frames: 1, score_layers: 2, ..tiny() }] {
        let parameters: Parameters<f32> = random(GroupScore::new(&config).1, 7);
        let weights = |id| parameters.unpacked(id);
        let graph = group_score(&config, &weights, Storage::Fp32).expect("a graph");
        let mut session = session(file(graph), folder.path(), "score.onnx");
        let (score, _) = GroupScore::new(&config);
        for (groups, dancers, frames, _) in CASES {
            let rows = groups * dancers;
            let x0 = normal(rows * frames * MOTION_DIM, 8);
            let w = normal(groups * config.width, 9);
            let t: Vec<i64> = (0..rows).map(|i| (i as i64 * 377) % 1000).collect();
            let number = vec![config.embedded_number(dancers) as i64; groups];
            let inputs = [
                floats(GroupScoreNames::X0, &[rows, frames, MOTION_DIM], &x0),
                integers(GroupScoreNames::T, &t),
                floats(GroupScoreNames::W, &[groups, config.width], &w),
                integers(GroupScoreNames::NUMBER, &number),
            ];
            let arena = Arena::default();
            let mut g = Eager::new(&parameters, &arena);
            let as_floats = |values: &[i64]| values.iter().map(|&x| x as f32).collect::<Vec<_>>();
            let x0 = g.constant(&[rows, frames, MOTION_DIM], &x0);
            let t = g.constant(&[rows], &as_floats(&t));
            let w = g.constant(&[groups, config.width], &w);
            let number = g.constant(&[groups], &as_floats(&number));
            let given = GroupScoreInputs {
                x0: &x0,
                t: &t,
                w: &w,
                number: &number,
                mask: None,
                there: None,
            };
            let wanted = score.forward(&mut g, &given).expect("shapes fit");
            for (name, wanted) in [
                (GroupScoreNames::LOG_RATIO, wanted.log_ratio),
                (GroupScoreNames::AGREEMENT, wanted.agreement),
            ] {
                let (shape, found) = session.run(&inputs, name).expect("an answer");
                assert_eq!(shape, [groups, 1]);
                let difference = max_difference(&found, wanted.data());
                assert!(
                    difference <= 1e-4,
                    "{name}: {groups} × {dancers} × {frames}: {difference:e}"
                );
            }
        }
    }
}
