//! Broken and odd files beside sound ones: each fails or gives features by itself.

use std::f64::consts::TAU;
use std::io::{Cursor, Write as _};
use std::path::Path;

use motiongen::audio::decode::Decoder;

use super::{
    Archive, Values, assert_consistent, extract, extract_files, extractions, features, golden, read,
};
use crate::support::files::{wav, wav_of};
use crate::support::{Dir, failures, ingest};

/// The chroma of A.
const A: usize = 128 + 9;
const RMS: usize = 160;

/// Returns a mono WAV file of 32-bit floats.
pub(super) fn float_wav(rate_hz: u32, samples: &[f32]) -> Vec<u8> {
    let spec = hound::WavSpec {
        channels: 1,
        sample_rate: rate_hz,
        bits_per_sample: 32,
        sample_format: hound::SampleFormat::Float,
    };
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = hound::WavWriter::new(&mut bytes, spec).unwrap();
    samples.iter().for_each(|&sample| writer.write_sample(sample).unwrap());
    writer.finalize().unwrap();
    bytes.into_inner()
}

/// Returns a WAV file of integers in which all channels hold 440 Hz.
fn sine_wav(rate_hz: u32, n_channels: u16, bits: u16, n_frames: u32) -> Vec<u8> {
    let sample_format = hound::SampleFormat::Int;
    let spec = hound::WavSpec {
        channels: n_channels,
        sample_rate: rate_hz,
        bits_per_sample: bits,
        sample_format,
    };
    let mut bytes = Cursor::new(Vec::new());
    let mut writer = hound::WavWriter::new(&mut bytes, spec).unwrap();
    let peak = 0.3 * f64::from(1_i32 << (bits - 1));
    for i in 0..n_frames {
        let value = peak * (TAU * 440.0 * f64::from(i) / f64::from(rate_hz)).sin();
        (0..n_channels).for_each(|_| writer.write_sample(value as i32).unwrap());
    }
    writer.finalize().unwrap();
    bytes.into_inner()
}

fn mono_16_bit(rate_hz: u32, samples: impl IntoIterator<Item = i16>) -> Vec<u8> {
    let samples: Vec<u8> = samples.into_iter().flat_map(i16::to_le_bytes).collect();
    wav_of(rate_hz, 1, &samples)
}

/// Returns the mono samples of a file, and their rate.
fn decode(bytes: &[u8], extension: &str) -> (Vec<f32>, u32) {
    let mut decoder = Decoder::open(Cursor::new(bytes), extension).unwrap();
    let mut samples = Vec::new();
    while decoder.next_block(&mut samples).unwrap() {}
    (samples, decoder.sample_rate_hz())
}

/// Returns `(kind, message)` of every failure.
fn told(store: &Path) -> Vec<(String, String, String)> {
    failures(store).into_iter().map(|(id, row)| (id, row.kind, row.message)).collect()
}

#[test]
fn files_that_were_cut_short_give_what_is_left_of_them() {
    let dir = Dir::new();
    let clips = [
        "short_200ms_stereo.wav",
        "music_44k_stereo_s24.flac",
        "music_44k_stereo.mp3",
        "music_48k_stereo.ogg",
    ];
    let mut prefixes = Vec::new();
    for clip in clips {
        let (name, extension) = clip.split_once('.').unwrap();
        let whole = read(&golden(&format!("audio/{clip}")));
        let cut = &whole[..whole.len() / 3];
        dir.write(format!("source/audio/{name}/{extension}.{extension}"), cut);
        // What is left is the beginning of the whole, and most of the third that the bytes are.
        let (all, rate_hz) = decode(&whole, extension);
        let (left, _) = decode(cut, extension);
        assert!(all.starts_with(&left), "{clip}: not a beginning");
        assert!(left.len() > all.len() / 6 && left.len() < all.len(), "{clip}: {}", left.len());
        dir.write(format!("prefixes/{extension}.wav"), float_wav(rate_hz, &left));
        prefixes.push(dir.at(format!("prefixes/{extension}.wav")));
    }
    let (source, store) = (dir.at("source"), dir.at("store"));
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_consistent(&store);
    assert_eq!(extract_files(&prefixes, &dir.at("expected"), &[]).code, 0);
    let frames = features(&store);
    assert_eq!(frames.len(), 4);
    for (id, frames) in frames {
        let (_, extension) = id.rsplit_once('/').unwrap();
        let expected = Archive::read(&dir.at(format!("expected/{extension}.npz"))).frames();
        assert!(frames == expected, "{id}: frames differ");
    }
}

