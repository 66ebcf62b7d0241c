//! One phrase: its files' contents become a row and a trajectory, or one failure.

use std::io::{Read as _, Seek as _};

use super::layout::Role;
use super::motion::{ReadMotion, read_dancers, read_group, read_motion};
use crate::audio::header::{AudioHeader, AudioHeaderError, read_header, read_header_from};
use crate::motion::style_name::{MAX_STYLE_NAME, is_style_name};
use crate::motion::text::text_of;
use crate::motion::{Axis, Beats, BeatsPerBarSource, CaptureAccount, ChannelLimits, Dancers};
use crate::stages::RARE;
use crate::stages::beats::{self, BeatSource};
use crate::stages::failure::{Failure, FailureKind};
use crate::stages::feature_file::read_features;
use crate::store::{Content, SourceFile, StoreError, digest, digest_of};
use crate::units::{FPS, frames_to_s, s_to_frames};

/// Largest motion, feature or beat file that is read, in bytes.
const MAX_FILE_BYTES: u64 = 1 << 30;

/// What makes a phrase acceptable; a change of these makes every phrase be read again.
#[derive(Clone, Copy, Debug, PartialEq, clap::Args, serde::Serialize)]
pub struct IngestRules {
    /// Which channel values a motion may have: `wide` allows ±20 rad/s of angular velocity, as real
    /// spins need; `reference` allows ±10 rad/s.
    #[arg(long, value_enum, value_name = "LIMITS", default_value_t = ChannelLimits::Wide,
          hide_short_help = RARE)]
    pub limits: ChannelLimits,
    /// Frames by which the lengths of motion, features and audio may differ.
    #[arg(long, value_name = "FRAMES", default_value_t = 1, hide_short_help = RARE)]
    pub length_tolerance_frames: u32,
    /// The axis that is up in motion captures [default: found, by the skeleton and its poses].
    #[arg(long, value_enum, value_name = "AXIS", allow_hyphen_values = true)]
    // Without it the rules are those of before: nothing is read again for it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub up: Option<Axis>,
}

/// A phrase that passed every check.
#[derive(Clone, Debug)]
pub struct CheckedPhrase {
    pub content_hash: String,
    /// Digest of the audio file, without audio of the feature file.
    pub song_hash: Option<String>,
    pub motion: Option<Dancers>,
    pub motion_format: Option<&'static str>,
    /// Of a motion capture, what was found out about it.
    pub capture: Option<CaptureAccount>,
    pub n_feature_frames: Option<usize>,
    pub audio: Option<AudioHeader>,
    pub tempo: Option<Tempo>,
    /// Those of a beat list.
    pub beats: Option<Beats>,
    pub has_beats: bool,
    /// Name of the style of the motion, as its file says.
    pub style_name: Option<String>,
}

/// Tempo and metre, with where each came from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tempo {
    pub bpm: f64,
    pub source: &'static str,
    pub beats_per_bar: Option<(u32, &'static str)>,
}

impl CheckedPhrase {
    /// Returns the length of the audio, else of the motion or the features.
    pub fn duration_s(&self) -> f64 {
        let n_frames = self.motion.as_ref().map(Dancers::n_frames).or(self.n_feature_frames);
        self.audio.as_ref().map_or_else(|| frames_to_s(n_frames.unwrap_or(0)), |a| a.duration_s)
    }

    /// Returns the frames of the motion, else of the features or of those that the audio will have.
    pub fn n_frames(&self) -> usize {
        let n_frames = self.motion.as_ref().map(Dancers::n_frames).or(self.n_feature_frames);
        n_frames.unwrap_or_else(|| s_to_frames(self.duration_s()).floor() as usize + 1)
    }

    /// Takes the motion that was read at a place, if it keeps the rules.
    fn take_motion(
        &mut self,
        place: &str,
        read: ReadMotion,
        rules: &IngestRules,
    ) -> Result<(), Failure> {
        let checked = match read.dancers.trajectories() {
            [soloist] => soloist.check(&rules.limits).map_err(|e| Failure::of(place, e.kind(), &e)),
            _ => read.dancers.check(&rules.limits).map_err(|e| Failure::of(place, e.kind(), &e)),
        };
        checked?;
        self.motion = Some(read.dancers);
        self.motion_format = Some(read.format);
        self.capture = read.account;
        Ok(())
    }
}

/// A phrase's files as they came from the source, digests first.
pub struct PhraseFiles {
    content_hash: String,
    song_hash: Option<String>,
    files: Vec<(Role, SourceFile, Content)>,
}

