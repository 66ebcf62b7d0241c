use super::*;

/// Bits, written from the highest on.
#[derive(Default)]
struct Writer {
    bits: Vec<bool>,
}

impl Writer {
    fn put(mut self, value: u32, n: usize) -> Self {
        self.bits.extend((0..n).rev().map(|i| value >> i & 1 == 1));
        self
    }

    fn bytes(self) -> Vec<u8> {
        let byte = |eight: &[bool]| {
            eight.iter().enumerate().fold(0, |byte, (i, &bit)| byte | u8::from(bit) << (7 - i))
        };
        self.bits.chunks(8).map(byte).collect()
    }
}

/// A silent frame of one channel: element, tag, gain, window, no bands, no tools.
fn silence() -> Writer {
    Writer::default().put(0, 3).put(0, 4).put(0, 8).put(0, 1 + 2 + 1).put(0, 6 + 1).put(0, 3)
}

/// A fill element whose payload starts with an extension's type.
fn fill(frame: Writer, n_bytes: u32, extension: u32) -> Writer {
    let frame = frame.put(FILL_ELEMENT, 3);
    let frame = match n_bytes {
        0..15 => frame.put(n_bytes, 4),
        _ => frame.put(15, 4).put(n_bytes - 14, 8),
    };
    let frame = frame.put(extension, 4);
    (1..2 * n_bytes).fold(frame, |frame, i| frame.put((i * 7) & 0xf, 4))
}

#[test]
fn replication_is_found_in_frames() {
    for (n_bytes, extension, expected) in [
        (9, 13, true),
        (14, 14, true),
        (40, 13, true),
        (100, 14, true),
        (9, 0, false),
        (40, 1, false),
    ] {
        let frame = fill(silence(), n_bytes, extension).put(END, 3).bytes();
        assert_eq!(ends_in_replication(&frame), expected, "{n_bytes} bytes of {extension}");
        // With plain fill behind it.
        let frame = fill(fill(silence(), n_bytes, extension), 20, 0).put(END, 3).bytes();
        assert_eq!(ends_in_replication(&frame), expected, "{n_bytes} bytes of {extension}");
    }
    assert!(!ends_in_replication(&silence().put(END, 3).bytes()));
    assert!(!ends_in_replication(&[]));
}

#[test]
fn replication_is_found_in_configurations() {
    let plain = [0x12, 0x08];
    // 24 kHz, stereo: AAC-LC with SBR behind the sync extension, and the same said not to be there.
    let sync = |present: u32| {
        let head = Writer::default().put(AAC_LC, 5).put(6, 4).put(2, 4).put(0, 3);
        head.put(SYNC_EXTENSION, 11).put(SBR, 5).put(present, 1).put(3, 4).bytes()
    };
    let explicit = |kind| Writer::default().put(kind, 5).put(6, 4).put(2, 4).put(3, 4).bytes();
    for (config, expected) in [
        (plain.to_vec(), false),
        (sync(1), true),
        (sync(0), false),
        (explicit(SBR), true),
        (explicit(PS), true),
    ] {
        assert_eq!(has_spectral_band_replication(Some(&config), &[]), expected, "{config:02x?}");
    }
}

/// Frames of 24 kHz, mono, in an ADTS stream (ISO/IEC 13818-7 section 6.2).
fn adts(frames: &[Vec<u8>]) -> Vec<u8> {
    let framed = frames.iter().map(|frame| {
        let n = frame.len() as u32 + 7;
        let head = [0xff, 0xf1, 1 << 6 | 6 << 2, 1 << 6 | (n >> 11) as u8];
        let tail = [(n >> 3) as u8, ((n & 7) << 5) as u8 | 0x1f, 0xfc];
        [&head[..], &tail, frame].concat()
    });
    framed.collect::<Vec<_>>().concat()
}

#[test]
fn a_stream_with_replication_is_refused_with_a_sentence() {
    let plain = silence().put(END, 3).bytes();
    let replicated = fill(silence(), 24, 13).put(END, 3).bytes();
    let read =
        |frame: &Vec<u8>| crate::audio::header::read_header(&adts(&vec![frame.clone(); 30]), "aac");
    let header = read(&plain).unwrap();
    assert_eq!((header.codec.as_str(), header.duration_s), ("aac", 30.0 * 1024.0 / 24_000.0));
    let error = read(&replicated).unwrap_err();
    assert_eq!(
        (error.kind(), error.to_string().as_str()),
        (
            "audio_codec",
            "audio is HE-AAC, whose upper half of the spectrum (SBR) this program does not decode; \
             convert it, for example with: ffmpeg -i in.aac out.flac"
        )
    );
}
