//! `finetune`: the UNet and the decoder of a run learn together, end to end, to hold motion together.

use std::num::NonZeroUsize;
use std::sync::Arc;

use anyhow::ensure;

use super::failure::quoted;
use super::learned::{learned_path, remember};
use super::train::budget::{SavingParams, minutes};
use super::train::ranks::refuse_others;
use super::train::session::{
    MachineParams, ProgressWatch, check_run_name, claim, claim_path, lease_of, read_phrases,
};
use super::train::{StageSummary, TrainDryRun, TrainSummary, restore};
use super::trained::{TrainedRun, WeightsChoice};
use super::{ClientParams, Contract, Progress, RARE, Stage, Summary};
use crate::model::Family;
use crate::store::Location;
use crate::training::{
    Augmentation, CheckpointKind, Checkpoints, Drive, FinetuneConfig, FinetuneLearner, Journal,
    Loader, OptimizerConfig, Plan, Ranks, State, TemporalConfig, TrainingEnd, Windows,
    WithholdProbabilities,
};

/// The stage.
pub struct Finetune;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables and the run.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Name of the run, which `train` has finished; fine-tuning that was begun is continued.
    #[arg(long, value_name = "NAME")]
    pub run: String,
    /// Refuse to start fine-tuning that was not begun.
    #[arg(long, hide_short_help = RARE)]
    pub resume: bool,
    /// Times that all phrases are seen [default: 50, without --minutes]
    #[arg(long, value_name = "N", help_heading = "Budget")]
    pub epochs: Option<u64>,
    /// Steps.
    #[arg(long, value_name = "N", help_heading = "Budget")]
    pub steps: Option<u64>,
    /// Minutes that fine-tuning may take, over all its resumptions.
    #[arg(long, value_name = "M", help_heading = "Budget")]
    pub minutes: Option<f64>,
    /// Training phrases to use [default: all]
    #[arg(long, value_name = "N", help_heading = "Budget", hide_short_help = RARE)]
    pub num_phrases: Option<NonZeroUsize>,
    /// Validations without improvement after which fine-tuning ends; 0 for never.
    #[arg(long, value_name = "N", default_value_t = 10, help_heading = "Budget",
          hide_short_help = RARE)]
    pub patience: u64,
    /// Epochs from one validation to the next.
    #[arg(long, value_name = "N", default_value_t = 1, help_heading = "Budget",
          hide_short_help = RARE)]
    pub validate_every: u64,
    #[command(flatten)]
    pub saving: SavingParams,
    /// Windows of a step.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::new(8).expect("not 0"),
          help_heading = "Optimizer")]
    pub batch_size: NonZeroUsize,
    /// Learning rate of the UNet (1e-6 in the reference).
    #[arg(long, value_name = "X", default_value_t = 1e-4, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub lr_diffusion: f64,
    /// Learning rate of the decoder (5e-5 in the reference).
    #[arg(long, value_name = "X", default_value_t = 5e-6, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub lr_decoder: f64,
    /// Weight of the loss of the UNet's prediction (0.1 in the reference).
    #[arg(long, value_name = "W", default_value_t = 1.0, help_heading = "Losses",
          hide_short_help = RARE)]
    pub diffusion_weight: f64,
    /// Weight of the distance of sampled motion from the phrase's (1 in the reference).
    #[arg(long, value_name = "W", default_value_t = 3.0, help_heading = "Losses",
          hide_short_help = RARE)]
    pub decoder_weight: f64,
    /// Weight of the losses of coherence in time.
    #[arg(long, value_name = "W", default_value_t = 10.0, help_heading = "Losses",
          hide_short_help = RARE)]
    pub temporal_weight: f64,
    #[command(flatten)]
    pub temporal: TemporalParams,
    /// Decay of weights.
    #[arg(long, value_name = "X", default_value_t = OptimizerConfig::default().weight_decay,
          help_heading = "Optimizer", hide_short_help = RARE)]
    pub weight_decay: f64,
    /// Largest norm of the gradient; 0 for no limit.
    #[arg(long, value_name = "X", default_value_t = 1.0, help_heading = "Optimizer",
          hide_short_help = RARE)]
    pub gradient_clip: f64,
    /// Steps of DDIM that gradients flow through.
    #[arg(long, value_name = "N", default_value_t = 5, help_heading = "Losses",
          hide_short_help = RARE)]
    pub num_steps: usize,
    /// Share of the diffusion's steps that are undone: sampling begins with the phrase's motion made as
    /// noisy; 1 begins with noise alone, as in the reference, and ends in motion that stands still.
    #[arg(long, value_name = "SHARE", default_value_t = 0.25, help_heading = "Losses",
          hide_short_help = RARE)]
    pub start: f64,
    #[command(flatten)]
    pub machine: MachineParams,
    #[command(flatten)]
    pub client: ClientParams,
    /// Seed of everything that is left to chance.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Start fine-tuning anew: its checkpoints and its log are removed.
    #[arg(long)]
    pub force: bool,
}

