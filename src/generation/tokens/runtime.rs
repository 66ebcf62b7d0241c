//! The networks of a model of tokens in onnxruntime.

use std::borrow::Cow;
use std::path::Path;

use ndarray::{Array3, ArrayView3};

use super::networks::{PlanWindow, PlannerNetworks, TokenizerNetworks, WindowPlan};
use crate::audio::FEATURE_DIM;
use crate::generation::card::{ModelFileName, file_names};
use crate::generation::engine::EngineError;
use crate::generation::pool::Pool;
use crate::generation::runtime::SessionPlan;
use crate::model::{PlannerConfig, PlannerKind, TokensConfig};
use crate::motion::CLOCK_DIM;
use crate::motion::style::STYLE_DIM;
use crate::onnx::{
    NamedTensor, Numbers, OnnxError, PlannerMusicNames, PlannerNames, PlannerStepNames, Runtime,
    Session, SessionOptions, SignalDenoiserNames, SignalNames, TokenEncoderNames,
};

/// Name of onnxruntime in flags and tables.
const NAME: &str = "onnx";

/// Opens a file of a model as often as there are workers.
fn sessions(
    runtime: &Runtime,
    path: &Path,
    plan: SessionPlan,
    has: impl Fn(&Session) -> Result<(), OnnxError>,
) -> Result<Pool<Session>, OnnxError> {
    let options = SessionOptions {
        n_threads: plan.n_threads,
        is_alone: plan.n_workers == 1,
        device: plan.device,
        is_optimized: false,
    };
    let open = |_| {
        let session = Session::open(runtime, path, options)?;
        has(&session)?;
        Ok(session)
    };
    let opened = (0..plan.n_workers.max(1)).map(open).collect::<Result<Vec<_>, OnnxError>>()?;
    Ok(Pool::new(opened))
}

/// The networks of a tokenizer.
pub struct OnnxTokenizer {
    config: TokensConfig,
    n_workers: usize,
    encoder: Pool<Session>,
    signal: Pool<Session>,
    denoiser: Pool<Session>,
}

impl OnnxTokenizer {
    /// Loads the files of a model in a folder.
    ///
    /// # Errors
    /// Errors of onnxruntime about a file, or inputs and outputs that are not those of a model.
    pub fn open(
        runtime: &Runtime,
        folder: &Path,
        config: &TokensConfig,
        plan: SessionPlan,
    ) -> Result<Self, OnnxError> {
        let open = |name, inputs: &[&str], output: &str, n_axes| {
            sessions(runtime, &folder.join(name), plan, |session| {
                session.expect_of(inputs, &[output], n_axes)
            })
        };
        type Denoiser = SignalDenoiserNames;
        Ok(Self {
            config: config.clone(),
            n_workers: plan.n_workers.max(1),
            encoder: open(
                file_names::ENCODER,
                &[TokenEncoderNames::MOTION],
                TokenEncoderNames::TOKENS,
                2,
            )?,
            signal: open(file_names::SIGNAL, &[SignalNames::TOKENS], SignalNames::SIGNAL, 3)?,
            denoiser: open(
                file_names::DENOISER,
                &[Denoiser::X, Denoiser::T, Denoiser::SIGNAL],
                Denoiser::X0,
                3,
            )?,
        })
    }
}

impl TokenizerNetworks for OnnxTokenizer {
    fn name(&self) -> &'static str {
        NAME
    }

    fn n_workers(&self) -> usize {
        self.n_workers
    }

    fn encode(&self, motion: ArrayView3<f32>) -> Result<Vec<u32>, EngineError> {
        let given = [view(TokenEncoderNames::MOTION, &motion)];
        let (_, found) =
            self.encoder.with(|session| session.run(&given, TokenEncoderNames::TOKENS))?;
        Ok(found.into_iter().map(|token| token as u32).collect())
    }

    fn signal(
        &self,
        tokens: &[u32],
        (n, frames): (usize, usize),
    ) -> Result<Array3<f32>, EngineError> {
        let shape = vec![n, self.config.n_tokens(frames)];
        let given = [whole(SignalNames::TOKENS, shape, tokens)];
        let made = self.signal.with(|session| session.run(&given, SignalNames::SIGNAL))?;
        let n_made = self.config.n_tokens(frames) * self.config.frames_per_token;
        array("the shape of the signal", made, [n, n_made, self.config.width])
    }

    fn denoise(
        &self,
        x: ArrayView3<f32>,
        t: usize,
        signal: ArrayView3<f32>,
    ) -> Result<Array3<f32>, EngineError> {
        let (n, frames, channels) = x.dim();
        let given = [
            view(SignalDenoiserNames::X, &x),
            whole(SignalDenoiserNames::T, vec![n], &vec![t as u32; n]),
            view(SignalDenoiserNames::SIGNAL, &signal),
        ];
        let made = self.denoiser.with(|session| session.run(&given, SignalDenoiserNames::X0))?;
        array("the shape of the estimate", made, [n, frames, channels])
    }
}

