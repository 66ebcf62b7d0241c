//! From packets to samples: what each kind of source gives, and what damage in it means.

use std::io;
use std::mem;

use symphonia::core::codecs::audio::AudioDecoder;
use symphonia::core::errors::Error;
use symphonia::core::packet::Packet;
use symphonia::core::units::{Duration, Timestamp};

use super::codec::Codec;
use super::layer3::{Fault, MAX_FRAME_SAMPLES};
use super::{DecodeError, Decoder, MAX_PLAUSIBLE, mix};
use crate::audio::container::media::codec_name;
use crate::audio::container::mpeg::FrameHeader;
use crate::audio::container::{Stream, audio_track, possible_frame};
use crate::audio::peak::peak;

/// Samples of the longest Vorbis block are 8,192, of the usual one 2,048: positions of pages that
/// jump by less are an encoder's, not a page's that is missing.
const MIN_GAP_SAMPLES: i64 = 2_048;

/// Samples beyond the stated end of pages in a row after which that end counts as wrong. One page
/// has 255 packets, of up to 8,192 samples.
const MAX_HELD_SAMPLES: usize = 1 << 20;

impl Decoder<'_> {
    /// Decodes one packet onto `mono`, which may give no samples; false at the end.
    pub(super) fn next_packet(&mut self, mono: &mut Vec<f32>) -> Result<bool, DecodeError> {
        let time_s = self.time_s();
        match &mut self.source {
            None => Ok(false),
            Some(Stream::Pcm(samples)) => {
                samples.next(&mut self.values).map_err(|e| input_error(&e, time_s))?;
                mix::append_interleaved(&self.values, self.n_channels, mono);
                self.n_decoded += self.values.len() as u64 / u64::from(self.n_channels).max(1);
                Ok(!self.values.is_empty())
            }
            Some(Stream::Mpeg(frames)) => {
                let Codec::Mp3(layer3) = &mut self.decoder else { return Ok(false) };
                let (header, outcome) = match frames.next() {
                    Ok(Some((header, frame))) => {
                        self.values.clear();
                        self.values.resize(header.n_values().min(MAX_FRAME_SAMPLES), 0.0);
                        (header, layer3.decode(frame, &mut self.values))
                    }
                    Ok(None) => return Ok(false),
                    Err(error) => return Err(input_error(&error, time_s)),
                };
                self.add_mpeg(header, outcome, mono)?;
                Ok(true)
            }
            Some(Stream::Packets(packets)) => match packets.next() {
                Ok(Some(packet)) if packet.track_id == packets.track.id => {
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
                Err(Error::IoError(error)) => Err(input_error(&error, time_s)),
                Err(error) => {
                    self.note_damage(reason_of(&error), 0);
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
        let Self { decoder, values, .. } = self;
        match decoder {
            Codec::None => Ok(()),
            Codec::Mp3(layer3) => {
                let Some(header) = FrameHeader::parse(&packet.data) else {
                    self.note_damage("mp3: not a frame".to_owned(), packet.dur.get());
                    return Ok(());
                };
                values.clear();
                values.resize(header.n_values().min(MAX_FRAME_SAMPLES), 0.0);
                let outcome = layer3.decode(&packet.data, values);
                self.add_mpeg(header, outcome, mono)
            }
            Codec::Opus(opus) => {
                let n_beyond = mem::take(&mut packet.trim_end).get() as usize;
                let outcome = opus.decode(&packet.data, values);
                let n_channels = opus.n_channels;
                self.hold(n_beyond, mono);
                let n_before = mono.len();
                match outcome {
                    Ok(()) => mix::append_interleaved(&self.values, n_channels, mono),
                    Err(reason) => {
                        self.note_damage(reason, packet.dur.get());
                        return Ok(());
                    }
                }
                self.add(mono, n_before, n_beyond, 48_000, n_channels)
            }
            Codec::Symphonia(_) => self.decode_with_symphonia(packet, mono),
        }
    }

    fn decode_with_symphonia(
        &mut self,
        mut packet: Packet,
        mono: &mut Vec<f32>,
    ) -> Result<(), DecodeError> {
        // Symphonia cuts what goes beyond a page's stated end; libvorbis does so on the last page
        // only, and other pages of some encoders state too early an end.
        let is_vorbis = self.codec == "vorbis";
        let n_beyond = match is_vorbis {
            true => mem::take(&mut packet.trim_end).get() as usize,
            false => 0,
        };
        // A hole in a file that was restored: even silence has an end mark.
        if self.codec == "alac" && packet.data.iter().all(|&byte| byte == 0) {
            self.note_damage("a packet of zeros".to_owned(), packet.dur.get());
            return Ok(());
        }
        self.hold(n_beyond, mono);
        let n_before = mono.len();
        let Codec::Symphonia(decoder) = &mut self.decoder else { return Ok(()) };
        let (rate_hz, n_channels) = match decode(decoder.as_mut(), &packet, mono) {
            Ok(found) => found,
            Err(reason) => {
                // libvorbis leaves such packets out, too.
                match is_vorbis {
                    true => self.losses.left_out(packet.dur.get(), self.n_given),
                    false => self.note_damage(reason, packet.dur.get()),
                }
                return Ok(());
            }
        };
        let start = packet.pts.get();
        let gap = self.expected.map_or(0, |expected| start.saturating_sub(expected));
        if self.codec == "flac" {
            // Symphonia leaves broken frames out without a word.
            if gap > 0 {
                self.note_damage("a frame's checksum does not match".to_owned(), 0);
            }
            self.expected = Some(start.saturating_add_unsigned(packet.dur.get()));
            if let Some((position, _)) = &mut self.flac_frames {
                *position += packet.data.len() as u64;
            }
        }
        if is_vorbis {
            // Nor does it say that a page is missing.
            if gap >= MIN_GAP_SAMPLES {
                self.losses.left_out(gap.unsigned_abs(), self.n_given);
            }
            let n_whole = packet.dur.get().saturating_add(n_beyond as u64);
            self.expected = Some(start.saturating_add_unsigned(n_whole));
        }
        self.add(mono, n_before, n_beyond, rate_hz, n_channels)
    }

    /// Gives what was held back of earlier pages, unless this one ends early, too.
    fn hold(&mut self, n_beyond: usize, mono: &mut Vec<f32>) {
        if n_beyond == 0 || self.held.len() > MAX_HELD_SAMPLES {
            self.release(mono);
        }
    }

    /// Counts a packet's samples, from `n_before` on in `mono`, and holds the last `n_beyond` back.
    fn add(
        &mut self,
        mono: &mut Vec<f32>,
        n_before: usize,
        n_beyond: usize,
        rate_hz: u32,
        n_channels: u16,
    ) -> Result<(), DecodeError> {
        let n_kept = mono.len().saturating_sub(n_beyond).max(n_before);
        self.held.extend(mono.drain(n_kept..));
        let n_new = (n_kept - n_before) as u64;
        self.losses.start();
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
        let Some(Stream::Packets(packets)) = self.source.take() else { return };
        let Codec::Symphonia(decoder) = &mut self.decoder else { return };
        let (rest, ends) = possible_frame(&mut packets.reader.into_inner(), position);
        for end in ends {
            let packet = Packet::new(0, Timestamp::ZERO, Duration::new(n_missing), &rest[..end]);
            if let Ok(buffer) = decoder.decode(&packet)
                && buffer.frames() as u64 == n_missing
            {
                mix::append_mono(&buffer, mono);
                self.n_decoded += n_missing;
                break;
            }
        }
    }

    /// Adds one MPEG frame, which lies in `values`; one that cannot be decoded is silence, as in
    /// libmpg123.
    fn add_mpeg(
        &mut self,
        header: FrameHeader,
        outcome: Result<(), Fault>,
        mono: &mut Vec<f32>,
    ) -> Result<(), DecodeError> {
        self.check_rate(header.sample_rate_hz)?;
        if self.n_decoded == 0 {
            self.n_channels = header.n_channels;
        }
        let is_plausible = peak(&self.values) <= MAX_PLAUSIBLE;
        if outcome.is_err() || !is_plausible {
            self.values.fill(0.0);
            let is_cut = outcome == Err(Fault::Reservoir);
            self.losses.silence(header.n_samples, self.n_given, is_cut);
        } else {
            self.losses.start();
        }
        mix::append_interleaved(&self.values, header.n_channels, mono);
        self.n_decoded += header.n_samples;
        Ok(())
    }

    /// Goes on with the next stream of a chain (RFC 3533 section 4).
    fn next_link(&mut self) -> Result<bool, DecodeError> {
        let Some(Stream::Packets(packets)) = &mut self.source else { return Ok(false) };
        let Some((track, params)) = audio_track(packets.reader.as_ref()) else { return Ok(false) };
        self.decoder = Codec::new(&params, "ogg", self.extension)?;
        self.codec = codec_name(params.codec);
        packets.track = track;
        self.expected = None;
        self.held.clear();
        Ok(true)
    }

    /// Remembers the first damage since the last intact packet, and how many samples it costs.
    fn note_damage(&mut self, reason: String, n_samples: u64) {
        let time_s = self.time_s();
        self.damage.get_or_insert((time_s, reason));
        self.losses.trail(n_samples);
    }
}

/// Decodes a packet onto `mono`; returns its sample rate and number of channels.
fn decode(
    decoder: &mut dyn AudioDecoder,
    packet: &Packet,
    mono: &mut Vec<f32>,
) -> Result<(u32, u16), String> {
    let buffer = decoder.decode(packet).map_err(|e| reason_of(&e))?;
    mix::append_mono(&buffer, mono);
    let n_channels = u16::try_from(buffer.num_planes()).unwrap_or(u16::MAX);
    Ok((buffer.spec().rate(), n_channels))
}

fn reason_of(error: &Error) -> String {
    match error {
        Error::DecodeError(reason) | Error::Unsupported(reason) => (*reason).to_owned(),
        other => other.to_string(),
    }
}

fn input_error(error: &io::Error, time_s: f64) -> DecodeError {
    DecodeError::Input { time_s, reason: error.to_string() }
}