/// Weights and targets of the losses of coherence, within --temporal-weight.
#[derive(Clone, Debug, clap::Args)]
pub struct TemporalParams {
    /// Of velocity against the differences of position.
    #[arg(long, value_name = "W", default_value_t = TemporalConfig::default().velocity_weight,
          help_heading = "Losses", hide_short_help = RARE)]
    pub velocity_weight: f64,
    /// Of acceleration against the differences of velocity.
    #[arg(long, value_name = "W", default_value_t = TemporalConfig::default().acceleration_weight,
          help_heading = "Losses", hide_short_help = RARE)]
    pub acceleration_weight: f64,
    /// Of the differences of acceleration.
    #[arg(long, value_name = "W", default_value_t = TemporalConfig::default().jerk_weight,
          help_heading = "Losses", hide_short_help = RARE)]
    pub jerk_weight: f64,
    /// Of large turns between frames.
    #[arg(long, value_name = "W", default_value_t = TemporalConfig::default().quaternion_delta_weight,
          help_heading = "Losses", hide_short_help = RARE)]
    pub quat_delta_weight: f64,
    /// Of a phase that falls within a bar.
    #[arg(long, value_name = "W", default_value_t = TemporalConfig::default().phase_weight,
          help_heading = "Losses", hide_short_help = RARE)]
    pub phase_monotonic_weight: f64,
    /// Of steps longer than half a metre between frames.
    #[arg(long, value_name = "W", default_value_t = TemporalConfig::default().smoothness_weight,
          help_heading = "Losses", hide_short_help = RARE)]
    pub smoothness_weight: f64,
    /// By which errors of velocity are divided, m/s.
    #[arg(long, value_name = "X", default_value_t = TemporalConfig::default().target_velocity,
          help_heading = "Losses", hide_short_help = RARE)]
    pub target_vel_coherence: f64,
    /// By which errors of acceleration are divided, m/s².
    #[arg(long, value_name = "X", default_value_t = TemporalConfig::default().target_acceleration,
          help_heading = "Losses", hide_short_help = RARE)]
    pub target_accel_coherence: f64,
    /// By which jerk is divided, m/s³.
    #[arg(long, value_name = "X", default_value_t = TemporalConfig::default().target_jerk,
          help_heading = "Losses", hide_short_help = RARE)]
    pub target_jerk: f64,
    /// |q · q'| above which a turn between frames costs nothing.
    #[arg(long, value_name = "X", default_value_t = TemporalConfig::default().target_quaternion_dot,
          help_heading = "Losses", hide_short_help = RARE)]
    pub target_quat_delta: f64,
}

impl TemporalParams {
    fn config(&self) -> TemporalConfig {
        TemporalConfig {
            velocity_weight: self.velocity_weight,
            acceleration_weight: self.acceleration_weight,
            jerk_weight: self.jerk_weight,
            quaternion_delta_weight: self.quat_delta_weight,
            phase_weight: self.phase_monotonic_weight,
            smoothness_weight: self.smoothness_weight,
            target_velocity: self.target_vel_coherence,
            target_acceleration: self.target_accel_coherence,
            target_jerk: self.target_jerk,
            target_quaternion_dot: self.target_quat_delta,
            max_step_m: TemporalConfig::default().max_step_m,
        }
    }

