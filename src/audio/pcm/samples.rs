//! Bytes of uncompressed samples become numbers.

use std::io::{self, Read};

/// How one sample is stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::audio) enum SampleFormat {
    U8,
    S8,
    S16 { big_endian: bool },
    S24 { big_endian: bool },
    S32 { big_endian: bool },
    F32 { big_endian: bool },
    F64 { big_endian: bool },
    ALaw,
    MuLaw,
}

impl SampleFormat {
    /// Bytes of one sample of one channel.
    pub fn n_bytes(self) -> u64 {
        match self {
            Self::U8 | Self::S8 | Self::ALaw | Self::MuLaw => 1,
            Self::S16 { .. } => 2,
            Self::S24 { .. } => 3,
            Self::S32 { .. } | Self::F32 { .. } => 4,
            Self::F64 { .. } => 8,
        }
    }

    /// FFmpeg's name of the codec.
    pub fn codec(self) -> &'static str {
        let either = |big_endian, big, little| if big_endian { big } else { little };
        match self {
            Self::U8 => "pcm_u8",
            Self::S8 => "pcm_s8",
            Self::S16 { big_endian } => either(big_endian, "pcm_s16be", "pcm_s16le"),
            Self::S24 { big_endian } => either(big_endian, "pcm_s24be", "pcm_s24le"),
            Self::S32 { big_endian } => either(big_endian, "pcm_s32be", "pcm_s32le"),
            Self::F32 { big_endian } => either(big_endian, "pcm_f32be", "pcm_f32le"),
            Self::F64 { big_endian } => either(big_endian, "pcm_f64be", "pcm_f64le"),
            Self::ALaw => "pcm_alaw",
            Self::MuLaw => "pcm_mulaw",
        }
    }

    /// Whether samples may exceed full scale by any factor.
    pub fn is_float(self) -> bool {
        matches!(self, Self::F32 { .. } | Self::F64 { .. })
    }

    /// Appends samples as numbers; integers become v / 2^(bits - 1), as in libsndfile.
    fn append(self, bytes: &[u8], values: &mut Vec<f32>) {
        // Scales are powers of two: a product and a quotient round alike.
        const I8: f32 = 1.0 / (1_u32 << 7) as f32;
        const I16: f32 = 1.0 / (1_u32 << 15) as f32;
        const I24: f32 = 1.0 / (1_u32 << 23) as f32;
        const I32: f32 = 1.0 / (1_u32 << 31) as f32;
        let i24 = |[low, mid, high]: [u8; 3]| i32::from_le_bytes([0, low, mid, high]) >> 8;
        match self {
            Self::U8 => values.extend(bytes.iter().map(|&x| f32::from(i16::from(x) - 0x80) * I8)),
            Self::S8 => values.extend(bytes.iter().map(|&x| f32::from(x.cast_signed()) * I8)),
            Self::ALaw => values.extend(bytes.iter().map(|&x| f32::from(a_law(x)) * I16)),
            Self::MuLaw => values.extend(bytes.iter().map(|&x| f32::from(mu_law(x)) * I16)),
            Self::S16 { big_endian: true } => {
                extend(values, bytes, |x| f32::from(i16::from_be_bytes(x)) * I16);
            }
            Self::S16 { .. } => extend(values, bytes, |x| f32::from(i16::from_le_bytes(x)) * I16),
            Self::S24 { big_endian: true } => {
                extend(values, bytes, |[high, mid, low]| i24([low, mid, high]) as f32 * I24);
            }
            Self::S24 { .. } => extend(values, bytes, |x| i24(x) as f32 * I24),
            Self::S32 { big_endian: true } => {
                extend(values, bytes, |x| i32::from_be_bytes(x) as f32 * I32);
            }
            Self::S32 { .. } => extend(values, bytes, |x| i32::from_le_bytes(x) as f32 * I32),
            Self::F32 { big_endian: true } => extend(values, bytes, f32::from_be_bytes),
            Self::F32 { .. } => extend(values, bytes, f32::from_le_bytes),
            Self::F64 { big_endian: true } => {
                extend(values, bytes, |x| f64::from_be_bytes(x) as f32)
            }
            Self::F64 { .. } => extend(values, bytes, |x| f64::from_le_bytes(x) as f32),
        }
    }
}

fn extend<const N: usize>(values: &mut Vec<f32>, bytes: &[u8], value: impl Fn([u8; N]) -> f32) {
    values.extend(bytes.as_chunks::<N>().0.iter().map(|&x| value(x)));
}

/// Expands a sample of 8 bits (ITU-T G.711, A-law).
fn a_law(x: u8) -> i16 {
    let x = x ^ 0x55;
    let mantissa = i16::from(x & 0xf) << 4 | 8;
    let magnitude = match x >> 4 & 7 {
        0 => mantissa,
        exponent => (mantissa | 0x100) << (exponent - 1),
    };
    if x & 0x80 == 0 { -magnitude } else { magnitude }
}

/// Expands a sample of 8 bits (ITU-T G.711, mu-law).
fn mu_law(x: u8) -> i16 {
    let x = !x;
    let magnitude = ((i16::from(x & 0xf) << 3 | 0x84) << (x >> 4 & 7)) - 0x84;
    if x & 0x80 == 0 { magnitude } else { -magnitude }
}

/// Frames that are read together.
const BLOCK_FRAMES: u64 = 1152;

/// The samples of a file, from a reader that stands at the first one.
pub(in crate::audio) struct Samples<R> {
    input: R,
    pub format: SampleFormat,
    n_channels: u16,
    n_left_frames: u64,
    bytes: Vec<u8>,
}

impl<R: Read> Samples<R> {
    pub fn new(input: R, format: SampleFormat, n_channels: u16, n_frames: u64) -> Self {
        Self { input, format, n_channels, n_left_frames: n_frames, bytes: Vec::new() }
    }

    /// Replaces `values` by the next block, channels interleaved; empty at the end.
    pub fn next(&mut self, values: &mut Vec<f32>) -> io::Result<()> {
        values.clear();
        let n_frames = self.n_left_frames.min(BLOCK_FRAMES);
        let frame_bytes = self.format.n_bytes() * u64::from(self.n_channels);
        self.bytes.clear();
        self.input.by_ref().take(n_frames * frame_bytes).read_to_end(&mut self.bytes)?;
        let n_whole = self.bytes.len() as u64 / frame_bytes.max(1);
        self.n_left_frames = if n_whole < n_frames { 0 } else { self.n_left_frames - n_frames };
        let n_bytes = (n_whole * frame_bytes) as usize;
        self.format.append(&self.bytes[..n_bytes], values);
        Ok(())
    }
}
