//! The library's phrases by their music: what sampling can begin from, and a baseline of every evaluation.

use std::num::NonZeroUsize;

use anyhow::bail;
use ndarray::{Array2, ArrayView2, s};

use crate::generation::{Retrieval, Windows};
use crate::motion::{MOTION_DIM, Placement};
use crate::store::{Location, Patience, StoreError, StoreSnapshot};
use crate::training::{Dataset, DatasetOptions, Ensemble, ExcludedPhrase, Phrase, Split};

/// Most training phrases that are read, the same ones every time: a bound on memory.
pub const MAX_TRAIN_PHRASES: usize = 4000;

/// Reads the phrases of a store that there is to learn from.
///
/// # Errors
/// As [`Dataset::read`].
pub fn read_dataset(
    store: &Location,
    threads: NonZeroUsize,
) -> Result<Dataset, crate::training::DatasetError> {
    let (dataset, left_out) =
        dataset_of(&StoreSnapshot::take(store)?, Ensemble::Soloists, threads)?;
    let n_groups = left_out.iter().filter(|one| one.is_for_other_models()).count();
    if n_groups > 0 {
        tracing::info!(
            "{n_groups} phrases of groups of dancers are left out: soloists begin from soloists"
        );
    }
    Ok(dataset)
}

/// Most training phrases of groups that are read: their frames count once for each dancer.
const MAX_TRAIN_GROUPS: usize = 800;

/// Reads the phrases of a snapshot that there is for soloists or groups to learn from, and those that are left out.
///
/// # Errors
/// As [`Dataset::read`].
pub fn dataset_of(
    snapshot: &StoreSnapshot,
    ensemble: Ensemble,
    threads: NonZeroUsize,
) -> Result<(Dataset, Vec<ExcludedPhrase>), crate::training::DatasetError> {
    let most = match ensemble {
        Ensemble::Soloists => MAX_TRAIN_PHRASES,
        Ensemble::Groups { .. } => MAX_TRAIN_GROUPS,
    };
    let reading = DatasetOptions {
        ensemble,
        in_memory: false,
        n_threads: threads,
        patience: Patience::default(),
        max_train_phrases: Some(most),
    };
    Dataset::of(snapshot, &reading, &|_, _| {}, &|_, _| {})
}

/// Returns an index of the training phrases that have `window_frames`, and their places in the dataset; none
/// where there are none.
///
/// # Errors
/// [`StoreError`] when frames at hand cannot be read.
pub fn index_of(
    dataset: &Dataset,
    window_frames: usize,
) -> Result<Option<(Retrieval, Vec<usize>)>, StoreError> {
    let (mut places, mut failed) = (Vec::new(), None);
    let is_indexed =
        |phrase: &Phrase| phrase.split == Split::Train && phrase.n_frames >= window_frames;
    let phrases = dataset.phrases().iter().enumerate().filter(|(_, phrase)| is_indexed(phrase));
    // One phrase in memory at a time: its frames are four times its key.
    let features = phrases.map_while(|(place, phrase)| {
        places.push(place);
        dataset.features(phrase, 0, window_frames).map_err(|e| failed = Some(e)).ok()
    });
    let index = Retrieval::new(window_frames, features);
    failed.map_or(Ok(index.map(|index| (index, places))), Err)
}

/// Phrases that sampling can begin from.
pub struct Primer {
    index: Retrieval,
    names: Vec<String>,
    /// Each in its own place, \[window, 25\].
    motions: Vec<Array2<f32>>,
    /// Digest of the phrases.
    pub fingerprint: String,
}

/// Motion for the windows of a track, and where it comes from.
pub struct Priming {
    /// Windows one behind the other, \[n T, 25\].
    pub motion: Array2<f32>,
    /// The phrase of each window.
    pub names: Vec<String>,
}

impl Primer {
    /// Reads the training phrases of a store that are as long as a model's windows.
    ///
    /// # Errors
    /// When the store cannot be read, or one sentence where it has no such phrases.
    pub fn read(
        store: &Location,
        window_frames: usize,
        threads: NonZeroUsize,
    ) -> anyhow::Result<Self> {
        let dataset = read_dataset(store, threads)?;
        let Some(primer) = Self::of(&dataset, window_frames)? else {
            bail!(
                "store {store} has no training phrases of {window_frames} frames, which sampling could begin \
                 from; leave --prime out, or build a library with motiongen library --store {store}"
            );
        };
        Ok(primer)
    }

