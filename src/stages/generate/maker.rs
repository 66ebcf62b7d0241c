//! One phrase: its music becomes motions, of which the best are kept.

use std::time::Instant;

use ndarray::{Array2, Array3, ArrayView2, Axis, concatenate};

use super::constraints_text::text_of;
use super::identity::{RunIdentity, SampledMotion};
use super::music::{HeardMusic, PhraseMusic};
use super::params::Settings;
use crate::evaluation::{Score, derivative_error, score};
use crate::generation::{
    Constraints, EngineError, Generator, Miss, ModelCard, PrimingMotion, Track, WeightedConstraints,
};
use crate::motion::postprocess::{Displacement, process, process_holding};
use crate::motion::{Channel, MOTION_DIM};
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::retrieval::{Primer, Priming};
use crate::store::digest;
use crate::store::tables::GenerationRow;

/// A motion that was kept, and what is known of all its candidates.
#[derive(Debug)]
pub struct GeneratedMotion {
    /// Dancer by dancer, \[N, T, 25\].
    pub frames: Array3<f32>,
    /// The same motion as it was decoded, before post-processing, \[N, T, 25\].
    pub decoded: Array3<f32>,
    pub rows: Vec<GenerationRow>,
    /// How far fusion moved its poses, where they were fused.
    pub displacement: Option<Displacement>,
    pub seconds: f64,
}

impl GeneratedMotion {
    /// Returns the number of frames of each dancer.
    pub fn n_frames(&self) -> usize {
        self.frames.len_of(Axis(1))
    }
}

/// Makes motions of one model with some settings.
pub trait MotionMaker: Sync {
    /// What all its motions have in common.
    fn identity(&self) -> &RunIdentity;

    /// Makes one sample; `watch` sees the frames of its first candidate as they are final.
    ///
    /// # Errors
    /// A [`Failure`] that names the phrase's music.
    fn make(
        &self,
        music: &PhraseMusic,
        sample: usize,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<GeneratedMotion, Failure>;
}

/// Generates motions of one dancer: samples candidates, scores them, and keeps the best.
pub struct SoloistMaker<'a> {
    pub generator: Generator<'a>,
    pub card: &'a ModelCard,
    pub identity: RunIdentity,
    pub settings: &'a Settings,
    /// The library that sampling begins from.
    pub primer: Option<&'a Primer>,
}

/// Returns the name of a motion in tables.
pub fn generation_id(run: &str, phrase_id: &str, sample: usize) -> String {
    format!("{run}/{phrase_id}/{sample}")
}

/// Returns the seed of a candidate: it depends on nothing but what names it.
pub fn seed_of(seed: u64, phrase_id: &str, sample: usize, candidate: usize) -> u64 {
    let text = format!("{seed}\n{phrase_id}\n{sample}\n{candidate}");
    u64::from_str_radix(&digest(text.as_bytes())[..16], 16)
        .expect("a digest has hexadecimal digits")
}

impl MotionMaker for SoloistMaker<'_> {
    fn identity(&self) -> &RunIdentity {
        &self.identity
    }

    fn make(
        &self,
        music: &PhraseMusic,
        sample: usize,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<GeneratedMotion, Failure> {
        guarded(music.source, || self.candidates(music, sample, watch))
    }
}

