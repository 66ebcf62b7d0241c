//! A whole recording: from a reader of bytes to features, in bounded memory.

use std::io::{self, Read, Seek};

use super::SAMPLE_RATE_HZ;
use super::decode::{DecodeError, Decoder, Loss};
use super::features::{FeatureError, FirstPass, RawFeatures};
use super::meter::{Meter, MeterPass};
use super::peak::peak;
use super::resample::Resampler;
use super::tuning::Tuning;

/// Samples at 44.1 kHz that are kept for the second pass: 6 min. Longer recordings are decoded twice.
pub const MAX_HELD_SAMPLES: usize = 6 * 60 * SAMPLE_RATE_HZ as usize;

/// Sample rates that are converted, in Hz; the filter's length grows with the rate.
const MIN_RATE_HZ: u32 = 1_000;
const MAX_RATE_HZ: u32 = 768_000;

/// Largest sample. The power of a frame, (2048 · sample)², has to stay below f32's 3·10³⁸.
const MAX_SAMPLE: f32 = 1e12;

/// What an encoded recording is read from.
pub trait Input: Read + Seek + Send + Sync {}
impl<T: Read + Seek + Send + Sync> Input for T {}

/// How a recording is analysed.
pub struct Options<'a> {
    /// Fixes the tuning that would be estimated.
    pub tuning: Option<Tuning>,
    /// Longest recording, in seconds.
    pub max_duration_s: f64,
    /// Whether the time for this recording is over; asked once per packet.
    pub is_late: &'a dyn Fn() -> bool,
    /// Samples kept for the second pass, usually [`MAX_HELD_SAMPLES`].
    pub max_held_samples: usize,
}

/// A recording's features and what it was.
#[derive(Clone, Debug, PartialEq)]
pub struct Recording {
    pub raw: RawFeatures,
    /// The beats and bars that motion follows.
    pub meter: Meter,
    pub encoding: Encoding,
    /// What is missing of it.
    pub loss: Loss,
}

/// How a recording was stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Encoding {
    pub codec: &'static str,
    pub sample_rate_hz: u32,
    pub n_channels: u16,
}

/// Why a recording has no features.
#[derive(Debug, thiserror::Error)]
pub enum RecordingError {
    #[error("cannot be opened ({0}); check that it is still there")]
    Open(io::Error),
    #[error(transparent)]
    Decode(#[from] DecodeError),
    #[error(transparent)]
    Features(#[from] FeatureError),
    /// A rate that no recording has.
    #[error(
        "has a sample rate of {found_hz} Hz, outside the {MIN_RATE_HZ} to {MAX_RATE_HZ} Hz that are \
         converted; its header is probably damaged, encode it again"
    )]
    Rate { found_hz: u32 },
    /// A sample whose power would not fit the numbers that features are computed in.
    #[error(
        "sample at {time_s:.3} s is {value:e}, and full scale is 1; samples above {MAX_SAMPLE:e} are \
         no audio, export the file again, for example as 16-bit integers"
    )]
    TooLarge { time_s: f64, value: f32 },
    /// The limit on length.
    #[error(
        "is longer than {limit_s} s, the longest recording that is taken; split it or raise \
         --max-duration"
    )]
    TooLong { limit_s: f64 },
    /// The limit on time.
    #[error(
        "was not done in time, after {done_s:.1} s of its audio; raise --timeout or look at the \
         file"
    )]
    Late { done_s: f64 },
    /// The two passes saw different samples.
    #[error("changed while it was read; run extract again when nobody writes it")]
    Changed,
}

impl RecordingError {
    /// The error's class in reports.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Open(_) => "unreadable",
            Self::Decode(e) => e.kind(),
            Self::Features(FeatureError::Empty) => "audio_no_samples",
            Self::Rate { .. } => "audio_sample_rate",
            Self::TooLarge { .. } => "audio_data",
            Self::TooLong { .. } => "too_long",
            Self::Late { .. } => "timeout",
            Self::Changed => "changed",
        }
    }
}

