//! From packets to samples: what each kind of source gives, and what damage in it means.

use std::io;
use std::mem;

use symphonia::core::codecs::audio::{AudioCodecParameters, AudioDecoder, AudioDecoderOptions};
use symphonia::core::errors::Error;
use symphonia::core::formats::{FormatReader, Track, TrackType};
use symphonia::core::packet::Packet;
use symphonia::core::units::{Duration, Timestamp};

use super::mpeg::{FrameHeader, Frames};
use super::{DecodeError, Decoder, flac, mix};
use crate::audio::header::media::codec_name;

/// Samples beyond the stated end of pages in a row after which that end counts as wrong. One page
/// has 255 packets, of up to 8,192 samples.
const MAX_HELD_SAMPLES: usize = 1 << 20;

/// Where packets come from.
pub(super) enum Source<'a> {
    Container { reader: Box<dyn FormatReader + 'a>, track_id: u32 },
    Mpeg(Frames<'a>),
    Ended,
}

impl Decoder<'_> {
    /// Decodes one packet onto `mono`, which may give no samples; false at the end.
    pub(super) fn next_packet(&mut self, mono: &mut Vec<f32>) -> Result<bool, DecodeError> {
        match &mut self.source {
            Source::Mpeg(frames) => {
                let (header, packet) = match frames.next() {
                    Ok(Some((header, frame))) => {
                        let duration = Duration::new(header.n_samples);
                        (header, Packet::new(0, Timestamp::ZERO, duration, frame))
                    }
                    Ok(None) => return Ok(false),
                    Err(error) => return Err(input_error(&error, self.time_s())),
                };
                self.decode_mpeg(&packet, header, mono)?;
                Ok(true)
            }
            Source::Ended => Ok(false),
            Source::Container { reader, track_id } => match reader.next_packet() {
                Ok(Some(packet)) if packet.track_id == *track_id => {
                    self.decode_packet(packet, mono)?;
                    Ok(true)
                }
                Ok(Some(_)) => Ok(true),
                Ok(None) => Ok(false),
                Err(Error::ResetRequired) => self.next_link(),
                Err(Error::IoError(error)) if error.kind() == io::ErrorKind::UnexpectedEof => {
                    self.release(mono);
                    self.decode_flac_end(mono);
                    Ok(false)
                }
                Err(Error::IoError(error)) => Err(input_error(&error, self.time_s())),
                Err(error) => {
                    self.note_damage(&error);
                    Ok(true)
                }
            },
        }
    }

    fn decode_packet(
        &mut self,
        mut packet: Packet,
        mono: &mut Vec<f32>,
    ) -> Result<(), DecodeError> {
        // Symphonia cuts what goes beyond a page's stated end; libvorbis does so on the last page
        // only, and other pages of some encoders state too early an end.
        let n_beyond = match self.codec {
            "vorbis" => mem::replace(&mut packet.trim_end, Duration::ZERO).get() as usize,
            _ => 0,
        };
        if n_beyond == 0 || self.held.len() > MAX_HELD_SAMPLES {
            self.release(mono);
        }
        let n_before = mono.len();
        let buffer = match self.decoder.decode(&packet) {
            Ok(buffer) => buffer,
            Err(error) => {
                // libvorbis leaves such packets out, too.
                if self.codec != "vorbis" {
                    self.note_damage(&error);
                }
                return Ok(());
            }
        };
        let rate_hz = buffer.spec().rate();
        let n_channels = u16::try_from(buffer.num_planes()).unwrap_or(u16::MAX);
        mix::append_mono(&buffer, mono);
        let n_kept = mono.len().saturating_sub(n_beyond).max(n_before);
        self.held.extend(mono.drain(n_kept..));
        let n_new = (n_kept - n_before) as u64;
        if self.codec == "flac" {
            // Symphonia leaves broken frames out without a word.
            let start = packet.pts.get();
            if self.expected.is_some_and(|expected| start > expected) {
                self.note_damage(&Error::DecodeError("a frame's checksum does not match"));
            }
            self.expected = Some(start.saturating_add_unsigned(packet.dur.get()));
            if let Some((position, _)) = &mut self.flac_frames {
                *position += packet.data.len() as u64;
            }
        }
        if let Some((time_s, reason)) = self.damage.take() {
            return Err(DecodeError::Damaged { codec: self.codec, time_s, reason });
        }
        if n_new > 0 {
            if self.n_decoded == 0 {
                self.n_channels = n_channels;
                self.sample_rate_hz = rate_hz;
            }
            self.check_rate(rate_hz)?;
        }
        self.n_decoded += n_new;
        Ok(())
    }

    /// Gives the samples that went beyond a page which was not the last.
    fn release(&mut self, mono: &mut Vec<f32>) {
        self.n_decoded += self.held.len() as u64;
        mono.append(&mut self.held);
    }

    /// Decodes a last FLAC frame with other bytes behind it.
    fn decode_flac_end(&mut self, mono: &mut Vec<f32>) {
        let Some((position, n_samples)) = self.flac_frames.take() else { return };
        let n_missing = n_samples.saturating_sub(self.n_decoded);
        let source = mem::replace(&mut self.source, Source::Ended);
        let Source::Container { reader, .. } = source else { return };
        let (rest, ends) = flac::possible_frame(&mut reader.into_inner(), position);
        for end in ends {
            let packet = Packet::new(0, Timestamp::ZERO, Duration::new(n_missing), &rest[..end]);
            if let Ok(buffer) = self.decoder.decode(&packet)
                && buffer.frames() as u64 == n_missing
            {
                mix::append_mono(&buffer, mono);
                self.n_decoded += n_missing;
                break;
            }
        }
    }

    /// Decodes one MPEG frame; one that cannot be decoded is silence, as in libmpg123.
    fn decode_mpeg(
        &mut self,
        packet: &Packet,
        header: FrameHeader,
        mono: &mut Vec<f32>,
    ) -> Result<(), DecodeError> {
        self.check_rate(header.sample_rate_hz)?;
        // Symphonia's decoder refuses frames of another number of channels than its first.
        if self.n_decoded == 0 {
            self.n_channels = header.n_channels;
        } else if self.mpeg_channels != header.n_channels {
            self.decoder = make_decoder(&self.params, self.extension)?;
        }
        self.mpeg_channels = header.n_channels;
        let n_after = mono.len() + header.n_samples as usize;
        if let Ok(buffer) = self.decoder.decode(packet) {
            mix::append_mono(&buffer, mono);
        }
        mono.resize(n_after, 0.0);
        self.n_decoded += header.n_samples;
        Ok(())
    }

    /// Goes on with the next stream of a chain (RFC 3533 section 4).
    fn next_link(&mut self) -> Result<bool, DecodeError> {
        let Source::Container { reader, track_id } = &mut self.source else { return Ok(false) };
        let Some((track, params)) = audio_track(reader.as_ref()) else { return Ok(false) };
        *track_id = track.id;
        self.decoder = make_decoder(&params, self.extension)?;
        self.codec = codec_name(params.codec);
        self.expected = None;
        self.held.clear();
        Ok(true)
    }

    /// Remembers the first damage since the last intact packet.
    fn note_damage(&mut self, error: &Error) {
        let time_s = self.time_s();
        let reason = match error {
            Error::DecodeError(reason) | Error::Unsupported(reason) => (*reason).to_owned(),
            other => other.to_string(),
        };
        self.damage.get_or_insert((time_s, reason));
    }
}

