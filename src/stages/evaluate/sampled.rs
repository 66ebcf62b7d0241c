//! Baselines for the music of what is evaluated: which windows are sampled, and with what.

use std::collections::{BTreeMap, BTreeSet};

use ndarray::{Array2, s};

use super::baselines::{self, Baseline, MusicWindow, RunSettings};
use super::evaluand::Evaluand;
use super::job::SampledWindow;
use super::params::Params;
use super::splits::MusicSplit;
use super::subjects::Subject;
use super::truth::Truth;
use crate::evaluation::window::window_starts;
use crate::motion::clock;
use crate::stages::model_files::{OpenModel, default_model_cache};
use crate::stages::{Progress, learned};
use crate::store::{Location, StoreError, digest, tables};

/// Seed of the noise of baselines, so that two evaluations sample the same.
pub(super) const BASELINE_SEED: u64 = 2026;

impl Evaluand {
    /// Samples the untrained network, and the trained one without music, for windows of the music of a split; none,
    /// and a note, where the model is not there.
    pub(super) fn sampled(
        &mut self,
        store: &Location,
        params: &Params,
        truth: Option<&Truth>,
        split: MusicSplit,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<Vec<SampledWindow>>> {
        let most = params.baseline_windows;
        let (Some(row), true) = (self.generations.first(), most > 0) else { return Ok(None) };
        let is_there = learned::has_weights(store, &row.model, &row.weights)?;
        if !is_there && learned::weights_now(store, &row.model)?.as_ref() == Some(&row.weights) {
            self.notes.push(format!(
                "Model \"{}\" is of a family whose untrained network is not sampled as a baseline.",
                row.model
            ));
            return Ok(None);
        }
        if !is_there {
            self.notes.push(format!(
                "Store {store} has no model \"{}\" with the weights that the motions were made with, so that its \
                 untrained network could not be sampled as a baseline.",
                row.model
            ));
            return Ok(None);
        }
        let model = OpenModel::of_store(store, &row.model, &default_model_cache())?;
        let settings = RunSettings::of_run(row, &model.card)?;
        let length = self.window_frames(truth);
        let windows = self.music_windows(split, length, most)?;
        let request = baselines::BaselineRequest {
            store,
            model: &model,
            settings: &settings,
            seed: BASELINE_SEED,
            windows: &windows,
            threads: params.threads,
        };
        let mut sampled = Vec::new();
        for (baseline, subject) in
            [(Baseline::Untrained, Subject::Untrained), (Baseline::NoMusic, Subject::NoMusic)]
        {
            let motions = baselines::sample(baseline, &request, progress)?;
            sampled.extend(windows.iter().zip(motions).map(|(window, motion)| SampledWindow {
                subject,
                phrase_id: window.phrase_id.clone(),
                first_frame: window.first_frame,
                frames: motion.frames,
            }));
        }
        Ok(Some(sampled))
    }

    /// Returns up to `most` windows of the music of a split, evenly among all of up to as many phrases.
    pub(super) fn music_windows(
        &self,
        split: MusicSplit,
        length: usize,
        most: usize,
    ) -> Result<Vec<MusicWindow>, StoreError> {
        let motions_in_split = self.motions.iter().filter(|motion| motion.split == split);
        let ids: BTreeSet<&str> =
            motions_in_split.map(|motion| motion.phrase_id.as_str()).collect();
        let mut order: Vec<&str> = ids.into_iter().collect();
        order.sort_by_cached_key(|id| digest(id.as_bytes()));
        order.truncate(most);
        let names: BTreeSet<String> = order.iter().map(|id| (*id).to_owned()).collect();
        let mut all: BTreeMap<String, Vec<MusicWindow>> = BTreeMap::new();
        self.snapshot.table(tables::features())?.visit_items(
            &names,
            |id, features: Array2<f32>| {
                let n_frames = features.nrows();
                let music = self.phrases.music(id, n_frames).map(|music| {
                    let phase: Vec<f64> =
                        music.bars.iter().map(|bars| bars.rem_euclid(1.0)).collect();
                    let clock = clock(&phase, music.beats_per_bar);
                    (phase, clock)
                });
                let window = |first: usize| MusicWindow {
                    phrase_id: id.to_owned(),
                    first_frame: first,
                    features: features.slice(s![first..first + length, ..]).to_owned(),
                    phase: music.as_ref().map(|(phase, _)| phase[first..first + length].to_vec()),
                    clock: music
                        .as_ref()
                        .map(|(_, clock)| clock.slice(s![first..first + length, ..]).to_owned()),
                };
                let windows = window_starts(n_frames, length).map(window).collect();
                all.insert(id.to_owned(), windows);
                Ok::<_, StoreError>(())
            },
        )?;
        let all: Vec<MusicWindow> = all.into_values().flatten().collect();
        let n = most.min(all.len());
        Ok((0..n).map(|i| all[i * all.len() / n].clone()).collect())
    }
}
