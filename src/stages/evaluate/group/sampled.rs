//! Baselines of groups that are sampled: the untrained network, the trained one without music, and soloists.

use std::num::NonZeroUsize;
use std::sync::Mutex;

use anyhow::Context as _;
use ndarray::{Array3, Axis, concatenate};
use serde::Serialize;

use super::{GroupMeasurer, SampledGroup};
use crate::autodiff::Parameters;
use crate::diffusion::Schedule;
use crate::generation::{
    EngineError, FamilyCard as _, GroupCard, GroupEngine, GroupGenerator, GroupTrack,
};
use crate::model::{GroupNetworks, condition};
use crate::stages::evaluate::baselines::{BaselineMotion, MusicWindow, cache};
use crate::stages::evaluate::evaluand::Evaluand;
use crate::stages::evaluate::job::SampledWindow;
use crate::stages::evaluate::params::Params;
use crate::stages::evaluate::sampled::BASELINE_SEED;
use crate::stages::evaluate::splits::MusicSplit;
use crate::stages::evaluate::subjects::Subject;
use crate::stages::generate::{GroupSettings, group_parameters, seed_of};
use crate::stages::model_files::{ModelFolder, default_model_cache};
use crate::stages::pool::{self, lock};
use crate::stages::{Progress, learned};
use crate::store::{Location, digest};

/// Most windows of music for which each baseline is sampled: groups cost as much as their dancers.
const MAX_WINDOWS: usize = 32;
/// Raised when the same networks, settings and windows give other motion.
const VERSION: u32 = 1;

/// Baselines of groups, each as its own subject.
const BASELINES: [Subject; 3] = [Subject::Untrained, Subject::NoMusic, Subject::Independent];

/// The model of a run of groups, and how its baselines are sampled.
struct GroupBaselines<'a> {
    store: &'a Location,
    files: ModelFolder,
    card: GroupCard,
    settings: GroupSettings,
    windows: Vec<MusicWindow>,
    threads: NonZeroUsize,
}

/// What determines the motion of a baseline.
#[derive(Serialize)]
struct GroupBaselineKey<'a> {
    version: u32,
    baseline: &'static str,
    card: &'a GroupCard,
    settings: &'a GroupSettings,
    seed: u64,
    /// Phrase, first frame, and digests of features and phase.
    windows: Vec<(&'a str, usize, String, Option<String>)>,
}

impl Evaluand {
    /// Samples baselines for windows of the music of a split: gives groups to `measurer`, and returns their dancers; none,
    /// and a note, where the model is not there.
    pub(in crate::stages::evaluate) fn sampled_groups(
        &mut self,
        store: &Location,
        params: &Params,
        (split, measurer): (MusicSplit, &mut GroupMeasurer),
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<Vec<SampledWindow>>> {
        let most = params.baseline_windows.min(MAX_WINDOWS);
        let (Some(row), true) = (self.generations.first(), most > 0) else { return Ok(None) };
        let settings = row.settings.as_deref().and_then(GroupSettings::of_text);
        let now = learned::weights_now(store, &row.model)?;
        let (Some(settings), true) = (settings, now.as_ref() == Some(&row.weights)) else {
            self.notes.push(format!(
                "Store {store} has no model \"{}\" with the weights and settings that the motions were made with, so \
                 that neither its untrained network nor soloists could be sampled as baselines.",
                row.model
            ));
            return Ok(None);
        };
        let files = ModelFolder::of_store(store, &row.model, &default_model_cache())?;
        let card = GroupCard::read(files.card_bytes(), files.card_place())?;
        let windows = self.music_windows(split, measurer.window_frames(), most)?;
        let baselines =
            GroupBaselines { store, files, card, settings, windows, threads: params.threads };
        let mut dancers = Vec::new();
        for subject in BASELINES {
            let groups = baselines.sample(subject, progress)?;
            let mut of_subject = Vec::new();
            for (window, frames) in baselines.windows.iter().zip(groups) {
                let (phrase_id, first_frame) = (window.phrase_id.clone(), window.first_frame);
                // Soloists are held against groups, and not against their dancers one by one.
                if subject != Subject::Independent {
                    dancers.extend(frames.axis_iter(Axis(0)).map(|dancer| SampledWindow {
                        subject,
                        phrase_id: phrase_id.clone(),
                        first_frame,
                        frames: dancer.to_owned(),
                    }));
                }
                of_subject.push(SampledGroup { subject, phrase_id, first_frame, split, frames });
            }
            measurer.expect(of_subject);
        }
        Ok(Some(dancers))
    }
}

impl GroupBaselines<'_> {
    /// Returns a group for each window, in order: what the store keeps, else sampled, and kept.
    fn sample(
        &self,
        subject: Subject,
        progress: &dyn Progress,
    ) -> anyhow::Result<Vec<Array3<f32>>> {
        let digest = self.digest(subject)?;
        let n_dancers = self.settings.n_dancers;
        // The file has the dancers of a window one behind the other.
        let of_dancers: Vec<MusicWindow> = self
            .windows
            .iter()
            .flat_map(|window| std::iter::repeat_n(window.clone(), n_dancers))
            .collect();
        let motions = match cache::read(self.store, &digest, &of_dancers)? {
            Some(known) => known,
            None => {
                let motions = self.sample_all(subject, progress)?;
                cache::write(self.store, &digest, &motions)?;
                motions
            }
        };
        let groups = motions.chunks_exact(n_dancers).map(|dancers| {
            let views: Vec<_> = dancers.iter().map(|dancer| dancer.frames.view()).collect();
            ndarray::stack(Axis(0), &views).context("while joining the dancers of a baseline")
        });
        groups.collect()
    }

