//! Baselines that are sampled: what a run's motion is worth is seen beside what its sampler makes of
//! networks that learned nothing, and of the trained ones without music.
//!
//! Sampling takes minutes, so that what was sampled is kept in the store under a digest of everything that
//! determines it: `baselines/<digest>.npy`.

pub(super) mod cache;
#[cfg(test)]
mod tests;
pub mod tokens;

use std::num::NonZeroUsize;
use std::sync::Mutex;

use anyhow::{Context as _, ensure};
use ndarray::{Array2, Axis, concatenate};

use crate::audio::FEATURE_DIM;
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing};
use crate::generation::{
    EagerEngine, EngineError, FamilyCard as _, Generator, ModelCard, OVERLAP_FRAMES, Sampling,
    Track,
};
use crate::model::condition;
use crate::motion::postprocess::{PostProcessConfig, process};
use crate::stages::Progress;
use crate::stages::generate::{MotionSettings, PostProcessParams, seed_of};
use crate::stages::model_files::OpenModel;
use crate::stages::pool::{self, lock};
use crate::store::Location;
use crate::store::tables::GenerationRow;

/// What motion is sampled from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Baseline {
    /// The run's networks, UNet and decoder, with their first weights, and the music. The UNet's last
    /// convolution, which begins at zero, is drawn like any other ([`OpenModel::untrained`]): with zeros its
    /// prediction is constant, and a baseline that hardly moves is beaten by anything.
    Untrained,
    /// The trained networks with the music withheld: guidance 0.
    NoMusic,
}

impl Baseline {
    /// Returns the name of the baseline in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Untrained => "untrained",
            Self::NoMusic => "no_music",
        }
    }
}

/// A window of music.
#[derive(Clone, Debug)]
pub struct MusicWindow {
    pub phrase_id: String,
    /// Its first frame in the phrase.
    pub first_frame: usize,
    /// Features as the table has them, \[T, 163\].
    pub features: Array2<f32>,
    /// Bar phase of its frames, \[T\], for post-processing that takes the phase from the music.
    pub phase: Option<Vec<f64>>,
    /// Clock of its frames, \[T, 10\], for a network that hears it.
    pub clock: Option<Array2<f32>>,
}

/// Motion that was sampled for a window of music.
#[derive(Clone, Debug, PartialEq)]
pub struct BaselineMotion {
    /// As it was decoded, \[T, 25\].
    pub decoded: Array2<f32>,
    /// After the post-processing of the run, \[T, 25\].
    pub frames: Array2<f32>,
}

/// The windows to sample, with model, settings and seed.
pub struct BaselineRequest<'a> {
    pub store: &'a Location,
    pub model: &'a OpenModel,
    pub settings: &'a RunSettings,
    /// The noise of a window follows from it, the phrase and the first frame.
    pub seed: u64,
    pub windows: &'a [MusicWindow],
    pub threads: NonZeroUsize,
}

/// The part of a run's settings with which baselines are sampled: one candidate, without constraints or
/// priming.
#[derive(Clone, Debug, PartialEq)]
pub struct RunSettings(MotionSettings);

impl RunSettings {
    /// Reads the settings of a run; those of a run that release 0.1 made follow from the columns of its row, and
    /// what it has no columns for is as generate does it by default.
    ///
    /// # Errors
    /// One sentence for a sampler or settings that this program does not know, or that the model cannot be
    /// sampled with.
    pub fn of_run(row: &GenerationRow, card: &ModelCard) -> anyhow::Result<Self> {
        let again = || {
            format!(
                "run \"{}\" has settings that this program cannot sample with; make its motions again with \
                 motiongen generate --force",
                row.run
            )
        };
        let mut settings = match &row.settings {
            Some(text) => serde_json::from_str(text).with_context(again)?,
            None => of_columns(row, card)?,
        };
        settings.best_of = 1;
        settings.prime = None;
        settings.constraints = None;
        settings.uncontrolled = false;
        let check = || -> anyhow::Result<()> {
            settings.sampler.check(Schedule::new(&card.diffusion)?.len())?;
            settings.postprocess.check()?;
            ensure!(
                settings.guidance.is_finite() && settings.guidance >= 0.0,
                "guidance is {}; it must be 0 or more",
                settings.guidance
            );
            ensure!(
                settings.overlap_frames < card.window_frames,
                "windows of {} frames share {}",
                card.window_frames,
                settings.overlap_frames
            );
            Ok(())
        };
        check().with_context(again)?;
        Ok(Self(settings))
    }
}

/// Returns the settings that the columns of a row tell, and defaults for the rest.
fn of_columns(row: &GenerationRow, card: &ModelCard) -> anyhow::Result<MotionSettings> {
    let known = [Sampler::Ddpm, Sampler::Ddim { eta: row.eta.unwrap_or(0.0) }, Sampler::DpmSolver];
    let sampler = known.into_iter().find(|sampler| sampler.name() == row.sampler);
    let sampler = sampler.with_context(|| {
        let names = known.map(Sampler::name).join(", ");
        format!(
            "run \"{}\" was made with sampler \"{}\", and this program has {names}; make its motions again \
             with motiongen generate --force",
            row.run, row.sampler
        )
    })?;
    let n_steps = usize::try_from(row.n_steps).unwrap_or(0);
    Ok(MotionSettings {
        output_version: 0,
        weights: None,
        sampler: SamplerConfig { sampler, n_steps, spacing: Spacing::Trailing, clip: true },
        guidance: row.guidance,
        seed: None,
        best_of: 1,
        style: None,
        overlap_frames: OVERLAP_FRAMES.min(card.window_frames - 1),
        prime: None,
        postprocess: PostProcessParams::usual()
            .config((card.motion_range, card.fusion_variances()))?,
        constraints: None,
        constraint_strength: 1.0,
        soft: false,
        no_clock: false,
        decoder_derives: card.decoder.fusion.is_some(),
        phase_given: false,
        uncontrolled: false,
    })
}

