//! Trajectories and captures that are no motion.

use motiongen::motion::npy::write;

use super::case::Case;
use crate::support::files::{coherent, npy, trajectory};

pub fn cases() -> Vec<Case> {
    [foreign_bytes(), foreign_types(), shapes(), values(), captures()]
        .into_iter()
        .flatten()
        .collect()
}

fn sound() -> Vec<u8> {
    trajectory(&coherent(17, 3))
}

/// A sound trajectory of 17 frames with some of its values replaced.
fn with_values(replaced: &[(usize, usize, f32)]) -> Vec<u8> {
    let mut frames = coherent(17, 3);
    for &(frame, channel, value) in replaced {
        frames[frame][channel] = value;
    }
    trajectory(&frames)
}

#[rustfmt::skip]
fn foreign_bytes() -> Vec<Case> {
    let mut header_lie = sound();
    header_lie[8..10].copy_from_slice(&60_000_u16.to_le_bytes());
    let mut header_short = sound();
    header_short[8..10].copy_from_slice(&40_u16.to_le_bytes());
    let mut version = sound();
    version[6] = 9;
    let mut magic = sound();
    magic[..6].copy_from_slice(b"NUMPY!");
    vec![
        Case::npy("npy-empty", vec![], "empty_file",
            "npy file is empty (0 bytes); the download or copy that made it failed, fetch it \
             again"),
        Case::npy("npy-cut-in-the-data", sound()[..1001].to_vec(), "truncated",
            "npy data is truncated: 1700 bytes are declared and 873 found; the file was cut short, \
             copy or download it again"),
        Case::npy("npy-cut-in-the-header", sound()[..61].to_vec(), "truncated",
            "npy header is truncated: 118 bytes are declared and 51 found; the file was cut short, \
             copy or download it again"),
        Case::npy("npy-cut-in-the-magic", sound()[..5].to_vec(), "truncated",
            "npy magic is truncated: 8 bytes are declared and 5 found; the file was cut short, \
             copy or download it again"),
        Case::npy("npy-header-length-too-long", header_lie, "truncated",
            "npy header is truncated: 60000 bytes are declared and 1818 found; the file was cut \
             short, copy or download it again"),
        Case::npy("npy-header-length-too-short", header_short, "npy_format",
            "npy header is malformed at byte 40: expected a value, found the end; save the array \
             again with numpy.save"),
        Case::npy("npy-version-9", version, "npy_format",
            "npy format version 9.0 is unknown; versions 1.0, 2.0 and 3.0 are read, save the array \
             again with numpy.save"),
        Case::npy("npy-wrong-magic", magic, "npy_format",
            "not an npy file: it starts with \"NUMPY!\"; save the array with numpy.save"),
        Case::npy("npy-is-a-web-page", b"<html>404 Not Found</html>".to_vec(), "npy_format",
            "not an npy file: it starts with \"<html>404 Not Found</htm\"; was an error page saved \
             in place of the array?"),
        Case::npy("npy-is-a-zip", b"PK\x03\x04\x14\x00\x00\x00\x08\x00".to_vec(), "npy_format",
            "not an npy file: it starts with bytes 50 4b 03 04 14 00 00 00; it is a zip archive, \
             name it .npz to have its members read"),
        Case::npy("npy-claims-10-gb", npy("'<f4'", "(100000000, 25)", &[0; 100]), "too_large",
            "npy header declares shape (100000000, 25) of \"<f4\", at least 10000000000 bytes in \
             memory, over the limit of 1073741824; split the array into smaller files"),
        Case::npy("npy-claims-1-gb", npy("'<f4'", "(10000000, 25)", &[0; 100]), "truncated",
            "npy data is truncated: 1000000000 bytes are declared and 100 found; the file was cut \
             short, copy or download it again"),
        Case::npy("npy-claims-more-than-can-be", npy("'<f4'", "(99999999999999999999999, 25)", &[]),
            "too_large",
            "npy header declares shape (18446744073709551615, 25) of \"<f4\", at least \
             18446744073709551615 bytes in memory, over the limit of 1073741824; split the array \
             into smaller files"),
        Case::npy("npy-negative-length", npy("'<f4'", "(-3, 25)", &[]), "npy_format",
            "npy header is malformed at byte 49: shape holds a negative number, not a length; save \
             the array again with numpy.save"),
    ]
}

