//! MPEG audio streams, layer III, cut into frames the way libmpg123 does it.
//!
//! Symphonia's own reader takes any sync word for a frame, also one within junk, and trims VBR
//! files without a tag to an estimated length.
//!
//! ISO/IEC 11172-3 section 2.4 and ISO/IEC 13818-3; the tag as in LAME's `VbrTag.c`.

use std::io::{self, Read, Seek};

use symphonia::core::io::MediaSourceStream;

/// Kilobits per second of layer III by bitrate index, MPEG-1 and MPEG-2.
const KBIT_PER_S: [[usize; 16]; 2] = [
    [0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320, 0],
    [0, 8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160, 0],
];

/// More than the longest frame, 1,441 bytes, and the header after it.
const MAX_FRAME_BYTES: usize = 2048;
const WINDOW_BYTES: usize = 64 * 1024;

/// Samples that a decoder lags behind the encoder (LAME, `DECDELAY` + 1).
const DECODER_DELAY: u64 = 529;

/// What a frame's header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct FrameHeader {
    /// Bits of the version; the rate's meaning depends on it.
    version: u8,
    pub sample_rate_hz: u32,
    pub n_channels: u16,
    pub n_samples: u64,
    n_bytes: usize,
    has_crc: bool,
}

impl FrameHeader {
    /// Reads the four bytes at the start of `bytes`; `None` for anything but layer III.
    fn parse(bytes: &[u8]) -> Option<Self> {
        let &[0xff, b1, b2, b3, ..] = bytes else { return None };
        let version = b1 >> 3 & 3;
        if b1 & 0xe0 != 0xe0 || version == 1 || b1 >> 1 & 3 != 1 {
            return None;
        }
        let mpeg_1 = version == 3;
        let kbit_per_s = KBIT_PER_S[usize::from(!mpeg_1)][usize::from(b2 >> 4)];
        let rate_mpeg_1 = *[44_100, 48_000, 32_000].get(usize::from(b2 >> 2 & 3))?;
        if kbit_per_s == 0 {
            return None;
        }
        let sample_rate_hz = match version {
            3 => rate_mpeg_1,
            2 => rate_mpeg_1 / 2,
            _ => rate_mpeg_1 / 4,
        };
        let n_samples: u64 = if mpeg_1 { 1152 } else { 576 };
        let padding = usize::from(b2 >> 1 & 1);
        let n_bytes =
            n_samples as usize / 8 * kbit_per_s * 1000 / sample_rate_hz as usize + padding;
        let n_channels = if b3 >> 6 == 3 { 1 } else { 2 };
        let has_crc = b1 & 1 == 0;
        Some(Self { version, sample_rate_hz, n_channels, n_samples, n_bytes, has_crc })
    }

    fn is_kin(&self, other: &Self) -> bool {
        (self.version, self.sample_rate_hz) == (other.version, other.sample_rate_hz)
    }
}

/// The samples that an encoder's tag asks to keep, counted from the first decoded one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Kept {
    pub start: u64,
    pub end: u64,
}

/// The frames of an MPEG audio stream.
pub(super) struct Frames<'a> {
    stream: MediaSourceStream<'a>,
    window: Vec<u8>,
    /// Where the next frame is looked for in `window`.
    at: usize,
    /// Whether the previous frame ended at `at`.
    locked: bool,
    ended: bool,
    kin: Option<FrameHeader>,
}

impl<'a> Frames<'a> {
    /// Starts at the stream's first byte; the second result is from the Xing or Info tag, whose
    /// frame is no audio.
    pub fn open(mut stream: MediaSourceStream<'a>) -> io::Result<(Self, Option<Kept>)> {
        stream.rewind()?;
        let window = Vec::with_capacity(WINDOW_BYTES);
        let mut frames = Self { stream, window, at: 0, locked: false, ended: false, kin: None };
        let first = frames.next()?.map(|(header, frame)| (tag(&header, frame), frame.len()));
        let kept = match first {
            Some((Some(tag), _)) => tag.kept,
            Some((None, n_bytes)) => {
                frames.at -= n_bytes;
                None
            }
            None => None,
        };
        Ok((frames, kept))
    }

