//! `train` of the family `unet`: the UNet learns to remove noise from motion, then the decoder to make motion of latents.

use std::sync::Arc;

use anyhow::ensure;

use super::budget::KeptCheckpoint;
use super::judge::ValidationJudge;
use super::ranks::agreed;
use super::session::{ProgressWatch, scales};
use super::{Params, Run, TrainDryRun, TrainSummary, lease, resume_command};
use crate::autodiff::{Arena, Parameters};
use crate::diffusion::Schedule;
use crate::model::{Family, UNet1D};
use crate::motion::Normalizer;
use crate::stages::trained::best;
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::training::{
    Augmentation, ByOne, ChannelWeights, Checkpoints, DecoderLearner, Denoiser, DiffusionLearner,
    Learner as _, Ranks, TrainConfig, TrainingEnd, TrainingError, Windows,
};

/// Runs the stage.
///
/// # Errors
/// Settings of which no network can be made, and what the store says.
pub fn run(
    params: &Params,
    ranks: &Arc<Ranks>,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let checked = || -> anyhow::Result<_> {
        let config = params.config.config(params.seed);
        config.network.check()?;
        check_numbers(params, &config)?;
        Ok((config, Location::open(&params.store, &params.client.options())?))
    };
    let (config, store) = agreed(ranks, checked())?;
    let watch = ProgressWatch(progress);
    let lease = agreed(ranks, lease(params, &store, ranks, &watch))?;
    let mut run = Run { params, store: &store, watch: &watch, lease: lease.as_ref(), ranks };
    agreed(ranks, run.check_resume(DiffusionLearner::STAGE))?;
    if params.dry_run {
        return run.dry_run_of_unet(&config, progress);
    }
    run.sweep();
    run.train_unet(&config, progress)
}

fn check_numbers(params: &Params, config: &TrainConfig) -> anyhow::Result<()> {
    let share = |flag: &str, x: f64| {
        ensure!((0.0..1.0).contains(&x), "{flag} {x} is no share; give a number from 0 to below 1");
        Ok(())
    };
    let d = &config.diffusion;
    share("--condition-dropout", d.condition_dropout)?;
    share("--clock-dropout", d.clock_dropout)?;
    share("--style-dropout", d.style_dropout)?;
    share("--time-stretch", d.augmentation.stretch)?;
    share("--decoder-dropout", config.network.decoder.dropout)?;
    share("--decoder-noised-to", config.decoder.noised_to)?;
    share("--decoder-sampled-from", config.decoder.sampled_from)?;
    let losses = &params.config.diffusion;
    ensure!(
        losses.difference_losses.len() == 3,
        "--difference-losses has {} weights; give three, for the first to the third difference",
        losses.difference_losses.len()
    );
    let weights = [
        ("--style-weight", losses.style_weight),
        ("--vertical-weight", losses.vertical_weight),
        ("--pose-weight", losses.pose_weight.unwrap_or(ChannelWeights::default().pose)),
        ("--velocity-loss", losses.velocity_loss),
        ("--acceleration-loss", losses.acceleration_loss),
    ];
    let differences = losses.difference_losses.iter().map(|&x| ("--difference-losses", x));
    for (flag, x) in weights.into_iter().chain(differences) {
        ensure!(x.is_finite() && x >= 0.0, "{flag} {x} is no weight; give 0 or more");
    }
    for beta in d.optimizer.betas {
        share("--betas", beta)?;
    }
    let decoder = &config.network.decoder;
    ensure!(
        decoder.hidden_dim > 0 && decoder.expansion > 0,
        "--decoder-hidden-dim and --decoder-expansion must be at least 1"
    );
    let positive = |flag: &str, x: f64| {
        ensure!(x > 0.0 && x.is_finite(), "{flag} {x} is not above 0; give a positive number");
        Ok(())
    };
    positive("--learning-rate", d.learning_rate.peak)?;
    positive("--decoder-learning-rate", config.decoder.learning_rate.peak)?;
    positive("--save-every-minutes", params.budget.saving.save_every_minutes)?;
    params.budget.minutes.map_or(Ok(()), |minutes| positive("--minutes", minutes))?;
    ensure!(
        d.augmentation.condition_noise >= 0.0 && d.augmentation.yaw_deg >= 0.0,
        "--condition-noise and --yaw-rotation may not be below 0"
    );
    Ok(())
}

