use std::io::Cursor;

use super::*;

/// A chunk with its size as given, padded to an even length.
fn chunk(id: &[u8; 4], size: u32, content: &[u8]) -> Vec<u8> {
    let pad = &[0][..content.len() % 2];
    [&id[..], &size.to_le_bytes(), content, pad].concat()
}

fn fmt(tag: u16, n_channels: u16, rate_hz: u32, block_bytes: u16, bits: u16) -> Vec<u8> {
    let content = [
        &tag.to_le_bytes()[..],
        &n_channels.to_le_bytes(),
        &rate_hz.to_le_bytes(),
        &(rate_hz * u32::from(block_bytes)).to_le_bytes(),
        &block_bytes.to_le_bytes(),
        &bits.to_le_bytes(),
    ];
    chunk(b"fmt ", 16, &content.concat())
}

fn riff(chunks: &[Vec<u8>]) -> Vec<u8> {
    let content = chunks.concat();
    [b"RIFF", &(content.len() as u32 + 4).to_le_bytes()[..], b"WAVE", &content].concat()
}

fn read(bytes: &[u8]) -> Layout {
    let marker = &bytes[..4];
    let layout = Layout::read(&mut Cursor::new(bytes), marker, 0, bytes.len() as u64);
    layout.unwrap().expect("an uncompressed file")
}

fn values(bytes: &[u8]) -> Vec<f32> {
    let layout = read(bytes);
    let Payload::Samples(format) = layout.payload else { panic!("{:?}", layout.payload) };
    let input = &bytes[layout.start as usize..];
    let mut samples = Samples::new(input, format, layout.n_channels, layout.n_frames());
    let (mut all, mut block) = (Vec::new(), Vec::new());
    loop {
        samples.next(&mut block).unwrap();
        if block.is_empty() {
            return all;
        }
        all.append(&mut block);
    }
}

#[test]
fn samples_of_one_byte_know_their_end() {
    // Cut, and streamed: nothing is made up behind the end, where 0 would be full scale.
    let head = riff(&[fmt(1, 1, 8_000, 1, 8)]);
    for size in [3, 5_000, 0, u32::MAX, 0x7fff_f000] {
        let bytes =
            [head.clone(), b"data".to_vec(), size.to_le_bytes().to_vec(), vec![0x80, 0xc0, 0x40]];
        assert_eq!(values(&bytes.concat()), [0.0, 0.5, -0.5], "size {size}");
    }
    let stated = [head, b"data".to_vec(), 5_000_u32.to_le_bytes().to_vec(), vec![0x80; 3]].concat();
    let layout = read(&stated);
    assert_eq!((layout.n_frames(), layout.n_stated_frames()), (3, Some(5_000)));
}

#[test]
fn each_format_is_scaled_to_1() {
    let two = |tag, bytes: &[u8]| {
        let n = bytes.len() as u16 / 2;
        values(&riff(&[fmt(tag, 1, 8_000, n, 8 * n), chunk(b"data", bytes.len() as u32, bytes)]))
    };
    assert_eq!(two(1, &[0, 0x40, 0, 0xc0]), [0.5, -0.5]);
    assert_eq!(two(1, &[0, 0, 0x40, 1, 0, 0]), [0.5, 1.0 / 8_388_608.0]);
    assert_eq!(two(1, &[0, 0, 0, 0x40, 0, 0, 0, 0x80]), [0.5, -1.0]);
    let floats = [0.25_f32.to_le_bytes(), (-3.5_f32).to_le_bytes()].concat();
    assert_eq!(two(3, &floats), [0.25, -3.5]);
    let doubles = [0.25_f64.to_le_bytes(), (-3.5_f64).to_le_bytes()].concat();
    assert_eq!(two(3, &doubles), [0.25, -3.5]);
    // ITU-T G.711: the largest value and the smallest positive one; by libsndfile.
    let laws = |x: [i16; 2]| x.map(|x| f32::from(x) / 32_768.0);
    assert_eq!(two(6, &[0xaa, 0xd5]), laws([32_256, 8]));
    assert_eq!(two(7, &[0x80, 0x00]), laws([32_124, -32_124]));
    // As RIFX, all is from the high byte on.
    let mut rifx =
        b"RIFX\0\0\0\x28WAVEfmt \0\0\0\x10\0\x01\0\x01\0\0\x1f\x40\0\0\x3e\x80\0\x02\0\x10"
            .to_vec();
    rifx.extend_from_slice(b"data\0\0\0\x04\x40\0\xc0\0");
    assert_eq!(values(&rifx), [0.5, -0.5]);
}

#[test]
fn chunks_before_the_samples_may_be_broken() {
    let (format, data) = (fmt(1, 1, 8_000, 2, 16), chunk(b"data", 4, &[0, 0x40, 0, 0xc0]));
    // Longer than the file, odd without padding, and truly odd.
    let long = chunk(b"LIST", 900_000, b"INFOISFT\xff\xff\xff\x7fLavf");
    let unpadded = [&b"junk\x03\0\0\0"[..], b"abc"].concat();
    let odd = chunk(b"junk", 3, b"abc");
    for broken in [long, unpadded, odd] {
        let bytes = riff(&[format.clone(), broken.clone(), data.clone()]);
        assert_eq!(values(&bytes), [0.5, -0.5], "{broken:?}");
    }
}

#[test]
fn a_truly_empty_data_chunk_has_no_samples() {
    let empty = [fmt(1, 1, 8_000, 2, 16), chunk(b"data", 0, b""), chunk(b"LIST", 4, b"INFO")];
    assert_eq!(read(&riff(&empty)).n_frames(), 0);
}

#[test]
fn caf_is_read_with_either_end_first() {
    for (flags, bytes) in [(0_u32, [0x40, 0, 0xc0, 0]), (2, [0, 0x40, 0, 0xc0])] {
        let words = |words: [u32; 5]| words.map(u32::to_be_bytes).concat();
        let description =
            [&8_000_f64.to_be_bytes()[..], b"lpcm", &words([flags, 2, 1, 1, 16])].concat();
        let caf = [
            &b"caff\0\x01\0\0desc"[..],
            &32_i64.to_be_bytes(),
            &description,
            b"free",
            &2_i64.to_be_bytes(),
            b"..",
            b"data",
            &(-1_i64).to_be_bytes(),
            &[0; 4],
            &bytes,
        ]
        .concat();
        assert_eq!(values(&caf), [0.5, -0.5], "flags {flags}");
        let layout = read(&caf);
        assert_eq!((layout.sample_rate_hz, layout.n_stated_bytes), (8_000, None));
    }
}
