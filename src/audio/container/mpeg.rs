//! MPEG audio streams, layer III, cut into frames the way libmpg123 does it.
//!
//! ISO/IEC 11172-3 section 2.4 and ISO/IEC 13818-3; the tag in `tag`.

mod tag;

use std::io::{self, Read, Seek};

use super::media::Section;
use tag::Tag;

/// Kilobits per second of layer III by bitrate index, MPEG-1 and MPEG-2.
const KBIT_PER_S: [[usize; 16]; 2] = [
    [0, 32, 40, 48, 56, 64, 80, 96, 112, 128, 160, 192, 224, 256, 320, 0],
    [0, 8, 16, 24, 32, 40, 48, 56, 64, 80, 96, 112, 128, 144, 160, 0],
];

/// More than the longest frame, one of free format with 640 kbit/s at 32 kHz, and the header after
/// it.
const MAX_FRAME_BYTES: usize = 2881;
const WINDOW_BYTES: usize = 64 * 1024;

/// Bytes without a frame, but for zeros, after which a file counts as none of MPEG audio.
const MAX_JUNK_BYTES: u64 = 64 * 1024;

/// Frames in a row that chance does not make: each matches in some 20 bits.
const N_CHAIN: usize = 3;

/// What a frame's header says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::audio) struct FrameHeader {
    /// Bits of the version; the rate's meaning depends on it.
    version: u8,
    pub sample_rate_hz: u32,
    pub n_channels: u16,
    pub n_samples: u64,
    /// `None` in free format, where only the distance of the frames tells.
    n_bytes: Option<usize>,
    padding: usize,
    pub has_checksum: bool,
}

impl FrameHeader {
    /// Reads the four bytes at the start of `bytes`; `None` for anything but layer III.
    pub fn parse(bytes: &[u8]) -> Option<Self> {
        let &[0xff, b1, b2, b3, ..] = bytes else { return None };
        let version = b1 >> 3 & 3;
        if b1 & 0xe0 != 0xe0 || version == 1 || b1 >> 1 & 3 != 1 {
            return None;
        }
        let mpeg_1 = version == 3;
        let bitrate = usize::from(b2 >> 4);
        let kbit_per_s = KBIT_PER_S[usize::from(!mpeg_1)][bitrate];
        let rate_mpeg_1 = *[44_100, 48_000, 32_000].get(usize::from(b2 >> 2 & 3))?;
        if bitrate == 15 {
            return None;
        }
        let sample_rate_hz = match version {
            3 => rate_mpeg_1,
            2 => rate_mpeg_1 / 2,
            _ => rate_mpeg_1 / 4,
        };
        let n_samples: u64 = if mpeg_1 { 1152 } else { 576 };
        let padding = usize::from(b2 >> 1 & 1);
        let n_bytes = n_samples as usize / 8 * kbit_per_s * 1000 / sample_rate_hz as usize;
        let n_bytes = Some(n_bytes + padding).filter(|_| bitrate > 0);
        let n_channels = if b3 >> 6 == 3 { 1 } else { 2 };
        let has_checksum = b1 & 1 == 0;
        Some(Self {
            version,
            sample_rate_hz,
            n_channels,
            n_samples,
            n_bytes,
            padding,
            has_checksum,
        })
    }

    fn is_kin(&self, other: &Self) -> bool {
        (self.version, self.sample_rate_hz) == (other.version, other.sample_rate_hz)
            && self.n_bytes.is_some() == other.n_bytes.is_some()
    }

    /// Samples of all channels.
    pub fn n_values(&self) -> usize {
        self.n_samples as usize * usize::from(self.n_channels)
    }
}

/// What is known of a stream before it is decoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::audio) struct StreamFacts {
    pub first: FrameHeader,
    /// Samples in the stream's frames.
    pub n_samples: u64,
    /// The first sample to give and the one after the last, counted from the first decoded one.
    pub kept: (u64, u64),
    /// Samples that the tag states, of those to give.
    pub n_stated: Option<u64>,
}

/// The frames of an MPEG audio stream.
pub(in crate::audio) struct Frames<'a> {
    stream: Section<'a>,
    window: Vec<u8>,
    /// Where the next frame is looked for in `window`.
    at: usize,
    /// Whether the previous frame ended at `at`.
    locked: bool,
    ended: bool,
    kin: Option<FrameHeader>,
    /// Bytes of a free-format frame without padding.
    free_bytes: Option<usize>,
    /// Bytes that were passed over, but for zeros, before the first frame.
    n_junk: u64,
}

impl<'a> Frames<'a> {
    /// Whether a stream starts with frames, perhaps behind zeros and some junk.
    pub fn is_in(stream: Section<'a>) -> io::Result<bool> {
        Ok(Self::new(stream).next()?.is_some())
    }

    fn new(stream: Section<'a>) -> Self {
        Self {
            stream,
            window: Vec::with_capacity(WINDOW_BYTES),
            at: 0,
            locked: false,
            ended: false,
            kin: None,
            free_bytes: None,
            n_junk: 0,
        }
    }