#[test]
fn odd_recordings_have_finite_features() {
    let dir = Dir::new();
    let song = |name: &str, bytes: Vec<u8>| dir.write(format!("source/audio/{name}.wav"), bytes);
    song("8-khz", sine_wav(8_000, 1, 16, 4_000));
    song("192-khz", sine_wav(192_000, 8, 24, 19_200));
    song("one-sample", mono_16_bit(44_100, [16_384]));
    song("silence", mono_16_bit(44_100, [0; 11_025]));
    song("dc", mono_16_bit(44_100, [8_192; 11_025]));
    let square = |i: u32| {
        let half = (f64::from(i) * 880.0 / 44_100.0) as u32;
        if half.is_multiple_of(2) { i16::MAX } else { i16::MIN }
    };
    song("clipped", mono_16_bit(44_100, (0..22_050).map(square)));
    let (source, store) = (dir.at("source"), dir.at("store"));
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_consistent(&store);

    let rows = extractions(&store);
    let lengths = rows.values().map(|row| (row.phrase_id.as_str(), row.n_samples, row.n_frames));
    let expected = [
        ("192-khz", Some(4_410), 4),
        ("8-khz", Some(22_050), 16),
        ("clipped", Some(22_050), 16),
        ("dc", Some(11_025), 8),
        ("one-sample", Some(1), 1),
        ("silence", Some(11_025), 8),
    ];
    assert_eq!(lengths.collect::<Vec<_>>(), expected);
    let row = &rows["192-khz"];
    let encoding = (row.audio_codec.as_deref(), row.sample_rate_hz, row.n_channels);
    assert_eq!(encoding, (Some("pcm_s24le"), Some(192_000), Some(8)));

    let features = features(&store);
    let column = |id: &str, k: usize| features[id].iter().map(|v| v[k]).collect::<Vec<_>>();
    // Nothing gives nothing, whatever it is divided by.
    assert!(features["silence"].as_flattened().iter().all(|&x| x == 0.0));
    assert_eq!((rows["silence"].tempo_bpm, rows["silence"].tuning), (None, Some(0.0)));
    // 440 Hz is A in all three, in every frame.
    for id in ["8-khz", "192-khz", "clipped"] {
        assert!(column(id, A).iter().all(|&x| x == 1.0), "{id}: {:?}", column(id, A));
    }
    // Of the 2048 samples around frames 0 and 7, 1024 and 1759 lie within the recording. The highest
    // is 1 but for what keeps it from being a division by 0.
    let expected = [0.5_f64.sqrt(), 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, (1759.0_f64 / 2048.0).sqrt()];
    for (x, expected) in column("dc", RMS).into_iter().zip(expected) {
        assert!((f64::from(x) - expected).abs() < 1e-6, "{:?}", column("dc", RMS));
    }
    let golden = Archive::read(&golden("audio/one_sample.npz")).frames();
    let worst =
        |a: &Values, b: &Values| a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
    // Tolerance of librosa's chroma; all that is not scaled over the file is that near.
    assert_eq!(golden.len(), 1);
    assert!(worst(&features["one-sample"][0], &golden[0]) < 1e-4);
}

