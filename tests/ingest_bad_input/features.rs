//! Feature files that hold no features.

use std::io::{Cursor, Write as _};

use motiongen::motion::npy::write;
use zip::CompressionMethod::{Deflated, Stored};
use zip::write::SimpleFileOptions;

use super::case::Case;
use crate::support::files::{Member, features, features_npz, npy, npz};

pub fn cases() -> Vec<Case> {
    [archives(), members(), bombs(), arrays()].into_iter().flatten().collect()
}

/// A sound file with one array exchanged.
fn with(key: &str, array: Vec<u8>) -> Vec<u8> {
    let mut members = features(23);
    members.iter_mut().find(|(k, _)| *k == key).unwrap().1 = array;
    npz(&members, Deflated)
}

fn stored() -> Vec<u8> {
    npz(&features(23), Stored)
}

/// Where `needle` first starts.
fn first(bytes: &[u8], needle: &[u8]) -> usize {
    bytes.windows(needle.len()).position(|window| window == needle).unwrap()
}

#[rustfmt::skip]
fn archives() -> Vec<Case> {
    let sound = features_npz(23);
    let mut table = stored();
    let at = table.windows(4).rposition(|window| window == b"PK\x01\x02").unwrap();
    table[at] = b'Q';
    // The archive writer refuses to repeat a name, so a name of the same length is overwritten.
    let mut doubled = npz(&[("mel", vec![]), ("mfc", vec![])], Stored);
    for at in (0..doubled.len() - 3).rev() {
        if &doubled[at..at + 3] == b"mfc" {
            doubled[at..at + 3].copy_from_slice(b"mel");
        }
    }
    vec![
        Case::npz("npz-empty", vec![], "empty_file",
            "npz file is empty (0 bytes); the download or copy that made it failed, fetch it \
             again"),
        Case::npz("npz-truncated", sound[..500].to_vec(), "truncated",
            "npz file is truncated: it starts as a zip archive, but no table of members ends its \
             500 bytes; the file was cut short, copy or download it again"),
        Case::npz("npz-is-a-web-page", b"<!DOCTYPE html>\n<html></html>".to_vec(), "npz_format",
            "not an npz file: it starts with \"<!DOCTYPE html>\"; was an error page saved in place \
             of the archive?"),
        Case::npz("npz-is-an-npy", write(&[3], &[0.5; 3]), "npz_format",
            "not an npz file: it starts with bytes 93 4e 55 4d 50 59 01 00; it is a single array, \
             name it .npy"),
        Case::npz("npz-damaged-table", table, "npz_format",
            "npz table of members is damaged: invalid Zip archive: Invalid Central Directory \
             header; copy or download the file again"),
        Case::npz("npz-doubled-member", doubled, "npz_format",
            "npz key \"mel\" names two members; write the file again with each key once"),
        Case::npz("npz-no-members", npz(&[], Stored), "missing_key",
            "npz has no key \"mel\"; it holds no members at all"),
    ]
}

#[rustfmt::skip]
fn members() -> Vec<Case> {
    let mut without_mfcc = features(23);
    without_mfcc.remove(2);
    // Bit 0 of the flags: APPNOTE sections 4.3.7 (offset 6) and 4.3.12 (offset 8).
    let mut encrypted = stored();
    let table = first(&encrypted, b"PK\x01\x02");
    encrypted[6] |= 1;
    encrypted[table + 8] |= 1;
    // Method 12 is bzip2: offsets 8 and 10 of the same records.
    let mut bzip2 = stored();
    bzip2[8] = 12;
    bzip2[table + 10] = 12;
    let mut checksum = stored();
    let data = first(&checksum, b"\x93NUMPY") + 128;
    checksum[data] ^= 0x20;
    // Block type 3 does not exist: RFC 1951 section 3.2.3.
    let mut deflate = features_npz(23);
    let name_end = first(&deflate, b"mel.npy") + 7;
    let extra_bytes = usize::from(u16::from_le_bytes([deflate[28], deflate[29]]));
    deflate[name_end + extra_bytes] = 0xff;
    vec![
        Case::npz("npz-missing-key", npz(&without_mfcc, Stored), "missing_key",
            "npz has no key \"mfcc\"; it holds mel, chroma, rms, spectral_centroid, \
             onset_strength, tempo, beat_times"),
        Case::npz("npz-encrypted-member", encrypted, "npz_format",
            "npz member \"mel\" is encrypted; write it without a password"),
        Case::npz("npz-bzip2-member", bzip2, "npz_format",
            "npz member \"mel\" is compressed with zip method 12, and only stored (0) and \
             deflated (8) members are read; write the file with numpy.savez_compressed"),
        Case::npz("npz-wrong-checksum", checksum, "npz_format",
            "npz member \"mel\" is damaged: its bytes do not match its CRC-32; copy or download \
             the file again"),
        Case::npz("npz-damaged-deflate", deflate, "npz_format",
            "npz member \"mel\" is damaged: corrupt deflate stream; copy or download the file \
             again"),
        Case::npz("npz-pickled-member", with("chroma", npy("'|O'", "(2,)", b"\x80\x04\x95")),
            "pickle",
            "npz member \"chroma\": npy holds Python objects (pickle), which are never executed; \
             save it with numpy.save(..., allow_pickle=False) from a numeric array"),
        Case::npz("npz-empty-member", with("rms", vec![]), "empty_file",
            "npz member \"rms\": npy file is empty (0 bytes); the download or copy that made it \
             failed, fetch it again"),
        Case::npz("npz-member-cut-short", with("rms", npy("'<f4'", "(1, 23)", &[0; 31])),
            "truncated",
            "npz member \"rms\": npy data is truncated: 92 bytes are declared and 31 found; the \
             file was cut short, copy or download it again"),
    ]
}

