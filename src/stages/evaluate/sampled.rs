//! Baselines for the music of what is evaluated: which windows are sampled, and with what.

use std::collections::{BTreeMap, BTreeSet};

use ndarray::{Array2, s};

use super::baselines::tokens::{TokensBaseline, TokensBaselineRequest, settings_of_run};
use super::baselines::{self, Baseline, BaselineMotion, MusicWindow, RunSettings};
use super::evaluand::Evaluand;
use super::job::SampledWindow;
use super::params::Params;
use super::splits::MusicSplit;
use super::subjects::Subject;
use super::truth::Truth;
use crate::evaluation::window::window_starts;
use crate::generation::{FamilyCard as _, TokensCard};
use crate::model::Family;
use crate::motion::clock;
use crate::stages::generate::TokensSettings;
use crate::stages::model_files::{ModelFolder, OpenModel, default_model_cache};
use crate::stages::{Progress, learned};
use crate::store::tables::{self, GenerationRow};
use crate::store::{Location, StoreError, digest};

/// Seed of the noise of baselines, so that two evaluations sample the same.
pub(super) const BASELINE_SEED: u64 = 2026;

impl Evaluand {
    /// Returns whether the motions are of a model of tokens, whose dancers have the baselines of soloists.
    pub(super) fn is_by_tokens(&self) -> bool {
        let settings = self.generations.first().and_then(|row| row.settings.as_deref());
        settings.is_some_and(|text| serde_json::from_str::<TokensSettings>(text).is_ok())
    }

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
        let row = row.clone();
        let family = learned::family_with_weights(store, &row.model, &row.weights)?;
        let length = self.window_frames(truth);
        match family {
            Some(Family::Unet) => {
                let windows = self.music_windows(split, length, most)?;
                of_unet(store, params, &row, &windows, progress).map(Some)
            }
            Some(Family::Tokens) => {
                let windows = self.music_windows(split, length, most)?;
                of_tokens(store, params, &row, &windows, progress).map(Some)
            }
            Some(Family::Group) => {
                self.notes.push(format!(
                    "Model \"{}\" is of a family whose untrained network is not sampled as a baseline.",
                    row.model
                ));
                Ok(None)
            }
            None => {
                self.notes.push(format!(
                    "Store {store} has no model \"{}\" with the weights that the motions were made with, so that its \
                     untrained network could not be sampled as a baseline.",
                    row.model
                ));
                Ok(None)
            }
        }
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

/// Samples the baselines of a UNet.
fn of_unet(
    store: &Location,
    params: &Params,
    row: &GenerationRow,
    windows: &[MusicWindow],
    progress: &dyn Progress,
) -> anyhow::Result<Vec<SampledWindow>> {
    let model = OpenModel::of_store(store, &row.model, &default_model_cache())?;
    let settings = RunSettings::of_run(row, &model.card)?;
    let request = baselines::BaselineRequest {
        store,
        model: &model,
        settings: &settings,
        seed: BASELINE_SEED,
        windows,
        threads: params.threads,
    };
    let mut found = Vec::new();
    for (baseline, subject) in
        [(Baseline::Untrained, Subject::Untrained), (Baseline::NoMusic, Subject::NoMusic)]
    {
        let motions = baselines::sample(baseline, &request, progress)?;
        found.extend(sampled_windows(subject, windows, motions));
    }
    Ok(found)
}

/// Makes the baselines of a model of tokens.
fn of_tokens(
    store: &Location,
    params: &Params,
    row: &GenerationRow,
    windows: &[MusicWindow],
    progress: &dyn Progress,
) -> anyhow::Result<Vec<SampledWindow>> {
    let files = ModelFolder::of_store(store, &row.model, &default_model_cache())?;
    let card = TokensCard::read(files.card_bytes(), files.card_place())?;
    let settings = settings_of_run(row, &card)?;
    let request = TokensBaselineRequest {
        store,
        files: &files,
        card: &card,
        settings: &settings,
        seed: BASELINE_SEED,
        windows,
        threads: params.threads,
    };
    let mut found = Vec::new();
    for (baseline, subject) in [
        (TokensBaseline::Untrained, Subject::Untrained),
        (TokensBaseline::NoMusic, Subject::NoMusic),
        (TokensBaseline::ShuffledPlan, Subject::ShuffledPlan),
    ] {
        let motions = baselines::tokens::sample(baseline, &request, progress)?;
        found.extend(sampled_windows(subject, windows, motions));
    }
    Ok(found)
}

fn sampled_windows(
    subject: Subject,
    windows: &[MusicWindow],
    motions: Vec<BaselineMotion>,
) -> impl Iterator<Item = SampledWindow> {
    windows.iter().zip(motions).map(move |(window, motion)| SampledWindow {
        subject,
        phrase_id: window.phrase_id.clone(),
        first_frame: window.first_frame,
        frames: motion.frames,
    })
}