/// A planner: the whole network, or, of one that plans token by token, its conditions and its steps.
pub struct OnnxPlanner {
    config: PlannerConfig,
    sessions: PlannerSessions,
}

enum PlannerSessions {
    Masked(Pool<Session>),
    Autoregressive { music: Pool<Session>, step: Pool<Session> },
}

impl OnnxPlanner {
    /// Returns the files that are run.
    pub fn files(config: &PlannerConfig) -> &'static [ModelFileName] {
        match config.kind {
            PlannerKind::Masked => &[ModelFileName::Planner],
            PlannerKind::Autoregressive => {
                &[ModelFileName::PlannerMusic, ModelFileName::PlannerStep]
            }
        }
    }

    /// Loads the files of a model in a folder.
    ///
    /// # Errors
    /// Errors of onnxruntime about a file, or inputs and outputs that are not those of a model.
    pub fn open(
        runtime: &Runtime,
        folder: &Path,
        config: &PlannerConfig,
        plan: SessionPlan,
    ) -> Result<Self, OnnxError> {
        let open = |name, inputs: &[&str], outputs: &[&str]| {
            sessions(runtime, &folder.join(name), plan, |session| {
                session.expect_of(inputs, outputs, 3)
            })
        };
        let sessions = match config.kind {
            PlannerKind::Masked => PlannerSessions::Masked(open(
                file_names::PLANNER,
                &[PlannerNames::TOKENS, PlannerNames::AUDIO],
                &[PlannerNames::LOGITS],
            )?),
            PlannerKind::Autoregressive => {
                type Step = PlannerStepNames;
                PlannerSessions::Autoregressive {
                    music: open(
                        file_names::PLANNER_MUSIC,
                        &[PlannerNames::AUDIO],
                        &[PlannerMusicNames::LOCAL],
                    )?,
                    step: open(
                        file_names::PLANNER_STEP,
                        &[Step::TOKENS, Step::LOCAL, Step::GLOBAL, Step::PAST],
                        &[Step::LOGITS, Step::PRESENT],
                    )?,
                }
            }
        };
        Ok(Self { config: config.clone(), sessions })
    }

    /// Returns the conditions of a window as inputs, the same for each answer.
    fn heard(&self, window: &PlanWindow) -> Vec<NamedTensor<'static>> {
        let (n, frames) = (window.withheld.len(), window.condition.nrows());
        let columns = |range: std::ops::Range<usize>| -> Vec<f32> {
            let part = window.condition.slice(ndarray::s![.., range]);
            part.iter().copied().collect::<Vec<f32>>().repeat(n)
        };
        let features = columns(0..FEATURE_DIM);
        let mut given = vec![floats(PlannerNames::AUDIO, vec![n, frames, FEATURE_DIM], features)];
        if self.config.clock {
            let clock = columns(FEATURE_DIM..FEATURE_DIM + CLOCK_DIM);
            given.push(floats(PlannerNames::CLOCK, vec![n, frames, CLOCK_DIM], clock));
        }
        let dropped = window.drops(|withheld| withheld.music);
        given.push(floats(PlannerNames::DROP_AUDIO, vec![n], dropped));
        let width = self.config.constraint_dim;
        if width > 0 {
            let (asked, without) = match window.constraints {
                Some(asked) => (
                    asked.iter().copied().collect::<Vec<f32>>().repeat(n),
                    window.drops(|withheld| withheld.constraints),
                ),
                None => (vec![0.0; n * frames * width], vec![1.0; n]),
            };
            given.push(floats(PlannerNames::CONSTRAINTS, vec![n, frames, width], asked));
            given.push(floats(PlannerNames::DROP_CONSTRAINTS, vec![n], without));
        }
        if let Some(style) = window.style.filter(|_| self.config.style_dim > 0) {
            given.push(floats(PlannerNames::STYLE, vec![n, STYLE_DIM], style.repeat(n)));
        }
        given
    }
}

