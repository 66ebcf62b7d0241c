//! What the user asks of generate, and what follows from it.

mod postprocess;

use std::num::NonZeroUsize;
use std::path::PathBuf;

use anyhow::{Context as _, anyhow, ensure};
use serde::{Deserialize, Serialize};

use super::constraints_file::ConstraintsRequest;
use super::outputs::{MotionFormat, StreamFormat};
use super::settings::{MotionSettings, OUTPUT_VERSION};
use crate::diffusion::{Sampler, SamplerConfig, Schedule, Spacing, TokenSampling};
use crate::generation::{ConsistencyForm, Control, FamilyCard, ModelCard, OVERLAP_FRAMES};
use crate::motion::postprocess::PostProcessConfig;
use crate::motion::style::STYLE_DIM;
use crate::motion::style_name::{NamedStyles, is_style_name};
use crate::motion::{Channel, Normalizer};
use crate::stages::model_files::EngineParams;
use crate::stages::motion_source::read_motion;
use crate::stages::{ClientParams, RARE};
use crate::store::{Shard, digest};
pub use postprocess::PostProcessParams;

/// The samplers by the names of the flag.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum SamplerName {
    /// Every step that was trained, with fresh noise at each.
    Ddpm,
    /// 20 to 100 steps.
    Ddim,
    /// DPM-Solver++(2M): 8 to 20 steps.
    #[default]
    DpmSolver,
}

/// The forms of --consistency by the names of the flag.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum ConsistencyFormName {
    Direction,
    Estimate,
    Noise,
    Mean,
}

impl From<ConsistencyFormName> for ConsistencyForm {
    fn from(name: ConsistencyFormName) -> Self {
        match name {
            ConsistencyFormName::Direction => Self::Direction,
            ConsistencyFormName::Estimate => Self::Estimate,
            ConsistencyFormName::Noise => Self::Noise,
            ConsistencyFormName::Mean => Self::Mean,
        }
    }
}

