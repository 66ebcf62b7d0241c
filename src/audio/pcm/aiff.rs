//! AIFF and AIFC (Apple, Audio Interchange File Format 1.3 and AIFF-C draft of 1991).

use std::io::{self, Read, Seek};

use super::layout::{Chunks, Layout, Payload, invalid};
use super::samples::SampleFormat;

/// What a common chunk says.
struct Common {
    payload: Payload,
    sample_rate_hz: u32,
    n_channels: u16,
    n_frames: u32,
}

pub(super) fn read<R: Read + Seek>(file: &mut Chunks<'_, R>, start: u64) -> io::Result<Layout> {
    let form: [u8; 4] = file.at(start + 8)?;
    if &form != b"AIFF" && &form != b"AIFC" {
        return Err(invalid("iff: form is neither AIFF nor AIFC"));
    }
    let (mut common, mut data) = (None, None);
    let mut at = start + 12;
    // A chunk has a head of 8 bytes, so the walk ends after at most n_bytes / 8 steps.
    while at + 8 <= file.n_bytes && (common.is_none() || data.is_none()) {
        let [id @ .., s0, s1, s2, s3] = file.at::<8>(at)?;
        let size = u64::from(u32::from_be_bytes([s0, s1, s2, s3]));
        match &id {
            b"COMM" => common = Some(parse(&file.some(at + 8, size.min(22))?, &form == b"AIFC")?),
            b"SSND" => {
                // The samples follow an offset and a block size of 4 bytes each.
                let offset = u64::from(u32::from_be_bytes(file.at(at + 8)?));
                let content = at + 16 + offset;
                data = Some((content, file.data(content, size.saturating_sub(8 + offset))?));
            }
            _ => {}
        }
        at = at.saturating_add(8 + size + size % 2);
    }
    let common = common.ok_or(io::ErrorKind::UnexpectedEof)?;
    let (start, (n_bytes, n_stated_bytes)) = data.ok_or(io::ErrorKind::UnexpectedEof)?;
    let Common { payload, sample_rate_hz, n_channels, n_frames } = common;
    let mut layout = Layout {
        container: "aiff",
        payload,
        sample_rate_hz,
        n_channels,
        start,
        n_bytes,
        n_stated_bytes,
    };
    // Writers that die leave the number of frames at 0.
    if n_frames > 0 && n_stated_bytes.is_some() {
        let stated = u64::from(n_frames) * layout.frame_bytes();
        layout.n_bytes = layout.n_bytes.min(stated);
        layout.n_stated_bytes = Some(stated.min(n_stated_bytes.unwrap_or(stated)));
    }
    Ok(layout)
}

fn parse(bytes: &[u8], compressed: bool) -> io::Result<Common> {
    let early = || io::Error::from(io::ErrorKind::UnexpectedEof);
    let short = |at: usize| match bytes.get(at..at + 2) {
        Some(&[high, low]) => Ok(u16::from_be_bytes([high, low])),
        _ => Err(early()),
    };
    let n_channels = short(0)?;
    let n_frames = u32::from(short(2)?) << 16 | u32::from(short(4)?);
    let bits = short(6)?;
    let rate = bytes.get(8..18).and_then(|ten| ten.try_into().ok()).ok_or_else(early)?;
    let codec: [u8; 4] = match bytes.get(18..22) {
        Some(four) if compressed => four.try_into().map_err(|_| early())?,
        _ => *b"NONE",
    };
    let integer = |big_endian| match bits.div_ceil(8) {
        1 => Some(SampleFormat::S8),
        2 => Some(SampleFormat::S16 { big_endian }),
        3 => Some(SampleFormat::S24 { big_endian }),
        4 => Some(SampleFormat::S32 { big_endian }),
        _ => None,
    };
    let big_endian = true;
    let format = match &codec {
        b"NONE" | b"twos" => integer(true),
        b"sowt" => integer(false),
        b"raw " => Some(SampleFormat::U8),
        b"in24" => Some(SampleFormat::S24 { big_endian }),
        b"42ni" => Some(SampleFormat::S24 { big_endian: false }),
        b"in32" => Some(SampleFormat::S32 { big_endian }),
        b"23ni" => Some(SampleFormat::S32 { big_endian: false }),
        b"fl32" | b"FL32" => Some(SampleFormat::F32 { big_endian }),
        b"fl64" | b"FL64" => Some(SampleFormat::F64 { big_endian }),
        b"alaw" | b"ALAW" => Some(SampleFormat::ALaw),
        b"ulaw" | b"ULAW" => Some(SampleFormat::MuLaw),
        _ => None,
    };
    let payload = match format {
        Some(format) => Payload::Samples(format),
        None => {
            let name = String::from_utf8_lossy(&codec).trim().escape_debug().to_string();
            Payload::Unsupported(format!("of the AIFC codec {name} with {bits} bits"))
        }
    };
    Ok(Common { payload, sample_rate_hz: rate_hz(rate), n_channels, n_frames })
}

/// Returns an 80-bit number with 1 bit of sign, 15 of exponent and 64 of mantissa, rounded; 0 for
/// what is no sample rate.
fn rate_hz([e0, e1, mantissa @ ..]: [u8; 10]) -> u32 {
    let exponent = i32::from(u16::from_be_bytes([e0, e1])) - 16_383 - 63;
    let rate_hz = u64::from_be_bytes(mantissa) as f64 * 2_f64.powi(exponent);
    rate_hz.round() as u32
}