    fn check(&self) -> anyhow::Result<()> {
        for (flag, x) in [
            ("--velocity-weight", self.velocity_weight),
            ("--acceleration-weight", self.acceleration_weight),
            ("--jerk-weight", self.jerk_weight),
            ("--quat-delta-weight", self.quat_delta_weight),
            ("--phase-monotonic-weight", self.phase_monotonic_weight),
            ("--smoothness-weight", self.smoothness_weight),
        ] {
            ensure!(
                x >= 0.0 && x.is_finite(),
                "{flag} {x} is below 0; give 0 or a positive number"
            );
        }
        for (flag, x) in [
            ("--target-vel-coherence", self.target_vel_coherence),
            ("--target-accel-coherence", self.target_accel_coherence),
            ("--target-jerk", self.target_jerk),
        ] {
            ensure!(x > 0.0 && x.is_finite(), "{flag} {x} is not above 0; give a positive number");
        }
        Ok(())
    }
}

impl Params {
    fn config(&self) -> FinetuneConfig {
        FinetuneConfig {
            seed: self.seed,
            batch_size: self.batch_size.get(),
            lr_diffusion: self.lr_diffusion,
            lr_decoder: self.lr_decoder,
            diffusion_weight: self.diffusion_weight,
            decoder_weight: self.decoder_weight,
            temporal_weight: self.temporal_weight,
            temporal: self.temporal.config(),
            num_steps: self.num_steps,
            start: self.start,
            optimizer: OptimizerConfig {
                weight_decay: self.weight_decay,
                gradient_clip: (self.gradient_clip > 0.0).then_some(self.gradient_clip),
                ..OptimizerConfig::default()
            },
            num_phrases: self.num_phrases.map(NonZeroUsize::get),
        }
    }

    fn check(&self) -> anyhow::Result<()> {
        check_run_name(&self.run)?;
        for (flag, x) in [
            ("--lr-diffusion", self.lr_diffusion),
            ("--lr-decoder", self.lr_decoder),
            ("--diffusion-weight", self.diffusion_weight),
            ("--decoder-weight", self.decoder_weight),
            ("--temporal-weight", self.temporal_weight),
            ("--weight-decay", self.weight_decay),
        ] {
            ensure!(
                x >= 0.0 && x.is_finite(),
                "{flag} {x} is below 0; give 0 or a positive number"
            );
        }
        ensure!(
            self.start > 0.0 && self.start <= 1.0,
            "--start {} is no share; give a number above 0, up to 1",
            self.start
        );
        self.temporal.check()?;
        for (flag, x) in [
            ("--minutes", self.minutes),
            ("--save-every-minutes", Some(self.saving.save_every_minutes)),
        ] {
            let is_positive = x.is_none_or(|x| x > 0.0 && x.is_finite());
            ensure!(is_positive, "{flag} is not above 0; give a positive number");
        }
        Ok(())
    }

    fn plan(&self, windows: &Windows) -> Plan {
        let is_bounded = self.steps.is_some() || self.minutes.is_some();
        Plan {
            n_steps: self.steps,
            n_epochs: self.epochs.or_else(|| (!is_bounded).then_some(50)),
            time: self.minutes.map(minutes),
            windows_per_epoch: windows.n_train() as u64,
            batch_size: self.batch_size.get() as u64,
            validate_first: true,
            validate_every_epochs: self.validate_every,
            save_every_epochs: self.saving.save_every,
            save_every_steps: self.saving.save_every_steps,
            save_every: minutes(self.saving.save_every_minutes),
            patience: (self.patience > 0).then_some(self.patience),
            store_patience: self.machine.patience(),
        }
    }
}

