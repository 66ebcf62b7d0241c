use proptest::prelude::*;

use super::*;

/// A version 1.0 file with any header text and data.
fn file(header: &str, data: &[u8]) -> Vec<u8> {
    let length = (header.len() as u16).to_le_bytes();
    [b"\x93NUMPY\x01\x00".as_slice(), &length, header.as_bytes(), data].concat()
}

fn described(descr: &str, shape: &str) -> Vec<u8> {
    let header = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}\n");
    file(&header, &[0; 64])
}

#[track_caller]
fn says(bytes: &[u8], kind: &str, sentence: &str) {
    let error = read_f32(bytes).unwrap_err();
    assert_eq!((error.kind(), error.to_string().as_str()), (kind, sentence));
}

#[test]
fn each_error_is_a_sentence_with_its_values() {
    says(
        b"",
        "empty_file",
        "npy file is empty (0 bytes); the download or copy that made it failed, fetch it again",
    );
    says(
        b"<!DOCTYPE html>\n<html>",
        "npy_format",
        "not an npy file: it starts with \"<!DOCTYPE html>\"; was an error page saved in place of \
         the array?",
    );
    says(
        b"PK\x03\x04\x14\x00\x00\x00\x08\x00",
        "npy_format",
        "not an npy file: it starts with bytes 50 4b 03 04 14 00 00 00; it is a zip archive, name \
         it .npz to have its members read",
    );
    says(
        b"1.0,2.0\n",
        "npy_format",
        "not an npy file: it starts with \"1.0,2.0\"; save the array with numpy.save",
    );
    let pickle = "npy holds Python objects (pickle), which are never executed; save it with \
                  numpy.save(..., allow_pickle=False) from a numeric array";
    says(b"\x80\x04\x95\x10", "pickle", pickle);
    says(&described("'|O'", "(2,)"), "pickle", pickle);
    says(
        b"\x93NUMPY\x04\x00\x00\x00",
        "npy_format",
        "npy format version 4.0 is unknown; versions 1.0, 2.0 and 3.0 are read, save the array \
         again with numpy.save",
    );
    says(
        b"\x93NUMPY\x02\x00\xff\xff\xff\xff",
        "too_large",
        "npy header declares 4294967295 bytes of text, over the limit of 65536; the file is \
         damaged or no plain numeric array, save it again with numpy.save",
    );
    says(
        b"\x93NUMPY\x01\x00\x76\x00{'descr'",
        "truncated",
        "npy header is truncated: 118 bytes are declared and 8 found; the file was cut short, copy \
         or download it again",
    );
    says(
        &described("'<f4'", "(120, 25)"),
        "truncated",
        "npy data is truncated: 12000 bytes are declared and 64 found; the file was cut short, \
         copy or download it again",
    );
    says(
        &described("'<f4'", "(1000000, 1000000)"),
        "too_large",
        "npy header declares shape (1000000, 1000000) of \"<f4\", at least 4000000000000 bytes in \
         memory, over the limit of 1073741824; split the array into smaller files",
    );
    says(
        &described("'<c8'", "(2,)"),
        "npy_format",
        "npy dtype \"<c8\" holds complex numbers, which are not read; save a.real, a.imag or \
         abs(a) as float32",
    );
    says(
        &described("[('a', '<f4'), ('b', '<i4', (3,))]", "(2,)"),
        "npy_format",
        "npy dtype is structured with 2 fields, which are not read; save each field as an array of \
         its own, for example numpy.savez(path, **{n: a[n] for n in a.dtype.names})",
    );
    says(
        &file("{'descr'; '<f4'}", &[]),
        "npy_format",
        "npy header is malformed at byte 8: expected ':', found ';'; save the array again with \
         numpy.save",
    );
}

#[test]
fn a_failing_reader_is_reported() {
    struct Failing;
    impl Read for Failing {
        fn read(&mut self, _: &mut [u8]) -> io::Result<usize> {
            Err(io::Error::other("device gone"))
        }
    }
    let error = read_f32_from(Failing, MAX_ARRAY_BYTES).unwrap_err();
    assert_eq!(
        error.to_string(),
        "npy bytes could not be read: device gone; check the disk or the archive they come from"
    );
    assert_eq!(error.kind(), "npy_format");
}

