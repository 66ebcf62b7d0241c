//! Whether rows were made from what their phrases' files hold now.
//!
//! `extractions` and `generations` say what content they were made from. Rows of older versions do not, but the
//! commits that wrote them do.

use std::collections::{BTreeMap, BTreeSet};

use super::StoreError;
use super::ledger::Ledger;
use super::schema::Row as _;
use super::store_snapshot::StoreSnapshot;
use super::tables::{ExtractionRow, GenerationRow, PhraseRow};

/// The stages that write those tables, as commits name them.
const EXTRACT: &str = "extract";
const GENERATE: &str = "generate";

/// Returns the phrases whose features were extracted from other content than they have now, in order of name.
///
/// Constructed phrases have their features from the commit that has the phrase. Features that this program does not
/// read are not looked at.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn outdated_features<'a>(
    store: &StoreSnapshot,
    phrases: impl IntoIterator<Item = &'a PhraseRow>,
) -> Result<BTreeSet<String>, StoreError> {
    let phrases = phrases.into_iter().filter(|row| !row.is_constructed());
    let present: BTreeMap<&str, &str> =
        phrases.map(|row| (row.phrase_id.as_str(), row.content_hash.as_str())).collect();
    if present.is_empty() {
        return Ok(BTreeSet::new());
    }
    let (table, _) = store.known_table(ExtractionRow::schema())?;
    let rows = table.rows_where(|row: &ExtractionRow| present.contains_key(&*row.phrase_id))?;
    let made_from = rows.into_iter().map(|row| {
        let hash = row.content_hash;
        (row.phrase_id, hash)
    });
    let made_from: Vec<(String, Option<String>)> = made_from.collect();
    let outdated = outdated(store, EXTRACT, &made_from, |id| present.get(id).copied())?;
    Ok(outdated.into_iter().map(str::to_owned).collect())
}

/// Returns the motions, by name, that were made for other content than their phrases have now; a phrase that is gone
/// has none.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn outdated_generations<'a>(
    store: &StoreSnapshot,
    rows: &[GenerationRow],
    content_of: impl Fn(&str) -> Option<&'a str>,
) -> Result<BTreeSet<String>, StoreError> {
    let made_from: Vec<(String, Option<String>)> =
        rows.iter().map(|row| (row.generation.clone(), row.content_hash.clone())).collect();
    let phrase_of: BTreeMap<&str, &str> =
        rows.iter().map(|row| (row.generation.as_str(), row.phrase_id.as_str())).collect();
    let content_of = |name: &str| content_of(phrase_of.get(name)?);
    let outdated = outdated(store, GENERATE, &made_from, content_of)?;
    Ok(outdated.into_iter().map(str::to_owned).collect())
}

fn outdated<'a, 'b>(
    store: &StoreSnapshot,
    stage: &str,
    made_from: &'a [(String, Option<String>)],
    content_of: impl Fn(&str) -> Option<&'b str>,
) -> Result<Vec<&'a str>, StoreError> {
    let is_needed = made_from.iter().any(|(_, hash)| hash.is_none());
    let ledger = if is_needed { store.ledger(stage)? } else { Ledger::default() };
    let is_outdated = |(id, hash): &&(String, Option<String>)| {
        let settled = || ledger.get(id).map(|known| known.item.input_hash.as_str());
        let was = hash.as_deref().or_else(settled);
        matches!((was, content_of(id)), (Some(was), Some(is)) if was != is)
    };
    Ok(made_from.iter().filter(is_outdated).map(|(id, _)| id.as_str()).collect())
}
