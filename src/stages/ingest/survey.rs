//! What the store has of the phrases of a source, for `status`.

use std::collections::BTreeSet;

use clap::{Args as _, FromArgMatches as _};

use super::{Ingest, IngestRules, Layout, SEEN, params_hash, plan, state};
use crate::stages::Stage as _;
use crate::stages::item_state::{ItemState, last_params_hash};
use crate::stages::touched::TouchedContent;
use crate::store::{Source, StoreError, StoreSnapshot};

/// Returns the sources that the store has phrases of, in order.
///
/// # Errors
/// [`StoreError`] when the commits cannot be read.
pub fn origins(snapshot: &StoreSnapshot) -> Result<BTreeSet<String>, StoreError> {
    let ledger = snapshot.ledger(Ingest::NAME)?;
    Ok(ledger.iter().map(|known| known.origin.clone()).collect())
}

/// Returns the rules of ingest unless the user says otherwise.
fn usual_rules() -> IngestRules {
    let command = IngestRules::augment_args(clap::Command::new("usual"));
    IngestRules::from_arg_matches(&command.get_matches_from(["usual"]))
        .expect("invariant: every rule of ingest has a default")
}

/// Returns every phrase of a source with what the store has of it, by the rules of the last run, and whether those are
/// the usual ones.
///
/// # Errors
/// [`StoreError`] when the source cannot be listed or the commits cannot be read.
pub fn survey(
    snapshot: &StoreSnapshot,
    source: &Source,
    layout: Layout,
) -> Result<(Vec<(String, ItemState)>, bool), StoreError> {
    let plan = plan(source.list()?, layout);
    let ledger = snapshot.ledger(Ingest::NAME)?;
    let seen = TouchedContent::read(snapshot.store(), SEEN)?;
    let origin = source.location().url();
    let usual = params_hash(&usual_rules());
    let params_hash = last_params_hash(&ledger, &usual, |known| known.origin == origin)
        .unwrap_or_else(|| usual.clone());
    let unidentified = super::unidentified(snapshot)?;
    let states = plan.phrases.iter().map(|planned| {
        let state = match state(planned, &ledger, &seen, &params_hash, origin) {
            ItemState::Done if unidentified.contains(&planned.id) => ItemState::Stale,
            state => state,
        };
        (planned.id.clone(), state)
    });
    Ok((states.collect(), params_hash == usual))
}
