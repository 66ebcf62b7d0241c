//! Audio files as symphonia takes them: found, named and opened.

use std::io::{self, Read, Seek, SeekFrom};
use std::sync::LazyLock;

use symphonia::core::codecs::audio::AudioCodecId;
use symphonia::core::codecs::audio::well_known as codec;
use symphonia::core::common::Limit;
use symphonia::core::formats::probe::{Hint, Probe, ProbeOptions};
use symphonia::core::formats::well_known::{
    FORMAT_ID_CAF, FORMAT_ID_FLAC, FORMAT_ID_ISOMP4, FORMAT_ID_OGG,
};
use symphonia::core::formats::{FormatId, FormatOptions, FormatReader};
use symphonia::core::io::{MediaSource, MediaSourceStream};
use symphonia::core::meta::MetadataOptions;

use crate::audio::header::error::{self, AudioHeaderError};

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

/// What can be told of a file without knowing its format.
pub(in crate::audio) struct Survey {
    /// The first bytes.
    pub head: Vec<u8>,
    pub n_bytes: u64,
    /// Where leading ID3v2 tags end, which may be pictures of tens of megabytes.
    pub start: u64,
    /// The four bytes there.
    pub marker: Vec<u8>,
}

impl Survey {
    /// Reads what opening a file takes; leaves `input` anywhere. Errors: an empty file, one that
    /// cannot be read, and one that is surely of another kind.
    pub fn of(input: &mut (impl Read + Seek)) -> Result<Self, AudioHeaderError> {
        let survey = Self::read(input).map_err(|e| error::broken_input(&e))?;
        if survey.n_bytes == 0 {
            return Err(AudioHeaderError::Empty);
        }
        match error::other_format(&survey.head) {
            Some(error) => Err(error),
            None => Ok(survey),
        }
    }

    fn read(input: &mut (impl Read + Seek)) -> io::Result<Self> {
        let n_bytes = input.seek(SeekFrom::End(0))?;
        input.rewind()?;
        let mut head = Vec::new();
        input.take(HEAD_BYTES).read_to_end(&mut head)?;
        let start = tags_end(input, n_bytes)?;
        let mut marker = Vec::new();
        input.seek(SeekFrom::Start(start))?;
        input.take(4).read_to_end(&mut marker)?;
        Ok(Self { head, n_bytes, start, marker })
    }
}

/// Returns where the ID3v2 tags at the start end (ID3v2.4 section 3.1); 0 where one is cut short.
fn tags_end(input: &mut (impl Read + Seek), n_bytes: u64) -> io::Result<u64> {
    let mut start = 0;
    // A tag has a head of 10 bytes, so the walk ends after at most n_bytes / 10 steps.
    while start + 10 <= n_bytes {
        input.seek(SeekFrom::Start(start))?;
        let mut head = [0; 10];
        input.read_exact(&mut head)?;
        let [b'I', b'D', b'3', _, _, flags, size @ ..] = head else { break };
        if size.iter().any(|&byte| byte >= 0x80) {
            return Ok(0);
        }
        let size = size.iter().fold(0, |size, &byte| size << 7 | u64::from(byte));
        let footer = if flags & 0x10 == 0 { 0 } else { 10 };
        start += 10 + size + footer;
    }
    Ok(if start < n_bytes { start } else { 0 })
}

/// What bytes of audio are read from.
pub(in crate::audio) trait Bytes: Read + Seek + Send + Sync {}
impl<T: Read + Seek + Send + Sync> Bytes for T {}

/// A part of a file, behind other bytes than those before it in the file.
pub(in crate::audio) struct Section<'a> {
    prefix: Vec<u8>,
    input: Box<dyn Bytes + 'a>,
    /// Where the part starts in `input`.
    start: u64,
    /// Bytes of the prefix and the part.
    n_bytes: u64,
    position: u64,
}

impl<'a> Section<'a> {
    /// Returns the `n_bytes` of `input` from `start` on, behind `prefix`.
    pub fn new(input: Box<dyn Bytes + 'a>, prefix: Vec<u8>, start: u64, n_bytes: u64) -> Self {
        let n_bytes = prefix.len() as u64 + n_bytes;
        Self { prefix, input, start, n_bytes, position: u64::MAX }
    }
}

