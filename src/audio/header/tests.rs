use proptest::prelude::*;

use super::*;

/// A 16-bit PCM WAV file whose declared data length may differ from the data.
fn wav(rate_hz: u32, n_channels: u16, declared_bytes: u32, n_bytes: usize) -> Vec<u8> {
    let frame_bytes = 2 * n_channels;
    [
        b"RIFF".as_slice(),
        &declared_bytes.saturating_add(36).to_le_bytes(),
        b"WAVEfmt \x10\x00\x00\x00\x01\x00",
        &n_channels.to_le_bytes(),
        &rate_hz.to_le_bytes(),
        &rate_hz.saturating_mul(u32::from(frame_bytes)).to_le_bytes(),
        &frame_bytes.to_le_bytes(),
        b"\x10\x00data",
        &declared_bytes.to_le_bytes(),
        &vec![0; n_bytes],
    ]
    .concat()
}

#[track_caller]
fn says(bytes: &[u8], kind: &str, sentence: &str) {
    let error = read_header(bytes, "wav").unwrap_err();
    assert_eq!((error.kind(), error.to_string().as_str()), (kind, sentence));
}

#[test]
fn a_wav_header_is_read() {
    let header = read_header(&wav(22_050, 2, 88_200, 88_200), "mp3").unwrap();
    let expected = AudioHeader {
        codec: "pcm_s16le".to_owned(),
        container: "wav".to_owned(),
        sample_rate_hz: 22_050,
        n_channels: 2,
        duration_s: 1.0,
        duration_source: DurationSource::Header,
    };
    assert_eq!(header, expected);
}

#[test]
fn a_length_beyond_the_file_is_replaced_by_the_samples_present() {
    // Cut short, streamed by FFmpeg, and streamed by SoX.
    for declared_bytes in [80_000, u32::MAX, 0x7fff_f000] {
        let header = read_header(&wav(8_000, 1, declared_bytes, 7_000), "wav").unwrap();
        assert_eq!(header.duration_s, 3_500.0 / 8_000.0);
        assert_eq!(header.duration_source, DurationSource::Packets);
    }
}

#[test]
fn other_files_are_refused_with_a_sentence() {
    says(
        b"",
        "empty_file",
        "audio file is empty (0 bytes); the download or copy that made it failed, fetch it again",
    );
    says(
        b"\n<!DOCTYPE html>\n<html><body>404</body></html>",
        "audio_header",
        "not audio: it starts with \"<!DOCTYPE html>\"; was an error page saved as audio?",
    );
    says(
        b"{\"error\": \"not found\"}",
        "audio_header",
        "not audio: it starts with \"{\\\"error\\\": \\\"not found\\\"}\"; was an error message \
         saved as audio?",
    );
    says(
        b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR",
        "audio_header",
        "not audio: it starts with bytes 89 50 4e 47 0d 0a 1a 0a; it is a PNG picture",
    );
    says(
        b"time,beat\n0.5,1\n",
        "audio_header",
        "not audio: it starts with \"time,beat\"; WAV, AIFF, FLAC, MP3, Ogg, MP4, AAC, CAF and AU \
         are read, was another format saved under the name .wav?",
    );
    // A marker inside another file is not the file's own.
    let inside = [b"unknown container ".as_slice(), &wav(8_000, 1, 8, 8)].concat();
    says(
        &inside,
        "audio_header",
        "not audio: it starts with \"unknown container RIFF,\"; WAV, AIFF, FLAC, MP3, Ogg, MP4, AAC, \
         CAF and AU are read, was another format saved under the name .wav?",
    );
}

#[test]
fn broken_headers_are_refused_with_a_sentence() {
    says(
        &wav(8_000, 1, 8, 8)[..30],
        "audio_header",
        "audio header cannot be read from 30 bytes that start with \"RIFF,\": it ends before a \
         known codec's header does; the file may be cut short, copy or download it again",
    );
    says(
        &wav(0, 1, 8, 8),
        "audio_header",
        "wav header gives its pcm_s16le track a sample rate of 0 Hz; encode the file again",
    );
    says(
        &wav(44_100, 1, 0, 0),
        "audio_header",
        "wav file has 0 samples of pcm_s16le at 44100 Hz; the recording or conversion that made it \
         failed, make it again",
    );
    says(
        &wav(44_100, 0, 8, 8),
        "audio_header",
        "wav header gives its pcm_s16le track 0 channels; encode the file again",
    );
}

#[test]
fn errors_that_need_rare_files_are_sentences_too() {
    let (container, codec) = ("mp4", "aac");
    for (error, sentence) in [
        (
            AudioHeaderError::NoAudioTrack { container },
            "mp4 file holds no audio track; is it a video without sound?",
        ),
        (
            AudioHeaderError::NoChannels { container, codec },
            "mp4 header gives its aac track 0 channels; encode the file again",
        ),
    ] {
        assert_eq!((error.kind(), error.to_string().as_str()), ("audio_header", sentence));
    }
}

proptest! {
    #[test]
    fn any_bytes_are_answered(
        bytes in proptest::collection::vec(any::<u8>(), 0..400),
        start in prop::sample::select(vec![
            &b""[..], b"RIFF\x40\x00\x00\x00WAVEfmt ", b"FORM\x00\x00\x00\x40AIFFCOMM", b"fLaC",
            b"OggS\x00\x02", b"ID3\x03\x00\x00", b"\x00\x00\x00\x18ftypM4A ", b"\xff\xfb\x90",
            b"\xff\xf1\x50\x80",
        ]),
    ) {
        if let Ok(header) = read_header(&[start, &bytes].concat(), "") {
            prop_assert!(header.sample_rate_hz > 0 && header.n_channels > 0);
            prop_assert!(header.duration_s.is_finite() && header.duration_s > 0.0);
        }
    }
}
