//! Windows of phrases, ready to learn from: cropped, augmented, placed at the origin, normalised.

use std::sync::Arc;

use ndarray::{Array2, Axis, concatenate, s};
use serde::{Deserialize, Serialize};

use crate::audio::{FEATURE_DIM, FeatureScale};
use crate::autodiff::Stream;
use crate::model::ConditionConfig;
use crate::motion::augment::{
    mirror_x, rotate_yaw, stretch_features, stretch_motion, stretched_frames,
};
use crate::motion::{CLOCK_DIM, Channel, MOTION_DIM, Normalizer, Placement};
use crate::store::StoreError;

use super::batch::{Batch, Chances, PAIR};
use super::dataset::{Dataset, Phrase, Split};
use super::learner::{Ownership, all_windows};
use super::pairs::in_pairs;

/// Augmentation of windows; zero and false leave them as they are.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Augmentation {
    /// Standard deviation of the noise added to features, in units of their spread.
    pub condition_noise: f64,
    /// Whether every other window, by chance, is mirrored in x.
    pub mirror: bool,
    /// Largest turn about the vertical, in degrees, either way.
    pub yaw_deg: f64,
    /// Largest change of speed: rates are uniform in 1 ± this.
    pub stretch: f64,
}

impl Default for Augmentation {
    fn default() -> Self {
        // A handful of songs has a handful of tempi: stretched, they have all those between.
        Self { condition_noise: 0.1, mirror: true, yaw_deg: 0.0, stretch: 0.15 }
    }
}

/// Normalization of motion and music for the networks.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scales {
    pub motion: Normalizer,
    pub features: FeatureScale,
}

impl From<Normalizer> for Scales {
    /// Leaves features as they are.
    fn from(motion: Normalizer) -> Self {
        Self { motion, features: FeatureScale::identity(FEATURE_DIM) }
    }
}

/// Cuts windows out of the phrases of a dataset.
#[derive(Debug)]
pub struct Windows {
    dataset: Arc<Dataset>,
    scales: Scales,
    augmentation: Augmentation,
    n_frames: usize,
    /// Whether windows have the clock beside the features.
    has_clock: bool,
    /// Places for dancers in every window.
    n_slots: usize,
    /// Whether windows come in pairs to the same music.
    is_paired: bool,
    seed: u64,
    /// Training windows of an epoch: the phrase of each; longer phrases have several.
    train: Vec<u32>,
    /// Validation windows: phrase and first frame.
    validation: Vec<(u32, u32)>,
}

/// Streams of random numbers, told apart by their use.
const ORDER: u64 = 1 << 60;
const CROP: u64 = 2 << 60;
const AUDIO_NOISE: u64 = 3 << 60;
const CHANCES: u64 = 4 << 60;
const NOISE: u64 = 5 << 60;
const VALIDATION_NOISE: u64 = 6 << 60;
const PAIR_STEP: u64 = 7 << 60;

/// The golden ratio's fraction: multiples of it are spread evenly over \[0, 1), however many there are.
const GOLDEN: f64 = 0.618_033_988_749_894_9;

impl Windows {
    /// Makes windows of `n_frames` frames.
    pub fn new(
        dataset: Arc<Dataset>,
        scales: impl Into<Scales>,
        augmentation: Augmentation,
        n_frames: usize,
        seed: u64,
    ) -> Self {
        let (mut train, mut validation) = (Vec::new(), Vec::new());
        for (i, phrase) in dataset.phrases().iter().enumerate() {
            let i = i as u32;
            let n_windows = (phrase.n_frames / n_frames).max(1);
            match phrase.split {
                Split::Train => train.extend(std::iter::repeat_n(i, n_windows)),
                Split::Validation => {
                    validation.extend((0..n_windows).map(|k| (i, (k * n_frames) as u32)));
                }
                Split::Test => {}
            }
        }
        let scales = scales.into();
        let n_dancers = dataset.phrases().iter().map(|phrase| phrase.n_dancers);
        let n_slots = n_dancers.max().unwrap_or(1);
        let has_clock = false;
        Self {
            dataset,
            scales,
            augmentation,
            n_frames,
            has_clock,
            n_slots,
            is_paired: false,
            seed,
            train,
            validation,
        }
    }

    /// Gives windows what a network hears: the clock too, where its configuration says so.
    pub fn heard_by(self, config: impl Into<ConditionConfig>) -> Self {
        Self { has_clock: config.into().clock, ..self }
    }

