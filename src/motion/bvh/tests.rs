use super::*;
use proptest::prelude::*;

const TWO_JOINTS: &str = "HIERARCHY\nROOT Hips\n{\n OFFSET 1 2 3\n CHANNELS 6 \
    Xposition Yposition Zposition Zrotation Xrotation Yrotation\n JOINT Left Leg\n {\n  \
    OFFSET 0 -.5 0\n  CHANNELS 3 Yrotation Xrotation Zrotation\n  End Site\n  {\n   \
    OFFSET 0 -1e0 0\n  }\n }\n}\nMOTION\nFrames: 2\nFrame Time: .04\n\
    1 2 3 4 5 6 7 8 9\n-1 -2 -3 -4 -5 -6 -7 -8 -9\n";

fn refusal(text: &str) -> String {
    Bvh::parse(text.as_bytes()).unwrap_err().to_string()
}

#[test]
fn a_small_skeleton_is_read_in_full() {
    let bvh = Bvh::parse(TWO_JOINTS.as_bytes()).unwrap();
    let summary: Vec<_> =
        bvh.joints().iter().map(|j| (j.name.as_str(), j.parent, j.offset)).collect();
    assert_eq!(
        summary,
        [
            ("Hips", None, [1.0, 2.0, 3.0]),
            ("Left Leg", Some(0), [0.0, -0.5, 0.0]),
            ("Left Leg_end", Some(1), [0.0, -1.0, 0.0]),
        ]
    );
    use JointChannel::Rotation;
    assert_eq!(bvh.joints()[1].channels, [Rotation(1), Rotation(0), Rotation(2)]);
    assert_eq!(bvh.joints()[2].channels, []);
    assert_eq!(bvh.frame_time_s(), 0.04);
    assert_eq!(bvh.frames().dim(), (2, 9));
    assert_eq!(bvh.frames()[[1, 8]], -9.0);
}

#[test]
fn case_line_ends_tabs_and_a_byte_order_mark_do_not_matter() {
    let want = Bvh::parse(TWO_JOINTS.as_bytes()).unwrap();
    let shouted = TWO_JOINTS
        .replace("ROOT", "root")
        .replace("OFFSET", "Offset")
        .replace("Xposition", "xPosition")
        .replace("Frame Time:", "frame\ttime:")
        .replace(' ', " \t ")
        .replace("Left \t Leg", "Left Leg")
        .replace('\n', "\r\n\r\n");
    let text = format!("\u{feff}{}", shouted.trim_end());
    assert_eq!(Bvh::parse(text.as_bytes()).unwrap(), want);
}

#[test]
fn missing_and_surplus_values_are_counted() {
    assert_eq!(
        refusal(&TWO_JOINTS.replace("Frames: 2", "Frames: 70")),
        "bvh line 17 declares 70 frames of 9 values, found 2 frames and 0 values; \
         correct the count or restore the missing lines"
    );
    let cut = TWO_JOINTS.trim_end().strip_suffix(" -7 -8 -9").unwrap();
    let Err(BvhError::FrameCount { found_frames, found_rest, .. }) = Bvh::parse(cut.as_bytes())
    else {
        panic!("expected a frame count error");
    };
    assert_eq!((found_frames, found_rest), (1, 6));
    // A cut file is never whole by its frame count.
    let last = TWO_JOINTS.replace("Frames: 2", "Frames: 3").trim_end().to_owned();
    assert!(Bvh::parse(last.strip_suffix(" -9").unwrap().as_bytes()).is_err());
    assert!(Bvh::parse(TWO_JOINTS.replace("Frames: 2", "Frames: 4").as_bytes()).is_err());
}

#[test]
fn a_lying_frame_count_allocates_nothing() {
    assert_eq!(
        refusal(&TWO_JOINTS.replace("Frames: 2", "Frames: 18446744073709551615")),
        "bvh line 17 brings frames to 18446744073709551615, at most 1000000 are read; \
         split the file"
    );
    let huge = TWO_JOINTS.replace("Frames: 2", "Frames: 18446744073709551616");
    assert!(refusal(&huge).contains("expected a frame count of at least 1"));
    assert!(refusal(&TWO_JOINTS.replace("Frames: 2", "Frames: 0")).contains("at least 1"));
}