/// An archive of one member that begins with `start` and goes on with `n_zeros` zeros.
fn bomb(start: &[u8], n_zeros: usize) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file("mel.npy", SimpleFileOptions::default().compression_method(Deflated)).unwrap();
    zip.write_all(start).unwrap();
    let zeros = vec![0; 1 << 20];
    for _ in 0..n_zeros >> 20 {
        zip.write_all(&zeros).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

#[rustfmt::skip]
fn bombs() -> Vec<Case> {
    let one = write(&[128, 1], &[0.0; 128]);
    let honest = npy("'<f4'", "(128, 500000)", &[]);
    let cases = vec![
        // A small array, and then zeros without end.
        Case::npz("npz-bomb-behind-an-array", bomb(&one, 900 << 20), "too_large",
            "npz member \"mel\" decompresses to 268566528 bytes or more, over the limit of \
             268435456; split the array into smaller files"),
        // An array of 10 GB, as its header says.
        Case::npz("npz-bomb-of-10-gb", bomb(&npy("'<f4'", "(128, 20000000)", &[]), 900 << 20),
            "too_large",
            "npz member \"mel\": npy header declares shape (128, 20000000) of \"<f4\", at least \
             10240000000 bytes in memory, over the limit of 268435456; split the array into \
             smaller files"),
        // The largest array that is read at all, and nothing beside it.
        Case::npz("npz-bomb-within-the-limit", bomb(&honest, 245 << 20), "missing_key",
            "npz has no key \"chroma\"; it holds mel"),
    ];
    for case in &cases {
        assert!(case.n_bytes() < 1_100_000, "{} has {} bytes", case.id, case.n_bytes());
    }
    cases
}

#[rustfmt::skip]
fn arrays() -> Vec<Case> {
    let zeros = |shape: &[usize]| write(shape, &vec![0.0; shape.iter().product()]);
    let mut broken_mfcc = vec![0.25; 20 * 23];
    broken_mfcc[3 * 23 + 5] = f32::NAN;
    broken_mfcc[4 * 23 + 6] = f32::INFINITY;
    let none: Vec<Member> =
        features(23).into_iter().map(|(key, _)| (key, write::<f32>(&[128, 0], &[]))).collect();
    vec![
        Case::npz("npz-wrong-mel-rows", with("mel", zeros(&[80, 23])), "shape",
            "mel has shape [80, 23], expected [128, frames]"),
        Case::npz("npz-transposed-chroma", with("chroma", zeros(&[23, 12])), "shape",
            "chroma has shape [23, 12], expected [12, frames]"),
        Case::npz("npz-two-rows-of-rms", with("rms", zeros(&[2, 23])), "shape",
            "rms has shape [2, 23], expected [frames]"),
        Case::npz("npz-no-frames", npz(&none, Stored), "shape",
            "mel has shape [128, 0], expected [128, frames]"),
        Case::npz("npz-frame-counts-differ", with("onset_strength", zeros(&[22])), "shape",
            "onset_strength has 22 frames but mel has 23; extract them again"),
        Case::npz("npz-nan", with("mfcc", write(&[20, 23], &broken_mfcc)), "non_finite",
            "mfcc is NaN at frame 5 (2 non-finite values in all); extract the features again"),
        Case::npz("npz-negative-beat", with("beat_times", write(&[2], &[-0.5, 1.0])),
            "non_finite",
            "beat_times holds -0.5 s; times are finite and not negative"),
        Case::npz("npz-infinite-beat", with("beat_times", write(&[2], &[0.5, f32::INFINITY])),
            "non_finite",
            "beat_times holds inf s; times are finite and not negative"),
    ]
}
