//! Motion by tokens: a model of the family `tokens`, its settings, and how its motions are made.

use std::time::Instant;

use anyhow::{bail, ensure};
use ndarray::{Array2, Array3, ArrayView2, Axis, concatenate, stack};
use serde::{Deserialize, Serialize};

use super::constraints_file::ConstraintsRequest;
use super::constraints_text::text_of;
use super::dancers::score_of_dancers;
use super::identity::{RunIdentity, SampledMotion};
use super::maker::{GeneratedMotion, MotionMaker, StopReason, seed_of, worst_misses};
use super::music::PhraseMusic;
use super::params::{Params, SamplingSettings, style};
use super::report::GenerateSummary;
use super::settings::OUTPUT_VERSION;
use super::{
    engine_params, make_all, n_workers, name_of_model, run_name, weights_digest_of_tokens,
};
use crate::diffusion::{SamplerConfig, Schedule, TokenSampling};
use crate::generation::{
    Constraints, Control, FamilyCard as _, Steering, TokenGenerator, TokenTrack, TokensCard,
    WeightedConstraints, kept_of, steer,
};
use crate::motion::choreography::group::side_by_side;
use crate::motion::group::{MAX_DANCERS, RADIUS_M, separate};
use crate::motion::postprocess::{
    Displacement, HeldPoses, PostProcessConfig, process, process_holding,
};
use crate::motion::style::STYLE_DIM;
use crate::motion::{MOTION_DIM, Placement};
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::model_files::ModelFolder;
use crate::stages::tokens_model::{OpenTokens, TokenEngines};
use crate::stages::{Progress, Summary};
use crate::store::tables::GenerationRow;
use crate::store::{Location, digest};

/// The settings that determine a motion beside its music and its sample: the column `settings` of `generations`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensSettings {
    /// The version of what generate writes.
    pub output_version: u32,
    /// How tokens are drawn.
    pub plan: TokenSampling,
    /// How motion is made of them.
    pub sampler: SamplerConfig,
    /// Of the plan: 1 follows the music, more exaggerates it, 0 ignores it.
    pub guidance: f64,
    /// Style in the model's units.
    pub style: Option<[f32; STYLE_DIM]>,
    /// Frames of a window, where it is shorter than the model's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub window_frames: Option<usize>,
    /// Tokens that neighbouring windows share.
    pub overlap_tokens: usize,
    pub postprocess: PostProcessConfig,
    /// Digest of the constraints.
    pub constraints: Option<String>,
    /// Length of the steps by which the decoder is steered to constraints.
    pub constraint_strength: f64,
    /// Whether the rest of the way to constraints is left.
    pub soft: bool,
    /// Whether the clock is withheld from a network that hears it.
    pub no_clock: bool,
    /// Where constraints act; none where there are none.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub control: Option<Control>,
    /// Of several dancers, how they belong together.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub group: Option<TokensGroup>,
}

/// How several dancers belong together whose motion is made of tokens.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TokensGroup {
    pub n_dancers: usize,
    /// Share of the first dancer's tokens that the others keep, in [0, 1].
    pub consistency: f64,
    /// Whether bodies are moved apart where they would touch.
    pub separation: bool,
}

impl TokensGroup {
    /// Returns what is asked for; none for one dancer.
    fn asked(params: &Params, model: &str) -> anyhow::Result<Option<Self>> {
        let n_dancers = params.dancers.unwrap_or(1);
        ensure!(
            (1..=MAX_DANCERS).contains(&n_dancers),
            "--dancers {n_dancers} is none of 1 to {MAX_DANCERS}; make larger groups of several"
        );
        if n_dancers == 1 {
            if let Some(share) = params.consistency {
                bail!(
                    "--consistency {share}: one dancer of model {model}, of the family tokens, has nobody to share a plan \
                     with; give --dancers 2 or more, or leave it out"
                );
            }
            return Ok(None);
        }
        let consistency = params.consistency.unwrap_or(0.0);
        ensure!(
            (0.0..=1.0).contains(&consistency),
            "--consistency {consistency}: dancers of model {model}, of the family tokens, share from none, 0, to all, 1, of a \
             plan; give a number from 0 to 1, or name a model of the family group"
        );
        if params.stream.is_some() {
            bail!(
                "--stream: frames of {n_dancers} dancers are not final before all have been made; leave it out, or give \
                 --dancers 1"
            );
        }
        let separation = !params.no_separation && !params.postprocess.raw;
        Ok(Some(Self { n_dancers, consistency, separation }))
    }
}

