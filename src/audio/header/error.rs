//! What can be wrong with an audio file's header, each as one sentence.

use std::io;

use symphonia::core::errors::Error;

use crate::audio::container::media::Survey;
use crate::excerpt::preview;

/// Why a file's audio header could not be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum AudioHeaderError {
    /// No bytes at all.
    #[error(
        "audio file is empty (0 bytes); the download or copy that made it failed, fetch it again"
    )]
    Empty,
    /// The file could not be read.
    #[error("audio file could not be read ({reason}); check the disk and try again")]
    Input { reason: String },
    /// Bytes of another kind.
    #[error("not audio: it starts with {found}; {way_out}")]
    NotAudio { found: String, way_out: String },
    /// An audio container that ends or breaks off within its header.
    #[error(
        "audio header cannot be read from {found_bytes} bytes that start with {found}: {reason}; \
         the file may be cut short, copy or download it again"
    )]
    Unreadable { found_bytes: u64, found: String, reason: String },
    /// A container without audio, such as a silent video.
    #[error("{container} file holds no audio track; is it a video without sound?")]
    NoAudioTrack { container: &'static str },
    /// No sample rate, or one of 0 Hz.
    #[error(
        "{container} header gives its {codec} track a sample rate of 0 Hz; encode the file again"
    )]
    NoSampleRate { container: &'static str, codec: &'static str },
    /// No channels.
    #[error("{container} header gives its {codec} track 0 channels; encode the file again")]
    NoChannels { container: &'static str, codec: &'static str },
    /// A codec or variant that nothing here decodes.
    #[error(
        "audio is {name}, which this program does not decode; convert it, for example with: \
         ffmpeg -i in.{extension} out.flac"
    )]
    UnsupportedCodec { name: String, extension: &'static str },
    /// HE-AAC, of which only the lower half of the spectrum could be decoded.
    #[error(
        "audio is HE-AAC, whose upper half of the spectrum (SBR) this program does not decode; \
         convert it, for example with: ffmpeg -i in.{extension} out.flac"
    )]
    HighEfficiency { extension: &'static str },
    /// A readable header before nothing.
    #[error(
        "{container} file has 0 samples of {codec} at {sample_rate_hz} Hz; \
         the recording or conversion that made it failed, make it again"
    )]
    NoSamples { container: &'static str, codec: &'static str, sample_rate_hz: u32 },
}

impl AudioHeaderError {
    /// The error's class in reports: `audio_header`, `audio_codec` or `empty_file`.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Empty => "empty_file",
            Self::UnsupportedCodec { .. } | Self::HighEfficiency { .. } => "audio_codec",
            _ => "audio_header",
        }
    }
}

/// What is said of a header that goes on behind the end of its file.
const ENDS_EARLY: &str = "it ends before a known codec's header does";

/// Starts of files that are not audio; a search for markers within them could still find some.
const OTHER_FORMATS: [(&[u8], &str); 13] = [
    (b"\x89PNG", "it is a PNG picture"),
    (b"\xff\xd8\xff", "it is a JPEG picture"),
    (b"GIF8", "it is a GIF picture"),
    (b"%PDF", "it is a PDF document"),
    (b"PK\x03\x04", "it is a zip archive, unpack it first"),
    (b"\x1f\x8b", "it is a gzip file, unpack it first"),
    (b"\x93NUMPY", "it is a NumPy array"),
    (b"\x1a\x45\xdf\xa3", "it is a Matroska or WebM file, convert it to FLAC or Ogg"),
    (b"\x30\x26\xb2\x75", "it is a Windows Media file, convert it to FLAC or Ogg"),
    (b"PAR1", "it is a Parquet table"),
    (b"SQLite format", "it is a SQLite database"),
    (b"\x7fELF", "it is a program"),
    (b"glTF", "it is a glTF model"),
];

/// Starts of audio files, and of containers with audio, that nothing here reads: where the mark is, the mark, what the
/// audio is, and the usual extension.
const UNSUPPORTED: [(usize, &[u8], &str, &str); 26] = [
    (0, b"wvpk", "WavPack", "wv"),
    (0, b"TTA1", "True Audio (TTA)", "tta"),
    (0, b"tBaK", "TAK", "tak"),
    (0, b"MAC ", "Monkey's Audio", "ape"),
    (0, b"MPCK", "Musepack", "mpc"),
    (0, b"MP+", "Musepack", "mpc"),
    (0, b"OFR ", "OptimFROG", "ofr"),
    (0, b"DSD ", "DSD", "dsf"),
    (0, b"FRM8", "DSD", "dff"),
    (0, b"#!AMR", "AMR", "amr"),
    (0, b"#!SILK", "SILK", "silk"),
    (0, b".RMF", "RealMedia", "rm"),
    (0, b".ra\xfd", "RealAudio", "ra"),
    (0, b"\x7f\xfe\x80\x01", "DTS", "dts"),
    (0, b"\xfe\x7f\x01\x80", "DTS", "dts"),
    (0, b"\x1f\xff\xe8\x00", "DTS", "dts"),
    (0, b"\xff\x1f\x00\xe8", "DTS", "dts"),
    (4, b"\xf8\x72\x6f\xba", "TrueHD", "thd"),
    (0, b"Creative Voice File", "in a Creative Voice File", "voc"),
    (0, b" paf", "in an Ensoniq PARIS file", "paf"),
    (0, b"fap ", "in an Ensoniq PARIS file", "paf"),
    (0, b"\x64\xa3\x01\x00", "in an IRCAM file", "sf"),
    (8, b"8SVX", "in an 8SVX file", "svx"),
    (0, b"FLV\x01", "in a Flash video", "flv"),
    (8, b"AVI ", "in an AVI video", "avi"),
    (0, b"\x00\x00\x01\xba", "in an MPEG program stream", "mpg"),
];
/// Bytes of a packet of an MPEG transport stream, each of which begins with 47.
const TRANSPORT_PACKET_BYTES: usize = 188;

