//! Groups as groups: how their dancers move together and keep apart, beside real groups and made-up ones.

mod made_up;
mod sampled;

use std::collections::BTreeMap;

use ndarray::{Array2, Array3, ArrayView3, Axis, s};

use super::motions::PhraseIndex;
use super::splits::{ALL, MusicSplit};
use super::subjects::{Finding, Subject};
use super::truth::{Truth, TruthPhrase};
use crate::evaluation::frechet::Gaussian;
use crate::evaluation::group::numbers::{
    GroupWindow, WindowBars, feature_distribution, group_numbers,
};
use crate::evaluation::metrics::Number;
use crate::evaluation::verdict::GroupEvidence;
use crate::motion::group::RADIUS_M;
use crate::motion::{Channel, bar_phase};
use crate::training::Split;
use crate::units::frames_to_s;
use made_up::{FloorPoint, copied, independent, placed, places};

/// Frames of a window, unless groups have fewer: 8 s, the least span of one kind of unison.
const WINDOW_FRAMES: usize = 240;
/// Most real groups of a split that are looked at, evenly among all.
const MAX_REAL: usize = 400;
/// Dancers of groups before, of whom groups are made up where no soloists are sampled.
const MAX_STRANGERS: usize = 16;

/// The music of a window.
#[derive(Clone)]
struct WindowMusic {
    song: usize,
    bar_frames: f64,
    phase: Vec<f64>,
}

impl WindowMusic {
    fn bars(&self) -> WindowBars<'_> {
        WindowBars { song: self.song, bar_frames: self.bar_frames, phase: &self.phase }
    }

    fn window(&self, first: usize, n_frames: usize) -> Option<WindowBars<'_>> {
        Some(WindowBars { phase: self.phase.get(first..first + n_frames)?, ..self.bars() })
    }
}

/// A group that was sampled as a baseline for a window of music.
pub(super) struct SampledGroup {
    subject: Subject,
    phrase_id: String,
    first_frame: usize,
    split: MusicSplit,
    /// \[N, T, 25\]
    frames: Array3<f32>,
}

/// Measures groups as they come.
pub(super) struct GroupMeasurer {
    window: usize,
    windows: BTreeMap<(&'static str, Subject), Vec<GroupWindow>>,
    sampled: Vec<SampledGroup>,
    /// Where the dancers of a group stood for whom soloists were sampled, by phrase and first frame.
    places: BTreeMap<(String, usize), Vec<FloorPoint>>,
    /// Dancers of groups before, the latest last, and their songs.
    strangers: Vec<(usize, Array2<f32>)>,
    /// The music of the group before of another song.
    others: Vec<WindowMusic>,
}

impl GroupMeasurer {
    /// `n_frames` are the lengths of the motions, `truth` is real groups'.
    pub fn new(n_frames: &[usize], truth: Option<&Truth>) -> Self {
        let real = truth.into_iter().flat_map(|truth| &truth.phrases).map(|p| p.motion.nrows());
        let longest = n_frames.iter().copied().max().unwrap_or(WINDOW_FRAMES);
        Self {
            window: real.min().unwrap_or(WINDOW_FRAMES).min(longest).min(WINDOW_FRAMES),
            windows: BTreeMap::new(),
            sampled: Vec::new(),
            places: BTreeMap::new(),
            strangers: Vec::new(),
            others: Vec::new(),
        }
    }

    /// Returns the frames of a window.
    pub fn window_frames(&self) -> usize {
        self.window
    }

    /// Takes in baselines that were sampled before the groups come for whose music they are.
    pub fn expect(&mut self, sampled: Vec<SampledGroup>) {
        self.sampled.extend(sampled);
    }

