//! The file in which a user says what a motion must do: poses, holds and a motion to continue as TOML or JSON, or a table
//! of way points ([`super::path_file`]).

use std::fmt;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, anyhow, bail, ensure};
use ndarray::Array2;
use serde::Deserialize;

use super::path_file::{FrameConstraints, LAST_FRAME, frame_of, of_array, of_csv};
use crate::generation::{Constraints, WantedValue, continuing, facing};
use crate::motion::{CHANNEL_NAMES, Channel, ChannelLimits, MOTION_DIM, npy};

/// Frames of a motion that is continued, unless the file says otherwise: half a second.
const CONTINUED_FRAMES: usize = 15;

/// Values that may be asked of a frame: of each channel four times, since what agrees may be said again.
const MAX_ASKED: usize = 4 * MOTION_DIM;
/// Largest file that is read, in bytes.
const MAX_FILE_BYTES: u64 = 16 << 20;

/// All that a file can say; TOML or JSON.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ConstraintsFile {
    /// The pose of the first frame.
    start: Option<Pose>,
    /// The pose of the last frame.
    end: Option<Pose>,
    #[serde(default)]
    keyframe: Vec<Keyframe>,
    #[serde(default)]
    hold: Vec<Hold>,
    /// A motion whose last frames are the first of this one.
    continue_from: Option<Continued>,
}

/// Values of one frame.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
struct Pose {
    /// m
    position: Option<[f64; 3]>,
    /// w, x, y, z
    quaternion: Option<[f64; 4]>,
    /// Degrees from +Z towards +X, upright, instead of a quaternion.
    heading_deg: Option<f64>,
    /// Any other channel by its name.
    #[serde(flatten)]
    channels: std::collections::BTreeMap<String, f64>,
}

/// Values at a time.
#[derive(Clone, Debug, PartialEq, Deserialize)]
struct Keyframe {
    time_s: Option<f64>,
    frame: Option<usize>,
    #[serde(flatten)]
    pose: Pose,
}

/// Values over a time.
#[derive(Clone, Debug, PartialEq, Deserialize)]
struct Hold {
    from_s: f64,
    to_s: f64,
    #[serde(flatten)]
    pose: Pose,
}

#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct Continued {
    /// A `.npy` or `.csv` of 25 channels, beside the file that names it.
    file: PathBuf,
    frames: Option<usize>,
}

/// A file that was read, with the motion that it continues.
#[derive(Clone, Default, PartialEq)]
pub struct ConstraintsRequest {
    file: ConstraintsFile,
    before: Option<(Array2<f32>, usize)>,
    /// What a table asks for.
    path: FrameConstraints,
}

impl fmt::Debug for ConstraintsRequest {
    /// Writes the text that the digest of a motion's settings contains. It begins with `Asked`, as in stores that were
    /// written before: another text would make their motions again.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { file, before, path } = self;
        let mut text = f.debug_struct("Asked");
        text.field("file", file).field("before", before);
        if !path.is_empty() {
            text.field("path", path);
        }
        text.finish()
    }
}

