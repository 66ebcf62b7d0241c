//! AU, also known as SND (Sun, audio file format of `libaudio`).

use std::io::{self, Read, Seek};

use super::layout::{Chunks, Layout, Payload};
use super::samples::SampleFormat;

pub(super) fn read<R: Read + Seek>(file: &mut Chunks<'_, R>, start: u64) -> io::Result<Layout> {
    let big_endian = file.at::<4>(start)? == *b".snd";
    let mut word = |at: u64| -> io::Result<u32> {
        let bytes = file.at(start + at)?;
        Ok(if big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    };
    let (offset, stated, encoding) = (word(4)?, word(8)?, word(12)?);
    let (sample_rate_hz, n_channels) = (word(16)?, word(20)?);
    let payload = match encoding {
        1 => Payload::Samples(SampleFormat::MuLaw),
        2 => Payload::Samples(SampleFormat::S8),
        3 => Payload::Samples(SampleFormat::S16 { big_endian }),
        4 => Payload::Samples(SampleFormat::S24 { big_endian }),
        5 => Payload::Samples(SampleFormat::S32 { big_endian }),
        6 => Payload::Samples(SampleFormat::F32 { big_endian }),
        7 => Payload::Samples(SampleFormat::F64 { big_endian }),
        27 => Payload::Samples(SampleFormat::ALaw),
        23..=26 => Payload::Unsupported("G.72x ADPCM".to_owned()),
        other => Payload::Unsupported(format!("of the AU encoding {other}")),
    };
    let content = start + u64::from(offset.max(24));
    let (n_bytes, n_stated_bytes) = file.data(content, u64::from(stated))?;
    Ok(Layout {
        container: "au",
        payload,
        sample_rate_hz,
        n_channels: u16::try_from(n_channels).unwrap_or(0),
        start: content,
        n_bytes,
        n_stated_bytes,
    })
}