#[rustfmt::skip]
fn foreign_types() -> Vec<Case> {
    vec![
        Case::npy("npy-bare-pickle", b"\x80\x04\x95\x1a\x00\x00\x00cos\nsystem".to_vec(), "pickle",
            "npy holds Python objects (pickle), which are never executed; save it with \
             numpy.save(..., allow_pickle=False) from a numeric array"),
        Case::npy("npy-object-array", npy("'|O'", "(2,)", b"\x80\x04\x95\x1a\x00\x00\x00"),
            "pickle",
            "npy holds Python objects (pickle), which are never executed; save it with \
             numpy.save(..., allow_pickle=False) from a numeric array"),
        Case::npy("npy-structured", npy("[('x', '<f4'), ('y', '<f4')]", "(3,)", &[0; 24]),
            "npy_format",
            "npy dtype is structured with 2 fields, which are not read; save each field as an \
             array of its own, for example numpy.savez(path, **{n: a[n] for n in a.dtype.names})"),
        Case::npy("npy-strings", npy("'<U5'", "(3, 25)", &[0; 1500]), "npy_format",
            "npy dtype \"<U5\" holds strings, which are not read; save a numeric array, and names \
             in a text file"),
        Case::npy("npy-complex", npy("'<c8'", "(3, 25)", &[0; 600]), "npy_format",
            "npy dtype \"<c8\" holds complex numbers, which are not read; save a.real, a.imag or \
             abs(a) as float32"),
        Case::npy("npy-dates", npy("'<M8[ns]'", "(3, 25)", &[0; 600]), "npy_format",
            "npy dtype \"<M8[ns]\" holds dates or time spans, which are not read; save them as \
             float64 seconds"),
        Case::npy("npy-long-doubles", npy("'<f16'", "(3, 25)", &[0; 1200]), "npy_format",
            "npy dtype \"<f16\" holds long doubles, whose layout differs between machines, which \
             are not read; save a.astype('float64')"),
    ]
}

#[rustfmt::skip]
fn shapes() -> Vec<Case> {
    let zeros = |shape: &[usize]| write(shape, &vec![0.0; shape.iter().product()]);
    vec![
        Case::npy("npy-24-channels", zeros(&[17, 24]), "shape",
            "{path} has shape [17, 24], expected [frames, 25]"),
        Case::npy("npy-transposed", zeros(&[25, 17]), "shape",
            "{path} has shape [25, 17], expected [frames, 25]; transpose it"),
        Case::npy("npy-3-d", zeros(&[1, 17, 24]), "shape",
            "{path} has shape [1, 17, 24], expected [frames, 25]"),
        Case::npy("npy-1-d", zeros(&[425]), "shape",
            "{path} has shape [425], expected [frames, 25]"),
        Case::npy("npy-0-d", zeros(&[]), "shape",
            "{path} has shape [], expected [frames, 25]"),
        Case::npy("npy-no-frames", zeros(&[0, 25]), "shape",
            "{path} has shape [0, 25], expected [frames, 25]"),
    ]
}

