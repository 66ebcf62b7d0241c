//! Samples of an audio file, decoded block by block to mono.
//!
//! Lengths follow libsndfile and libmpg123, which librosa reads with, and for MP4 files, files that
//! were appended to one another and chained streams FFmpeg. Encoder delay and padding are cut where
//! the file states them: LAME's tag in MP3 files, end positions in Ogg, the edit list or iTunes' tag
//! in MP4. Deviation: an MP3 file of variable bit rate without a tag is read to its end (libsndfile
//! stops at an estimate).
//!
//! A file that ends early, or with damage at its end, gives the samples before that, and [`Loss`]
//! says what its header promised beyond them. Damage with intact data after it is an error, except
//! in MP3 and Vorbis: there, as in libmpg123 and libsndfile, a broken MP3 frame is silence and a
//! broken Ogg page is left out, up to a thousandth of the file or a second.

mod codec;
mod error;
mod layer3;
mod loss;
mod mix;
mod packets;
#[cfg(test)]
mod tests;

use std::io::{Read, Seek};
use std::mem;

use super::container::{FLAC_FRAMES_START, Opened, Stream, extension};
use super::pcm::SampleFormat;
use super::peak::peak;
use codec::Codec;
pub use error::DecodeError;
pub use loss::Loss;
use loss::Losses;

/// Packets in a row without a sample after which a stream counts as endless. A video's packets are
/// such, too: these are of four hours at 60 a second.
const MAX_EMPTY_PACKETS: u64 = 1 << 20;

/// Largest sample of a codec of integers, or of one that is made from them; more is damage.
const MAX_PLAUSIBLE: f32 = 8.0;

/// Decodes a file to mono f32 at its own rate, block by block.
///
/// x_t = (1 / C) sum_c x_tc over the C channels of a packet, summed in f32 in NumPy's order, so
/// that WAV, AIFF and FLAC are bit-equal to `librosa.load(path, sr=None)`.
pub struct Decoder<'a> {
    /// `None` behind the end.
    source: Option<Stream<'a>>,
    decoder: Codec,
    codec: &'static str,
    extension: &'static str,
    sample_rate_hz: u32,
    n_channels: u16,
    /// Whether samples may be of any size.
    is_float: bool,
    /// Samples decoded so far, with those that are cut.
    n_decoded: u64,
    /// Samples given so far.
    n_given: u64,
    /// Samples that the file states.
    n_stated: Option<u64>,
    losses: Losses,
    /// The first sample to give, and the one after the last.
    kept: (u64, u64),
    /// Where the next packet must start, in samples; for FLAC and Vorbis.
    expected: Option<i64>,
    /// Where the next FLAC frame lies in the file, and the samples that its header promises.
    flac_frames: Option<(u64, u64)>,
    /// Damage that is none if no intact packet follows.
    damage: Option<(f64, String)>,
    /// Samples beyond the stated end of an Ogg page, given unless the stream ends there.
    held: Vec<f32>,
    /// Interleaved samples of one block.
    values: Vec<f32>,
    /// The first block, decoded by `open`.
    first: Vec<f32>,
    n_empty_packets: u64,
    ended: bool,
}

impl<'a> Decoder<'a> {
    /// Opens a file of any kind that is read and decodes its first block.
    ///
    /// The content decides; `extension_hint` (no dot, may be empty) only completes messages.
    /// Errors: [`DecodeError`], also for what the first block has.
    pub fn open(
        input: impl Read + Seek + Send + Sync + 'a,
        extension_hint: &str,
    ) -> Result<Self, DecodeError> {
        let opened = Opened::open(input, extension_hint)?;
        let Opened { container, codec, sample_rate_hz, n_channels, n_stated, kept, .. } = opened;
        let extension = extension(container);
        let (mut decoder, mut flac_frames) = (Codec::None, None);
        let (mut is_float, mut expected) = (false, None);
        match &opened.stream {
            Stream::Pcm(samples) => is_float = SampleFormat::is_float(samples.format),
            Stream::Mpeg(_) => decoder = Codec::mp3(),
            Stream::Packets(packets) => {
                decoder = Codec::new(&packets.params, container, extension)?;
                is_float = codec.starts_with("pcm_f");
                let n_samples = packets.track.num_frames;
                let is_flac = container == "flac";
                expected = Some(0).filter(|_| is_flac);
                flac_frames = n_samples.filter(|_| is_flac).map(|n| (FLAC_FRAMES_START, n));
            }
        }
        let mut decoder = Self {
            source: Some(opened.stream),
            decoder,
            codec,
            extension,
            sample_rate_hz,
            n_channels,
            is_float,
            n_decoded: 0,
            n_given: 0,
            n_stated,
            losses: Losses::default(),
            kept,
            expected,
            flac_frames,
            damage: None,
            held: Vec::new(),
            values: Vec::new(),
            first: Vec::new(),
            n_empty_packets: 0,
            ended: false,
        };
        let mut first = Vec::new();
        if !decoder.next_block(&mut first)? {
            return Err(DecodeError::NoSamples { codec, sample_rate_hz: decoder.sample_rate_hz });
        }
        decoder.first = first;
        Ok(decoder)
    }

