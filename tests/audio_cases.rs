//! Files that people really have, against what libsndfile and FFmpeg read of them.
//!
//! `tests/data/audio_cases/make.py` writes `expected.json`.

use std::io::Cursor;

use motiongen::audio::decode::{DecodeError, Decoder, Loss};
use motiongen::audio::header::read_header;
use serde_json::Value;

const CASES: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/data/audio_cases/");

fn case(name: &str) -> Vec<u8> {
    std::fs::read(format!("{CASES}{name}")).unwrap_or_else(|error| panic!("{name}: {error}"))
}

struct Decoded {
    samples: Vec<f32>,
    sample_rate_hz: u32,
    n_channels: u16,
    loss: Loss,
}

fn decode(bytes: &[u8]) -> Result<Decoded, DecodeError> {
    let mut decoder = Decoder::open(Cursor::new(bytes), "")?;
    let mut samples = Vec::new();
    while decoder.next_block(&mut samples)? {}
    let (sample_rate_hz, n_channels) = (decoder.sample_rate_hz(), decoder.n_channels());
    Ok(Decoded { samples, sample_rate_hz, n_channels, loss: decoder.loss() })
}

/// Samples at the end of the reference that the file's edit list cuts and FFmpeg does not.
fn surplus(name: &str) -> i64 {
    match name {
        "a33c_mp3.m4a" => 227,
        "aac_96k.m4a" => 960,
        _ => 0,
    }
}

