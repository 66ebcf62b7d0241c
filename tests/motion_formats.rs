//! Formats of the field against golden files whose forward kinematics are stated apart
//! (`tests/golden/motion_formats/make.py`), by the readers and through ingest.

use std::fs;
use std::path::PathBuf;

use motiongen::motion::formats::{humanml3d, smpl, vmd};
use motiongen::motion::npy::read_f64;
use motiongen::motion::{
    Bvh, CHANNEL_NAMES, Capture, Channel, MOTION_DIM, RigidTrack, convert_capture, convert_track,
};

use crate::support::{Dir, failures, ingest, motion, phrases};

/// Every file of the folder with the format that it is told to be.
const CASES: [(&str, &str, &str); 9] = [
    ("aist", "npz", "aist"),
    ("amass", "npz", "amass"),
    ("smplx", "npz", "amass"),
    ("smpl", "npz", "smpl"),
    ("humanml3d", "npy", "humanml3d"),
    ("lafan1", "bvh", "bvh"),
    ("bandai", "bvh", "bvh"),
    ("dance", "vmd", "vmd"),
    ("camera", "vmd", "vmd_camera"),
];
/// Position within this, m.
const POSITION_M: f64 = 1e-3;
/// Orientation within this, degrees.
const ANGLE_DEG: f64 = 0.1;

fn golden(name: &str) -> Vec<u8> {
    let folder = "tests/golden/motion_formats";
    let path: PathBuf = [env!("CARGO_MANIFEST_DIR"), folder, name].iter().collect();
    fs::read(&path).unwrap_or_else(|error| panic!("{}: {error}", path.display()))
}

fn read(name: &str, extension: &str) -> Capture {
    let bytes = golden(&format!("{name}.{extension}"));
    let track: RigidTrack = match extension {
        "npz" => smpl::read(&bytes).unwrap(),
        "npy" => humanml3d::read(&bytes).unwrap(),
        "vmd" => vmd::read(&bytes).unwrap(),
        _ => return convert_capture(&Bvh::parse(&bytes).unwrap(), None, None).unwrap(),
    };
    convert_track(&track, None, None).unwrap()
}

/// Asserts that a motion is the expected one: the root to 1 mm and 0.1°, and every channel to what the
/// digits of its file leave.
fn assert_expected(name: &str, extension: &str, got: &[f32]) {
    let expected = read_f64(&golden(&format!("{name}.expected.npy"))).unwrap();
    assert_eq!(expected.shape, [got.len() / MOTION_DIM, MOTION_DIM], "{name}");
    // Features of single precision: 1e-7 m, summed over 60 frames and twice differenced (900 per s²). Text
    // of six decimals: 1e-8 m and 1e-6°. The others are double precision or exact.
    let digits = if extension == "npy" { 5e-4 } else { 2e-5 };
    let rows = got.chunks_exact(MOTION_DIM).zip(expected.values.chunks_exact(MOTION_DIM));
    for (t, (got, want)) in rows.enumerate() {
        let got: Vec<f64> = got.iter().map(|&x| f64::from(x)).collect();
        let off: Vec<f64> = got.iter().zip(want).map(|(a, b)| a - b).collect();
        let apart_m = Channel::Position.range().map(|i| off[i] * off[i]).sum::<f64>().sqrt();
        assert!(apart_m < POSITION_M, "{name}: frame {t} is {apart_m} m off");
        let chord = Channel::Quaternion.range().map(|i| off[i] * off[i]).sum::<f64>().sqrt();
        let apart_deg = 4.0 * (chord / 2.0).min(1.0).asin().to_degrees();
        assert!(apart_deg < ANGLE_DEG, "{name}: frame {t} is turned by {apart_deg}°");
        for (i, off) in off.iter().enumerate() {
            let tolerance = digits * (1.0 + want[i].abs());
            assert!(off.abs() <= tolerance, "{name}: frame {t}, {}: {off}", CHANNEL_NAMES[i]);
        }
    }
}

#[test]
fn every_channel_agrees_with_kinematics_written_apart() {
    for (name, extension, _) in CASES {
        let capture = read(name, extension);
        let frames: Vec<f32> = capture.trajectory.view().iter().copied().collect();
        assert_expected(name, extension, &frames);
    }
}