    /// The file's own sample rate in Hz.
    pub fn sample_rate_hz(&self) -> u32 {
        self.sample_rate_hz
    }

    /// The number of channels of the first packet that decoded.
    pub fn n_channels(&self) -> u16 {
        self.n_channels
    }

    /// FFmpeg's short name of the codec, as in [`AudioHeader::codec`](super::header::AudioHeader).
    pub fn codec(&self) -> &'static str {
        self.codec
    }

    /// What the file lacks of what it states, and what could not be decoded; known at the end.
    pub fn loss(&self) -> Loss {
        self.losses.sum(self.n_stated, self.n_given, self.sample_rate_hz)
    }

    /// Appends the next block of mono samples, at least one; false at the end.
    ///
    /// Errors: [`DecodeError`]; after one, and after the end, there are no more blocks.
    pub fn next_block(&mut self, mono: &mut Vec<f32>) -> Result<bool, DecodeError> {
        if !self.first.is_empty() {
            mono.append(&mut mem::take(&mut self.first));
            return Ok(true);
        }
        while !self.ended {
            // Stays set if an error leaves this loop.
            self.ended = true;
            let n_before = mono.len();
            let answer = self.next_packet(mono);
            self.cut(mono, n_before);
            let answer = answer.and_then(|goes_on| {
                self.check_samples(&mono[n_before..])?;
                self.losses.check(self.codec, self.sample_rate_hz, None)?;
                Ok(goes_on)
            });
            if answer.is_err() {
                mono.truncate(n_before);
            }
            let goes_on = answer?;
            let n_new = (mono.len() - n_before) as u64;
            self.n_given += n_new;
            self.ended = !goes_on || self.n_decoded >= self.kept.1;
            if n_new > 0 {
                self.n_empty_packets = 0;
                return Ok(true);
            }
            self.n_empty_packets += 1;
            if self.n_empty_packets > MAX_EMPTY_PACKETS {
                let (codec, n_packets) = (self.codec, self.n_empty_packets);
                return Err(DecodeError::NoProgress { codec, time_s: self.time_s(), n_packets });
            }
        }
        // After an error, there is nothing left to check.
        if self.source.take().is_some() {
            self.losses.check(self.codec, self.sample_rate_hz, Some(self.n_given))?;
        }
        Ok(false)
    }

    /// Leaves what `kept` keeps of a block that starts at `n_before` in `mono`.
    fn cut(&self, mono: &mut Vec<f32>, n_before: usize) {
        let n_block = mono.len() - n_before;
        let block_start = self.n_decoded.saturating_sub(n_block as u64);
        let (start, end) = self.kept;
        // At most the block's length.
        let n_until =
            |position: u64| position.saturating_sub(block_start).min(n_block as u64) as usize;
        mono.truncate(n_before + n_until(end));
        mono.drain(n_before..n_before + n_until(start).min(mono.len() - n_before));
    }

    fn check_samples(&self, block: &[f32]) -> Result<(), DecodeError> {
        let limit = if self.is_float { f32::MAX } else { MAX_PLAUSIBLE };
        if peak(block) <= limit {
            return Ok(());
        }
        let Some(idx) = block.iter().position(|x| !x.is_finite() || x.abs() > limit) else {
            return Ok(());
        };
        let time_s = (self.n_given + idx as u64) as f64 / f64::from(self.sample_rate_hz);
        let x = block[idx];
        if x.is_finite() {
            let reason = format!("a sample is {:.0} times full scale", x.abs());
            return Err(DecodeError::Damaged { codec: self.codec, time_s, reason });
        }
        let value = if x.is_nan() { "NaN" } else { "infinite" };
        Err(DecodeError::NotFinite { time_s, value })
    }

    fn check_rate(&self, rate_hz: u32) -> Result<(), DecodeError> {
        let (from_hz, to_hz) = (self.sample_rate_hz, rate_hz);
        if from_hz == to_hz {
            return Ok(());
        }
        let (time_s, extension) = (self.time_s(), self.extension);
        Err(DecodeError::RateChange { from_hz, to_hz, time_s, extension })
    }

    /// Where the next sample lies.
    fn time_s(&self) -> f64 {
        self.n_given as f64 / f64::from(self.sample_rate_hz)
    }
}
