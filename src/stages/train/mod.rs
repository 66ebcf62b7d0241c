//! `train`: networks of any family learn from the phrases of a store.

pub mod budget;
mod family;
mod group;
mod judge;
mod numbers;
mod params;
mod planner;
pub(in crate::stages) mod ranks;
pub mod session;
mod summary;
pub(in crate::stages) mod survey;
mod tokens;
mod unet;

use std::sync::Arc;

use anyhow::{bail, ensure};

use super::failure::quoted;
use super::learned::{learned_path, remember};
use super::{ClientParams, Contract, Progress, RARE, Stage, Summary};
use crate::model::Family;
use crate::store::{Lease, Location};
use crate::training::{
    CheckpointKind, Checkpoints, DecoderLearner, DiffusionLearner, Drive, GroupLearner, Journal,
    Learner, Loader, PlannerLearner, Ranks, State, TokensLearner, TrainingEnd, TrainingError,
    Windows,
};
use budget::{BudgetParams, StageBudget};
use group::GroupRun;
use planner::PlannerRun;
use ranks::{agreed, check_same};
use session::{
    MachineParams, ProgressWatch, TrainingPhrases, check_run_name, claim, claim_path, lease_of,
    read_phrases,
};
pub use summary::{StageSummary, TrainDryRun, TrainSummary};
use tokens::TokensRun;
use unet::UnetRun;

/// What this command trains, of any family.
const STAGES: [&str; 5] = [
    DiffusionLearner::STAGE,
    DecoderLearner::STAGE,
    GroupLearner::STAGE,
    TokensLearner::STAGE,
    PlannerLearner::STAGE,
];

/// The stage.
pub struct Train;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables; the run is written below it.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Name of the run; a run that exists is continued.
    #[arg(long, value_name = "NAME")]
    pub run: String,
    /// Refuse to start a run that does not exist.
    #[arg(long, hide_short_help = RARE)]
    pub resume: bool,
    #[command(flatten)]
    pub budget: BudgetParams,
    #[command(flatten)]
    pub config: params::ConfigParams,
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
    /// Start the run anew: its checkpoints and its log are removed.
    #[arg(long)]
    pub force: bool,
}

impl Stage for Train {
    const NAME: &'static str = "train";
    const ABOUT: &'static str = "train the networks of a model on the phrases of a store";
    const CONTRACT: Contract = Contract {
        reads: "phrases, motion, features",
        writes: "runs/<run>/ (checkpoints), training_log, failures",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        ranks::on_all(progress, |ranks, progress| {
            agreed(ranks, check_run_name(&params.run))?;
            match params.config.network.family {
                Family::Unet => family::run::<UnetRun>(&params, ranks, progress),
                Family::Group => family::run::<GroupRun>(&params, ranks, progress),
                Family::Tokens if params.config.tokens.tokenizer.is_some() => {
                    family::run::<PlannerRun>(&params, ranks, progress)
                }
                Family::Tokens => family::run::<TokensRun>(&params, ranks, progress),
            }
        })
    }
}

/// Takes the lease to write the run: the first process has it, and none in a dry run.
fn lease(
    params: &Params,
    store: &Location,
    ranks: &Ranks,
    watch: &ProgressWatch,
) -> anyhow::Result<Option<Lease>> {
    if params.dry_run || !ranks.is_first() {
        return Ok(None);
    }
    Ok(Some(lease_of(store, &params.run, watch)?))
}

/// A run of the stage.
#[derive(Clone, Copy)]
struct Run<'a> {
    params: &'a Params,
    store: &'a Location,
    watch: &'a ProgressWatch<'a>,
    lease: Option<&'a Lease>,
    ranks: &'a Arc<Ranks>,
}

impl<'a> Run<'a> {
    /// Refuses to resume a run that has no checkpoint.
    fn check_resume(&self, stage: &str) -> anyhow::Result<()> {
        let Self { params, store, .. } = self;
        ensure!(
            !params.resume || !self.checkpoints(stage).steps(CheckpointKind::Step)?.is_empty(),
            "run {} has no checkpoint to resume from in {store}; leave --resume out to start it",
            params.run
        );
        Ok(())
    }

