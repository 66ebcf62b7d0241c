//! Whose motion is measured: what was generated, and what it is compared with.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::sync::Arc;

use ndarray::Array2;

use super::measure::kept_frames;
use super::splits::{ALL, MusicSplit};
use crate::evaluation::WindowMeasures;
use crate::evaluation::coupling::Coupling;
use crate::evaluation::metrics::{
    MotionContext, MotionWindow, MusicContext, MusicWindow, N_WRONG_TEMPI, Number, PhaseOrigin,
    PhraseMusic, channel_numbers, motion_numbers, music_numbers, phase_numbers, shifted_numbers,
    soundness_numbers,
};
use crate::evaluation::reference_statistics::ReferenceStatistics;

/// Other songs whose music a motion is held against.
const MAX_OTHER_SONGS: usize = 8;

/// The motions or baseline that numbers were measured on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Subject {
    Generated,
    /// The same motions with the music of other songs.
    Shuffled,
    /// The same motions with the bars shifted by beats.
    Shifted,
    /// Motion of the run's own network with its first weights.
    Untrained,
    /// Motion of the trained network, its music withheld.
    NoMusic,
    /// Motion of a trained model of tokens, the tokens of each window in an order of chance.
    ShuffledPlan,
    /// Motion that a tokenizer made of the tokens of real motion.
    Reconstructed,
    /// The same without the diffusion decoder: what the convolutional one drafts.
    Draft,
    /// The library's phrase with the nearest features.
    Retrieval,
    MeanMotion,
    /// Soloists of the same model, each sampled by itself, in the places of the dancers of a group; of motions of another
    /// program dancers of other groups.
    Independent,
    /// One dancer of the group, copied to the places of all.
    Copied,
    HeldOutTruth,
    TrainingTruth,
}

impl Subject {
    /// Returns the name of the subject in tables.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Generated => "generated",
            Self::Shuffled => "shuffled",
            Self::Shifted => "shifted",
            Self::Untrained => "untrained",
            Self::NoMusic => "no_music",
            Self::ShuffledPlan => "shuffled_plan",
            Self::Reconstructed => "reconstructed",
            Self::Draft => "draft",
            Self::Retrieval => "retrieval",
            Self::MeanMotion => "mean_motion",
            Self::Independent => "independent",
            Self::Copied => "copied",
            Self::HeldOutTruth => "held_out_truth",
            Self::TrainingTruth => "training_truth",
        }
    }
}

/// Numbers of a subject, all of one split.
#[derive(Clone, Debug)]
pub struct Finding {
    pub subject: Subject,
    pub split: &'static str,
    pub numbers: Vec<Number>,
}

/// A window of motion with what is needed to measure a set of them.
#[derive(Clone, Debug)]
pub struct MeasuredWindow {
    /// Number of the song; windows of one song are no independent ones.
    pub song: usize,
    /// Number of the phrase that it was danced to.
    pub phrase: usize,
    pub first_frame: usize,
    pub split: MusicSplit,
    pub measured: Arc<WindowMeasures>,
    /// The same window as it was decoded; none where that is not known.
    pub decoded: Option<Arc<WindowMeasures>>,
    pub music: Option<Arc<PhraseMusic>>,
}

impl MeasuredWindow {
    fn music(&self) -> Option<MusicWindow<'_>> {
        self.music.as_ref()?.window(self.first_frame, self.measured.n_frames)
    }

    /// Returns the window with its music.
    pub fn as_danced(&self) -> MotionWindow<'_> {
        self.danced(&self.measured)
    }

    fn danced<'a>(&'a self, measured: &'a WindowMeasures) -> MotionWindow<'a> {
        MotionWindow {
            song: self.song,
            phrase: self.phrase,
            first_frame: self.first_frame,
            motion: measured,
            music: self.music(),
        }
    }
}

/// How sets of windows are measured.
#[derive(Clone, Copy)]
pub struct MeasureSettings<'a> {
    pub reference: Option<&'a ReferenceStatistics>,
    pub coupling: Option<&'a Coupling>,
    /// Windows that a Fréchet distance is made of, the same for all subjects.
    pub n_frechet: usize,
    pub threads: NonZeroUsize,
}

