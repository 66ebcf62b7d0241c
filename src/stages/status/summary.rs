//! How a store's state is told: as an account, as items, or as shards.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::num::NonZeroU32;

use super::array::array_specification;
use super::survey::StageSurvey;
use super::{MissingForm, Params};
use crate::stages::Summary;
use crate::stages::failure::{query_of_failures, quoted};
use crate::stages::item_state::ItemState;
use crate::store::{Location, shard_of};

/// The summary of the stage.
pub struct StatusSummary {
    store: String,
    surveys: Vec<StageSurvey>,
    missing: Option<MissingForm>,
    /// Whether what is left is all that is told.
    is_data: bool,
    /// Whether failed items count as left.
    with_failed: bool,
}

impl StatusSummary {
    pub fn new(store: &Location, surveys: Vec<StageSurvey>, params: &Params) -> Self {
        let is_data = match params.missing {
            Some(MissingForm::Items) => true,
            Some(MissingForm::Shards(_)) => params.stage.is_some(),
            None => false,
        };
        Self {
            store: store.to_string(),
            surveys,
            missing: params.missing,
            is_data,
            with_failed: params.failed,
        }
    }

    fn is_left(&self, state: ItemState) -> bool {
        match state {
            ItemState::Done => false,
            ItemState::Failed => self.with_failed,
            ItemState::Stale | ItemState::Missing => true,
        }
    }

    fn n_left(&self, survey: &StageSurvey) -> usize {
        survey.items.iter().filter(|item| self.is_left(item.state)).count()
    }

    /// Returns the shards of `n_shards` that have work left, as an array specification.
    fn array(&self, survey: &StageSurvey, n_shards: NonZeroU32) -> Option<String> {
        if !survey.stage.has_shards() {
            return None;
        }
        let left = survey.items.iter().filter(|item| self.is_left(item.state));
        let phrases = left.filter_map(|item| item.phrase.as_deref());
        let shards: BTreeSet<u32> = phrases.map(|phrase| shard_of(phrase, n_shards)).collect();
        Some(array_specification(&shards))
    }

    fn n_shards(&self) -> Option<NonZeroU32> {
        match self.missing {
            Some(MissingForm::Shards(n_shards)) => Some(n_shards),
            Some(MissingForm::Items) | None => None,
        }
    }

    fn write_survey(&self, out: &mut dyn Write, survey: &StageSurvey) -> io::Result<()> {
        let StageSurvey { stage, run, source, items, notes, unknown } = survey;
        write!(out, "  {:<9} ", stage.name())?;
        if let Some(run) = run {
            write!(out, "run {run}: ")?;
        }
        if let Some(why) = unknown {
            write!(out, "unknown, {why}")?;
        } else {
            let n_done = survey.count(ItemState::Done);
            write!(out, "{n_done} of {} {} done", items.len(), stage.unit())?;
        }
        for state in [ItemState::Failed, ItemState::Stale, ItemState::Missing] {
            match survey.count(state) {
                0 => {}
                n => write!(out, ", {n} {}", state.name())?,
            }
        }
        let array = self.n_shards().and_then(|n| self.array(survey, n)).filter(|a| !a.is_empty());
        if let Some(array) = array {
            write!(out, "; --array={array}")?;
        }
        if let Some(source) = source {
            write!(out, "; from {source}")?;
        }
        writeln!(out)?;
        for note in notes {
            writeln!(out, "            {note}")?;
        }
        Ok(())
    }
}

impl Summary for StatusSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        if self.is_data {
            for survey in &self.surveys {
                if let Some(array) = self.n_shards().and_then(|n| self.array(survey, n)) {
                    if !array.is_empty() {
                        writeln!(out, "{array}")?;
                    }
                    continue;
                }
                for item in survey.items.iter().filter(|item| self.is_left(item.state)) {
                    let (stage, state) = (survey.stage.name(), item.state.name());
                    writeln!(out, "{stage}\t{state}\t{}", item.name)?;
                }
            }
            return Ok(());
        }
        writeln!(out, "status {}", self.store)?;
        for survey in &self.surveys {
            self.write_survey(out, survey)?;
        }
        let n_left: usize = self.surveys.iter().map(|survey| self.n_left(survey)).sum();
        if n_left == 0 {
            writeln!(out, "  nothing is left to do")?;
        } else {
            let store = quoted(&self.store);
            writeln!(
                out,
                "  {n_left} are left; the same commands do them, and nothing else: motiongen status --store {store} \
                 --missing lists them"
            )?;
        }
        if self.n_failed() > 0 {
            writeln!(out, "  what failed: {}", query_of_failures(&self.store))?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        self.surveys.iter().map(|survey| survey.count(ItemState::Failed) as u64).sum()
    }

    fn has_work_left(&self) -> bool {
        self.surveys.iter().any(|survey| self.n_left(survey) > 0)
    }

    fn figures(&mut self) -> serde_json::Value {
        let stages = self.surveys.iter().map(|survey| {
            let mut told = serde_json::json!({
                "stage": survey.stage.name(),
                "run": survey.run,
                "source": survey.source,
                "unit": survey.stage.unit(),
                "n_items": survey.items.len(),
                "n_done": survey.count(ItemState::Done),
                "n_failed": survey.count(ItemState::Failed),
                "n_stale": survey.count(ItemState::Stale),
                "n_missing": survey.count(ItemState::Missing),
                "n_left": self.n_left(survey),
                "notes": survey.notes,
                "unknown": survey.unknown,
            });
            if let Some(n_shards) = self.n_shards() {
                told["array"] = self.array(survey, n_shards).into();
            }
            if self.missing == Some(MissingForm::Items) {
                let left = survey.items.iter().filter(|item| self.is_left(item.state));
                told["items"] = left
                    .map(
                        |item| serde_json::json!({ "item": item.name, "state": item.state.name() }),
                    )
                    .collect();
            }
            told
        });
        let stages: Vec<serde_json::Value> = stages.collect();
        serde_json::json!({
            "store": self.store,
            "n_left": self.surveys.iter().map(|survey| self.n_left(survey)).sum::<usize>(),
            "n_shards": self.n_shards(),
            "stages": stages,
        })
    }

    fn is_data(&self) -> bool {
        self.is_data
    }
}