#[test]
fn files_are_read_as_the_references_read_them() {
    let expected: Value = serde_json::from_slice(&case("expected.json")).unwrap();
    let expected = expected.as_object().unwrap();
    assert_eq!(expected.len(), 38);
    let mut wrong = Vec::new();
    for (name, file) in expected {
        let bytes = case(name);
        let decoded = decode(&bytes).unwrap_or_else(|error| panic!("{name}: {error}"));
        assert_eq!(Some(u64::from(decoded.sample_rate_hz)), file["sample_rate_hz"].as_u64());
        assert_eq!(Some(u64::from(decoded.n_channels)), file["n_channels"].as_u64(), "{name}");
        let n_samples = file["n_samples"].as_i64().unwrap() - surplus(name);
        if decoded.samples.len() as i64 != n_samples {
            wrong.push(format!("{name}: {} samples, want {n_samples}", decoded.samples.len()));
            continue;
        }
        let lossless =
            ["wav", "w64", "au", "aif", "flac", "mov"].iter().any(|end| name.ends_with(end))
                && name != "a06_mp3_in.wav";
        // Decoders of lossy codecs may round differently; Opus' speech part is in integers.
        let tolerance = match name.as_str() {
            _ if lossless || name.starts_with("alac") => 0.0,
            _ if name.starts_with("opus") => 1e-4,
            "a31_adts.aac" | "a47_asc_core_coder.m4a" | "aac_96k.m4a" => 2e-5,
            _ => 4e-6,
        };
        let mut worst = 0.0_f32;
        for place in file["places"].as_array().unwrap() {
            let start = place[0].as_u64().unwrap() as usize;
            for (got, want) in decoded.samples[start.min(decoded.samples.len())..]
                .iter()
                .zip(place[1].as_array().unwrap())
            {
                worst = worst.max((got - want.as_f64().unwrap() as f32).abs());
            }
        }
        if worst > tolerance {
            wrong.push(format!("{name}: off by {worst}"));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// The header's length is the decoder's to one frame of features, or the loss says what is missing.
#[test]
fn headers_say_what_decoding_gives() {
    let expected: Value = serde_json::from_slice(&case("expected.json")).unwrap();
    for name in expected.as_object().unwrap().keys() {
        let bytes = case(name);
        let header = read_header(&bytes, "").unwrap_or_else(|error| panic!("{name}: {error}"));
        let Decoded { samples, sample_rate_hz, loss, .. } = decode(&bytes).unwrap();
        let given_s = samples.len() as f64 / f64::from(sample_rate_hz);
        let missing_s = header.duration_s - given_s;
        if name == "half_flac.flac" {
            assert!(loss.is_truncated, "{name}");
            assert!((missing_s - loss.lost_s).abs() < 1e-9 && missing_s > 5.0, "{loss:?}");
        } else {
            assert!(missing_s.abs() <= 1.0 / 30.0, "{name}: {missing_s} s more by its header");
            assert_eq!(loss, Loss::default(), "{name}");
        }
    }
}

#[test]
fn codecs_that_are_not_read_are_named_with_the_way_out() {
    for (name, sentence) in [
        (
            "a08_vorbis_in.wav",
            "audio is Vorbis in RIFF, which this program does not decode; convert it, for example \
             with: ffmpeg -i in.wav out.flac",
        ),
        (
            "a34c_gsm.wav",
            "audio is GSM 6.10, which this program does not decode; convert it, for example with: \
             ffmpeg -i in.wav out.flac",
        ),
    ] {
        let bytes = case(name);
        let header = read_header(&bytes, "wav").unwrap_err();
        assert_eq!((header.kind(), header.to_string().as_str()), ("audio_codec", sentence));
        let decoder = decode(&bytes).map(|decoded| decoded.samples.len()).unwrap_err();
        assert_eq!((decoder.kind(), decoder.to_string().as_str()), ("audio_codec", sentence));
    }
}

#[test]
fn channels_with_different_blocks_are_not_silent() {
    let [differ, same] = ["a54_ms_block_types_differ.mp3", "a54b_ms_same_blocks.mp3"]
        .map(|name| decode(&case(name)).unwrap());
    assert_eq!(differ.loss, Loss::default());
    assert_eq!(differ.samples.len(), same.samples.len());
    let power = |samples: &[f32]| samples.iter().map(|x| f64::from(x * x)).sum::<f64>();
    let ratio = power(&differ.samples) / power(&same.samples);
    assert!((0.5..2.0).contains(&ratio), "{ratio}");
}

/// Formats that begin with a mark are refused by their name, as codecs are: they are audio.
#[test]
fn formats_that_are_not_read_are_named_with_the_way_out() {
    let mut transport = vec![0x20; 600];
    for packet in transport.chunks_mut(188) {
        packet[0] = 0x47;
    }
    let mut speex = vec![0; 600];
    speex[..6].copy_from_slice(b"OggS\0\x02");
    speex[26..28].copy_from_slice(&[1, 80]);
    speex[28..36].copy_from_slice(b"Speex   ");
    let long = |start: &[u8]| [start, &[0x55; 600]].concat();
    for (bytes, name, extension) in [
        (long(b"wvpk\x10\x20"), "WavPack", "wv"),
        (long(b"TTA1\x01"), "True Audio (TTA)", "tta"),
        (long(b"MAC \x96\x0f"), "Monkey's Audio", "ape"),
        (long(b"\x7f\xfe\x80\x01\xfc"), "DTS", "dts"),
        (long(b"\x0b\x77\x01\x1f\x14\x40"), "AC-3", "ac3"),
        (long(b"RIFF\x10\x20\0\0AVI LIST"), "in an AVI video", "avi"),
        (long(b"FORM\0\0\x10\x208SVXVHDR"), "in an 8SVX file", "svx"),
        (long(b"Creative Voice File\x1a"), "in a Creative Voice File", "voc"),
        (transport, "in an MPEG transport stream", "ts"),
        (speex, "Speex", "spx"),
    ] {
        let sentence = format!(
            "audio is {name}, which this program does not decode; convert it, for example with: ffmpeg -i \
             in.{extension} out.flac"
        );
        let header = read_header(&bytes, extension).unwrap_err();
        assert_eq!((header.kind(), header.to_string()), ("audio_codec", sentence.clone()));
        let decoder = decode(&bytes).map(|decoded| decoded.samples.len()).unwrap_err();
        assert_eq!((decoder.kind(), decoder.to_string()), ("audio_codec", sentence));
    }
}

/// A CAF file that was cut is no file of an unknown kind.
#[test]
fn a_caf_file_that_was_cut_may_be_cut_short() {
    let whole = case("alac.caf");
    let error = read_header(&whole[..whole.len() / 2], "caf").unwrap_err().to_string();
    assert!(error.starts_with("audio header cannot be read from "), "{error}");
    assert!(error.ends_with("the file may be cut short, copy or download it again"), "{error}");
}
