//! Motion captures: what is found in them is in `phrases` and in the summary.

use crate::support::{Dir, ingest, motion, phrases};

fn take() -> String {
    let path = format!("{}/tests/golden/motion/mocapbank.bvh", env!("CARGO_MANIFEST_DIR"));
    std::fs::read_to_string(&path).unwrap_or_else(|e| panic!("{path}: {e}")).replace("\r\n", "\n")
}

/// The take below a ROOT that never moves.
fn below_a_static_root(take: &str) -> String {
    let (skeleton, rows) = take.split_once("MOTION\n").unwrap();
    let skeleton = skeleton.replace(
        "ROOT ",
        "ROOT world\n{\nOFFSET 0 0 0\nCHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation \
         Yrotation\nJOINT ",
    );
    let rows = rows.lines().enumerate().map(|(i, row)| {
        if i < 2 || row.trim().is_empty() {
            format!("{row}\n")
        } else {
            format!("0 0 0 0 0 0 {row}\n")
        }
    });
    format!("{skeleton}}}\nMOTION\n{}", rows.collect::<String>())
}

#[test]
fn what_is_found_in_a_capture_is_told() {
    let dir = Dir::new();
    let base = take();
    let path = |id: &str| format!("captures/motion/{id}/motion.bvh");
    dir.write(path("base"), &base);
    dir.write(path("more"), base.replace("Frames:\t241", "Frames:\t242"));
    dir.write(path("static"), below_a_static_root(&base));
    let utf16: Vec<u8> =
        format!("\u{feff}{base}").encode_utf16().flat_map(u16::to_le_bytes).collect();
    dir.write(path("utf-16"), utf16);
    let store = dir.at("store");
    let output = ingest(&dir.at("captures"), &store, &["--limits", "wide"]);
    assert_eq!(output.code, 0, "{output:?}");

    let rows = phrases(&store);
    let motions = motion(&store);
    let root = rows["base"].motion_root.clone();
    for (id, row) in &rows {
        assert_eq!(motions[id], motions["base"], "{id}");
        assert_eq!(row.motion_root, root, "{id}");
        assert_eq!(row.motion_up.as_deref(), Some("y"), "{id}");
        assert_eq!((row.motion_unit_m, row.motion_cut_s), (Some(0.01), Some(0.0)), "{id}");
    }
    assert_eq!(rows["base"].motion_notes, None);
    let notes = |id: &str| rows[id].motion_notes.clone().unwrap();
    assert!(notes("more").ends_with("declares 242 frames, all 241 that are there are read"));
    let root = root.unwrap();
    assert_eq!(notes("static"), format!("root world never moves, the body's root is {root}"));
    assert_eq!(notes("utf-16"), "text is UTF-16");
    for id in ["more", "static", "utf-16"] {
        let line = format!("\n  note phrase {id}: {}\n", notes(id));
        assert!(output.stdout.contains(&line), "{}", output.stdout);
    }

    // Nothing is read again until the axis is given.
    let again = ingest(&dir.at("captures"), &store, &["--limits", "wide"]);
    assert!(again.stdout.contains("nothing to do: 4 phrases are up to date"), "{}", again.stdout);
    let turned = ingest(&dir.at("captures"), &store, &["--limits", "wide", "--up", "-z"]);
    assert!(turned.stdout.contains("  4 ingested ("), "{}", turned.stdout);
    assert_eq!(phrases(&store)["base"].motion_up.as_deref(), Some("-z"));
}