    /// Gives windows in pairs, as groups are learned from: 2k and 2k + 1 are of two phrases to the same music, cut and
    /// changed alike and with the same step of noise, so that dancers of one are strangers in the other for no reason
    /// but their steps. Phrases whose music no other phrase has are paired with each other.
    pub fn paired(mut self) -> Self {
        let phrases = self.dataset.phrases();
        let music = |phrase: u32| &*phrases[phrase as usize].music;
        self.validation = in_pairs(&self.validation, |w| w.0, |w| (music(w.0), w.1));
        self.is_paired = true;
        self
    }

    /// Returns the number that windows of a pair share, of their numbers.
    fn shared(&self, number: u64) -> u64 {
        if self.is_paired { number / PAIR as u64 } else { number }
    }

    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    pub fn normalizer(&self) -> &Normalizer {
        &self.scales.motion
    }

    pub fn scales(&self) -> &Scales {
        &self.scales
    }

    fn condition_dim(&self) -> usize {
        FEATURE_DIM + if self.has_clock { CLOCK_DIM } else { 0 }
    }

    /// Returns how many windows an epoch has.
    pub fn n_train(&self) -> usize {
        match self.is_paired {
            true => self.train.len().next_multiple_of(PAIR),
            false => self.train.len(),
        }
    }

    /// Returns how many validation windows there are.
    pub fn n_validation(&self) -> usize {
        self.validation.len()
    }

    /// Returns which phrase each window of an epoch is of, determined by seed and epoch alone.
    ///
    /// Fisher and Yates; each swap takes its number from the stream of the seed and epoch.
    pub fn order(&self, epoch: u64) -> Vec<u32> {
        let mut order = self.train.clone();
        let mut numbers = vec![0.0_f64; order.len()];
        Stream::new(self.seed, ORDER + epoch).uniform(0, &mut numbers);
        for i in (1..order.len()).rev() {
            order.swap(i, (numbers[i] * (i + 1) as f64) as usize);
        }
        if self.is_paired {
            let phrases = self.dataset.phrases();
            order = in_pairs(&order, |phrase| phrase, |phrase| &*phrases[phrase as usize].music);
        }
        order
    }

    /// Returns training windows, each by its number since training began and its phrase.
    ///
    /// # Errors
    /// [`StoreError`] when the frames at hand cannot be read.
    pub fn train(&self, windows: &[(u64, u32)]) -> Result<Batch, StoreError> {
        self.train_some(windows, &all_windows())
    }

    /// Returns training windows as [`Windows::train`] does, of which only those are read that a process learns from.
    ///
    /// # Errors
    /// As [`Windows::train`].
    pub fn train_some(
        &self,
        windows: &[(u64, u32)],
        ownership: &Ownership,
    ) -> Result<Batch, StoreError> {
        let mut batch =
            Batch::empty(windows.len(), self.n_frames, self.n_slots, self.condition_dim());
        let phrase_of = |phrase: u32| &self.dataset.phrases()[phrase as usize];
        let n_dancers: Vec<usize> =
            windows.iter().map(|&(_, phrase)| phrase_of(phrase).n_dancers).collect();
        for (&(number, phrase), is_own) in windows.iter().zip(ownership(&n_dancers)) {
            let phrase = phrase_of(phrase);
            if !is_own {
                batch.push_absent(phrase.n_dancers, &phrase.id, self.condition_dim());
                continue;
            }
            let (dancers, audio) = self.augmented(phrase, number)?;
            self.push(&mut batch, phrase, dancers, audio);
            let mut drawn = [0.0_f64; 4];
            Stream::new(self.seed, CHANCES + number).uniform(0, &mut drawn);
            let [mut step, no_audio, no_style, no_clock] = drawn;
            if self.is_paired {
                let mut drawn = [0.0_f64];
                Stream::new(self.seed, PAIR_STEP + self.shared(number)).uniform(0, &mut drawn);
                [step] = drawn;
            }
            batch.chances.push(Chances { step, no_audio, no_style, no_clock });
            push_noise(&mut batch, Stream::new(self.seed, NOISE + number));
        }
        Ok(batch)
    }