    /// Reads the stream through, then stands at its first frame of audio; `None` if there is no
    /// frame in the first bytes.
    pub fn open(stream: Section<'a>) -> io::Result<Option<(Self, StreamFacts)>> {
        let mut frames = Self::new(stream);
        let Some((first, tag)) = frames.start()? else { return Ok(None) };
        let mut n_frames = u64::from(tag.is_none());
        while let Some((header, _)) = frames.next()? {
            n_frames += 1;
            // What does not go on in the first frame's rate is for the decoder to refuse.
            if header.sample_rate_hz != first.sample_rate_hz {
                break;
            }
        }
        let n_samples = n_frames * first.n_samples;
        let (kept, n_stated) = match tag {
            Some(tag) => tag.kept(n_samples, first.n_samples),
            None => ((0, u64::MAX), None),
        };
        let is_tagged = tag.is_some();
        frames.rewind()?;
        if let Some((_, n_bytes)) = frames.next()?.map(|(header, frame)| (header, frame.len()))
            && !is_tagged
        {
            frames.at -= n_bytes;
        }
        Ok(Some((frames, StreamFacts { first, n_samples, kept, n_stated })))
    }

    fn rewind(&mut self) -> io::Result<()> {
        self.stream.rewind()?;
        self.window.clear();
        (self.at, self.locked, self.ended) = (0, false, false);
        (self.kin, self.free_bytes, self.n_junk) = (None, None, 0);
        Ok(())
    }

    /// Reads the first frame, and the tag that it may be instead of audio.
    fn start(&mut self) -> io::Result<Option<(FrameHeader, Option<Tag>)>> {
        let first = self.next()?;
        Ok(first.map(|(header, frame)| (header, Tag::read(&header, frame))))
    }

    /// Returns the next whole frame, of any sample rate; `None` at the end.
    pub fn next(&mut self) -> io::Result<Option<(FrameHeader, &[u8])>> {
        loop {
            self.fill()?;
            let rest = &self.window[self.at..];
            if rest.len() < 4 || self.kin.is_none() && self.n_junk > MAX_JUNK_BYTES {
                return Ok(None);
            }
            if let Some((header, n_bytes)) = self.frame_at(rest) {
                let start = self.at;
                self.at += n_bytes;
                self.locked = true;
                self.kin = Some(header);
                self.free_bytes = match header.n_bytes {
                    None => Some(n_bytes - header.padding),
                    Some(_) => None,
                };
                return Ok(Some((header, &self.window[start..self.at])));
            }
            self.locked = false;
            self.n_junk += u64::from(rest[0] != 0);
            self.at += 1;
        }
    }

    /// Returns the frame at the start of `rest` and its length, if it is one.
    fn frame_at(&self, rest: &[u8]) -> Option<(FrameHeader, usize)> {
        let header = FrameHeader::parse(rest)?;
        let n_bytes = match header.n_bytes {
            Some(n_bytes) => n_bytes,
            None => self.free_bytes.map(|n| n + header.padding).or_else(|| free_length(rest))?,
        };
        if n_bytes < 8 || rest.len() < n_bytes {
            return None;
        }
        if self.locked && self.kin.is_some_and(|kin| kin.is_kin(&header)) {
            return Some((header, n_bytes));
        }
        // Chance bytes look like a header, but hardly ever several times at the right distance.
        let n_wanted = if self.kin.is_none() { N_CHAIN } else { 2 };
        let (mut at, mut n_found) = (n_bytes, 1);
        while n_found < n_wanted {
            let Some(bytes) = rest.get(at..at + 4) else { break };
            let next = FrameHeader::parse(bytes).filter(|next| next.is_kin(&header));
            let Some(next) = next else { break };
            at += next.n_bytes.unwrap_or(n_bytes - header.padding + next.padding);
            n_found += 1;
        }
        // The end of the stream ends a chain, too; what follows there may be tags.
        let is_end = rest.len() < at + 4 || is_tag(&rest[at..]);
        let is_alone = n_found == 1 && !is_end;
        let is_kin = self.kin.is_none_or(|kin| kin.is_kin(&header));
        let is_frame = n_found >= n_wanted || is_end && is_kin || n_found == 2 && self.ended;
        (is_frame && !is_alone).then_some((header, n_bytes))
    }

    /// Makes sure that `window` holds a chain of frames, if the stream does.
    fn fill(&mut self) -> io::Result<()> {
        if self.ended || self.window.len() - self.at >= (N_CHAIN + 1) * MAX_FRAME_BYTES {
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

/// Whether a tag starts here that stands behind audio: ID3v1, Lyrics3, APE or ID3v2 of a next file.
fn is_tag(bytes: &[u8]) -> bool {
    [&b"TAG"[..], b"LYRICS", b"APETAGEX", b"ID3"].iter().any(|tag| bytes.starts_with(tag))
        || bytes.iter().take(64).all(|&byte| byte == 0)
}

/// Returns the distance from a free-format header to the next one of its kind, where a third one
/// follows at the same distance.
fn free_length(rest: &[u8]) -> Option<usize> {
    let header = FrameHeader::parse(rest)?;
    let kin = |at: usize| {
        let next = FrameHeader::parse(rest.get(at..at + 4)?)?;
        (next.is_kin(&header) && next.n_channels == header.n_channels).then_some(next.padding)
    };
    (32..MAX_FRAME_BYTES).find(|&n_bytes| {
        let bare = n_bytes - header.padding;
        kin(n_bytes).is_some_and(|padding| kin(n_bytes + bare + padding).is_some())
    })
}

/// Whether a marker is a frame's of layer II, in which radio and video have their sound.
pub(in crate::audio) fn is_layer_2(marker: &[u8]) -> bool {
    let &[0xff, b1, b2, _] = marker else { return false };
    let is_frame = b1 & 0xe0 == 0xe0 && b1 >> 3 & 3 != 1 && b2 >> 4 != 15 && b2 >> 2 & 3 != 3;
    is_frame && b1 >> 1 & 3 == 2
}