impl MeasureSettings<'_> {
    /// Measures a set of windows.
    pub fn numbers(
        &self,
        split: &str,
        items: &[&MeasuredWindow],
        phase: PhaseOrigin,
    ) -> Vec<Number> {
        let danced: Vec<MotionWindow> =
            items.iter().map(|item| item.danced(&item.measured)).collect();
        // Wrong tempi take most of the time; of all splits together nothing rests on them.
        let n_wrong_tempi = if split == ALL { 0 } else { N_WRONG_TEMPI };
        let mut numbers = music_numbers(&danced, &self.music_context(n_wrong_tempi));
        numbers.extend(phase_numbers(&danced, phase, ""));
        numbers.extend(soundness_numbers(&danced, ""));
        let context = MotionContext { reference: self.reference, n_frechet: self.n_frechet };
        numbers.extend(motion_numbers(&danced, &context));
        numbers
    }

    /// Measures how sound windows were as they were decoded; nothing where that is not known.
    pub fn decoded(&self, items: &[&MeasuredWindow], phase: PhaseOrigin) -> Vec<Number> {
        let danced: Vec<MotionWindow> = items
            .iter()
            .filter_map(|item| item.decoded.as_ref().map(|measured| item.danced(measured)))
            .collect();
        if danced.is_empty() {
            return Vec::new();
        }
        let mut numbers = soundness_numbers(&danced, DECODED);
        let mut phases = phase_numbers(&danced, phase, DECODED);
        // Beats of motion are those of what people see.
        phases.retain(|number| number.metric != "rayleigh");
        numbers.extend(phases);
        numbers
    }

    /// Measures windows with the music of other songs.
    ///
    /// The coupling is that with up to eight other songs; all else is with the next song. Nothing for a single song.
    pub fn shuffled(&self, items: &[&MeasuredWindow]) -> Vec<Number> {
        let mut songs: BTreeMap<usize, &Arc<PhraseMusic>> = BTreeMap::new();
        for item in items {
            if let Some(music) = &item.music {
                let known = songs.entry(item.song).or_insert(music);
                // The longest, so that every window has music to its end.
                if music.bars.len() > known.bars.len() {
                    *known = music;
                }
            }
        }
        let numbers: Vec<usize> = songs.keys().copied().collect();
        if numbers.len() < 2 {
            return Vec::new();
        }
        let other = |item: &MeasuredWindow, step: usize| -> Option<&PhraseMusic> {
            let place = numbers.iter().position(|song| *song == item.song)?;
            songs.get(&numbers[(place + step) % numbers.len()]).map(|music| &***music)
        };
        fn danced_to<'a>(
            item: &'a MeasuredWindow,
            music: Option<&'a PhraseMusic>,
        ) -> MotionWindow<'a> {
            let n = item.measured.n_frames;
            let music = music.filter(|_| item.music.is_some()).and_then(|music| {
                // Music that is shorter begins again.
                let n_starts = (music.bars.len() + 1).checked_sub(n).filter(|n| *n > 0)?;
                music.window(item.first_frame % n_starts, n)
            });
            MotionWindow { music, ..item.danced(&item.measured) }
        }
        let next: Vec<MotionWindow> =
            items.iter().map(|item| danced_to(item, other(item, 1))).collect();
        let mut found = music_numbers(&next, &self.music_context(0));
        let steps = 1..=MAX_OTHER_SONGS.min(numbers.len() - 1);
        let all: Vec<MotionWindow> = items
            .iter()
            .flat_map(|item| steps.clone().map(move |step| danced_to(item, other(item, step))))
            .collect();
        let pooled = music_numbers(&all, &self.music_context(0));
        let is_coupling = |number: &Number| ["coupling", "locking_p"].contains(&number.metric);
        found.retain(|number| !is_coupling(number));
        found.extend(pooled.into_iter().filter(is_coupling));
        found
    }

    /// Measures windows with their bars shifted by beats; nothing where no coupling is known.
    pub fn shifted(&self, items: &[&MeasuredWindow]) -> Vec<Number> {
        let danced: Vec<MotionWindow> =
            items.iter().map(|item| item.danced(&item.measured)).collect();
        self.coupling.map_or_else(Vec::new, |coupling| shifted_numbers(&danced, coupling))
    }

    fn music_context(&self, n_wrong_tempi: usize) -> MusicContext<'_> {
        MusicContext { coupling: self.coupling, n_wrong_tempi, n_threads: self.threads }
    }
}

/// The suffix of variants of numbers of motion as it was decoded.
pub const DECODED: &str = "raw";

/// Compares the values of channels with those of the training split.
pub fn channels<'a>(
    kept: impl IntoIterator<Item = &'a Array2<f32>>,
    truth: &Array2<f32>,
) -> Vec<Number> {
    let kept = kept_frames(kept);
    if kept.nrows() == 0 || truth.nrows() == 0 {
        return Vec::new();
    }
    channel_numbers(kept.view(), truth.view())
}
