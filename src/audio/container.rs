//! Audio files opened: the one place that says what is supported, how long a file is and which of
//! its samples are to be played. Headers and decoders both start here, so that they agree.

mod aac;
mod edits;
mod flac;
pub(in crate::audio) mod media;
pub(in crate::audio) mod mpeg;
mod ogg;
#[cfg(test)]
mod tests;

use std::collections::VecDeque;
use std::io::{Read, Seek};

use symphonia::core::codecs::audio::well_known as codec;
use symphonia::core::codecs::audio::{AudioCodecId, AudioCodecParameters};
use symphonia::core::errors::Error;
use symphonia::core::formats::well_known::{
    FORMAT_ID_CAF, FORMAT_ID_FLAC, FORMAT_ID_ISOMP4, FORMAT_ID_OGG,
};
use symphonia::core::formats::{FormatReader, Track, TrackType};
use symphonia::core::packet::Packet;

use super::header::AudioHeaderError;
use super::header::error;
use super::pcm::{Layout, Payload, Samples, valid_frames};
pub(in crate::audio) use edits::Edits;
pub(in crate::audio) use flac::{FRAMES_START as FLAC_FRAMES_START, possible_frame};
use media::{Section, Survey, codec_name, container_name};
use mpeg::Frames;

/// Packets in which what the header does not say of a stream is looked for.
const N_PEEKED: usize = 16;

/// Where samples come from.
pub(in crate::audio) enum Stream<'a> {
    Pcm(Samples<Section<'a>>),
    Mpeg(Frames<'a>),
    Packets(Box<Packets<'a>>),
}

/// The packets of a container's audio track.
pub(in crate::audio) struct Packets<'a> {
    pub reader: Box<dyn FormatReader + 'a>,
    pub track: Track,
    pub params: AudioCodecParameters,
    /// Packets that were looked at and are still to be given.
    peeked: VecDeque<Result<Option<Packet>, Error>>,
}

impl Packets<'_> {
    /// Returns the next packet of any track.
    pub fn next(&mut self) -> Result<Option<Packet>, Error> {
        match self.peeked.pop_front() {
            Some(answer) => answer,
            None => self.reader.next_packet(),
        }
    }

    /// Time from the first packet's start to the last one's end. Timestamps rather than a sum of
    /// durations, because symphonia 0.6.1 does not trim the durations as it documents.
    pub fn counted_duration_s(&mut self, file_bytes: u64) -> f64 {
        let Some(time_base) = self.track.time_base else { return 0.0 };
        let (mut first, mut end) = (None, 0);
        // No codec has packets below one byte, so more of them than bytes means a loop.
        for _ in 0..=file_bytes {
            // An error ends what can be played as surely as the end does.
            let Ok(Some(packet)) = self.next() else { break };
            if packet.track_id == self.track.id {
                let start = packet.pts.get();
                first.get_or_insert(start);
                end = end.max(start.saturating_add_unsigned(packet.dur.get()));
            }
        }
        let ticks = first.map_or(0, |first| i64::saturating_sub(end, first));
        ticks.max(0) as f64 * f64::from(time_base.numer.get()) / f64::from(time_base.denom.get())
    }
}

/// An audio file, opened.
pub(in crate::audio) struct Opened<'a> {
    pub container: &'static str,
    pub codec: &'static str,
    pub sample_rate_hz: u32,
    pub n_channels: u16,
    /// Samples that the file's headers leave to play and that are in the file, where that can be
    /// told without reading packets.
    pub n_present: Option<u64>,
    /// Samples to play that the file states, whether they are there or not.
    pub n_stated: Option<u64>,
    /// Whether `n_present` is as the header states, not counted.
    pub is_as_stated: bool,
    /// The first decoded sample to give, and the one after the last.
    pub kept: (u64, u64),
    pub stream: Stream<'a>,
    pub n_bytes: u64,
}

impl<'a> Opened<'a> {
    /// Opens a file of any kind that is read.
    ///
    /// The content decides; `extension_hint` (no dot, may be empty) only completes messages.
    ///
    /// # Errors
    /// [`AudioHeaderError`].
    pub fn open(
        mut input: impl Read + Seek + Send + Sync + 'a,
        extension_hint: &str,
    ) -> Result<Self, AudioHeaderError> {
        let survey = Survey::of(&mut input)?;
        let (start, n_bytes) = (survey.start, survey.n_bytes);
        let layout = Layout::read(&mut input, &survey.marker, start, n_bytes);
        if let Some(layout) = layout.map_err(|e| error::broken_header(&survey, &e))? {
            return uncompressed(input, &layout, &survey);
        }
        if media::may_be_mpeg(&survey) {
            let n_left = n_bytes - start;
            let section = Section::new(Box::new(&mut input), Vec::new(), start, n_left);
            if Frames::is_in(section).map_err(|e| error::broken_input(&e))? {
                let section = Section::new(Box::new(input), Vec::new(), start, n_left);
                return mpeg_stream(section, "mp3", &survey);
            }
        }
        packets(input, &survey, extension_hint)
    }
}