impl TokensSettings {
    fn new(
        params: &Params,
        card: &TokensCard,
        constraints: Option<&ConstraintsRequest>,
    ) -> anyhow::Result<Self> {
        let only_others = [
            ("--prime", params.prime.is_some(), "unet"),
            ("--best-of", params.best_of.get() > 1, "unet"),
            ("--consistency-form", params.consistency_form.is_some(), "group"),
            ("--consistency-scale", params.consistency_scale.is_some(), "group"),
        ];
        if let Some((flag, _, family)) = only_others.into_iter().find(|(_, is_given, _)| *is_given)
        {
            bail!(
                "{flag}: model {} is of the family tokens, which does not know it; leave it out, or name a model of \
                 the family {family}",
                card.name
            );
        }
        let SamplingSettings { sampler, guidance, overlap_frames } = params.sampling(card)?;
        // Unless steps are asked for, motion is made as in the paper.
        let sampler = if params.steps.is_none() { SamplerConfig::fast27() } else { sampler };
        sampler.check(Schedule::new(&card.diffusion)?.len())?;
        let rho = card.tokens.frames_per_token;
        if let Some(n) = params.window {
            let most = card.window_frames;
            ensure!(
                n > overlap_frames && n > rho && n <= most && n.is_multiple_of(rho),
                "--window {n} does not do for model {}: give a multiple of the {rho} frames of a token, up to the {most} \
                 of training and more than the {overlap_frames} of --overlap",
                card.name
            );
        }
        let plan = TokenSampling {
            n_iterations: params.plan_iterations,
            temperature: params.plan_temperature,
            top_share: params.plan_top,
            ..TokenSampling::default()
        };
        plan.check()?;
        let knows_constraints = card.planner.constraint_dim > 0;
        let usual = if knows_constraints { Control::Both } else { Control::Decode };
        let control = params.control.unwrap_or(usual);
        ensure!(
            knows_constraints || !control.plans(),
            "--control {}: the planner of model {} knows nothing of constraints; give decode or none, or train a planner \
             without --no-constraints",
            control.name(),
            card.name
        );
        Ok(Self {
            output_version: OUTPUT_VERSION,
            plan,
            sampler,
            guidance,
            style: style(
                &params.style,
                (&card.name, card.planner.style_dim > 0, &card.styles),
                &card.normalizer,
            )?,
            window_frames: params.window.filter(|&n| n < card.window_frames),
            // A window goes on from one token at least.
            overlap_tokens: (overlap_frames / rho).max(1),
            postprocess: params.postprocess.config((card.motion_range, card.fusion_variances()))?,
            constraints: constraints.map(|asked| digest(format!("{asked:?}").as_bytes())),
            constraint_strength: params.checked_constraint_strength()?,
            soft: params.soft,
            no_clock: params.no_clock,
            control: constraints.is_some().then_some(control),
            group: TokensGroup::asked(params, &card.name)?,
        })
    }
}

/// Runs the stage with a model of tokens.
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
    let opened = OpenTokens::of(files)?;
    let card = &opened.card;
    let constraints = params.constraints_asked()?;
    let settings = TokensSettings::new(params, card, constraints.as_ref())?;
    let name = name_of_model(params, &card.name);
    let run = run_name(params, &name)?;
    let TokenEngines { tokens, planner, note } =
        opened.engines(&engine_params(params), n_workers(params))?;
    if let Some(note) = note {
        progress.note(&note);
    }
    let tokens = match settings.window_frames {
        Some(window_frames) => tokens.with_window(window_frames),
        None => tokens,
    };
    let schedule = Schedule::new(&card.diffusion)?;
    let maker = TokensMaker {
        generator: TokenGenerator {
            tokens: &tokens,
            planner: &planner,
            plan: &settings.plan,
            sampler: &settings.sampler,
            schedule: &schedule,
            guidance: settings.guidance,
            overlap_tokens: settings.overlap_tokens,
        },
        card,
        identity: RunIdentity::new(
            (&name, &weights_digest_of_tokens(card), &run),
            params.seed,
            &settings,
        ),
        settings: &settings,
        constraints: constraints.as_ref(),
    };
    let (place, done) = make_all(params, store, &maker, tokens.n_workers(), progress)?;
    let made_with = format!(
        "model {name} (family tokens, {}){}, {} ({}), plans in {} iterations, {} in {} steps, guidance {}",
        card.planner.kind.name(),
        settings.group.map_or(String::new(), |group| format!(
            ", {} dancers, consistency {}",
            group.n_dancers, group.consistency
        )),
        tokens.name(),
        tokens.n_workers(),
        settings.plan.n_iterations,
        settings.sampler.sampler.name(),
        settings.sampler.n_steps,
        settings.guidance
    );
    let (dry_run, took_s) = (params.dry_run, started.elapsed().as_secs_f64());
    Ok(Box::new(GenerateSummary { place, done, model: name, made_with, dry_run, took_s }))
}