/// A phrase that fails, and why.
type Refusal = (&'static str, &'static str, &'static str);

#[rustfmt::skip]
const REFUSED: [Refusal; 6] = [
    ("changed", "changed",
        "audio/changed.wav: has 4846 bytes but had 4844 when it was looked at; run ingest again, \
         then extract"),
    ("corrupt", "audio_data",
        "audio/corrupt.flac: flac data is damaged at 0.46 s (a frame's checksum does not match); \
         re-encode or restore the file"),
    ("glitch", "audio_data",
        "audio/glitch.mp3: mp3 data is damaged at 0.24 s, and 0.03 s of it cannot be decoded; \
         re-encode or restore the file"),
    ("gone", "unreadable", "{source}/audio/gone.wav: not found"),
    ("infinite", "audio_not_finite",
        "audio/infinite.wav: sample at 0.499 s is infinite; samples must be finite, export the file \
         again, for example as 16-bit integers"),
    ("nan", "audio_not_finite",
        "audio/nan.wav: sample at 0.250 s is NaN; samples must be finite, export the file again, for \
         example as 16-bit integers"),
];

#[test]
fn broken_files_fail_alone_and_are_done_once_repaired() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    for name in ["sound-1", "changed", "gone", "sound-2"] {
        dir.write(format!("source/audio/{name}.wav"), wav(0.3));
    }
    let flac = read(&golden("audio/sine_440_plus_35_cents.flac"));
    let mut corrupt = flac.clone();
    let middle = corrupt.len() / 2;
    corrupt[middle..middle + 300].fill(0);
    dir.write("source/audio/corrupt.flac", corrupt);
    let mut samples = [0.1; 4_000];
    samples[2_000] = f32::NAN;
    dir.write("source/audio/nan.wav", float_wav(8_000, &samples));
    samples[2_000] = 0.1;
    samples[3_992] = f32::INFINITY;
    dir.write("source/audio/infinite.wav", float_wav(8_000, &samples));
    let mut glitch = read(&golden("audio_header/cbr_no_xing.mp3"));
    // The tenth frame of 64 kbit/s, but for its header.
    let first = glitch.windows(2).position(|two| two == [0xff, 0xfb]).unwrap();
    let tenth = (first + 9 * 208..).find(|&at| glitch[at..].starts_with(&[0xff, 0xfb])).unwrap();
    glitch[tenth + 4..tenth + 204].fill(0xff);
    dir.write("source/audio/glitch.mp3", glitch);
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let mut file =
        std::fs::OpenOptions::new().append(true).open(source.join("audio/changed.wav")).unwrap();
    file.write_all(&[0; 2]).unwrap();
    drop(file);
    std::fs::remove_file(source.join("audio/gone.wav")).unwrap();

    let expected = REFUSED.map(|(id, kind, message)| {
        (id.to_owned(), kind.to_owned(), message.replace("{source}", source.to_str().unwrap()))
    });
    let output = extract(&store, &["--workers", "3"]);
    assert_eq!(output.code, 1, "{output:?}");
    assert_eq!(told(&store), expected);
    let lines: Vec<_> = output.stdout.lines().collect();
    assert!(
        lines[1].starts_with("  2 phrases extracted (0.6 s, 20 frames), 0 up to date, 6 failed; "),
        "{}",
        lines[1]
    );
    let said =
        expected.iter().map(|(id, kind, message)| format!("  failed [{kind}] {id}: {message}"));
    assert_eq!(lines[2..8], said.collect::<Vec<_>>());
    for (id, row) in failures(&store) {
        assert_eq!(row.stage, "extract");
        let extension = match id.as_str() {
            "corrupt" => "flac",
            "glitch" => "mp3",
            _ => "wav",
        };
        let path = source.join(format!("audio/{id}.{extension}"));
        assert_eq!(row.source, url::Url::from_file_path(path).unwrap().as_str());
    }
    assert_eq!(extractions(&store).into_keys().collect::<Vec<_>>(), ["sound-1", "sound-2"]);
    assert_consistent(&store);

    // Tried again, they fail the same, and nothing is written.
    let before = super::contents(&store);
    let output = extract(&store, &[]);
    assert_eq!(output.code, 1, "{output:?}");
    assert!(
        output.stdout.contains("  0 phrases extracted (0.0 s, 0 frames), 2 up to date, 6 failed; "),
        "{}",
        output.stdout
    );
    super::contents(&store).assert_same_as(&before);

    dir.write("source/audio/corrupt.flac", flac);
    dir.write("source/audio/gone.wav", wav(0.3));
    samples[3_992] = 0.1;
    for name in ["nan", "infinite"] {
        dir.write(format!("source/audio/{name}.wav"), float_wav(8_000, &samples));
    }
    std::fs::remove_file(source.join("audio/glitch.mp3")).unwrap();
    dir.write("source/audio/glitch.wav", wav(0.2));
    let output = ingest(&source, &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(told(&store), []);
    assert_consistent(&store);
    let found = extractions(&store);
    let ids = ["changed", "corrupt", "glitch", "gone", "infinite", "nan", "sound-1", "sound-2"];
    assert_eq!(found.keys().collect::<Vec<_>>(), ids);
    let frames = features(&store);
    assert!(frames["gone"] == frames["sound-1"], "one file, two sets of features");
    assert!(frames["nan"] == frames["infinite"], "one file, two sets of features");
    assert_eq!(found["corrupt"].n_samples, Some(44_100));
}

#[test]
fn a_file_that_was_done_and_is_gone_keeps_its_rows() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    dir.write("source/audio/a.wav", wav(0.3));
    dir.write("source/audio/b.wav", wav(0.2));
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    assert_eq!(extract(&store, &[]).code, 0);
    let frames = features(&store);
    std::fs::remove_file(source.join("audio/a.wav")).unwrap();
    let output = extract(&store, &["--force"]);
    assert_eq!(output.code, 1, "{output:?}");
    assert!(features(&store) == frames, "rows went away");
    let message = format!("{}/audio/a.wav: not found", source.display());
    let expected = ("a @ extract".to_owned(), "unreadable".to_owned(), message);
    assert_eq!(told(&store), [expected]);
    assert_consistent(&store);

    dir.write("source/audio/a.wav", wav(0.3));
    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(told(&store), []);
    assert!(features(&store) == frames, "frames differ");
}

