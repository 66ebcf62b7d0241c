//! `status`: what is done, failed and left, stage by stage, by the rules by which the stages themselves decide it.

mod array;
mod summary;
mod survey;

use std::num::{NonZeroU32, NonZeroUsize};
use std::str::FromStr;

use anyhow::{bail, ensure};

use super::generate::Tracks;
use super::ingest::Layout;
use super::{ClientParams, Contract, LinkParams, Progress, RARE, Stage, Summary};
use crate::store::{Location, StoreSnapshot};

use summary::StatusSummary;
use survey::Surveyor;

/// The stage.
pub struct Status;

/// A stage whose items can be told one by one, in the order of a pipeline.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, clap::ValueEnum)]
pub enum SurveyedStage {
    Ingest,
    Extract,
    Library,
    /// train and finetune.
    Train,
    Generate,
    Evaluate,
}

impl SurveyedStage {
    const ALL: [Self; 6] =
        [Self::Ingest, Self::Extract, Self::Library, Self::Train, Self::Generate, Self::Evaluate];

    /// Returns the verb that the user types.
    fn name(self) -> &'static str {
        match self {
            Self::Ingest => "ingest",
            Self::Extract => "extract",
            Self::Library => "library",
            Self::Train => "train",
            Self::Generate => "generate",
            Self::Evaluate => "evaluate",
        }
    }

    /// Returns what its items are called.
    fn unit(self) -> &'static str {
        match self {
            Self::Ingest | Self::Extract => "phrases",
            Self::Library => "songs",
            Self::Train => "networks",
            Self::Generate => "motions",
            Self::Evaluate => "runs",
        }
    }

    /// Returns whether the stage takes `--shard`.
    fn has_shards(self) -> bool {
        matches!(self, Self::Ingest | Self::Extract | Self::Generate)
    }
}

/// How what is left is told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MissingForm {
    /// Item by item.
    Items,
    /// The shards that have work left, of this number of shards.
    Shards(NonZeroU32),
}

impl FromStr for MissingForm {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "items" {
            return Ok(Self::Items);
        }
        let n_shards =
            text.parse().map_err(|_| "use the number of shards, such as 16, or items")?;
        Ok(Self::Shards(n_shards))
    }
}

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Only this stage [default: every stage that was begun]
    #[arg(long, value_enum, value_name = "STAGE")]
    pub stage: Option<SurveyedStage>,
    /// Tell what is left, and nothing else: its items, one a line; with a number of SHARDS, those that have work left, as
    /// sbatch --array takes them (0,3,7-9), of the one --stage, or beside the account of all.
    #[arg(long, value_name = "SHARDS", num_args = 0..=1, default_missing_value = "items")]
    pub missing: Option<MissingForm>,
    /// Count items that failed as left: the stage tries them again.
    #[arg(long)]
    pub failed: bool,
    /// Only this run of train, generate and evaluate, begun or not [default: all that were begun]
    #[arg(long, value_name = "NAME")]
    pub run: Option<String>,
    /// Only this source of ingest, begun or not [default: all that were begun]
    #[arg(long, value_name = "URL", help_heading = "As the stages were told", hide_short_help = RARE)]
    pub source: Option<String>,
    /// How the source is organised.
    #[arg(long, value_enum, value_name = "LAYOUT", default_value_t = Layout::Auto,
          help_heading = "As the stages were told", hide_short_help = RARE)]
    pub layout: Layout,
    /// Captures of library [default: those of the store]
    #[arg(long, value_name = "DIR", help_heading = "As the stages were told", hide_short_help = RARE)]
    pub captures: Option<String>,
    /// Phrases of generate [default: songs, or what the run has]
    #[arg(long, value_enum, value_name = "TRACKS", help_heading = "As the stages were told", hide_short_help = RARE)]
    pub tracks: Option<Tracks>,
    /// Split of generate's phrases [default: all]
    #[arg(long, value_name = "SPLIT", help_heading = "As the stages were told", hide_short_help = RARE)]
    pub split: Option<String>,
    /// Motions of generate for each phrase [default: as many as the run has]
    #[arg(long, value_name = "N", help_heading = "As the stages were told", hide_short_help = RARE)]
    pub samples: Option<NonZeroUsize>,
    #[command(flatten)]
    pub links: LinkParams,
    #[command(flatten)]
    pub client: ClientParams,
    /// Taken as by every stage; nothing is written anyway.
    #[arg(long)]
    pub dry_run: bool,
}

impl Stage for Status {
    const NAME: &'static str = "status";
    const ABOUT: &'static str = "tell what is done, failed and left, stage by stage";
    const CONTRACT: Contract = Contract {
        reads: "what every stage committed, held against the sources, phrases and models as they are now",
        writes: "nothing; here exit code 75 says that work is left, 1 that nothing but failed items is",
    };
    type Params = Params;

    fn run(params: Params, _progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let store = Location::open(&params.store, &params.client.options())?;
        if params.source.is_none() {
            ensure!(
                store.is_store()?,
                "store {store} has no tables; run first: motiongen ingest --source … --store {store}"
            );
        }
        let snapshot = StoreSnapshot::take(&store)?;
        let surveyor = Surveyor { snapshot: &snapshot, params: &params };
        let surveys = match params.stage {
            Some(stage) => surveyor.stage(stage)?,
            None => {
                let all = SurveyedStage::ALL.map(|stage| surveyor.stage(stage));
                all.into_iter().collect::<anyhow::Result<Vec<_>>>()?.concat()
            }
        };
        if let (Some(stage), Some(MissingForm::Shards(n))) = (params.stage, params.missing) {
            let name = stage.name();
            if !stage.has_shards() {
                bail!("--missing {n}: {name} has no shards; it is run again as a whole");
            }
            let what = if stage == SurveyedStage::Ingest { "--source" } else { "--run" };
            ensure!(
                surveys.len() < 2,
                "--missing {n}: store {store} has {} commands of {name}, and the shards of one are told at a time; \
                 name it with {what}",
                surveys.len()
            );
        }
        Ok(Box::new(StatusSummary::new(&store, surveys, &params)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_left_is_asked_for_by_items_or_shards() {
        assert_eq!("items".parse(), Ok(MissingForm::Items));
        assert_eq!(
            "16".parse(),
            Ok(MissingForm::Shards(NonZeroU32::new(16).expect("16 is not 0")))
        );
        for text in ["0", "-1", "a", "", "1/2"] {
            let error = text.parse::<MissingForm>().expect_err(text);
            assert_eq!(error, "use the number of shards, such as 16, or items", "{text}");
        }
    }
}
