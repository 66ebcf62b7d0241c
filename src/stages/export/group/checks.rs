//! The files of a model of groups, held against the interpreter that trained its networks.

use bytes::Bytes;
use ndarray::Array3;

use super::TrainedGroup;
use crate::audio::FEATURE_DIM;
use crate::autodiff::{Arena, Eager, Interpreter as _, Parameters, Stream};
use crate::generation::ModelFileName;
use crate::model::{
    GroupConfig, GroupInputs, GroupNetworks, GroupScoreInputs, GroupScores, Parameter,
    ParameterList,
};
use crate::motion::{CLOCK_DIM, MOTION_DIM};
use crate::onnx::{GroupNames, GroupScoreNames, Model, NamedTensor, Numbers, Runtime, values_of};
use crate::stages::export::Params;
use crate::stages::export::checks::{
    CheckResults, Difference, FORWARD_TOLERANCE, check_row, difference, sessions, timed,
};
use crate::store::tables::OnnxCheckRow;

/// Groups that both engines are asked about.
#[derive(Clone, Copy)]
struct Case {
    n_groups: usize,
    n_dancers: usize,
    n_frames: usize,
}

/// Holds the files against the interpreter that trained the networks.
pub fn checks(
    trained: &TrainedGroup,
    params: &Params,
    files: &[(ModelFileName, Bytes)],
    runtime: &Runtime,
) -> anyhow::Result<CheckResults> {
    let mut sessions = sessions(files, params, runtime)?;
    let [denoiser, score] = &mut sessions[..] else { unreachable!("two files are written") };
    let network = &trained.state.config.network;
    let (networks, list) = GroupNetworks::new(&network.group);
    let parameters = read_back(files, list)?;
    let arena = Arena::default();
    let window = network.window_frames;
    let n_steps = network.diffusion.n_steps;
    let mut rows = Vec::new();
    for case in [
        Case { n_groups: 1, n_dancers: 5, n_frames: window },
        Case { n_groups: 3, n_dancers: 2, n_frames: window },
        Case { n_groups: 2, n_dancers: 3, n_frames: window / 2 + 17 },
        Case { n_groups: 1, n_dancers: 16, n_frames: 31 },
    ] {
        let given = CheckInputs::new(case, &network.group, n_steps);
        let (found, onnx_s) = timed(|| denoiser.run(&given.of_denoiser(), GroupNames::X0))?;
        let (w, _) = timed(|| denoiser.run(&given.of_denoiser(), GroupNames::W))?;
        let (wanted, eager_s) = timed(|| given.estimate(&networks, &parameters, &arena, trained))?;
        let apart = difference(&found.1, &wanted);
        rows.push((case, "forward", apart, onnx_s, eager_s));
        let (scores, eager_s) =
            timed(|| given.score(&networks, &parameters, &arena, &wanted, &w.1))?;
        for (check, output, wanted_scores) in [
            ("score", GroupScoreNames::LOG_RATIO, &scores.log_ratio),
            ("agreement", GroupScoreNames::AGREEMENT, &scores.agreement),
        ] {
            let (found, onnx_s) = timed(|| score.run(&given.of_score(&wanted, &w.1), output))?;
            rows.push((case, check, difference(&found.1, wanted_scores), onnx_s, eager_s));
        }
    }
    let build = runtime.build();
    let row = |(case, check, apart, onnx_s, eager_s): (Case, &str, Difference, f64, f64)| {
        let shape = (case.n_groups * case.n_dancers, case.n_frames);
        let row = check_row(params, check, shape, apart, FORWARD_TOLERANCE);
        OnnxCheckRow { onnx_s: Some(onnx_s), eager_s, runtime: build.clone(), ..row }
    };
    let rows = rows.into_iter().map(row).collect();
    Ok(CheckResults { rows, runtime: runtime.build() })
}

/// Reads weights out of the files, as the engine does.
fn read_back(
    files: &[(ModelFileName, Bytes)],
    list: ParameterList,
) -> anyhow::Result<Parameters<f32>> {
    let model = |i: usize| Model::read(files[i].1.clone(), None, files[i].0.name());
    let models = [model(0)?, model(1)?];
    let values = |p: &Parameter| {
        let (is_denoiser, name) = GroupNetworks::own_name(&p.name);
        let own = Parameter { name: name.to_owned(), ..p.clone() };
        let i = usize::from(!is_denoiser);
        values_of(&models[i], &own, files[i].0.name())
    };
    for (_, parameter) in list.iter() {
        values(parameter)?;
    }
    Ok(Parameters::from_fn(list, |p| values(p).expect("looked up before")))
}

/// Numbers that both engines are given.
struct CheckInputs {
    case: Case,
    width: usize,
    has_clock: bool,
    number: usize,
    x: Vec<f32>,
    t: Vec<usize>,
    features: Vec<f32>,
    clock: Vec<f32>,
    z: Vec<f32>,
}

