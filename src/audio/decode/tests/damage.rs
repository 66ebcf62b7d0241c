//! Damaged, cut and foreign files: what is counted, and what is refused with which sentence.

use super::*;

/// The golden MP3 file without a tag, as often as asked, with its tenth frame broken.
fn broken_mp3(n_copies: usize) -> Vec<u8> {
    let bytes = golden("cbr_no_xing.mp3");
    let frames = mp3_frames(&bytes);
    let mut broken = bytes[frames[0]..].repeat(n_copies);
    broken[frames[9] - frames[0] + 4..frames[10] - frames[0]].fill(0xff);
    broken
}

#[test]
fn a_broken_mp3_frame_is_silence_and_counted() {
    let whole = decode(&golden("cbr_no_xing.mp3")).unwrap().samples;
    // 22 frames a copy: one in 1,100 is lost.
    let broken = broken_mp3(50);
    let mut decoder = Decoder::open(Cursor::new(&broken), "").unwrap();
    let mut samples = Vec::new();
    while decoder.next_block(&mut samples).unwrap() {}
    assert_eq!(samples.len(), 50 * whole.len());
    assert_eq!(samples[..9 * 1152], whole[..9 * 1152]);
    assert_eq!(samples[9 * 1152..10 * 1152], [0.0; 1152]);
    // Its data may also serve the next frames, and frames overlap.
    assert_eq!(samples[14 * 1152..whole.len()], whole[14 * 1152..]);
    assert_eq!(decoder.loss(), Loss { is_truncated: false, lost_s: 1152.0 / 44_100.0 });
}

#[test]
fn more_than_a_thousandth_lost_is_refused_with_a_sentence() {
    says(
        &broken_mp3(1),
        "audio_data",
        "mp3 data is damaged at 0.24 s, and 0.03 s of it cannot be decoded; re-encode or restore \
         the file",
    );
}

/// What decoding to the end finds missing.
fn loss(bytes: &[u8]) -> Loss {
    let mut decoder = Decoder::open(Cursor::new(bytes), "").unwrap();
    let mut samples = Vec::new();
    while decoder.next_block(&mut samples).unwrap() {}
    decoder.loss()
}

#[test]
fn a_file_that_ends_before_its_header_says_is_truncated() {
    let pcm = wav(8_000, 1, 16, &[100; 8_000]);
    assert_eq!(loss(&pcm), Loss::default());
    let at_0_75_s = pcm.len() - 2 * 2_000;
    assert_eq!(loss(&pcm[..at_0_75_s]), Loss { is_truncated: true, lost_s: 0.25 });
    // Less than a frame of features is how containers round.
    assert_eq!(loss(&pcm[..pcm.len() - 2 * 200]), Loss::default());
    for name in ["cbr_lame.mp3", "sine.flac", "vorbis.ogg", "opus.opus", "aac.m4a"] {
        let bytes = golden(name);
        assert_eq!(loss(&bytes), Loss::default(), "{name}");
    }
    for name in ["cbr_lame.mp3", "sine.flac"] {
        let bytes = golden(name);
        let lost = loss(&bytes[..bytes.len() * 4 / 5]);
        assert!(lost.is_truncated && lost.lost_s > 0.05, "{name}: {lost:?}");
    }
}

#[test]
fn a_lost_vorbis_page_is_refused_with_its_place() {
    let mut bytes = std::fs::read(format!("{TESTS}data/music/parsec47/ptn1.ogg")).unwrap();
    assert_eq!(loss(&bytes), Loss::default());
    let is_page = |at: &usize| bytes[*at..].starts_with(b"OggS");
    let pages: Vec<usize> = (0..bytes.len()).filter(is_page).collect();
    let middle = pages[pages.len() / 2];
    bytes[middle + 400] ^= 0x55;
    let error = decode(&bytes).map(|decoded| decoded.samples.len()).unwrap_err();
    let DecodeError::Lost { codec, time_s, lost_s } = error else { panic!("{error}") };
    assert_eq!(codec, "vorbis");
    assert!(time_s > 1.0 && lost_s > 0.05 && lost_s < 2.0, "{time_s}, {lost_s}");
}

#[test]
fn alac_packets_of_zeros_are_damage() {
    let bytes = std::fs::read(format!("{TESTS}data/audio_cases/alac.m4a")).unwrap();
    let start = bytes.windows(4).position(|name| name == b"mdat").unwrap() + 4;
    // Two packets of some 10 kB, and the third's start.
    let mut zeroed = bytes.clone();
    zeroed[start + 8_000..start + 36_000].fill(0);
    let error = decode(&zeroed).map(|decoded| decoded.samples.len()).unwrap_err();
    assert!(matches!(error, DecodeError::Damaged { codec: "alac", .. }), "{error}");
}

#[test]
fn samples_beyond_any_level_are_damage_but_in_floats() {
    assert!(decode(&float_wav(1, &[0.5, -200.0])).is_ok());
    let mut decoder =
        Decoder::open(Cursor::new(wav(8_000, 1, 16, &[1; 100])), "").expect("samples");
    decoder.n_given = 400;
    let error = decoder.check_samples(&[0.1, 9.0]).unwrap_err();
    assert_eq!(
        (error.kind(), error.to_string().as_str()),
        (
            "audio_data",
            "pcm_s16le data is damaged at 0.05 s (a sample is 9 times full scale); re-encode or \
             restore the file"
        )
    );
}

