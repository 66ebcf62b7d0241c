use crate::audio::header::read_header;

/// Frames of one kind, empty but for their headers.
fn frames(header: [u8; 4], n_bytes: usize, n_frames: usize) -> Vec<u8> {
    let frame = [&header[..], &vec![0; n_bytes - 4]].concat();
    frame.repeat(n_frames)
}

#[test]
fn zeros_and_junk_before_mpeg_frames_are_passed_over() {
    // 128 kbit/s at 44.1 kHz, mono: 417 bytes a frame.
    let audio = frames([0xff, 0xfb, 0x90, 0xc4], 417, 20);
    for before in [vec![0; 300_000], b"a line of text\n".repeat(4_000)] {
        let header = read_header(&[before, audio.clone()].concat(), "").unwrap();
        assert_eq!(header.duration_s, 20.0 * 1152.0 / 44_100.0);
    }
    let far = [b"a line of text\n".repeat(9_000), audio].concat();
    assert_eq!(read_header(&far, "").unwrap_err().kind(), "audio_header");
}

#[test]
fn frames_of_other_layers_are_named() {
    // Layer II, 192 kbit/s at 48 kHz: 576 bytes a frame.
    let error = read_header(&frames([0xff, 0xfd, 0xa4, 0x04], 576, 20), "mp2").unwrap_err();
    assert_eq!(
        (error.kind(), error.to_string().as_str()),
        (
            "audio_codec",
            "audio is MPEG audio layer II, which this program does not decode; convert it, for \
             example with: ffmpeg -i in.mp2 out.flac"
        )
    );
}

#[test]
fn a_free_format_frame_is_as_long_as_the_next_ones_are_far() {
    let audio = frames([0xff, 0xfb, 0x00, 0xc4], 611, 9);
    assert_eq!(read_header(&audio, "").unwrap().duration_s, 9.0 * 1152.0 / 44_100.0);
}
