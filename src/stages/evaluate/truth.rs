//! Real motion: of the training split, by which all is measured, and held-out, which says how good a number can be.

use std::num::NonZeroUsize;

use ndarray::{Array2, ArrayView2, Axis};

use crate::evaluation::baseline::mean_motion;
use crate::evaluation::reference_statistics::ReferenceStatistics;
use crate::evaluation::window::{window, window_frames, window_starts};
use crate::generation::Retrieval;
use crate::motion::BODY;
use crate::stages::Progress;
use crate::stages::retrieval::{dataset_of, index_of};
use crate::store::{Location, StoreError, StoreSnapshot};
use crate::training::{DatasetError, Ensemble, Split};

/// Where the statistics of real motion are kept in a store.
const STATISTICS: &str = "reference";

/// Real motion to compare with.
pub struct Truth {
    pub phrases: Vec<TruthPhrase>,
    /// Of the training split alone.
    pub statistics: ReferenceStatistics,
    /// The training phrases by their features, and the place of each in `phrases`.
    pub retrieval: Option<(Retrieval, Vec<usize>)>,
    /// The best constant, a window of it.
    pub mean_motion: Array2<f32>,
}

/// A phrase with real motion, or a dancer of one: dancers of a group stand side by side.
pub struct TruthPhrase {
    pub id: String,
    pub split: Split,
    /// \[T, 25\]
    pub motion: Array2<f32>,
}

/// Reads the real motion of a store; none, and a note, where there is too little.
///
/// # Errors
/// When the store cannot be read.
pub fn read(
    snapshot: &StoreSnapshot,
    (data_hash, ensemble): (&str, Ensemble),
    threads: NonZeroUsize,
    progress: &dyn Progress,
) -> anyhow::Result<Option<Truth>> {
    let dataset = match dataset_of(snapshot, ensemble, threads) {
        Ok((dataset, left_out)) => {
            let n_groups = left_out.iter().filter(|one| one.is_for_other_models()).count();
            if n_groups > 0 && ensemble == Ensemble::Soloists {
                progress.note(&format!(
                    "{n_groups} phrases of groups of dancers are left out of real motion: soloists are compared \
                     with soloists"
                ));
            }
            dataset
        }
        Err(e @ DatasetError::GroupsAlone { .. }) => {
            progress.note(&format!("{e}, so that there is no real motion to compare with"));
            return Ok(None);
        }
        Err(DatasetError::Empty { .. }) => {
            progress.note(
                "the store has no phrases with motion and features, so that there is no real motion to \
                 compare with; build a library with motiongen library",
            );
            return Ok(None);
        }
        Err(e) => return Err(e.into()),
    };
    let mut phrases = Vec::with_capacity(dataset.phrases().len());
    let is_of_groups = ensemble != Ensemble::Soloists;
    for phrase in dataset.phrases().iter().filter(|phrase| (phrase.n_dancers > 1) == is_of_groups) {
        let group = dataset.group(phrase, 0, phrase.n_frames)?;
        phrases.extend(group.axis_iter(Axis(0)).map(|motion| TruthPhrase {
            id: phrase.id.to_string(),
            split: phrase.split,
            motion: motion.to_owned(),
        }));
    }
    let train = || phrases.iter().filter(|phrase| phrase.split == Split::Train);
    let too_little = "the training phrases of the store are too few or too short to compare with; two windows of 2.5 s are \
         the least";
    let Some(length) = window_frames(train().map(|phrase| phrase.motion.nrows())) else {
        progress.note(too_little);
        return Ok(None);
    };
    // Phrases of groups are no places of `phrases`, which has their dancers.
    let retrieval = if is_of_groups { None } else { index_of(&dataset, length)? };
    let mean = mean_motion(BODY, train().map(|phrase| phrase.motion.view()), length);
    let statistics = statistics(snapshot.store(), data_hash, train(), length)?;
    let (Some(mean_motion), Some(statistics)) = (mean, statistics) else {
        progress.note(too_little);
        return Ok(None);
    };
    Ok(Some(Truth { phrases, statistics, retrieval, mean_motion }))
}

/// Returns the statistics of the training split: those that the store keeps of these data, else measured, and
/// kept.
fn statistics<'a>(
    store: &Location,
    data_hash: &str,
    train: impl Iterator<Item = &'a TruthPhrase>,
    window_frames: usize,
) -> anyhow::Result<Option<ReferenceStatistics>> {
    // Named by its data, so that no artefact is ever changed.
    let path = format!("{STATISTICS}/{}.json", &data_hash[..32.min(data_hash.len())]);
    match store.read(&path) {
        Ok(bytes) => {
            let known = String::from_utf8_lossy(&bytes);
            if let Ok(known) = ReferenceStatistics::from_json(&known)
                && known.check_data(data_hash).is_ok()
                && known.window_frames == window_frames
            {
                return Ok(Some(known));
            }
            // Of another version of this program, or broken: what is measured takes its place.
            store.remove(&path)?;
        }
        Err(StoreError::NotFound { .. }) => {}
        Err(e) => return Err(e.into()),
    }
    let windows: Vec<Array2<f32>> = train
        .flat_map(|phrase| {
            let motion = phrase.motion.view();
            window_starts(motion.nrows(), window_frames)
                .map(move |first| window(motion, first, window_frames))
        })
        .collect();
    let views: Vec<ArrayView2<f32>> = windows.iter().map(|window| window.view()).collect();
    let measured = ReferenceStatistics::fit(&views, data_hash.to_owned());
    if let Some(measured) = &measured {
        let text = serde_json::to_vec_pretty(measured)?;
        store.put_new(&path, text.into())?;
    }
    Ok(measured)
}