impl PlannerNetworks for OnnxPlanner {
    fn name(&self) -> &'static str {
        NAME
    }

    fn begin<'a>(&'a self, window: &PlanWindow) -> Result<Box<dyn WindowPlan + 'a>, EngineError> {
        let n = window.withheld.len();
        let heard = self.heard(window);
        match &self.sessions {
            PlannerSessions::Masked(planner) => {
                Ok(Box::new(MaskedPlan { of: self, planner, n_answers: n, heard }))
            }
            PlannerSessions::Autoregressive { music, step } => {
                let names = [PlannerMusicNames::LOCAL, PlannerMusicNames::GLOBAL];
                let [local, global] = music.with(|session| session.run_for(&heard, names))?;
                let given = |name, (shape, numbers)| floats(name, shape, numbers);
                let conditions = vec![
                    given(PlannerStepNames::LOCAL, local),
                    given(PlannerStepNames::GLOBAL, global),
                ];
                let past = (vec![n, 0, self.config.cache_dim()], Vec::new());
                Ok(Box::new(SteppedPlan { of: self, step, n_answers: n, conditions, past }))
            }
        }
    }
}

/// A window of a masked planner.
struct MaskedPlan<'a> {
    of: &'a OnnxPlanner,
    planner: &'a Pool<Session>,
    n_answers: usize,
    heard: Vec<NamedTensor<'static>>,
}

impl WindowPlan for MaskedPlan<'_> {
    fn logits(&mut self, tokens: &[u32]) -> Result<Vec<f32>, EngineError> {
        let n = self.n_answers;
        let mut given = self.heard.clone();
        given.push(whole(PlannerNames::TOKENS, vec![n, tokens.len()], &tokens.repeat(n)));
        let made = self.planner.with(|session| session.run(&given, PlannerNames::LOGITS))?;
        checked(made, [n, tokens.len(), self.of.config.codes])
    }
}

/// A window that is planned token by token.
struct SteppedPlan<'a> {
    of: &'a OnnxPlanner,
    step: &'a Pool<Session>,
    n_answers: usize,
    conditions: Vec<NamedTensor<'static>>,
    /// The cache: its sizes and numbers.
    past: (Vec<usize>, Vec<f32>),
}

impl WindowPlan for SteppedPlan<'_> {
    fn logits(&mut self, tokens: &[u32]) -> Result<Vec<f32>, EngineError> {
        let (n, codes) = (self.n_answers, self.of.config.codes);
        // The next token stands behind those that are known; its value is not read.
        let seen = [tokens, &[0]].concat();
        let (shape, numbers) = std::mem::take(&mut self.past);
        let n_new = seen.len() - shape[1];
        let mut given = self.conditions.clone();
        given.push(whole(PlannerStepNames::TOKENS, vec![n, seen.len()], &seen.repeat(n)));
        given.push(floats(PlannerStepNames::PAST, shape, numbers));
        let names = [PlannerStepNames::LOGITS, PlannerStepNames::PRESENT];
        let [logits, present] = self.step.with(|session| session.run_for(&given, names))?;
        self.past = present;
        let logits = checked(logits, [n, n_new, codes])?;
        let answers = logits.chunks_exact(n_new * codes);
        Ok(answers.flat_map(|answer| &answer[(n_new - 1) * codes..]).copied().collect())
    }
}

fn view<'a>(name: &'static str, x: &'a ArrayView3<'a, f32>) -> NamedTensor<'a> {
    let numbers = match x.as_slice() {
        Some(numbers) => Cow::Borrowed(numbers),
        None => Cow::Owned(x.iter().copied().collect()),
    };
    NamedTensor { name, shape: x.shape().to_vec(), numbers: Numbers::Float(numbers) }
}

fn floats(name: &'static str, shape: Vec<usize>, numbers: Vec<f32>) -> NamedTensor<'static> {
    NamedTensor { name, shape, numbers: Numbers::Float(numbers.into()) }
}

fn whole(name: &'static str, shape: Vec<usize>, numbers: &[u32]) -> NamedTensor<'static> {
    let numbers: Vec<i64> = numbers.iter().map(|&x| i64::from(x)).collect();
    NamedTensor { name, shape, numbers: Numbers::Integer(numbers.into()) }
}

/// Returns the logits of an answer if it has the sizes that were asked for.
fn checked(
    (shape, numbers): (Vec<usize>, Vec<f32>),
    expected: [usize; 3],
) -> Result<Vec<f32>, EngineError> {
    if shape == expected {
        return Ok(numbers);
    }
    let what = "the shape of the logits";
    Err(EngineError::Shape { what, found: shape, expected: expected.to_vec() })
}

fn array(
    what: &'static str,
    (shape, numbers): (Vec<usize>, Vec<f32>),
    expected: [usize; 3],
) -> Result<Array3<f32>, EngineError> {
    let refuse =
        |found: Vec<usize>| EngineError::Shape { what, found, expected: expected.to_vec() };
    if shape != expected {
        return Err(refuse(shape));
    }
    Array3::from_shape_vec(expected, numbers).map_err(|_| refuse(shape))
}