impl CheckInputs {
    fn new(case: Case, config: &GroupConfig, n_steps: usize) -> Self {
        let Case { n_groups, n_dancers, n_frames } = case;
        let normal = |n: usize, seed: u64| {
            let mut values = vec![0.0; n];
            Stream::new(seed, 0).normal(0, &mut values);
            values
        };
        Self {
            case,
            width: config.width,
            has_clock: config.clock,
            number: config.embedded_number(n_dancers),
            x: normal(n_groups * n_dancers * n_frames * MOTION_DIM, 11),
            t: (0..n_groups).map(|i| (i + 1) * (n_steps - 1) / n_groups).collect(),
            features: normal(n_groups * n_frames * FEATURE_DIM, 12),
            clock: normal(n_groups * n_frames * CLOCK_DIM, 13),
            z: normal(n_groups * config.width, 14),
        }
    }

    fn t_dancers(&self) -> Vec<usize> {
        self.t.iter().flat_map(|&t| std::iter::repeat_n(t, self.case.n_dancers)).collect()
    }

    fn of_denoiser(&self) -> Vec<NamedTensor<'_>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        let mut inputs = vec![
            floats(GroupNames::X, &[n_groups * n_dancers, n_frames, MOTION_DIM], &self.x),
            whole(GroupNames::T, &self.t),
            floats(GroupNames::AUDIO, &[n_groups, n_frames, FEATURE_DIM], &self.features),
            whole(GroupNames::NUMBER, &vec![self.number; n_groups]),
            floats(GroupNames::Z, &[n_groups, self.width], &self.z),
        ];
        if self.has_clock {
            inputs.push(floats(GroupNames::CLOCK, &[n_groups, n_frames, CLOCK_DIM], &self.clock));
        }
        inputs
    }

    fn of_score<'a>(&'a self, x0: &'a [f32], w: &'a [f32]) -> Vec<NamedTensor<'a>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        vec![
            floats(GroupScoreNames::X0, &[n_groups * n_dancers, n_frames, MOTION_DIM], x0),
            whole(GroupScoreNames::T, &self.t_dancers()),
            floats(GroupScoreNames::W, &[n_groups, self.width], w),
            whole(GroupScoreNames::NUMBER, &vec![self.number; n_groups]),
        ]
    }

    fn estimate(
        &self,
        networks: &GroupNetworks,
        parameters: &Parameters<f32>,
        arena: &Arena<f32>,
        trained: &TrainedGroup,
    ) -> anyhow::Result<Vec<f32>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        let mut features =
            Array3::from_shape_vec((n_groups, n_frames, FEATURE_DIM), self.features.clone())?;
        let rows = features.view_mut().into_shape_with_order((n_groups * n_frames, FEATURE_DIM))?;
        trained.state.scales.features.apply(rows);
        let mut heard = Vec::new();
        for (row, clock) in features.rows().into_iter().zip(self.clock.chunks_exact(CLOCK_DIM)) {
            heard.extend(row);
            heard.extend(clock.iter().filter(|_| self.has_clock));
        }
        let dim = heard.len() / (n_groups * n_frames);
        let mut g = Eager::new(parameters, arena);
        let of_groups = |values: Vec<f32>, g: &Eager<f32>| g.constant(&[n_groups], &values);
        let x = g.constant(&[n_groups * n_dancers, n_frames, MOTION_DIM], &self.x);
        let t = of_groups(self.t.iter().map(|&t| t as f32).collect(), &g);
        let audio = g.constant(&[n_groups, n_frames, dim], &heard);
        let number = of_groups(vec![self.number as f32; n_groups], &g);
        let z = g.constant(&[n_groups, self.width], &self.z);
        let inputs = GroupInputs {
            x: &x,
            t: &t,
            audio: &audio,
            drop_audio: None,
            number: &number,
            z: &z,
            mask: None,
        };
        Ok(networks.denoiser.forward(&mut g, &inputs)?.x0.data().to_vec())
    }

    fn score(
        &self,
        networks: &GroupNetworks,
        parameters: &Parameters<f32>,
        arena: &Arena<f32>,
        x0: &[f32],
        w: &[f32],
    ) -> anyhow::Result<GroupScores<Vec<f32>>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        let mut g = Eager::new(parameters, arena);
        let x0 = g.constant(&[n_groups * n_dancers, n_frames, MOTION_DIM], x0);
        let t: Vec<f32> = self.t_dancers().iter().map(|&t| t as f32).collect();
        let t = g.constant(&[t.len()], &t);
        let w = g.constant(&[n_groups, self.width], w);
        let number = g.constant(&[n_groups], &vec![self.number as f32; n_groups]);
        let inputs =
            GroupScoreInputs { x0: &x0, t: &t, w: &w, number: &number, mask: None, there: None };
        let GroupScores { log_ratio, agreement } = networks.score.forward(&mut g, &inputs)?;
        Ok(GroupScores {
            log_ratio: log_ratio.data().to_vec(),
            agreement: agreement.data().to_vec(),
        })
    }
}

fn floats<'a>(name: &'static str, shape: &[usize], numbers: &'a [f32]) -> NamedTensor<'a> {
    NamedTensor { name, shape: shape.to_vec(), numbers: Numbers::Float(numbers.into()) }
}

fn whole(name: &'static str, numbers: &[usize]) -> NamedTensor<'static> {
    let numbers: Vec<i64> = numbers.iter().map(|&n| n as i64).collect();
    NamedTensor { name, shape: vec![numbers.len()], numbers: Numbers::Integer(numbers.into()) }
}
