//! WAV, RF64 (EBU Tech 3306), RIFX and Sony's Wave64.

use std::io::{self, Read, Seek};

use super::layout::{Chunks, Layout, Payload, invalid};
use super::samples::SampleFormat;
use crate::audio::formats::wave_codec;

/// Bytes in which the data chunk is looked for where the chunks before it do not lead there.
const MAX_SEARCH_BYTES: u64 = 1 << 20;

const TAG_PCM: u16 = 1;
const TAG_FLOAT: u16 = 3;
const TAG_A_LAW: u16 = 6;
const TAG_MU_LAW: u16 = 7;
const TAG_MP3: u16 = 0x55;
const TAG_EXTENSIBLE: u16 = 0xfffe;

/// What a format chunk says.
struct Format {
    payload: Payload,
    sample_rate_hz: u32,
    n_channels: u16,
}

impl Format {
    fn parse(bytes: &[u8], big_endian: bool) -> io::Result<Self> {
        let short = |at: usize| {
            let two = bytes.get(at..at + 2).and_then(|two| <[u8; 2]>::try_from(two).ok());
            two.map(
                |two| if big_endian { u16::from_be_bytes(two) } else { u16::from_le_bytes(two) },
            )
        };
        let early = || io::Error::from(io::ErrorKind::UnexpectedEof);
        let (tag, n_channels) = (short(0).ok_or_else(early)?, short(2).ok_or_else(early)?);
        let (low, high) = (short(4).ok_or_else(early)?, short(6).ok_or_else(early)?);
        let (low, high) = if big_endian { (high, low) } else { (low, high) };
        let sample_rate_hz = u32::from(high) << 16 | u32::from(low);
        let block_bytes = short(12).ok_or_else(early)?;
        let bits = short(14).unwrap_or(8);
        let tag = if tag == TAG_EXTENSIBLE { short(24).unwrap_or(TAG_PCM) } else { tag };
        // Samples fill their containers from the top, so what counts is the container.
        let sample_bytes = match block_bytes.checked_div(n_channels) {
            Some(bytes) if bytes > 0 && bytes * n_channels == block_bytes => bytes,
            _ => bits.div_ceil(8),
        };
        let samples = match (tag, sample_bytes) {
            (TAG_PCM, 1) => Some(SampleFormat::U8),
            (TAG_PCM, 2) => Some(SampleFormat::S16 { big_endian }),
            (TAG_PCM, 3) => Some(SampleFormat::S24 { big_endian }),
            (TAG_PCM, 4) => Some(SampleFormat::S32 { big_endian }),
            (TAG_FLOAT, 4) => Some(SampleFormat::F32 { big_endian }),
            (TAG_FLOAT, 8) => Some(SampleFormat::F64 { big_endian }),
            (TAG_A_LAW, 1) => Some(SampleFormat::ALaw),
            (TAG_MU_LAW, 1) => Some(SampleFormat::MuLaw),
            _ => None,
        };
        let payload = match (samples, tag) {
            (Some(format), _) => Payload::Samples(format),
            (None, TAG_MP3) => Payload::Mpeg,
            (None, TAG_PCM | TAG_FLOAT) => {
                Payload::Unsupported(format!("PCM with {sample_bytes} bytes a sample"))
            }
            (None, tag) => Payload::Unsupported(wave_codec(tag)),
        };
        Ok(Self { payload, sample_rate_hz, n_channels })
    }

    fn at(self, container: &'static str, start: u64, sizes: (u64, Option<u64>)) -> Layout {
        let Self { payload, sample_rate_hz, n_channels } = self;
        let (n_bytes, n_stated_bytes) = sizes;
        Layout { container, payload, sample_rate_hz, n_channels, start, n_bytes, n_stated_bytes }
    }
}