/// Which phrases of a store.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Tracks {
    /// Those with music of their own.
    #[default]
    Songs,
    /// Those that library constructed.
    Constructed,
    /// All with features.
    All,
}

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables; its model and, without --audio, its phrases.
    #[arg(long, value_name = "URL")]
    pub store: Option<String>,
    /// Name of a model of the store, or the folder of one [default: the model that ships with the program, `pretrained`, or
    /// `group` where --dancers or --consistency are given]
    #[arg(long, value_name = "NAME|DIR")]
    pub model: Option<String>,
    /// Audio files to dance to, instead of the store's phrases.
    #[arg(long, value_name = "FILE", num_args = 1.., requires = "output")]
    pub audio: Vec<PathBuf>,
    /// With --audio: the folder for motions, pictures and pages.
    #[arg(long, value_name = "DIR", requires = "audio")]
    pub output: Option<PathBuf>,
    /// With --audio: what is written of each motion.
    #[arg(long, value_enum, value_name = "FORMAT", value_delimiter = ',', num_args = 1..,
          default_values_t = MotionFormat::DEFAULT)]
    pub format: Vec<MotionFormat>,
    /// With --audio: writes the frames of the first motion, as soon as they are final and before
    /// post-processing; - is the standard output.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-", requires = "audio",
          hide_short_help = RARE)]
    pub stream: Option<String>,
    /// What --stream writes: lines of CSV, or of JSON.
    #[arg(long, value_enum, value_name = "FORMAT", default_value_t, requires = "stream",
          hide_short_help = RARE)]
    pub stream_format: StreamFormat,
    /// Name under which tables keep the motions [default: the model's]
    #[arg(long, value_name = "NAME")]
    pub run: Option<String>,
    /// Which phrases of the store.
    #[arg(long, value_enum, default_value_t = Tracks::Songs, help_heading = "Phrases",
          hide_short_help = RARE)]
    pub tracks: Tracks,
    /// Only phrases of this split: train, validation or test.
    #[arg(long, value_name = "SPLIT", help_heading = "Phrases", hide_short_help = RARE)]
    pub split: Option<String>,
    /// Only these phrases.
    #[arg(long, value_name = "ID", num_args = 1.., help_heading = "Phrases",
          hide_short_help = RARE)]
    pub phrase: Vec<String>,
    /// Part of the job that this process does: i/n, or auto inside an array job.
    #[arg(long, value_name = "I/N", default_value_t = Shard::WHOLE.to_string(),
          help_heading = "Phrases", hide_short_help = RARE)]
    pub shard: String,
    /// Motions for each phrase.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN, help_heading = "Sampling")]
    pub samples: NonZeroUsize,
    /// Candidates for each motion, of which the one with the best score is kept.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN, help_heading = "Sampling",
          hide_short_help = RARE)]
    pub best_of: NonZeroUsize,
    /// How noise becomes motion.
    #[arg(long, value_enum, default_value_t = SamplerName::DpmSolver, help_heading = "Sampling",
          hide_short_help = RARE)]
    pub sampler: SamplerName,
    /// Steps of the sampler [default: 20; all of ddpm; 27 of ddpm for a model of the family tokens]
    #[arg(long, value_name = "N", help_heading = "Sampling", hide_short_help = RARE)]
    pub steps: Option<usize>,
    /// Which steps of the diffusion are visited.
    #[arg(long, value_enum, default_value_t = Spacing::Trailing, help_heading = "Sampling",
          hide_short_help = RARE)]
    pub spacing: Spacing,
    /// 1 follows the music, more exaggerates it, 0 ignores it [default: the model's]
    #[arg(long, value_name = "X", help_heading = "Sampling")]
    pub guidance: Option<f64>,
    /// Withhold the clock from a model that hears it, so that it dances to the features alone.
    #[arg(long, help_heading = "Sampling", hide_short_help = RARE)]
    pub no_clock: bool,
    /// Share of the noise that ddim renews at every step, 0 to 1.
    #[arg(long, value_name = "X", default_value_t = 0.0, help_heading = "Sampling",
          hide_short_help = RARE)]
    pub eta: f64,
    /// Seed of all noise.
    #[arg(long, value_name = "N", default_value_t = 0, help_heading = "Sampling")]
    pub seed: u64,
    /// Style, of a model that takes one: a name that `motiongen model` lists, or eight values from -1 to 1.
    #[arg(long, value_name = "NAME|S0,…,S7", value_delimiter = ',', num_args = 1.., allow_hyphen_values = true,
          help_heading = "Sampling", hide_short_help = RARE)]
    pub style: Vec<String>,
    /// Begin from the motion of the library's phrases whose music is nearest, made noisy, instead of from noise
    /// alone: the share of it that is kept, 0 to 1; needs --store with a library.
    #[arg(long, value_name = "X", help_heading = "Sampling", hide_short_help = RARE)]
    pub prime: Option<f64>,
    /// Dancers, for a model of the family group or tokens [default: 3; of the family tokens 1]
    #[arg(long, value_name = "N", help_heading = "Groups")]
    pub dancers: Option<usize>,
    /// Guidance by the score of a model of the family group, from -1 (away from one group, meant for dancers who go
    /// each a way of their own) to 1 (towards one group, meant for unison); docs/groups.md has what it was seen to
    /// do; other than 0 it takes longer; of a model of the family tokens the share of the first dancer's plan that the
    /// others keep, 0 to 1 [default: 0]
    #[arg(long, value_name = "GAMMA", allow_hyphen_values = true, help_heading = "Groups",
          hide_short_help = RARE)]
    pub consistency: Option<f64>,
    /// What --consistency moves at every step: the estimate, by a set length along the gradient, or by the gradient as it
    /// is; or, more slowly, the noise that is predicted (Dhariwal and Nichol) or the mean of the step (the paper), by the
    /// gradient through the network. For a model of the family group [default: direction]
    #[arg(long, value_name = "FORM", value_enum, help_heading = "Groups", hide_short_help = RARE)]
    pub consistency_form: Option<ConsistencyFormName>,
    /// How far --consistency 1 or -1 goes: standard deviations of what is open yet a step, by a direction; a factor of the
    /// gradient, by the other forms. For a model of the family group [default: 1]
    #[arg(long, value_name = "S", help_heading = "Groups", hide_short_help = RARE)]
    pub consistency_scale: Option<f64>,
    /// Let bodies touch where they were sampled so, instead of moving them apart.
    #[arg(long, help_heading = "Groups", hide_short_help = RARE)]
    pub no_separation: bool,
    /// Frames that neighbouring windows of a long track share.
    #[arg(long, value_name = "N", default_value_t = OVERLAP_FRAMES, help_heading = "Sampling",
          hide_short_help = RARE)]
    pub overlap: usize,
    /// Frames of a window of a long track, for a model of the family tokens; of a short one the first frames come
    /// sooner [default: the model's, which is the most]
    #[arg(long, value_name = "N", help_heading = "Tokens", hide_short_help = RARE)]
    pub window: Option<usize>,
    /// Iterations in which a model of the family tokens plans a window; of one that plans token by token no matter.
    #[arg(long, value_name = "N", default_value_t = TokenSampling::default().n_iterations,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub plan_iterations: usize,
    /// How evenly tokens are drawn: 1 as the planner says, 0 always the likeliest.
    #[arg(long, value_name = "X", default_value_t = TokenSampling::default().temperature,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub plan_temperature: f64,
    /// Share of the tokens, the most probable ones, that may be drawn.
    #[arg(long, value_name = "SHARE", default_value_t = TokenSampling::default().top_share,
          help_heading = "Tokens", hide_short_help = RARE)]
    pub plan_top: f64,
    /// Poses and values that the motion must have: a TOML or JSON file (docs/generate.md); a path or way points as CSV
    /// (time_s or frame, x, y, z, heading_deg or a quaternion); or as .npy, [T, 3] or [T, 25], NaN where free.
    #[arg(long, value_name = "FILE", help_heading = "Control", hide_short_help = RARE)]
    pub constraints: Option<PathBuf>,
    /// Where constraints act: on the plan of a model of the family tokens, in decoding (of the family unet, by
    /// in-painting), on both, or nowhere, where it is only told how far motion is from them [default: both of a planner that
    /// knows constraints, decode of other models]
    #[arg(long, value_enum, value_name = "PATHS", help_heading = "Control", hide_short_help = RARE)]
    pub control: Option<Control>,
    /// Share of the way to a constraint that every step of the sampling goes, 0 to 1.
    #[arg(long, value_name = "X", default_value_t = 1.0, help_heading = "Control",
          hide_short_help = RARE)]
    pub constraint_strength: f64,
    /// Leave the rest of the way, instead of bending the finished motion to every constraint.
    #[arg(long, help_heading = "Control", hide_short_help = RARE)]
    pub soft: bool,
    #[command(flatten)]
    pub postprocess: PostProcessParams,
    #[command(flatten)]
    pub engine: EngineParams,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Make every motion again, made or not.
    #[arg(long)]
    pub force: bool,
}

