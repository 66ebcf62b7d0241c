//! The work: motions become windows, windows become numbers, and numbers verdicts.

use std::collections::BTreeMap;
use std::sync::Arc;

use ndarray::Array2;

use super::group::GroupFindings;
use super::measure::{MeasuredMotion, Measurer, kept_frames, stride_for};
use super::motions::{PhraseIndex, is_held_out};
use super::params::Params;
use super::splits::{ALL, MusicSplit, SPLITS};
use super::subjects::{Finding, MeasureSettings, MeasuredWindow, Subject, channels};
use super::truth::{Truth, TruthPhrase};
use crate::evaluation::coupling::{Coupling, Harmonics, Template, consistency_p};
use crate::evaluation::keyframe::{Keyframe, KeyframeMisses};
use crate::evaluation::metrics::{
    MotionWindow, Number, PhaseOrigin, control_numbers, coupling_ratio, keyframe_numbers,
    motion_ratios, song_harmonics, whole_numbers,
};
use crate::evaluation::verdict::{Evidence, Verdict, verdicts};
use crate::evaluation::window::window_starts;
use crate::stages::Progress;
use crate::store::{StoreError, StoreSnapshot};

/// Windows of real motion that are measured beside what was generated, evenly among all.
const MAX_TRUTH_WINDOWS: usize = 4000;
/// A coupling that training motion shows with a lower probability by chance is taken for one.
const COUPLING_P: f64 = 0.01;
/// Seed of that test.
const COUPLING_SEED: u64 = 2026;

/// Stages of the making of a motion at which it is checked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotionStage {
    /// As it was decoded.
    Raw,
    /// After post-processing.
    Final,
}

impl MotionStage {
    /// Returns the name of the stage in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Raw => "raw",
            Self::Final => "final",
        }
    }
}

/// A motion that is evaluated, of a soloist or of a dancer of a group; dancers of a group stand side by side.
#[derive(Clone, Debug)]
pub struct EvaluationMotion {
    pub phrase_id: String,
    pub sample: i32,
    /// Place of the generation, or of the file, that it is of.
    pub item: usize,
    /// Number of the dancer, 0 of a soloist.
    pub dancer: usize,
    pub split: MusicSplit,
    /// Largest misses of its constraints: mm and degrees.
    pub misses: [Option<f64>; 2],
    /// What it was asked to do; empty where nothing was asked or nobody wrote it down.
    pub keyframes: Vec<Keyframe>,
}

/// A motion, measured as it is and, where that is known, as it was decoded.
pub struct EvaluatedMotion {
    pub is: MeasuredMotion,
    pub decoded: Option<MeasuredMotion>,
    pub keyframes: KeyframeMisses,
}

/// Motion that was sampled as a baseline: one window each, and the place of its music.
pub struct SampledWindow {
    pub subject: Subject,
    pub phrase_id: String,
    pub first_frame: usize,
    /// \[T, 25\]
    pub frames: Array2<f32>,
}

/// The numbers and verdicts of an evaluation.
pub struct EvaluationFindings {
    pub findings: Vec<Finding>,
    pub verdicts: Vec<(MusicSplit, Verdict)>,
}

/// The inputs of an evaluation: motions, and what they are compared with.
pub struct EvaluationJob<'a> {
    pub params: &'a Params,
    pub snapshot: &'a StoreSnapshot,
    pub motions: &'a [EvaluationMotion],
    pub phrases: &'a PhraseIndex,
    pub truth: Option<&'a Truth>,
    /// Frames of a window: as many for all that is compared.
    pub window_frames: usize,
    pub phase: PhaseOrigin,
    /// Whether motions were decoded by this program.
    pub has_raw: bool,
    /// Whether there is a network whose first weights are a baseline.
    pub has_network: bool,
    /// Split of the windows that were sampled.
    pub sampled_split: Option<MusicSplit>,
    /// What was measured of groups; none of soloists.
    pub groups: Option<&'a GroupFindings>,
}

