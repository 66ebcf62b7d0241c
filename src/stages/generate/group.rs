//! Motion of groups: a model of the family `group`, its settings, and how its motions are made.

use std::num::NonZeroUsize;
use std::time::Instant;

use anyhow::{Context as _, bail, ensure};
use ndarray::{Array2, Array3, ArrayView2, Axis, concatenate};
use serde::{Deserialize, Serialize};

use super::dancers::score_of_dancers;
use super::identity::{RunIdentity, SampledMotion};
use super::maker::{GeneratedMotion, MotionMaker, seed_of};
use super::music::PhraseMusic;
use super::params::{Params, SamplingSettings};
use super::report::GenerateSummary;
use super::settings::OUTPUT_VERSION;
use super::{make_all, n_workers, name_of_model, run_name};
use crate::autodiff::Parameters;
use crate::diffusion::{SamplerConfig, Schedule};
use crate::generation::{
    ConsistencyForm, EngineError, FamilyCard as _, GroupCard, GroupEngine, GroupEstimator as _,
    GroupGenerator, GroupTrack, ModelFileName,
};
use crate::model::{GroupNetworks, Parameter};
use crate::motion::group::{MAX_DANCERS, RADIUS_M, SeparationError, separate};
use crate::motion::postprocess::{PostProcessConfig, process};
use crate::onnx::{Model, values_of};
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::model_folder::ModelFolder;
use crate::stages::pretrained::ShippedModel;
use crate::stages::{Progress, Summary};
use crate::store::Location;
use crate::store::tables::GenerationRow;

/// Dancers, unless the user says otherwise.
const DEFAULT_DANCERS: usize = 3;

/// Returns the model of the program for what was asked where none is named.
pub fn shipped_for(params: &Params) -> ShippedModel {
    let is_of_groups = params.dancers.is_some_and(|n| n != 1) || params.consistency.is_some();
    if is_of_groups { ShippedModel::Group } else { ShippedModel::Soloist }
}

/// Refuses what only groups know, for a model of one dancer.
///
/// # Errors
/// One sentence.
pub fn refuse_for_soloists(params: &Params, model: &str) -> anyhow::Result<()> {
    let is_group =
        "is of the family unet, which makes one dancer; name one of the family group with --model";
    if let Some(n) = params.dancers.filter(|&n| n != 1) {
        bail!("--dancers {n}: model {model} {is_group}, or leave --dancers out");
    }
    if let Some(gamma) = params.consistency {
        bail!("--consistency {gamma}: model {model} {is_group}, or leave --consistency out");
    }
    let of_gamma = [
        ("--consistency-form", params.consistency_form.is_some()),
        ("--consistency-scale", params.consistency_scale.is_some()),
    ];
    if let Some((flag, _)) = of_gamma.into_iter().find(|(_, is_given)| *is_given) {
        bail!("{flag}: model {model} {is_group}, or leave {flag} out");
    }
    Ok(())
}

/// The settings that determine a motion of a group beside its music and its sample: the column `settings` of
/// `generations`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(in crate::stages) struct GroupSettings {
    /// The version of what generate writes.
    pub output_version: u32,
    pub n_dancers: usize,
    /// γ: how alike dancers move.
    pub consistency: f64,
    /// What γ moves.
    pub consistency_form: ConsistencyForm,
    /// s, the factor of the gradient beside γ.
    pub consistency_scale: f64,
    pub sampler: SamplerConfig,
    /// 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// Frames that neighbouring windows share.
    pub overlap_frames: usize,
    pub postprocess: PostProcessConfig,
    /// Whether bodies are moved apart where they would touch.
    pub separation: bool,
    /// Whether the clock is withheld from a network that hears it.
    pub no_clock: bool,
}