impl Recording {
    /// Decodes a recording and extracts its raw features.
    ///
    /// `open` is called once, and once more for recordings that are longer than what is held.
    ///
    /// # Errors
    /// [`RecordingError`].
    pub fn analyse<I: Input>(
        mut open: impl FnMut() -> io::Result<I>,
        extension_hint: &str,
        options: &Options<'_>,
    ) -> Result<Self, RecordingError> {
        let mut held = Some(Vec::new());
        let mut first = FirstPass::new(options.tuning);
        let mut meter = MeterPass::new();
        let mut digest = Digest::default();
        let input = open().map_err(RecordingError::Open)?;
        let (encoding, loss) = decode(input, extension_hint, options, |samples| {
            first.push(samples);
            meter.push(samples);
            match &mut held {
                Some(kept) if kept.len() + samples.len() <= options.max_held_samples => {
                    kept.extend_from_slice(samples);
                }
                _ => {
                    // Samples that are read twice are compared.
                    digest.add(&held.take().unwrap_or_default());
                    digest.add(samples);
                }
            }
        })?;
        let mut second = first.finish()?;
        let meter = meter.finish();
        match held {
            Some(samples) => {
                for block in samples.chunks(BLOCK_SAMPLES) {
                    second.push(block);
                }
            }
            None => {
                let mut again = Digest::default();
                let input = open().map_err(RecordingError::Open)?;
                decode(input, extension_hint, options, |samples| {
                    second.push(samples);
                    again.add(samples);
                })?;
                if again != digest {
                    return Err(RecordingError::Changed);
                }
            }
        }
        Ok(Self { raw: second.finish(), meter, encoding, loss })
    }
}

/// Samples that are passed on together.
const BLOCK_SAMPLES: usize = 8192;

/// Decodes and resamples, in blocks.
fn decode(
    input: impl Input,
    extension_hint: &str,
    options: &Options<'_>,
    mut visit: impl FnMut(&[f32]),
) -> Result<(Encoding, Loss), RecordingError> {
    let mut decoder = Decoder::open(input, extension_hint)?;
    let rate_hz = decoder.sample_rate_hz();
    if !(MIN_RATE_HZ..=MAX_RATE_HZ).contains(&rate_hz) {
        return Err(RecordingError::Rate { found_hz: rate_hz });
    }
    let mut resampler = Resampler::new(rate_hz);
    let (mut packet, mut block) = (Vec::new(), Vec::new());
    let mut n_samples = 0u64;
    loop {
        packet.clear();
        let goes_on = decoder.next_block(&mut packet)?;
        if peak(&packet) > MAX_SAMPLE
            && let Some(i) = packet.iter().position(|y| y.abs() > MAX_SAMPLE)
        {
            let time_s = (n_samples + i as u64) as f64 / f64::from(rate_hz);
            return Err(RecordingError::TooLarge { time_s, value: packet[i] });
        }
        n_samples += packet.len() as u64;
        resampler.push(&packet, &mut block);
        if block.len() >= BLOCK_SAMPLES {
            visit(&block);
            block.clear();
        }
        if !goes_on {
            break;
        }
        let done_s = n_samples as f64 / f64::from(rate_hz);
        if done_s > options.max_duration_s {
            return Err(RecordingError::TooLong { limit_s: options.max_duration_s });
        }
        if (options.is_late)() {
            return Err(RecordingError::Late { done_s });
        }
    }
    resampler.finish(&mut block);
    visit(&block);
    let (codec, n_channels) = (decoder.codec(), decoder.n_channels());
    Ok((Encoding { codec, sample_rate_hz: rate_hz, n_channels }, decoder.loss()))
}

/// Tells two streams of samples apart (FNV-1a over their bits, in words).
#[derive(Clone, Copy, Debug, PartialEq)]
struct Digest(u64);

impl Default for Digest {
    fn default() -> Self {
        Self(0xcbf2_9ce4_8422_2325)
    }
}