    /// Returns the next whole frame, of any sample rate; `None` at the end.
    pub fn next(&mut self) -> io::Result<Option<(FrameHeader, &[u8])>> {
        loop {
            self.fill()?;
            let rest = &self.window[self.at..];
            if rest.len() < 4 {
                return Ok(None);
            }
            if let Some(header) = FrameHeader::parse(rest)
                && rest.len() >= header.n_bytes
            {
                let expected = self.locked && self.kin.is_some_and(|kin| kin.is_kin(&header));
                // Chance bytes look like a header, but hardly ever twice at the right distance.
                let followed = || match rest.get(header.n_bytes..header.n_bytes + 4) {
                    Some(next) => FrameHeader::parse(next).is_some_and(|next| next.is_kin(&header)),
                    None => self.kin.is_none_or(|kin| kin.is_kin(&header)),
                };
                if expected || followed() {
                    let start = self.at;
                    self.at += header.n_bytes;
                    self.locked = true;
                    self.kin = Some(header);
                    return Ok(Some((header, &self.window[start..self.at])));
                }
            }
            self.locked = false;
            self.at += 1;
        }
    }

    /// Makes sure that `window` holds a frame and the header after it, if the stream does.
    fn fill(&mut self) -> io::Result<()> {
        if self.ended || self.window.len() - self.at >= MAX_FRAME_BYTES {
            return Ok(());
        }
        self.window.drain(..self.at);
        self.at = 0;
        let wanted = WINDOW_BYTES - self.window.len();
        let n_read = self.stream.by_ref().take(wanted as u64).read_to_end(&mut self.window)?;
        self.ended = n_read < wanted;
        Ok(())
    }
}

/// A first frame that holds counts instead of audio.
struct Tag {
    kept: Option<Kept>,
}

/// Reads a Xing or Info tag. Like libmpg123, takes Fraunhofer's VBRI for a frame of silence.
fn tag(header: &FrameHeader, frame: &[u8]) -> Option<Tag> {
    let side_info = match (header.n_samples, header.n_channels) {
        (1152, 1) | (576, 2) => 17,
        (1152, _) => 32,
        _ => 9,
    };
    // Some encoders count a checksum before the side information, some do not.
    let starts = [4 + side_info, 6 + side_info];
    let starts = if header.has_crc { &starts[..] } else { &starts[..1] };
    let is_tag = |&&start: &&usize| matches!(frame.get(start..start + 4), Some(b"Xing" | b"Info"));
    let start = *starts.iter().find(is_tag)?;
    Some(Tag { kept: kept(header, &frame[start..]) })
}

/// Returns what a tag's counts leave of the samples, if it has them.
fn kept(header: &FrameHeader, tag: &[u8]) -> Option<Kept> {
    let word = |at: usize| Some(u32::from_be_bytes(tag.get(at..at + 4)?.try_into().ok()?));
    let flags = word(4)?;
    if flags & 1 == 0 {
        return None;
    }
    let n_samples = u64::from(word(8)?) * header.n_samples;
    // Each of the four optional fields: frames, bytes, seek table and quality.
    let sizes = [4, 4, 100, 4];
    let lame = 8 + (0..4).filter(|bit| flags >> bit & 1 == 1).map(|bit| sizes[bit]).sum::<usize>();
    // Two counts of 12 bits: the encoder's delay and the padding at the end.
    let counts = u64::from(word(lame + 20)? & 0xff_ffff);
    let (delay, padding) = (counts >> 12, counts & 0xfff);
    let start = delay + DECODER_DELAY;
    let end = (n_samples + DECODER_DELAY).saturating_sub(padding).min(n_samples);
    (start < end).then_some(Kept { start, end })
}