#[test]
fn other_types_are_refused_by_name() {
    for (descr, part) in [
        ("'<f16'", "holds long doubles"),
        ("'<M8[ns]'", "holds dates or time spans"),
        ("'<m8[s]'", "holds dates or time spans"),
        ("'|S5'", "holds strings"),
        ("'<U5'", "holds strings"),
        ("'|V16'", "holds raw bytes or records"),
        ("'<i3'", "holds values of an unknown type"),
        ("'i4 '", "holds values of an unknown type"),
        ("''", "holds values of an unknown type"),
        ("('<f4', (3,))", "structured with 1 fields"),
        ("5", "descr is a number, not a string"),
    ] {
        let message = read_f32(&described(descr, "(2,)")).unwrap_err().to_string();
        assert!(message.contains(part), "{descr}: {message}");
    }
}

#[test]
fn headers_are_read_as_python_reads_them() {
    let data: Vec<u8> = (1..=6).flat_map(|value| (value as f32).to_le_bytes()).collect();
    for header in [
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3), }   \n",
        "{\"shape\":(2,3,),\"fortran_order\":False,\"descr\":\"f4\"}",
        " {'shape': (2L, 3L), 'fortran_order': False, 'descr': '=f4'}\n",
        "{'fortran_order': False,\t'descr': '|f4',\n 'shape': (02, 3)}",
    ] {
        let array = read_f32(&file(header, &data)).unwrap();
        assert_eq!(array.shape, [2, 3], "{header}");
        assert_eq!(array.values, [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    }
}

#[test]
fn malformed_headers_are_refused() {
    for (header, part) in [
        ("", "expected '{', found the end"),
        ("{", "expected a value, found the end"),
        ("{'descr': '<f4', 'fortran_order': False}", "key \"shape\" is missing"),
        ("{'fortran_order': False, 'shape': ()}", "key \"descr\" is missing"),
        ("{'descr': '<f4', 'shape': ()}", "key \"fortran_order\" is missing"),
        ("{'descr': '<f4', 'descr': '<f4'}", "key \"descr\" is given twice"),
        ("{'kind': 1}", "unknown key \"kind\""),
        ("{5: 1}", "a key is no string"),
        ("{'descr': '<f4}", "a string is not closed"),
        ("{'descr': f4}", "unknown word \"f4\""),
        ("{'shape': -}", "expected a digit, found '}'"),
        ("{'descr': '<f4', 'fortran_order': 0, 'shape': ()}", "fortran_order is a number"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (3)}", "shape is a number, not"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': [3]}", "shape is a list, not"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': (-3,)}", "holds a negative number"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': ((),)}", "shape holds a tuple"),
        ("{'descr': '<f4', 'fortran_order': False, 'shape': ()} x", "nothing after the closing"),
        (&format!("{{'shape': {}", "[".repeat(1000)), "nested deeper than 16 levels"),
        (
            &format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({})}}", "1,".repeat(65)),
            "shape has 65 axes and NumPy allows 64",
        ),
    ] {
        let error = read_f32(&file(header, &[])).unwrap_err();
        assert!(error.to_string().contains(part), "{header}: {error}");
        assert_eq!(error.kind(), "npy_format");
    }
}

#[test]
fn lying_shapes_allocate_nothing() {
    for shape in [
        "(0, 99999999999999999999)",
        "(99999999999999999999999999999999999,)",
        "(4294967296, 4294967296, 4294967296)",
        "(268435457,)",
    ] {
        assert_eq!(read_f32(&described("'<f4'", shape)).unwrap_err().kind(), "too_large");
    }
    // One byte each in the file, but four in memory.
    assert_eq!(read_f32(&described("'|u1'", "(268435457,)")).unwrap_err().kind(), "too_large");
    // Within the limit and far beyond the data.
    assert_eq!(read_f32(&described("'<f4'", "(268435456,)")).unwrap_err().kind(), "truncated");
    let limited = read_f32_from(described("'<f4'", "(16,)").as_slice(), 63).unwrap_err();
    assert_eq!(limited.kind(), "too_large");
}