#[test]
fn errors_name_the_line_and_what_was_expected() {
    assert_eq!(
        refusal(&TWO_JOINTS.replace("OFFSET 0 -.5 0", "OFFSET 0 half 0")),
        "bvh line 8 has `half`, expected offset y; export the take again as plain BVH"
    );
    assert_eq!(
        refusal(&TWO_JOINTS.replace("7 8 9\n-1", "7 nan 9\n-1")),
        "bvh line 19 has `nan`, expected a finite number; repair or cut the take there"
    );
    assert_eq!(
        refusal(&TWO_JOINTS.replace(".04", "0")),
        "bvh line 18 has frame time 0.0 s, expected 0.0001 to 1 s; \
         write the sampling interval of the take"
    );
    assert_eq!(
        refusal(&TWO_JOINTS.replace("3 Yrotation", "3 Xscale")),
        "bvh line 9 has `Xscale`, expected a channel such as Xposition or Zrotation; \
         export the take again as plain BVH"
    );
    assert_eq!(
        refusal("HIERARCHY\nROOT Hips\n{\n"),
        "bvh line 3 has the end of the text, expected OFFSET, CHANNELS, JOINT, End Site or }; \
         export the take again as plain BVH"
    );
    assert!(refusal("ROOT x").contains("expected HIERARCHY"));
    assert!(refusal(&TWO_JOINTS.replace("MOTION", "ROOT b {}\nMOTION")).contains("MOTION"));
    assert!(
        refusal("HIERARCHY\nROOT a\n{ }\nMOTION\nFrames: 1\nFrame Time: 1\n")
            .contains("a skeleton without channels")
    );
}

#[test]
fn depth_nodes_and_channels_are_bounded() {
    let deep = format!("HIERARCHY ROOT a {{ {}", "JOINT b\n{ ".repeat(100_000));
    assert_eq!(
        refusal(&deep),
        "bvh line 128 brings nested joints to 129, at most 128 are read; split the file"
    );
    let wide = format!("HIERARCHY ROOT a {{ {}", "End Site { }\n".repeat(5000));
    assert!(refusal(&wide).contains("brings nodes to 1025, at most 1024"));
    assert!(refusal(&TWO_JOINTS.replace("CHANNELS 3", "CHANNELS 9")).contains("at most 6"));
}

fn noted(text: &[u8]) -> (Bvh, Vec<String>) {
    let bvh = Bvh::parse(text).unwrap();
    let notes = bvh.notes().iter().map(ToString::to_string).collect();
    (bvh, notes)
}

#[test]
fn a_frame_count_off_by_one_is_read_with_a_note() {
    for declared in [1, 3] {
        let text = TWO_JOINTS.replace("Frames: 2", &format!("Frames: {declared}"));
        let (bvh, notes) = noted(text.as_bytes());
        assert_eq!(bvh.frames().nrows(), 2);
        let note = format!("line 17 declares {declared} frames, all 2 that are there are read");
        assert_eq!(notes, [note]);
    }
}

#[test]
fn labels_are_read_however_their_spaces_and_colons_are() {
    let want = Bvh::parse(TWO_JOINTS.as_bytes()).unwrap();
    for (frames, time, n_notes) in [
        ("Frames:2", "Frame Time:.04", 2),
        ("FRAMES :2", "Frame Time : .04", 2),
        ("Frames\t:\t2", "FrameTime: .04", 2),
        ("Frames 2", "frame time .04", 2),
        ("frames:  2", "Frame  Time:\t.04", 0),
        ("Frames: 2", "Frame\tTime: 4e-2", 0),
    ] {
        let text = TWO_JOINTS.replace("Frames: 2", frames).replace("Frame Time: .04", time);
        let (bvh, notes) = noted(text.as_bytes());
        assert_eq!(bvh.frames(), want.frames(), "{frames}");
        assert_eq!(bvh.frame_time_s(), 0.04, "{time}");
        assert_eq!(notes.len(), n_notes, "{notes:?}");
    }
    let (_, notes) = noted(TWO_JOINTS.replace("Frames: 2", "Frames:2").as_bytes());
    assert_eq!(notes, ["line 17 has `Frames:2`, usual is `Frames:`"]);
    assert_eq!(
        refusal(&TWO_JOINTS.replace("Frames: 2", "Framesize: 2")),
        "bvh line 17 has `Framesize:`, expected Frames:; export the take again as plain BVH"
    );
    assert_eq!(
        refusal(&TWO_JOINTS.replace("Frame Time", "Frame Rate")),
        "bvh line 18 has `Frame`, expected Frame Time:; export the take again as plain BVH"
    );
}

