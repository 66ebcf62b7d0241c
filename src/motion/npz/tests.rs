use std::io::Write;

use proptest::prelude::*;
use zip::{ZipWriter, write::SimpleFileOptions};

use super::*;
use crate::motion::npy::write;

fn archive(members: &[(&str, &[u8])], method: CompressionMethod) -> Vec<u8> {
    let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(method);
    for (name, bytes) in members {
        writer.start_file(*name, options).unwrap();
        writer.write_all(bytes).unwrap();
    }
    writer.finish().unwrap().into_inner()
}

fn sample() -> Vec<u8> {
    let (mel, beats) = (write::<f32>(&[2, 3], &[1.5; 6]), write::<f32>(&[4], &[2.0; 4]));
    let members = [("mel.npy", mel.as_slice()), ("beats.npy", &beats), ("note.txt", b"hello")];
    archive(&members, CompressionMethod::Stored)
}

/// Where `needle` last starts; the table of members is at the end.
fn last(bytes: &[u8], needle: &[u8]) -> usize {
    bytes.windows(needle.len()).rposition(|window| window == needle).unwrap()
}

#[track_caller]
fn says<T: std::fmt::Debug>(result: Result<T, NpzError>, kind: &str, sentence: &str) {
    let error = result.unwrap_err();
    assert_eq!((error.kind(), error.to_string().as_str()), (kind, sentence));
}

#[test]
fn members_read_by_key() {
    let bytes = sample();
    let mut npz = Npz::open(&bytes).unwrap();
    assert_eq!(npz.keys(), ["mel", "beats", "note.txt"]);
    assert_eq!(npz.read_f32("mel").unwrap(), NpyArray { shape: vec![2, 3], values: vec![1.5; 6] });
    assert_eq!(npz.read_f64("beats").unwrap(), NpyArray { shape: vec![4], values: vec![2.0; 4] });
}

#[test]
fn whole_archives_are_refused_with_a_sentence() {
    says(
        Npz::open(b""),
        "empty_file",
        "npz file is empty (0 bytes); the download or copy that made it failed, fetch it again",
    );
    says(
        Npz::open(b"<html>Not found</html>"),
        "npz_format",
        "not an npz file: it starts with \"<html>Not found</html>\"; was an error page saved in \
         place of the archive?",
    );
    says(
        Npz::open(&write(&[1], &[0.0])),
        "npz_format",
        "not an npz file: it starts with bytes 93 4e 55 4d 50 59 01 00; it is a single array, name \
         it .npy",
    );
    says(
        Npz::open(&sample()[..100]),
        "truncated",
        "npz file is truncated: it starts as a zip archive, but no table of members ends its 100 \
         bytes; the file was cut short, copy or download it again",
    );
    let mut bytes = sample();
    let at = last(&bytes, b"PK\x01\x02");
    bytes[at] = b'Q';
    let error = Npz::open(&bytes).unwrap_err();
    assert_eq!(error.kind(), "npz_format");
    assert!(error.to_string().starts_with("npz table of members is damaged: "), "{error}");
}

#[test]
fn keys_given_twice_are_refused() {
    let array = write(&[1], &[0.0]);
    let stripped =
        archive(&[("a.npy", array.as_slice()), ("a", &array)], CompressionMethod::Stored);
    let sentence = "npz key \"a\" names two members; write the file again with each key once";
    says(Npz::open(&stripped), "npz_format", sentence);
    // The writer refuses equal names, so one is renamed in its local header and in the table.
    let mut equal = archive(&[("a.npy", &array), ("b.npy", &array)], CompressionMethod::Stored);
    while let Some(at) = equal.windows(5).position(|window| window == b"b.npy") {
        equal[at] = b'a';
    }
    says(Npz::open(&equal), "npz_format", sentence);
}

#[test]
fn a_missing_key_names_those_there_are() {
    let bytes = sample();
    says(
        Npz::open(&bytes).unwrap().read_f32("tempo"),
        "missing_key",
        "npz has no key \"tempo\"; it holds mel, beats, note.txt",
    );
    let none = archive(&[], CompressionMethod::Stored);
    says(
        Npz::open(&none).unwrap().read_f32("mel"),
        "missing_key",
        "npz has no key \"mel\"; it holds no members at all",
    );
    let names: Vec<String> = (0..25).map(|i| format!("k{i}")).collect();
    assert!(list(&names).ends_with("k19 and 5 more"));
}

