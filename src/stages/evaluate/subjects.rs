//! Whose motion is measured: what was generated, and what it is compared with.

use std::collections::{BTreeMap, BTreeSet};
use std::num::NonZeroUsize;

use ndarray::{Array2, ArrayView2, s};

use super::measure::{Measurer, Seen, kept_of, stride_for};
use super::motions::{Phrases, excerpt};
use super::truth::{RETRIEVAL_FRAMES, Truth};
use crate::evaluation::metrics::{
    Danced, Music, Number, of_channels, of_control, of_motion, of_music,
};
use crate::generation::Retrieval;
use crate::store::tables::GenerationRow;
use crate::training::Split;

/// Windows of music for which the library is asked for its nearest phrase.
pub const MAX_RETRIEVED: usize = 500;

/// Whose numbers they are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Subject {
    Generated,
    /// The same motions with the music of other songs.
    Shuffled,
    /// The library's phrase with the nearest features.
    Retrieval,
    MeanMotion,
    HeldOutTruth,
    GroundTruth,
}

impl Subject {
    /// Returns the name of the subject in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Generated => "generated",
            Self::Shuffled => "shuffled",
            Self::Retrieval => "retrieval",
            Self::MeanMotion => "mean_motion",
            Self::HeldOutTruth => "held_out_truth",
            Self::GroundTruth => "ground_truth",
        }
    }
}

/// Every song.
pub const ALL: &str = "all";
/// Songs that the model did not learn from.
pub const HELD_OUT: &str = "held_out";

/// A number, whose it is and of which songs.
pub struct Finding {
    pub subject: Subject,
    pub split: &'static str,
    pub number: Number,
}

/// A motion with what is needed to measure a set of them.
pub struct Item {
    pub phrase_id: String,
    pub song: usize,
    pub phrase: usize,
    pub is_held_out: bool,
    pub seen: Seen,
    pub music: Option<Music>,
}

/// What is measured.
pub struct Subjects<'a> {
    pub phrases: &'a Phrases,
    pub truth: Option<&'a Truth>,
    pub measurer: &'a Measurer<'a>,
    pub threads: NonZeroUsize,
}