#[rustfmt::skip]
fn values() -> Vec<Case> {
    let mut doubles: Vec<f64> = coherent(17, 3).as_flattened().iter().map(|&x| x.into()).collect();
    doubles[6 * 25 + 1] = -1e39;
    let doubles: Vec<u8> = doubles.into_iter().flat_map(f64::to_le_bytes).collect();
    let scaled: Vec<_> = (9..13).map(|c| (8, c, coherent(17, 3)[8][c] * 1.5)).collect();
    vec![
        Case::npy("npy-nan", with_values(&[(7, 4, f32::NAN), (16, 24, f32::NAN)]), "non_finite",
            "channel velocity_y is NaN at frame 7 (2 non-finite values in all); repair or remove \
             the phrase"),
        Case::npy("npy-infinite", with_values(&[(0, 0, f32::INFINITY)]), "non_finite",
            "channel position_x is inf at frame 0 (1 non-finite values in all); repair or remove \
             the phrase"),
        Case::npy("npy-double-beyond-single", npy("'<f8'", "(17, 25)", &doubles), "non_finite",
            "channel position_y is -inf at frame 6 (1 non-finite values in all); repair or remove \
             the phrase"),
        Case::npy("npy-quaternion-too-long", with_values(&scaled), "quaternion_norm",
            "quaternion norm is 1.5000 at frame 8, expected 1 within 0.05 (1 such frames in all); \
             normalise the quaternions or remove the phrase"),
        Case::npy("npy-quaternion-zero", with_values(&[
                (3, 9, 0.0), (3, 10, 0.0), (3, 11, 0.0), (3, 12, 0.0)]),
            "quaternion_norm",
            "quaternion norm is 0.0000 at frame 3, expected 1 within 0.05 (1 such frames in all); \
             normalise the quaternions or remove the phrase"),
        Case::npy("npy-spins-too-fast", with_values(&[(5, 13, 20.5), (2, 15, -31.0)]),
            "channel_limit",
            "{path}: channel angular_velocity_z is -31.0 rad/s at frame 2, allowed -20 to 20 rad/s \
             (2 values outside their limits in all); correct the unit or remove the phrase"),
        Case::npy("npy-too-far-away", with_values(&[(11, 2, 100.5)]), "channel_limit",
            "{path}: channel position_z is 100.5 m at frame 11, allowed -100 to 100 m (1 values \
             outside their limits in all); correct the unit or remove the phrase"),
        Case::npy("npy-too-fast", with_values(&[(11, 3, -51.0)]), "channel_limit",
            "{path}: channel velocity_x is -51.0 m/s at frame 11, allowed -50 to 50 m/s (1 values \
             outside their limits in all); correct the unit or remove the phrase"),
        Case::npy("npy-phase-beyond-the-bar", with_values(&[(1, 16, 1.25)]), "channel_limit",
            "{path}: channel phase is 1.25 bar at frame 1, allowed 0 to 1 bar (1 values outside \
             their limits in all); correct the unit or remove the phrase"),
    ]
}

/// A capture of one joint; `motion` is what follows its skeleton.
fn capture(motion: &str) -> String {
    format!(
        "HIERARCHY\nROOT Hips\n{{\n OFFSET 0 0 0\n CHANNELS 6 Xposition Yposition Zposition \
         Zrotation Xrotation Yrotation\n End Site\n {{\n  OFFSET 0 1.7 0\n }}\n}}\nMOTION\n{motion}"
    )
}

#[rustfmt::skip]
fn captures() -> Vec<Case> {
    vec![
        Case::bvh("bvh-empty", "", "empty_file", "{path} is empty; export the capture again"),
        Case::bvh("bvh-cut-in-the-skeleton", capture("").split_once("Yp").unwrap().0, "bvh_format",
            "bvh line 5 has the end of the text, expected a channel such as Xposition or \
             Zrotation; export the take again as plain BVH"),
        Case::bvh("bvh-cut-in-the-frames",
            capture("Frames: 3\nFrame Time: 0.04\n0 1 0 0 0 0\n0 1 0 0 0 5\n0 1\n"), "bvh_format",
            "bvh line 12 declares 3 frames of 6 values, found 2 frames and 2 values; correct the \
             count or restore the missing lines"),
        Case::bvh("bvh-binary", b"\x00\x01\xff\xfe\x00GIF89a".as_slice(), "bvh_format",
            "bvh line 1 has `\\u{0}\\u{1}\\u{fffd}\\u{fffd}\\u{0}GIF89a`, expected HIERARCHY; \
             export the take again as plain BVH"),
        Case::bvh("bvh-no-frames", capture("Frames: 0\nFrame Time: 0.04\n"), "bvh_format",
            "bvh line 12 has `0`, expected a frame count of at least 1; export the take again as \
             plain BVH"),
        Case::bvh("bvh-claims-too-many-frames", capture("Frames: 4000000000\nFrame Time: 0.04\n"),
            "bvh_format",
            "bvh line 12 brings frames to 4000000000, at most 1000000 are read; split the file"),
        Case::bvh("bvh-not-a-number",
            capture("Frames: 2\nFrame Time: 0.04\n0 1 0 0 0 0\n0 1 0 nan 0 0\n"), "bvh_format",
            "bvh line 15 has `nan`, expected a finite number; repair or cut the take there"),
        Case::bvh("bvh-too-short",
            capture("Frames: 2\nFrame Time: 0.04\n0 1 0 0 0 0\n0 1 0 0 0 0\n"), "bvh_format",
            "capture lasts 0.040 s and gives 2 frames at 30 fps, expected at least 5; use a longer \
             take"),
    ]
}