/// How windows are sampled, by a model of any family.
pub struct SamplingSettings {
    pub sampler: SamplerConfig,
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// Frames that neighbouring windows share.
    pub overlap_frames: usize,
}

impl Params {
    /// Returns how windows of a model are sampled.
    ///
    /// # Errors
    /// One sentence for what this model or any sampler cannot do.
    pub fn sampling(&self, card: &impl FamilyCard) -> anyhow::Result<SamplingSettings> {
        let model = card.shared();
        let n_train = Schedule::new(model.diffusion)?.len();
        let sampler = match self.sampler {
            SamplerName::Ddpm => Sampler::Ddpm,
            SamplerName::Ddim => Sampler::Ddim { eta: self.eta },
            SamplerName::DpmSolver => Sampler::DpmSolver,
        };
        let n_steps = self.steps.unwrap_or_else(|| sampler.usual_steps(n_train));
        let sampler = SamplerConfig { sampler, n_steps, spacing: self.spacing, clip: true };
        sampler.check(n_train)?;
        let guidance = self.guidance.unwrap_or_else(|| card.guidance());
        ensure!(
            guidance >= 0.0 && guidance.is_finite(),
            "--guidance {guidance} is below 0; give 1 to follow the music, more to exaggerate it"
        );
        let overlap_frames = self.overlap;
        ensure!(
            overlap_frames < model.window_frames,
            "--overlap {overlap_frames} is not below the {} frames of a window of model {}; give a smaller number",
            model.window_frames,
            model.name
        );
        Ok(SamplingSettings { sampler, guidance, overlap_frames })
    }