    fn of(dataset: &Dataset, window_frames: usize) -> Result<Option<Self>, StoreError> {
        let Some((index, places)) = index_of(dataset, window_frames)? else { return Ok(None) };
        let (mut names, mut motions) = (Vec::new(), Vec::new());
        for place in places {
            let phrase = &dataset.phrases()[place];
            let mut motion = dataset.motion(phrase, 0, window_frames)?;
            if let Some(stands) = Placement::of_first(motion.view()) {
                stands.remove(&mut motion);
            }
            names.push(phrase.id.to_string());
            motions.push(motion);
        }
        Ok(Some(Self { index, names, motions, fingerprint: dataset.fingerprint().to_owned() }))
    }

    /// Returns the nearest phrase for every window of a track's features, `[T, 163]`; none where a feature is
    /// not finite.
    pub fn motion_for(&self, features: ArrayView2<f32>, windows: &Windows) -> Option<Priming> {
        let length = windows.length();
        let mut motion = Array2::zeros((windows.len() * length, MOTION_DIM));
        let mut names = Vec::with_capacity(windows.len());
        for i in 0..windows.len() {
            let (nearest, _) = self.index.nearest(features.slice(s![windows.frames(i), ..]))?;
            let mut target = motion.slice_mut(s![i * length..(i + 1) * length, ..]);
            target.assign(&self.motions[nearest].slice(s![..length, ..]));
            names.push(self.names[nearest].clone());
        }
        Some(Priming { motion, names })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::audio::FEATURE_DIM;

    /// A phrase that sounds of `pitch` and stands at `x` m, moving along z.
    fn phrase(n: usize, pitch: usize, x: f32) -> (Array2<f32>, Array2<f32>) {
        let motion = Array2::from_shape_fn((n, MOTION_DIM), |(t, channel)| match channel {
            0 => x,
            2 => x + 0.1 * t as f32,
            9 => 1.0,
            _ => 0.0,
        });
        let sound = |(t, j): (usize, usize)| if j == pitch + t / 8 { 1.0 } else { 0.0 };
        (motion, Array2::from_shape_fn((n, FEATURE_DIM), sound))
    }

    #[test]
    fn every_window_begins_from_the_nearest_training_phrase_in_its_own_place() {
        let phrases = [
            ("a", Split::Train, phrase(31, 3, 1.0)),
            ("b", Split::Train, phrase(24, 50, 2.0)),
            ("short", Split::Train, phrase(23, 90, 3.0)),
            ("unseen", Split::Test, phrase(40, 90, 4.0)),
        ];
        let dataset = Dataset::in_memory(
            phrases.map(|(id, split, (motion, features))| (id, split, motion, features)),
        )
        .expect("in memory");
        let primer = Primer::of(&dataset, 24).expect("read").expect("two phrases");
        assert_eq!(primer.names, ["a", "b"]);

        let mut features = phrase(41, 50, 0.0).1;
        features.slice_mut(s![17.., ..]).assign(&phrase(24, 3, 0.0).1);
        let windows = Windows::new(41, 24, 7);
        let priming = primer.motion_for(features.view(), &windows).expect("finite");
        assert_eq!(priming.names, ["b", "a"]);
        assert_eq!(priming.motion.dim(), (48, MOTION_DIM));
        // Both begin at the origin, wherever the phrase stood.
        for first in [0, 24] {
            assert_eq!(priming.motion.slice(s![first, ..3]).to_vec(), [0.0; 3]);
            assert!((priming.motion[[first + 23, 2]] - 2.3).abs() < 1e-5);
        }
        // A track that is shorter than a window is one of its own length.
        let short = primer.motion_for(features.slice(s![..13, ..]), &Windows::new(13, 24, 7));
        assert_eq!(short.map(|priming| priming.motion.nrows()), Some(13));
        features[[30, 5]] = f32::NAN;
        assert!(primer.motion_for(features.view(), &windows).is_none());
        assert!(Primer::of(&dataset, 32).expect("read").is_none());
    }
}