/// A dancer as it was decoded.
struct Dancer {
    /// Tokens of every window.
    plans: Vec<Vec<u32>>,
    decoded: Array2<f32>,
    /// What is asked of this dancer.
    constraints: Option<Constraints>,
}

/// Dancers as users get them.
struct FinishedDancers {
    /// \[N, T, 25\]
    frames: Array3<f32>,
    /// As they were decoded, \[N, T, 25\].
    decoded: Array3<f32>,
    /// How far fusion moved the poses of a soloist.
    displacement: Option<Displacement>,
}

/// Generates motions by tokens.
struct TokensMaker<'a> {
    generator: TokenGenerator<'a>,
    card: &'a TokensCard,
    identity: RunIdentity,
    settings: &'a TokensSettings,
    constraints: Option<&'a ConstraintsRequest>,
}

impl MotionMaker for TokensMaker<'_> {
    fn identity(&self) -> &RunIdentity {
        &self.identity
    }

    fn make(
        &self,
        music: &PhraseMusic,
        sample: usize,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<GeneratedMotion, Failure> {
        guarded(music.source, || self.sample(music, sample, watch))
    }
}

impl TokensMaker<'_> {
    fn sample(
        &self,
        music: &PhraseMusic,
        sample: usize,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<GeneratedMotion, Failure> {
        let started = Instant::now();
        let heard = music.heard_by(self.card.planner.condition(), self.settings.no_clock);
        let bars = heard.bars();
        let n_frames = music.features.nrows();
        let (limits, strength) =
            (self.settings.postprocess.limits, self.settings.constraint_strength);
        let constraints = match self.constraints.map(|asked| asked.of_track(n_frames, limits)) {
            Some(Err(e)) => return Err(Failure::new(FailureKind::Constraint, music.source, e)),
            Some(Ok(constraints)) => Some(constraints),
            None => None,
        };
        let group = self.settings.group;
        let seed = |dancer| seed_of(self.identity.seed, music.phrase_id, sample, dancer);
        let places = group
            .map_or(vec![Placement::default()], |group| side_by_side(group.n_dancers, seed(0)));
        let mut dancers: Vec<Dancer> = Vec::with_capacity(places.len());
        for (i, &place) in places.iter().enumerate() {
            // Every dancer's way is the one that is asked for, as far beside it as it begins beside the others.
            let own = constraints.as_ref().map(|constraints| match group {
                Some(_) => constraints.moved([place.x_m, place.z_m], n_frames, limits),
                None => Ok(constraints.clone()),
            });
            let refuse = |e| Failure::new(FailureKind::Constraint, music.source, e);
            let constraints: Option<Constraints> = own.transpose().map_err(refuse)?;
            let kept = match (group, dancers.first()) {
                (Some(group), Some(first)) => kept_of(&first.plans, group.consistency, seed(i)),
                _ => Vec::new(),
            };
            let weighted = |constraints| WeightedConstraints { constraints, strength };
            let track = TokenTrack {
                phase: heard.clock_phase(),
                style: self.settings.style,
                constraints: constraints.as_ref().map(weighted),
                control: self.settings.control.unwrap_or(Control::None),
                place,
                kept: &kept,
                ..TokenTrack::new(heard.condition.view(), seed(i))
            };
            let (plans, decoded) = self.decoded(&track, music.source, watch)?;
            dancers.push(Dancer { plans, decoded, constraints });
        }
        let FinishedDancers { frames, decoded, displacement } =
            self.finished(&dancers, music.source, bars)?;
        let asked = dancers.iter().map(|dancer| dancer.constraints.as_ref());
        let misses: Vec<_> = asked
            .zip(frames.outer_iter())
            .flat_map(|(asked, frames)| asked.map(|c| c.errors(frames)).unwrap_or_default())
            .collect();
        let seconds = started.elapsed().as_secs_f64();
        let phase = heard.phase.as_deref();
        let mut row = self.row(music, (sample, seed(0)), (&frames, &decoded), phase, seconds);
        [row.control_error_mm, row.control_error_deg] = worst_misses(&misses);
        row.constraints = constraints.as_ref().map(text_of);
        row.consistency = group.map(|group| group.consistency);
        Ok(GeneratedMotion { frames, decoded, rows: vec![row], displacement, seconds })
    }

    /// Plans and decodes a dancer; returns the plans of its windows, and its motion.
    fn decoded(
        &self,
        track: &TokenTrack,
        source: &str,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<(Vec<Vec<u32>>, Array2<f32>), Failure> {
        let mut parts: Vec<Array2<f32>> = Vec::new();
        let emit = |frames: Array2<f32>| -> Result<(), StopReason> {
            watch(frames.view()).map_err(StopReason::Watcher)?;
            parts.push(frames);
            Ok(())
        };
        let plans = self.generator.run(track, emit).map_err(|stop| stop.of(source))?;
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
        let decoded =
            concatenate(Axis(0), &views).unwrap_or_else(|_| Array2::zeros((0, MOTION_DIM)));
        Ok((plans, decoded))
    }

    /// Finishes dancers: each is post-processed, bodies are moved apart, and then constraints are met.
    fn finished(
        &self,
        dancers: &[Dancer],
        source: &str,
        bars: Option<&[f64]>,
    ) -> Result<FinishedDancers, Failure> {
        let TokensSettings { postprocess, group, soft, .. } = self.settings;
        let views: Vec<_> = dancers.iter().map(|dancer| dancer.decoded.view()).collect();
        let decoded =
            stack(Axis(0), &views).expect("invariant: every dancer has the frames of the music");
        let (mut frames, mut displacement) = (decoded.clone(), None);
        for mut dancer in frames.outer_iter_mut() {
            let mut motion = dancer.to_owned();
            let moved = process_holding(postprocess, &mut motion, bars, &HeldPoses::default());
            displacement = moved.filter(|_| group.is_none());
            dancer.assign(&motion);
        }
        if group.is_some_and(|group| group.separation) {
            frames = separate(frames.view(), RADIUS_M)
                .map_err(|e| Failure::new(FailureKind::NonFinite, source, e))?;
        }
        let is_kept = self.settings.control.is_some_and(Control::decodes) && !soft;
        let asked = dancers.iter().map(|dancer| dancer.constraints.as_ref());
        for (mut dancer, asked) in frames.outer_iter_mut().zip(asked) {
            if let Some(constraints) = asked.filter(|_| is_kept) {
                // After smoothing, so that the correction is smooth, too; velocities then follow from the poses again.
                let mut motion = dancer.to_owned();
                steer(constraints, &mut motion, 0, Steering::Finish);
                process(&postprocess.without_smoothing(), &mut motion, bars);
                dancer.assign(&motion);
            }
        }
        Ok(FinishedDancers { frames, decoded, displacement })
    }

    fn row(
        &self,
        music: &PhraseMusic,
        (sample, seed): (usize, u64),
        (frames, decoded): (&Array3<f32>, &Array3<f32>),
        phase: Option<&[f64]>,
        generate_s: f64,
    ) -> GenerationRow {
        let settings = self.settings;
        let (n_dancers, n_frames, _) = frames.dim();
        let limits = settings.postprocess.limits;
        let (score, velocity_error) = score_of_dancers(frames, decoded, limits, phase);
        let made = SampledMotion {
            sample,
            candidate: 0,
            seed,
            engine: self.generator.tokens.name(),
            sampler: &settings.sampler,
            guidance: settings.guidance,
            n_dancers,
            n_frames,
            n_windows: self.generator.n_windows(n_frames),
            score: &score,
            velocity_error,
            generate_s,
        };
        self.identity.row(music, &made)
    }
}
