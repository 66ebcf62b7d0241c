//! Samples of an audio file, decoded block by block to mono.
//!
//! Symphonia decodes; lengths follow libsndfile and libmpg123, which librosa reads with, and for
//! MP4 files FFmpeg. Encoder delay and padding are cut where the file states them: LAME's tag in
//! MP3 files, end positions in Ogg, the edit list or iTunes' tag in MP4. Deviations: an MP3 file of
//! variable bit rate without a tag is read to its end (libsndfile stops at an estimate), and so
//! are chained Ogg streams and a stream in which the number of channels changes.
//!
//! A file that ends early, or with damage at its end, gives the samples before that. Damage with
//! intact data after it is an error, except in MP3 and Vorbis: there, as in libmpg123 and
//! libsndfile, a broken MP3 frame is silence and a broken Ogg page is left out.

mod edits;
mod error;
mod flac;
mod mix;
mod mpeg;
mod packets;
#[cfg(test)]
mod tests;

use std::io::{Read, Seek};
use std::mem;

use symphonia::core::codecs::audio::{AudioCodecParameters, AudioDecoder};
use symphonia::core::formats::well_known::{FORMAT_ID_ISOMP4, FORMAT_ID_MP3};

use super::header::AudioHeaderError;
use super::header::media::{self, Survey, codec_name, container_name, pcm_frame_bytes};
use edits::Edits;
pub use error::DecodeError;
use mpeg::Frames;
use packets::{Source, audio_track, extension, input_error, make_decoder};

/// Packets in a row without a sample after which a stream counts as endless. A video's packets are
/// such, too: these are of four hours at 60 a second.
const MAX_EMPTY_PACKETS: u64 = 1 << 20;

/// Decodes a file to mono f32 at its own rate, block by block.
///
/// x_t = (1 / C) sum_c x_tc over the C channels of a packet, summed in f32 in NumPy's order, so
/// that WAV, AIFF and FLAC are bit-equal to `librosa.load(path, sr=None)`.
pub struct Decoder<'a> {
    source: Source<'a>,
    decoder: Box<dyn AudioDecoder>,
    codec: &'static str,
    extension: &'static str,
    sample_rate_hz: u32,
    n_channels: u16,
    params: AudioCodecParameters,
    /// Channels that `decoder` expects, for MP3.
    mpeg_channels: u16,
    /// Samples decoded so far, with those that are cut.
    n_decoded: u64,
    /// Samples given so far.
    n_given: u64,
    /// The first sample to give, and the one after the last.
    kept: (u64, u64),
    /// Where the next packet must start, in samples; for FLAC.
    expected: Option<i64>,
    /// Where the next FLAC frame lies in the file, and the samples that its header promises.
    flac_frames: Option<(u64, u64)>,
    /// Damage that is none if no intact packet follows.
    damage: Option<(f64, String)>,
    /// Samples beyond the stated end of an Ogg page, given unless the stream ends there.
    held: Vec<f32>,
    /// The first block, decoded by `open`.
    first: Vec<f32>,
    n_empty_packets: u64,
    ended: bool,
}

impl<'a> Decoder<'a> {
    /// Opens a WAV, AIFF, FLAC, MP3, Ogg, MP4 or ADTS file and decodes its first block.
    ///
    /// The content decides; `extension_hint` (no dot, may be empty) only completes messages.
    /// Errors: [`DecodeError`], also for what the first block has.
    pub fn open(
        mut input: impl Read + Seek + Send + Sync + 'a,
        extension_hint: &str,
    ) -> Result<Self, DecodeError> {
        let survey = Survey::of(&mut input)?;
        let edits = match survey.head.get(4..8) {
            // A file cut within its atoms is for symphonia to refuse.
            Some(b"ftyp") => Edits::read(&mut input, survey.n_bytes).unwrap_or_default(),
            _ => Edits::default(),
        };
        let flac_start = match survey.marker.as_slice() {
            b"fLaC" => flac::frames_start(&mut input, survey.start).ok(),
            _ => None,
        };
        let reader = media::open(input, &survey, extension_hint)?;
        let info = reader.format_info();
        let (format, container) = (info.format, container_name(info.short_name));
        let (track, params) =
            audio_track(reader.as_ref()).ok_or(AudioHeaderError::NoAudioTrack { container })?;
        let codec = codec_name(params.codec);
        let extension = extension(container);
        let sample_rate_hz = params.sample_rate.unwrap_or(0);
        if sample_rate_hz == 0 {
            return Err(AudioHeaderError::NoSampleRate { container, codec }.into());
        }
        let n_channels = params.channels.as_ref().map_or(0, |channels| channels.count());
        let n_channels = u16::try_from(n_channels).unwrap_or(0);
        let decoder = make_decoder(&params, extension)?;

        let n_samples = track.num_frames;
        let mut kept = (0, u64::MAX);
        if let (Some(size), Some(n)) =
            (pcm_frame_bytes(params.codec, n_channels), survey.pcm_data_bytes)
        {
            kept.1 = n / size.max(1);
        }
        let source = if format == FORMAT_ID_MP3 {
            let (frames, tag) =
                Frames::open(reader.into_inner()).map_err(|e| input_error(&e, 0.0))?;
            kept = tag.map_or(kept, |tag| (tag.start, tag.end));
            Source::Mpeg(frames)
        } else {
            if format == FORMAT_ID_ISOMP4 {
                kept = edits.of_track(track.id, sample_rate_hz, n_samples).unwrap_or(kept);
            }
            Source::Container { reader, track_id: track.id }
        };
        let mut decoder = Self {
            source,
            decoder,
            codec,
            extension,
            sample_rate_hz,
            n_channels,
            params,
            mpeg_channels: n_channels,
            n_decoded: 0,
            n_given: 0,
            kept,
            expected: flac_start.map(|_| 0),
            flac_frames: flac_start.zip(n_samples),
            damage: None,
            held: Vec::new(),
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
                self.check_finite(&mono[n_before..])?;
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

    fn check_finite(&self, block: &[f32]) -> Result<(), DecodeError> {
        let Some(idx) = block.iter().position(|x| !x.is_finite()) else { return Ok(()) };
        let value = if block[idx].is_nan() { "NaN" } else { "infinite" };
        let time_s = (self.n_given + idx as u64) as f64 / f64::from(self.sample_rate_hz);
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