impl GroupSettings {
    fn new(params: &Params, card: &GroupCard) -> anyhow::Result<Self> {
        let only_soloists = [
            ("--constraints", params.constraints.is_some()),
            ("--control", params.control.is_some()),
            ("--prime", params.prime.is_some()),
            ("--style", !params.style.is_empty()),
            ("--stream", params.stream.is_some()),
            ("--best-of", params.best_of.get() > 1),
        ];
        if let Some((flag, _)) = only_soloists.into_iter().find(|(_, is_given)| *is_given) {
            bail!(
                "{flag}: model {} is of the family group, which does not know it; leave it out, or name a model of \
                 the family unet",
                card.name
            );
        }
        let n_dancers = params.dancers.unwrap_or(DEFAULT_DANCERS);
        ensure!(
            (1..=MAX_DANCERS).contains(&n_dancers),
            "--dancers {n_dancers} is none of 1 to {MAX_DANCERS}; make larger groups of several"
        );
        let consistency = params.consistency.unwrap_or(0.0);
        ensure!(
            (-1.0..=1.0).contains(&consistency),
            "--consistency {consistency} is not from -1 to 1; give -1 for dancers who go each a way of their own, 1 \
             for unison"
        );
        let consistency_form =
            params.consistency_form.map(ConsistencyForm::from).unwrap_or_default();
        let consistency_scale = params.consistency_scale.unwrap_or(1.0);
        ensure!(
            consistency_scale.is_finite() && consistency_scale >= 0.0,
            "--consistency-scale {consistency_scale} is no factor; give a number from 0 up"
        );
        let SamplingSettings { sampler, guidance, overlap_frames } = params.sampling(card)?;
        Ok(Self {
            output_version: OUTPUT_VERSION,
            n_dancers,
            consistency,
            consistency_form,
            consistency_scale,
            sampler,
            guidance,
            overlap_frames,
            postprocess: params.postprocess.config((card.motion_range, card.fusion_variances()))?,
            separation: !params.no_separation && !params.postprocess.raw,
            no_clock: params.no_clock,
        })
    }

    /// Reads the settings of a row of `generations`; none of a model of another family, or of another release.
    pub fn of_text(text: &str) -> Option<Self> {
        serde_json::from_str(text).ok()
    }

    /// Returns γ times s.
    pub fn gamma(&self) -> f64 {
        self.consistency * self.consistency_scale
    }

    /// Returns what users get of a group as it was decoded, \[N, T, 25\]: each dancer post-processed, and bodies apart.
    ///
    /// # Errors
    /// Motion that is not finite.
    pub fn finished(
        &self,
        decoded: &Array3<f32>,
        bars: Option<&[f64]>,
    ) -> Result<Array3<f32>, SeparationError> {
        let mut frames = decoded.clone();
        for mut dancer in frames.outer_iter_mut() {
            let mut motion: Array2<f32> = dancer.to_owned();
            process(&self.postprocess, &mut motion, bars);
            dancer.assign(&motion);
        }
        if self.separation { separate(frames.view(), RADIUS_M) } else { Ok(frames) }
    }
}

/// Runs the stage with a model of groups.
///
/// # Errors
/// Settings that the model does not know, and what files or the store say.
pub fn run(
    params: &Params,
    store: Option<&Location>,
    files: ModelFolder,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let started = Instant::now();
    let card = GroupCard::read(files.card_bytes(), files.card_place())?;
    let settings = GroupSettings::new(params, &card)?;
    let name = name_of_model(params, &card.name);
    let run = run_name(params, &name)?;
    let (threads, n_workers) = (params.engine.threads, n_workers(params));
    let n_threads = NonZeroUsize::new(threads.get() / n_workers.get()).unwrap_or(NonZeroUsize::MIN);
    let parameters = parameters(&files, &card)?;
    let workers = (n_workers, n_threads);
    let engine = GroupEngine::new(&card.group, parameters, &card.feature_scale, workers)
        .context("while starting threads")?;
    let schedule = Schedule::new(&card.diffusion)?;
    let maker = GroupMaker {
        generator: GroupGenerator {
            engine: &engine,
            sampler: &settings.sampler,
            schedule: &schedule,
            guidance: settings.guidance,
            consistency: settings.gamma(),
            form: settings.consistency_form,
            normalizer: &card.normalizer,
            window_frames: card.window_frames,
            overlap_frames: settings.overlap_frames,
        },
        card: &card,
        identity: RunIdentity::new((&name, &card.weights_sha256, &run), params.seed, &settings),
        settings: &settings,
    };
    let (place, done) = make_all(params, store, &maker, engine.n_workers(), progress)?;
    let made_with = format!(
        "model {name} (family group), {} dancers, consistency {}, {} ({}), {} in {} steps, guidance {}",
        settings.n_dancers,
        settings.consistency,
        engine.name(),
        engine.n_workers(),
        settings.sampler.sampler.name(),
        settings.sampler.n_steps,
        settings.guidance
    );
    let (dry_run, took_s) = (params.dry_run, started.elapsed().as_secs_f64());
    Ok(Box::new(GenerateSummary { place, done, model: name, made_with, dry_run, took_s }))
}

