//! Samples as a WAV file.

use crate::audio::SAMPLE_RATE_HZ;

/// Bytes of the header.
const HEADER_BYTES: u32 = 44;

/// Returns mono samples within ±1 at 44.1 kHz as a WAV file of 16-bit integers; what is beyond is clipped.
pub fn wav(samples: &[f32]) -> Vec<u8> {
    let n_bytes = 2 * samples.len() as u32;
    let mut bytes = Vec::with_capacity(HEADER_BYTES as usize + 2 * samples.len());
    bytes.extend(b"RIFF");
    bytes.extend((n_bytes + HEADER_BYTES - 8).to_le_bytes());
    bytes.extend(b"WAVEfmt ");
    bytes.extend(16_u32.to_le_bytes());
    for short in [1_u16, 1] {
        bytes.extend(short.to_le_bytes());
    }
    bytes.extend(SAMPLE_RATE_HZ.to_le_bytes());
    bytes.extend((2 * SAMPLE_RATE_HZ).to_le_bytes());
    for short in [2_u16, 16] {
        bytes.extend(short.to_le_bytes());
    }
    bytes.extend(b"data");
    bytes.extend(n_bytes.to_le_bytes());
    // Full scale is 2¹⁵, as decoders have it.
    let rounded = |y: &f32| (y * 32_768.0).round().clamp(-32_768.0, 32_767.0) as i16;
    bytes.extend(samples.iter().flat_map(|y| rounded(y).to_le_bytes()));
    bytes
}