impl PhraseFiles {
    /// Takes the contents of a phrase's files and digests them.
    ///
    /// # Errors
    /// A [`Failure`] when a file could not be read.
    pub fn take(
        files: Vec<(Role, SourceFile, Result<Content, StoreError>)>,
    ) -> Result<Self, Failure> {
        let mut taken = Vec::with_capacity(files.len());
        let mut lines = String::new();
        let (mut of_audio, mut of_features) = (None, None);
        for (role, file, content) in files {
            let mut content = content.map_err(|e| unreadable(&file, &e))?;
            let hash = match &mut content {
                Content::Bytes(bytes) => digest(bytes),
                Content::File(file_content) => digest_of(file_content)
                    .and_then(|hash| file_content.rewind().map(|()| hash))
                    .map_err(|e| Failure::new(FailureKind::Unreadable, &file.path, e))?,
            };
            lines += &hash_line(role, &hash);
            match role {
                Role::Audio => of_audio = Some(hash),
                Role::Features => of_features = Some(hash),
                Role::Beats
                | Role::MotionNpy
                | Role::MotionCapture
                | Role::Dancer(_)
                | Role::Style => {}
            }
            taken.push((role, file, content));
        }
        let song_hash = of_audio.or(of_features);
        Ok(Self { content_hash: digest(lines.as_bytes()), song_hash, files: taken })
    }

    pub fn content_hash(&self) -> &str {
        &self.content_hash
    }

    /// Reads and checks the phrase.
    ///
    /// # Errors
    /// The first [`Failure`] in the order audio, beats, features, motion, then their lengths.
    pub fn check(self, rules: &IngestRules) -> Result<CheckedPhrase, Failure> {
        let mut phrase = CheckedPhrase {
            content_hash: self.content_hash,
            song_hash: self.song_hash,
            motion: None,
            motion_format: None,
            capture: None,
            n_feature_frames: None,
            audio: None,
            tempo: None,
            beats: None,
            has_beats: false,
            style_name: None,
        };
        let mut motion_path = String::new();
        let mut of_dancers: Vec<(String, bytes::Bytes)> = Vec::new();
        // Roles are sorted, so beats are known before the motion whose phase needs them.
        for (role, file, content) in self.files {
            let path = file.path.as_str();
            match role {
                Role::Audio => phrase.audio = Some(audio_header(path, content)?),
                Role::Beats => {
                    let read = read_beats(path, bytes_of(&file, content)?.as_ref())?;
                    phrase.tempo = Some(tempo_of(&read));
                    phrase.has_beats = true;
                    phrase.beats = Some(read);
                }
                Role::Features => {
                    let bytes = bytes_of(&file, content)?;
                    let features = read_features(path, &bytes, |_, _, _| {})?;
                    phrase.n_feature_frames = Some(features.n_frames);
                    phrase.has_beats |= !features.beat_times_s.is_empty();
                    let source = BeatSource::Features.name();
                    let tempo = |bpm| Tempo { bpm, source, beats_per_bar: None };
                    // A beat list beside the audio was written by somebody; a tracker's was not.
                    phrase.tempo = phrase.tempo.or(features.tempo_bpm.map(tempo));
                }
                Role::MotionNpy => {
                    let dancers = read_dancers(path, &bytes_of(&file, content)?)?;
                    let read = ReadMotion { dancers, format: "npy", account: None };
                    phrase.take_motion(path, read, rules)?;
                    path.clone_into(&mut motion_path);
                }
                Role::MotionCapture => {
                    let bytes = bytes_of(&file, content)?;
                    let read = read_motion(path, &bytes, phrase.beats.as_ref(), rules.up)?;
                    phrase.take_motion(path, read, rules)?;
                    path.clone_into(&mut motion_path);
                }
                Role::Style => {
                    phrase.style_name = Some(read_style_name(path, &bytes_of(&file, content)?)?);
                }
                Role::Dancer(_) => of_dancers.push((path.to_owned(), bytes_of(&file, content)?)),
            }
        }
        if let Some((first, _)) = of_dancers.first() {
            let folder = first.rsplit_once('/').map_or(first.as_str(), |(folder, _)| folder);
            let read = read_group(&of_dancers, phrase.beats.as_ref(), rules.up)?;
            phrase.take_motion(folder, read, rules)?;
            folder.clone_into(&mut motion_path);
        }
        check_lengths(&phrase, rules, &motion_path)?;
        Ok(phrase)
    }
}

/// One line of what a phrase's content hash is the digest of.
fn hash_line(role: Role, hash: &str) -> String {
    format!("{} {hash}\n", role.name())
}

/// Returns the content hash of a phrase that is an audio file with this digest and nothing else.
pub fn content_hash_of_audio(hash: &str) -> String {
    digest(hash_line(Role::Audio, hash).as_bytes())
}

