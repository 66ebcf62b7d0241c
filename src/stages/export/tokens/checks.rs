//! The files of a model of tokens, held against the interpreter that trained its networks.

use std::time::Instant;

use anyhow::{Context as _, ensure};
use bytes::Bytes;

use crate::audio::FEATURE_DIM;
use crate::autodiff::{Arena, Eager, Interpreter as _, Parameters, Stream, Tensor};
use crate::generation::{ModelFileName, TokensCard, tokens_parameters};
use crate::model::{Graph as _, Planner, PlannerInputs, Tokenizer, condition_scale};
use crate::motion::{CLOCK_DIM, MOTION_DIM};
use crate::onnx::{
    Model, NamedTensor, Numbers, PlannerMusicNames, PlannerNames, PlannerStepNames, Runtime,
    Session, SignalDenoiserNames, SignalNames, TokenEncoderNames,
};
use crate::stages::export::Params;
use crate::stages::export::checks::{
    CheckResults, Difference, FORWARD_TOLERANCE, check_row, difference, sessions, timed,
};
use crate::store::tables::OnnxCheckRow;

/// Windows that both engines are asked about.
#[derive(Clone, Copy)]
struct Case {
    n_windows: usize,
    n_frames: usize,
}

/// The networks of a model as the interpreter runs them.
struct Networks {
    tokenizer: Tokenizer,
    of_tokenizer: Parameters<f32>,
    planner: Planner,
    of_planner: Parameters<f32>,
    arena: Arena<f32>,
}

/// Holds the files against the interpreter that trained the networks.
///
/// # Errors
/// When the runtime refuses a file, or the files lack weights.
pub fn checks(
    card: &TokensCard,
    params: &Params,
    files: &[(ModelFileName, Bytes)],
    runtime: &Runtime,
) -> anyhow::Result<CheckResults> {
    let mut sessions = sessions(files, params, runtime)?;
    let [encoder, signal, denoiser, planner, of_steps @ ..] = &mut sessions[..] else {
        unreachable!("four files are written at least")
    };
    let read = |name: ModelFileName| -> anyhow::Result<(Model, String)> {
        let found = files.iter().find(|(known, _)| *known == name);
        let (_, bytes) = found.context("invariant: every file of the family is written")?;
        Ok((Model::read(bytes.clone(), None, name.name())?, name.name().to_owned()))
    };
    let (of_tokenizer, of_planner) = tokens_parameters(card, read)?;
    let networks = Networks {
        tokenizer: Tokenizer::new(&card.tokens).0,
        of_tokenizer,
        planner: Planner::new(&card.planner).0,
        of_planner,
        arena: Arena::default(),
    };
    let window = card.window_frames;
    let mut rows = Vec::new();
    for case in [
        Case { n_windows: 1, n_frames: window },
        Case { n_windows: 3, n_frames: window },
        Case { n_windows: 2, n_frames: window / 2 + 5 },
    ] {
        let given = CheckInputs::new(case, card);
        let (found, onnx_s) =
            timed(|| encoder.run(&given.of_encoder(), TokenEncoderNames::TOKENS))?;
        let (wanted, eager_s) = timed(|| given.encode(&networks))?;
        // Of latents that are as near to two rows rounding may choose either: a share, and no distance.
        let n_apart = found.1.iter().zip(wanted.data()).filter(|(a, b)| a != b).count();
        let share = n_apart as f64 / wanted.len().max(1) as f64;
        let apart = Difference { max_abs: share, rms: share };
        rows.push((case, "tokens", apart, MAX_TOKENS_APART, onnx_s, eager_s));

        let (found, onnx_s) = timed(|| signal.run(&given.of_signal(), SignalNames::SIGNAL))?;
        let (wanted, eager_s) = timed(|| given.signal(&networks))?;
        let apart = difference(&found.1, wanted.data());
        rows.push((case, "signal", apart, FORWARD_TOLERANCE, onnx_s, eager_s));

        let of_denoiser = given.of_denoiser(&wanted);
        let (found, onnx_s) = timed(|| denoiser.run(&of_denoiser, SignalDenoiserNames::X0))?;
        let (wanted, eager_s) = timed(|| given.denoise(&networks, &wanted))?;
        let apart = difference(&found.1, wanted.data());
        rows.push((case, "forward", apart, FORWARD_TOLERANCE, onnx_s, eager_s));

        let (found, onnx_s) = timed(|| planner.run(&given.of_planner(), PlannerNames::LOGITS))?;
        let (wanted, eager_s) = timed(|| given.plan(&networks, card))?;
        let apart = difference(&found.1, wanted.data());
        rows.push((case, "planner", apart, FORWARD_TOLERANCE, onnx_s, eager_s));

        if let [music, step] = of_steps {
            // Position by position with what is kept, against the whole network at once.
            let started = Instant::now();
            let found = given.steps(card, music, step)?;
            let onnx_s = started.elapsed().as_secs_f64();
            let apart = difference(&found, wanted.data());
            rows.push((case, "planner_step", apart, FORWARD_TOLERANCE, onnx_s, eager_s));
        }
    }
    let build = runtime.build();
    let row = |(case, check, apart, tolerance, onnx_s, eager_s): CheckRow| {
        let row = check_row(params, check, (case.n_windows, case.n_frames), apart, tolerance);
        OnnxCheckRow { onnx_s: Some(onnx_s), eager_s, runtime: build.clone(), ..row }
    };
    let rows = rows.into_iter().map(row).collect();
    Ok(CheckResults { rows, runtime: runtime.build() })
}

