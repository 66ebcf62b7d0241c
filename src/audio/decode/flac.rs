//! The last frame of a FLAC file with other bytes behind it, such as an ID3v1 tag.
//!
//! Symphonia 0.6.1 takes everything from the last frame's start to the end of the file for one
//! frame and drops it, because the checksum (RFC 9639 section 9.3) does not match.

use std::io::{self, Read, Seek, SeekFrom};

use symphonia::core::checksum::Crc16Ansi;
use symphonia::core::io::{Monitor, ReadBytes};

/// Bytes in which the last frame's end is looked for: 65,535 samples of 8 channels in 32 bits.
const MAX_FRAME_BYTES: usize = 2 << 20;

/// Returns where the frames start, after the metadata blocks (RFC 9639 section 8.1).
pub(super) fn frames_start(input: &mut (impl Read + Seek), start: u64) -> io::Result<u64> {
    let mut position = start + 4;
    loop {
        input.seek(SeekFrom::Start(position))?;
        let mut head = [0; 4];
        input.read_exact(&mut head)?;
        let [kind, s0, s1, s2] = head;
        position += 4 + u64::from(u32::from_be_bytes([0, s0, s1, s2]));
        if kind & 0x80 != 0 {
            return Ok(position - start);
        }
    }
}

/// Returns the stream's rest and where in it the frame at its start may end: where the checksum
/// over all before it matches.
pub(super) fn possible_frame(
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
