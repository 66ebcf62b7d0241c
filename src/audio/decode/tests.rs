use std::io::Cursor;

use hound::{SampleFormat, WavSpec, WavWriter};
use proptest::prelude::*;

use super::*;
use crate::audio::container::Edits;

mod damage;

const TESTS: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/");

/// A file's samples, and its rate and channels.
#[derive(Debug, PartialEq)]
struct Decoded {
    samples: Vec<f32>,
    sample_rate_hz: u32,
    n_channels: u16,
}

/// Decodes to the end; the samples before an error are dropped.
fn decode(bytes: &[u8]) -> Result<Decoded, DecodeError> {
    let mut decoder = Decoder::open(Cursor::new(bytes), "")?;
    let mut samples = Vec::new();
    loop {
        let n_before = samples.len();
        let goes_on = decoder.next_block(&mut samples)?;
        assert_eq!(samples.len() > n_before, goes_on, "a block is never empty");
        if !goes_on {
            break;
        }
    }
    assert!(!decoder.next_block(&mut samples).unwrap(), "the end stays");
    let (sample_rate_hz, n_channels) = (decoder.sample_rate_hz(), decoder.n_channels());
    Ok(Decoded { samples, sample_rate_hz, n_channels })
}

fn golden(name: &str) -> Vec<u8> {
    std::fs::read(format!("{TESTS}golden/audio_header/{name}")).unwrap()
}

/// An integer WAV file; hound writes WAVE_FORMAT_EXTENSIBLE beyond 2 channels or 16 bits.
fn wav(sample_rate: u32, channels: u16, bits_per_sample: u16, samples: &[i32]) -> Vec<u8> {
    let spec = WavSpec { channels, sample_rate, bits_per_sample, sample_format: SampleFormat::Int };
    write(spec, samples)
}

fn float_wav(channels: u16, samples: &[f32]) -> Vec<u8> {
    let (sample_rate, sample_format) = (8_000, SampleFormat::Float);
    write(WavSpec { channels, sample_rate, bits_per_sample: 32, sample_format }, samples)
}

fn write<S: hound::Sample + Copy>(spec: WavSpec, samples: &[S]) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = WavWriter::new(&mut bytes, spec).unwrap();
    for &sample in samples {
        writer.write_sample(sample).unwrap();
    }
    writer.finalize().unwrap();
    bytes.into_inner()
}

#[track_caller]
fn says(bytes: &[u8], kind: &str, sentence: &str) {
    let error = decode(bytes).map(|decoded| decoded.samples.len()).unwrap_err();
    assert_eq!((error.kind(), error.to_string().as_str()), (kind, sentence));
}

#[test]
fn integers_of_each_width_are_scaled_by_their_largest() {
    for (bits, low, high) in [
        (8, -128, 127),
        (16, -32_768, 32_767),
        (24, -8_388_608, 8_388_607),
        (32, i32::MIN, i32::MAX),
    ] {
        let scale = 2_f64.powi(bits - 1);
        let values = [low, high, 0, 1, -1, low / 3];
        let expected: Vec<f32> = values.iter().map(|&v| (f64::from(v) / scale) as f32).collect();
        for channels in [1, 2] {
            // Twice the same value has that value as its mean.
            let samples: Vec<i32> =
                values.iter().flat_map(|&v| std::iter::repeat_n(v, channels)).collect();
            let decoded = decode(&wav(192_000, channels as u16, bits as u16, &samples)).unwrap();
            assert_eq!(decoded.samples, expected, "{bits} bits, {channels} channels");
            assert_eq!((decoded.sample_rate_hz, decoded.n_channels), (192_000, channels as u16));
        }
    }
}

#[test]
fn one_sample_is_a_file() {
    assert_eq!(decode(&wav(44_100, 1, 16, &[-16_384])).unwrap().samples, [-0.5]);
}

#[test]
fn the_mean_of_channels_is_numpys() {
    // np.mean(np.float32([...]).reshape(1, -1).T, axis=0); a sum from left to right gives
    // 0.46249998 for eight channels.
    let x = [1e8, 1.0, -1e8, 1.0, 3.0, 0.1, -0.7, 0.3, 1e-3];
    for (n_channels, mean) in [(2, 5e7), (3, 0.0), (5, 0.8), (8, 0.337_499_98), (9, 0.300_111_1)] {
        let decoded = decode(&float_wav(n_channels, &x[..usize::from(n_channels)])).unwrap();
        assert_eq!(decoded.samples, [mean], "{n_channels} channels");
    }
    // The sum starts at 0, so only one channel can give -0.
    assert_eq!(decode(&float_wav(2, &[-0.0, -0.0])).unwrap().samples[0].to_bits(), 0);
    assert_eq!(decode(&float_wav(1, &[-0.0])).unwrap().samples[0].to_bits(), 1 << 31);
}