impl ConstraintsRequest {
    /// Reads a file: by the end of its name a table, `.csv` or `.npy`, or JSON, `.json`; TOML otherwise.
    ///
    /// # Errors
    /// One sentence that names the file and what is wrong in it.
    pub fn read(
        path: &Path,
        motion: impl FnOnce(&Path) -> anyhow::Result<Array2<f32>>,
    ) -> anyhow::Result<Self> {
        let name = path.display();
        let mut bytes = Vec::new();
        std::fs::File::open(path)
            .and_then(|file| file.take(MAX_FILE_BYTES + 1).read_to_end(&mut bytes))
            .with_context(|| format!("while reading {name}"))?;
        ensure!(
            bytes.len() as u64 <= MAX_FILE_BYTES,
            "{name}: has more than {MAX_FILE_BYTES} bytes, and is no file of constraints"
        );
        let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
        let extension = extension.as_deref().unwrap_or_default();
        let asked = Self::of_bytes(bytes, extension)
            .with_context(|| format!("{name} has no constraints"))?;
        let before = match &asked.file.continue_from {
            Some(continued) => {
                let frames = continued.frames.unwrap_or(CONTINUED_FRAMES);
                ensure!(frames > 0, "{name}: continue_from takes 0 frames; take 1 or more");
                let beside = path.parent().unwrap_or(Path::new(".")).join(&continued.file);
                let before = motion(&beside)?;
                let n_there = before.nrows();
                // Who names no number takes what there is.
                ensure!(
                    continued.frames.is_none() || frames <= n_there,
                    "{name}: continue_from asks for {frames} frames of {}, which has {n_there}; ask for {n_there} or \
                     fewer",
                    continued.file.display()
                );
                Some((before, frames))
            }
            None => None,
        };
        Ok(Self { before, ..asked })
    }

    /// Reads what a file has whose name ends in `extension`, but no motion that it continues.
    ///
    /// # Errors
    /// One sentence about what is wrong in it.
    pub fn of_bytes(bytes: Vec<u8>, extension: &str) -> anyhow::Result<Self> {
        if extension == "npy" {
            return Ok(Self { path: of_array(&npy::read_f64(&bytes)?)?, ..Self::default() });
        }
        let text = String::from_utf8(bytes)
            .map_err(|_| anyhow!("it is not UTF-8 text; write it as text, or name it .npy"))?;
        match extension {
            "csv" => Ok(Self { path: of_csv(&text)?, ..Self::default() }),
            _ => Self::of_text(&text, extension == "json"),
        }
    }

    /// Reads a text, TOML or JSON, that continues no motion.
    ///
    /// # Errors
    /// One sentence about what is wrong in it.
    pub fn of_text(text: &str, is_json: bool) -> anyhow::Result<Self> {
        Ok(Self { file: Self::parse(text, is_json)?, ..Self::default() })
    }

    fn parse(text: &str, is_json: bool) -> anyhow::Result<ConstraintsFile> {
        if is_json {
            return Ok(serde_json::from_str(text)?);
        }
        toml::from_str(text).map_err(|e: toml::de::Error| {
            let start = e.span().map_or(0, |span| span.start);
            let line = 1 + text.bytes().take(start).filter(|&byte| byte == b'\n').count();
            anyhow!("line {line}: {}", e.message())
        })
    }

    /// Returns what is asked of a track.
    ///
    /// # Errors
    /// One sentence for what cannot be asked of a track of `n_frames`.
    pub fn of_track(&self, n_frames: usize, limits: ChannelLimits) -> anyhow::Result<Constraints> {
        let file = &self.file;
        let mut wanted = self.path.clone();
        if let Some((before, n)) = &self.before {
            wanted.extend(continuing(before.view(), *n));
        }
        if let Some(pose) = &file.start {
            add(pose, 0..1, &mut wanted)?;
        }
        if let Some(pose) = &file.end {
            let last = n_frames.saturating_sub(1);
            add(pose, last..last + 1, &mut wanted)?;
        }
        let most = MAX_ASKED.saturating_mul(n_frames.max(1));
        for Keyframe { time_s, frame, pose } in &file.keyframe {
            let frame = match (time_s, frame) {
                (Some(time_s), None) => frame_of(*time_s)?,
                (None, Some(frame)) => (*frame).min(LAST_FRAME),
                _ => bail!("a keyframe needs time_s or frame, and not both"),
            };
            add(pose, frame..frame + 1, &mut wanted)?;
            check_asked(wanted.len(), most, n_frames)?;
        }
        for Hold { from_s, to_s, pose } in &file.hold {
            let (from, to) = (frame_of(*from_s)?, frame_of(*to_s)?);
            ensure!(
                from <= to,
                "a hold goes from {from_s} s to {to_s} s; it must end after it begins"
            );
            // What lies behind the end is not asked of anything; a hold that begins there is refused as a frame is.
            let end = (to + 1).min(n_frames.max(from + 1));
            add(pose, from..end, &mut wanted)?;
            check_asked(wanted.len(), most, n_frames)?;
        }
        Ok(Constraints::new(wanted, n_frames, limits)?)
    }
}