impl Digest {
    fn add(&mut self, samples: &[f32]) {
        for sample in samples {
            self.0 = (self.0 ^ u64::from(sample.to_bits())).wrapping_mul(0x0000_0100_0000_01b3);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Cursor;

    /// A WAV file of 32-bit floats, mono.
    fn wav(rate_hz: u32, samples: &[f32]) -> Vec<u8> {
        let format = hound::SampleFormat::Float;
        let spec = hound::WavSpec {
            channels: 1,
            sample_rate: rate_hz,
            bits_per_sample: 32,
            sample_format: format,
        };
        let mut bytes = Cursor::new(Vec::new());
        let mut writer = hound::WavWriter::new(&mut bytes, spec).expect("a header");
        samples.iter().for_each(|&sample| writer.write_sample(sample).expect("a sample"));
        writer.finalize().expect("an end");
        bytes.into_inner()
    }

    fn options(max_held_samples: usize) -> Options<'static> {
        Options { tuning: None, max_duration_s: 10.0, is_late: &|| false, max_held_samples }
    }

    fn analyse(bytes: &[u8], options: &Options<'_>) -> Result<Recording, RecordingError> {
        Recording::analyse(|| Ok(Cursor::new(bytes)), "wav", options)
    }

    fn tones(n: usize) -> Vec<f32> {
        (0..n).map(|i| (i as f32 * 0.05).sin() * 0.4 + (i as f32 * 0.171).sin() * 0.2).collect()
    }

    #[test]
    fn decoding_twice_gives_what_holding_gives() {
        let bytes = wav(48_000, &tones(70_001));
        let held = analyse(&bytes, &options(usize::MAX)).expect("features");
        let twice = analyse(&bytes, &options(1000)).expect("features");
        assert_eq!(held, twice);
        assert_eq!(held.raw.n_samples, 64_314);
        let encoding = Encoding { codec: "pcm_f32le", sample_rate_hz: 48_000, n_channels: 1 };
        assert_eq!(held.encoding, encoding);
    }

    #[test]
    fn a_file_that_changes_between_the_passes_is_refused() {
        let files = [wav(44_100, &tones(30_000)), wav(44_100, &[0.25; 30_000])];
        let mut n_opened = 0;
        let open = || {
            n_opened += 1;
            Ok(Cursor::new(&files[n_opened - 1]))
        };
        let error = Recording::analyse(open, "wav", &options(0)).expect_err("two contents");
        assert_eq!(
            error.to_string(),
            "changed while it was read; run extract again when nobody writes it"
        );
    }

    #[test]
    #[rustfmt::skip]
    fn limits_are_sentences() {
        let refused = |bytes: &[u8], options: &Options<'_>| {
            let error = analyse(bytes, options).expect_err("refused");
            (error.kind(), error.to_string())
        };
        let sound = wav(44_100, &tones(30_000));
        let mut loud = tones(30_000);
        loud[4410] = -2e20;
        let short = Options { max_duration_s: 0.5, ..options(0) };
        let late = Options { is_late: &|| true, ..options(0) };
        for (found, kind, sentence) in [
            (refused(&sound, &short), "too_long",
             "is longer than 0.5 s, the longest recording that is taken; split it or raise \
              --max-duration"),
            (refused(&wav(44_100, &loud), &options(0)), "audio_data",
             "sample at 0.100 s is -2e20, and full scale is 1; samples above 1e12 are no audio, \
              export the file again, for example as 16-bit integers"),
            (refused(&wav(999, &[0.1; 50]), &options(0)), "audio_sample_rate",
             "has a sample rate of 999 Hz, outside the 1000 to 768000 Hz that are converted; its \
              header is probably damaged, encode it again"),
        ] {
            assert_eq!(found, (kind, sentence.to_owned()));
        }
        let (kind, sentence) = refused(&sound, &late);
        assert_eq!(kind, "timeout");
        assert!(sentence.starts_with("was not done in time, after 0."), "{sentence}");
    }
}
