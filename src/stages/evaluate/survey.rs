//! Whether runs were evaluated as their motions are now, for `status`.

use std::collections::BTreeSet;

use super::evaluand::Evaluand;
use super::rows::RunIdentity;
use super::{CHECKS, Evaluate, motions};
use crate::stages::Stage as _;
use crate::stages::item_state::ItemState;
use crate::store::{StoreError, StoreSnapshot};

/// Returns the runs that were evaluated, in order.
///
/// # Errors
/// [`StoreError`] when the commits cannot be read.
pub fn runs(snapshot: &StoreSnapshot) -> Result<BTreeSet<String>, StoreError> {
    let mut runs = BTreeSet::new();
    for stage in [CHECKS, Evaluate::NAME] {
        let ledger = snapshot.ledger(stage)?;
        // Files that hold no motion are settled as RUN/FILE.
        let of_runs = ledger.iter().filter(|known| known.item.succeeded());
        runs.extend(of_runs.map(|known| known.item.id.clone()));
    }
    Ok(runs)
}

/// Returns whether a run was evaluated, and files of it that hold no motion; of motions of another program it is not
/// known whether they are still the same.
///
/// # Errors
/// When the store cannot be read.
pub fn survey(
    snapshot: &StoreSnapshot,
    run: &str,
) -> anyhow::Result<(ItemState, BTreeSet<String>)> {
    let checks = snapshot.ledger(CHECKS)?;
    let prefix = format!("{run}/");
    let refused = checks.iter().filter(|known| known.item.failure.is_some());
    let refused = refused.map(|known| known.item.id.clone()).filter(|id| id.starts_with(&prefix));
    let refused: BTreeSet<String> = refused.collect();
    let numbers = snapshot.ledger(Evaluate::NAME)?;
    // A quick evaluation has checks alone.
    let (stage, ledger) = match numbers.get(run) {
        Some(known) if known.item.succeeded() => (Evaluate::NAME, &numbers),
        _ => (CHECKS, &checks),
    };
    let Some(known) = ledger.get(run).filter(|known| known.item.succeeded()) else {
        return Ok((ItemState::Missing, refused));
    };
    if !motions::has_run(snapshot, run)? {
        return Ok((ItemState::Done, refused));
    }
    let input_hash = match Evaluand::of_run(snapshot.clone(), run, None) {
        Ok(subject) => subject.input_hash(&subject.phrases.truth_digest())?,
        // Motions that are left to be made again are evaluated after that.
        Err(_) => return Ok((ItemState::Stale, refused)),
    };
    let identity = RunIdentity {
        store: snapshot.store(),
        run,
        params_hash: &known.params_hash,
        whole_hash: &known.params_hash,
        input_hash: &input_hash,
    };
    let is_current = identity.is_up_to_date(stage)?;
    Ok((if is_current { ItemState::Done } else { ItemState::Stale }, refused))
}
