//! The links of a chained Ogg file (RFC 3533 section 4) and how long each is.

use std::io::{self, Read, Seek, SeekFrom};

/// Links of a chain that are read.
const MAX_LINKS: usize = 1 << 16;

/// A stream of a link.
struct Logical {
    serial: u32,
    /// Samples before the first one to play.
    delay: u64,
    last_granule: u64,
}

/// Returns the samples of each link that holds Vorbis or Opus: its last page's position, without
/// the pre-skip. One page in a broken place ends the walk.
pub(super) fn links(
    input: &mut (impl Read + Seek),
    start: u64,
    n_bytes: u64,
) -> io::Result<Vec<u64>> {
    let mut streams: Vec<Logical> = Vec::new();
    let mut at = start;
    // A page has a head of 27 bytes, so the walk ends after at most n_bytes / 27 steps.
    while at + 27 <= n_bytes && streams.len() < MAX_LINKS {
        input.seek(SeekFrom::Start(at))?;
        let mut head = [0; 27];
        input.read_exact(&mut head)?;
        if !head.starts_with(b"OggS") {
            break;
        }
        let [_, _, _, _, _, flags, g0, g1, g2, g3, g4, g5, g6, g7, s0, s1, s2, s3, ..] = head;
        let granule = i64::from_le_bytes([g0, g1, g2, g3, g4, g5, g6, g7]);
        let serial = u32::from_le_bytes([s0, s1, s2, s3]);
        let mut lacing = vec![0; usize::from(head[26])];
        input.read_exact(&mut lacing)?;
        let body = lacing.iter().map(|&n| u64::from(n)).sum::<u64>();
        if flags & 2 != 0 {
            let mut first = Vec::new();
            input.take(body.min(12)).read_to_end(&mut first)?;
            let delay = match first.as_slice() {
                [1, b'v', b'o', b'r', b'b', b'i', b's', ..] => Some(0),
                [b'O', b'p', b'u', b's', b'H', b'e', b'a', b'd', _, _, low, high] => {
                    Some(u64::from(u16::from_le_bytes([*low, *high])))
                }
                _ => None,
            };
            if let Some(delay) = delay {
                streams.push(Logical { serial, delay, last_granule: 0 });
            }
        } else if let Some(stream) = streams.last_mut().filter(|stream| stream.serial == serial)
            && let Ok(granule) = u64::try_from(granule)
        {
            stream.last_granule = granule;
        }
        at += 27 + lacing.len() as u64 + body;
    }
    Ok(streams.iter().map(|link| link.last_granule.saturating_sub(link.delay)).collect())
}