    /// Measures a group, \[N, T, 25\], in windows, and what is made up from it; none where its beats are not known.
    pub fn add(
        &mut self,
        phrases: &PhraseIndex,
        (phrase_id, split): (&str, MusicSplit),
        group: ArrayView3<f32>,
    ) {
        let (n_dancers, n_frames, _) = group.dim();
        let Some(music) = music_of(phrases, phrase_id, n_frames) else { return };
        let other = self.others.iter().rev().find(|other| other.song != music.song).cloned();
        let window = self.window;
        let strangers: Vec<Array2<f32>> = {
            let of_others = self.strangers.iter().rev().filter(|(song, _)| *song != music.song);
            of_others.take(n_dancers).map(|(_, frames)| frames.clone()).collect()
        };
        for first in (0..).step_by(window).take_while(|first| first + window <= n_frames) {
            let frames = group.slice(s![.., first..first + window, ..]);
            let Some(own) = music.window(first, window) else { continue };
            let other = other.as_ref().and_then(|other| other.window(first, window));
            let mut add = |subject, frames: ArrayView3<f32>| {
                let found = GroupWindow::new(frames, RADIUS_M, own, other);
                self.windows.entry((split.name(), subject)).or_default().push(found);
            };
            add(Subject::Generated, frames);
            add(Subject::Copied, copied(frames).view());
            let is_sampled = self.sampled.iter().any(|s| s.subject == Subject::Independent);
            let last = first + window;
            let others: Option<Vec<_>> = strangers
                .iter()
                .map(|stranger| {
                    (stranger.nrows() >= last).then(|| stranger.slice(s![first..last, ..]))
                })
                .collect();
            if let Some(others) = others.filter(|others| !is_sampled && others.len() == n_dancers) {
                add(Subject::Independent, independent(frames, &others).view());
            }
            self.places.entry((phrase_id.to_owned(), first)).or_insert_with(|| places(frames));
        }
        // A dancer of each group, another one each time.
        let dancer = self.strangers.len() % n_dancers.max(1);
        self.strangers.push((music.song, group.index_axis(Axis(0), dancer).to_owned()));
        if self.strangers.len() > MAX_STRANGERS {
            self.strangers.remove(0);
        }
        self.others.retain(|other| other.song != music.song);
        self.others.push(music);
    }

    /// Measures real groups and sampled ones, and returns the numbers of all.
    pub fn finish(mut self, phrases: &PhraseIndex, truth: Option<&Truth>) -> GroupFindings {
        for sampled in std::mem::take(&mut self.sampled) {
            let SampledGroup { subject, phrase_id, first_frame, split, mut frames } = sampled;
            let last = first_frame + frames.dim().1;
            let Some(music) = music_of(phrases, &phrase_id, last) else { continue };
            let Some(own) = music.window(first_frame, frames.dim().1) else { continue };
            if subject == Subject::Independent {
                let Some(to) = self.places.get(&(phrase_id, first_frame)) else { continue };
                frames = placed(frames.view(), to);
            }
            let other = self.others.iter().find(|other| other.song != music.song);
            let other = other.and_then(|other| other.window(first_frame, frames.dim().1));
            let found = GroupWindow::new(frames.view(), RADIUS_M, own, other);
            self.windows.entry((split.name(), subject)).or_default().push(found);
        }
        if let Some(truth) = truth {
            self.add_real(phrases, truth);
        }
        let training = self.windows.get(&(ALL, Subject::TrainingTruth));
        let reference: Option<Gaussian> =
            training.and_then(|windows| feature_distribution(windows));
        let numbers = self.windows.iter().map(|(&(split, subject), windows)| {
            ((split, subject), group_numbers(windows, reference.as_ref()))
        });
        GroupFindings { numbers: numbers.collect() }
    }

