//! What the store has of the songs of a library, for `status`.

use std::collections::BTreeSet;

use super::captures::Captures;
use super::songs::{Song, Songs};
use super::store_contents::StoreContents;
use super::write::{fingerprint, state};
use super::{FROM_STORE, Library, SEEN, split};
use crate::stages::Stage as _;
use crate::stages::item_state::{ItemState, last_params_hash};
use crate::stages::touched::TouchedContent;
use crate::store::{Source, StoreSnapshot};

/// The songs from one place.
pub struct SurveyedSongs {
    /// Where they come from; none is the store itself.
    pub folder: Option<String>,
    pub states: Vec<(String, ItemState)>,
    /// Whether it is known which captures they are to be danced with.
    pub has_captures: bool,
}

/// Returns every song of the libraries that were constructed in a store, by the rules of the last run.
///
/// Songs lie where they lay then. Captures are those of the store, or of `captures`; where there are none, it is not
/// known whether others came. The split of a song is as it was.
///
/// # Errors
/// When the store or the songs cannot be read.
pub fn survey(
    snapshot: &StoreSnapshot,
    captures: Option<Source>,
    open: impl Fn(&str) -> anyhow::Result<Source>,
) -> anyhow::Result<Vec<SurveyedSongs>> {
    let ledger = snapshot.ledger(Library::NAME)?;
    let seen = TouchedContent::read(snapshot.store(), SEEN)?;
    let origins: BTreeSet<&str> = ledger
        .iter()
        .filter(|known| known.item.succeeded())
        .map(|known| known.origin.as_str())
        .collect();
    let mut found = Vec::new();
    for origin in origins {
        let mut known = StoreContents::read(snapshot)?;
        let is_of_store = origin == FROM_STORE;
        let captures = match &captures {
            Some(folder) => Some(Captures::of_folder(folder.clone(), None)?),
            None if known.captures.is_empty() => None,
            None => Some(Captures::of_store(snapshot, &known)),
        };
        let mut songs = match is_of_store {
            true => Songs::of_store(snapshot, &mut known, false)?,
            false => Songs::of_folder(open(origin)?, &known)?,
        };
        songs.refuse_namesakes();
        let params_hash =
            last_params_hash(&ledger, "", |known| known.origin == origin && known.item.succeeded())
                .unwrap_or_default();
        let state_of = |song: &Song| {
            if song.problem.is_some() {
                return ItemState::Failed;
            }
            let first = known.constructed.get(&song.slug).and_then(|phrases| phrases.keys().next());
            let first = first.and_then(|id| ledger.get(id));
            let state_with = |fingerprint: &str| {
                let made_by = (origin, params_hash.as_str());
                state(song, first, (&ledger, &seen), made_by, fingerprint)
            };
            let Some(captures) = &captures else {
                return state_with(first.map_or("", |known| &known.item.fingerprint));
            };
            // Which songs are held out may have been chosen otherwise than by default.
            let states = [split::TRAIN, split::VALIDATION, split::TEST].map(|split| {
                let song = Song { split, ..song.clone() };
                state_with(&fingerprint(&song, &captures.fingerprint))
            });
            states.into_iter().min().unwrap_or(ItemState::Missing)
        };
        let states = songs.songs.iter().map(|song| (song.id.clone(), state_of(song))).collect();
        found.push(SurveyedSongs {
            folder: (!is_of_store).then(|| origin.to_owned()),
            states,
            has_captures: captures.is_some(),
        });
    }
    Ok(found)
}