#[test]
fn an_uncompressed_file_cut_short_gives_all_its_whole_frames() {
    let samples: Vec<i32> = (0..6_000).collect();
    let whole = wav(8_000, 2, 24, &samples);
    let means: Vec<f32> =
        samples.chunks(2).map(|pair| (pair[0] + pair[1]) as f32 / 2_f32.powi(24)).collect();
    assert_eq!(decode(&whole).unwrap().samples, means);
    let n_head = whole.len() - 3 * 6_000;
    for n_frames in [1, 1_151, 1_152, 1_153, 2_999] {
        let cut = &whole[..n_head + 6 * n_frames + 5];
        assert_eq!(decode(cut).unwrap().samples, means[..n_frames], "{n_frames} frames");
    }
    let aiff = golden("pcm16.aiff");
    let n_samples = decode(&aiff).unwrap().samples.len();
    let cut = decode(&aiff[..aiff.len() - 1_001]).unwrap().samples.len();
    assert_eq!(n_samples - cut, 501);
}

#[test]
fn sizes_in_a_wav_header_that_are_placeholders_are_not_believed() {
    let samples = [1, 2, 3];
    let whole = wav(8_000, 1, 16, &samples);
    let expected = decode(&whole).unwrap();
    for (riff, data) in [(0, 6), (20, 6), (u32::MAX, u32::MAX), (6, 0x7fff_f000)] {
        let mut bytes = whole.clone();
        bytes[4..8].copy_from_slice(&riff.to_le_bytes());
        let at = bytes.len() - 10;
        bytes[at..at + 4].copy_from_slice(&data.to_le_bytes());
        assert_eq!(decode(&bytes).unwrap(), expected, "RIFF {riff}, data {data}");
    }
}

#[test]
fn samples_are_those_of_libsndfile_and_ffmpeg() {
    let text =
        std::fs::read_to_string(format!("{TESTS}golden/audio_decode/expected.json")).unwrap();
    let expected: serde_json::Value = serde_json::from_str(&text).unwrap();
    for (name, file) in expected.as_object().unwrap() {
        let decoded = decode(&std::fs::read(format!("{TESTS}{name}")).unwrap()).unwrap();
        assert_eq!(Some(u64::from(decoded.sample_rate_hz)), file["sample_rate_hz"].as_u64());
        assert_eq!(Some(decoded.samples.len() as u64), file["n_samples"].as_u64(), "{name}");
        let lossless = ["wav", "aiff", "flac"].iter().any(|end| name.ends_with(end));
        // Decoders may round differently; libmpg123's and symphonia's differ by 1.9e-6 on music.
        let tolerance = if lossless { 0.0 } else { 4e-6 };
        for place in file["places"].as_array().unwrap() {
            let start = place[0].as_u64().unwrap() as usize;
            for (offset, want) in place[1].as_array().unwrap().iter().enumerate() {
                let (got, want) = (decoded.samples[start + offset], want.as_f64().unwrap() as f32);
                assert!(
                    (got - want).abs() <= tolerance,
                    "{name}, sample {}: got {got}, want {want}",
                    start + offset
                );
            }
        }
    }
}

#[test]
fn tags_of_any_length_before_the_audio_are_skipped() {
    let tag = |n_bytes: u32| {
        let size = [21, 14, 7, 0].map(|shift| (n_bytes >> shift & 0x7f) as u8);
        [b"ID3\x04\0\0".as_slice(), &size, &vec![0xff; n_bytes as usize]].concat()
    };
    for name in ["cbr_lame.mp3", "sine.flac", "pcm16.wav"] {
        let bytes = golden(name);
        let tagged = [tag(3), tag(200_000), bytes.clone()].concat();
        assert_eq!(decode(&tagged).unwrap(), decode(&bytes).unwrap(), "{name}");
    }
}

#[test]
fn bytes_after_the_audio_are_no_samples() {
    let id3v1 = [b"TAG".as_slice(), &[b'x'; 125]].concat();
    for name in
        ["cbr_lame.mp3", "cbr_no_xing.mp3", "sine.flac", "vorbis.ogg", "pcm16.wav", "aac.m4a"]
    {
        let bytes = golden(name);
        let expected = decode(&bytes).unwrap();
        for tail in [id3v1.clone(), vec![0; 3_000]] {
            let longer = [bytes.clone(), tail].concat();
            assert!(decode(&longer).unwrap() == expected, "{name}");
        }
    }
}

