//! CAF with uncompressed samples (Apple, Core Audio Format Specification 1.0).

use std::io::{self, Read, Seek};

use super::layout::{Chunks, Layout, Payload};
use super::samples::SampleFormat;

/// Reads a CAF file; `None` if its samples are compressed.
pub(super) fn read<R: Read + Seek>(
    file: &mut Chunks<'_, R>,
    start: u64,
) -> io::Result<Option<Layout>> {
    let mut format = None;
    let mut at = start + 8;
    // A chunk has a head of 12 bytes, so the walk ends after at most n_bytes / 12 steps.
    while at + 12 <= file.n_bytes {
        let id: [u8; 4] = file.at(at)?;
        let size = i64::from_be_bytes(file.at(at + 4)?);
        let content = at + 12;
        match &id {
            b"desc" => {
                let rate_hz = f64::from_be_bytes(file.at(content)?).round() as u32;
                let codec: [u8; 4] = file.at(content + 8)?;
                let flags = u32::from_be_bytes(file.at(content + 12)?);
                let n_channels = u32::from_be_bytes(file.at(content + 24)?);
                let bits = u32::from_be_bytes(file.at(content + 28)?);
                let (is_float, big_endian) = (flags & 1 != 0, flags & 2 == 0);
                let payload = match (&codec, is_float, bits.div_ceil(8)) {
                    (b"alaw", ..) => Payload::Samples(SampleFormat::ALaw),
                    (b"ulaw", ..) => Payload::Samples(SampleFormat::MuLaw),
                    (b"lpcm", true, 4) => Payload::Samples(SampleFormat::F32 { big_endian }),
                    (b"lpcm", true, 8) => Payload::Samples(SampleFormat::F64 { big_endian }),
                    (b"lpcm", false, 1) => Payload::Samples(SampleFormat::S8),
                    (b"lpcm", false, 2) => Payload::Samples(SampleFormat::S16 { big_endian }),
                    (b"lpcm", false, 3) => Payload::Samples(SampleFormat::S24 { big_endian }),
                    (b"lpcm", false, 4) => Payload::Samples(SampleFormat::S32 { big_endian }),
                    (b"lpcm", ..) => Payload::Unsupported(format!("PCM of {bits} bits in CAF")),
                    _ => return Ok(None),
                };
                format = Some((payload, rate_hz, u16::try_from(n_channels).unwrap_or(0)));
            }
            b"data" => {
                let Some((payload, sample_rate_hz, n_channels)) = format else { break };
                // The samples follow a count of edits; a size of -1 means to the end of the file.
                let stated = u64::try_from(size).unwrap_or(u64::MAX).saturating_sub(4);
                let (n_bytes, n_stated_bytes) = file.data(content + 4, stated)?;
                return Ok(Some(Layout {
                    container: "caf",
                    payload,
                    sample_rate_hz,
                    n_channels,
                    start: content + 4,
                    n_bytes,
                    n_stated_bytes,
                }));
            }
            _ => {}
        }
        at = content.saturating_add(u64::try_from(size).unwrap_or(u64::MAX));
    }
    Err(io::ErrorKind::UnexpectedEof.into())
}

/// Returns the frames to play of a CAF file with packets: the first one and how many, by its packet
/// table and, where that does not say it, by the last packet of ALAC.
pub(in crate::audio) fn valid_frames(
    input: &mut (impl Read + Seek),
    start: u64,
    n_bytes: u64,
) -> io::Result<Option<(u64, u64)>> {
    let mut file = Chunks::new(input, n_bytes);
    let (mut codec, mut packet_frames, mut data, mut table) = ([0; 4], 0, None, None);
    let mut at = start + 8;
    // A chunk has a head of 12 bytes, so the walk ends after at most n_bytes / 12 steps.
    while at + 12 <= n_bytes {
        let id: [u8; 4] = file.at(at)?;
        let size = i64::from_be_bytes(file.at(at + 4)?);
        let content = at + 12;
        match &id {
            b"desc" => {
                codec = file.at(content + 8)?;
                packet_frames = u64::from(u32::from_be_bytes(file.at(content + 20)?));
            }
            b"data" => data = Some(content + 4),
            b"pakt" => table = Some((content, u64::try_from(size).unwrap_or(0))),
            _ => {}
        }
        at = content.saturating_add(u64::try_from(size).unwrap_or(u64::MAX));
    }
    let Some((content, size)) = table else { return Ok(None) };
    let (n_valid, n_priming) =
        (i64::from_be_bytes(file.at(content + 8)?), i32::from_be_bytes(file.at(content + 16)?));
    let remainder = i32::from_be_bytes(file.at(content + 20)?);
    let stated = u64::try_from(n_priming).ok().zip(u64::try_from(n_valid).ok());
    let Some((start, mut n)) = stated.filter(|&(_, n)| n > 0 && n < 1 << 62) else {
        return Ok(None);
    };
    if let Some(data) = data.filter(|_| &codec == b"alac" && remainder == 0) {
        let before_last = last_packet(&file.some(content + 24, size.saturating_sub(24))?);
        let last = file.some(data.saturating_add(before_last), 12)?;
        n -= alac_frames(&last).map_or(0, |of_last| packet_frames.saturating_sub(of_last)).min(n);
    }
    Ok(Some((start, n)))
}

/// Returns where the last packet starts, by a table of sizes in groups of 7 bits.
fn last_packet(table: &[u8]) -> u64 {
    let (mut sum, mut last, mut size) = (0_u64, 0_u64, 0_u64);
    for &byte in table {
        size = size << 7 | u64::from(byte & 0x7f);
        if byte & 0x80 == 0 {
            sum = sum.saturating_add(last);
            (last, size) = (size, 0);
        }
    }
    sum
}

/// Returns the frames that an ALAC packet states (Apple, `ALACDecoder.cpp`); whole packets do not.
fn alac_frames(packet: &[u8]) -> Option<u64> {
    let bits = packet.first_chunk::<8>().map(|&first| u64::from_be_bytes(first))?;
    // A tag of 3 bits, 4 of an instance, 12 of nothing, whether there is a size, and 3 of flags.
    let has_size = bits >> (63 - 19) & 1 == 1;
    has_size.then_some((bits << 23) >> 32)
}