    /// Returns the share of the way to a constraint that every step goes.
    ///
    /// # Errors
    /// A number that is no share.
    pub fn checked_constraint_strength(&self) -> anyhow::Result<f64> {
        let strength = self.constraint_strength;
        ensure!(
            (0.0..=1.0).contains(&strength),
            "--constraint-strength {strength} is no share; give a number from 0 to 1"
        );
        Ok(strength)
    }

    /// Reads the constraints, where there are any.
    ///
    /// # Errors
    /// A file that cannot be read, or says what nobody can do.
    pub fn constraints_asked(&self) -> anyhow::Result<Option<ConstraintsRequest>> {
        let read =
            |path| ConstraintsRequest::read(path, |path| Ok(read_motion(path)?.into_array()));
        self.constraints.as_deref().map(read).transpose()
    }
}

/// How sampling begins from the library's motion.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Prime {
    /// Steps of the diffusion that are left to sample, out of all that were trained.
    pub n_left: usize,
    /// Digest of the library.
    pub library: String,
}

/// What determines a motion beside the model and the music.
#[derive(Clone, Debug)]
pub struct Settings {
    pub sampler: SamplerConfig,
    pub guidance: f64,
    pub seed: u64,
    pub best_of: usize,
    pub style: Option<[f32; STYLE_DIM]>,
    pub overlap_frames: usize,
    pub prime: Option<Prime>,
    pub postprocess: PostProcessConfig,
    pub constraints: Option<ConstraintsRequest>,
    pub constraint_strength: f64,
    pub soft: bool,
    pub no_clock: bool,
    pub decoder_derives: bool,
    pub phase_given: bool,
    /// Whether constraints are only measured.
    pub uncontrolled: bool,
}

impl Settings {
    /// Reads what the user asks for, for a model.
    ///
    /// # Errors
    /// One sentence for what this model or any sampler cannot do.
    pub fn new(params: &Params, card: &ModelCard) -> anyhow::Result<Self> {
        let SamplingSettings { sampler, guidance, overlap_frames } = params.sampling(card)?;
        let strength = params.checked_constraint_strength()?;
        let constraints = params.constraints_asked()?;
        let control = params.control.unwrap_or(Control::Decode);
        ensure!(
            !control.plans(),
            "--control {}: model {} is of the family unet, which plans nothing; give decode or none",
            control.name(),
            card.name
        );
        Ok(Self {
            sampler,
            guidance,
            seed: params.seed,
            best_of: params.best_of.get(),
            style: style(
                &params.style,
                (&card.name, card.unet.style_dim > 0, &card.styles),
                &card.normalizer,
            )?,
            overlap_frames,
            prime: None,
            postprocess: params.postprocess.config((card.motion_range, card.fusion_variances()))?,
            constraints,
            constraint_strength: strength,
            soft: params.soft,
            no_clock: params.no_clock,
            decoder_derives: card.decoder.fusion.is_some(),
            phase_given: card.unet.clock && !params.no_clock,
            uncontrolled: !control.decodes(),
        })
    }