#[test]
fn ingest_reads_each_format_and_tells_what_it_took() {
    let dir = Dir::new();
    for (name, extension, _) in CASES {
        let bytes = golden(&format!("{name}.{extension}"));
        dir.write(format!("captures/motion/{name}/motion.{extension}"), bytes);
    }
    let store = dir.at("store");
    let output = ingest(&dir.at("captures"), &store, &["--limits", "wide"]);
    assert_eq!(output.code, 0, "{output:?}");
    let (rows, motions) = (phrases(&store), motion(&store));
    assert_eq!(rows.len(), CASES.len());
    for (name, extension, format) in CASES {
        assert_eq!(rows[name].motion_format.as_deref(), Some(format), "{name}");
        assert_eq!(rows[name].motion_cut_s, Some(0.0), "{name}");
        let frames: Vec<f32> = motions[name].iter().flatten().copied().collect();
        assert_expected(name, extension, &frames);
    }
    let told = |name: &str| {
        let row = &rows[name];
        (
            row.motion_root.clone().unwrap(),
            row.motion_up.clone().unwrap(),
            row.motion_notes.clone().unwrap_or_default(),
        )
    };
    let pelvis = "root is the pelvis of the mean shape, 0.223 m below the translation along the file's y; \
                  that of the body's own shape is not in the file";
    let is = |root: &str, up: &str, notes: &str| (root.to_owned(), up.to_owned(), notes.to_owned());
    assert_eq!(told("aist"), is("pelvis", "y", pelvis));
    assert_eq!(told("amass"), is("pelvis", "z", &format!("{pelvis}; z is up in the file")));
    assert_eq!(told("smplx"), told("amass"));
    assert_eq!(told("smpl"), is("pelvis", "y", pelvis));
    assert_eq!(
        told("humanml3d"),
        is("pelvis", "y", "of the root's orientation the features have the heading alone")
    );
    assert_eq!(
        told("lafan1"),
        is("Hips", "y", "joint Hips has axes of its own, x is the body's up, it is turned upright")
    );
    assert_eq!(
        told("bandai"),
        is("Hips", "y", "root joint_Root never moves, the body's root is Hips")
    );
    assert_eq!(
        told("dance"),
        is(
            "センター",
            "y",
            "the centre is taken to rest at 0.64 m, as most models have it; the motion does not say it"
        )
    );
    assert_eq!(told("camera"), is("camera", "y", "the track is the camera's"));
}

#[test]
fn what_is_not_read_is_refused_with_the_way_out() {
    let dir = Dir::new();
    let features = golden("humanml3d.npy");
    for (id, name, bytes) in [
        ("pickled", "motion.pkl", b"\x80\x04}\x94.".to_vec()),
        ("markers", "motion.c3d", b"\x02\x50".to_vec()),
        ("features", "trajectory.npy", features),
        ("songs", "motion.npz", {
            let mut npz = motiongen::motion::npz::NpzWriter::new(std::io::Cursor::new(Vec::new()));
            npz.add("mel", &[2, 1], [0.0f32, 1.0]).unwrap();
            npz.finish().unwrap().into_inner()
        }),
        ("text", "motion.vmd", b"HIERARCHY\n".to_vec()),
        ("nothing", "motion.npz", Vec::new()),
    ] {
        dir.write(format!("captures/motion/{id}/{name}"), bytes);
    }
    let store = dir.at("store");
    let output = ingest(&dir.at("captures"), &store, &[]);
    assert_ne!(output.code, 0, "{output:?}");
    let found: Vec<(String, String, String)> =
        failures(&store).into_values().map(|row| (row.phrase_id, row.kind, row.message)).collect();
    let want = [
        (
            "features",
            "shape",
            "motion/features/trajectory.npy has shape [61, 263], expected [frames, 25]; features of \
             HumanML3D are read where the file is named motion.npy",
        ),
        (
            "markers",
            "motion_format",
            "motion/markers/motion.c3d is a C3D file of markers, which is not read; solve it to a skeleton \
             and export that as BVH (in Blender: import the C3D, retarget it to an armature, export it as \
             motion.bvh)",
        ),
        ("nothing", "empty_file", "motion/nothing/motion.npz is empty; export the capture again"),
        (
            "pickled",
            "pickle",
            "motion/pickled/motion.pkl is a Python pickle, which can run any program and is never loaded; \
             convert it where you trust it: python3 -c \"import pickle, numpy as n; d = \
             pickle.load(open('motion.pkl', 'rb'), encoding='latin1'); n.savez('motion.npz', **{k: d[k] for \
             k in ('smpl_poses', 'smpl_trans', 'root_trans', 'smpl_scaling') if k in d})\"",
        ),
        (
            "songs",
            "missing_key",
            "motion/songs/motion.npz: npz has no pose: it holds mel, expected smpl_orients, smpl_poses, poses, root_orient \
             or global_orient; save them with numpy.savez(path, poses=…, trans=…, mocap_framerate=…)",
        ),
        (
            "text",
            "motion_format",
            "motion/text/motion.vmd: vmd starts with \"HIERARCHY\", expected \"Vocaloid Motion Data 0002\"; \
             save the motion again in MikuMikuDance 5 or later",
        ),
    ];
    let want = want.map(|(id, kind, message)| (id.to_owned(), kind.to_owned(), message.to_owned()));
    assert_eq!(found, want);
}
