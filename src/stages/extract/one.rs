//! One phrase: its audio, or else its feature file, becomes features.

use std::io::{self, Cursor, Read as _, Seek as _};
use std::time::{Duration, Instant};

use ndarray::{Array2, s};

use crate::audio::decode::Loss;
use crate::audio::recording::{Encoding, MAX_HELD_SAMPLES, Options, Recording};
use crate::audio::{BLOCKS, FEATURE_DIM, Tuning};
use crate::motion::Beats;
use crate::stages::beats::BeatSource;
use crate::stages::failure::{Failure, FailureKind, guarded};
use crate::stages::feature_file::read_features;
use crate::store::{Content, SourceFile, StoreError, digest, digest_of};
use crate::units::{frames_to_s, s_to_frames};

/// Settings of the extraction, the same for every phrase.
#[derive(Clone, Copy, Debug)]
pub struct ExtractRules {
    /// Fixes the tuning that would be estimated.
    pub tuning: Option<Tuning>,
    /// Longest audio, in seconds.
    pub max_duration_s: f64,
    /// Longest time for one file.
    pub timeout: Duration,
}

/// The source of a phrase's features.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    Audio,
    FeatureFile,
}

impl Origin {
    /// Returns where beats that come with the features came from.
    pub fn beat_source(self) -> BeatSource {
        match self {
            Origin::Audio => BeatSource::Tracker,
            Origin::FeatureFile => BeatSource::Features,
        }
    }

    pub fn name(self) -> &'static str {
        match self {
            Origin::Audio => "audio",
            Origin::FeatureFile => "feature_file",
        }
    }
}

/// A phrase's features.
#[derive(Clone, Debug, PartialEq)]
pub struct ExtractedFeatures {
    pub origin: Origin,
    /// [T, 163].
    pub frames: Array2<f32>,
    /// librosa's, as it belongs to the features.
    pub tempo_bpm: Option<f64>,
    /// Frame and time of every beat, librosa's as well.
    pub beats: Vec<(usize, f64)>,
    /// Time of every beat that motion follows, s, and its number in the bar if known.
    pub pulse: Vec<(f64, Option<i64>)>,
    /// None for features that were read from a file.
    pub audio: Option<AudioFacts>,
}

/// Facts that are known of audio only, not of a feature file.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AudioFacts {
    pub n_samples: u64,
    pub tuning: Tuning,
    /// `estimated` or `given`.
    pub tuning_source: &'static str,
    pub encoding: Encoding,
    pub loss: Loss,
}

impl ExtractedFeatures {
    /// Returns how many seconds of the audio are missing at an end before the stated one, or could
    /// not be decoded.
    pub fn lost_s(&self) -> f64 {
        self.audio.map_or(0.0, |heard| heard.loss.lost_s)
    }

    /// Returns the beats that motion follows, in their bars; none for too few.
    pub fn counted_beats(&self) -> Option<Beats> {
        let (times_s, numbers): (Vec<f64>, Vec<Option<i64>>) = self.pulse.iter().copied().unzip();
        Beats::new(times_s, numbers.into_iter().collect(), None).ok()
    }

    /// Returns the length of the audio, or of the frames.
    pub fn duration_s(&self) -> f64 {
        self.audio.map_or_else(
            || frames_to_s(self.frames.nrows()),
            |heard| heard.n_samples as f64 / f64::from(crate::audio::SAMPLE_RATE_HZ),
        )
    }
}

/// Bytes of a work in progress that do not depend on the file.
const BASE_BYTES: u64 = 24 << 20;
/// Bytes per frame: two sets of mel bands, the features, what follows from them, and three times a third of a frame
/// of the spectra and envelopes in which beats are found.
const FRAME_BYTES: u64 = 2048 + 1024;

/// Returns an estimate of the memory that a file of `duration_s` takes while it is worked on.
pub fn needed_bytes(duration_s: f64, file_bytes: u64) -> u64 {
    let n_samples = (duration_s * f64::from(crate::audio::SAMPLE_RATE_HZ)) as u64;
    let held = n_samples.min(MAX_HELD_SAMPLES as u64) * size_of::<f32>() as u64;
    let frames = s_to_frames(duration_s) as u64 * FRAME_BYTES;
    // Larger files are read as they are decoded.
    BASE_BYTES + held + frames + file_bytes.min(16 << 20)
}