impl Run<'_> {
    fn dry_run_of_unet(
        &self,
        config: &TrainConfig,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let phrases = self.phrases(Family::Unet, progress)?;
        let n_frames = config.network.window_frames;
        let windows = Windows::new(
            phrases.dataset,
            Normalizer::identity(),
            Augmentation::default(),
            n_frames,
            0,
        );
        let (_, list) = UNet1D::new(&config.network.unet);
        Ok(Box::new(TrainDryRun {
            run: self.params.run.clone(),
            what: format!("train a UNet of {} parameters", list.n_elements()),
            n_train: windows.n_train(),
            n_validation: windows.n_validation(),
            n_left_out: phrases.left_out.len(),
            steps_per_epoch: windows.n_train().div_ceil(config.diffusion.batch_size),
        }))
    }

    fn train_unet(
        &mut self,
        config: &TrainConfig,
        progress: &dyn Progress,
    ) -> anyhow::Result<Box<dyn Summary>> {
        let params = self.params;
        let phrases = self.phrases(Family::Unet, progress)?;
        let threads = Arc::new(params.machine.start_threads()?);
        let n_frames = config.network.window_frames;
        let scales = scales(&phrases.dataset, n_frames, self.watch)?;
        let windows = |augmentation: Augmentation| {
            let (dataset, scales) = (Arc::clone(&phrases.dataset), scales.clone());
            let windows = Windows::new(dataset, scales, augmentation, n_frames, params.seed);
            Arc::new(windows.heard_by(&config.network.unet))
        };
        let mut account = TrainSummary::new(&params.run, self.store, phrases.left_out.clone());

        let augmented = windows(config.diffusion.augmentation.clone());
        let learner =
            DiffusionLearner::new(&config.network, &config.diffusion, &augmented, params.seed)?
                .on(&threads);
        let mut learner = agreed(self.ranks, learner.among(self.ranks).map_err(Into::into))?;
        if params.budget.keep == KeptCheckpoint::Motion
            && self.ranks.is_first()
            && let Some(judge) =
                ValidationJudge::new(&config.network, &phrases.dataset, &scales.features)?
        {
            learner = learner.judged_by(judge);
        }
        self.begin(config)?;
        let end = self.stage(
            config,
            params.budget.of_denoiser(config.diffusion.batch_size),
            &mut learner,
            &augmented,
            &mut account,
        )?;
        if end == TrainingEnd::Interrupted {
            return Ok(Box::new(account.interrupted(&resume_command(params))));
        }
        if self.ranks.is_first() {
            account.beside(learner.baselines()?);
        }
        drop(learner);

        let (unet, list) = UNet1D::new(&config.network.unet);
        let arena = Arena::default();
        let takes_style = config.network.unet.style_dim > 0;
        let augmented =
            windows(Augmentation { condition_noise: 0.0, ..config.diffusion.augmentation.clone() });
        let checkpoints = self.checkpoints(DiffusionLearner::STAGE);
        let best = || best_unet(&checkpoints, &params.run, list);
        let weights = self.ranks.is_first().then(best).transpose()?;
        // A decoder's step takes milliseconds: one process is faster than several that wait for each other.
        let mut learner = ByOne::new(self.ranks, weights.as_ref(), |weights| {
            let schedule = Schedule::new(&config.network.diffusion)?;
            let denoiser =
                Denoiser { unet: &unet, parameters: weights, arena: &arena, takes_style };
            let (decoder, training) = (&config.network.decoder, &config.decoder);
            let learner =
                DecoderLearner::new(decoder, training, denoiser, schedule, &augmented, params.seed);
            Ok::<_, anyhow::Error>(learner.on(&threads))
        })?;
        let end = self.stage(
            config,
            params.budget.of_decoder(config.decoder.batch_size),
            &mut learner,
            &augmented,
            &mut account,
        )?;
        if end == TrainingEnd::Interrupted {
            return Ok(Box::new(account.interrupted(&resume_command(params))));
        }
        Ok(Box::new(account))
    }
}

/// Reads the UNet of a run that validated best.
///
/// # Errors
/// When there is none, or it is of another network.
fn best_unet(
    checkpoints: &Checkpoints,
    run: &str,
    list: crate::model::ParameterList,
) -> Result<Parameters<f32>, TrainingError> {
    Ok(best(checkpoints, run, "unet.", "trained UNet", list)?.parameters)
}