/// Refuses more values than a track has places for.
fn check_asked(n_asked: usize, most: usize, n_frames: usize) -> anyhow::Result<()> {
    ensure!(
        n_asked <= most,
        "keyframes and holds ask for {n_asked} values and more of a track of {n_frames} frames, where {most} say all \
         there is to say; leave out what is said again"
    );
    Ok(())
}

/// Adds what a pose asks of some frames.
fn add(
    pose: &Pose,
    frames: std::ops::Range<usize>,
    wanted: &mut Vec<(usize, WantedValue)>,
) -> anyhow::Result<()> {
    let Pose { position, quaternion, heading_deg, channels } = pose;
    let mut all = Vec::new();
    if let Some(position) = position {
        let values = Channel::Position.range().zip(position);
        all.extend(values.map(|(channel, &value)| WantedValue::Value { channel, value }));
    }
    match (quaternion, heading_deg) {
        (Some(_), Some(_)) => bail!("an orientation is given twice, as quaternion and heading_deg"),
        (Some(q), None) => all.push(WantedValue::Orientation(*q)),
        (None, Some(heading_deg)) => {
            all.push(WantedValue::Orientation(facing(heading_deg.to_radians())))
        }
        (None, None) => {}
    }
    for (name, &value) in channels {
        let Some(channel) = CHANNEL_NAMES.iter().position(|known| known == name) else {
            bail!(
                "there is no channel {name}; give position, quaternion, heading_deg or one of {}",
                CHANNEL_NAMES.join(", ")
            );
        };
        ensure!(
            !Channel::Quaternion.range().contains(&channel),
            "{name} cannot be asked for alone; give quaternion = [w, x, y, z] or heading_deg"
        );
        all.push(WantedValue::Value { channel, value });
    }
    ensure!(
        !all.is_empty(),
        "a constraint asks for nothing; give position, quaternion or another channel"
    );
    wanted.extend(frames.flat_map(|frame| all.iter().map(move |wanted| (frame, *wanted))));
    Ok(())
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::motion::Placement;

    fn asked(text: &str) -> ConstraintsRequest {
        ConstraintsRequest::of_text(text, false).expect("constraints")
    }

    #[test]
    fn the_text_in_digests_is_that_of_earlier_versions() {
        let text = format!("{:?}", asked(""));
        assert!(
            text.starts_with("Asked { file: ConstraintsFile { start: None, end: None, "),
            "{text}"
        );
        assert!(text.ends_with(" }, before: None }"), "{text}");
    }

    #[test]
    fn every_kind_of_constraint_is_read() {
        let text = "
            [start]
            position = [0.5, 0.9, 0.0]
            heading_deg = 90.0
            [end]
            position_y = 0.7
            [[keyframe]]
            time_s = 1.0
            quaternion = [1.0, 0.0, 0.0, 0.0]
            [[hold]]
            from_s = 2.0
            to_s = 2.1
            position_z = 1.5
        ";
        let constraints = asked(text).of_track(101, ChannelLimits::Wide).expect("constraints");
        let mut frames = Array2::zeros((101, MOTION_DIM));
        frames.column_mut(9).fill(1.0);
        constraints.bend(&mut frames, 0, 1.0);
        assert_eq!((frames[[0, 0]], frames[[0, 1]], frames[[100, 1]]), (0.5, 0.9, 0.7));
        assert_eq!((frames[[60, 2]], frames[[63, 2]]), (1.5, 1.5));
        // A quarter turn to +X: (√½, 0, √½, 0).
        assert!((frames[[0, 11]] - 0.5_f32.sqrt()).abs() < 1e-6);
        assert!((frames[[30, 9]] - 1.0).abs() < 1e-6);
        let json = r#"{"keyframe": [{"frame": 7, "position_y": 0.25}]}"#;
        let file = ConstraintsRequest::parse(json, true).expect("JSON");
        let constraints =
            ConstraintsRequest { file, ..Default::default() }.of_track(8, ChannelLimits::Wide);
        assert_eq!(
            constraints.expect("constraints").errors(Array2::zeros((8, 25)).view())[0].error,
            0.25
        );
    }

    #[test]
    fn a_motion_is_continued() {
        let mut before = Array2::zeros((40, MOTION_DIM));
        before.column_mut(9).fill(1.0);
        before.column_mut(2).assign(&ndarray::Array1::range(0.0, 40.0, 1.0));
        let asked = ConstraintsRequest { before: Some((before, 3)), ..asked("") };
        let constraints = asked.of_track(50, ChannelLimits::Wide).expect("constraints");
        assert_eq!(constraints.placement(Placement::default()).z_m, 37.0);
    }

    #[test]
    fn tables_are_constraints_like_others() {
        let table = |text: &str| ConstraintsRequest::of_bytes(text.as_bytes().to_vec(), "csv");
        let path = table("time_s,x,y,z\n0,0.5,0.9,-1\n1,0.25,0.9,0\n").expect("a path");
        let constraints = path.of_track(31, ChannelLimits::Wide).expect("constraints");
        assert_eq!(
            (
                constraints.placement(Placement::default()).x_m,
                constraints.placement(Placement::default()).z_m
            ),
            (0.5, -1.0)
        );
        assert!(format!("{path:?}").contains(", path: [(0, Value { channel: 0, value: 0.5 })"));
        let said = |text: &str| {
            let path = table(text).expect("a path");
            path.of_track(31, ChannelLimits::Wide).expect_err("a mistake").to_string()
        };
        assert_eq!(
            said("time_s,y\n2,0.9"),
            "a constraint on position_y is at frame 60 (2.00 s), but the track has 31 frames (1.03 s); move it or \
             leave it out"
        );
        assert_eq!(
            said("time_s,y\n0.5,0.9\n0.51,0.8"),
            "position_y at frame 15 must be 0.9 and 0.8 at once; keep one of the two"
        );
        assert!(said("time_s,y\n0.5,inf").starts_with("position_y at frame 15 is inf, allowed "));
        assert_eq!(
            said("frame,qw,qx,qy,qz\n3,1,1,0,0"),
            "the orientation at frame 3 has length 1.4142; a quaternion has length 1"
        );
        let bytes = npy::write(&[2, 3], &[1.0, f64::NAN, 0.0, f64::NAN, 0.9, f64::NAN]);
        let path = ConstraintsRequest::of_bytes(bytes, "npy").expect("a path");
        let constraints = path.of_track(2, ChannelLimits::Wide).expect("constraints");
        assert_eq!(constraints.errors(Array2::zeros((2, 25)).view()).len(), 3);
        let broken = ConstraintsRequest::of_bytes(vec![0x93, 0x4e], "npy");
        assert!(!broken.expect_err("no array").to_string().is_empty());
        let broken = ConstraintsRequest::of_bytes(vec![0xff, 0xfe], "csv").expect_err("no text");
        assert_eq!(broken.to_string(), "it is not UTF-8 text; write it as text, or name it .npy");
    }

    #[test]
    fn a_hold_ends_with_the_track_at_the_latest() {
        let held = |to_s: &str| {
            let text = format!("[[hold]]\nfrom_s = 0.1\nto_s = {to_s}\nposition_y = 0.5");
            asked(&text).of_track(31, ChannelLimits::Wide)
        };
        let to_the_end = held("1.0").expect("constraints");
        for to_s in ["1.1", "1e8", "1e300", "1.7e308"] {
            assert_eq!(held(to_s).expect("constraints"), to_the_end, "{to_s}");
        }
        let behind = |text: &str| {
            let refused = asked(text).of_track(31, ChannelLimits::Wide);
            refused.expect_err("behind the end").to_string()
        };
        assert_eq!(
            behind("[[hold]]\nfrom_s = 2.0\nto_s = 1e8\nposition_y = 0.5"),
            "a constraint on position_y is at frame 60 (2.00 s), but the track has 31 frames (1.03 s); move it or \
             leave it out"
        );
        for keyframe in ["frame = 9223372036854775807", "time_s = 1e300"] {
            let said = behind(&format!("[[keyframe]]\n{keyframe}\nposition_y = 0.5"));
            assert!(
                said.ends_with("but the track has 31 frames (1.03 s); move it or leave it out"),
                "{said}"
            );
        }
        // JSON has greater numbers than TOML.
        let json = r#"{"keyframe": [{"frame": 18446744073709551615, "position_y": 0.5}]}"#;
        let last = ConstraintsRequest::of_text(json, true).expect("JSON");
        let said = last.of_track(31, ChannelLimits::Wide).expect_err("behind the end").to_string();
        assert!(
            said.ends_with("but the track has 31 frames (1.03 s); move it or leave it out"),
            "{said}"
        );
    }

    #[test]
    fn the_same_said_without_end_is_refused() {
        let hold = "[[hold]]\nfrom_s = 0.0\nto_s = 1e8\nposition_y = 0.5\n";
        assert!(asked(&hold.repeat(99)).of_track(31, ChannelLimits::Wide).is_ok());
        let refused = asked(&hold.repeat(101)).of_track(31, ChannelLimits::Wide);
        assert_eq!(
            refused.expect_err("too much").to_string(),
            "keyframes and holds ask for 3131 values and more of a track of 31 frames, where 3100 say all there is to \
             say; leave out what is said again"
        );
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_reader(
            text in r#"(\[\[?(start|end|keyframe|hold)\]\]?\n|(time_s|frame|from_s|to_s|position_y|heading_deg) ?= ?(-?[0-9]{1,3}(e[0-9]{1,3})?|nan|inf|-inf)\n|position = \[1, 2.0, 3\]\n|[ -~]){0,12}"#,
            is_json: bool,
            n_frames in 0_usize..40,
        ) {
            if let Ok(asked) = ConstraintsRequest::of_text(&text, is_json) {
                let _ = asked.of_track(n_frames, ChannelLimits::Wide);
            }
        }
    }

    #[test]
    fn mistakes_are_named() {
        let said = |text: &str| {
            asked(text).of_track(101, ChannelLimits::Wide).expect_err("a mistake").to_string()
        };
        assert_eq!(
            said("[[keyframe]]\nposition_y = 1.0"),
            "a keyframe needs time_s or frame, and not both"
        );
        assert_eq!(
            said("[[keyframe]]\nframe = 3"),
            "a constraint asks for nothing; give position, quaternion or another channel"
        );
        assert_eq!(
            said("[[keyframe]]\nframe = 3\nquaternion_w = 1.0"),
            "quaternion_w cannot be asked for alone; give quaternion = [w, x, y, z] or heading_deg"
        );
        assert!(
            said("[start]\nspeed = 1.0").starts_with("there is no channel speed; give position, ")
        );
        assert_eq!(
            said("[[hold]]\nfrom_s = 2.0\nto_s = 1.0\nposition_y = 1.0"),
            "a hold goes from 2 s to 1 s; it must end after it begins"
        );
        assert_eq!(
            said("[start]\nquaternion = [1.0, 0.0, 0.0, 0.0]\nheading_deg = 3.0"),
            "an orientation is given twice, as quaternion and heading_deg"
        );
        assert_eq!(
            said("[[keyframe]]\ntime_s = -1.0\nposition_y = 1.0"),
            "-1 s is no time in a track; begin at 0"
        );
        assert!(ConstraintsRequest::parse("[middle]\nposition_y = 1.0", false).is_err());
    }
}
