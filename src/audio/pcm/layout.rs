//! Where the samples of an uncompressed file lie and what they are.

use std::io::{self, Read, Seek, SeekFrom};

use super::samples::SampleFormat;
use super::{aiff, apple, riff, sun};

/// Sizes from here on that exceed the file are placeholders: streams are written with 2^31 − 4096
/// (SoX), 2^31 − 1 or 2^32 − 1 (FFmpeg).
const PLACEHOLDER_BYTES: u64 = 0x7fff_f000;

/// What the data chunk holds.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::audio) enum Payload {
    Samples(SampleFormat),
    /// An MPEG audio stream.
    Mpeg,
    /// A codec that nothing here decodes, as a message names it.
    Unsupported(String),
}

/// The format of a file's samples and their place in it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::audio) struct Layout {
    pub container: &'static str,
    pub payload: Payload,
    pub sample_rate_hz: u32,
    pub n_channels: u16,
    /// Offset of the first sample.
    pub start: u64,
    /// Bytes of samples that are in the file.
    pub n_bytes: u64,
    /// Bytes of samples that the header states, unless its size is a placeholder.
    pub n_stated_bytes: Option<u64>,
}

impl Layout {
    /// Reads the layout of the file in `input` whose marker lies at `start`; `None` for other
    /// containers and for codecs that a demuxer of packets reads.
    ///
    /// # Errors
    /// What is wrong with the header, as `InvalidData` or `UnexpectedEof`; what `input` gives.
    pub fn read(
        input: &mut (impl Read + Seek),
        marker: &[u8],
        start: u64,
        n_bytes: u64,
    ) -> io::Result<Option<Self>> {
        let mut file = Chunks::new(input, n_bytes);
        match marker {
            b"RIFF" | b"RF64" | b"BW64" | b"RIFX" => riff::wave(&mut file, start).map(Some),
            b"riff" => riff::wave64(&mut file, start).map(Some),
            b"FORM" => aiff::read(&mut file, start).map(Some),
            b".snd" | b"dns." => sun::read(&mut file, start).map(Some),
            b"caff" => apple::read(&mut file, start),
            _ => Ok(None),
        }
    }

    /// Bytes of one frame, all channels; at least 1.
    pub fn frame_bytes(&self) -> u64 {
        match self.payload {
            Payload::Samples(format) => format.n_bytes() * u64::from(self.n_channels).max(1),
            Payload::Mpeg | Payload::Unsupported(_) => 1,
        }
    }

    pub fn n_frames(&self) -> u64 {
        self.n_bytes / self.frame_bytes()
    }

    pub fn n_stated_frames(&self) -> Option<u64> {
        Some(self.n_stated_bytes? / self.frame_bytes())
    }
}

/// A file of chunks.
pub(super) struct Chunks<'a, R> {
    input: &'a mut R,
    pub n_bytes: u64,
}

impl<'a, R: Read + Seek> Chunks<'a, R> {
    pub fn new(input: &'a mut R, n_bytes: u64) -> Self {
        Self { input, n_bytes }
    }

    /// Reads `N` bytes at an offset.
    pub fn at<const N: usize>(&mut self, offset: u64) -> io::Result<[u8; N]> {
        let mut bytes = [0; N];
        self.input.seek(SeekFrom::Start(offset))?;
        self.input.read_exact(&mut bytes)?;
        Ok(bytes)
    }

    /// Reads up to `n` bytes at an offset.
    pub fn some(&mut self, offset: u64, n: u64) -> io::Result<Vec<u8>> {
        let mut bytes = Vec::new();
        self.input.seek(SeekFrom::Start(offset))?;
        self.input.take(n).read_to_end(&mut bytes)?;
        Ok(bytes)
    }

    /// Returns the bytes that a data chunk has, and those that it states unless that is a
    /// placeholder. `start` is its content's; `stated` the size in its head.
    pub fn data(&mut self, start: u64, stated: u64) -> io::Result<(u64, Option<u64>)> {
        let rest = self.n_bytes.saturating_sub(start);
        if stated == 0 && rest > 0 && !self.ends_in_chunks(start)? {
            return Ok((rest, None));
        }
        if stated > rest && stated >= PLACEHOLDER_BYTES {
            return Ok((rest, None));
        }
        Ok((stated.min(rest), Some(stated)))
    }

    /// Whether whole chunks follow up to the end of the file, as behind a data chunk that is truly
    /// empty.
    fn ends_in_chunks(&mut self, mut start: u64) -> io::Result<bool> {
        while start + 8 <= self.n_bytes {
            let [i0, i1, i2, i3, s0, s1, s2, s3] = self.at(start)?;
            if ![i0, i1, i2, i3].iter().all(|byte| (b' '..=b'~').contains(byte)) {
                return Ok(false);
            }
            let sizes =
                [u32::from_le_bytes([s0, s1, s2, s3]), u32::from_be_bytes([s0, s1, s2, s3])];
            let Some(&size) =
                sizes.iter().find(|&&size| start + 8 + u64::from(size) <= self.n_bytes)
            else {
                return Ok(false);
            };
            start += 8 + u64::from(size) + u64::from(size % 2);
        }
        Ok(start >= self.n_bytes)
    }
}

/// The error for a header that breaks its format's rules.
pub(super) fn invalid(reason: &str) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, reason)
}
