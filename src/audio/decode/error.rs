//! What can be wrong with audio data, each as one sentence.

use crate::audio::header::AudioHeaderError;

/// Why a file's samples could not be decoded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The file or its header.
    #[error(transparent)]
    Header(#[from] AudioHeaderError),
    /// The file could not be read on.
    #[error(
        "audio file could not be read on at {time_s:.2} s ({reason}); check the disk and try again"
    )]
    Input { time_s: f64, reason: String },
    /// A codec that is known, with parameters that are not.
    #[error(
        "{codec} stream cannot be decoded ({reason}); convert it, for example with: \
         ffmpeg -i in.{extension} out.flac"
    )]
    UnsupportedStream { codec: &'static str, extension: &'static str, reason: String },
    /// Data that breaks its codec's rules, with intact data after it.
    #[error("{codec} data is damaged at {time_s:.2} s ({reason}); re-encode or restore the file")]
    Damaged { codec: &'static str, time_s: f64, reason: String },
    /// More of a stream lost than can pass for a glitch.
    #[error(
        "{codec} data is damaged at {time_s:.2} s, and {lost_s:.2} s of it cannot be decoded; \
         re-encode or restore the file"
    )]
    Lost { codec: &'static str, time_s: f64, lost_s: f64 },
    /// Two sample rates in one file.
    #[error(
        "sample rate changes from {from_hz} Hz to {to_hz} Hz at {time_s:.2} s; split the file \
         there, or convert it, for example with: ffmpeg -i in.{extension} -ar {from_hz} out.flac"
    )]
    RateChange { from_hz: u32, to_hz: u32, time_s: f64, extension: &'static str },
    /// A floating-point sample that is no number.
    #[error(
        "sample at {time_s:.3} s is {value}; samples must be finite, export the file again, for \
         example as 16-bit integers"
    )]
    NotFinite { time_s: f64, value: &'static str },
    /// A stream without samples.
    #[error(
        "{codec} stream at {sample_rate_hz} Hz holds 0 samples; the recording or conversion that \
         made the file failed, make it again"
    )]
    NoSamples { codec: &'static str, sample_rate_hz: u32 },
    /// Packets without end and without samples.
    #[error(
        "{codec} data gives no samples after {time_s:.2} s, in {n_packets} packets; re-encode or \
         restore the file"
    )]
    NoProgress { codec: &'static str, time_s: f64, n_packets: u64 },
}

impl DecodeError {
    /// The error's class in reports: `audio_header`, `empty_file`, `audio_codec`, `audio_data`,
    /// `audio_sample_rate`, `audio_not_finite` or `audio_no_samples`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Header(error) => error.kind(),
            Self::UnsupportedStream { .. } => "audio_codec",
            Self::Input { .. }
            | Self::Damaged { .. }
            | Self::Lost { .. }
            | Self::NoProgress { .. } => "audio_data",
            Self::RateChange { .. } => "audio_sample_rate",
            Self::NotFinite { .. } => "audio_not_finite",
            Self::NoSamples { .. } => "audio_no_samples",
        }
    }
}
