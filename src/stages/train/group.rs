//! `train --family group`: a transformer learns to remove noise from the motion of groups, and a score to tell groups
//! from mixed ones.

use std::sync::Arc;

use anyhow::ensure;

use super::Params;
use super::family::{FamilyTraining, of_preset, open};
use super::numbers::{check_positive, check_share, check_weight};
use crate::model::{Family, GroupNetworks};
use crate::store::Location;
use crate::training::{Augmentation, GroupLearner, GroupTrainConfig, PAIR, TrainingError, Windows};

/// The training of the networks of a group.
pub struct GroupRun(GroupTrainConfig);

impl FamilyTraining for GroupRun {
    type Config = GroupTrainConfig;
    type Learner = GroupLearner;

    const FAMILY: Family = Family::Group;

    fn prepare(params: &Params) -> anyhow::Result<(Self, Location)> {
        let config = params.config.group_config(params.seed);
        let config = of_preset(params, config, "the family group")?;
        config.network.check()?;
        check_numbers(&config)?;
        Ok((Self(config), open(params)?))
    }

    fn config(&self) -> &GroupTrainConfig {
        &self.0
    }

    fn window_frames(&self) -> usize {
        self.0.network.window_frames
    }

    fn batch_size(&self) -> usize {
        self.0.group.batch_size
    }

    fn augmentation(&self) -> &Augmentation {
        &self.0.group.augmentation
    }

    fn description(&self) -> String {
        let n_elements = GroupNetworks::new(&self.0.network.group).1.n_elements();
        format!("train a denoiser and a score of groups, {n_elements} parameters")
    }

    fn adapt(&self, windows: Windows) -> Windows {
        windows.paired().heard_by(self.0.network.group.condition())
    }

    fn learner(&self, windows: &Arc<Windows>, seed: u64) -> Result<GroupLearner, TrainingError> {
        GroupLearner::new(&self.0.network, &self.0.group, windows, seed)
    }
}

fn check_numbers(config: &GroupTrainConfig) -> anyhow::Result<()> {
    let training = &config.group;
    check_share("--condition-dropout", training.condition_dropout)?;
    check_share("--clock-dropout", training.clock_dropout)?;
    check_share("--time-stretch", training.augmentation.stretch)?;
    check_weight("--markers-loss", training.losses.markers)?;
    check_weight("--contrast-loss", training.losses.contrast)?;
    let n = training.batch_size;
    ensure!(
        n.is_multiple_of(PAIR) || training.losses.contrast == 0.0,
        "--batch-size {n} is odd; groups are told from mixed ones in pairs to the same music, so give {} or {}",
        n - 1,
        n + 1
    );
    check_positive("--learning-rate", training.learning_rate.peak)
}
