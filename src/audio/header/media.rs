//! Audio files as symphonia takes them: found, named and opened.

use std::io::{self, Read, Seek, SeekFrom};
use std::sync::LazyLock;

use symphonia::core::codecs::audio::AudioCodecId;
use symphonia::core::codecs::audio::well_known as codec;
use symphonia::core::common::Limit;
use symphonia::core::formats::probe::{Hint, Probe, ProbeOptions};
use symphonia::core::formats::well_known::{
    FORMAT_ID_AIFF, FORMAT_ID_FLAC, FORMAT_ID_ISOMP4, FORMAT_ID_OGG, FORMAT_ID_WAVE,
};
use symphonia::core::formats::{FormatId, FormatOptions, FormatReader};
use symphonia::core::io::{MediaSource, MediaSourceStream};
use symphonia::core::meta::MetadataOptions;

use super::error::{self, AudioHeaderError};

/// Bytes without a known marker after which the search for one ends. Symphonia's own 1 MiB lets
/// chance pairs of MPEG sync words turn one in twenty random files into audio.
const MAX_PROBE_BYTES: u32 = 64 * 1024;

/// Bytes at the start of a file that messages and checks look at.
const HEAD_BYTES: u64 = 4096;

/// Zero bytes that follow an uncompressed file: one of symphonia's packets of 1,152 frames, which
/// it would drop when the file ends within it, of up to 1,820 channels of 8 bytes.
const TAIL_BYTES: u64 = 16 << 20;

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
    /// Bytes from the samples' start in a WAV or AIFF file to the end of the file.
    pub pcm_data_bytes: Option<u64>,
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
        let pcm_data_bytes = match marker.as_slice() {
            b"RIFF" => pcm_data_bytes(input, start, n_bytes, *b"data", u32::from_le_bytes)?,
            // The samples follow an offset and a block size of 4 bytes each.
            b"FORM" => pcm_data_bytes(input, start, n_bytes, *b"SSND", u32::from_be_bytes)?
                .map(|n| n.saturating_sub(8)),
            _ => None,
        };
        Ok(Self { head, n_bytes, start, marker, pcm_data_bytes })
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

/// Finds the chunk of samples in an IFF file and returns the bytes from its content to the end.
fn pcm_data_bytes(
    input: &mut (impl Read + Seek),
    start: u64,
    n_bytes: u64,
    wanted: [u8; 4],
    size_of: fn([u8; 4]) -> u32,
) -> io::Result<Option<u64>> {
    let mut chunk_start = start + 12;
    // A chunk has a head of 8 bytes, so the walk ends after at most n_bytes / 8 steps.
    while chunk_start + 8 <= n_bytes {
        input.seek(SeekFrom::Start(chunk_start))?;
        let mut head = [0; 8];
        input.read_exact(&mut head)?;
        let [id @ .., s0, s1, s2, s3] = head;
        if id == wanted {
            return Ok(Some(n_bytes - chunk_start - 8));
        }
        let size = u64::from(size_of([s0, s1, s2, s3]));
        // Chunks start at even offsets.
        chunk_start += 8 + size + size % 2;
    }
    Ok(None)
}

/// A reader as symphonia takes it: without the tags before the audio, with zeros after it.
struct Media<R> {
    input: R,
    /// Where the audio starts in `input`.
    start: u64,
    n_bytes: u64,
    tail_bytes: u64,
    position: u64,
    /// Whether to read the RIFF chunk's size as unknown.
    riff: bool,
}

impl<R: Read> Read for Media<R> {
    fn read(&mut self, bytes: &mut [u8]) -> io::Result<usize> {
        let n_read = if self.position < self.n_bytes {
            let wanted = (self.n_bytes - self.position).min(bytes.len() as u64) as usize;
            self.input.read(&mut bytes[..wanted])?
        } else {
            let left = (self.n_bytes + self.tail_bytes).saturating_sub(self.position);
            let n_zeros = left.min(bytes.len() as u64) as usize;
            bytes[..n_zeros].fill(0);
            n_zeros
        };
        // A size of 0 or of part of the file, as interrupted writers leave it, hides the samples
        // from symphonia; libsndfile does not look at it either.
        if self.riff && self.position < 8 {
            for (byte, offset) in bytes[..n_read].iter_mut().zip(self.position..) {
                if (4..8).contains(&offset) {
                    *byte = 0xff;
                }
            }
        }
        self.position += n_read as u64;
        Ok(n_read)
    }
}

impl<R: Seek> Seek for Media<R> {
    fn seek(&mut self, position: SeekFrom) -> io::Result<u64> {
        let target = match position {
            SeekFrom::Start(target) => Some(target),
            SeekFrom::Current(delta) => self.position.checked_add_signed(delta),
            SeekFrom::End(delta) => (self.n_bytes + self.tail_bytes).checked_add_signed(delta),
        };
        let target = target.ok_or(io::ErrorKind::InvalidInput)?;
        self.input.seek(SeekFrom::Start(self.start + target.min(self.n_bytes)))?;
        self.position = target;
        Ok(target)
    }
}

impl<R: Read + Seek + Send + Sync> MediaSource for Media<R> {
    fn is_seekable(&self) -> bool {
        true
    }

    fn byte_len(&self) -> Option<u64> {
        Some(self.n_bytes + self.tail_bytes)
    }
}

/// Opens a surveyed file. The samples of an uncompressed file are followed by zeros that are not
/// in it: count them with [`Survey::pcm_data_bytes`].
pub(in crate::audio) fn open<'a>(
    mut input: impl Read + Seek + Send + Sync + 'a,
    survey: &Survey,
    extension_hint: &str,
) -> Result<Box<dyn FormatReader + 'a>, AudioHeaderError> {
    input.seek(SeekFrom::Start(survey.start)).map_err(|e| error::broken_input(&e))?;
    let media = Media {
        input,
        start: survey.start,
        n_bytes: survey.n_bytes - survey.start,
        tail_bytes: if survey.pcm_data_bytes.is_some() { TAIL_BYTES } else { 0 },
        position: 0,
        riff: survey.marker == b"RIFF",
    };
    let stream = MediaSourceStream::new(Box::new(media), Default::default());
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
        FORMAT_ID_WAVE => bytes.get(..4) == Some(b"RIFF"),
        FORMAT_ID_AIFF => bytes.get(..4) == Some(b"FORM"),
        FORMAT_ID_FLAC => bytes.get(..4) == Some(b"fLaC"),
        FORMAT_ID_OGG => bytes.get(..4) == Some(b"OggS"),
        FORMAT_ID_ISOMP4 => bytes.get(4..8) == Some(b"ftyp"),
        _ => true,
    };
    marker || bytes.starts_with(b"ID3")
}

pub(in crate::audio) fn container_name(symphonia_name: &str) -> &'static str {
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
pub(in crate::audio) fn pcm_frame_bytes(id: AudioCodecId, n_channels: u16) -> Option<u64> {
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
