//! Baselines of a model of tokens: what is left of its motion without training, without music, and without the order
//! of its tokens.

use std::num::NonZeroUsize;

use anyhow::{Context as _, ensure};
use ndarray::Array2;
use serde::Serialize;

use super::cache::{self, BaselineKeyWindow, key_windows};
use super::{BaselineMotion, MusicWindow, check_windows, decoded_windows};
use crate::audio::FeatureScale;
use crate::diffusion::{DiffusionConfig, Schedule};
use crate::generation::{EngineError, TokenGenerator, TokenTrack, TokensCard};
use crate::model::{PlannerConfig, TokensConfig, condition};
use crate::motion::Normalizer;
use crate::stages::Progress;
use crate::stages::generate::{TokensSettings, seed_of, weights_digest_of_tokens};
use crate::stages::model_folder::ModelFolder;
use crate::stages::tokens_model::{TokenEngines, TokensWeights};
use crate::store::tables::GenerationRow;
use crate::store::{Location, digest};

/// Raised when the same networks, settings and windows give other motion.
const VERSION: u32 = 1;

/// What motion is made by.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TokensBaseline {
    /// Tokenizer and planner with their first weights, and the music.
    Untrained,
    /// The trained networks with the music withheld: guidance 0.
    NoMusic,
    /// The trained networks and the music, but the tokens of each window in an order of chance.
    ShuffledPlan,
}

impl TokensBaseline {
    /// Returns the name of the baseline in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Untrained => "untrained",
            Self::NoMusic => "no_music",
            Self::ShuffledPlan => "shuffled_plan",
        }
    }
}

/// The windows to make motion for, with model, settings and seed.
pub struct TokensBaselineRequest<'a> {
    pub store: &'a Location,
    pub files: &'a ModelFolder,
    pub card: &'a TokensCard,
    pub settings: &'a TokensSettings,
    /// The noise and the tokens of a window follow from it, the phrase and the first frame.
    pub seed: u64,
    pub windows: &'a [MusicWindow],
    pub threads: NonZeroUsize,
}

/// Reads the settings of a run, as far as baselines are made by them: without constraints, of one dancer.
///
/// # Errors
/// One sentence for settings that this program does not know, or that the model cannot be sampled with.
pub fn settings_of_run(row: &GenerationRow, card: &TokensCard) -> anyhow::Result<TokensSettings> {
    let read = || -> anyhow::Result<TokensSettings> {
        let text = row.settings.as_deref().context("its row has no settings")?;
        let settings: TokensSettings = serde_json::from_str(text)?;
        settings.sampler.check(Schedule::new(&card.diffusion)?.len())?;
        settings.plan.check()?;
        settings.postprocess.check()?;
        ensure!(
            settings.guidance.is_finite() && settings.guidance >= 0.0,
            "guidance is {}; it must be 0 or more",
            settings.guidance
        );
        Ok(TokensSettings { constraints: None, group: None, ..settings })
    };
    read().with_context(|| {
        format!(
            "run \"{}\" has settings that this program cannot sample with; make its motions again with motiongen \
             generate --force",
            row.run
        )
    })
}

/// What determines the motion of a baseline.
#[derive(Serialize)]
struct TokensBaselineKey<'a> {
    version: u32,
    baseline: &'static str,
    /// Weights of the model; those of an untrained one follow from its sizes.
    weights: Option<String>,
    tokens: &'a TokensConfig,
    planner: &'a PlannerConfig,
    diffusion: &'a DiffusionConfig,
    window_frames: usize,
    normalizer: &'a Normalizer,
    feature_scale: &'a FeatureScale,
    settings: &'a TokensSettings,
    seed: u64,
    windows: Vec<BaselineKeyWindow<'a>>,
}

/// Returns motion for each window, in order: what the store keeps, else made, and kept.
///
/// Same request, same bytes, for any number of threads.
///
/// # Errors
/// When the store cannot be read or written, a file of the model is not what its card says, or a sampler refuses;
/// windows that are no music in a sentence.
pub fn sample(
    baseline: TokensBaseline,
    request: &TokensBaselineRequest,
    progress: &dyn Progress,
) -> anyhow::Result<Vec<BaselineMotion>> {
    let TokensBaselineRequest { store, card, windows, .. } = request;
    check_windows(windows)?;
    if windows.is_empty() {
        return Ok(Vec::new());
    }
    let mut settings = request.settings.clone();
    if baseline == TokensBaseline::NoMusic {
        settings.guidance = 0.0;
    }
    if card.planner.style_dim == 0 {
        settings.style = None;
    }
    let key = TokensBaselineKey {
        version: VERSION,
        baseline: baseline.name(),
        weights: (baseline != TokensBaseline::Untrained).then(|| weights_digest_of_tokens(card)),
        tokens: &card.tokens,
        planner: &card.planner,
        diffusion: &card.diffusion,
        window_frames: card.window_frames,
        normalizer: &card.normalizer,
        feature_scale: &card.feature_scale,
        settings: &settings,
        seed: request.seed,
        windows: key_windows(windows, card.planner.condition().clock),
    };
    let text = serde_json::to_vec(&key).expect("invariant: numbers and texts become JSON");
    let name = digest(&text);
    if let Some(known) = cache::read(store, &name, windows)? {
        return Ok(known);
    }
    let motions = make_all(baseline, request, &settings, progress)?;
    cache::write(store, &name, &motions)?;
    Ok(motions)
}

fn make_all(
    baseline: TokensBaseline,
    request: &TokensBaselineRequest,
    settings: &TokensSettings,
    progress: &dyn Progress,
) -> anyhow::Result<Vec<BaselineMotion>> {
    let TokensBaselineRequest { files, card, seed, windows, threads, .. } = request;
    let weights = match baseline {
        TokensBaseline::Untrained => TokensWeights::untrained(card),
        TokensBaseline::NoMusic | TokensBaseline::ShuffledPlan => TokensWeights::read(files, card)?,
    };
    // Windows are independent: a worker of one thread for each core keeps all of them busy.
    let TokenEngines { tokens, planner, .. } =
        weights.engines(card, (*threads, NonZeroUsize::MIN))?;
    // As the run that is held against: windows may be shorter than the model's.
    let tokens = match settings.window_frames {
        Some(window_frames) => tokens.with_window(window_frames),
        None => tokens,
    };
    let planner = match baseline {
        TokensBaseline::ShuffledPlan => planner.with_shuffled_plans(),
        TokensBaseline::Untrained | TokensBaseline::NoMusic => planner,
    };
    let schedule = Schedule::new(&card.diffusion)?;
    let generator = TokenGenerator {
        tokens: &tokens,
        planner: &planner,
        plan: &settings.plan,
        sampler: &settings.sampler,
        schedule: &schedule,
        guidance: settings.guidance,
        overlap_tokens: settings.overlap_tokens,
    };
    let decode = |window: &MusicWindow, parts: &mut Vec<Array2<f32>>| {
        let clock = window.clock.as_ref().filter(|_| !settings.no_clock);
        let clock = clock.map(|clock| clock.view());
        let heard = condition(card.planner.condition(), window.features.view(), clock);
        let track = TokenTrack {
            // Without the phase, as for a UNet: it would tell the network what it is asked to make.
            style: settings.style,
            ..TokenTrack::new(
                heard.view(),
                seed_of(*seed, &window.phrase_id, window.first_frame, 0),
            )
        };
        let emit = |frames| -> Result<(), EngineError> {
            parts.push(frames);
            Ok(())
        };
        generator.run(&track, emit).map(drop)
    };
    decoded_windows((windows, *threads), &settings.postprocess, decode, progress)
}
