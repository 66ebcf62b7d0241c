//! All tables of a store as they were at one moment.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::StoreError;
use super::item::ItemTables;
use super::ledger::Ledger;
use super::location::Location;
use super::manifest::Part;
use super::reader::{Snapshot, check_version};
use super::schema::TableSchema;
use super::stage_log::StageLog;

/// Most items for which it is looked up which parts they are in; for more of them all parts are read.
const MAX_LOOKED_UP: usize = 1 << 16;

/// The commits of a store, as they were when the snapshot was taken: one moment for all its tables.
#[derive(Clone, Debug)]
pub struct StoreSnapshot {
    store: Location,
    stages: Arc<Vec<StageLog>>,
}

/// A part that a table's readers see.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LivePart {
    pub part: Part,
    /// Items whose rows in this part were superseded by a later commit.
    pub superseded: Arc<Vec<String>>,
    /// The commit that the part is of.
    pub(super) commit: Arc<str>,
}

/// Returns the live parts of every table of a store, tables and parts in order of name.
///
/// # Errors
/// [`StoreError`] when commits cannot be read.
pub fn live_parts(store: &Location) -> Result<BTreeMap<String, Vec<LivePart>>, StoreError> {
    StoreSnapshot::take(store)?.live_parts()
}

impl StoreSnapshot {
    /// Takes a snapshot of a store; that of a store without commits is empty.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn take(store: &Location) -> Result<Self, StoreError> {
        let stages = Arc::new(StageLog::read_all(store)?);
        Ok(Self { store: store.clone(), stages })
    }

    /// Returns the store.
    pub fn store(&self) -> &Location {
        &self.store
    }

    /// Returns the live rows of a table; a table that was never written is empty.
    ///
    /// # Errors
    /// [`StoreError::SchemaVersion`] when a part is of a version that is not read; [`StoreError`] when
    /// the commits cannot be read.
    pub fn table(&self, schema: TableSchema) -> Result<Snapshot, StoreError> {
        let parts = self.parts(schema.name)?;
        Snapshot::new(&self.store, schema, parts, None).map(|table| table.within(self))
    }

    /// Returns the rows of the parts of a table that this program reads, and tells why it leaves out the first
    /// of the others.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn known_table(
        &self,
        schema: TableSchema,
    ) -> Result<(Snapshot, Option<StoreError>), StoreError> {
        let mut parts = self.parts(schema.name)?;
        let mut unknown = None;
        parts.retain(|live| match check_version(&self.store, &schema, live) {
            Ok(()) => true,
            Err(e) => {
                unknown.get_or_insert(e);
                false
            }
        });
        let table = Snapshot::new(&self.store, schema, parts, None)?.within(self);
        Ok((table, unknown))
    }

    /// Looks an item up; one that was not settled has no rows.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn item(&self, item: &str) -> Result<ItemTables, StoreError> {
        let mut tables: BTreeMap<String, Vec<LivePart>> = BTreeMap::new();
        for log in self.stages.iter() {
            for part in log.parts_of(item)? {
                let table = tables.entry(part.table.clone()).or_default();
                table.push(LivePart { part, superseded: Arc::default(), commit: "".into() });
            }
        }
        Ok(ItemTables::new(&self.store, item, tables))
    }

    /// Returns what a stage has committed.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn ledger(&self, stage: &str) -> Result<Ledger, StoreError> {
        match self.stages.iter().find(|log| log.stage == stage) {
            Some(log) => Ledger::of(log),
            None => Ok(Ledger::default()),
        }
    }

    /// Returns what a stage has committed of the items that `is_wanted` names, such as those of a shard.
    ///
    /// # Errors
    /// [`StoreError`] when the commits cannot be read.
    pub fn ledger_where(
        &self,
        stage: &str,
        is_wanted: impl Fn(&str) -> bool,
    ) -> Result<Ledger, StoreError> {
        match self.stages.iter().find(|log| log.stage == stage) {
            Some(log) => Ledger::of_items(log, is_wanted),
            None => Ok(Ledger::default()),
        }
    }

    /// Writes catalogues of stages whose last one is behind, as [`checkpoint`] does.
    pub fn checkpoint(&self) {
        for log in self.stages.iter() {
            report(&self.store, log);
        }
    }

    /// Returns the live parts of every table, tables and parts in order of name.
    ///
    /// # Errors
    /// [`StoreError`] when commits cannot be read.
    pub fn live_parts(&self) -> Result<BTreeMap<String, Vec<LivePart>>, StoreError> {
        let mut tables: BTreeMap<String, Vec<LivePart>> = BTreeMap::new();
        for log in self.stages.iter() {
            for live in live_parts_of(log)? {
                tables.entry(live.part.table.clone()).or_default().push(live);
            }
        }
        for parts in tables.values_mut() {
            parts.sort_by(|a, b| a.part.path.cmp(&b.part.path));
        }
        Ok(tables)
    }

    /// Returns the live parts of one table, in order of name.
    pub(super) fn parts(&self, table: &str) -> Result<Vec<LivePart>, StoreError> {
        let mut parts = Vec::new();
        for log in self.stages.iter().filter(|log| log.may_have(table)) {
            parts.extend(live_parts_of(log)?.into_iter().filter(|live| live.part.table == table));
        }
        parts.sort_by(|a, b| a.part.path.cmp(&b.part.path));
        Ok(parts)
    }

    /// Returns those parts of a table that may hold rows of the items.
    pub(super) fn parts_near<'a>(
        &self,
        table: &str,
        parts: &'a [LivePart],
        items: &BTreeSet<String>,
    ) -> Result<Vec<&'a LivePart>, StoreError> {
        if parts.len() < 2 || items.len() > MAX_LOOKED_UP {
            return Ok(parts.iter().collect());
        }
        let logs = self.stages.iter().filter(|log| log.may_have(table));
        let places = logs.map(StageLog::places).collect::<Result<Vec<_>, _>>()?;
        if places.iter().map(|places| places.n_items()).sum::<usize>() <= items.len() {
            return Ok(parts.iter().collect());
        }
        let commits: Vec<_> = places.iter().map(|places| places.commits_of(items)).collect();
        let is_near = |live: &&LivePart| commits.iter().any(|keys| keys.contains(&*live.commit));
        Ok(parts.iter().filter(is_near).collect())
    }
}