    fn digest(&self, subject: Subject) -> anyhow::Result<String> {
        let bytes = |values: &mut dyn Iterator<Item = [u8; 4]>| -> String {
            digest(&values.flatten().collect::<Vec<u8>>())
        };
        let key = GroupBaselineKey {
            version: VERSION,
            baseline: subject.name(),
            card: &self.card,
            settings: &self.settings,
            seed: BASELINE_SEED,
            windows: self
                .windows
                .iter()
                .map(|window| {
                    let features = bytes(&mut window.features.iter().map(|x| x.to_le_bytes()));
                    let phase = window
                        .phase
                        .as_ref()
                        .map(|phase| bytes(&mut phase.iter().map(|&x| (x as f32).to_le_bytes())));
                    (window.phrase_id.as_str(), window.first_frame, features, phase)
                })
                .collect(),
        };
        Ok(digest(&serde_json::to_vec(&key)?))
    }

    /// Samples a baseline; the dancers of each window are side by side.
    fn sample_all(
        &self,
        subject: Subject,
        progress: &dyn Progress,
    ) -> anyhow::Result<Vec<BaselineMotion>> {
        let Self { files, card, settings, windows, threads, .. } = self;
        let parameters = match subject {
            Subject::Untrained => {
                // Layers that begin at zero are drawn like all others: else nothing would move.
                let list = GroupNetworks::new(&card.group).1;
                Parameters::new(list.without_zero_layers(), 0)
            }
            _ => group_parameters(files, card)?,
        };
        // Windows are independent: a worker of one thread for each core keeps all of them busy.
        let workers = (*threads, NonZeroUsize::MIN);
        let engine = GroupEngine::new(&card.group, parameters, &card.feature_scale, workers)
            .context("while starting threads")?;
        let schedule = Schedule::new(&card.diffusion)?;
        let (guidance, consistency) = match subject {
            Subject::NoMusic => (0.0, settings.gamma()),
            Subject::Independent => (settings.guidance, 0.0),
            _ => (settings.guidance, settings.gamma()),
        };
        let generator = GroupGenerator {
            engine: &engine,
            sampler: &settings.sampler,
            schedule: &schedule,
            guidance,
            consistency,
            form: settings.consistency_form,
            normalizer: &card.normalizer,
            window_frames: card.window_frames,
            overlap_frames: settings.overlap_frames,
        };
        progress.start("baselines", "windows", windows.len() as u64);
        let made: Mutex<Vec<Vec<BaselineMotion>>> = Mutex::new(vec![Vec::new(); windows.len()]);
        let mut queue = windows.iter().enumerate();
        pool::run(
            *threads,
            || queue.next(),
            |(i, window): (usize, &MusicWindow)| -> anyhow::Result<()> {
                let heard = window.clock.as_ref().filter(|_| !settings.no_clock);
                let heard = heard.map(|clock| clock.view());
                let heard = condition(card.group.condition(), window.features.view(), heard);
                let sample = |n_dancers: usize, number: usize| -> anyhow::Result<Array3<f32>> {
                    let (phrase, first) = (window.phrase_id.as_str(), window.first_frame);
                    let track = GroupTrack {
                        condition: heard.view(),
                        // A network without training, or without music, would get from the phase what it is asked to make.
                        phase: None,
                        seed: seed_of(BASELINE_SEED, phrase, first, number),
                        n_dancers,
                    };
                    let mut parts: Vec<Array3<f32>> = Vec::new();
                    generator.run(&track, |frames| -> Result<(), EngineError> {
                        parts.push(frames);
                        Ok(())
                    })?;
                    let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
                    concatenate(Axis(1), &views).context("while joining windows")
                };
                let decoded = match subject {
                    Subject::Independent => {
                        let soloists = (0..settings.n_dancers)
                            .map(|number| sample(1, number))
                            .collect::<anyhow::Result<Vec<_>>>()?;
                        let views: Vec<_> = soloists.iter().map(|one| one.view()).collect();
                        concatenate(Axis(0), &views).context("while joining soloists")?
                    }
                    _ => sample(settings.n_dancers, 0)?,
                };
                // Soloists are not moved apart: nobody told them of each other.
                let as_run = subject != Subject::Independent && settings.separation;
                let finishing = GroupSettings { separation: as_run, ..settings.clone() };
                let frames = finishing.finished(&decoded, window.phase.as_deref())?;
                let dancers = decoded.outer_iter().zip(frames.outer_iter());
                lock(&made)[i] = dancers
                    .map(|(decoded, frames)| BaselineMotion {
                        decoded: decoded.to_owned(),
                        frames: frames.to_owned(),
                    })
                    .collect();
                progress.advance(1);
                Ok(())
            },
        )?;
        progress.finish();
        let made = made.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        Ok(made.into_iter().flatten().collect())
    }
}