/// Reads a RIFF, RF64 or RIFX file.
pub(super) fn wave<R: Read + Seek>(file: &mut Chunks<'_, R>, start: u64) -> io::Result<Layout> {
    let [m0, m1, m2, m3, _, _, _, _, form @ ..] = file.at::<12>(start)?;
    if &form != b"WAVE" {
        return Err(invalid("riff: form is not WAVE"));
    }
    let big_endian = [m0, m1, m2, m3] == *b"RIFX";
    let size_of = if big_endian { u32::from_be_bytes } else { u32::from_le_bytes };
    let (mut format, mut data, mut data_size_64) = (None, None, None);
    let mut at = start + 12;
    // A chunk has a head of 8 bytes, so the walk ends after at most n_bytes / 8 steps.
    while at + 8 <= file.n_bytes {
        let [id @ .., s0, s1, s2, s3] = file.at::<8>(at)?;
        let (content, size) = (at + 8, u64::from(size_of([s0, s1, s2, s3])));
        match &id {
            b"fmt " => {
                format = Some(Format::parse(&file.some(content, size.min(64))?, big_endian)?)
            }
            b"ds64" => data_size_64 = Some(u64::from_le_bytes(file.at(content + 8)?)),
            b"data" => {
                let stated = data_size_64.filter(|_| size == u64::from(u32::MAX)).unwrap_or(size);
                data = Some((content, file.data(content, stated)?));
            }
            _ => {}
        }
        if format.is_some() && data.is_some() {
            break;
        }
        // Chunks start at even offsets, which some writers do not know.
        let next = content.saturating_add(size);
        let padded = next.saturating_add(size % 2);
        at = match &id {
            b"data" | b"fmt " => padded,
            _ if size % 2 == 1 && is_chunk(file, next)? && !is_chunk(file, padded)? => next,
            _ if padded < file.n_bytes && is_chunk(file, padded)? => padded,
            // A size that leads nowhere: look for the samples from here on.
            _ => match search(file, content)? {
                Some(found) => found,
                None => padded,
            },
        };
    }
    let format = format.ok_or(io::ErrorKind::UnexpectedEof)?;
    let (content, sizes) = data.ok_or(io::ErrorKind::UnexpectedEof)?;
    Ok(format.at("wav", content, sizes))
}

/// Whether a chunk may start at an offset: it does, or the file ends there.
fn is_chunk<R: Read + Seek>(file: &mut Chunks<'_, R>, at: u64) -> io::Result<bool> {
    if at.saturating_add(8) > file.n_bytes {
        return Ok(at >= file.n_bytes && at <= file.n_bytes + 1);
    }
    let id: [u8; 4] = file.at(at)?;
    Ok(id.iter().all(|byte| (b' '..=b'~').contains(byte)))
}

/// Returns where the next format or data chunk starts.
fn search<R: Read + Seek>(file: &mut Chunks<'_, R>, from: u64) -> io::Result<Option<u64>> {
    let bytes = file.some(from, MAX_SEARCH_BYTES)?;
    let found = bytes.windows(4).position(|id| id == b"data" || id == b"fmt ");
    Ok(found.map(|offset| from + offset as u64))
}

/// Reads a Wave64 file: chunks with names of 16 bytes and sizes of 8, heads included, at multiples
/// of 8.
pub(super) fn wave64<R: Read + Seek>(file: &mut Chunks<'_, R>, start: u64) -> io::Result<Layout> {
    let form: [u8; 4] = file.at(start + 24)?;
    if &form != b"wave" {
        return Err(invalid("w64: form is not wave"));
    }
    let (mut format, mut at) = (None, start + 40);
    while at + 24 <= file.n_bytes {
        let id: [u8; 4] = file.at(at)?;
        let size = u64::from_le_bytes(file.at(at + 16)?);
        let content = at + 24;
        match &id {
            b"fmt " => {
                format = Some(Format::parse(&file.some(content, size.min(64))?, false)?);
            }
            b"data" => {
                let sizes = file.data(content, size.saturating_sub(24))?;
                let format: Format = format.ok_or_else(|| invalid("w64: no format chunk"))?;
                return Ok(format.at("w64", content, sizes));
            }
            _ => {}
        }
        at = at.saturating_add(size.max(24)).saturating_add(7) & !7;
    }
    Err(io::ErrorKind::UnexpectedEof.into())
}
