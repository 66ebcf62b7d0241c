//! What an AAC stream is beyond its low-complexity core.
//!
//! HE-AAC codes the upper half of the spectrum by spectral band replication (ISO/IEC 14496-3
//! section 4.6.18), which its decoder's core does not see: decoded without it, music has half its
//! sample rate and nothing above a quarter of it.

#[cfg(test)]
mod tests;

use symphonia::core::codecs::audio::AudioCodecParameters;

/// Share of the frames looked at that must hold a replication payload: chance makes one in some
/// 200.
const MIN_SHARE: f64 = 0.5;

const AAC_LC: u32 = 2;
const SBR: u32 = 5;
const PS: u32 = 29;
const SYNC_EXTENSION: u32 = 0x2b7;

const FILL_ELEMENT: u32 = 6;
const END: u32 = 7;
const SBR_DATA: [u32; 2] = [13, 14];

/// Bits from the highest on; zeros behind the end.
struct Bits<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Bits<'_> {
    fn take(&mut self, n: usize) -> u32 {
        let bit = |at: usize| {
            self.bytes.get(at / 8).map_or(0, |byte| u32::from(byte >> (7 - at % 8) & 1))
        };
        let value = (self.at..self.at + n).fold(0, |value, at| value << 1 | bit(at));
        self.at += n;
        value
    }

    fn object_type(&mut self) -> u32 {
        match self.take(5) {
            31 => 32 + self.take(6),
            object_type => object_type,
        }
    }

    /// Reads a sample rate's index, and the rate itself where the index is an escape.
    fn rate(&mut self) -> (u32, Option<u32>) {
        match self.take(4) {
            15 => (15, Some(self.take(24))),
            index => (index, None),
        }
    }
}

/// Sample rates by their index (ISO/IEC 14496-3 table 1.18), in Hz.
const RATES_HZ: [u32; 13] = [
    96_000, 88_200, 64_000, 48_000, 44_100, 32_000, 24_000, 22_050, 16_000, 12_000, 11_025, 8_000,
    7_350,
];

/// Returns the sample rate that a configuration states, in Hz.
pub(super) fn configured_rate_hz(config: &[u8]) -> Option<u32> {
    if config.len() < 2 {
        return None;
    }
    let mut bits = Bits { bytes: config, at: 0 };
    bits.object_type();
    match bits.rate() {
        (_, Some(rate_hz)) => Some(rate_hz).filter(|&rate_hz| rate_hz > 0),
        (index, None) => RATES_HZ.get(index as usize).copied(),
    }
}

/// Whether a stream is HE-AAC: by its configuration (ISO/IEC 14496-3 section 1.6.2.1), explicitly
/// or behind the sync extension, or by what its frames hold.
pub(super) fn has_spectral_band_replication(config: Option<&[u8]>, frames: &[&[u8]]) -> bool {
    if config.is_some_and(is_configured) {
        return true;
    }
    let n_with = frames.iter().filter(|frame| ends_in_replication(frame)).count();
    n_with > 0 && n_with as f64 >= MIN_SHARE * frames.len() as f64
}

fn is_configured(config: &[u8]) -> bool {
    let mut bits = Bits { bytes: config, at: 0 };
    let object_type = bits.object_type();
    if object_type == SBR || object_type == PS {
        return true;
    }
    bits.rate();
    let n_channels = bits.take(4);
    if object_type != AAC_LC || n_channels == 0 {
        return false;
    }
    // Frame length, core coder with its delay, extension.
    bits.take(1);
    if bits.take(1) == 1 {
        bits.take(14);
    }
    bits.take(1);
    bits.take(11) == SYNC_EXTENSION && bits.object_type() == SBR && bits.take(1) == 1
}

/// Whether a raw data block ends in a fill element with a replication payload, perhaps with more
/// fill elements behind it. Only its end can be read without decoding what is before it, so every
/// place is tried at which such an end could start.
fn ends_in_replication(frame: &[u8]) -> bool {
    let n_bits = 8 * frame.len();
    // 269 bytes of payload and two of heads are the most; twice that for other fill elements.
    let first = n_bits.saturating_sub(8 * 2 * 271);
    (first..n_bits.saturating_sub(10)).any(|at| {
        let mut bits = Bits { bytes: frame, at };
        let mut is_first = true;
        loop {
            match bits.take(3) {
                FILL_ELEMENT => {}
                END => {
                    let n_left = n_bits.saturating_sub(bits.at);
                    return !is_first && bits.at <= n_bits && n_left < 8 && bits.take(n_left) == 0;
                }
                _ => return false,
            }
            let n_bytes = match bits.take(4) {
                15 => 14 + bits.take(8) as usize,
                n => n as usize,
            };
            let start = bits.at;
            if is_first && (n_bytes == 0 || !SBR_DATA.contains(&bits.take(4))) {
                return false;
            }
            is_first = false;
            bits.at = start + 8 * n_bytes;
            if bits.at >= n_bits {
                return false;
            }
        }
    })
}

/// Writes the configuration of a plain AAC-LC stream anew, without what a decoder of it does not
/// need: a core coder that it depends on is named by some encoders and there in none. Returns the
/// number of channels, 0 where that is elsewhere.
pub(super) fn simplify(params: &mut AudioCodecParameters) -> u16 {
    let Some(config) = params.extra_data.as_deref() else { return 0 };
    let mut bits = Bits { bytes: config, at: 0 };
    let object_type = bits.object_type();
    let (index, rate_hz) = bits.rate();
    let n_channels = bits.take(4);
    let has_short_frames = bits.take(1) == 1;
    if object_type != AAC_LC || n_channels == 0 || has_short_frames || rate_hz.is_some() {
        return 0;
    }
    let word = AAC_LC << 11 | index << 7 | n_channels << 3;
    params.extra_data = Some(Box::new((word as u16).to_be_bytes()));
    if n_channels == 7 { 8 } else { n_channels as u16 }
}
