//! The items of every stage, each with its state; the stages' own planning tells it.

use anyhow::Context as _;

use super::{Params, SurveyedStage};
use crate::stages::generate::SurveyedRun;
use crate::stages::item_state::ItemState;
use crate::stages::{evaluate, extract, generate, ingest, library, train};
use crate::store::{Location, Source, StoreSnapshot};

/// One item of a stage.
#[derive(Clone, Debug)]
pub struct SurveyedItem {
    pub name: String,
    /// The phrase whose shard does it; none in a stage without shards.
    pub phrase: Option<String>,
    pub state: ItemState,
}

/// The items of one command: of a stage, and of its run or its source.
#[derive(Clone, Debug)]
pub struct StageSurvey {
    pub stage: SurveyedStage,
    pub run: Option<String>,
    pub source: Option<String>,
    pub items: Vec<SurveyedItem>,
    /// What a reader should know of them.
    pub notes: Vec<String>,
    /// Why nothing is known of the items.
    pub unknown: Option<String>,
}

impl StageSurvey {
    fn new(stage: SurveyedStage, items: impl IntoIterator<Item = SurveyedItem>) -> Self {
        let items = items.into_iter().collect();
        Self { stage, run: None, source: None, items, notes: Vec::new(), unknown: None }
    }

    fn of_phrases(stage: SurveyedStage, states: Vec<(String, ItemState)>) -> Self {
        let item = |(id, state): (String, ItemState)| SurveyedItem {
            phrase: Some(id.clone()),
            name: id,
            state,
        };
        Self::new(stage, states.into_iter().map(item))
    }

    /// Returns how many items are in a state.
    pub fn count(&self, state: ItemState) -> usize {
        self.items.iter().filter(|item| item.state == state).count()
    }
}

/// Looks at the items of a store.
pub struct Surveyor<'a> {
    pub snapshot: &'a StoreSnapshot,
    pub params: &'a Params,
}