type CheckRow = (Case, &'static str, Difference, f64, f64, f64);

/// Share of the tokens that may be other ones.
const MAX_TOKENS_APART: f64 = 0.01;

/// Numbers that both engines are given.
struct CheckInputs {
    case: Case,
    n_tokens: usize,
    is_clock_heard: bool,
    /// Of a frame; 0 for a network without.
    constraint_dim: usize,
    motion: Vec<f32>,
    x: Vec<f32>,
    t: Vec<usize>,
    tokens: Vec<usize>,
    features: Vec<f32>,
    clock: Vec<f32>,
    constraints: Vec<f32>,
    /// Of every other window.
    drop_constraints: Vec<f32>,
}

impl CheckInputs {
    fn new(case: Case, card: &TokensCard) -> Self {
        let Case { n_windows, n_frames } = case;
        let normal = |n: usize, seed: u64| {
            let mut values = vec![0.0; n];
            Stream::new(seed, 0).normal(0, &mut values);
            values
        };
        let n_tokens = card.tokens.n_tokens(n_frames);
        let codes = card.tokens.codes;
        Self {
            case,
            n_tokens,
            is_clock_heard: card.planner.clock,
            constraint_dim: card.planner.constraint_dim,
            motion: normal(n_windows * n_frames * MOTION_DIM, 11),
            x: normal(n_windows * n_frames * MOTION_DIM, 12),
            t: (0..n_windows).map(|i| (i + 1) * (card.diffusion.n_steps - 1) / n_windows).collect(),
            tokens: (0..n_windows * n_tokens).map(|i| i * 7919 % codes).collect(),
            features: normal(n_windows * n_frames * FEATURE_DIM, 13),
            clock: normal(n_windows * n_frames * CLOCK_DIM, 14),
            constraints: normal(n_windows * n_frames * card.planner.constraint_dim, 15),
            drop_constraints: (0..n_windows).map(|i| (i % 2) as f32).collect(),
        }
    }

    fn frames(&self, width: usize) -> [usize; 3] {
        [self.case.n_windows, self.case.n_frames, width]
    }

    fn of_encoder(&self) -> Vec<NamedTensor<'_>> {
        vec![floats(TokenEncoderNames::MOTION, &self.frames(MOTION_DIM), &self.motion)]
    }

    fn encode(&self, networks: &Networks) -> anyhow::Result<Tensor<f32>> {
        let mut g = Eager::new(&networks.of_tokenizer, &networks.arena);
        let motion = g.constant(&self.frames(MOTION_DIM), &self.motion);
        Ok(networks.tokenizer.tokens(&mut g, &motion)?)
    }

    fn of_signal(&self) -> Vec<NamedTensor<'_>> {
        vec![whole(SignalNames::TOKENS, &[self.case.n_windows, self.n_tokens], &self.tokens)]
    }

    fn signal(&self, networks: &Networks) -> anyhow::Result<Tensor<f32>> {
        let mut g = Eager::new(&networks.of_tokenizer, &networks.arena);
        let tokens = self.seen(&g);
        let q = networks.tokenizer.codes(&mut g, &tokens)?;
        Ok(networks.tokenizer.whole_signal(&mut g, &q)?)
    }

    fn of_denoiser<'a>(&'a self, signal: &'a Tensor<f32>) -> Vec<NamedTensor<'a>> {
        vec![
            floats(SignalDenoiserNames::X, &self.frames(MOTION_DIM), &self.x),
            whole(SignalDenoiserNames::T, &[self.t.len()], &self.t),
            floats(SignalDenoiserNames::SIGNAL, signal.shape(), signal.data()),
        ]
    }

    fn denoise(&self, networks: &Networks, signal: &Tensor<f32>) -> anyhow::Result<Tensor<f32>> {
        let mut g = Eager::new(&networks.of_tokenizer, &networks.arena);
        let x = g.constant(&self.frames(MOTION_DIM), &self.x);
        let t: Vec<f32> = self.t.iter().map(|&t| t as f32).collect();
        let t = g.constant(&[t.len()], &t);
        let signal = g.constant(signal.shape(), signal.data());
        let signal = g.crop_frames(&signal, &x)?;
        Ok(networks.tokenizer.denoise(&mut g, &x, &t, &signal)?)
    }

    fn of_planner(&self) -> Vec<NamedTensor<'_>> {
        let tokens = [self.case.n_windows, self.n_tokens];
        let mut inputs = vec![
            whole(PlannerNames::TOKENS, &tokens, &self.tokens),
            floats(PlannerNames::AUDIO, &self.frames(FEATURE_DIM), &self.features),
        ];
        if self.is_clock_heard {
            inputs.push(floats(PlannerNames::CLOCK, &self.frames(CLOCK_DIM), &self.clock));
        }
        if self.constraint_dim > 0 {
            let shape = self.frames(self.constraint_dim);
            inputs.push(floats(PlannerNames::CONSTRAINTS, &shape, &self.constraints));
            let (name, dropped) = (PlannerNames::DROP_CONSTRAINTS, &self.drop_constraints);
            inputs.push(floats(name, &[dropped.len()], dropped));
        }
        inputs
    }

    /// Returns the logits of all positions, found one after the other but for the first few, which come together.
    fn steps(
        &self,
        card: &TokensCard,
        music: &mut Session,
        step: &mut Session,
    ) -> anyhow::Result<Vec<f32>> {
        type Step = PlannerStepNames;
        let (n, codes) = (self.case.n_windows, card.planner.codes);
        // The music alone: the first input of the whole planner is its tokens.
        let heard = self.of_planner().split_off(1);
        let names = [PlannerMusicNames::LOCAL, PlannerMusicNames::GLOBAL];
        let [local, global] = music.run_for(&heard, names)?;
        let mut past = (vec![n, 0, card.planner.cache_dim()], Vec::new());
        let mut logits = vec![0.0; n * self.n_tokens * codes];
        let first = (self.n_tokens / 3).max(1);
        for n_seen in first..=self.n_tokens {
            let windows = self.tokens.chunks_exact(self.n_tokens);
            let seen: Vec<usize> = windows.flat_map(|window| &window[..n_seen]).copied().collect();
            let n_new = n_seen - past.0[1];
            let given = [
                whole(Step::TOKENS, &[n, n_seen], &seen),
                floats(Step::LOCAL, &local.0, &local.1),
                floats(Step::GLOBAL, &global.0, &global.1),
                floats(Step::PAST, &past.0, &past.1),
            ];
            let [found, present] = step.run_for(&given, [Step::LOGITS, Step::PRESENT])?;
            ensure!(
                found.0 == [n, n_new, codes],
                "planner_step.onnx returns logits of the shape {:?}, expected {:?}",
                found.0,
                [n, n_new, codes]
            );
            let windows = logits.chunks_exact_mut(self.n_tokens * codes);
            for (window, found) in windows.zip(found.1.chunks_exact(n_new * codes)) {
                window[(n_seen - n_new) * codes..][..found.len()].copy_from_slice(found);
            }
            past = present;
        }
        Ok(logits)
    }

    fn plan(&self, networks: &Networks, card: &TokensCard) -> anyhow::Result<Tensor<f32>> {
        let mut g = Eager::new(&networks.of_planner, &networks.arena);
        let heard = card.planner.condition();
        let scale = condition_scale(heard, &card.feature_scale);
        let rows = self.features.chunks_exact(FEATURE_DIM).zip(self.clock.chunks_exact(CLOCK_DIM));
        let mut audio: Vec<f32> = Vec::with_capacity(self.features.len() + self.clock.len());
        for (features, clock) in rows {
            audio.extend(features);
            audio.extend(if self.is_clock_heard { clock } else { &[] });
        }
        let n_rows = self.case.n_windows * self.case.n_frames;
        let mut audio = ndarray::Array2::from_shape_vec((n_rows, heard.dim()), audio)?;
        scale.apply(audio.view_mut());
        let audio = g.constant(&self.frames(heard.dim()), audio.as_slice().unwrap_or_default());
        let tokens = self.seen(&g);
        let style = (card.planner.style_dim > 0).then(|| {
            let shape = [self.case.n_windows, card.planner.style_dim];
            g.constant(&shape, &vec![0.0; shape[0] * shape[1]])
        });
        let constraints = (self.constraint_dim > 0).then(|| {
            let shape = self.frames(self.constraint_dim);
            let dropped = &self.drop_constraints;
            (g.constant(&shape, &self.constraints), g.constant(&[dropped.len()], dropped))
        });
        let inputs = PlannerInputs {
            tokens: &tokens,
            audio: &audio,
            drop_audio: None,
            style: style.as_ref(),
            constraints: constraints.as_ref().map(|(asked, _)| asked),
            drop_constraints: constraints.as_ref().map(|(_, dropped)| dropped),
            mask: None,
        };
        Ok(networks.planner.forward(&mut g, &inputs)?)
    }

    fn seen(&self, g: &Eager<f32>) -> Tensor<f32> {
        let tokens: Vec<f32> = self.tokens.iter().map(|&token| token as f32).collect();
        g.constant(&[self.case.n_windows, self.n_tokens], &tokens)
    }
}

fn floats<'a>(name: &'static str, shape: &[usize], values: &'a [f32]) -> NamedTensor<'a> {
    NamedTensor { name, shape: shape.to_vec(), numbers: Numbers::Float(values.into()) }
}

fn whole<'a>(name: &'static str, shape: &[usize], values: &[usize]) -> NamedTensor<'a> {
    let values: Vec<i64> = values.iter().map(|&x| x as i64).collect();
    NamedTensor { name, shape: shape.to_vec(), numbers: Numbers::Integer(values.into()) }
}
