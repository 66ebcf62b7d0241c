//! Who may write a run, a model or a store's parts: one process at a time.

use std::cell::Cell;
use std::time::Duration;

use crate::store::{Lease, Location, StoreError};

/// Takes the lease `name`, and returns with it whether another process had it before and was waited for.
///
/// `what` is how the user knows the thing that is written; `note` receives a sentence for whom is waited.
///
/// # Errors
/// [`StoreError::Held`] when another process writes it; errors of the storage.
pub fn take(
    store: &Location,
    name: &str,
    what: &str,
    note: &dyn Fn(&str),
) -> Result<(Lease, bool), StoreError> {
    let has_waited = Cell::new(false);
    let waiting = |holder: &str, rest: Duration| {
        has_waited.set(true);
        let rest_s = rest.as_secs() + 1;
        note(&format!(
            "{what} was last written by {holder}; waiting {rest_s} s for a sign of life"
        ));
    };
    let lease = Lease::take(store, name, &waiting)?;
    Ok((lease, has_waited.get()))
}