    /// Lets sampling begin from a library's motion, of which the share `strength` is kept.
    ///
    /// # Errors
    /// A strength that is no share, or one that leaves fewer steps than the sampler takes.
    pub fn begin_from(
        &mut self,
        strength: f64,
        library: &str,
        card: &ModelCard,
    ) -> anyhow::Result<()> {
        ensure!(
            (0.0..=1.0).contains(&strength),
            "--prime {strength} is no share; give a number from 0 to 1"
        );
        let n_all = Schedule::new(&card.diffusion)?.len();
        let n_left = ((1.0 - strength) * n_all as f64).round() as usize;
        let n_steps = self.sampler.n_steps;
        ensure!(
            n_left >= n_steps,
            "--prime {strength} leaves {n_left} of {n_all} steps, fewer than the {n_steps} of the sampler; \
             give up to {:.3}, or fewer --steps",
            // Rounded down, so that what is told is enough.
            (1000 * n_all.saturating_sub(n_steps) / n_all) as f64 / 1000.0
        );
        self.prime = Some(Prime { n_left, library: library.to_owned() });
        Ok(())
    }

    /// Returns the settings as `generations` keeps them: without seed and weights, and of constraints the
    /// digest.
    pub fn to_row(&self) -> MotionSettings {
        MotionSettings {
            output_version: OUTPUT_VERSION,
            weights: None,
            sampler: self.sampler.clone(),
            guidance: self.guidance,
            seed: None,
            best_of: self.best_of,
            style: self.style,
            overlap_frames: self.overlap_frames,
            prime: self.prime.clone(),
            postprocess: self.postprocess.clone(),
            constraints: self.constraints_text().map(|text| digest(text.as_bytes())),
            constraint_strength: self.constraint_strength,
            soft: self.soft,
            no_clock: self.no_clock,
            decoder_derives: self.decoder_derives,
            phase_given: self.phase_given,
            uncontrolled: self.uncontrolled && self.constraints.is_some(),
        }
    }

    /// Returns the digest of everything but the music that determines motions.
    pub fn digest(&self, weights: &str) -> String {
        let settings = MotionSettings {
            weights: Some(weights.to_owned()),
            seed: Some(self.seed),
            constraints: self.constraints_text(),
            ..self.to_row()
        };
        settings.digest()
    }

    fn constraints_text(&self) -> Option<String> {
        self.constraints.as_ref().map(|asked| format!("{asked:?}"))
    }
}

/// Reads the values of the style channels.
fn values_of(given: &[String]) -> anyhow::Result<[f32; STYLE_DIM]> {
    let read = |text: &String| -> anyhow::Result<f32> {
        text.trim().parse().with_context(|| {
            format!("--style has {text:?}; give one name, or {STYLE_DIM} values from -1 to 1")
        })
    };
    let values: Vec<f32> = given.iter().map(read).collect::<Result<_, _>>()?;
    let n = values.len();
    <[f32; STYLE_DIM]>::try_from(values)
        .map_err(|_| anyhow!("--style has {n} values; give {STYLE_DIM}, from -1 to 1"))
}

/// Returns a style in the model's units: that of a name, or eight values.
pub fn style(
    given: &[String],
    (model, takes_style, named): (&str, bool, &NamedStyles),
    normalizer: &Normalizer,
) -> anyhow::Result<Option<[f32; STYLE_DIM]>> {
    if given.is_empty() {
        return Ok(None);
    }
    ensure!(
        takes_style,
        "model {model} takes no style; leave --style out, or train one with --style"
    );
    let mut style = match given {
        [name] if is_style_name(name) => {
            let names: Vec<&str> = named.keys().map(String::as_str).collect();
            *named.get(name).with_context(|| match names.as_slice() {
                [] => format!(
                    "model {model} has no style \"{name}\": no phrase that it was trained on has the name of a style; give \
                     {STYLE_DIM} values, from -1 to 1"
                ),
                names => format!("model {model} has no style \"{name}\"; it has {}", names.join(", ")),
            })?
        }
        _ => values_of(given)?,
    };
    for (i, x) in Channel::Style.range().zip(&mut style) {
        ensure!((-1.0..=1.0).contains(x), "--style has {x}; give values from -1 to 1");
        *x = (*x - normalizer.centre[i]) / normalizer.scale[i];
    }
    Ok(Some(style))
}