/// Opens the samples of an uncompressed file, or the MPEG stream in it.
fn uncompressed<'a>(
    input: impl Read + Seek + Send + Sync + 'a,
    layout: &Layout,
    survey: &Survey,
) -> Result<Opened<'a>, AudioHeaderError> {
    let &Layout { container, sample_rate_hz, n_channels, start, n_bytes, .. } = layout;
    let section = Section::new(Box::new(input), Vec::new(), start, n_bytes);
    let format = match &layout.payload {
        Payload::Samples(format) => *format,
        Payload::Mpeg => return mpeg_stream(section, container, survey),
        Payload::Unsupported(name) => {
            let (name, extension) = (name.clone(), container);
            return Err(AudioHeaderError::UnsupportedCodec { name, extension });
        }
    };
    let codec = format.codec();
    check(container, codec, sample_rate_hz, n_channels)?;
    let (n_present, n_stated) = (layout.n_frames(), layout.n_stated_frames());
    Ok(Opened {
        container,
        codec,
        sample_rate_hz,
        n_channels,
        n_present: Some(n_present),
        n_stated,
        is_as_stated: n_stated == Some(n_present),
        kept: (0, n_present),
        stream: Stream::Pcm(Samples::new(section, format, n_channels, n_present)),
        n_bytes: survey.n_bytes,
    })
}

/// Opens an MPEG stream.
fn mpeg_stream<'a>(
    section: Section<'a>,
    container: &'static str,
    survey: &Survey,
) -> Result<Opened<'a>, AudioHeaderError> {
    let opened = Frames::open(section).map_err(|e| error::broken_input(&e))?;
    let Some((frames, facts)) = opened else {
        return Err(AudioHeaderError::NoSamples { container, codec: "mp3", sample_rate_hz: 0 });
    };
    let (start, end) = facts.kept;
    let n_present = facts.n_samples.min(end).saturating_sub(start);
    Ok(Opened {
        container,
        codec: "mp3",
        sample_rate_hz: facts.first.sample_rate_hz,
        n_channels: facts.first.n_channels,
        n_present: Some(n_present),
        n_stated: facts.n_stated,
        is_as_stated: facts.n_stated == Some(n_present),
        kept: facts.kept,
        stream: Stream::Mpeg(frames),
        n_bytes: survey.n_bytes,
    })
}

