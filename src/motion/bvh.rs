//! Biovision hierarchy (BVH) text: a skeleton and its channel values frame by frame.
//!
//! The text is untrusted. Nothing is allocated from a number the file claims, the nesting is kept
//! on an explicit stack, and the limits below bound every count. Keywords are read in any case;
//! spaces, tabs, blank lines, CRLF and a byte order mark are all white space. What exporters commonly
//! write otherwise is read, and told by [`Bvh::notes`]. Format: Meredith and Maddock, Motion Capture File
//! Formats Explained, University of Sheffield, 2001, section 3.

mod frame_time;
mod note;
mod words;

use ndarray::{Array2, ArrayView2};
use thiserror::Error;

use super::text::text_of;

pub use note::BvhNote;

use frame_time::frame_time_of;
use words::Words;

/// Longest accepted text.
pub const MAX_TEXT_BYTES: usize = 128 << 20;
/// Most nodes of a skeleton, end sites included.
pub const MAX_NODES: usize = 1024;
/// Deepest nesting of braces.
pub const MAX_DEPTH: usize = 128;
/// Most channels of one joint: three positions and three rotations.
pub const MAX_JOINT_CHANNELS: usize = 6;
/// Most frames: over two hours at 120 Hz.
pub const MAX_FRAMES: usize = 1_000_000;
/// Shortest and longest frame time, s.
pub const FRAME_TIME_RANGE_S: (f64, f64) = (1e-4, 1.0);

/// Frames by which the declared count may be off.
const FRAME_COUNT_SLACK: usize = 1;
const SHOWN_CHARS: usize = 40;

/// Why a BVH text was refused; every variant names a line, counted from 1.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum BvhError {
    /// Something else stands where the format needs a certain word or number.
    #[error("bvh line {line} has {found}, expected {expected}; export the take again as plain BVH")]
    Unexpected { line: usize, found: String, expected: &'static str },
    /// A number that is NaN or infinite.
    #[error("bvh line {line} has {found}, expected a finite number; repair or cut the take there")]
    NonFinite { line: usize, found: String },
    /// The frame time is zero, negative or absurd.
    #[error(
        "bvh line {line} has frame time {frame_time_s:?} s, expected {low} to {high} s; \
         write the sampling interval of the take"
    )]
    FrameTime { line: usize, frame_time_s: f64, low: f64, high: f64 },
    /// A count beyond one of the limits.
    #[error("bvh line {line} brings {what} to {count}, at most {limit} are read; split the file")]
    Limit { line: usize, what: &'static str, count: usize, limit: usize },
    /// Fewer or more values than the declared frames need.
    #[error(
        "bvh line {line} declares {declared} frames of {n_channels} values, found {found_frames} \
         frames and {found_rest} values; correct the count or restore the missing lines"
    )]
    FrameCount {
        line: usize,
        declared: usize,
        n_channels: usize,
        found_frames: usize,
        found_rest: usize,
    },
}

/// The motion of one channel of a joint; the number is the axis, 0 to 2 for x to z.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum JointChannel {
    /// Translation along an axis, in file units.
    Position(usize),
    /// Rotation about an axis, in degrees.
    Rotation(usize),
}

/// One node of the skeleton: a joint, or an end site without channels.
#[derive(Clone, Debug, PartialEq)]
pub struct Joint {
    /// The joint's name; for an end site its parent's name with `_end`.
    pub name: String,
    /// Index of the parent, always smaller than the node's own; `None` for the root.
    pub parent: Option<usize>,
    /// Rest position relative to the parent, file units.
    pub offset: [f64; 3],
    /// The joint's channels in file order.
    pub channels: Vec<JointChannel>,
}

/// A parsed BVH file.
#[derive(Clone, Debug, PartialEq)]
pub struct Bvh {
    joints: Vec<Joint>,
    frame_time_s: f64,
    frames: Array2<f64>,
    notes: Vec<BvhNote>,
}

