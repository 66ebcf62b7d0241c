//! The codecs of packets: symphonia's, Opus, and MPEG audio layer III.

use opus_pure::{OpusDecoder, OpusMSDecoder};
use symphonia::core::codecs::audio::well_known as codec;
use symphonia::core::codecs::audio::{AudioCodecParameters, AudioDecoder, AudioDecoderOptions};

use super::DecodeError;
use super::layer3::Layer3;
use crate::audio::container::media::codec_name;

/// Samples of the longest Opus packet: 120 ms at 48 kHz.
const MAX_OPUS_FRAMES: usize = 5_760;

/// A decoder of packets.
pub(super) enum Codec {
    /// For what is not compressed.
    None,
    Symphonia(Box<dyn AudioDecoder>),
    Mp3(Box<Layer3>),
    Opus(Box<Opus>),
}

impl Codec {
    pub fn mp3() -> Self {
        Self::Mp3(Box::new(Layer3::new()))
    }

    /// Makes the decoder of a track.
    ///
    /// # Errors
    /// [`DecodeError::UnsupportedStream`].
    pub fn new(
        params: &AudioCodecParameters,
        container: &'static str,
        extension: &'static str,
    ) -> Result<Self, DecodeError> {
        let unsupported = |reason: String| {
            let codec = codec_name(params.codec);
            DecodeError::UnsupportedStream { codec, extension, reason }
        };
        match params.codec {
            codec::CODEC_ID_MP3 => Ok(Self::mp3()),
            codec::CODEC_ID_OPUS => {
                let head = params.extra_data.as_deref().unwrap_or_default();
                let opus = Opus::new(head, container == "mp4").map_err(unsupported)?;
                Ok(Self::Opus(Box::new(opus)))
            }
            _ => symphonia::default::get_codecs()
                .make_audio_decoder(params, &AudioDecoderOptions::default())
                .map(Self::Symphonia)
                .map_err(|error| unsupported(error.to_string())),
        }
    }
}

/// The Opus decoders of one stream (RFC 6716), at 48 kHz.
pub(super) struct Opus {
    streams: Streams,
    pub n_channels: u16,
    /// Samples that are still to be left out: what the encoder lags behind.
    pub n_skipped: usize,
}

enum Streams {
    /// Mono or stereo.
    One(Box<OpusDecoder>),
    Several(Box<OpusMSDecoder>),
}

impl Opus {
    /// Reads an identification header (RFC 7845 section 5.1), in MP4 files with numbers from the
    /// high byte on.
    fn new(head: &[u8], big_endian: bool) -> Result<Self, String> {
        let short = |at: usize| match head.get(at..at + 2) {
            Some(&[first, second]) if big_endian => Ok(u16::from_be_bytes([first, second])),
            Some(&[first, second]) => Ok(u16::from_le_bytes([first, second])),
            _ => Err("opus: the identification header is too short".to_owned()),
        };
        let (pre_skip, gain) = (short(10)?, short(16)?.cast_signed());
        let (n_channels, family) = (head[9], head.get(18).copied().unwrap_or(0));
        let gain_q8 = i32::from(gain);
        let channels = usize::from(n_channels);
        let streams = match family {
            0 => {
                let mut decoder = OpusDecoder::new(48_000, channels).map_err(|e| e.to_string())?;
                decoder.gain_q8 = gain_q8;
                Streams::One(Box::new(decoder))
            }
            1 => {
                let mut decoder =
                    OpusMSDecoder::new(48_000, channels, family).map_err(|e| e.to_string())?;
                for stream in decoder.streams_mut() {
                    stream.gain_q8 = gain_q8;
                }
                Streams::Several(Box::new(decoder))
            }
            other => return Err(format!("opus: channel mapping family {other}")),
        };
        // In MP4 files the edit list cuts it.
        let n_skipped = if big_endian { 0 } else { usize::from(pre_skip) };
        let n_channels = u16::from(n_channels);
        Ok(Self { streams, n_channels, n_skipped })
    }

    /// Replaces `values` by a packet's samples, channels interleaved.
    pub fn decode(&mut self, packet: &[u8], values: &mut Vec<f32>) -> Result<(), String> {
        let n_channels = usize::from(self.n_channels);
        values.clear();
        values.resize(MAX_OPUS_FRAMES * n_channels, 0.0);
        if packet.is_empty() {
            values.clear();
            return Err("opus: empty packet".to_owned());
        }
        let decoded = match &mut self.streams {
            Streams::One(decoder) => decoder.decode(packet, MAX_OPUS_FRAMES, values),
            Streams::Several(decoder) => decoder.decode(packet, MAX_OPUS_FRAMES, values),
        };
        let n_frames = decoded.inspect_err(|_| values.clear()).map_err(|e| e.to_string())?;
        values.truncate(n_frames * n_channels);
        let n_skipped = self.n_skipped.min(n_frames);
        self.n_skipped -= n_skipped;
        values.drain(..n_skipped * n_channels);
        Ok(())
    }
}