/// Opens the audio track of a container of packets.
fn packets<'a>(
    mut input: impl Read + Seek + Send + Sync + 'a,
    survey: &Survey,
    extension_hint: &str,
) -> Result<Opened<'a>, AudioHeaderError> {
    let (start, n_bytes) = (survey.start, survey.n_bytes);
    // A file cut within its atoms is for symphonia to refuse.
    let edits = match survey.head.get(4..8) {
        Some(b"ftyp") => Edits::read(&mut input, n_bytes).unwrap_or_default(),
        _ => Edits::default(),
    };
    let chain = match survey.marker.as_slice() {
        b"OggS" => ogg::links(&mut input, start, n_bytes).unwrap_or_default(),
        _ => Vec::new(),
    };
    // Of a FLAC file's metadata, symphonia gets only what decoding takes.
    let flac = match survey.marker.as_slice() {
        b"fLaC" => flac::essence(&mut input, start).ok(),
        _ => None,
    };
    let caf_frames = match survey.marker.as_slice() {
        b"caff" => valid_frames(&mut input, start, n_bytes).ok().flatten(),
        _ => None,
    };
    let (prefix, from) = flac.unwrap_or((Vec::new(), start));
    let section = Section::new(Box::new(input), prefix, from, n_bytes - from.min(n_bytes));
    let mut reader = media::open(section, survey, extension_hint).map_err(|error| {
        let (name, extension) = ("MPEG audio layer II".to_owned(), "mp2");
        if mpeg::is_layer_2(&survey.marker) {
            return AudioHeaderError::UnsupportedCodec { name, extension };
        }
        if survey.marker == b"OggS" && survey.head.get(28..36) == Some(b"Speex   ") {
            return AudioHeaderError::UnsupportedCodec {
                name: "Speex".to_owned(),
                extension: "spx",
            };
        }
        error
    })?;
    let info = reader.format_info();
    let (format, container) = (info.format, container_name(info.short_name));
    let (track, mut params) =
        audio_track(reader.as_ref()).ok_or(AudioHeaderError::NoAudioTrack { container })?;
    if format == FORMAT_ID_ISOMP4 && edits.is_big_endian(track.id) {
        params.codec = high_byte_first(params.codec);
    }
    let codec = codec_name(params.codec);
    let extension = extension(container);
    if !is_supported(params.codec) {
        let name = match codec {
            "unknown" => "of an unknown codec".to_owned(),
            name => name.to_owned(),
        };
        return Err(AudioHeaderError::UnsupportedCodec { name, extension });
    }
    let mut peeked = VecDeque::new();
    let mut n_coded = 0;
    let is_mp3 = params.codec == codec::CODEC_ID_MP3;
    if params.codec == codec::CODEC_ID_AAC || is_mp3 {
        let mut goes_on = true;
        while peeked.len() < N_PEEKED && goes_on {
            let answer = reader.next_packet();
            goes_on = matches!(answer, Ok(Some(_)));
            peeked.push_back(answer);
        }
    }
    let frames = peeked.iter().filter_map(|answer| answer.as_ref().ok()?.as_ref());
    let frames = frames.filter(|packet| packet.track_id == track.id);
    let frames: Vec<&[u8]> = frames.map(|packet| &*packet.data).collect();
    if is_mp3 {
        let first = frames.iter().find_map(|frame| mpeg::FrameHeader::parse(frame));
        n_coded = first.map_or(0, |header| header.n_channels);
    }
    if params.codec == codec::CODEC_ID_AAC {
        if aac::has_spectral_band_replication(params.extra_data.as_deref(), &frames) {
            return Err(AudioHeaderError::HighEfficiency { extension });
        }
        // An MP4 header has 16 bits for it, so that 96 kHz are written as 0.
        params.sample_rate =
            params.extra_data.as_deref().and_then(aac::configured_rate_hz).or(params.sample_rate);
        n_coded = aac::simplify(&mut params);
    }
    // Not every container says it, or says it truly.
    let n_channels = params.channels.as_ref().map_or(0, |channels| channels.count());
    let n_channels = u16::try_from(n_channels).ok().filter(|&n| n > 0).unwrap_or(n_coded);
    let sample_rate_hz = params.sample_rate.unwrap_or(0);
    check(container, codec, sample_rate_hz, n_channels)?;
    let n_samples = track.num_frames.filter(|&n| n > 0);
    let mut kept = (0, u64::MAX);
    let n_stated = match format {
        FORMAT_ID_ISOMP4 => {
            kept = edits.of_track(track.id, sample_rate_hz, n_samples).unwrap_or(kept);
            if params.codec == codec::CODEC_ID_OPUS {
                // The pre-skip, which an edit says again, if there is one.
                let head = params.extra_data.as_deref().unwrap_or_default();
                let pre_skip =
                    head.get(10..12).map_or(0, |two| u64::from(two[0]) << 8 | u64::from(two[1]));
                kept.0 = kept.0.max(pre_skip);
            }
            n_samples.map(|n| n.min(kept.1).saturating_sub(kept.0))
        }
        FORMAT_ID_OGG if chain.len() > 1 => Some(chain.iter().sum()),
        FORMAT_ID_OGG => {
            // Ogg's last timestamp counts Opus' pre-skip (RFC 7845 section 4.3).
            let delay = match params.codec {
                codec::CODEC_ID_OPUS => u64::from(track.delay.unwrap_or(0)),
                _ => 0,
            };
            n_samples.map(|n| n.saturating_sub(delay))
        }
        FORMAT_ID_CAF => {
            kept = caf_frames.map_or(kept, |(start, n)| (start, start + n));
            caf_frames.map(|(_, n)| n).or(n_samples)
        }
        FORMAT_ID_FLAC => n_samples,
        _ => None,
    };
    Ok(Opened {
        container,
        codec,
        sample_rate_hz,
        n_channels,
        n_present: n_stated,
        n_stated,
        is_as_stated: true,
        kept,
        stream: Stream::Packets(Box::new(Packets { reader, track, params, peeked })),
        n_bytes,
    })
}

/// Returns the codec of the same samples with their high byte first.
fn high_byte_first(id: AudioCodecId) -> AudioCodecId {
    match id {
        codec::CODEC_ID_PCM_S24LE => codec::CODEC_ID_PCM_S24BE,
        codec::CODEC_ID_PCM_S32LE => codec::CODEC_ID_PCM_S32BE,
        codec::CODEC_ID_PCM_F32LE => codec::CODEC_ID_PCM_F32BE,
        codec::CODEC_ID_PCM_F64LE => codec::CODEC_ID_PCM_F64BE,
        other => other,
    }
}

/// Refuses what no file can have.
fn check(
    container: &'static str,
    codec: &'static str,
    sample_rate_hz: u32,
    n_channels: u16,
) -> Result<(), AudioHeaderError> {
    if sample_rate_hz == 0 {
        return Err(AudioHeaderError::NoSampleRate { container, codec });
    }
    if n_channels == 0 {
        return Err(AudioHeaderError::NoChannels { container, codec });
    }
    Ok(())
}

/// Whether a codec is decoded: by symphonia, or here.
fn is_supported(id: AudioCodecId) -> bool {
    matches!(id, codec::CODEC_ID_MP3 | codec::CODEC_ID_OPUS)
        || symphonia::default::get_codecs().get_audio_decoder(id).is_some()
}

pub(in crate::audio) fn audio_track(
    reader: &dyn FormatReader,
) -> Option<(Track, AudioCodecParameters)> {
    let track =
        reader.default_track(TrackType::Audio).or_else(|| reader.first_track(TrackType::Audio))?;
    let params = track.codec_params.as_ref()?.audio()?;
    Some((track.clone(), params.clone()))
}

/// The usual file name extension of a container.
pub(in crate::audio) fn extension(container: &'static str) -> &'static str {
    match container {
        "mp4" => "m4a",
        "adts" => "aac",
        container => container,
    }
}