impl Read for Section<'_> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        if self.position == u64::MAX {
            self.rewind()?;
        }
        let n_prefix = self.prefix.len() as u64;
        let n_read = if self.position < n_prefix {
            let mut rest = &self.prefix[self.position as usize..];
            rest.read(bytes)?
        } else {
            let n_left = self.n_bytes.saturating_sub(self.position);
            let wanted = n_left.min(bytes.len() as u64) as usize;
            self.input.read(&mut bytes[..wanted])?
        };
        self.position += n_read as u64;
        Ok(n_read)
    }
}

impl Seek for Section<'_> {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        let target = match position {
            SeekFrom::Start(target) => Some(target),
            SeekFrom::Current(delta) => self.position.checked_add_signed(delta),
            SeekFrom::End(delta) => self.n_bytes.checked_add_signed(delta),
        };
        let target = target.ok_or(io::ErrorKind::InvalidInput)?;
        let n_prefix = self.prefix.len() as u64;
        let offset = target.min(self.n_bytes).saturating_sub(n_prefix);
        self.input.seek(SeekFrom::Start(self.start + offset))?;
        self.position = target;
        Ok(target)
    }
}

impl MediaSource for Section<'_> {
    fn is_seekable(&self) -> bool {
        true
    }

    fn byte_len(&self) -> Option<u64> {
        Some(self.n_bytes)
    }
}

/// Opens a section of a surveyed file with symphonia's demuxers.
pub(in crate::audio) fn open<'a>(
    section: Section<'a>,
    survey: &Survey,
    extension_hint: &str,
) -> Result<Box<dyn FormatReader + 'a>, AudioHeaderError> {
    let stream = MediaSourceStream::new(Box::new(section), Default::default());
    let mut hint = Hint::new();
    if !extension_hint.is_empty() {
        hint.with_extension(extension_hint);
    }
    // Cover pictures can be megabytes and nobody looks at them here.
    let metadata = MetadataOptions::default().limit_visual_bytes(Limit::Maximum(0));
    let reader = PROBE
        .probe(&hint, stream, FormatOptions::default(), metadata)
        .map_err(|error| error::unreadable(&survey.head, survey.n_bytes, extension_hint, &error))?;
    if !starts_as(reader.format_info().format, &survey.head) {
        return Err(error::unknown(&survey.head, extension_hint));
    }
    Ok(reader)
}

/// Whether the marker that symphonia found is where it belongs, not somewhere inside a file of
/// another format. Only MPEG streams occur with other bytes before them.
fn starts_as(format: FormatId, bytes: &[u8]) -> bool {
    let marker = match format {
        FORMAT_ID_CAF => bytes.get(..4) == Some(b"caff"),
        FORMAT_ID_FLAC => bytes.get(..4) == Some(b"fLaC"),
        FORMAT_ID_OGG => bytes.get(..4) == Some(b"OggS"),
        FORMAT_ID_ISOMP4 => bytes.get(4..8) == Some(b"ftyp"),
        _ => true,
    };
    marker || bytes.starts_with(b"ID3")
}

pub(in crate::audio) fn container_name(symphonia_name: &str) -> &'static str {
    match symphonia_name {
        "caf" => "caf",
        "flac" => "flac",
        "ogg" => "ogg",
        "isomp4" => "mp4",
        "aac" | "adts" => "adts",
        _ => "audio",
    }
}

pub(in crate::audio) fn codec_name(id: AudioCodecId) -> &'static str {
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

/// Whether a file has no marker of another container, as MPEG streams, which have none.
pub(in crate::audio) fn may_be_mpeg(survey: &Survey) -> bool {
    let is_adts = matches!(survey.marker.as_slice(), [0xff, second, ..] if second & 0xf6 == 0xf0);
    let is_marked = [&b"fLaC"[..], b"OggS", b"caff"]
        .iter()
        .any(|marker| survey.marker.starts_with(marker) || marker.starts_with(&survey.marker));
    !is_adts && !is_marked && survey.head.get(4..8) != Some(b"ftyp")
}
