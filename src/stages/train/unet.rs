//! `train` of the family `unet`: the UNet learns to remove noise from motion, then the decoder to make motion of latents.

use std::sync::Arc;

use anyhow::ensure;

use super::budget::{BudgetParams, KeptCheckpoint, StageBudget};
use super::family::{FamilyInputs, FamilyTraining, open};
use super::judge::ValidationJudge;
use super::numbers::{check_positive, check_share, check_weight};
use super::{Params, Run, TrainSummary};
use crate::autodiff::{Arena, Parameters};
use crate::diffusion::Schedule;
use crate::model::{Family, UNet1D};
use crate::stages::trained::best;
use crate::store::Location;
use crate::training::{
    Augmentation, ByOne, ChannelWeights, Checkpoints, DecoderLearner, Denoiser, DiffusionLearner,
    Learner as _, TrainConfig, TrainingEnd, TrainingError, Windows,
};

/// The training of a UNet and of its decoder.
pub struct UnetRun(TrainConfig);

impl FamilyTraining for UnetRun {
    type Config = TrainConfig;
    type Learner = DiffusionLearner;

    const FAMILY: Family = Family::Unet;

    fn prepare(params: &Params) -> anyhow::Result<(Self, Location)> {
        let config = params.config.config(params.seed);
        config.network.check()?;
        check_numbers(params, &config)?;
        Ok((Self(config), open(params)?))
    }

    fn config(&self) -> &TrainConfig {
        &self.0
    }

    fn window_frames(&self) -> usize {
        self.0.network.window_frames
    }

    fn batch_size(&self) -> usize {
        self.0.diffusion.batch_size
    }

    fn augmentation(&self) -> &Augmentation {
        &self.0.diffusion.augmentation
    }

    fn description(&self) -> String {
        let (_, list) = UNet1D::new(&self.0.network.unet);
        format!("train a UNet of {} parameters", list.n_elements())
    }

    /// The decoder has the rest.
    fn budget(&self, budget: &BudgetParams) -> StageBudget {
        budget.of_denoiser(self.batch_size())
    }

    fn adapt(&self, windows: Windows) -> Windows {
        windows.heard_by(&self.0.network.unet)
    }

    fn learner(
        &self,
        windows: &Arc<Windows>,
        seed: u64,
    ) -> Result<DiffusionLearner, TrainingError> {
        DiffusionLearner::new(&self.0.network, &self.0.diffusion, windows, seed)
    }

    fn judged(
        &self,
        learner: DiffusionLearner,
        run: &Run,
        windows: &Windows,
    ) -> anyhow::Result<DiffusionLearner> {
        if run.params.budget.keep != KeptCheckpoint::Motion || !run.ranks.is_first() {
            return Ok(learner);
        }
        let (dataset, scale) = (windows.dataset(), &windows.scales().features);
        let judge = ValidationJudge::new(&self.0.network, dataset, scale)?;
        Ok(match judge {
            Some(judge) => learner.judged_by(judge),
            None => learner,
        })
    }

    /// Trains the decoder on the latents of the UNet that validated best.
    fn finish(
        &self,
        run: &Run,
        learner: DiffusionLearner,
        inputs: &FamilyInputs,
        account: &mut TrainSummary,
    ) -> anyhow::Result<TrainingEnd> {
        let Run { params, ranks, .. } = *run;
        let Self(config) = self;
        if ranks.is_first() {
            account.beside(learner.baselines()?);
        }
        drop(learner);
        let (unet, list) = UNet1D::new(&config.network.unet);
        let arena = Arena::default();
        let takes_style = config.network.unet.style_dim > 0;
        let augmentation = Augmentation { condition_noise: 0.0, ..self.augmentation().clone() };
        let windows = inputs.windows(self, augmentation, params.seed);
        let checkpoints = run.checkpoints(DiffusionLearner::STAGE);
        let best = || best_unet(&checkpoints, &params.run, list);
        let weights = ranks.is_first().then(best).transpose()?;
        // A decoder's step takes milliseconds: one process is faster than several that wait for each other.
        let mut learner = ByOne::new(ranks, weights.as_ref(), |weights| {
            let schedule = Schedule::new(&config.network.diffusion)?;
            let denoiser =
                Denoiser { unet: &unet, parameters: weights, arena: &arena, takes_style };
            let (decoder, training) = (&config.network.decoder, &config.decoder);
            let learner =
                DecoderLearner::new(decoder, training, denoiser, schedule, &windows, params.seed);
            Ok::<_, anyhow::Error>(learner.on(&inputs.threads))
        })?;
        let budget = params.budget.of_decoder(config.decoder.batch_size);
        run.stage(config, budget, &mut learner, &windows, account)
    }
}

fn check_numbers(params: &Params, config: &TrainConfig) -> anyhow::Result<()> {
    let d = &config.diffusion;
    check_share("--condition-dropout", d.condition_dropout)?;
    check_share("--clock-dropout", d.clock_dropout)?;
    check_share("--style-dropout", d.style_dropout)?;
    check_share("--time-stretch", d.augmentation.stretch)?;
    check_share("--decoder-dropout", config.network.decoder.dropout)?;
    check_share("--decoder-noised-to", config.decoder.noised_to)?;
    check_share("--decoder-sampled-from", config.decoder.sampled_from)?;
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
        check_weight(flag, x)?;
    }
    for beta in d.optimizer.betas {
        check_share("--betas", beta)?;
    }
    let decoder = &config.network.decoder;
    ensure!(
        decoder.hidden_dim > 0 && decoder.expansion > 0,
        "--decoder-hidden-dim and --decoder-expansion must be at least 1"
    );
    check_positive("--learning-rate", d.learning_rate.peak)?;
    check_positive("--decoder-learning-rate", config.decoder.learning_rate.peak)?;
    check_positive("--save-every-minutes", params.budget.saving.save_every_minutes)?;
    params.budget.minutes.map_or(Ok(()), |minutes| check_positive("--minutes", minutes))?;
    ensure!(
        d.augmentation.condition_noise >= 0.0 && d.augmentation.yaw_deg >= 0.0,
        "--condition-noise and --yaw-rotation may not be below 0"
    );
    Ok(())
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