/// Turns the content of a file into features; a defect of ours costs the file, not the job.
///
/// `is_as_recorded` is asked about the content's digest.
///
/// # Errors
/// A [`Failure`] that names the file.
pub fn extract(
    origin: Origin,
    file: &SourceFile,
    content: Result<Content, StoreError>,
    is_as_recorded: impl FnOnce(&str) -> bool,
    rules: &ExtractRules,
) -> Result<ExtractedFeatures, Failure> {
    let path = file.path.as_str();
    let mut content = content.map_err(|e| {
        let cause = std::error::Error::source(&e).map(|e| format!(" ({e})")).unwrap_or_default();
        Failure::new(FailureKind::Unreadable, path, format!("{e}{cause}"))
    })?;
    check_size(file, &content)?;
    if !is_as_recorded(&hash_of(path, &mut content)?) {
        let message = format!(
            "{path}: has other content than when it was looked at; run ingest again, then extract"
        );
        return Err(Failure::new(FailureKind::Changed, path, message));
    }
    guarded(path, || match origin {
        Origin::Audio => from_audio(path, content, rules),
        Origin::FeatureFile => from_feature_file(path, content),
    })
}

/// Refuses a file that is not the one that the table speaks of.
fn check_size(file: &SourceFile, content: &Content) -> Result<(), Failure> {
    let unreadable = |e: io::Error| Failure::new(FailureKind::Unreadable, &file.path, e);
    let found = match content {
        Content::Bytes(bytes) => bytes.len() as u64,
        Content::File(open) => open.metadata().map_err(unreadable)?.len(),
    };
    if found == file.size_bytes {
        return Ok(());
    }
    let message = format!(
        "{}: has {found} bytes but had {} when it was looked at; run ingest again, then extract",
        file.path, file.size_bytes
    );
    Err(Failure::new(FailureKind::Changed, &file.path, message))
}

fn hash_of(path: &str, content: &mut Content) -> Result<String, Failure> {
    match content {
        Content::Bytes(bytes) => Ok(digest(bytes)),
        Content::File(open) => digest_of(open)
            .and_then(|hash| open.rewind().map(|()| hash))
            .map_err(|e| Failure::new(FailureKind::Unreadable, path, e)),
    }
}

fn from_audio(
    path: &str,
    content: Content,
    rules: &ExtractRules,
) -> Result<ExtractedFeatures, Failure> {
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    let started = Instant::now();
    let options = Options {
        tuning: rules.tuning,
        max_duration_s: rules.max_duration_s,
        is_late: &|| started.elapsed() > rules.timeout,
        max_held_samples: MAX_HELD_SAMPLES,
    };
    let recording = match content {
        Content::Bytes(bytes) => {
            Recording::analyse(|| Ok(Cursor::new(bytes.as_ref())), extension, &options)
        }
        Content::File(file) => {
            let open = || (&file).rewind().map(|()| &file);
            Recording::analyse(open, extension, &options)
        }
    };
    let Recording { raw, meter, encoding, loss } =
        recording.map_err(|e| Failure::of(path, e.kind(), &e))?;
    let features = raw.normalize();
    let beats = features.rhythm.beat_frames.iter().map(|&frame| (frame, frames_to_s(frame)));
    Ok(ExtractedFeatures {
        origin: Origin::Audio,
        tempo_bpm: Some(features.rhythm.tempo_bpm).filter(|&bpm| bpm > 0.0),
        beats: beats.collect(),
        pulse: meter.numbered().collect(),
        audio: Some(AudioFacts {
            n_samples: features.n_samples,
            tuning: features.tuning,
            tuning_source: if rules.tuning.is_some() { "given" } else { "estimated" },
            encoding,
            loss,
        }),
        frames: features.frames,
    })
}

fn from_feature_file(path: &str, content: Content) -> Result<ExtractedFeatures, Failure> {
    let bytes = match content {
        Content::Bytes(bytes) => bytes,
        Content::File(mut open) => {
            let mut bytes = Vec::new();
            open.read_to_end(&mut bytes)
                .map_err(|e| Failure::new(FailureKind::Unreadable, path, e))?;
            bytes.into()
        }
    };
    let mut frames = Array2::zeros((0, FEATURE_DIM));
    let file = read_features(path, &bytes, |block, values, n_frames| {
        if frames.nrows() != n_frames {
            frames = Array2::zeros((n_frames, FEATURE_DIM));
        }
        let first: usize = BLOCKS.iter().take_while(|b| **b != block).map(|b| b.len).sum();
        let mut columns = frames.slice_mut(s![.., first..first + block.len]);
        for (mut column, row) in columns.columns_mut().into_iter().zip(values.chunks(n_frames)) {
            column.iter_mut().zip(row).for_each(|(to, from)| *to = *from);
        }
    })?;
    let last = file.n_frames.saturating_sub(1);
    let frame = |time_s: f64| (s_to_frames(time_s).round() as usize).min(last);
    let beats = file.beat_times_s.iter().map(|&time_s| (frame(time_s), time_s)).collect();
    let pulse = file.beat_times_s.iter().map(|&time_s| (time_s, None)).collect();
    Ok(ExtractedFeatures {
        origin: Origin::FeatureFile,
        frames,
        tempo_bpm: file.tempo_bpm,
        beats,
        pulse,
        audio: None,
    })
}