impl Bvh {
    /// Parses a whole BVH file with one root and `Frames:` matching its data, or off by one.
    ///
    /// Errors: [`BvhError`], with the line where reading stopped.
    pub fn parse(text: &[u8]) -> Result<Self, BvhError> {
        if text.len() > MAX_TEXT_BYTES {
            let (what, count) = ("bytes", text.len());
            return Err(BvhError::Limit { line: 1, what, count, limit: MAX_TEXT_BYTES });
        }
        let (text, was_utf16) = text_of(text);
        let mut words = Words::new(&text);
        words.notes.extend(was_utf16.then_some(BvhNote::Utf16));
        let joints = parse_hierarchy(&mut words)?;
        let (frame_time_s, frames) = parse_motion(&mut words, &joints)?;
        Ok(Self { joints, frame_time_s, frames, notes: words.notes })
    }

    /// All nodes, parents before children, the root first.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Deviations from the format that are read all the same.
    pub fn notes(&self) -> &[BvhNote] {
        &self.notes
    }

    /// Sampling interval, s; a rounded one is that of the whole rate which it stands for.
    pub fn frame_time_s(&self) -> f64 {
        self.frame_time_s
    }

    /// Channel values, shape `[n_frames, n_channels]`, channels in the order of the joints.
    pub fn frames(&self) -> ArrayView2<'_, f64> {
        self.frames.view()
    }
}

fn parse_hierarchy(words: &mut Words) -> Result<Vec<Joint>, BvhError> {
    words.expect("HIERARCHY", "HIERARCHY")?;
    words.expect("ROOT", "ROOT")?;
    let mut joints: Vec<Joint> = Vec::new();
    let mut open: Vec<usize> = Vec::new();
    // The first line of each kind, and how many there are.
    let (mut named_ends, mut unnamed) = ((0, 0), (0, 0));
    let name = open_joint(words, &joints, &mut unnamed)?;
    joints.push(Joint { name, parent: None, offset: [0.0; 3], channels: Vec::new() });
    open.push(0);
    while let Some(&node) = open.last() {
        let word = words.next("OFFSET, CHANNELS, JOINT, End Site or }")?;
        if word.is("}") {
            open.pop();
        } else if word.is("OFFSET") {
            joints[node].offset =
                [words.number("offset x")?, words.number("offset y")?, words.number("offset z")?];
        } else if word.is("CHANNELS") && joints[node].channels.is_empty() {
            joints[node].channels = parse_channels(words)?;
        } else if word.is("JOINT") || word.is("End") || word.is("EndSite") {
            check_limit(word.line, "nodes", joints.len() + 1, MAX_NODES)?;
            check_limit(word.line, "nested joints", open.len() + 1, MAX_DEPTH)?;
            let name = if word.is("JOINT") {
                open_joint(words, &joints, &mut unnamed)?
            } else {
                if word.is("End") {
                    words.expect("Site", "Site after End")?;
                }
                let line = words.line;
                if !words.name().is_empty() {
                    count(&mut named_ends, line);
                }
                words.expect("{", "{")?;
                format!("{}_end", joints[node].name)
            };
            open.push(joints.len());
            joints.push(Joint { name, parent: Some(node), offset: [0.0; 3], channels: Vec::new() });
        } else {
            return Err(word.unexpected("OFFSET, one CHANNELS, JOINT, End Site or }"));
        }
    }
    if let (line, count @ 1..) = named_ends {
        words.notes.push(BvhNote::NamedEndSites { line, count });
    }
    if let (line, count @ 1..) = unnamed {
        words.notes.push(BvhNote::UnnamedJoints { line, count });
    }
    Ok(joints)
}

/// Reads a joint's name and its opening brace; one without a name is numbered.
fn open_joint(
    words: &mut Words,
    joints: &[Joint],
    unnamed: &mut (usize, usize),
) -> Result<String, BvhError> {
    let line = words.line;
    let mut name = words.name();
    if name.is_empty() {
        count(unnamed, line);
        name = format!("joint {}", joints.len());
    }
    words.expect("{", "{")?;
    Ok(name)
}