pub(super) fn audio_track(reader: &dyn FormatReader) -> Option<(Track, AudioCodecParameters)> {
    let track =
        reader.default_track(TrackType::Audio).or_else(|| reader.first_track(TrackType::Audio))?;
    let params = track.codec_params.as_ref()?.audio()?;
    Some((track.clone(), params.clone()))
}

pub(super) fn make_decoder(
    params: &AudioCodecParameters,
    extension: &'static str,
) -> Result<Box<dyn AudioDecoder>, DecodeError> {
    let codecs = symphonia::default::get_codecs();
    if codecs.get_audio_decoder(params.codec).is_none() {
        let (name, extension) = match codec_name(params.codec) {
            "opus" => ("Opus", "opus"),
            "unknown" => ("of an unknown codec", extension),
            name => (name, extension),
        };
        return Err(DecodeError::UnsupportedCodec { name, extension });
    }
    codecs.make_audio_decoder(params, &AudioDecoderOptions::default()).map_err(|error| {
        let codec = codec_name(params.codec);
        DecodeError::UnsupportedStream { codec, extension, reason: error.to_string() }
    })
}

pub(super) fn input_error(error: &io::Error, time_s: f64) -> DecodeError {
    DecodeError::Input { time_s, reason: error.to_string() }
}

/// The usual file name extension of a container.
pub(super) fn extension(container: &'static str) -> &'static str {
    match container {
        "mp4" => "m4a",
        "adts" => "aac",
        container => container,
    }
}