impl Subjects<'_> {
    /// Returns the motions of a run with their music.
    pub fn generated(&self, rows: &[GenerationRow], seen: Vec<Option<Seen>>) -> Vec<Item> {
        let mut number_of: BTreeMap<String, usize> = BTreeMap::new();
        rows.iter()
            .zip(seen)
            .filter_map(|(row, seen)| {
                let (seen, id) = (seen?, &row.phrase_id);
                let n = number_of.len();
                Some(Item {
                    phrase_id: id.clone(),
                    song: self.phrases.song(id),
                    phrase: *number_of.entry(id.clone()).or_insert(n),
                    is_held_out: self.phrases.is_held_out(id),
                    music: self.phrases.music(id, seen.measured.n_frames),
                    seen,
                })
            })
            .collect()
    }

    /// Returns the phrases of the ground truth.
    pub fn truth(&self) -> Vec<Item> {
        let Some(truth) = self.truth else { return Vec::new() };
        let feed = |give: &mut dyn FnMut(usize, Array2<f32>)| {
            for (i, phrase) in truth.phrases.iter().enumerate() {
                give(i, phrase.motion.clone());
            }
            Ok::<_, std::convert::Infallible>(())
        };
        let n_frames = truth.phrases.iter().map(|phrase| phrase.motion.nrows()).sum();
        let measurer = Measurer { stride: stride_for(n_frames), ..*self.measurer };
        let Ok(seen) = measurer.run(truth.phrases.len(), feed);
        let with_music =
            |(i, (phrase, seen)): (usize, (&super::truth::TruthPhrase, Option<Seen>))| {
                let seen = seen?;
                Some(Item {
                    phrase_id: phrase.id.clone(),
                    song: self.phrases.song(&phrase.id),
                    phrase: i,
                    is_held_out: phrase.split != Split::Train,
                    music: self.phrases.music_of_phase(&phrase.id, &seen.measured.phase),
                    seen,
                })
            };
        truth.phrases.iter().zip(seen).enumerate().filter_map(with_music).collect()
    }

    /// Returns the motions that the library has for the music of a phrase, window by window.
    pub fn retrieved(&self, item: &Item, features: ArrayView2<f32>, most: usize) -> Vec<Item> {
        let Some(truth) = self.truth else { return Vec::new() };
        let Some((index, of_phrase)) = &truth.retrieval else { return Vec::new() };
        windows(features.nrows())
            .take(most)
            .filter_map(|first| {
                let window = features.slice(s![first..first + RETRIEVAL_FRAMES, ..]);
                let (nearest, _) = Retrieval::nearest(index, window)?;
                let phrase = &truth.phrases[*of_phrase.get(nearest)?];
                let motion = phrase.motion.slice(s![..RETRIEVAL_FRAMES, ..]).to_owned();
                Some(Item {
                    phrase_id: phrase.id.clone(),
                    song: item.song,
                    phrase: item.phrase,
                    is_held_out: item.is_held_out,
                    seen: self.measurer.look(&motion),
                    music: item.music.as_ref().map(|m| excerpt(m, first, RETRIEVAL_FRAMES)),
                })
            })
            .collect()
    }

    /// Returns the best constant with the music of each phrase, one for each window.
    pub fn mean_motion(&self, generated: &[Item]) -> Vec<Item> {
        let Some(truth) = self.truth else { return Vec::new() };
        let mut phrases = BTreeSet::new();
        let firsts = generated.iter().filter(|item| phrases.insert(item.phrase));
        let of_windows = firsts
            .flat_map(|item| windows(item.seen.measured.n_frames).map(move |first| (item, first)));
        of_windows
            .take(MAX_RETRIEVED)
            .map(|(item, first)| Item {
                phrase_id: item.phrase_id.clone(),
                song: item.song,
                phrase: item.phrase,
                is_held_out: item.is_held_out,
                seen: self.measurer.look(&truth.mean_motion),
                music: item.music.as_ref().map(|m| excerpt(m, first, RETRIEVAL_FRAMES)),
            })
            .collect()
    }

    /// Measures a set of motions; of a shuffled one only how far it follows its music.
    pub fn numbers(&self, subject: Subject, split: &'static str, items: &[&Item]) -> Vec<Finding> {
        let danced: Vec<Danced> = items
            .iter()
            .map(|item| Danced {
                song: item.song,
                phrase: item.phrase,
                motion: &item.seen.measured,
                music: item.music.as_ref(),
            })
            .collect();
        let mut numbers = of_music(&danced, self.threads);
        numbers.extend(of_motion(&danced, self.truth.map(|truth| &truth.statistics)));
        findings(subject, split, numbers)
    }

    /// Measures motions with the music of other songs: each song takes the music of the next.
    ///
    /// None for a single song.
    pub fn shuffled(&self, split: &'static str, items: &[&Item]) -> Vec<Finding> {
        let mut of_song: BTreeMap<usize, &Music> = BTreeMap::new();
        for item in items {
            if let Some(music) = &item.music {
                let known = of_song.entry(item.song).or_insert(music);
                // The longest, so that every motion has music to its end.
                if music.bars.len() > known.bars.len() {
                    *known = music;
                }
            }
        }
        if of_song.len() < 2 {
            return Vec::new();
        }
        let next = |song: usize| {
            let after = of_song.range(song + 1..).next().or_else(|| of_song.iter().next());
            after.map(|(_, music)| *music)
        };
        let danced: Vec<Danced> = items
            .iter()
            .map(|item| Danced {
                song: item.song,
                phrase: item.phrase,
                motion: &item.seen.measured,
                music: item.music.as_ref().and_then(|_| next(item.song)),
            })
            .collect();
        findings(Subject::Shuffled, split, of_music(&danced, self.threads))
    }
}

/// Compares the values of channels with those of the ground truth.
pub fn channels(
    subject: Subject,
    split: &'static str,
    items: &[&Item],
    truth: &Array2<f32>,
) -> Vec<Finding> {
    let kept = kept_of(items.iter().map(|item| &item.seen));
    findings(subject, split, of_channels(kept.view(), truth.view()))
}

/// Sums up how far motions are from their constraints.
pub fn control(split: &'static str, rows: &[&GenerationRow], phrases: &Phrases) -> Vec<Finding> {
    let of = |miss: fn(&GenerationRow) -> Option<f64>| -> (Vec<f64>, Vec<usize>) {
        rows.iter().filter_map(|row| Some((miss(row)?, phrases.song(&row.phrase_id)))).unzip()
    };
    let position = of(|row| row.control_error_mm);
    let orientation = of(|row| row.control_error_deg);
    let numbers = of_control([&position.0, &orientation.0], [&position.1, &orientation.1]);
    findings(Subject::Generated, split, numbers)
}

fn findings(subject: Subject, split: &'static str, numbers: Vec<Number>) -> Vec<Finding> {
    numbers.into_iter().map(|number| Finding { subject, split, number }).collect()
}

/// First frames of the windows of a track.
fn windows(n_frames: usize) -> impl Iterator<Item = usize> {
    (0..n_frames / RETRIEVAL_FRAMES).map(|i| i * RETRIEVAL_FRAMES)
}
