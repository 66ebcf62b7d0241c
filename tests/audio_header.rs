//! Headers of files encoded by FFmpeg, against what ffprobe says of them.
//!
//! `tests/golden/audio_header/make.py` writes the files, 0.537 s of a sine each, and
//! `expected.json`.

use std::collections::BTreeMap;

use motiongen::audio::header::{AudioHeader, DurationSource, read_header};
use proptest::prelude::*;
use serde_json::Value;

const GOLDEN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/audio_header/");

/// The length of the sine, rounded up to a sample of the lowest rate used, 4 kHz.
const SINE_S: f64 = 0.537;
const SAMPLE_S: f64 = 1.0 / 4_000.0;

fn golden(name: &str) -> Vec<u8> {
    let path = format!("{GOLDEN}{name}");
    std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn expected() -> BTreeMap<String, Value> {
    serde_json::from_slice(&golden("expected.json")).unwrap()
}

fn header(name: &str) -> AudioHeader {
    let extension = name.rsplit('.').next().unwrap_or_default();
    read_header(&golden(name), extension).unwrap_or_else(|error| panic!("{name}: {error}"))
}

#[test]
fn codec_rate_and_channels_are_ffprobes() {
    let expected = expected();
    assert_eq!(expected.len(), 19);
    for (name, probe) in expected {
        let header = header(&name);
        assert_eq!(probe["codec"], header.codec, "{name}");
        assert_eq!(probe["sample_rate_hz"], header.sample_rate_hz, "{name}");
        assert_eq!(probe["n_channels"], header.n_channels, "{name}");
    }
}

#[test]
fn durations_are_ffprobes_where_ffprobe_is_exact() {
    for (name, probe) in expected() {
        let tolerance_s = match name.as_str() {
            // ffprobe 5 counts the delay and padding that the LAME tag tells decoders to drop.
            "cbr_lame.mp3" | "mpeg2_22k.mp3" => continue,
            // ffprobe 5 counts the pre-skip, 312 samples at 48 kHz.
            "opus.opus" | "opus_stereo.ogg" => 0.0066,
            // Without a tag ffprobe divides the file's length by the bit rate.
            "cbr_no_xing.mp3" | "vbr_no_xing.mp3" | "cover.mp3" | "aac.aac" => 0.0025,
            // The edited length of an MP4 file is rounded up to its header's unit, 1 ms.
            "aac.m4a" | "aac_48k_stereo.m4a" => 0.0011,
            _ => 1e-6,
        };
        let (ours_s, theirs_s) = (header(&name).duration_s, probe["duration_s"].as_f64().unwrap());
        assert!((ours_s - theirs_s).abs() <= tolerance_s, "{name}: {ours_s} s, {theirs_s} s");
    }
}

#[test]
fn durations_are_the_sines_where_the_container_can_tell() {
    let untrimmed = ["cbr_no_xing.mp3", "vbr_no_xing.mp3", "cover.mp3", "aac.aac"];
    for name in expected().into_keys() {
        let header = header(&name);
        let counted = untrimmed.contains(&name.as_str());
        let source = if counted || name == "piped.wav" {
            DurationSource::Packets
        } else {
            DurationSource::Header
        };
        assert_eq!(header.duration_source, source, "{name}");
        // Delay and padding of an encoder that the file says nothing of: below three packets of
        // 1,152 samples.
        let excess_s = match name.as_str() {
            _ if counted => 3.0 * 1_152.0 / 44_100.0,
            "aac.m4a" | "aac_48k_stereo.m4a" => 0.0011,
            _ => SAMPLE_S,
        };
        let duration_s = header.duration_s;
        assert!(
            (SINE_S - SAMPLE_S..SINE_S + excess_s).contains(&duration_s),
            "{name}: {duration_s} s"
        );
    }
}

#[test]
fn the_content_decides_and_not_the_name() {
    let bytes = golden("vorbis.ogg");
    let header = read_header(&bytes, "wav").unwrap();
    assert_eq!((header.container.as_str(), header.codec.as_str()), ("ogg", "vorbis"));
    assert_eq!(read_header(&bytes, "").unwrap(), header);
}

#[test]
fn files_cut_short_are_answered_at_every_length() {
    for name in expected().into_keys() {
        let bytes = golden(&name);
        for kept in (0..bytes.len()).step_by(bytes.len() / 50 + 1) {
            if let Ok(header) = read_header(&bytes[..kept], "") {
                assert!(header.duration_s.is_finite() && header.duration_s > 0.0, "{name}");
            }
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn damaged_files_are_answered(
        file: prop::sample::Index,
        damage in proptest::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..20),
    ) {
        let names: Vec<String> = expected().into_keys().collect();
        let mut bytes = golden(&names[file.index(names.len())]);
        // Headers are at the start in all but a few formats, so half of the damage goes there.
        let n_header = bytes.len().min(200);
        for (i, (at, by)) in damage.iter().enumerate() {
            let at = at.index(if i % 2 == 0 { n_header } else { bytes.len() });
            bytes[at] = *by;
        }
        // Symphonia 0.6.1 itself panics on some damaged headers where overflow is checked, for
        // example on an extensible WAV file with over 32 channels; callers catch that.
        if let Ok(Ok(header)) = std::panic::catch_unwind(|| read_header(&bytes, "")) {
            prop_assert!(header.duration_s.is_finite() && header.duration_s > 0.0);
            prop_assert!(header.sample_rate_hz > 0 && header.n_channels > 0);
        }
    }
}
