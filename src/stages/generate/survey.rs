//! What the store has of the motions of a run, for `status`.

use std::collections::BTreeSet;
use std::num::NonZeroUsize;

use super::maker::generation_id;
use super::params::Tracks;
use super::settings::OUTPUT_VERSION;
use super::tracks::{TrackTarget, plan};
use super::{Generate, MotionSettings};
use crate::stages::Stage as _;
use crate::stages::item_state::{ItemState, last_params_hash};
use crate::stages::learned::weights_now;
use crate::store::tables::{GenerationRow, PhraseRow};
use crate::store::{Ledger, Row as _, Shard, StoreError, StoreSnapshot};

/// Which motions a run is to have; what is not said is what it has.
#[derive(Clone, Copy, Debug)]
pub struct SurveyedRun<'a> {
    pub run: &'a str,
    pub tracks: Option<Tracks>,
    pub split: Option<&'a str>,
    pub n_samples: Option<usize>,
}

/// Returns the runs that the store has motions of, in order.
///
/// # Errors
/// [`StoreError`] when the commits cannot be read.
pub fn runs(snapshot: &StoreSnapshot) -> Result<BTreeSet<String>, StoreError> {
    let ledger = snapshot.ledger(Generate::NAME)?;
    Ok(ledger.ids().filter_map(|id| Some(parts_of(id)?.0.to_owned())).collect())
}

/// Splits the name of a motion into its run, its phrase and its sample.
fn parts_of(id: &str) -> Option<(&str, &str, usize)> {
    let (run, rest) = id.split_once('/')?;
    let (phrase, sample) = rest.rsplit_once('/')?;
    Some((run, phrase, sample.parse().ok()?))
}

/// Returns the phrase, the name and the state of every motion of a run, by the parameters of the last command.
///
/// Motions of a model whose weights were replaced since, or of settings that are read otherwise now, are stale.
///
/// # Errors
/// When the store cannot be read, or has no phrases.
pub fn survey(
    snapshot: &StoreSnapshot,
    asked: SurveyedRun<'_>,
) -> anyhow::Result<Vec<(String, String, ItemState)>> {
    let SurveyedRun { run, split, .. } = asked;
    let ledger = snapshot.ledger(Generate::NAME)?;
    let settled = settled(&ledger, run);
    let n_known = settled.iter().map(|(_, sample)| sample + 1).max().unwrap_or(1);
    let n_samples = asked.n_samples.unwrap_or(n_known);
    let tracks = match asked.tracks {
        Some(tracks) => tracks,
        None => tracks_of(snapshot, &settled)?,
    };
    let is_of_run = |id: &str| parts_of(id).is_some_and(|parts| parts.0 == run);
    let params_hash =
        last_params_hash(&ledger, "", |known| is_of_run(&known.item.id)).unwrap_or_default();
    let target = TrackTarget {
        store: snapshot.store(),
        shard: Shard::WHOLE,
        params_hash: &params_hash,
        force: false,
        dry_run: true,
        tracks,
        split,
        phrases: &[],
        n_samples,
        n_workers: NonZeroUsize::MIN,
    };
    let is_outdated = is_outdated(snapshot, run)?;
    let mut found = Vec::new();
    for task in plan(&target, snapshot)? {
        for sample in 0..n_samples {
            let state = match task.state(run, sample, &ledger, &target) {
                ItemState::Done if is_outdated => ItemState::Stale,
                state => state,
            };
            let id = &task.row.phrase_id;
            found.push((id.clone(), generation_id(run, id, sample), state));
        }
    }
    Ok(found)
}

/// Returns the phrases and samples that a run has anything of.
fn settled<'a>(ledger: &'a Ledger, run: &str) -> BTreeSet<(&'a str, usize)> {
    let ids = ledger.ids().filter_map(parts_of);
    ids.filter(|parts| parts.0 == run).map(|(_, phrase, sample)| (phrase, sample)).collect()
}

/// Returns which phrases a run was made for: songs, unless it has constructed ones.
fn tracks_of(
    snapshot: &StoreSnapshot,
    settled: &BTreeSet<(&str, usize)>,
) -> Result<Tracks, StoreError> {
    let phrases: BTreeSet<&str> = settled.iter().map(|(phrase, _)| *phrase).collect();
    let (mut has_songs, mut has_constructed) = (false, false);
    snapshot.table(PhraseRow::schema())?.rows_where(|row: &PhraseRow| {
        if phrases.contains(row.phrase_id.as_str()) {
            has_constructed |= row.is_constructed();
            has_songs |= !row.is_constructed();
        }
        false
    })?;
    Ok(match (has_songs, has_constructed) {
        (_, false) => Tracks::Songs,
        (false, true) => Tracks::Constructed,
        (true, true) => Tracks::All,
    })
}

/// Returns whether the last motion of a run was made with weights that its model no longer has, or by a program that
/// made another one. Of a model that is not in the store nothing is known.
fn is_outdated(snapshot: &StoreSnapshot, run: &str) -> Result<bool, StoreError> {
    let mut last: Option<GenerationRow> = None;
    snapshot.table(GenerationRow::schema())?.rows_where(|row: &GenerationRow| {
        if row.run == run && last.as_ref().is_none_or(|last| row.time.0 > last.time.0) {
            last = Some(row.clone());
        }
        false
    })?;
    let Some(last) = last else { return Ok(false) };
    let settings =
        last.settings.and_then(|text| serde_json::from_str::<MotionSettings>(&text).ok());
    let is_of_other_program =
        settings.is_some_and(|settings| settings.output_version != OUTPUT_VERSION);
    let weights = weights_now(snapshot.store(), &last.model)?;
    Ok(is_of_other_program || weights.is_some_and(|weights| weights != last.weights))
}

#[cfg(test)]
mod tests {
    use super::parts_of;

    #[test]
    fn names_of_motions_are_taken_apart() {
        assert_eq!(parts_of("m/album/a b.ogg/12"), Some(("m", "album/a b.ogg", 12)));
        assert_eq!(parts_of("m/x"), None);
        assert_eq!(parts_of("m/x/y"), None);
    }
}