/// The error for audio that begins as a format that nothing here reads.
fn unsupported(bytes: &[u8]) -> Option<AudioHeaderError> {
    let has = |at: usize, mark: &[u8]| bytes.get(at..).is_some_and(|rest| rest.starts_with(mark));
    let found = UNSUPPORTED.iter().find(|(at, mark, ..)| has(*at, mark));
    let found = found.map(|(_, _, name, extension)| (*name, *extension)).or_else(|| {
        let is_transport = (0..3).all(|i| bytes.get(i * TRANSPORT_PACKET_BYTES) == Some(&0x47));
        // AC-3 has a bit stream identification of at most 10, E-AC-3 of at most 16.
        let is_ac3 = has(0, b"\x0b\x77") && bytes.get(5).is_some_and(|byte| byte >> 3 <= 16);
        is_transport
            .then_some(("in an MPEG transport stream", "ts"))
            .or(is_ac3.then_some(("AC-3", "ac3")))
    });
    found.map(|(name, extension)| {
        let name = name.to_owned();
        AudioHeaderError::UnsupportedCodec { name, extension }
    })
}

/// The error for bytes that are surely of another format.
pub(in crate::audio) fn other_format(bytes: &[u8]) -> Option<AudioHeaderError> {
    if let Some(error) = unsupported(bytes) {
        return Some(error);
    }
    let text = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes).trim_ascii_start();
    let way_out = match text.first() {
        Some(b'<') => "was an error page saved as audio?",
        Some(b'{' | b'[') => "was an error message saved as audio?",
        _ => OTHER_FORMATS.iter().find(|(start, _)| bytes.starts_with(start))?.1,
    };
    Some(AudioHeaderError::NotAudio { found: preview(text), way_out: way_out.to_owned() })
}

/// The error for a file whose bytes cannot be had.
pub(in crate::audio) fn broken_input(error: &io::Error) -> AudioHeaderError {
    AudioHeaderError::Input { reason: error.to_string() }
}

/// The error for the header of an uncompressed file that cannot be read.
pub(in crate::audio) fn broken_header(survey: &Survey, error: &io::Error) -> AudioHeaderError {
    let reason = match error.kind() {
        io::ErrorKind::UnexpectedEof => ENDS_EARLY.to_owned(),
        io::ErrorKind::InvalidData => error.to_string(),
        _ => return broken_input(error),
    };
    let found = preview(&survey.head);
    AudioHeaderError::Unreadable { found_bytes: survey.n_bytes, found, reason }
}

/// The error for a file that symphonia refuses: its first bytes, and how many it has.
pub(in crate::audio) fn unreadable(
    bytes: &[u8],
    n_bytes: u64,
    extension: &str,
    error: &Error,
) -> AudioHeaderError {
    let known = [&b"RIFF"[..], b"FORM", b"fLaC", b"OggS", b"ID3", b"caff"];
    let mp4 = bytes.get(4..8) == Some(b"ftyp");
    // The bare start of a marker is a header cut short, too.
    let audio = mp4
        || known.iter().any(|start| bytes.starts_with(start) || start.starts_with(bytes))
        || matches!(bytes, [0xff, second, ..] if second & 0xe0 == 0xe0);
    if audio {
        let found = preview(bytes);
        let reason = match error {
            Error::IoError(_) => ENDS_EARLY.to_owned(),
            Error::DecodeError(reason) | Error::Unsupported(reason) => {
                reason.trim_start_matches("core (probe): ").to_owned()
            }
            other => other.to_string(),
        };
        return AudioHeaderError::Unreadable { found_bytes: n_bytes, found, reason };
    }
    unknown(bytes, extension)
}

/// The error for bytes that start like no audio format.
pub(in crate::audio) fn unknown(bytes: &[u8], extension: &str) -> AudioHeaderError {
    let name = match extension {
        "" => String::new(),
        extension => format!(" under the name .{}", extension.chars().take(8).collect::<String>()),
    };
    let way_out = format!(
        "WAV, AIFF, FLAC, MP3, Ogg, MP4, AAC, CAF and AU are read, was another format saved{name}?"
    );
    AudioHeaderError::NotAudio { found: preview(bytes), way_out }
}