#[test]
fn members_are_refused_with_a_sentence() {
    let bytes = sample();
    says(
        Npz::open(&bytes).unwrap().read_f32("note.txt"),
        "npy_format",
        "npz member \"note.txt\": not an npy file: it starts with \"hello\"; save the array with \
         numpy.save",
    );
    says(
        Npz::open_limited(&bytes, 20).unwrap().read_f32("mel"),
        "too_large",
        "npz member \"mel\": npy header declares shape (2, 3) of \"<f4\", at least 24 bytes in \
         memory, over the limit of 20; split the array into smaller files",
    );

    // The flags and the method of the first member's record in the table, and its data.
    let record = bytes.windows(4).position(|window| window == b"PK\x01\x02").unwrap();
    let mut encrypted = bytes.clone();
    encrypted[record + 8] |= 1;
    says(
        Npz::open(&encrypted).unwrap().read_f32("mel"),
        "npz_format",
        "npz member \"mel\" is encrypted; write it without a password",
    );
    let mut other = bytes.clone();
    other[record + 10] = 12;
    says(
        Npz::open(&other).unwrap().read_f32("mel"),
        "npz_format",
        "npz member \"mel\" is compressed with zip method 12, and only stored (0) and deflated (8) \
         members are read; write the file with numpy.savez_compressed",
    );
    let mut flipped = bytes.clone();
    let at = bytes.windows(4).position(|window| window == 1.5_f32.to_le_bytes()).unwrap();
    flipped[at] ^= 1;
    says(
        Npz::open(&flipped).unwrap().read_f32("mel"),
        "npz_format",
        "npz member \"mel\" is damaged: its bytes do not match its CRC-32; copy or download the \
         file again",
    );
}

#[test]
fn a_bomb_stops_at_the_limit() {
    // 8 MiB of zeros behind a small array shrink to 8 kB.
    let member = [write(&[2], &[0.0; 2]), vec![0; 8 << 20]].concat();
    let bytes = archive(&[("a.npy", &member)], CompressionMethod::Deflated);
    assert!(bytes.len() < 100_000);
    says(
        Npz::open_limited(&bytes, 1 << 20).unwrap().read_f32("a"),
        "too_large",
        "npz member \"a\" decompresses to 1179648 bytes or more, over the limit of 1048576; split \
         the array into smaller files",
    );
    assert_eq!(Npz::open(&bytes).unwrap().read_f32("a").unwrap().values, [0.0; 2]);
}

proptest! {
    #[test]
    fn any_bytes_are_answered(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let _ = Npz::open(&bytes);
        let _ = Npz::open(&[b"PK\x05\x06".as_slice(), &bytes].concat());
    }

    #[test]
    fn any_damage_is_answered(at: prop::sample::Index, by in 1_u8.., kept: prop::sample::Index) {
        let mut bytes = sample();
        let at = at.index(bytes.len());
        bytes[at] ^= by;
        bytes.truncate(kept.index(bytes.len() * 2).min(bytes.len()));
        if let Ok(mut npz) = Npz::open(&bytes) {
            for key in npz.keys().to_vec() {
                let _ = npz.read_f32(&key);
            }
        }
    }
}

#[test]
fn what_is_written_is_read() {
    let large: Vec<f32> = (0..30_011).map(|i| i as f32 * 0.5).collect();
    let write = || {
        let mut npz = NpzWriter::new(Cursor::new(Vec::new()));
        npz.add("large", &[30_011], large.iter().copied()).unwrap();
        npz.add("scalar", &[], [-2.5f64]).unwrap();
        npz.add("counts", &[1, 3], [7i64, -1, 1 << 40]).unwrap();
        npz.add("none", &[0], Vec::<f32>::new()).unwrap();
        npz.finish().unwrap().into_inner()
    };
    let bytes = write();
    assert_eq!(bytes, write());
    let mut npz = Npz::open(&bytes).unwrap();
    assert_eq!(npz.keys(), ["large", "scalar", "counts", "none"]);
    assert_eq!(npz.read_f32("large").unwrap(), NpyArray { shape: vec![30_011], values: large });
    let array =
        |shape: &[usize], values: &[f64]| NpyArray { shape: shape.into(), values: values.into() };
    assert_eq!(npz.read_f64("scalar").unwrap(), array(&[], &[-2.5]));
    assert_eq!(npz.read_f64("counts").unwrap(), array(&[1, 3], &[7.0, -1.0, (1u64 << 40) as f64]));
    assert_eq!(npz.read_f64("none").unwrap(), array(&[0], &[]));
}