    /// Returns validation windows as they are, counted on and on: after the last comes the first again,
    /// with other noise and another step.
    ///
    /// The seed plays no part, so that runs can be compared; nothing is withheld, and steps are spread
    /// evenly, so that few windows tell much.
    ///
    /// # Errors
    /// [`StoreError`] when the frames at hand cannot be read.
    ///
    /// # Panics
    /// When there are no validation windows.
    pub fn validation(&self, range: std::ops::Range<usize>) -> Result<Batch, StoreError> {
        let mut batch =
            Batch::empty(range.len(), self.n_frames, self.n_slots, self.condition_dim());
        for number in range {
            let (phrase, first) = self.validation[number % self.validation.len()];
            let phrase = &self.dataset.phrases()[phrase as usize];
            let n = self.n_frames.min(phrase.n_frames - first as usize);
            let mut dancers = self.dancers(phrase, first as usize, n)?;
            let mut audio = self.dataset.features(phrase, first as usize, n)?;
            self.scales.features.apply(audio.view_mut());
            place(&mut dancers);
            self.push(&mut batch, phrase, dancers, audio);
            let step = ((self.shared(number as u64) as f64 + 0.5) * GOLDEN).fract();
            batch.chances.push(Chances { step, no_audio: 1.0, no_style: 1.0, no_clock: 1.0 });
            push_noise(&mut batch, Stream::new(0, VALIDATION_NOISE + number as u64));
        }
        Ok(batch)
    }

    /// Reads frames of all dancers of a phrase.
    fn dancers(
        &self,
        phrase: &Phrase,
        first: usize,
        n: usize,
    ) -> Result<Vec<Array2<f32>>, StoreError> {
        let group = self.dataset.group(phrase, first, n)?;
        Ok(group.outer_iter().map(|dancer| dancer.to_owned()).collect())
    }

    /// Cuts a window by chance and changes it by chance; returns its dancers and its music.
    fn augmented(
        &self,
        phrase: &Phrase,
        number: u64,
    ) -> Result<(Vec<Array2<f32>>, Array2<f32>), StoreError> {
        let mut drawn = [0.0_f64; 4];
        Stream::new(self.seed, CROP + self.shared(number)).uniform(0, &mut drawn);
        let [crop, speed, turn, side] = drawn;
        let Augmentation { condition_noise, mirror, yaw_deg, stretch } = self.augmentation;
        let rate = 1.0 + stretch * (2.0 * speed - 1.0);
        let is_stretched = stretch > 0.0 && phrase.n_frames > 4;
        // Two frames more for the differences, and one for what lies between frames.
        let n_wanted = if is_stretched {
            ((self.n_frames + 1) as f64 * rate).ceil() as usize + 1
        } else {
            self.n_frames
        };
        let n = n_wanted.min(phrase.n_frames);
        let first = (crop * (phrase.n_frames - n + 1) as f64) as usize;
        let mut dancers = self.dancers(phrase, first, n)?;
        let mut audio = self.dataset.features(phrase, first, n)?;
        let layout = self.scales.motion.layout();
        let stretched: Result<Vec<_>, _> =
            dancers.iter().map(|motion| stretch_motion(layout, motion.view(), rate)).collect();
        if is_stretched && let Ok(stretched) = stretched {
            let n_stretched = stretched.iter().map(|motion| motion.nrows()).min().unwrap_or(n);
            let n = n_stretched.min(self.n_frames).min(stretched_frames(n, rate));
            dancers = stretched.iter().map(|motion| motion.slice(s![..n, ..]).to_owned()).collect();
            audio = stretch_features(audio.view(), rate, n);
        }
        place(&mut dancers);
        for motion in &mut dancers {
            if mirror && side < 0.5 {
                mirror_x(layout, motion.view_mut());
            }
            if yaw_deg > 0.0 {
                rotate_yaw(layout, motion, (2.0 * turn - 1.0) * yaw_deg.to_radians());
            }
        }
        self.scales.features.apply(audio.view_mut());
        if condition_noise > 0.0 {
            let mut noise = vec![0.0_f32; audio.len()];
            Stream::new(self.seed, AUDIO_NOISE + number).normal(0, &mut noise);
            for (x, z) in audio.iter_mut().zip(noise) {
                *x += condition_noise as f32 * z;
            }
        }
        Ok((dancers, audio))
    }