/// Counts one more of a kind, of which the first line is kept.
fn count((first_line, count): &mut (usize, usize), line: usize) {
    if *count == 0 {
        *first_line = line;
    }
    *count += 1;
}

fn parse_channels(words: &mut Words) -> Result<Vec<JointChannel>, BvhError> {
    let count = words.next("a number of channels")?;
    let n: usize = count.parse().ok_or_else(|| count.unexpected("a number of channels"))?;
    check_limit(count.line, "channels of one joint", n, MAX_JOINT_CHANNELS)?;
    const EXPECTED: &str = "a channel such as Xposition or Zrotation";
    (0..n)
        .map(|_| {
            let word = words.next(EXPECTED)?;
            let name = word.text.to_ascii_lowercase();
            let axis = name.first().and_then(|first| b"xyz".iter().position(|a| a == first));
            match (axis, name.get(1..)) {
                (Some(axis), Some(b"position")) => Ok(JointChannel::Position(axis)),
                (Some(axis), Some(b"rotation")) => Ok(JointChannel::Rotation(axis)),
                _ => Err(word.unexpected(EXPECTED)),
            }
        })
        .collect()
}

fn parse_motion(words: &mut Words, joints: &[Joint]) -> Result<(f64, Array2<f64>), BvhError> {
    words.expect("MOTION", "MOTION (one skeleton per file)")?;
    words.expect_label(&["Frames"], "Frames:")?;
    const COUNT: &str = "a frame count of at least 1";
    let count = words.next(COUNT)?;
    let line = count.line;
    let declared: usize =
        count.parse().filter(|&n| n > 0).ok_or_else(|| count.unexpected(COUNT))?;
    check_limit(line, "frames", declared, MAX_FRAMES)?;
    words.expect_label(&["Frame", "Time"], "Frame Time:")?;
    const FRAME_TIME: &str = "frame time in seconds";
    let written = words.next(FRAME_TIME)?;
    let frame_time_s = words.number_of(&written, FRAME_TIME)?;
    let (low, high) = FRAME_TIME_RANGE_S;
    if !(low..=high).contains(&frame_time_s) {
        return Err(BvhError::FrameTime { line: words.line, frame_time_s, low, high });
    }
    let frame_time_s = frame_time_of(&String::from_utf8_lossy(written.text), frame_time_s);
    let n_channels: usize = joints.iter().map(|j| j.channels.len()).sum();
    if n_channels == 0 {
        let found = "a skeleton without channels".to_owned();
        return Err(BvhError::Unexpected { line, found, expected: "at least one CHANNELS" });
    }
    // Grows with the values that are there, whatever the file declares.
    let mut values = Vec::new();
    while let Some(word) = words.next_word() {
        values.push(words.number_of(&word, "channel value")?);
    }
    let (found, rest) = (values.len() / n_channels, values.len() % n_channels);
    let mismatch =
        BvhError::FrameCount { line, declared, n_channels, found_frames: found, found_rest: rest };
    // Exporters that count from 0, or count the rest pose, are off by one; a file that was cut is not whole.
    if rest > 0 || found == 0 || found.abs_diff(declared) > FRAME_COUNT_SLACK {
        return Err(mismatch);
    }
    if found != declared {
        words.notes.push(BvhNote::FrameCount { line, declared, found });
    }
    let frames = Array2::from_shape_vec((found, n_channels), values).map_err(|_| mismatch)?;
    Ok((frame_time_s, frames))
}

fn check_limit(
    line: usize,
    what: &'static str,
    count: usize,
    limit: usize,
) -> Result<(), BvhError> {
    if count > limit { Err(BvhError::Limit { line, what, count, limit }) } else { Ok(()) }
}

#[cfg(test)]
mod tests;
