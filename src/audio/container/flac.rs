//! FLAC files: what symphonia 0.6.1 makes too much of.
//!
//! It refuses metadata that it cannot parse, though frames decode without it; and it takes
//! everything from the last frame's start to the end of the file for one frame and drops it,
//! because the checksum (RFC 9639 section 9.3) does not match, where other bytes follow, such as
//! an ID3v1 tag.

use std::io::{self, Read, Seek, SeekFrom};

use symphonia::core::checksum::Crc16Ansi;
use symphonia::core::io::{Monitor, ReadBytes};

/// Bytes in which the last frame's end is looked for: 65,535 samples of 8 channels in 32 bits.
const MAX_FRAME_BYTES: usize = 2 << 20;

/// Bytes of a marker and a block of stream information with its head.
pub(in crate::audio) const FRAMES_START: u64 = 4 + 4 + 34;

/// The smallest block size that RFC 9639 section 8.2 allows in stream information.
const MIN_BLOCK_SIZE: u16 = 16;

/// Returns the smallest and the largest block size, which some writers leave at 0, as far as the
/// first frame's head tells them: all are of one size (RFC 9639 section 9.1.1), or not.
fn block_sizes(stated: &[u8], [_, strategy, size, ..]: [u8; 3]) -> [u8; 4] {
    let [min, max] =
        [&stated[..2], &stated[2..4]].map(|two| u16::from(two[0]) << 8 | u16::from(two[1]));
    let of_frame = match size >> 4 {
        1 => 192,
        code @ 2..=5 => 576 << (code - 2),
        code @ 8..=15 => 256 << (code - 8),
        _ => u16::MAX,
    };
    let max = if max < MIN_BLOCK_SIZE { of_frame } else { max };
    let min = match min {
        MIN_BLOCK_SIZE.. => min.min(max),
        _ if strategy & 1 == 0 => max,
        _ => MIN_BLOCK_SIZE,
    };
    let ([a, b], [c, d]) = (min.to_be_bytes(), max.to_be_bytes());
    [a, b, c, d]
}

/// Returns a marker with the file's stream information alone, and where its frames start, after
/// the metadata blocks (RFC 9639 section 8.1).
pub(super) fn essence(input: &mut (impl Read + Seek), start: u64) -> io::Result<(Vec<u8>, u64)> {
    let mut position = start + 4;
    let mut essence = Vec::new();
    loop {
        input.seek(SeekFrom::Start(position))?;
        let mut head = [0; 4];
        input.read_exact(&mut head)?;
        let [kind, s0, s1, s2] = head;
        let size = u64::from(u32::from_be_bytes([0, s0, s1, s2]));
        if kind & 0x7f == 0 && size == 34 && essence.is_empty() {
            let mut info = [0; 34];
            input.read_exact(&mut info)?;
            essence.extend_from_slice(b"fLaC\x80\0\0\x22");
            essence.extend_from_slice(&info);
        }
        position += 4 + size;
        if kind & 0x80 != 0 {
            break;
        }
    }
    if essence.is_empty() {
        return Err(io::ErrorKind::InvalidData.into());
    }
    let mut frame = [0; 3];
    input.seek(SeekFrom::Start(position))?;
    input.read_exact(&mut frame)?;
    let sizes = block_sizes(&essence[8..12], frame);
    essence[8..12].copy_from_slice(&sizes);
    Ok((essence, position))
}

/// Returns the stream's rest and where in it the frame at its start may end: where the checksum
/// over all before it matches.
pub(in crate::audio) fn possible_frame(
    stream: &mut (impl ReadBytes + Seek),
    position: u64,
) -> (Vec<u8>, Vec<usize>) {
    let mut rest = Vec::new();
    if stream.seek(SeekFrom::Start(position)).is_ok() {
        // What was read before an error is as good as a shorter file.
        while rest.len() < MAX_FRAME_BYTES
            && let Ok(byte) = stream.read_u8()
        {
            rest.push(byte);
        }
    }
    let mut sum = Crc16Ansi::new(0);
    let mut ends = Vec::new();
    if rest.first() == Some(&0xff) {
        for (idx, two) in rest.windows(2).enumerate() {
            if idx > 0 && two == sum.crc().to_be_bytes() {
                ends.push(idx + 2);
            }
            sum.process_byte(two[0]);
        }
    }
    (rest, ends)
}
