use proptest::prelude::*;

use super::*;
use crate::motion::convert_track;

const CENTRE: &[u8] = &[0x83, 0x5a, 0x83, 0x93, 0x83, 0x5e, 0x81, 0x5b];
/// Curves along the diagonal.
const STRAIGHT: [u8; 64] = {
    let mut bytes = [20; 64];
    let mut i = 0;
    while i < 64 {
        // Rows are moved on by a byte each, so that the second half is told by the place in the row.
        if (i % 16) + i / 16 >= 8 {
            bytes[i] = 107;
        }
        i += 1;
    }
    bytes
};

fn bone_key(name: &[u8], frame: u32, numbers: [f32; 7]) -> Vec<u8> {
    let mut key = name.to_vec();
    key.resize(15, 0);
    key.extend(frame.to_le_bytes());
    key.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
    key.extend(STRAIGHT);
    key
}

fn camera_key(frame: u32, numbers: [f32; 7]) -> Vec<u8> {
    let mut key = frame.to_le_bytes().to_vec();
    key.extend(numbers.iter().flat_map(|x| x.to_le_bytes()));
    key.extend([20, 107, 20, 107].repeat(6));
    key.extend([30, 0, 0, 0, 0]);
    key
}

fn vmd(bones: &[Vec<u8>], cameras: &[Vec<u8>]) -> Vec<u8> {
    let mut file = SIGNATURE.to_vec();
    file.resize(SIGNATURE_BYTES + MODEL_NAME_BYTES, 0);
    let count = |n: usize| (n as u32).to_le_bytes();
    file.extend(count(bones.len()));
    file.extend(bones.concat());
    file.extend(count(0));
    file.extend(count(cameras.len()));
    file.extend(cameras.concat());
    file
}

#[test]
fn the_centre_moves_in_metres_and_reflected() {
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let file = vmd(
        &[
            // A quarter turn about y, which in a left-handed world is clockwise seen from above.
            bone_key(CENTRE, 10, [10.0, -1.0, 5.0, 0.0, half, 0.0, half]),
            bone_key(CENTRE, 0, [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
            // No bone of the root, but the dance goes on.
            bone_key(b"arm", 14, [f32::NAN; 7]),
        ],
        &[],
    );
    let track = read(&file).unwrap();
    assert_eq!(track.position_m.len(), 15);
    for (t, share) in [(0, 0.0), (5, 0.5), (10, 1.0), (14, 1.0)] {
        let want = [0.8 * share, 0.64 - 0.08 * share, -0.4 * share];
        for (got, want) in track.position_m[t].iter().zip(want) {
            assert!((got - want).abs() < 1e-9, "{t}: {:?}", track.position_m[t]);
        }
    }
    let [w, x, y, z] = track.orientation[14];
    let half = f64::from(half);
    assert!((w - half).abs() < 1e-7 && (y + half).abs() < 1e-7 && x == 0.0 && z == 0.0);
}

#[test]
fn a_camera_looks_at_its_target() {
    // From 35 units in front of (1, 12, 3), turned by a quarter about y: from its left, that is +x.
    let quarter = std::f32::consts::FRAC_PI_2;
    let file = vmd(&[], &[camera_key(0, [-35.0, 1.0, 12.0, 3.0, 0.0, quarter, 0.0])]);
    let track = read(&file).unwrap();
    for (got, want) in track.position_m[0].iter().zip([36.0 * 0.08, 12.0 * 0.08, -3.0 * 0.08]) {
        assert!((got - want).abs() < 1e-6, "{:?}", track.position_m);
    }
    let sight = crate::motion::quaternion::rotate(track.orientation[0], [0.0, 0.0, 1.0]);
    for (got, want) in sight.iter().zip([-1.0, 0.0, 0.0]) {
        assert!((got - want).abs() < 1e-6, "{sight:?}");
    }
    let both = vmd(&[bone_key(CENTRE, 3, [0.0; 7])], &[camera_key(0, [0.0; 7])]);
    assert_eq!(read(&both).unwrap().notes.last().unwrap(), "1 camera keys are left out");
}

#[test]
fn files_that_are_cut_or_hold_no_root_are_refused() {
    let told = |bytes: &[u8]| {
        let error = read(bytes).unwrap_err();
        (error.to_string(), error.kind())
    };
    let file = vmd(&[bone_key(CENTRE, 1, [0.0; 7]), bone_key(CENTRE, 2, [0.0; 7])], &[]);
    let cut = "vmd declares 2 bone keys of 111 bytes, 153 bytes follow; the file was cut short, copy it again";
    assert_eq!(told(&file[..207]), (cut.to_owned(), "truncated"));
    let cut = "vmd ends at byte 52, before its number of bone keys; copy the file again";
    assert_eq!(told(&file[..52]), (cut.to_owned(), "truncated"));
    // Early versions end after the bones.
    assert!(read(&file[..54 + 222]).is_ok());
    let no_root = "vmd has 1 bone keys, none of 全ての親, センター or グルーブ (root, centre, groove), and no \
                   camera keys; export a motion that moves one of them";
    let centre_ik = [CENTRE, &[0x82, 0x68]].concat();
    assert_eq!(
        told(&vmd(&[bone_key(&centre_ik, 1, [0.0; 7])], &[])),
        (no_root.to_owned(), "motion_format")
    );
    assert_eq!(
        told(&vmd(&[bone_key(CENTRE, u32::MAX, [0.0; 7])], &[])),
        (
            "vmd has a key at frame 4294967295, at most 216000 are read; split the motion"
                .to_owned(),
            "too_large"
        )
    );
    assert_eq!(
        told(&vmd(&[], &[camera_key(7, [f32::INFINITY; 7])])),
        (
            "vmd has a value that is not finite in the camera key of frame 7; mend or delete that key"
                .to_owned(),
            "non_finite"
        )
    );
}

proptest! {
    #[test]
    fn no_bytes_make_the_reader_panic(
        foreign in prop::collection::vec(any::<u8>(), 0..300),
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        frames in prop::collection::vec(0..400u32, 1..5), cut in any::<prop::sample::Index>()
    ) {
        let bones: Vec<_> = frames.iter().map(|&t| bone_key(CENTRE, t, [0.5; 7])).collect();
        let cameras: Vec<_> = frames.iter().map(|&t| camera_key(t, [0.5; 7])).collect();
        for mut bytes in [vmd(&bones, &cameras), vmd(&[], &cameras), [SIGNATURE, &foreign].concat(), foreign] {
            for (at, byte) in &flips {
                if !bytes.is_empty() {
                    let at = at.index(bytes.len());
                    bytes[at] = *byte;
                }
            }
            for bytes in [&bytes[..], &bytes[..cut.index(bytes.len() + 1)]] {
                match read(bytes) {
                    Ok(track) => drop(convert_track(&track, None, None)),
                    Err(error) => prop_assert!(error.to_string().len() < 1000),
                }
            }
        }
    }
}