    /// Normalises a window and adds it to a batch, its last frame held to the end.
    fn push(
        &self,
        batch: &mut Batch,
        phrase: &Phrase,
        mut dancers: Vec<Array2<f32>>,
        audio: Array2<f32>,
    ) {
        let n = audio.nrows().min(dancers[0].nrows());
        // Every dancer has the phase of the music.
        let clock = self.has_clock.then(|| phrase.clock_of(dancers[0].view()));
        for motion in &mut dancers {
            self.scales.motion.normalize(motion.view_mut());
            for t in (0..self.n_frames).map(|t| t.min(n - 1)) {
                batch.motion.extend(motion.row(t));
            }
        }
        let n_absent = self.n_slots - dancers.len();
        batch.motion.extend(std::iter::repeat_n(0.0, n_absent * self.n_frames * MOTION_DIM));
        for t in (0..self.n_frames).map(|t| t.min(n - 1)) {
            batch.audio.extend(audio.row(t));
            batch.audio.extend(clock.iter().flat_map(|clock| clock.row(t)));
        }
        batch.mask.extend((0..self.n_frames).map(|t| if t < n { 1.0 } else { 0.0 }));
        let style = dancers[0].slice(s![.., Channel::Style.range()]);
        batch.style.extend(style.columns().into_iter().map(|column| column.sum() / n as f32));
        batch.n_dancers.push(dancers.len());
        batch.phrase_ids.push(Arc::clone(&phrase.id));
        batch.n_windows += 1;
    }
}

/// Adds the noise of one more window.
fn push_noise(batch: &mut Batch, stream: Stream) {
    let first = batch.noise.len();
    batch.noise.resize(first + batch.n_slots * batch.n_frames * MOTION_DIM, 0.0);
    stream.normal(0, &mut batch.noise[first..]);
}

/// Puts dancers where a network expects them: a soloist at the origin, facing +Z, in the first frame. A group stays on
/// its stage, whose middle is the origin and whose front is +Z, so that windows of one track have one place.
fn place(dancers: &mut [Array2<f32>]) {
    if let [soloist] = dancers
        && let Some(placement) = Placement::of_first(soloist.view())
    {
        placement.remove(soloist);
    }
}

/// Most frames that a normalizer is fitted to; more say nothing new.
const MAX_FITTED_FRAMES: usize = 1 << 20;

/// Fits the scales of motion and features to the training windows of a dataset; returns the names of
/// constant channels of motion too.
///
/// # Errors
/// [`StoreError`] when the frames at hand cannot be read.
///
/// # Panics
/// When there are no training phrases.
pub fn fit_scales(
    dataset: &Dataset,
    n_frames: usize,
) -> Result<(Scales, Vec<&'static str>), StoreError> {
    let train = dataset.phrases().iter().filter(|phrase| phrase.split == Split::Train);
    let windows: Vec<_> = train
        .flat_map(|phrase| {
            let n_windows = (phrase.n_frames / n_frames).max(1);
            (0..n_windows).map(move |k| (phrase, k * n_frames))
        })
        .collect();
    let gather = |width: usize, max_frames: usize, read: &dyn Fn(&Phrase, usize, usize) -> _| {
        // Evenly over all phrases where there are more than enough.
        let stride = (windows.len() * n_frames).div_ceil(max_frames).max(1);
        let mut values = Vec::new();
        for &(phrase, first) in windows.iter().step_by(stride) {
            let frames: Array2<f32> = read(phrase, first, n_frames.min(phrase.n_frames - first))?;
            values.extend(frames);
        }
        let shape = (values.len() / width, width);
        Ok::<_, StoreError>(
            Array2::from_shape_vec(shape, values).expect("whole frames were gathered"),
        )
    };
    let motion = gather(MOTION_DIM, MAX_FITTED_FRAMES, &|phrase, first, n| {
        let group = dataset.group(phrase, first, n)?;
        let mut dancers: Vec<_> = group.outer_iter().map(|dancer| dancer.to_owned()).collect();
        place(&mut dancers);
        let views: Vec<_> = dancers.iter().map(|motion| motion.view()).collect();
        Ok(concatenate(Axis(0), &views).expect("invariant: motions of one width"))
    })?;
    let features = gather(FEATURE_DIM, MAX_FITTED_FRAMES / 8, &|phrase, first, n| {
        dataset.features(phrase, first, n)
    })?;
    let (motion, constant) = Normalizer::fit(motion.view());
    Ok((Scales { motion, features: FeatureScale::fit(features.view()) }, constant))
}