fn check_lengths(
    phrase: &CheckedPhrase,
    rules: &IngestRules,
    motion_path: &str,
) -> Result<(), Failure> {
    let lengths = [
        ("audio", phrase.audio.as_ref().map(|a| a.duration_s)),
        ("features", phrase.n_feature_frames.map(frames_to_s)),
        ("motion", phrase.motion.as_ref().map(|m| frames_to_s(m.n_frames()))),
    ];
    let tolerance = rules.length_tolerance_frames;
    for (i, (a, a_s)) in lengths.iter().enumerate() {
        for (b, b_s) in &lengths[i + 1..] {
            let (Some(a_s), Some(b_s)) = (a_s, b_s) else { continue };
            // 1e-3: lengths are counted in samples, and a frame is no whole number of them.
            if s_to_frames((a_s - b_s).abs()) > f64::from(tolerance) + 1e-3 {
                let message = format!(
                    "{a} is {a_s:.2} s but {b} is {b_s:.2} s; they must agree within {tolerance} \
                     frame{} ({:.3} s)",
                    if tolerance == 1 { "" } else { "s" },
                    f64::from(tolerance) / FPS
                );
                return Err(Failure::new(FailureKind::LengthMismatch, motion_path, message));
            }
        }
    }
    Ok(())
}

fn unreadable(file: &SourceFile, error: &StoreError) -> Failure {
    let cause = std::error::Error::source(error).map(|e| format!(" ({e})")).unwrap_or_default();
    let message = format!("{error}{cause}");
    Failure::new(FailureKind::Unreadable, &file.path, message)
}

/// Returns a file's bytes, refusing what no phrase can be.
fn bytes_of(file: &SourceFile, content: Content) -> Result<bytes::Bytes, Failure> {
    if file.size_bytes > MAX_FILE_BYTES {
        let message = format!(
            "{} has {} bytes, more than the {MAX_FILE_BYTES} that are read; split the phrase",
            file.path, file.size_bytes
        );
        return Err(Failure::new(FailureKind::TooLarge, &file.path, message));
    }
    match content {
        Content::Bytes(bytes) => Ok(bytes),
        Content::File(mut open) => {
            let mut bytes = Vec::new();
            open.read_to_end(&mut bytes)
                .map_err(|e| Failure::new(FailureKind::Unreadable, &file.path, e))?;
            Ok(bytes.into())
        }
    }
}

fn audio_header(path: &str, content: Content) -> Result<AudioHeader, Failure> {
    let extension = path.rsplit_once('.').map_or("", |(_, extension)| extension);
    let read = match content {
        Content::Bytes(bytes) => read_header(&bytes, extension),
        Content::File(file) => read_header_from(file, extension),
    };
    read.map_err(|e: AudioHeaderError| Failure::of(path, e.kind(), &e))
}

/// Reads a beat list.
///
/// # Errors
/// A [`Failure`] that names the file.
pub(in crate::stages) fn read_beats(path: &str, bytes: &[u8]) -> Result<Beats, Failure> {
    let refuse = |message: &dyn std::fmt::Display| {
        Failure::new(FailureKind::BeatsFormat, path, format!("{path}: {message}"))
    };
    if bytes.is_empty() {
        let message = format!("{path} is empty; write one beat time in seconds per line");
        return Err(Failure::new(FailureKind::EmptyFile, path, message));
    }
    let (text, _) = text_of(bytes);
    let text = std::str::from_utf8(&text)
        .map_err(|_| refuse(&"is not UTF-8 text; write one beat time in seconds per line"))?;
    Beats::parse(text).map_err(|e| refuse(&e))
}

/// Reads the name of a style.
///
/// # Errors
/// A [`Failure`] that names the file.
fn read_style_name(path: &str, bytes: &[u8]) -> Result<String, Failure> {
    let refuse = |message: String| Failure::new(FailureKind::Layout, path, message);
    let (text, _) = text_of(bytes);
    let text = std::str::from_utf8(&text).map_err(|_| {
        refuse(format!("{path} is not UTF-8 text; write the name of one style in a line"))
    })?;
    let name = text.trim();
    if !is_style_name(name) {
        return Err(refuse(format!(
            "{path} has no name of a style; write one in a line: at most {MAX_STYLE_NAME} letters, digits, spaces, \
             -, _ and ', and no number",
        )));
    }
    Ok(name.to_owned())
}

fn tempo_of(list: &Beats) -> Tempo {
    let source = match list.beats_per_bar_source() {
        BeatsPerBarSource::Given | BeatsPerBarSource::Numbers => BeatSource::BeatsFile.name(),
        BeatsPerBarSource::Default => beats::DEFAULT,
    };
    let beats_per_bar = Some((list.beats_per_bar(), source));
    Tempo { bpm: list.tempo_bpm(), source: BeatSource::BeatsFile.name(), beats_per_bar }
}