    fn add_real(&mut self, phrases: &PhraseIndex, truth: &Truth) {
        for subject in [Subject::HeldOutTruth, Subject::TrainingTruth] {
            let is_of_subject = |group: &&[TruthPhrase]| {
                (group[0].split == Split::Train) == (subject == Subject::TrainingTruth)
            };
            let groups: Vec<&[TruthPhrase]> =
                truth.phrases.chunk_by(|a, b| a.id == b.id).filter(is_of_subject).collect();
            let n = groups.len().min(MAX_REAL);
            let chosen: Vec<&[TruthPhrase]> =
                (0..n).map(|i| groups[i * groups.len() / n]).collect();
            // The bars of real motion are those of its own phase.
            let music: Vec<Option<WindowMusic>> =
                chosen.iter().map(|group| music_of_real(phrases, &group[0])).collect();
            let split = real_split(subject);
            for (i, (group, own)) in chosen.iter().zip(&music).enumerate() {
                let Some(own) = own else { continue };
                let other = (1..n)
                    .filter_map(|k| music[(i + k) % n].as_ref())
                    .find(|other| other.song != own.song);
                let views: Vec<_> = group.iter().map(|dancer| dancer.motion.view()).collect();
                let Ok(frames) = ndarray::stack(Axis(0), &views) else { continue };
                let window = self.window;
                let firsts = (0..).step_by(window);
                for first in firsts.take_while(|first| first + window <= frames.dim().1) {
                    let Some(bars) = own.window(first, window) else { continue };
                    let other = other.and_then(|other| other.window(first, window));
                    let frames = frames.slice(s![.., first..first + window, ..]);
                    let found = GroupWindow::new(frames, RADIUS_M, bars, other);
                    self.windows.entry((split, subject)).or_default().push(found);
                }
            }
        }
    }
}

/// Returns the split that numbers of real groups have in tables.
fn real_split(subject: Subject) -> &'static str {
    match subject {
        Subject::HeldOutTruth => MusicSplit::HeldOut.name(),
        _ => ALL,
    }
}

/// Returns the bars of the music of a phrase; none where its beats are not known.
fn music_of(phrases: &PhraseIndex, phrase_id: &str, n_frames: usize) -> Option<WindowMusic> {
    let beats = phrases.beats(phrase_id)?;
    let times_s: Vec<f64> = (0..n_frames).map(frames_to_s).collect();
    Some(WindowMusic {
        song: phrases.song(phrase_id),
        bar_frames: phrases.bar_frames(phrase_id)?,
        phase: bar_phase(&times_s, &beats),
    })
}

fn music_of_real(phrases: &PhraseIndex, dancer: &TruthPhrase) -> Option<WindowMusic> {
    let phase = dancer.motion.column(Channel::Phase.range().start);
    Some(WindowMusic {
        song: phrases.song(&dancer.id),
        bar_frames: phrases.bar_frames(&dancer.id)?,
        phase: phase.iter().map(|&x| f64::from(x)).collect(),
    })
}

/// The numbers of groups, by split and subject.
pub(super) struct GroupFindings {
    numbers: BTreeMap<(&'static str, Subject), Vec<Number>>,
}

/// The numbers of a split that verdicts rest on.
pub(super) struct SplitNumbers<'a> {
    own: &'a [Number],
    independent: &'a [Number],
    truth: &'a [Number],
}

impl GroupFindings {
    fn of(&self, split: &'static str, subject: Subject) -> &[Number] {
        self.numbers.get(&(split, subject)).map_or(&[], Vec::as_slice)
    }

    /// Returns the numbers of a split.
    pub fn of_split(&self, split: MusicSplit) -> SplitNumbers<'_> {
        let truth = Subject::HeldOutTruth;
        SplitNumbers {
            own: self.of(split.name(), Subject::Generated),
            independent: self.of(split.name(), Subject::Independent),
            truth: self.of(real_split(truth), truth),
        }
    }

    /// Returns all numbers, as tables have them.
    pub fn findings(&self) -> impl Iterator<Item = Finding> + '_ {
        self.numbers.iter().map(|(&(split, subject), numbers)| {
            let mut numbers = numbers.clone();
            // Distances from itself say nothing.
            numbers.retain(|n| n.metric != "gmr" || subject != Subject::TrainingTruth);
            Finding { subject, split, numbers }
        })
    }
}

impl SplitNumbers<'_> {
    /// Returns what the verdicts are told.
    pub fn evidence(&self) -> GroupEvidence<'_> {
        let Self { own, independent, truth } = self;
        GroupEvidence { own, independent, truth }
    }
}
