//! Makers of source files: motion, features, audio and beats, sound unless a test breaks them.

use std::io::{Cursor, Write as _};

use motiongen::motion::npy::write;
use motiongen::motion::{MOTION_DIM, quaternion};
use motiongen::units::FPS;
use zip::CompressionMethod;
use zip::write::SimpleFileOptions;

pub type Frame = [f32; MOTION_DIM];

/// Returns `n_frames` of motion that obeys the identities of the format: unit quaternions,
/// velocity, acceleration and angular velocity as forward differences. Each `seed` is another walk.
pub fn coherent(n_frames: usize, seed: u32) -> Vec<Frame> {
    let seed = f64::from(seed);
    let position = |i: usize| {
        let t_s = i as f64 / FPS;
        [(0.7 * t_s + seed).sin(), 0.9 + 0.05 * (5.0 * t_s).sin(), 0.3 * t_s + 0.01 * seed]
    };
    let velocity = |i: usize| difference(position(i), position(i + 1));
    let acceleration = |i: usize| difference(velocity(i), velocity(i + 1));
    let turn = |i: usize| {
        let angle_rad = 0.4 * seed + 1.1 * i as f64 / FPS;
        quaternion::from_axis_angle([0.0, 1.0, 0.0], angle_rad)
    };
    let frame = |i: usize| {
        let mut values = Vec::with_capacity(MOTION_DIM);
        values.extend(position(i));
        values.extend(velocity(i));
        values.extend(acceleration(i));
        values.extend(turn(i));
        values.extend(quaternion::angular_velocity(turn(i), turn(i + 1), FPS));
        // 120 beats per minute, four to the bar.
        values.push((i as f64 / FPS / 2.0).fract());
        values.extend((0..8).map(|k| (0.3 * seed + f64::from(k)).sin() * 0.9));
        std::array::from_fn(|channel| values[channel] as f32)
    };
    (0..n_frames).map(frame).collect()
}

fn difference(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| (b[axis] - a[axis]) * FPS)
}

/// Returns frames as the bytes of `trajectory.npy`.
pub fn trajectory(frames: &[Frame]) -> Vec<u8> {
    write(&[frames.len(), MOTION_DIM], frames.as_flattened())
}

/// Returns a version 1.0 `.npy` file of any type: `descr` and `shape` as Python writes them.
pub fn npy(descr: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let mut header = format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}");
    header += &" ".repeat(63 - (10 + header.len()) % 64);
    header.push('\n');
    [b"\x93NUMPY\x01\x00", (header.len() as u16).to_le_bytes().as_slice(), header.as_bytes(), data]
        .concat()
}

/// A member of an archive: its key and the bytes of its array.
pub type Member = (&'static str, Vec<u8>);

/// Returns members as `numpy.savez` writes them (`Stored`) or `numpy.savez_compressed`
/// (`Deflated`).
pub fn npz(members: &[Member], method: CompressionMethod) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    // NumPy reserves room for sizes over 4 GiB, whatever the size.
    let options = SimpleFileOptions::default().compression_method(method).large_file(true);
    for (key, array) in members {
        zip.start_file(format!("{key}.npy"), options).unwrap();
        zip.write_all(array).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// Returns the arrays of a sound feature file of `n_frames`, with a tempo of 97.5 beats/min.
pub fn features(n_frames: usize) -> Vec<Member> {
    let array = |shape: &[usize], start: f32| {
        let n: usize = shape.iter().product();
        let values: Vec<f32> = (0..n).map(|i| start + (i % 101) as f32 / 64.0).collect();
        write(shape, &values)
    };
    vec![
        ("mel", array(&[128, n_frames], -80.0)),
        ("chroma", array(&[12, n_frames], 0.0)),
        ("mfcc", array(&[20, n_frames], -3.0)),
        ("rms", array(&[1, n_frames], 0.0)),
        ("spectral_centroid", array(&[1, n_frames], 900.0)),
        ("onset_strength", array(&[n_frames], 0.0)),
        ("tempo", npy("'<f8'", "()", &97.5_f64.to_le_bytes())),
        ("beat_times", write(&[3], &[0.25, 0.75, 1.25])),
    ]
}

/// Returns a sound `features.npz` of `n_frames`.
pub fn features_npz(n_frames: usize) -> Vec<u8> {
    npz(&features(n_frames), CompressionMethod::Deflated)
}

/// Sample rate of [`wav`].
pub const WAV_RATE_HZ: u32 = 8_000;

/// Returns a mono 16-bit WAV file of `duration_s` at [`WAV_RATE_HZ`].
pub fn wav(duration_s: f64) -> Vec<u8> {
    let n_samples = (duration_s * f64::from(WAV_RATE_HZ)).round() as usize;
    let samples: Vec<u8> =
        (0..n_samples).flat_map(|i| ((i * 37 % 2001) as i16 - 1000).to_le_bytes()).collect();
    wav_of(WAV_RATE_HZ, 1, &samples)
}

/// Returns a 16-bit WAV file around `samples`, whatever its header then says.
pub fn wav_of(rate_hz: u32, n_channels: u16, samples: &[u8]) -> Vec<u8> {
    let n_bytes = samples.len() as u32;
    let frame_bytes = 2 * n_channels;
    [
        b"RIFF".as_slice(),
        &(n_bytes + 36).to_le_bytes(),
        b"WAVEfmt \x10\x00\x00\x00\x01\x00",
        &n_channels.to_le_bytes(),
        &rate_hz.to_le_bytes(),
        &(rate_hz * u32::from(frame_bytes)).to_le_bytes(),
        &frame_bytes.to_le_bytes(),
        b"\x10\x00data",
        &n_bytes.to_le_bytes(),
        samples,
    ]
    .concat()
}

/// Returns a beats file of `n_beats` at `tempo_bpm`, numbered when `beats_per_bar` is given.
pub fn beats(n_beats: usize, tempo_bpm: f64, beats_per_bar: Option<usize>) -> String {
    (0..n_beats)
        .map(|i| {
            let number = beats_per_bar.map_or(String::new(), |n| format!(" {}", i % n + 1));
            format!("{}{number}\n", 0.5 + i as f64 * 60.0 / tempo_bpm)
        })
        .collect()
}
