//! Files written by NumPy read through [`motiongen::motion::npy`] and [`motiongen::motion::npz`].
//!
//! `tests/golden/npy/make.py` writes them by the rule that [`expected`] repeats.

use motiongen::motion::npy::{self, NpyArray};
use motiongen::motion::npz::Npz;

const GOLDEN: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/npy/");
const SHAPE: [usize; 3] = [3, 5, 2];

fn golden(name: &str) -> Vec<u8> {
    let path = format!("{GOLDEN}{name}");
    std::fs::read(&path).unwrap_or_else(|error| panic!("{path}: {error}"))
}

/// The value at flat C index `i` for a type code such as `i4`.
fn expected(code: &str, i: usize) -> f64 {
    let base = (i * 7 % 23) as f64;
    match code.as_bytes()[0] {
        b'b' => base % 2.0,
        b'u' => base,
        b'i' => base - 11.0,
        _ => (base - 11.0) / 4.0,
    }
}

#[track_caller]
fn assert_rule<T: Copy + Into<f64>>(array: &NpyArray<T>, shape: &[usize], code: &str, name: &str) {
    assert_eq!(array.shape, shape, "{name}");
    assert_eq!(array.values.len(), shape.iter().product::<usize>(), "{name}");
    for (i, &value) in array.values.iter().enumerate() {
        assert_eq!(value.into(), expected(code, i), "{name} at flat index {i}");
    }
}

#[test]
fn every_dtype_byte_order_and_layout_reads_exactly() {
    let mut n_files = 0;
    for code in ["b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"] {
        for byte_order in ["le", "be"] {
            if byte_order == "be" && code.ends_with('1') {
                continue;
            }
            for layout in ["c", "fortran"] {
                let name = format!("{code}_{byte_order}_{layout}.npy");
                let bytes = golden(&name);
                assert_rule(&npy::read_f32(&bytes).unwrap(), &SHAPE, code, &name);
                assert_rule(&npy::read_f64(&bytes).unwrap(), &SHAPE, code, &name);
                n_files += 1;
            }
        }
    }
    assert_eq!(n_files, 42);
}

#[test]
fn every_version_and_rank_reads() {
    for name in ["version_2.npy", "version_3.npy"] {
        assert_rule(&npy::read_f32(&golden(name)).unwrap(), &SHAPE, "f4", name);
    }
    for (name, shape) in
        [("vector.npy", &[7][..]), ("motion.npy", &[25, 9]), ("empty_axis.npy", &[0, 4])]
    {
        assert_rule(&npy::read_f32(&golden(name)).unwrap(), shape, "f4", name);
    }
    let scalar = npy::read_f32(&golden("scalar.npy")).unwrap();
    assert_eq!(scalar, NpyArray { shape: vec![], values: vec![expected("f4", 2) as f32] });
}

#[test]
fn writing_equals_numpy_save_byte_for_byte() {
    for name in ["f4_le_c.npy", "vector.npy", "motion.npy", "scalar.npy", "empty_axis.npy"] {
        let bytes = golden(name);
        let array = npy::read_f32(&bytes).unwrap();
        assert_eq!(npy::write(&array.shape, &array.values), bytes, "{name}");
    }
}

#[test]
fn what_is_no_plain_number_is_refused() {
    for (name, kind, part) in [
        ("refused_complex.npy", "npy_format", "complex numbers"),
        ("refused_datetime.npy", "npy_format", "dates or time spans"),
        ("refused_bytes.npy", "npy_format", "strings"),
        ("refused_text.npy", "npy_format", "strings"),
        ("refused_structured.npy", "npy_format", "structured with 2 fields"),
        ("refused_longdouble.npy", "npy_format", "long doubles"),
        ("refused_pickle.npy", "pickle", "never executed"),
    ] {
        let error = npy::read_f32(&golden(name)).unwrap_err();
        assert_eq!(error.kind(), kind, "{name}: {error}");
        assert!(error.to_string().contains(part), "{name}: {error}");
    }
}

#[test]
fn npz_members_read_stored_and_deflated() {
    for name in ["stored.npz", "deflated.npz"] {
        let bytes = golden(name);
        let mut npz = Npz::open(&bytes).unwrap();
        assert_eq!(npz.keys(), ["mel", "beats", "power", "sample_rate_hz"], "{name}");
        assert_rule(&npz.read_f32("mel").unwrap(), &[8, 6], "f4", name);
        assert_rule(&npz.read_f64("beats").unwrap(), &[5], "i8", name);
        assert_rule(&npz.read_f32("power").unwrap(), &[4, 3], "f8", name);
        let rate = npz.read_f64("sample_rate_hz").unwrap();
        assert_eq!(rate, NpyArray { shape: vec![], values: vec![22_050.0] });
    }
    let bytes = golden("zip64.npz");
    assert_rule(&Npz::open(&bytes).unwrap().read_f32("mel").unwrap(), &[8, 6], "f4", "zip64.npz");
}

#[test]
fn unusable_archives_are_refused() {
    let bytes = golden("no_members.npz");
    let mut none = Npz::open(&bytes).unwrap();
    assert!(none.keys().is_empty());
    assert_eq!(none.read_f32("mel").unwrap_err().kind(), "missing_key");

    let bytes = golden("bzip2.npz");
    let error = Npz::open(&bytes).unwrap().read_f32("mel").unwrap_err();
    assert_eq!(error.kind(), "npz_format");
    assert!(error.to_string().contains("zip method 12"), "{error}");

    let bytes = golden("deflated.npz");
    for kept in [30, bytes.len() / 2, bytes.len() - 23] {
        assert_eq!(Npz::open(&bytes[..kept]).unwrap_err().kind(), "truncated", "{kept} bytes");
    }
}