/// Refuses windows that are no music.
fn check_windows(windows: &[MusicWindow]) -> anyhow::Result<()> {
    for MusicWindow { phrase_id, first_frame, features, phase, .. } in windows {
        let (n_frames, n_features) = features.dim();
        ensure!(
            n_frames > 0 && n_features == FEATURE_DIM,
            "features of {phrase_id} from frame {first_frame} are {n_frames} frames of {n_features}; give \
             one or more frames of {FEATURE_DIM}"
        );
        let n_phases = phase.as_ref().map_or(n_frames, Vec::len);
        ensure!(
            n_phases == n_frames,
            "{phrase_id} from frame {first_frame} has {n_phases} phases for {n_frames} frames; give one \
             for each"
        );
    }
    Ok(())
}

/// Returns motion for each window, in order: what the store keeps, else sampled, and kept.
///
/// Same request, same bytes, for any number of threads.
///
/// # Errors
/// When the store cannot be read or written, a file of the model is not what its card says, or the sampler
/// refuses; windows that are no music in a sentence.
pub fn sample(
    baseline: Baseline,
    request: &BaselineRequest,
    progress: &dyn Progress,
) -> anyhow::Result<Vec<BaselineMotion>> {
    let BaselineRequest { store, model, settings, windows, .. } = request;
    check_windows(windows)?;
    if windows.is_empty() {
        return Ok(Vec::new());
    }
    let mut settings = settings.0.clone();
    if baseline == Baseline::NoMusic {
        settings.guidance = 0.0;
    }
    if model.card.unet.style_dim == 0 {
        settings.style = None;
    }
    let digest = cache::digest_of(baseline, request, &settings);
    if let Some(known) = cache::read(store, &digest, windows)? {
        return Ok(known);
    }
    let motions = sample_all(baseline, request, &settings, progress)?;
    cache::write(store, &digest, &motions)?;
    Ok(motions)
}

fn sample_all(
    baseline: Baseline,
    request: &BaselineRequest,
    settings: &MotionSettings,
    progress: &dyn Progress,
) -> anyhow::Result<Vec<BaselineMotion>> {
    let BaselineRequest { model, seed, windows, threads, .. } = request;
    let card = &model.card;
    // Windows are independent: a worker of one thread for each core keeps all of them busy.
    let engine: EagerEngine = match baseline {
        Baseline::Untrained => model.untrained(*threads, NonZeroUsize::MIN)?,
        Baseline::NoMusic => model.eager(*threads, NonZeroUsize::MIN)?,
    };
    let schedule = Schedule::new(&card.diffusion)?;
    let generator = Generator {
        engine: &engine,
        sampling: Sampling {
            config: &settings.sampler,
            schedule: &schedule,
            guidance: settings.guidance,
        },
        normalizer: &card.normalizer,
        window_frames: card.window_frames,
        overlap_frames: settings.overlap_frames,
    };
    let decode = |window: &MusicWindow, parts: &mut Vec<Array2<f32>>| {
        let clock = window.clock.as_ref().filter(|_| !settings.no_clock);
        let clock = clock.map(|clock| clock.view());
        let heard = condition(&card.unet, window.features.view(), clock);
        let track = Track {
            condition: heard.view(),
            // A network without training, or without music, would get from the phase what it is asked to make.
            phase: None,
            seed: seed_of(*seed, &window.phrase_id, window.first_frame, 0),
            style: settings.style,
            constraints: None,
            primed: None,
        };
        generator.run(&track, |frames| -> Result<(), EngineError> {
            parts.push(frames);
            Ok(())
        })
    };
    decoded_windows((windows, *threads), &settings.postprocess, decode, progress)
}

/// Makes motion for each window, in order and several at once, and processes it; `decode` gives the frames of a window
/// in parts.
fn decoded_windows(
    (windows, threads): (&[MusicWindow], NonZeroUsize),
    postprocess: &PostProcessConfig,
    decode: impl Fn(&MusicWindow, &mut Vec<Array2<f32>>) -> Result<(), EngineError> + Sync,
    progress: &dyn Progress,
) -> anyhow::Result<Vec<BaselineMotion>> {
    progress.start("baselines", "windows", windows.len() as u64);
    let motions: Mutex<Vec<Option<BaselineMotion>>> = Mutex::new(vec![None; windows.len()]);
    let mut queue = windows.iter().enumerate();
    pool::run(
        threads,
        || queue.next(),
        |(i, window): (usize, &MusicWindow)| -> anyhow::Result<()> {
            let mut parts: Vec<Array2<f32>> = Vec::new();
            decode(window, &mut parts)?;
            let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
            let decoded = concatenate(Axis(0), &views).context("while joining windows")?;
            let mut frames = decoded.clone();
            process(postprocess, &mut frames, window.phase.as_deref());
            lock(&motions)[i] = Some(BaselineMotion { decoded, frames });
            progress.advance(1);
            Ok(())
        },
    )?;
    progress.finish();
    let motions = motions.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    Ok(motions.into_iter().flatten().collect())
}
