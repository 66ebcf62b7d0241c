//! What a first frame without audio says of a stream: Xing's and LAME's tag (LAME, `VbrTag.c`) and
//! Fraunhofer's VBRI.

use super::FrameHeader;

/// Samples that a decoder lags behind the encoder (LAME, `DECDELAY` + 1).
const DECODER_DELAY: u64 = 529;

/// Frames beyond the stated number that a tag's writer may have counted otherwise; more are of
/// another file that was appended.
const MAX_UNCOUNTED_FRAMES: u64 = 2;

/// Where VBRI starts behind the header, always, and where its number of frames stands.
const VBRI_START: usize = 4 + 32;
const VBRI_FRAMES: usize = VBRI_START + 14;

/// A first frame that holds counts instead of audio.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(super) struct Tag {
    n_frames: Option<u64>,
    /// Samples that the encoder put in front, and that it filled the last frame up with.
    gapless: Option<(u64, u64)>,
}

impl Tag {
    /// Reads the tag of a first frame; `None` for a frame of audio.
    pub fn read(header: &FrameHeader, frame: &[u8]) -> Option<Self> {
        if frame.get(VBRI_START..VBRI_START + 4) == Some(b"VBRI") {
            let n_frames = word(frame, VBRI_FRAMES).map(u64::from).filter(|&n| n > 0);
            return Some(Self { n_frames, gapless: None });
        }
        let side_info = match (header.n_samples, header.n_channels) {
            (1152, 1) | (576, 2) => 17,
            (1152, _) => 32,
            _ => 9,
        };
        // Some encoders count a checksum before the side information, some do not.
        let starts = [4 + side_info, 6 + side_info];
        let starts = if header.has_checksum { &starts[..] } else { &starts[..1] };
        let is_tag =
            |&&start: &&usize| matches!(frame.get(start..start + 4), Some(b"Xing" | b"Info"));
        let start = *starts.iter().find(is_tag)?;
        Some(Self::parse(&frame[start..]).unwrap_or_default())
    }

    fn parse(tag: &[u8]) -> Option<Self> {
        let flags = word(tag, 4)?;
        let n_frames = if flags & 1 == 1 { Some(u64::from(word(tag, 8)?)) } else { None };
        // Each of the four optional fields: frames, bytes, seek table and quality.
        let sizes = [4, 4, 100, 4];
        let lame =
            8 + (0..4).filter(|bit| flags >> bit & 1 == 1).map(|bit| sizes[bit]).sum::<usize>();
        // Two counts of 12 bits: the encoder's delay and the padding at the end.
        let gapless = word(tag, lame + 20).map(|counts| {
            let counts = u64::from(counts & 0xff_ffff);
            (counts >> 12, counts & 0xfff)
        });
        // Without frames to count from, only what LAME and its kin wrote is believed.
        let is_signed = tag.get(lame..lame + 4).is_some_and(|name| name.iter().all(|&b| b > b' '));
        let gapless = gapless.filter(|_| n_frames.is_some() || is_signed);
        Some(Self { n_frames, gapless })
    }

    /// Returns the first sample to give and the one after the last, and how many samples between
    /// them the tag states, for a stream of `n_samples` in frames of `frame_samples`.
    pub fn kept(&self, n_samples: u64, frame_samples: u64) -> ((u64, u64), Option<u64>) {
        let stated = self.n_frames.map(|n_frames| n_frames * frame_samples);
        let (delay, padding) = self.gapless.unwrap_or_default();
        let start = if self.gapless.is_some() { delay + DECODER_DELAY } else { 0 };
        let end = match (stated, self.gapless) {
            (Some(stated), Some(_)) => (stated + DECODER_DELAY).saturating_sub(padding).min(stated),
            (Some(stated), None) => stated,
            (None, _) => n_samples,
        };
        if start >= end {
            return ((0, u64::MAX), None);
        }
        let is_longer =
            stated.is_some_and(|stated| n_samples > stated + MAX_UNCOUNTED_FRAMES * frame_samples);
        // As FFmpeg does, all is given of files that were appended to one another.
        let to = if is_longer || stated.is_none() { u64::MAX } else { end };
        let n_stated = stated.filter(|_| !is_longer).map(|_| end - start);
        ((start, to), n_stated)
    }
}

fn word(bytes: &[u8], at: usize) -> Option<u32> {
    Some(u32::from_be_bytes(bytes.get(at..at + 4)?.try_into().ok()?))
}