#[test]
fn doubles_beyond_f32_become_infinite_and_trailing_bytes_are_ignored() {
    let mut bytes = described("'<f8'", "(3,)");
    let start = bytes.len() - 64;
    for (slot, value) in bytes[start..].chunks_exact_mut(8).zip([1e300, -1e39, 0.1]) {
        slot.copy_from_slice(&f64::to_le_bytes(value));
    }
    assert_eq!(read_f32(&bytes).unwrap().values, [f32::INFINITY, f32::NEG_INFINITY, 0.1]);
    assert_eq!(read_f64(&bytes).unwrap().values, [1e300, -1e39, 0.1]);
}

#[test]
fn integers_are_rounded_once() {
    // 2^24 + 1 lies between two f32; 2^63 - 1 rounds up to 2^63.
    let mut bytes = described("'<i8'", "(2,)");
    let start = bytes.len() - 64;
    bytes[start..start + 8].copy_from_slice(&16_777_217_i64.to_le_bytes());
    bytes[start + 8..start + 16].copy_from_slice(&i64::MAX.to_le_bytes());
    assert_eq!(read_f32(&bytes).unwrap().values, [16_777_216.0, 9_223_372_036_854_775_808.0]);
}

#[test]
fn written_as_numpy_writes() {
    // numpy.save of numpy.array([[1, 2]], dtype="<f4") with NumPy 2.4.
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (1, 2), }";
    let expected = [
        b"\x93NUMPY\x01\x00\x76\x00".as_slice(),
        format!("{header:<117}\n").as_bytes(),
        b"\x00\x00\x80\x3f\x00\x00\x00\x40",
    ]
    .concat();
    assert_eq!(write::<f32>(&[1, 2], &[1.0, 2.0]), expected);
}

#[test]
#[should_panic(expected = "shape [2, 2] against 3 values")]
fn writing_checks_the_shape() {
    write::<f32>(&[2, 2], &[0.0; 3]);
}

fn bits(values: &[f32]) -> Vec<u32> {
    values.iter().map(|value| value.to_bits()).collect()
}

proptest! {
    #[test]
    fn written_arrays_read_back(shape in proptest::collection::vec(0_usize..6, 0..5), seed: u32) {
        let count = shape.iter().product::<usize>() as u32;
        let values: Vec<f32> =
            (0..count).map(|i| f32::from_bits(seed.wrapping_mul(i.wrapping_add(7)))).collect();
        let file = write(&shape, &values);
        prop_assert_eq!((file.len() - values.len() * 4) % 64, 0);
        for array in [read_f32(&file).unwrap(), read_f32_from(&file[..], u64::MAX).unwrap()] {
            prop_assert_eq!(&array.shape, &shape);
            prop_assert_eq!(bits(&array.values), bits(&values));
        }
    }

    #[test]
    fn fortran_order_is_undone(shape in proptest::collection::vec(1_usize..5, 1..5)) {
        let count: usize = shape.iter().product();
        // Each value is its own C index, written in Fortran order by the definition of strides.
        let mut stored = vec![0.0_f32; count];
        for c_index in 0..count {
            let (mut rest, mut fortran_index) = (c_index, 0);
            for (axis, length) in shape.iter().enumerate().rev() {
                fortran_index += rest % length * shape[..axis].iter().product::<usize>();
                rest /= length;
            }
            stored[fortran_index] = c_index as f32;
        }
        let expected: Vec<f32> = (0..count).map(|index| index as f32).collect();
        prop_assert_eq!(to_c_order(stored, &shape), expected);
    }

    #[test]
    fn any_bytes_are_answered(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
        let _ = read_f32(&bytes);
        let _ = read_f32(&[b"\x93NUMPY\x01\x00".as_slice(), &bytes].concat());
    }

    #[test]
    fn any_damage_is_answered(
        at in 0_usize..168,
        by in any::<u8>(),
        kept in 0_usize..=168,
    ) {
        let mut file = write(&[2, 5], &[0.5; 10]);
        file[at] ^= by;
        file.truncate(kept);
        if let Ok(array) = read_f64(&file) {
            prop_assert_eq!(array.values.len(), array.shape.iter().product::<usize>());
        }
    }
}