impl Surveyor<'_> {
    /// Returns the items of a stage, command by command; none where it was not begun and is not asked for.
    ///
    /// # Errors
    /// When the store cannot be read.
    pub fn stage(&self, stage: SurveyedStage) -> anyhow::Result<Vec<StageSurvey>> {
        match stage {
            SurveyedStage::Ingest => self.ingest(),
            SurveyedStage::Extract => self.extract(),
            SurveyedStage::Library => self.library(),
            SurveyedStage::Train => self.train(),
            SurveyedStage::Generate => self.generate(),
            SurveyedStage::Evaluate => self.evaluate(),
        }
    }

    fn store(&self) -> &Location {
        self.snapshot.store()
    }

    fn open(&self, url: &str) -> anyhow::Result<Source> {
        let source = Source::open(url, &self.params.client.options(), None)?;
        Ok(source.following_links(self.params.links.follow_links))
    }

    fn ingest(&self) -> anyhow::Result<Vec<StageSurvey>> {
        if let Some(url) = &self.params.source {
            return Ok(vec![self.source(&self.open(url)?)?]);
        }
        let origins = ingest::origins(self.snapshot)?.into_iter();
        let survey = |url: String| match self.open(&url).and_then(|source| self.source(&source)) {
            Ok(survey) => survey,
            Err(error) => StageSurvey {
                source: Some(url),
                unknown: Some(format!("the source cannot be listed from here: {error:#}")),
                ..StageSurvey::new(SurveyedStage::Ingest, [])
            },
        };
        Ok(origins.map(survey).collect())
    }

    fn source(&self, source: &Source) -> anyhow::Result<StageSurvey> {
        let (states, is_usual) = ingest::survey(self.snapshot, source, self.params.layout)?;
        Ok(StageSurvey {
            source: Some(source.location().url().to_owned()),
            notes: unless_usual(is_usual, SurveyedStage::Ingest),
            ..StageSurvey::of_phrases(SurveyedStage::Ingest, states)
        })
    }

    fn extract(&self) -> anyhow::Result<Vec<StageSurvey>> {
        let (states, is_usual) = extract::survey(self.snapshot)?;
        if states.is_empty() {
            return Ok(Vec::new());
        }
        Ok(vec![StageSurvey {
            notes: unless_usual(is_usual, SurveyedStage::Extract),
            ..StageSurvey::of_phrases(SurveyedStage::Extract, states)
        }])
    }

    fn library(&self) -> anyhow::Result<Vec<StageSurvey>> {
        let captures = self.params.captures.as_deref().map(|url| self.open(url)).transpose()?;
        let found = library::survey(self.snapshot, captures, |url| self.open(url))
            .context("while looking at the songs of library")?;
        let survey = |songs: library::SurveyedSongs| {
            let item = |(name, state)| SurveyedItem { name, phrase: None, state };
            let note = "the store has no captures, so that those of another folder are taken to be as they were; \
                        name it with --captures";
            StageSurvey {
                source: songs.folder,
                notes: (!songs.has_captures).then(|| note.to_owned()).into_iter().collect(),
                ..StageSurvey::new(SurveyedStage::Library, songs.states.into_iter().map(item))
            }
        };
        let found: Vec<StageSurvey> = found.into_iter().map(survey).collect();
        Ok(match self.params.stage {
            Some(SurveyedStage::Library) if found.is_empty() => {
                vec![not_begun(SurveyedStage::Library, "library")]
            }
            _ => found,
        })
    }

    /// Returns the runs to look at: the one that is asked for, or all that were begun.
    fn runs(&self, begun: impl IntoIterator<Item = String>) -> Vec<String> {
        match &self.params.run {
            Some(run) => vec![run.clone()],
            None => begun.into_iter().collect(),
        }
    }

    fn train(&self) -> anyhow::Result<Vec<StageSurvey>> {
        let begun = train::survey::runs(self.store())?;
        let mut found = Vec::new();
        for run in self.runs(begun) {
            let networks = train::survey::survey(self.store(), &run)?;
            if networks.is_empty() {
                if self.params.stage == Some(SurveyedStage::Train) {
                    let survey = not_begun(SurveyedStage::Train, &run);
                    found.push(StageSurvey { run: Some(run), ..survey });
                }
                continue;
            }
            let note = |trained: &train::survey::TrainedNetwork| {
                let n_steps = trained.n_steps?;
                let unfinished = trained.state != ItemState::Done;
                unfinished.then(|| {
                    format!("{} is at step {} of {n_steps}", trained.network, trained.step)
                })
            };
            let item = |trained: &train::survey::TrainedNetwork| SurveyedItem {
                name: format!("{run}/{}", trained.network),
                phrase: None,
                state: trained.state,
            };
            found.push(StageSurvey {
                notes: networks.iter().filter_map(note).collect(),
                run: Some(run.clone()),
                ..StageSurvey::new(SurveyedStage::Train, networks.iter().map(item))
            });
        }
        Ok(found)
    }

    fn generate(&self) -> anyhow::Result<Vec<StageSurvey>> {
        let Params { tracks, split, samples, .. } = self.params;
        let mut found = Vec::new();
        for run in self.runs(generate::runs(self.snapshot)?) {
            let asked = SurveyedRun {
                run: &run,
                tracks: *tracks,
                split: split.as_deref(),
                n_samples: samples.map(Into::into),
            };
            let motions = generate::survey(self.snapshot, asked)?;
            let items = motions.into_iter().map(|(phrase, name, state)| SurveyedItem {
                name,
                phrase: Some(phrase),
                state,
            });
            let survey = StageSurvey::new(SurveyedStage::Generate, items);
            found.push(StageSurvey { run: Some(run), ..survey });
        }
        Ok(found)
    }

    fn evaluate(&self) -> anyhow::Result<Vec<StageSurvey>> {
        let begun = match self.params.stage {
            // With --stage evaluate, a run without an evaluation is one that is left.
            Some(SurveyedStage::Evaluate) => {
                let mut runs = generate::runs(self.snapshot)?;
                runs.extend(evaluate::runs(self.snapshot)?);
                runs
            }
            _ => evaluate::runs(self.snapshot)?,
        };
        let mut found = Vec::new();
        for run in self.runs(begun) {
            let (state, refused) = evaluate::survey(self.snapshot, &run)?;
            let item = |name, state| SurveyedItem { name, phrase: None, state };
            let refused = refused.into_iter().map(|name| item(name, ItemState::Failed));
            let items = std::iter::once(item(run.clone(), state)).chain(refused);
            let survey = StageSurvey::new(SurveyedStage::Evaluate, items);
            found.push(StageSurvey { run: Some(run.clone()), ..survey });
        }
        Ok(found)
    }
}

/// Returns what is left of a stage that was not begun and whose items nobody knows yet.
fn not_begun(stage: SurveyedStage, name: &str) -> StageSurvey {
    let item = SurveyedItem { name: name.to_owned(), phrase: None, state: ItemState::Missing };
    StageSurvey::new(stage, [item])
}

/// Returns a note where a stage last ran with other parameters than without flags, or in another version.
fn unless_usual(is_usual: bool, stage: SurveyedStage) -> Vec<String> {
    let name = stage.name();
    let note = || {
        format!(
            "{name} last ran with flags that change what it writes, or in another version of motiongen; by those \
             parameters this is told"
        )
    };
    (!is_usual).then(note).into_iter().collect()
}
