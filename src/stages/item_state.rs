//! What a stage's commits say of an item, held against what the item is now: what decides whether it is done again.

use std::collections::BTreeMap;

use crate::store::{Ledger, SettledItem};

/// The state of one item of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum ItemState {
    /// Done for what the item is now. The stage leaves it alone; it does all others.
    Done,
    /// Failed for what the item is now.
    Failed,
    /// Settled for other content, or with other parameters.
    Stale,
    /// Never settled, or forgotten since.
    Missing,
}

impl ItemState {
    /// Returns the state of an item that was settled so; `is_current` tells whether that was for what it is now.
    pub fn of(known: Option<&SettledItem>, is_current: impl FnOnce(&SettledItem) -> bool) -> Self {
        match known {
            None => Self::Missing,
            Some(known) if known.item.failure.is_none() && !known.item.succeeded() => Self::Missing,
            Some(known) if !is_current(known) => Self::Stale,
            Some(known) if known.item.failure.is_some() => Self::Failed,
            Some(_) => Self::Done,
        }
    }

    /// Returns whether the stage leaves the item alone.
    pub fn is_done(self) -> bool {
        self == Self::Done
    }

    /// Returns the name of the state.
    pub fn name(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Failed => "failed",
            Self::Stale => "stale",
            Self::Missing => "missing",
        }
    }
}

/// Returns the digest of the parameters with which a stage settled items last.
///
/// Commits have no clock, but one that replaces others has a higher sequence. Among parameters of one sequence, which
/// settled different items, those in use now (`usual`) come first, then those of the most items.
pub fn last_params_hash(
    ledger: &Ledger,
    usual: &str,
    is_wanted: impl Fn(&SettledItem) -> bool,
) -> Option<String> {
    let mut found: BTreeMap<&str, (u64, u64)> = BTreeMap::new();
    for known in ledger.iter().filter(|known| is_wanted(known)) {
        let (sequence, n_items) = found.entry(&known.params_hash).or_default();
        *sequence = known.sequence.max(*sequence);
        *n_items += 1;
    }
    let rank = |hash: &str, (sequence, n_items): (u64, u64)| (sequence, hash == usual, n_items);
    let last = found.into_iter().max_by_key(|(hash, seen)| rank(hash, *seen));
    last.map(|(hash, _)| hash.to_owned())
}
