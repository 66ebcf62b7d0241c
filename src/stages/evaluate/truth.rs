//! The ground truth: motion of the phrases that there is to learn from.

use std::num::NonZeroUsize;

use ndarray::Array2;

use crate::evaluation::baseline::mean_motion;
use crate::evaluation::reference_statistics::ReferenceStatistics;
use crate::generation::Retrieval;
use crate::stages::Progress;
use crate::stages::retrieval::{index_of, read_dataset};
use crate::store::{Location, StoreError};
use crate::training::{DatasetError, Split};

/// Frames of the windows for which the library is asked for its nearest phrase.
pub const RETRIEVAL_FRAMES: usize = 120;
/// Where the statistics of the ground truth are kept in a store.
const STATISTICS: &str = "reference";

/// Motion to compare with.
pub struct Truth {
    pub phrases: Vec<TruthPhrase>,
    pub statistics: ReferenceStatistics,
    /// The library's phrases by their features, and the place of each in `phrases`.
    pub retrieval: Option<(Retrieval, Vec<usize>)>,
    /// The best constant.
    pub mean_motion: Array2<f32>,
}

/// A phrase of the ground truth.
pub struct TruthPhrase {
    pub id: String,
    pub split: Split,
    /// \[T, 25\]
    pub motion: Array2<f32>,
}

/// Reads the ground truth of a store; none, and a note, where there is too little.
///
/// # Errors
/// When the store cannot be read.
pub fn read(
    store: &Location,
    data_hash: &str,
    threads: NonZeroUsize,
    progress: &dyn Progress,
) -> anyhow::Result<Option<Truth>> {
    let dataset = match read_dataset(store, threads) {
        Ok(dataset) => dataset,
        Err(DatasetError::Empty { .. }) => {
            progress.note(
                "the store has no phrases with motion and features, so that there is no ground truth to \
                 compare with; build one with motiongen library",
            );
            return Ok(None);
        }
        Err(e) => return Err(e.into()),
    };
    let mut phrases = Vec::with_capacity(dataset.phrases().len());
    for phrase in dataset.phrases() {
        let motion = dataset.motion(phrase, 0, phrase.n_frames)?;
        phrases.push(TruthPhrase { id: phrase.id.to_string(), split: phrase.split, motion });
    }
    let retrieval = index_of(&dataset, RETRIEVAL_FRAMES)?;
    let train = || phrases.iter().filter(|phrase| phrase.split == Split::Train);
    let mean = mean_motion(train().map(|phrase| phrase.motion.view()), RETRIEVAL_FRAMES);
    let statistics = statistics(store, data_hash, &phrases)?;
    let (Some(mean_motion), Some(statistics)) = (mean, statistics) else {
        progress.note(
            "the phrases with motion and features are too few or too short to compare with; two chunks of \
             2.5 s are the least",
        );
        return Ok(None);
    };
    Ok(Some(Truth { phrases, statistics, retrieval, mean_motion }))
}

/// Returns the statistics of the ground truth: those that the store keeps of these data, else measured, and
/// kept.
fn statistics(
    store: &Location,
    data_hash: &str,
    phrases: &[TruthPhrase],
) -> anyhow::Result<Option<ReferenceStatistics>> {
    // Named by its data, so that no artefact is ever changed.
    let path = format!("{STATISTICS}/{}.json", &data_hash[..32.min(data_hash.len())]);
    match store.read(&path) {
        Ok(bytes) => {
            let known = String::from_utf8_lossy(&bytes);
            if let Ok(known) = ReferenceStatistics::from_json(&known)
                && known.check_data(data_hash).is_ok()
            {
                return Ok(Some(known));
            }
            // Of another version of this program, or broken: what is measured takes its place.
            store.remove(&path)?;
        }
        Err(StoreError::NotFound { .. }) => {}
        Err(e) => return Err(e.into()),
    }
    let motions: Vec<_> = phrases.iter().map(|phrase| phrase.motion.view()).collect();
    let measured = ReferenceStatistics::fit(&motions, data_hash.to_owned());
    if let Some(measured) = &measured {
        let text = serde_json::to_vec_pretty(measured)?;
        store.put_new(&path, text.into())?;
    }
    Ok(measured)
}