#[test]
fn a_stream_cut_out_of_another_one_says_what_it_lacks_at_its_start() {
    let bytes = golden("cbr_lame.mp3");
    let first = bytes.windows(2).position(|two| two == [0xff, 0xfb]).unwrap();
    // The tag's frame, and those that the next one takes bytes of.
    let cut = &bytes[first + 2_000..];
    let mut decoder = Decoder::open(Cursor::new(cut), "").unwrap();
    let mut samples = Vec::new();
    while decoder.next_block(&mut samples).unwrap() {}
    assert!(!decoder.loss().is_truncated);
    let n_silent = samples.iter().take_while(|&&x| x == 0.0).count();
    let lost = decoder.loss().lost_s * 44_100.0;
    assert!(lost <= n_silent as f64 + 1.0 && lost % 1152.0 < 1e-6, "{lost}, {n_silent}");
}

#[test]
fn channels_may_change_in_mid_stream() {
    let mono = golden("cbr_no_xing.mp3");
    let stereo = std::fs::read(format!("{TESTS}data/audio_cases/a54b_ms_same_blocks.mp3")).unwrap();
    let decoded = decode(&[mono.clone(), stereo].concat()).unwrap();
    assert_eq!(decoded.n_channels, 1);
    assert_eq!(decoded.samples.len(), 25_344 + 111_744);
}

#[test]
fn a_change_of_rate_is_refused_with_a_sentence() {
    let both = [golden("cbr_no_xing.mp3"), golden("mpeg2_22k.mp3")].concat();
    says(
        &both,
        "audio_sample_rate",
        "sample rate changes from 44100 Hz to 22050 Hz at 0.57 s; split the file there, or convert \
         it, for example with: ffmpeg -i in.mp3 -ar 44100 out.flac",
    );
}

#[test]
fn damage_in_the_middle_is_refused_with_a_sentence() {
    let mut flac = golden("sine.flac");
    // In the second frame of six.
    flac[9_300] ^= 1;
    says(
        &flac,
        "audio_data",
        "flac data is damaged at 0.10 s (a frame's checksum does not match); re-encode or restore \
         the file",
    );
    let mut aac = golden("aac.aac");
    let middle = aac.len() / 2;
    aac[middle..middle + 60].fill(0xff);
    let error = decode(&aac).map(|decoded| decoded.samples.len()).unwrap_err();
    assert!(matches!(error, DecodeError::Damaged { codec: "aac", .. }), "{error}");
}

#[test]
fn damage_at_the_end_counts_as_an_early_end() {
    let bytes = golden("sine.flac");
    let whole = decode(&bytes).unwrap().samples;
    let mut broken = bytes.clone();
    let last = broken.len() - 20;
    broken[last] ^= 1;
    let samples = decode(&broken).unwrap().samples;
    assert!(samples.len() < whole.len());
    assert_eq!(samples, whole[..samples.len()]);
}

#[test]
fn samples_that_are_no_numbers_are_refused_with_a_sentence() {
    let mut samples = vec![0.25; 4_000];
    samples[2_469] = f32::NAN;
    says(
        &float_wav(2, &samples),
        "audio_not_finite",
        "sample at 0.154 s is NaN; samples must be finite, export the file again, for example as \
         16-bit integers",
    );
    samples[2_469] = f32::NEG_INFINITY;
    says(
        &float_wav(1, &samples),
        "audio_not_finite",
        "sample at 0.309 s is infinite; samples must be finite, export the file again, for example \
         as 16-bit integers",
    );
}

#[test]
fn other_files_are_refused_with_a_sentence() {
    says(
        &wav(44_100, 2, 16, &[]),
        "audio_no_samples",
        "pcm_s16le stream at 44100 Hz holds 0 samples; the recording or conversion that made the \
         file failed, make it again",
    );
    says(
        b"",
        "empty_file",
        "audio file is empty (0 bytes); the download or copy that made it failed, fetch it again",
    );
}

#[test]
fn errors_that_need_rare_files_are_sentences_too() {
    for (error, kind, sentence) in [
        (
            DecodeError::Input { time_s: 3.2, reason: "timed out".to_owned() },
            "audio_data",
            "audio file could not be read on at 3.20 s (timed out); check the disk and try again",
        ),
        (
            DecodeError::UnsupportedStream {
                codec: "aac",
                extension: "m4a",
                reason: "aac too complex".to_owned(),
            },
            "audio_codec",
            "aac stream cannot be decoded (aac too complex); convert it, for example with: \
             ffmpeg -i in.m4a out.flac",
        ),
        (
            DecodeError::NoProgress { codec: "vorbis", time_s: 0.5, n_packets: 9 },
            "audio_data",
            "vorbis data gives no samples after 0.50 s, in 9 packets; re-encode or restore the file",
        ),
    ] {
        assert_eq!((error.kind(), error.to_string().as_str()), (kind, sentence));
    }
}

proptest! {
    #[test]
    fn damaged_files_are_answered(
        name in prop::sample::select(vec![
            "pcm8_8k.wav", "pcm16.aiff", "sine.flac", "cbr_lame.mp3", "vorbis.ogg", "aac.m4a",
            "aac.aac",
        ]),
        places in proptest::collection::vec((0.0..1.0, any::<u8>()), 0..6),
        length in 0.0..1.0,
    ) {
        let mut bytes = golden(name);
        for (place, value) in places {
            let at = (place * bytes.len() as f64) as usize;
            bytes[at] = value;
        }
        bytes.truncate((length * bytes.len() as f64) as usize + 1);
        match decode(&bytes) {
            Ok(decoded) => prop_assert!(decoded.samples.iter().all(|x| x.is_finite())),
            Err(error) => prop_assert!(!error.kind().is_empty() && error.to_string().len() < 400),
        }
    }
}