#[test]
fn a_compressed_file_cut_short_gives_the_samples_before_the_cut() {
    let headers = "golden/audio_header";
    for name in [
        &format!("{headers}/cbr_lame.mp3"),
        &format!("{headers}/cbr_no_xing.mp3"),
        &format!("{headers}/sine.flac"),
        &format!("{headers}/aac.aac"),
        "data/music/parsec47/ptn1.ogg",
    ] {
        let bytes = std::fs::read(format!("{TESTS}{name}")).unwrap();
        let whole = decode(&bytes).unwrap().samples;
        let cut = decode(&bytes[..bytes.len() * 4 / 5]).unwrap().samples;
        assert!(cut.len() < whole.len() && cut.len() > whole.len() / 3, "{name}: {}", cut.len());
        assert!(cut == whole[..cut.len()], "{name}");
    }
}

#[test]
fn nested_mp4_atoms_are_no_danger() {
    let mut bytes = b"\0\0\0\x0cftypM4A ".to_vec();
    let n_atoms = 100_000_u32;
    for atom in (1..=n_atoms).rev() {
        bytes.extend_from_slice(&(8 * atom).to_be_bytes());
        bytes.extend_from_slice(b"edts");
    }
    let error = decode(&bytes).map(|decoded| decoded.samples.len()).unwrap_err();
    assert_eq!(error.kind(), "audio_header", "{error}");
}

#[test]
fn mp4_edits_come_from_the_list_or_else_from_itunes() {
    let atom = |name: &str, content: &[u8]| {
        [&(content.len() as u32 + 8).to_be_bytes(), name.as_bytes(), content].concat()
    };
    let words =
        |words: &[u32]| words.iter().flat_map(|word| word.to_be_bytes()).collect::<Vec<_>>();
    let text = b"\0\0\0\x01\0\0\0\0 00000000 00000840 0000012C 0000000000005678 00000000";
    let tag = [
        atom("mean", b"\0\0\0\0com.apple.iTunes"),
        atom("name", b"\0\0\0\0iTunSMPB"),
        atom("data", text),
    ];
    let meta = atom("meta", &[words(&[0]), atom("ilst", &atom("----", &tag.concat()))].concat());
    let track = |more: &[u8]| {
        let media = atom("mdia", &atom("mdhd", &words(&[0, 0, 0, 22_050, 0, 0])));
        atom("trak", &[atom("tkhd", &words(&[0, 0, 0, 7, 0])), media, more.to_vec()].concat())
    };
    let read = |track: Vec<u8>| {
        let header = atom("mvhd", &words(&[0, 0, 0, 1_000, 0]));
        let file = atom("moov", &[header, track, atom("udta", &meta)].concat());
        Edits::read(&mut Cursor::new(&file), file.len() as u64).unwrap()
    };
    let tagged = read(track(b""));
    assert_eq!(tagged.of_track(7, 44_100, None), Some((0x840, 0x840 + 0x5678)));
    assert_eq!(tagged.of_track(8, 44_100, None), None);

    // An empty edit of 1 s, then one from 512/22050 s that lasts 2.5 s.
    let list = words(&[0, 2, 1_000, u32::MAX, 1 << 16, 2_500, 512, 1 << 16]);
    let edited = read(track(&atom("edts", &atom("elst", &list))));
    assert_eq!(edited.of_track(7, 44_100, None), Some((1_024, 1_024 + 110_250)));
    assert_eq!(edited.of_track(7, 44_100, Some(100_000)), Some((1_024, 100_000)));
}

/// Where the frames of the golden MP3 file without a tag start: 64 kbit/s at 44.1 kHz.
fn mp3_frames(bytes: &[u8]) -> Vec<usize> {
    let first = bytes.windows(2).position(|two| two == [0xff, 0xfb]).unwrap();
    let next = |&start: &usize| {
        let padding = usize::from(*bytes.get(start + 2)? >> 1 & 1);
        Some(start + 144 * 64_000 / 44_100 + padding).filter(|&start| start < bytes.len())
    };
    std::iter::successors(Some(first), next).collect()
}

#[test]
fn junk_between_mp3_frames_is_skipped() {
    let bytes = golden("cbr_no_xing.mp3");
    let whole = decode(&bytes).unwrap();
    let at = mp3_frames(&bytes)[9];
    // Sync words without a second one at the right distance, and another rate's.
    for junk in [vec![0; 5_000], vec![0xff; 700], b"\xff\xfb\x94\xc4".repeat(50)] {
        let with_junk = [&bytes[..at], &junk, &bytes[at..]].concat();
        assert!(decode(&with_junk).unwrap() == whole, "{} bytes", junk.len());
    }
}
