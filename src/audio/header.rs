//! Codec, sample rate, channels and duration of an audio file, without decoding it.
//!
//! Demuxing is symphonia's. Where the header has no sample count, or one that is an estimate or
//! does not fit the file, the duration comes from the packets' timestamps instead.

mod error;
pub(super) mod media;
#[cfg(test)]
mod tests;

use std::io::{Cursor, Read, Seek};

use symphonia::core::codecs::audio::AudioCodecParameters;
use symphonia::core::codecs::audio::well_known as codec;
use symphonia::core::formats::well_known::{
    FORMAT_ID_AIFF, FORMAT_ID_FLAC, FORMAT_ID_ISOMP4, FORMAT_ID_MP1, FORMAT_ID_MP2, FORMAT_ID_MP3,
    FORMAT_ID_OGG, FORMAT_ID_WAVE,
};
use symphonia::core::formats::{FormatReader, Track, TrackType};

pub use error::AudioHeaderError;
use media::{Survey, codec_name, container_name, pcm_frame_bytes};

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
    /// `wav`, `aiff`, `flac`, `mp3`, `ogg`, `mp4` or `adts`.
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

/// Reads the header of a WAV, AIFF, FLAC, MP3, Ogg, MP4 or ADTS file, of any size.
///
/// The content decides; `extension_hint` (no dot, may be empty) only completes messages. In an
/// MP3 without a LAME tag, an ADTS file and a PCM file shorter than it declares, the duration is
/// counted from the packets. Errors: [`AudioHeaderError`].
pub fn read_header_from(
    mut input: impl Read + Seek + Send + Sync,
    extension_hint: &str,
) -> Result<AudioHeader, AudioHeaderError> {
    let survey = Survey::of(&mut input)?;
    let n_bytes = survey.n_bytes;
    let mut reader = media::open(input, &survey, extension_hint)?;
    let info = reader.format_info();
    let (format, container) = (info.format, container_name(info.short_name));
    let track = reader
        .default_track(TrackType::Audio)
        .or_else(|| reader.first_track(TrackType::Audio))
        .cloned()
        .ok_or(AudioHeaderError::NoAudioTrack { container })?;
    let Some(params) = track.codec_params.as_ref().and_then(|params| params.audio()) else {
        return Err(AudioHeaderError::NoAudioTrack { container });
    };
    let codec = codec_name(params.codec);
    let sample_rate_hz = params.sample_rate.unwrap_or(0);
    if sample_rate_hz == 0 {
        return Err(AudioHeaderError::NoSampleRate { container, codec });
    }
    let n_channels = params.channels.as_ref().map_or(0, |channels| channels.count());
    let n_channels = u16::try_from(n_channels).unwrap_or(0);
    if n_channels == 0 {
        return Err(AudioHeaderError::NoChannels { container, codec });
    }

    let frame_bytes = pcm_frame_bytes(params.codec, n_channels);
    let stated = match format {
        FORMAT_ID_WAVE | FORMAT_ID_AIFF => {
            whole(&track, frame_bytes, survey.pcm_data_bytes.unwrap_or(n_bytes))
        }
        FORMAT_ID_FLAC | FORMAT_ID_OGG => stated_duration_s(&track, params),
        FORMAT_ID_ISOMP4 => edited_duration_s(reader.as_ref(), &track, params),
        // Without a LAME tag symphonia extrapolates from the first frames' bit rate.
        FORMAT_ID_MP1 | FORMAT_ID_MP2 | FORMAT_ID_MP3 if track.delay.is_some() => {
            stated_duration_s(&track, params)
        }
        _ => None,
    };
    let (duration_s, duration_source) = match stated {
        Some(duration_s) => (duration_s, DurationSource::Header),
        None => {
            let n_frames = match frame_bytes {
                // Symphonia's packets would go on into the zeros behind the file.
                Some(size) => survey.pcm_data_bytes.map(|n| n / size),
                None => None,
            };
            let duration_s = match n_frames {
                Some(n_frames) => n_frames as f64 / f64::from(sample_rate_hz),
                None => counted_duration_s(reader.as_mut(), &track, n_bytes),
            };
            (duration_s, DurationSource::Packets)
        }
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

fn stated_duration_s(track: &Track, params: &AudioCodecParameters) -> Option<f64> {
    match (track.num_frames, params.sample_rate, track.duration, track.time_base) {
        (Some(n_frames), Some(rate_hz), ..) => {
            // Ogg's last timestamp counts Opus' pre-skip (RFC 7845 section 4.3).
            let delay = match params.codec {
                codec::CODEC_ID_OPUS => u64::from(track.delay.unwrap_or(0)),
                _ => 0,
            };
            Some(n_frames.saturating_sub(delay) as f64 / f64::from(rate_hz))
        }
        (None, _, Some(duration), Some(time_base)) => {
            Some(time_base.calc_duration(duration)?.as_secs_f64())
        }
        _ => None,
    }
}

/// The track's duration, shortened to the whole file's where that is shorter: only the latter has
/// the edit list applied, which cuts the encoder's delay (ISO/IEC 14496-12 section 8.6.6).
fn edited_duration_s(
    reader: &dyn FormatReader,
    track: &Track,
    params: &AudioCodecParameters,
) -> Option<f64> {
    let track_s = stated_duration_s(track, params).filter(|&duration_s| duration_s > 0.0)?;
    let info = reader.media_info();
    let file_s = match (info.time_base, info.duration) {
        (Some(time_base), Some(duration)) => time_base.calc_duration(duration)?.as_secs_f64(),
        _ => 0.0,
    };
    // A fragmented file states 0.
    Some(if file_s > 0.0 { track_s.min(file_s) } else { track_s })
}

/// The stated duration of an uncompressed file, unless its samples would not fit the file, as
/// when it was cut short or streamed with a placeholder for its length.
fn whole(track: &Track, frame_bytes: Option<u64>, n_bytes: u64) -> Option<f64> {
    let n_frames = track.num_frames?;
    if n_frames.saturating_mul(frame_bytes.unwrap_or(0)) > n_bytes {
        return None;
    }
    stated_duration_s(track, track.codec_params.as_ref()?.audio()?)
}

/// Time from the first packet's start to the last one's end. Timestamps rather than a sum of
/// durations, because symphonia 0.6.1 does not trim the durations as it documents.
fn counted_duration_s(reader: &mut dyn FormatReader, track: &Track, file_bytes: u64) -> f64 {
    let Some(time_base) = track.time_base else { return 0.0 };
    let (mut first, mut end) = (None, 0);
    // No codec has packets below one byte, so more of them than bytes means a loop.
    for _ in 0..=file_bytes {
        // An error ends what can be played as surely as the end does.
        let Ok(Some(packet)) = reader.next_packet() else { break };
        if packet.track_id == track.id {
            let start = packet.pts.get();
            first.get_or_insert(start);
            end = end.max(start.saturating_add_unsigned(packet.dur.get()));
        }
    }
    let ticks = first.map_or(0, |first| i64::saturating_sub(end, first));
    ticks.max(0) as f64 * f64::from(time_base.numer.get()) / f64::from(time_base.denom.get())
}