#[test]
fn a_file_that_was_done_and_is_replaced_by_a_broken_one_loses_its_rows() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    dir.write("source/audio/a.wav", wav(0.3));
    dir.write("source/audio/b.wav", wav(0.2));
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    assert_eq!(extract(&store, &[]).code, 0);
    let sound = features(&store);
    dir.write("source/audio/a.wav", float_wav(8_000, &[f32::NEG_INFINITY]));
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    let output = extract(&store, &[]);
    assert_eq!(output.code, 1, "{output:?}");
    let message = "audio/a.wav: sample at 0.000 s is infinite; samples must be finite, export the \
                   file again, for example as 16-bit integers";
    let expected = ("a".to_owned(), "audio_not_finite".to_owned(), message.to_owned());
    assert_eq!(told(&store), [expected]);
    assert_consistent(&store);
    let found = features(&store);
    assert!(found.keys().eq(["b"]) && found["b"] == sound["b"], "{:?}", found.keys());

    // A shard that has nothing to do with it leaves the failure alone; the others come back to it.
    dir.write("source/audio/a.wav", wav(0.3));
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    let outputs = ["0/2", "1/2"].map(|shard| extract(&store, &["--shard", shard]));
    assert!(outputs.iter().all(|output| output.code == 0), "{outputs:?}");
    assert_eq!(told(&store), []);
    assert!(features(&store) == sound, "frames differ");
}

#[test]
fn limits_fail_the_files_beyond_them() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    dir.write("source/audio/long.wav", wav(3.5));
    dir.write("source/audio/short.wav", wav(0.2));
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    let output = extract(&store, &["--max-duration", "3"]);
    assert_eq!(output.code, 1, "{output:?}");
    let message = "audio/long.wav: is longer than 3 s, the longest recording that is taken; split it \
                   or raise --max-duration";
    assert_eq!(told(&store), [("long".to_owned(), "too_long".to_owned(), message.to_owned())]);
    assert_eq!(extractions(&store).into_keys().collect::<Vec<_>>(), ["short"]);

    // Late after its first packet; where that ends is the decoder's affair.
    let output = extract(&store, &["--timeout", "1e-9"]);
    assert_eq!(output.code, 1, "{output:?}");
    let [(id, kind, message)] = told(&store).try_into().unwrap();
    assert_eq!((id.as_str(), kind.as_str()), ("long", "timeout"));
    assert!(message.starts_with("audio/long.wav: was not done in time, after 0."), "{message}");
    assert!(message.ends_with(" s of its audio; raise --timeout or look at the file"), "{message}");
    assert_eq!(extractions(&store).into_keys().collect::<Vec<_>>(), ["short"]);

    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(told(&store), []);
    assert_eq!(extractions(&store)["long"].n_samples, Some(154_350));
    assert_consistent(&store);
}

#[test]
fn a_file_that_ends_early_is_told_and_marked() {
    let dir = Dir::new();
    let (source, store) = (dir.at("source"), dir.at("store"));
    let case = |name: &str| {
        read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/audio_cases").join(name))
    };
    dir.write("source/audio/half.flac", case("half_flac.flac"));
    // A chain of two links, and names that are less usual.
    dir.write("source/audio/chain.oga", case("a19_chained_same.ogg"));
    dir.write("source/audio/adts.aac", case("a31_adts.aac"));
    assert_eq!(ingest(&source, &store, &[]).code, 0);
    let output = extract(&store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let line = "  half ends before its header says: 5.38 s are missing\n";
    assert!(output.stdout.contains(line), "{}", output.stdout);
    let found = extractions(&store);
    let marks = found.values().map(|row| (row.phrase_id.as_str(), row.n_samples, row.truncated));
    assert_eq!(
        marks.collect::<Vec<_>>(),
        [
            ("adts", Some(134_144), Some(false)),
            ("chain", Some(264_600), Some(false)),
            ("half", Some(233_472), Some(true)),
        ]
    );
    let lost_s = found["half"].lost_s.unwrap();
    assert!((lost_s - (470_723.0 - 233_472.0) / 44_100.0).abs() < 1e-9, "{lost_s}");
    assert_eq!(found["chain"].lost_s, Some(0.0));
    assert_consistent(&store);
}
