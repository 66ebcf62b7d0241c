//! What generated motion is compared with, beside real motion: retrieved, constant and sampled motion for its music.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use ndarray::{Array2, ArrayView2, s};

use super::job::{EvaluationJob, SampledWindow};
use super::measure::Measurer;
use super::subjects::{MeasuredWindow, Subject};
use crate::evaluation::WindowMeasures;
use crate::evaluation::window::window_starts;
use crate::store::{StoreError, digest, tables};

/// Windows of music for which the library is asked for its nearest phrase.
const MAX_RETRIEVED: usize = 500;

/// Baselines that were sampled.
pub(super) struct SampledBaselines {
    pub untrained: Vec<MeasuredWindow>,
    pub no_music: Vec<MeasuredWindow>,
    pub shuffled_plan: Vec<MeasuredWindow>,
}

impl EvaluationJob<'_> {
    /// Asks the library for the nearest phrases of other songs, for one motion of each phrase.
    pub(super) fn retrieved(
        &self,
        measurer: &Measurer,
        generated: &[(MeasuredWindow, Array2<f32>)],
    ) -> Result<Vec<MeasuredWindow>, StoreError> {
        let Some((truth, (index, of_phrase))) =
            self.truth.and_then(|truth| Some((truth, truth.retrieval.as_ref()?)))
        else {
            return Ok(Vec::new());
        };
        let mut names: BTreeSet<&str> =
            self.motions.iter().map(|motion| motion.phrase_id.as_str()).collect();
        if names.len() > MAX_RETRIEVED {
            // A song here and there, where there are more than are asked for.
            let mut order: Vec<&str> = names.into_iter().collect();
            order.sort_by_cached_key(|id| digest(id.as_bytes()));
            order.truncate(MAX_RETRIEVED);
            names = order.into_iter().collect();
        }
        let most = MAX_RETRIEVED.div_ceil(names.len().max(1));
        let owned: BTreeSet<String> = names.iter().map(|id| (*id).to_owned()).collect();
        let length = measurer.window_frames;
        let mut found: BTreeMap<String, Vec<MeasuredWindow>> = BTreeMap::new();
        self.snapshot.table(tables::features())?.visit_items(
            &owned,
            |id, features: Array2<f32>| {
                let song = self.phrases.song(id);
                let is_other =
                    |i: usize| self.phrases.song(&truth.phrases[of_phrase[i]].id) != song;
                let items =
                    window_starts(features.nrows(), length).take(most).filter_map(|first| {
                        let window = features.slice(s![first..first + length, ..]);
                        let (nearest, _) = index.nearest_among(window, is_other)?;
                        let phrase = &truth.phrases[*of_phrase.get(nearest)?];
                        let window = phrase.motion.slice(s![..length, ..]);
                        self.baseline_item(measurer, generated, id, first, window)
                    });
                let items: Vec<MeasuredWindow> = items.collect();
                found.insert(id.to_owned(), items);
                Ok::<_, StoreError>(())
            },
        )?;
        Ok(found.into_values().flatten().collect())
    }

    /// Measures a window of some motion with the music of a place of a phrase that motion was generated for.
    fn baseline_item(
        &self,
        measurer: &Measurer,
        generated: &[(MeasuredWindow, Array2<f32>)],
        phrase_id: &str,
        first_frame: usize,
        window: ArrayView2<f32>,
    ) -> Option<MeasuredWindow> {
        let place = self.motions.iter().position(|motion| motion.phrase_id == phrase_id)?;
        let motion = &self.motions[place];
        let song = self.phrases.song(phrase_id);
        let known = generated.iter().find(|(item, _)| {
            item.song == song
                && item
                    .music
                    .as_ref()
                    .is_some_and(|music| music.bars.len() >= first_frame + measurer.window_frames)
        });
        let music = match known.filter(|_| self.phrases.is_song(phrase_id)) {
            Some((item, _)) => item.music.clone(),
            None => {
                self.phrases.music(phrase_id, first_frame + measurer.window_frames).map(Arc::new)
            }
        };
        let measured: WindowMeasures = measurer.measure(window).windows.into_iter().next()?;
        Some(MeasuredWindow {
            song,
            phrase: place,
            first_frame,
            split: motion.split,
            measured: Arc::new(measured),
            decoded: None,
            music,
        })
    }

    /// Returns the best constant with the music of each phrase, one for each window.
    pub(super) fn mean_motion(
        &self,
        measurer: &Measurer,
        generated: &[(MeasuredWindow, Array2<f32>)],
    ) -> Vec<MeasuredWindow> {
        let Some(truth) = self.truth else { return Vec::new() };
        let Some(still) =
            measurer.measure(truth.mean_motion.view()).windows.into_iter().next().map(Arc::new)
        else {
            return Vec::new();
        };
        let mut places = BTreeSet::new();
        generated
            .iter()
            .filter(|(item, _)| places.insert((item.phrase, item.first_frame)))
            .take(MAX_RETRIEVED)
            .map(|(item, _)| MeasuredWindow {
                measured: still.clone(),
                decoded: None,
                ..item.clone()
            })
            .collect()
    }

    pub(super) fn sampled(
        &self,
        measurer: &Measurer,
        sampled: &[SampledWindow],
    ) -> SampledBaselines {
        let item = |window: &SampledWindow| {
            let (id, first) = (window.phrase_id.as_str(), window.first_frame);
            self.baseline_item(measurer, &[], id, first, window.frames.view())
        };
        let windows_of = |subject: Subject| -> Vec<MeasuredWindow> {
            sampled.iter().filter(|window| window.subject == subject).filter_map(item).collect()
        };
        SampledBaselines {
            untrained: windows_of(Subject::Untrained),
            no_music: windows_of(Subject::NoMusic),
            shuffled_plan: windows_of(Subject::ShuffledPlan),
        }
    }
}