fn live_parts_of(log: &StageLog) -> Result<Vec<LivePart>, StoreError> {
    let mut live = Vec::new();
    for commit in log.state()?.iter().filter(|commit| !commit.is_dead) {
        live.extend(commit.parts.iter().map(|part| LivePart {
            part: part.clone(),
            superseded: Arc::clone(&commit.dead),
            commit: Arc::clone(&commit.key),
        }));
    }
    Ok(live)
}

/// Returns where an item of a stage came from when it was last settled, without reading what is known of others.
///
/// # Errors
/// [`StoreError`] when commits cannot be read.
pub fn origin_of(store: &Location, stage: &str, item: &str) -> Result<Option<String>, StoreError> {
    StageLog::read(store, stage)?.origin_of(item)
}

/// Writes catalogues of stages whose last one is behind; what keeps them from being written is logged and no
/// more, because a store is whole without them.
pub fn checkpoint(store: &Location, stages: &[&str]) {
    for stage in stages {
        match StageLog::read(store, stage) {
            Ok(log) => report(store, &log),
            Err(e) => tracing::warn!("{store}: no catalogue of {stage} was written: {e}"),
        }
    }
}

fn report(store: &Location, log: &StageLog) {
    let stage = &log.stage;
    match log.checkpoint(false) {
        Ok(true) => tracing::info!("wrote a catalogue of {stage}"),
        Ok(false) => {}
        Err(e) => tracing::warn!("{store}: no catalogue of {stage} was written: {e}"),
    }
}