    /// Removes what writers of the store left behind.
    fn sweep(&self) {
        if self.ranks.is_first() {
            self.store.sweep();
        }
    }

    /// Makes the run this configuration's, anew where that is asked for. Only to be called when it is certain that there
    /// is something to train and to train on.
    fn begin<C>(&self, config: &C) -> anyhow::Result<()>
    where
        C: serde::Serialize + serde::de::DeserializeOwned,
    {
        let begun = || -> anyhow::Result<()> {
            if !self.ranks.is_first() {
                return Ok(());
            }
            if self.params.force {
                self.clear()?;
            }
            let patience = self.params.machine.patience();
            claim(self.store, &self.params.run, Train::NAME, config, patience, self.watch)
        };
        agreed(self.ranks, begun())
    }

    fn checkpoints(&self, stage: &str) -> Checkpoints<'a> {
        Checkpoints::new(self.store, &self.params.run, stage)
    }

    fn journal(&self, stage: &'static str) -> anyhow::Result<Journal<'a>> {
        let journal = Journal::open(self.store, Train::NAME, &self.params.run, stage)?;
        Ok(match self.lease {
            Some(lease) => journal.under(lease),
            None => journal,
        })
    }

    /// Reads the phrases that networks of a family learn from.
    fn phrases(&self, family: Family, progress: &dyn Progress) -> anyhow::Result<TrainingPhrases> {
        let Params { machine, dry_run, .. } = self.params;
        let (store, watch) = (self.store, self.watch);
        let is_dry_run = *dry_run || !self.ranks.is_first();
        let machine = (machine, family);
        let read = read_phrases(store, Train::NAME, machine, None, progress, watch, is_dry_run);
        let phrases = agreed(self.ranks, read)?;
        check_same(self.ranks, &self.params.store, phrases.dataset.fingerprint())?;
        Ok(phrases)
    }

    /// Removes what the run has left, so that it can begin anew.
    fn clear(&self) -> anyhow::Result<()> {
        for stage in STAGES {
            self.checkpoints(stage).clear()?;
            self.journal(stage)?.clear()?;
        }
        self.checkpoints("finetune").clear()?;
        Journal::open(self.store, "finetune", &self.params.run, "finetune")?.clear()?;
        for command in [Train::NAME, "finetune"] {
            self.store.remove(&claim_path(&self.params.run, command))?;
            self.store.remove(&learned_path(&self.params.run, command))?;
        }
        Ok(())
    }

    /// Trains one network, from its newest checkpoint on.
    fn stage<L, C>(
        &self,
        config: &C,
        steps: StageBudget,
        learner: &mut L,
        windows: &Arc<Windows>,
        account: &mut TrainSummary,
    ) -> anyhow::Result<TrainingEnd>
    where
        L: Learner,
        C: Clone + serde::Serialize + serde::de::DeserializeOwned,
    {
        let checkpoints = self.checkpoints(L::STAGE);
        let patience = self.params.machine.patience();
        let plan = self.params.budget.plan(steps, windows.n_train(), patience);
        let state = State::new(
            L::STAGE,
            config.clone(),
            windows.dataset().fingerprint(),
            windows.scales().clone(),
        );
        let state = self.restore(learner, &checkpoints, state)?;
        let (run, dataset) = (&self.params.run, windows.dataset());
        if self.ranks.is_first() {
            remember(self.store, run, Train::NAME, dataset, patience, self.watch)?;
        }
        let started_at = state.progress.step;
        let mut drive = Drive {
            plan,
            state,
            checkpoints,
            journal: self.ranks.is_first().then(|| self.journal(L::STAGE)).transpose()?,
            ranks: Arc::clone(self.ranks),
            watch: self.watch,
            anchor: claim_path(&self.params.run, Train::NAME),
        };
        let machine = &self.params.machine;
        let end = drive.run(learner, |first, ownership| {
            let (size, n_threads) = (plan.batch_size as usize, machine.loader_threads);
            Loader::start_some(windows, size, first, n_threads, ownership)
        })?;
        account.add(StageSummary::of(L::STAGE, &drive.state.progress, started_at, end));
        Ok(end)
    }

    /// Takes up the newest checkpoint that the first process can read, on all of them.
    fn restore<L, C>(
        &self,
        learner: &mut L,
        checkpoints: &Checkpoints,
        fresh: State<C>,
    ) -> anyhow::Result<State<C>>
    where
        L: Learner,
        C: serde::Serialize + serde::de::DeserializeOwned,
    {
        let (run, ranks) = (&self.params.run, self.ranks);
        if ranks.is_first() {
            let state = agreed(ranks, restore(learner, checkpoints, fresh, run, self.watch))?;
            let (step, n_steps) = (state.progress.step, state.progress.n_steps);
            // Steps in all are chosen before the first is saved.
            ranks.of_first(&[f64::from(u8::from(n_steps > 0)), step as f64])?;
            return agreed(ranks, Ok(state));
        }
        agreed(ranks, Ok(()))?;
        let step = match ranks.of_first(&[])?[..] {
            [has_checkpoint, step] if has_checkpoint > 0.0 => step as u64,
            _ => return agreed(ranks, Ok(fresh)),
        };
        let read = checkpoints.read(CheckpointKind::Step, step, |archive, place| {
            let state = State::<C>::of(archive, place)?;
            learner.restore(archive, place, &state.progress)?;
            Ok(state)
        });
        agreed(ranks, read.map_err(Into::into))
    }
}