impl Stage for Finetune {
    const NAME: &'static str = "finetune";
    const ABOUT: &'static str = "fine-tune a trained run end to end for motion that holds together";
    const CONTRACT: Contract = Contract {
        reads: "phrases, motion, features, runs/<run>/",
        writes: "runs/<run>/finetune/ (checkpoints), training_log, failures",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        refuse_others(Self::NAME)?;
        params.check()?;
        let config = params.config();
        let store = Location::open(&params.store, &params.client.options())?;
        let watch = ProgressWatch(progress);
        let run = params.run.as_str();
        let checkpoints = Checkpoints::new(&store, run, Self::NAME);
        ensure!(
            !params.resume || !checkpoints.steps(CheckpointKind::Step)?.is_empty(),
            "run {run} has no fine-tuning to resume in {store}; leave --resume out to start it"
        );
        let TrainedRun { state: trained, unet, decoder, .. } =
            TrainedRun::read(&store, run, WeightsChoice::Train)?;
        let lease = match params.dry_run {
            true => None,
            false => Some(lease_of(&store, run, &watch)?),
        };
        if !params.dry_run {
            store.sweep();
        }
        let machine = &params.machine;
        let (limit, is_dry_run) = (config.num_phrases, params.dry_run);
        let phrases = read_phrases(
            &store,
            Self::NAME,
            (machine, Family::Unet),
            limit,
            progress,
            &watch,
            is_dry_run,
        )?;
        let network = &trained.config.network;
        let windows = Windows::new(
            Arc::clone(&phrases.dataset),
            trained.scales.clone(),
            // The phrases as they are: sampled motion is held against them.
            Augmentation { condition_noise: 0.0, mirror: false, yaw_deg: 0.0, stretch: 0.0 },
            network.window_frames,
            params.seed,
        );
        let windows = Arc::new(windows.heard_by(&network.unet));
        let mut learner = FinetuneLearner::new(
            network,
            (
                &trained.config.diffusion.objective,
                WithholdProbabilities::of(&trained.config.diffusion),
            ),
            &config,
            &windows,
            [&unet.parameters, &decoder.parameters],
        )?
        .on(&Arc::new(machine.start_threads()?));
        // The learner has copies; of `base` they are half a gigabyte.
        drop((unet, decoder));
        if params.dry_run {
            return Ok(Box::new(TrainDryRun {
                run: params.run.clone(),
                what: "fine-tune both networks".to_owned(),
                n_train: windows.n_train(),
                n_validation: windows.n_validation(),
                n_left_out: phrases.left_out.len(),
                steps_per_epoch: windows.n_train().div_ceil(params.batch_size.get()),
            }));
        }
        // Only now is it certain that there is something to learn and to learn from.
        if params.force {
            checkpoints.clear()?;
            Journal::open(&store, Self::NAME, run, Self::NAME)?.clear()?;
            store.remove(&claim_path(run, Self::NAME))?;
            store.remove(&learned_path(run, Self::NAME))?;
        }
        claim(&store, run, Self::NAME, &config, machine.patience(), &watch)?;
        let fresh = State::new(
            Self::NAME,
            config.clone(),
            windows.dataset().fingerprint(),
            windows.scales().clone(),
        );
        let state = restore(&mut learner, &checkpoints, fresh, run, &watch)?;
        remember(&store, run, Self::NAME, &phrases.dataset, machine.patience(), &watch)?;
        let started_at = state.progress.step;
        let plan = params.plan(&windows);
        let journal = Journal::open(&store, Self::NAME, run, Self::NAME)?;
        let mut drive = Drive {
            plan,
            state,
            checkpoints,
            journal: Some(match &lease {
                Some(lease) => journal.under(lease),
                None => journal,
            }),
            ranks: Ranks::alone(),
            watch: &watch,
            anchor: claim_path(run, Self::NAME),
        };
        let batch_size = plan.batch_size as usize;
        let end = drive.run(&mut learner, |first, _| {
            Loader::start(&windows, batch_size, first, machine.loader_threads)
        })?;
        let mut account = TrainSummary::new(run, &store, phrases.left_out);
        account.add(StageSummary::of(Self::NAME, &drive.state.progress, started_at, end));
        if end == TrainingEnd::Interrupted {
            let mut words: Vec<String> = std::env::args().map(|word| quoted(&word)).collect();
            words.retain(|word| word != "--force");
            if !params.resume {
                words.push("--resume".to_owned());
            }
            return Ok(Box::new(account.interrupted(&words.join(" "))));
        }
        Ok(Box::new(account))
    }
}
