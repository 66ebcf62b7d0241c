//! Codec, sample rate, channels and duration of an audio file, without decoding it.
//!
//! Where the header has no sample count, or one that is an estimate or does not fit the file, the
//! duration comes from the frames or the packets' timestamps instead.

pub(super) mod error;
#[cfg(test)]
mod tests;

use std::io::{Cursor, Read, Seek};

use super::container::{Opened, Stream};
pub use error::AudioHeaderError;

/// Where a duration comes from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DurationSource {
    /// The sample count that the container states.
    Header,
    /// The packets present in the file.
    Packets,
}

/// What an audio file says of itself.
#[derive(Debug, Clone, PartialEq)]
pub struct AudioHeader {
    /// FFmpeg's short name: `pcm_s16le`, `flac`, `mp3`, `vorbis`, `opus`, `aac` and so on.
    pub codec: String,
    /// `wav`, `w64`, `aiff`, `au`, `caf`, `flac`, `mp3`, `ogg`, `mp4` or `adts`.
    pub container: String,
    pub sample_rate_hz: u32,
    pub n_channels: u16,
    /// Without encoder delay and padding where the container states them.
    pub duration_s: f64,
    pub duration_source: DurationSource,
}

/// Reads the header of an audio file held in memory; see [`read_header_from`].
pub fn read_header(bytes: &[u8], extension_hint: &str) -> Result<AudioHeader, AudioHeaderError> {
    read_header_from(Cursor::new(bytes), extension_hint)
}

/// Reads the header of a WAV, AIFF, AU, CAF, FLAC, MP3, Ogg, MP4 or ADTS file, of any size.
///
/// The content decides; `extension_hint` (no dot, may be empty) only completes messages. In an
/// MP3 without a LAME tag, an ADTS file and a PCM file shorter than it declares, the duration is
/// counted from the packets. Errors: [`AudioHeaderError`].
pub fn read_header_from(
    input: impl Read + Seek + Send + Sync,
    extension_hint: &str,
) -> Result<AudioHeader, AudioHeaderError> {
    let opened = Opened::open(input, extension_hint)?;
    let Opened { container, codec, sample_rate_hz, n_channels, n_bytes, .. } = opened;
    let (duration_s, duration_source) = match (opened.n_present, opened.stream) {
        (Some(n_samples), _) => {
            let source =
                if opened.is_as_stated { DurationSource::Header } else { DurationSource::Packets };
            (n_samples as f64 / f64::from(sample_rate_hz), source)
        }
        (None, Stream::Packets(mut packets)) => {
            (packets.counted_duration_s(n_bytes), DurationSource::Packets)
        }
        (None, Stream::Pcm(_) | Stream::Mpeg(_)) => (0.0, DurationSource::Packets),
    };
    if duration_s <= 0.0 {
        return Err(AudioHeaderError::NoSamples { container, codec, sample_rate_hz });
    }
    Ok(AudioHeader {
        codec: codec.to_owned(),
        container: container.to_owned(),
        sample_rate_hz,
        n_channels,
        duration_s,
        duration_source,
    })
}