/// Takes up the newest checkpoint that can be read, if there is one.
///
/// # Errors
/// When it is of another configuration, of other data, or of another network.
pub fn restore<L: Learner, C>(
    learner: &mut L,
    checkpoints: &Checkpoints,
    fresh: State<C>,
    run: &str,
    watch: &ProgressWatch,
) -> anyhow::Result<State<C>>
where
    C: serde::Serialize + serde::de::DeserializeOwned,
{
    use crate::training::Watch as _;
    for step in checkpoints.steps(CheckpointKind::Step)?.into_iter().rev() {
        let read = checkpoints.read(CheckpointKind::Step, step, |archive, place| {
            let state = State::<C>::of(archive, place)?;
            let differences = crate::training::differences(&fresh.config, &state.config);
            if !differences.is_empty() {
                return Err(TrainingError::OtherConfig { run: run.to_owned(), differences });
            }
            if state.data != fresh.data {
                let short = |digest: &str| digest.chars().take(12).collect();
                return Err(TrainingError::OtherData {
                    run: run.to_owned(),
                    known: short(&state.data),
                    found: short(&fresh.data),
                });
            }
            learner.restore(archive, place, &state.progress)?;
            Ok(state)
        });
        match read {
            Ok(state) => {
                watch.note(&format!("{}: going on from step {step}", L::STAGE));
                return Ok(state);
            }
            // A disk may have lost what it said it had written; the one before is as good.
            Err(TrainingError::Weights { place, source }) if is_damaged(&source) => {
                watch.note(&format!(
                    "checkpoint {place} is damaged ({source}); taking an older one"
                ));
                // What is there is not written again, so it must go.
                checkpoints.remove(CheckpointKind::Step, step)?;
            }
            Err(error) => bail!(error),
        }
    }
    Ok(fresh)
}

fn is_damaged(error: &crate::weights::WeightsError) -> bool {
    matches!(error, crate::weights::WeightsError::Format(_))
}

/// Returns the command that goes on where this one stopped.
fn resume_command(params: &Params) -> String {
    let arguments: Vec<String> = std::env::args().collect();
    let mut words: Vec<String> = arguments.iter().map(|word| quoted(word)).collect();
    words.retain(|word| word != "--force");
    if !params.resume {
        words.push("--resume".to_owned());
    }
    words.join(" ")
}
