//! The file in which a user says what a motion must do.

use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail, ensure};
use ndarray::Array2;
use serde::Deserialize;

use crate::generation::{Constraints, Wanted, continuing, facing};
use crate::motion::{CHANNEL_NAMES, Channel, ChannelLimits};
use crate::units::s_to_frames;

/// Frames of a motion that is continued, unless the file says otherwise: half a second.
const CONTINUED_FRAMES: usize = 15;

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
#[derive(Clone, Debug, PartialEq)]
pub struct Asked {
    file: ConstraintsFile,
    before: Option<(Array2<f32>, usize)>,
}

impl Asked {
    /// Reads a file; what it says in TOML or, where its name ends in `.json`, JSON.
    ///
    /// # Errors
    /// One sentence that names the file and what is wrong in it.
    pub fn read(
        path: &Path,
        motion: impl FnOnce(&Path) -> anyhow::Result<Array2<f32>>,
    ) -> anyhow::Result<Self> {
        let name = path.display();
        let text =
            std::fs::read_to_string(path).with_context(|| format!("while reading {name}"))?;
        let is_json = path.extension().is_some_and(|extension| extension == "json");
        let file =
            Self::parse(&text, is_json).with_context(|| format!("{name} has no constraints"))?;
        let before = match &file.continue_from {
            Some(continued) => {
                let frames = continued.frames.unwrap_or(CONTINUED_FRAMES);
                ensure!(frames > 0, "{name}: continue_from takes 0 frames; take 1 or more");
                let beside = path.parent().unwrap_or(Path::new(".")).join(&continued.file);
                Some((motion(&beside)?, frames))
            }
            None => None,
        };
        Ok(Self { file, before })
    }

    fn parse(text: &str, is_json: bool) -> anyhow::Result<ConstraintsFile> {
        Ok(if is_json { serde_json::from_str(text)? } else { toml::from_str(text)? })
    }

    /// Returns what is asked of a track.
    ///
    /// # Errors
    /// One sentence for what cannot be asked of a track of so many frames.
    pub fn of_track(&self, n_frames: usize, limits: ChannelLimits) -> anyhow::Result<Constraints> {
        let file = &self.file;
        let mut wanted = Vec::new();
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
        for Keyframe { time_s, frame, pose } in &file.keyframe {
            let frame = match (time_s, frame) {
                (Some(time_s), None) => frame_of(*time_s)?,
                (None, Some(frame)) => *frame,
                _ => bail!("a keyframe needs time_s or frame, and not both"),
            };
            add(pose, frame..frame + 1, &mut wanted)?;
        }
        for Hold { from_s, to_s, pose } in &file.hold {
            let (from, to) = (frame_of(*from_s)?, frame_of(*to_s)?);
            ensure!(
                from <= to,
                "a hold goes from {from_s} s to {to_s} s; it must end after it begins"
            );
            add(pose, from..to + 1, &mut wanted)?;
        }
        Ok(Constraints::new(wanted, n_frames, limits)?)
    }
}

fn frame_of(time_s: f64) -> anyhow::Result<usize> {
    ensure!(time_s.is_finite() && time_s >= 0.0, "{time_s} s is no time in a track; begin at 0");
    Ok(s_to_frames(time_s).round() as usize)
}

/// Adds what a pose asks of some frames.
fn add(
    pose: &Pose,
    frames: std::ops::Range<usize>,
    wanted: &mut Vec<(usize, Wanted)>,
) -> anyhow::Result<()> {
    let Pose { position, quaternion, heading_deg, channels } = pose;
    let mut all = Vec::new();
    if let Some(position) = position {
        let values = Channel::Position.range().zip(position);
        all.extend(values.map(|(channel, &value)| Wanted::Value { channel, value }));
    }
    match (quaternion, heading_deg) {
        (Some(_), Some(_)) => bail!("an orientation is given twice, as quaternion and heading_deg"),
        (Some(q), None) => all.push(Wanted::Orientation(*q)),
        (None, Some(heading_deg)) => {
            all.push(Wanted::Orientation(facing(heading_deg.to_radians())))
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
        all.push(Wanted::Value { channel, value });
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
    use super::*;
    use crate::motion::MOTION_DIM;

    fn asked(text: &str) -> Asked {
        Asked { file: Asked::parse(text, false).expect("constraints"), before: None }
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
        let file = Asked::parse(json, true).expect("JSON");
        let constraints = Asked { file, before: None }.of_track(8, ChannelLimits::Wide);
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
        let asked = Asked { before: Some((before, 3)), ..asked("") };
        let constraints = asked.of_track(50, ChannelLimits::Wide).expect("constraints");
        assert_eq!(constraints.placement().z_m, 37.0);
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
        assert!(Asked::parse("[middle]\nposition_y = 1.0", false).is_err());
    }
}