impl EvaluationJob<'_> {
    /// Makes numbers and verdicts of motions that were measured.
    ///
    /// # Errors
    /// [`StoreError`] when features cannot be read.
    pub fn numbers(
        &self,
        evaluated: &[EvaluatedMotion],
        sampled: &[SampledWindow],
        progress: &dyn Progress,
    ) -> Result<EvaluationFindings, StoreError> {
        let measurer = self.measurer(1);
        let generated = self.generated(evaluated);
        progress.say("measuring what it is compared with");
        let (training, held_out) = self.real_motion();
        let coupling = self.coupling(&training);
        let retrieved = self.retrieved(&measurer, &generated)?;
        let constant = self.mean_motion(&measurer, &generated);
        let sampled = self.sampled(&measurer, sampled);
        let training_kept = kept_frames(training.iter().map(|(_, kept)| kept));
        let held_out_items: Vec<&MeasuredWindow> = held_out.iter().map(|(item, _)| item).collect();
        let meter = |n_own: usize| MeasureSettings {
            reference: self.truth.map(|truth| &truth.statistics),
            coupling: coupling.as_ref(),
            n_frechet: match held_out_items.len() {
                0 => n_own,
                n => n.min(n_own),
            },
            threads: self.params.threads,
        };
        let (real, own) = (PhaseOrigin::Own, self.phase);
        let mut findings = Vec::new();
        let mut all_verdicts = Vec::new();
        let largest = SPLITS
            .iter()
            .map(|split| generated.iter().filter(|(item, _)| item.split == *split).count())
            .max()
            .unwrap_or(0);
        let truth_name = MusicSplit::HeldOut.name();
        let truth = meter(largest).numbers(truth_name, &held_out_items, real);
        let mut truth_numbers = truth.clone();
        truth_numbers.extend(channels(held_out.iter().map(|(_, kept)| kept), &training_kept));
        if !held_out_items.is_empty() {
            let (subject, split) = (Subject::HeldOutTruth, truth_name);
            findings.push(Finding { subject, split, numbers: truth_numbers });
        }
        if !training.is_empty() {
            let items: Vec<&MeasuredWindow> = training.iter().map(|(item, _)| item).collect();
            // Distances from itself say nothing.
            let mut numbers = meter(items.len()).numbers(ALL, &items, real);
            numbers.retain(|number| !DISTANCES.contains(&number.metric));
            findings.push(Finding { subject: Subject::TrainingTruth, split: ALL, numbers });
        }
        let splits: Vec<MusicSplit> = SPLITS
            .into_iter()
            .filter(|split| generated.iter().any(|(item, _)| item.split == *split))
            .collect();
        progress.say("measuring what was generated");
        if splits.len() > 1 {
            let items: Vec<&MeasuredWindow> = generated.iter().map(|(item, _)| item).collect();
            let mut numbers = meter(items.len()).numbers(ALL, &items, own);
            numbers.extend(meter(0).decoded(&items, self.raw_phase()));
            numbers.extend(self.control(evaluated, None));
            findings.push(Finding { subject: Subject::Generated, split: ALL, numbers });
        }
        for split in splits {
            let chosen: Vec<&(MeasuredWindow, Array2<f32>)> =
                generated.iter().filter(|(item, _)| item.split == split).collect();
            let items: Vec<&MeasuredWindow> = chosen.iter().map(|(item, _)| item).collect();
            let meter = meter(items.len());
            let name = split.name();
            let mut numbers = meter.numbers(name, &items, own);
            numbers.extend(meter.decoded(&items, self.raw_phase()));
            numbers.extend(whole_numbers(&self.whole(evaluated, split)));
            numbers.extend(motion_ratios(&numbers, &truth));
            numbers.extend(coupling_ratio(&numbers, &truth));
            numbers.extend(channels(chosen.iter().map(|(_, kept)| kept), &training_kept));
            numbers.extend(self.control(evaluated, Some(split)));
            let shuffled = meter.shuffled(&items);
            let shifted = meter.shifted(&items);
            let items_in_split = |items: &'_ [MeasuredWindow]| -> Vec<MeasuredWindow> {
                items.iter().filter(|item| item.split == split).cloned().collect()
            };
            let baseline = |subject: Subject, items: &[MeasuredWindow]| -> Finding {
                let items = items_in_split(items);
                let items: Vec<&MeasuredWindow> = items.iter().collect();
                let numbers = match items.is_empty() {
                    true => Vec::new(),
                    false => meter.numbers(name, &items, real),
                };
                Finding { subject, split: name, numbers }
            };
            let untrained = baseline(Subject::Untrained, &sampled.untrained);
            let group = self.groups.map(|groups| groups.of_split(split));
            let evidence = Evidence {
                own: &numbers,
                shuffled: &shuffled,
                shifted: &shifted,
                untrained: &untrained.numbers,
                truth: &truth,
                has_raw: self.has_raw,
                has_network: self.has_network && self.sampled_split == Some(split),
                group: group.as_ref().map(|group| group.evidence()),
            };
            let told = verdicts(&evidence);
            all_verdicts.extend(told.into_iter().map(|verdict| (split, verdict)));
            let finding = |subject, numbers| Finding { subject, split: name, numbers };
            findings.extend([
                finding(Subject::Generated, numbers),
                finding(Subject::Shuffled, shuffled),
                finding(Subject::Shifted, shifted),
                untrained,
                baseline(Subject::NoMusic, &sampled.no_music),
                baseline(Subject::ShuffledPlan, &sampled.shuffled_plan),
                baseline(Subject::Retrieval, &retrieved),
                baseline(Subject::MeanMotion, &constant),
            ]);
        }
        findings.extend(self.groups.into_iter().flat_map(GroupFindings::findings));
        findings.retain(|finding| !finding.numbers.is_empty());
        Ok(EvaluationFindings { findings, verdicts: all_verdicts })
    }

    /// Returns the songs of a split's motions, whether each is finite, and whether it is without seams.
    fn whole(&self, evaluated: &[EvaluatedMotion], split: MusicSplit) -> Vec<(usize, bool, bool)> {
        let motions = self.motions.iter().zip(evaluated);
        motions
            .filter(|(motion, _)| motion.split == split)
            .map(|(motion, found)| {
                (self.phrases.song(&motion.phrase_id), found.is.is_finite, found.is.is_seamless)
            })
            .collect()
    }

    /// Returns what measures motions of which one frame in `stride` is kept.
    pub fn measurer(&self, stride: usize) -> Measurer<'_> {
        Measurer {
            limits: self.params.limits,
            reference: self.truth.map(|truth| &truth.statistics),
            window_frames: self.window_frames,
            num_frames: self.params.num_frames.map(Into::into),
            stride,
            threads: self.params.threads,
        }
    }

    fn raw_phase(&self) -> PhaseOrigin {
        if self.has_raw { PhaseOrigin::Own } else { self.phase }
    }

    /// Returns the windows of the motions with their music, and the frames that are kept of each motion with its first.
    fn generated(&self, evaluated: &[EvaluatedMotion]) -> Vec<(MeasuredWindow, Array2<f32>)> {
        let mut number_of: BTreeMap<&str, usize> = BTreeMap::new();
        let mut music_of: BTreeMap<&str, Option<Arc<_>>> = BTreeMap::new();
        let mut items = Vec::new();
        for (motion, found) in self.motions.iter().zip(evaluated) {
            let id = motion.phrase_id.as_str();
            let n = number_of.len();
            let phrase = *number_of.entry(id).or_insert(n);
            let music = music_of
                .entry(id)
                .or_insert_with(|| self.phrases.music(id, found.is.n_frames).map(Arc::new))
                .clone();
            // Two motions for a phrase may differ in length: music reaches as far as the longer one.
            let music = match music {
                Some(known) if known.bars.len() < found.is.n_frames => {
                    let longer = self.phrases.music(id, found.is.n_frames).map(Arc::new);
                    music_of.insert(id, longer.clone());
                    longer
                }
                music => music,
            };
            let firsts = window_starts(found.is.n_frames, self.window_frames);
            for (i, (first_frame, window)) in firsts.zip(&found.is.windows).enumerate() {
                let decoded = found.decoded.as_ref().and_then(|decoded| decoded.windows.get(i));
                let item = MeasuredWindow {
                    song: self.phrases.song(id),
                    phrase,
                    first_frame,
                    split: motion.split,
                    measured: Arc::new(window.clone()),
                    decoded: decoded.cloned().map(Arc::new),
                    music: music.clone(),
                };
                let kept = match i {
                    0 => found.is.kept.clone(),
                    _ => Array2::zeros((0, crate::motion::MOTION_DIM)),
                };
                items.push((item, kept));
            }
        }
        items
    }

    /// Returns windows of the training split's and of held-out real motion, with the frames that are kept of them.
    fn real_motion(&self) -> (Measurements, Measurements) {
        let Some(truth) = self.truth else { return (Vec::new(), Vec::new()) };
        let measure = |phrases: Vec<(usize, &TruthPhrase)>| -> Measurements {
            let n = phrases.len();
            let chosen: Vec<(usize, &TruthPhrase)> = (0..n.min(MAX_TRUTH_WINDOWS))
                .map(|i| phrases[i * n / n.min(MAX_TRUTH_WINDOWS)])
                .collect();
            let n_frames = chosen.iter().map(|(_, phrase)| phrase.motion.nrows()).sum();
            let measurer = self.measurer(stride_for(n_frames));
            let feed = |give: &mut dyn FnMut(usize, Array2<f32>)| {
                for (i, (_, phrase)) in chosen.iter().enumerate() {
                    give(i, phrase.motion.clone());
                }
                Ok::<_, std::convert::Infallible>(())
            };
            let Ok(found) = measurer.run(chosen.len(), feed);
            let length = measurer.window_frames;
            let mut items = Vec::new();
            // Takes of one place of a song are motions for one phrase.
            let mut places: BTreeMap<(usize, u64), usize> = BTreeMap::new();
            for ((_, phrase), measured) in chosen.iter().zip(found) {
                let Some(measured) = measured else { continue };
                let n = places.len();
                let place = *places.entry(self.phrases.place(&phrase.id)).or_insert(n);
                let phase: Vec<f64> = phrase
                    .motion
                    .column(crate::motion::Channel::Phase.range().start)
                    .iter()
                    .map(|x| f64::from(*x))
                    .collect();
                let music = self.phrases.music_of_real(&phrase.id, &phase).map(Arc::new);
                let firsts = window_starts(measured.n_frames, length);
                for (i, (first_frame, window)) in firsts.zip(measured.windows).enumerate() {
                    let item = MeasuredWindow {
                        song: self.phrases.song(&phrase.id),
                        phrase: place,
                        first_frame,
                        split: MusicSplit::HeldOut,
                        measured: Arc::new(window),
                        decoded: None,
                        music: music.clone(),
                    };
                    let kept = match i {
                        0 => measured.kept.clone(),
                        _ => Array2::zeros((0, crate::motion::MOTION_DIM)),
                    };
                    items.push((item, kept));
                }
            }
            items
        };
        let phrases = truth.phrases.iter().enumerate();
        let (held_out, training) =
            phrases.partition::<Vec<_>, _>(|(_, phrase)| is_held_out(phrase.split));
        (measure(training), measure(held_out))
    }

    /// Returns what vertical velocity is known to owe to the bar: that of the construction, or the mean of training
    /// motion where that is no chance.
    fn coupling(&self, training: &Measurements) -> Option<Coupling> {
        if self.phrases.is_constructed() {
            return Some(Coupling::Constructed);
        }
        let danced: Vec<MotionWindow> = training.iter().map(|(item, _)| item.as_danced()).collect();
        let songs: Vec<Harmonics> = song_harmonics(&danced).into_values().collect();
        let p = consistency_p(&songs, COUPLING_SEED)?;
        if p < COUPLING_P { Template::fit(&songs).map(Coupling::Learned) } else { None }
    }

    /// Sums up how far motions are from their constraints.
    fn control(&self, evaluated: &[EvaluatedMotion], split: Option<MusicSplit>) -> Vec<Number> {
        let chosen = || {
            self.motions
                .iter()
                .filter(move |motion| split.is_none_or(|split| motion.split == split))
        };
        let misses = |i: usize| -> (Vec<f64>, Vec<usize>) {
            chosen()
                .filter_map(|motion| {
                    Some((motion.misses[i]?, self.phrases.song(&motion.phrase_id)))
                })
                .unzip()
        };
        let (position, orientation) = (misses(0), misses(1));
        let mut numbers =
            control_numbers([&position.0, &orientation.0], [&position.1, &orientation.1]);
        let at_keyframes: Vec<(usize, &KeyframeMisses)> = self
            .motions
            .iter()
            .zip(evaluated)
            .filter(|(motion, _)| split.is_none_or(|split| motion.split == split))
            .map(|(motion, found)| (self.phrases.song(&motion.phrase_id), &found.keyframes))
            .collect();
        numbers.extend(keyframe_numbers(&at_keyframes));
        numbers
    }
}

/// Windows with the frames that are kept of their motions.
type Measurements = Vec<(MeasuredWindow, Array2<f32>)>;

/// Metrics that say how far windows are from the training split.
const DISTANCES: [&str; 4] = ["fid_k", "fid_g", "feature_shift", "channel_distance"];