/// Reads the weights of both networks of a model of groups.
///
/// # Errors
/// When a file is not the one that the card lists.
pub(in crate::stages) fn parameters(
    files: &ModelFolder,
    card: &GroupCard,
) -> anyhow::Result<Parameters<f32>> {
    let model = |name| -> anyhow::Result<(Model, String)> {
        let place = files.place_of(name);
        Ok((Model::read(files.read(name)?, None, &place)?, place))
    };
    let models = [model(ModelFileName::Denoiser)?, model(ModelFileName::Score)?];
    let (_, list) = GroupNetworks::new(&card.group);
    let values = |parameter: &Parameter| {
        let (is_denoiser, name) = GroupNetworks::own_name(&parameter.name);
        let own = Parameter { name: name.to_owned(), ..parameter.clone() };
        let (model, place) = &models[usize::from(!is_denoiser)];
        values_of(model, &own, place)
    };
    // Looked up first, since filling cannot fail.
    for (_, parameter) in list.iter() {
        values(parameter)?;
    }
    Ok(Parameters::from_fn(list, |parameter| values(parameter).expect("looked up before")))
}

/// Generates motions of groups.
struct GroupMaker<'a> {
    generator: GroupGenerator<'a>,
    card: &'a GroupCard,
    identity: RunIdentity,
    settings: &'a GroupSettings,
}

impl MotionMaker for GroupMaker<'_> {
    fn identity(&self) -> &RunIdentity {
        &self.identity
    }

    fn make(
        &self,
        music: &PhraseMusic,
        sample: usize,
        _watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<GeneratedMotion, Failure> {
        guarded(music.source, || self.sample(music, sample))
    }
}

impl GroupMaker<'_> {
    fn sample(&self, music: &PhraseMusic, sample: usize) -> Result<GeneratedMotion, Failure> {
        let started = Instant::now();
        let heard = music.heard_by(self.card.group.condition(), self.settings.no_clock);
        let bars = heard.bars();
        let seed = seed_of(self.identity.seed, music.phrase_id, sample, 0);
        let track = GroupTrack {
            condition: heard.condition.view(),
            phase: heard.clock_phase(),
            seed,
            n_dancers: self.settings.n_dancers,
        };
        let mut parts: Vec<Array3<f32>> = Vec::new();
        let emit = |frames| -> Result<(), EngineError> {
            parts.push(frames);
            Ok(())
        };
        self.generator
            .run(&track, emit)
            .map_err(|e| Failure::new(FailureKind::Engine, music.source, e))?;
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
        let decoded = concatenate(Axis(1), &views).expect("invariant: parts of one group");
        let frames = self
            .settings
            .finished(&decoded, bars)
            .map_err(|e| Failure::new(FailureKind::NonFinite, music.source, e))?;
        let seconds = started.elapsed().as_secs_f64();
        let row = self.row(music, sample, seed, (&frames, &decoded), bars, seconds);
        Ok(GeneratedMotion { frames, decoded, rows: vec![row], displacement: None, seconds })
    }

    fn row(
        &self,
        music: &PhraseMusic,
        sample: usize,
        seed: u64,
        (frames, decoded): (&Array3<f32>, &Array3<f32>),
        bars: Option<&[f64]>,
        generate_s: f64,
    ) -> GenerationRow {
        let settings = self.settings;
        let (n_dancers, n_frames, _) = frames.dim();
        let limits = settings.postprocess.limits;
        let (score, velocity_error) = score_of_dancers(frames, decoded, limits, bars);
        let made = SampledMotion {
            sample,
            candidate: 0,
            seed,
            engine: self.generator.engine.name(),
            sampler: &settings.sampler,
            guidance: settings.guidance,
            n_dancers,
            n_frames,
            n_windows: self.generator.windows(n_frames).len(),
            score: &score,
            velocity_error,
            generate_s,
        };
        let row = self.identity.row(music, &made);
        GenerationRow { consistency: Some(settings.consistency), ..row }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_guides_has_the_sign_of_the_consistency_that_was_asked_for() {
        let settings = |consistency| GroupSettings {
            output_version: OUTPUT_VERSION,
            n_dancers: 3,
            consistency,
            consistency_form: ConsistencyForm::default(),
            consistency_scale: 4.0,
            sampler: SamplerConfig::fast27(),
            guidance: 1.0,
            overlap_frames: 30,
            postprocess: PostProcessConfig::default(),
            separation: true,
            no_clock: false,
        };
        assert_eq!([-0.5, 0.0, 1.0].map(|x| settings(x).gamma()), [-2.0, 0.0, 4.0]);
    }
}
