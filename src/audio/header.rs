//! Codec, sample rate, channels and duration of an audio file, without decoding it.
//!
//! Demuxing is symphonia's. Where the header has no sample count, or one that is an estimate or
//! does not fit the file, the duration comes from the packets' timestamps instead.

mod error;
#[cfg(test)]
mod tests;

use std::io::{self, Cursor, Read, Seek, SeekFrom};
use std::sync::LazyLock;

use symphonia::core::codecs::audio::well_known as codec;
use symphonia::core::codecs::audio::{AudioCodecId, AudioCodecParameters};
use symphonia::core::common::Limit;
use symphonia::core::formats::probe::{Hint, Probe, ProbeOptions};
use symphonia::core::formats::well_known::{
    FORMAT_ID_AIFF, FORMAT_ID_FLAC, FORMAT_ID_ISOMP4, FORMAT_ID_MP1, FORMAT_ID_MP2, FORMAT_ID_MP3,
    FORMAT_ID_OGG, FORMAT_ID_WAVE,
};
use symphonia::core::formats::{FormatId, FormatOptions, FormatReader, Track, TrackType};
use symphonia::core::io::{MediaSource, MediaSourceStream};
use symphonia::core::meta::MetadataOptions;

pub use error::AudioHeaderError;

/// Bytes without a known marker after which the search for one ends. Symphonia's own 1 MiB lets
/// chance pairs of MPEG sync words turn one in twenty random files into audio.
const MAX_PROBE_BYTES: u32 = 64 * 1024;

/// Bytes at the start of a file that messages and checks look at.
const HEAD_BYTES: u64 = 4096;

static PROBE: LazyLock<Probe> = LazyLock::new(|| {
    let options = ProbeOptions { max_probe_depth: MAX_PROBE_BYTES, ..ProbeOptions::default() };
    let mut probe = Probe::new_with_options(&options);
    symphonia::default::register_enabled_formats(&mut probe);
    probe
});

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
    let survey = Survey::of(&mut input).map_err(|e| error::broken_input(&e))?;
    if survey.n_bytes == 0 {
        return Err(AudioHeaderError::Empty);
    }
    if let Some(error) = error::other_format(&survey.head) {
        return Err(error);
    }
    let n_bytes = survey.n_bytes;
    let mut reader = open(input, &survey, extension_hint)?;
    let info = reader.format_info();
    let (format, container) = (info.format, container_name(info.short_name));
    if !starts_as(format, &survey.head) {
        return Err(error::unknown(&survey.head, extension_hint));
    }
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
        FORMAT_ID_WAVE | FORMAT_ID_AIFF => whole(&track, frame_bytes, n_bytes),
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
                // Symphonia's packets would miss up to 1,151 frames at the end.
                Some(size) if format == FORMAT_ID_WAVE => survey.wav_data_bytes.map(|n| n / size),
                _ => None,
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

/// What can be told of a file without knowing its format.
struct Survey {
    /// The first bytes.
    head: Vec<u8>,
    n_bytes: u64,
    /// Bytes from the start of a WAV file's `data` chunk to the end of the file.
    wav_data_bytes: Option<u64>,
}

impl Survey {
    fn of(input: &mut (impl Read + Seek)) -> io::Result<Self> {
        let n_bytes = input.seek(SeekFrom::End(0))?;
        input.rewind()?;
        let mut head = Vec::new();
        input.take(HEAD_BYTES).read_to_end(&mut head)?;
        let wav_data_bytes = match head.get(..4) {
            Some(b"RIFF") => wav_data_bytes(input, n_bytes)?,
            _ => None,
        };
        input.rewind()?;
        Ok(Self { head, n_bytes, wav_data_bytes })
    }
}

/// Finds the `data` chunk of a WAV file and returns the bytes from its content to the end.
fn wav_data_bytes(input: &mut (impl Read + Seek), n_bytes: u64) -> io::Result<Option<u64>> {
    let mut chunk_start = 12;
    // A chunk has a head of 8 bytes, so the walk ends after at most n_bytes / 8 steps.
    while chunk_start + 8 <= n_bytes {
        input.seek(SeekFrom::Start(chunk_start))?;
        let mut head = [0; 8];
        input.read_exact(&mut head)?;
        let [id @ .., s0, s1, s2, s3] = head;
        if id == *b"data" {
            return Ok(Some(n_bytes - chunk_start - 8));
        }
        let size = u64::from(u32::from_le_bytes([s0, s1, s2, s3]));
        // Chunks start at even offsets.
        chunk_start += 8 + size + size % 2;
    }
    Ok(None)
}

/// A reader as symphonia takes it.
struct Media<R> {
    input: R,
    n_bytes: u64,
}

impl<R: Read> Read for Media<R> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        self.input.read(bytes)
    }
}

impl<R: Seek> Seek for Media<R> {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        self.input.seek(position)
    }
}

impl<R: Read + Seek + Send + Sync> MediaSource for Media<R> {
    fn is_seekable(&self) -> bool {
        true
    }