impl SoloistMaker<'_> {
    fn candidates(
        &self,
        music: &PhraseMusic,
        sample: usize,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<GeneratedMotion, Failure> {
        let started = Instant::now();
        let n_frames = music.features.nrows();
        let constraints = self.constraints(music)?;
        let heard = music.heard_by(&self.card.unet, self.settings.no_clock);
        let bars = heard.bars();
        let priming = self.priming(music)?;
        let settings = self.settings;
        let is_kept = !settings.soft && !settings.uncontrolled;
        let kept = constraints.as_ref().filter(|_| is_kept);
        let held = kept.map(|constraints| constraints.held(n_frames)).unwrap_or_default();
        let mut best: Option<Candidate> = None;
        let mut rows = Vec::with_capacity(self.settings.best_of);
        for candidate in 0..self.settings.best_of {
            let begun = Instant::now();
            let seed = seed_of(self.settings.seed, music.phrase_id, sample, candidate);
            let mut unseen = |_: ArrayView2<f32>| Ok(());
            let watcher: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()> =
                if candidate == 0 { &mut *watch } else { &mut unseen };
            let decoded =
                self.sample(music, &heard, seed, constraints.as_ref(), priming.as_ref(), watcher)?;
            let velocity_error = derivative_error(
                decoded.view(),
                Channel::Position.columns(),
                Channel::Velocity.columns(),
            );
            let mut frames = decoded.clone();
            let postprocess = &self.settings.postprocess;
            let displacement = process_holding(postprocess, &mut frames, bars, &held);
            if let Some(constraints) = kept {
                // Smoothing and limits have moved it, by millimetres; what follows from poses follows again.
                constraints.bend(&mut frames, 0, 1.0);
                process(&postprocess.without_smoothing(), &mut frames, bars);
            }
            let score = score(
                frames.view(),
                self.settings.postprocess.limits,
                heard.phase.as_deref(),
                velocity_error,
            );
            let misses = constraints.as_ref().map(|c| c.errors(frames.view())).unwrap_or_default();
            let generate_s = begun.elapsed().as_secs_f64();
            let found = CandidateFindings {
                sample,
                candidate,
                seed,
                primed_by: priming.as_ref().map(|priming| priming.names.join(",")),
                score: &score,
                velocity_error,
                control: worst_misses(&misses),
                constraints: constraints.as_ref(),
                generate_s,
            };
            rows.push(self.row(music, n_frames, &found));
            // Among equal scores the first, so that one candidate more changes nothing else.
            let value = score.total.unwrap_or(f64::NEG_INFINITY);
            if best.as_ref().is_none_or(|known| value > known.value) {
                best = Some(Candidate { value, candidate, frames, decoded, displacement });
            }
        }
        let Candidate { candidate, frames, decoded, displacement, .. } =
            best.expect("at least one candidate is sampled");
        rows[candidate].selected = true;
        let seconds = started.elapsed().as_secs_f64();
        let [frames, decoded] = [frames, decoded].map(|motion| motion.insert_axis(Axis(0)));
        Ok(GeneratedMotion { frames, decoded, rows, displacement, seconds })
    }

    fn constraints(&self, music: &PhraseMusic) -> Result<Option<Constraints>, Failure> {
        let Some(asked) = &self.settings.constraints else { return Ok(None) };
        let limits = self.settings.postprocess.limits;
        match asked.of_track(music.features.nrows(), limits) {
            Ok(constraints) => Ok(Some(constraints)),
            Err(e) => Err(Failure::new(FailureKind::Constraint, music.source, e)),
        }
    }

    /// Returns the library's motion for a track, where sampling begins from it.
    fn priming(&self, music: &PhraseMusic) -> Result<Option<Priming>, Failure> {
        let Some(primer) = self.primer else { return Ok(None) };
        let windows = self.generator.windows(music.features.nrows());
        primer.motion_for(music.features, &windows).map(Some).ok_or_else(|| {
            let message = "a feature is not finite, so that no phrase of the library is nearest; extract \
                           it again";
            Failure::new(FailureKind::NonFinite, music.source, message)
        })
    }

    /// Samples and decodes a whole track, bent to its constraints.
    fn sample(
        &self,
        music: &PhraseMusic,
        heard: &HeardMusic,
        seed: u64,
        constraints: Option<&Constraints>,
        priming: Option<&Priming>,
        watch: &mut dyn FnMut(ArrayView2<f32>) -> std::io::Result<()>,
    ) -> Result<Array2<f32>, Failure> {
        let strength = self.settings.constraint_strength;
        let track = Track {
            condition: heard.condition.view(),
            phase: heard.clock_phase(),
            seed,
            style: self.settings.style,
            constraints: constraints
                .filter(|_| !self.settings.uncontrolled)
                .map(|constraints| WeightedConstraints { constraints, strength }),
            primed: priming.zip(self.settings.prime.as_ref()).map(|(priming, prime)| {
                PrimingMotion { motion: priming.motion.view(), n_left: prime.n_left }
            }),
        };
        let mut parts: Vec<Array2<f32>> = Vec::new();
        self.generator
            .run(&track, |frames| -> Result<(), StopReason> {
                watch(frames.view()).map_err(StopReason::Watcher)?;
                parts.push(frames);
                Ok(())
            })
            .map_err(|stop| stop.of(music.source))?;
        let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
        let mut frames =
            concatenate(Axis(0), &views).unwrap_or_else(|_| Array2::zeros((0, MOTION_DIM)));
        let is_kept = !self.settings.soft && !self.settings.uncontrolled;
        if let Some(constraints) = constraints.filter(|_| is_kept) {
            constraints.bend(&mut frames, 0, 1.0);
        }
        Ok(frames)
    }

    fn row(
        &self,
        music: &PhraseMusic,
        n_frames: usize,
        found: &CandidateFindings,
    ) -> GenerationRow {
        let made = SampledMotion {
            sample: found.sample,
            candidate: found.candidate,
            seed: found.seed,
            engine: self.generator.engine.name(),
            sampler: &self.settings.sampler,
            guidance: self.settings.guidance,
            n_dancers: 1,
            n_frames,
            n_windows: self.generator.windows(n_frames).len(),
            score: found.score,
            velocity_error: found.velocity_error,
            generate_s: found.generate_s,
        };
        GenerationRow {
            selected: false,
            primed_by: found.primed_by.clone(),
            control_error_mm: found.control[0],
            control_error_deg: found.control[1],
            constraints: found.constraints.map(text_of),
            ..self.identity.row(music, &made)
        }
    }
}

/// Returns the largest misses of positions, mm, and of orientations, degrees, where such are asked for.
pub fn worst_misses(misses: &[Miss]) -> [Option<f64>; 2] {
    [(Channel::Position, 1e3), (Channel::Quaternion, 1.0_f64.to_degrees())].map(
        |(group, factor)| {
            let of_group = misses.iter().filter(|miss| miss.what.starts_with(group.name()));
            of_group.map(|miss| miss.error * factor).reduce(f64::max)
        },
    )
}

/// The best candidate so far.
struct Candidate {
    value: f64,
    candidate: usize,
    frames: Array2<f32>,
    decoded: Array2<f32>,
    displacement: Option<Displacement>,
}

/// The score and errors of a candidate.
struct CandidateFindings<'a> {
    sample: usize,
    candidate: usize,
    seed: u64,
    primed_by: Option<String>,
    score: &'a Score,
    velocity_error: f64,
    /// Largest misses: mm, degrees.
    control: [Option<f64>; 2],
    constraints: Option<&'a Constraints>,
    generate_s: f64,
}

/// Why sampling stopped.
pub enum StopReason {
    Engine(EngineError),
    Watcher(std::io::Error),
}

impl StopReason {
    /// Returns the failure of the music that was danced to.
    pub fn of(self, source: &str) -> Failure {
        match self {
            Self::Engine(e) => Failure::new(FailureKind::Engine, source, e),
            Self::Watcher(e) => Failure::new(
                FailureKind::Unwritable,
                source,
                format!("frames could not be streamed: {e}"),
            ),
        }
    }
}

impl From<EngineError> for StopReason {
    fn from(e: EngineError) -> Self {
        Self::Engine(e)
    }
}