#[test]
fn end_sites_with_names_and_joints_without_are_read() {
    let want = Bvh::parse(TWO_JOINTS.as_bytes()).unwrap();
    for end in ["End Site Left Toe", "END SITE toe", "EndSite toe", "End Site toe {"] {
        let mut text = TWO_JOINTS.replace("End Site", end);
        if end.ends_with('{') {
            text = text.replace("toe {\n  {", "toe {\n");
        }
        let (bvh, notes) = noted(text.as_bytes());
        assert_eq!(bvh.joints(), want.joints(), "{end}");
        assert_eq!(notes, ["1 end sites have names, the first in line 10"], "{end}");
    }
    let (bvh, notes) = noted(TWO_JOINTS.replace("JOINT Left Leg", "JOINT").as_bytes());
    assert_eq!(bvh.joints()[1].name, "joint 1");
    assert_eq!(notes, ["1 joints have no names, the first in line 6"]);
}

#[test]
fn any_encoding_of_windows_is_read() {
    let want = Bvh::parse(TWO_JOINTS.as_bytes()).unwrap();
    for (big_endian, mark) in [(false, true), (true, true), (false, false), (true, false)] {
        let text = if mark { format!("\u{feff}{TWO_JOINTS}") } else { TWO_JOINTS.to_owned() };
        let bytes: Vec<u8> = text
            .encode_utf16()
            .flat_map(|unit| if big_endian { unit.to_be_bytes() } else { unit.to_le_bytes() })
            .collect();
        let (bvh, notes) = noted(&bytes);
        assert_eq!((bvh.joints(), bvh.frames()), (want.joints(), want.frames()));
        assert_eq!(notes, ["text is UTF-16"]);
    }
    // A byte order mark, a Ctrl-Z, NULs and old Mac line ends need no note.
    let text = format!("\u{feff}{}\u{1a}\0\0", TWO_JOINTS.replace('\n', "\r"));
    assert_eq!(Bvh::parse(text.as_bytes()).unwrap(), want);
    let bad = text.replace("-7", "x");
    assert!(refusal(&bad).starts_with("bvh line 20 has `x`"), "{}", refusal(&bad));
}

#[test]
fn decimal_commas_are_read_with_a_note() {
    let want = Bvh::parse(TWO_JOINTS.as_bytes()).unwrap();
    let text = TWO_JOINTS.replace("-.5", "-0,5").replace(".04", "0,04");
    let (bvh, notes) = noted(text.as_bytes());
    assert_eq!((bvh.joints(), bvh.frames()), (want.joints(), want.frames()));
    assert_eq!(bvh.frame_time_s(), 0.04);
    assert_eq!(notes, ["numbers have decimal commas, the first in line 8"]);
    // Commas between numbers are another format.
    assert!(refusal(&TWO_JOINTS.replace("1 2 3 4 5", "1.0,2.0,3.0 4 5")).contains("line 19"));
    assert!(refusal(&TWO_JOINTS.replace("1 2 3 4 5", "1,2 3,4 5")).contains("found 1 frames"));
}

#[test]
fn a_rounded_frame_time_is_the_one_that_is_meant() {
    let bvh = Bvh::parse(TWO_JOINTS.replace(".04", "0.0333333").as_bytes()).unwrap();
    assert_eq!(bvh.frame_time_s(), 1.0 / 30.0);
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
        let _ = Bvh::parse(&bytes);
    }

    #[test]
    fn damaged_files_never_panic(at in 0..TWO_JOINTS.len(), n in 0..12usize,
                                 patch in "[{}a-zA-Z0-9 .:\\n\\-]{0,9}") {
        let mut bytes = TWO_JOINTS.as_bytes().to_vec();
        let end = (at + n).min(bytes.len());
        bytes.splice(at..end, patch.into_bytes());
        if let Ok(bvh) = Bvh::parse(&bytes) {
            let n_channels: usize = bvh.joints().iter().map(|j| j.channels.len()).sum();
            prop_assert_eq!(bvh.frames().ncols(), n_channels);
            prop_assert!(bvh.joints().iter().enumerate().all(|(i, j)| j.parent < Some(i)));
        }
    }
}