    fn byte_len(&self) -> Option<u64> {
        Some(self.n_bytes)
    }
}

fn open<'a>(
    input: impl Read + Seek + Send + Sync + 'a,
    survey: &Survey,
    extension_hint: &str,
) -> Result<Box<dyn FormatReader + 'a>, AudioHeaderError> {
    let media = Media { input, n_bytes: survey.n_bytes };
    let stream = MediaSourceStream::new(Box::new(media), Default::default());
    let mut hint = Hint::new();
    if !extension_hint.is_empty() {
        hint.with_extension(extension_hint);
    }
    // Cover pictures can be megabytes and nobody looks at them here.
    let metadata = MetadataOptions::default().limit_visual_bytes(Limit::Maximum(0));
    PROBE
        .probe(&hint, stream, FormatOptions::default(), metadata)
        .map_err(|error| error::unreadable(&survey.head, survey.n_bytes, extension_hint, &error))
}

/// Whether the marker that symphonia found is where it belongs, not somewhere inside a file of
/// another format. Only MPEG streams occur with other bytes before them.
fn starts_as(format: FormatId, bytes: &[u8]) -> bool {
    let marker = match format {
        FORMAT_ID_WAVE => bytes.get(..4) == Some(b"RIFF"),
        FORMAT_ID_AIFF => bytes.get(..4) == Some(b"FORM"),
        FORMAT_ID_FLAC => bytes.get(..4) == Some(b"fLaC"),
        FORMAT_ID_OGG => bytes.get(..4) == Some(b"OggS"),
        FORMAT_ID_ISOMP4 => bytes.get(4..8) == Some(b"ftyp"),
        _ => true,
    };
    marker || bytes.starts_with(b"ID3")
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
fn whole(track: &Track, frame_bytes: Option<u64>, file_bytes: u64) -> Option<f64> {
    let n_frames = track.num_frames?;
    if n_frames.saturating_mul(frame_bytes.unwrap_or(0)) > file_bytes {
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

fn container_name(symphonia_name: &str) -> &'static str {
    match symphonia_name {
        "wave" | "wav" => "wav",
        "aiff" => "aiff",
        "flac" => "flac",
        "mp1" => "mp1",
        "mp2" => "mp2",
        "mp3" => "mp3",
        "ogg" => "ogg",
        "isomp4" => "mp4",
        "aac" | "adts" => "adts",
        _ => "audio",
    }
}

/// Bytes of one frame, all channels, of an uncompressed codec.
fn pcm_frame_bytes(id: AudioCodecId, n_channels: u16) -> Option<u64> {
    let name = codec_name(id).strip_prefix("pcm_")?;
    let sample_bytes = match name.get(1..3)? {
        "64" => 8,
        "32" => 4,
        "24" => 3,
        "16" => 2,
        _ => 1,
    };
    Some(sample_bytes * u64::from(n_channels))
}

fn codec_name(id: AudioCodecId) -> &'static str {
    match id {
        codec::CODEC_ID_PCM_U8 => "pcm_u8",
        codec::CODEC_ID_PCM_S8 => "pcm_s8",
        codec::CODEC_ID_PCM_S16LE => "pcm_s16le",
        codec::CODEC_ID_PCM_S16BE => "pcm_s16be",
        codec::CODEC_ID_PCM_S24LE => "pcm_s24le",
        codec::CODEC_ID_PCM_S24BE => "pcm_s24be",
        codec::CODEC_ID_PCM_S32LE => "pcm_s32le",
        codec::CODEC_ID_PCM_S32BE => "pcm_s32be",
        codec::CODEC_ID_PCM_F32LE => "pcm_f32le",
        codec::CODEC_ID_PCM_F32BE => "pcm_f32be",
        codec::CODEC_ID_PCM_F64LE => "pcm_f64le",
        codec::CODEC_ID_PCM_F64BE => "pcm_f64be",
        codec::CODEC_ID_PCM_ALAW => "pcm_alaw",
        codec::CODEC_ID_PCM_MULAW => "pcm_mulaw",
        codec::CODEC_ID_ADPCM_MS => "adpcm_ms",
        codec::CODEC_ID_ADPCM_IMA_WAV => "adpcm_ima_wav",
        codec::CODEC_ID_ADPCM_IMA_QT => "adpcm_ima_qt",
        codec::CODEC_ID_MP1 => "mp1",
        codec::CODEC_ID_MP2 => "mp2",
        codec::CODEC_ID_MP3 => "mp3",
        codec::CODEC_ID_AAC => "aac",
        codec::CODEC_ID_AC3 => "ac3",
        codec::CODEC_ID_ALAC => "alac",
        codec::CODEC_ID_FLAC => "flac",
        codec::CODEC_ID_OPUS => "opus",
        codec::CODEC_ID_SPEEX => "speex",
        codec::CODEC_ID_VORBIS => "vorbis",
        _ => "unknown",
    }
}
