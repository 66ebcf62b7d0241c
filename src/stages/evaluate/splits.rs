//! Of which music numbers are: whether the model learned from it.

use std::collections::BTreeMap;

use super::motions::PhraseIndex;
use crate::generation::LearnedFrom;
pub use crate::generation::MusicSplit;
use crate::stages::learned;
use crate::store::Location;
use crate::store::tables::GenerationRow;

/// Everything that was generated.
pub const ALL: &str = "all";

/// Every split, in the order in which they are measured.
pub const SPLITS: [MusicSplit; 4] =
    [MusicSplit::HeldOut, MusicSplit::Validation, MusicSplit::TrainedOn, MusicSplit::Unknown];

/// Returns the most telling of the given splits: held out, else unknown, else validation, else trained on.
pub fn telling(splits: impl IntoIterator<Item = MusicSplit>) -> Option<MusicSplit> {
    splits.into_iter().min_by_key(|split| match split {
        MusicSplit::HeldOut => 0,
        MusicSplit::Unknown => 1,
        MusicSplit::Validation => 2,
        MusicSplit::TrainedOn => 3,
    })
}

/// Returns what the model that made each motion had to do with its music, as the card says, and a note where that is
/// not known.
pub fn splits_of(
    store: &Location,
    phrases: &PhraseIndex,
    generations: &[GenerationRow],
) -> anyhow::Result<(Vec<MusicSplit>, Vec<String>)> {
    let mut models: BTreeMap<(&str, &str), Option<LearnedFrom>> = BTreeMap::new();
    let mut notes = Vec::new();
    for row in generations {
        let key = (row.model.as_str(), row.weights.as_str());
        if models.contains_key(&key) {
            continue;
        }
        let learned_from = match learned::of_model(store, key.0, key.1)? {
            Ok(learned_from) => Some(learned_from),
            Err(why) => {
                notes.push(format!(
                    "Nobody knows which of these songs model {} learned from: {why}.",
                    row.model
                ));
                None
            }
        };
        models.insert(key, learned_from);
    }
    let split = |row: &GenerationRow| -> MusicSplit {
        let learned_from = models.get(&(row.model.as_str(), row.weights.as_str()));
        match (learned_from, phrases.row(&row.phrase_id)) {
            (Some(Some(learned_from)), Some(phrase)) => {
                learned_from.split_of(phrase.song_hash.as_deref(), &phrase.content_hash)
            }
            _ => MusicSplit::Unknown,
        }
    };
    Ok((generations.iter().map(split).collect(), notes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn validation_never_counts_as_held_out() {
        use MusicSplit::{HeldOut, TrainedOn, Unknown, Validation};
        assert_eq!(telling([TrainedOn, Validation, HeldOut]), Some(HeldOut));
        assert_eq!(telling([TrainedOn, Validation, Unknown]), Some(Unknown));
        assert_eq!(telling([TrainedOn, Validation]), Some(Validation));
        assert_eq!(telling([]), None);
    }
}
