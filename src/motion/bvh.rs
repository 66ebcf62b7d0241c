//! Biovision hierarchy (BVH) text: a skeleton and its channel values frame by frame.
//!
//! The text is untrusted. Nothing is allocated from a number the file claims, the nesting is kept
//! on an explicit stack, and the limits below bound every count. Keywords are read in any case;
//! spaces, tabs, blank lines, CRLF and a byte order mark are all white space. Format: Meredith and
//! Maddock, Motion Capture File Formats Explained, University of Sheffield, 2001, section 3.

use std::borrow::Cow;

use ndarray::{Array2, ArrayView2};
use thiserror::Error;

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

/// What one channel of a joint moves; the number is the axis, 0 to 2 for x to z.
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
}

impl Bvh {
    /// Parses a whole BVH file with one root and `Frames:` matching its data.
    ///
    /// Errors: [`BvhError`], with the line where reading stopped.
    pub fn parse(text: &[u8]) -> Result<Self, BvhError> {
        if text.len() > MAX_TEXT_BYTES {
            let (what, count) = ("bytes", text.len());
            return Err(BvhError::Limit { line: 1, what, count, limit: MAX_TEXT_BYTES });
        }
        let mut words = Words::new(text);
        let joints = parse_hierarchy(&mut words)?;
        let (frame_time_s, frames) = parse_motion(&mut words, &joints)?;
        Ok(Self { joints, frame_time_s, frames })
    }

    /// All nodes, parents before children, the root first.
    pub fn joints(&self) -> &[Joint] {
        &self.joints
    }

    /// Sampling interval, s.
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
    let mut joints =
        vec![Joint { name: words.name()?, parent: None, offset: [0.0; 3], channels: Vec::new() }];
    words.expect("{", "{")?;
    let mut open = vec![0];
    while let Some(&node) = open.last() {
        let word = words.next("OFFSET, CHANNELS, JOINT, End Site or }")?;
        if word.is("}") {
            open.pop();
        } else if word.is("OFFSET") {
            joints[node].offset =
                [words.number("offset x")?, words.number("offset y")?, words.number("offset z")?];
        } else if word.is("CHANNELS") && joints[node].channels.is_empty() {
            joints[node].channels = parse_channels(words)?;
        } else if word.is("JOINT") || word.is("End") {
            let name = if word.is("JOINT") {
                words.name()?
            } else {
                words.expect("Site", "Site after End")?;
                format!("{}_end", joints[node].name)
            };
            check_limit(word.line, "nodes", joints.len() + 1, MAX_NODES)?;
            check_limit(word.line, "nested joints", open.len() + 1, MAX_DEPTH)?;
            words.expect("{", "{")?;
            open.push(joints.len());
            joints.push(Joint { name, parent: Some(node), offset: [0.0; 3], channels: Vec::new() });
        } else {
            return Err(word.unexpected("OFFSET, one CHANNELS, JOINT, End Site or }"));
        }
    }
    Ok(joints)
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
    words.expect("Frames:", "Frames:")?;
    const COUNT: &str = "a frame count of at least 1";
    let count = words.next(COUNT)?;
    let line = count.line;
    let declared: usize =
        count.parse().filter(|&n| n > 0).ok_or_else(|| count.unexpected(COUNT))?;
    check_limit(line, "frames", declared, MAX_FRAMES)?;
    words.expect("Frame", "Frame Time:")?;
    words.expect("Time:", "Frame Time:")?;
    let frame_time_s = words.number("frame time in seconds")?;
    let (low, high) = FRAME_TIME_RANGE_S;
    if !(low..=high).contains(&frame_time_s) {
        return Err(BvhError::FrameTime { line: words.line, frame_time_s, low, high });
    }
    let n_channels: usize = joints.iter().map(|j| j.channels.len()).sum();
    if n_channels == 0 {
        let found = "a skeleton without channels".to_owned();
        return Err(BvhError::Unexpected { line, found, expected: "at least one CHANNELS" });
    }
    // Grows with the values that are there, whatever the file declares.
    let mut values = Vec::new();
    while let Some(word) = words.next_word() {
        values.push(word.number("channel value")?);
    }
    let found = values.len();
    let mismatch = BvhError::FrameCount {
        line,
        declared,
        n_channels,
        found_frames: found / n_channels,
        found_rest: found % n_channels,
    };
    if found != declared * n_channels {
        return Err(mismatch);
    }
    let frames = Array2::from_shape_vec((declared, n_channels), values).map_err(|_| mismatch)?;
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

/// One word of the text and the line it stands on.
#[derive(Clone, Copy)]
struct Word<'a> {
    text: &'a [u8],
    line: usize,
}

impl Word<'_> {
    fn is(&self, keyword: &str) -> bool {
        self.text.eq_ignore_ascii_case(keyword.as_bytes())
    }

    fn parse<T: std::str::FromStr>(&self) -> Option<T> {
        std::str::from_utf8(self.text).ok()?.parse().ok()
    }

    fn number(&self, expected: &'static str) -> Result<f64, BvhError> {
        let value: f64 = self.parse().ok_or_else(|| self.unexpected(expected))?;
        if value.is_finite() {
            Ok(value)
        } else {
            Err(BvhError::NonFinite { line: self.line, found: self.shown() })
        }
    }

    fn unexpected(&self, expected: &'static str) -> BvhError {
        BvhError::Unexpected { line: self.line, found: self.shown(), expected }
    }

    fn shown(&self) -> String {
        // Four bytes hold any character, so the cut cannot fall short of the shown ones.
        let head = &self.text[..self.text.len().min(4 * SHOWN_CHARS)];
        let head: String = String::from_utf8_lossy(head).chars().take(SHOWN_CHARS).collect();
        format!("`{}`", head.escape_default())
    }
}

/// The words of a text in order, with line numbers.
struct Words<'a> {
    rest: &'a [u8],
    line: usize,
}

impl<'a> Words<'a> {
    fn new(text: &'a [u8]) -> Self {
        Self { rest: text.strip_prefix(b"\xef\xbb\xbf").unwrap_or(text), line: 1 }
    }

    fn next_word(&mut self) -> Option<Word<'a>> {
        let start = self.rest.iter().position(|b| !b.is_ascii_whitespace())?;
        self.line += self.rest[..start].iter().filter(|&&b| b == b'\n').count();
        let rest = &self.rest[start..];
        let end = rest.iter().position(u8::is_ascii_whitespace).unwrap_or(rest.len());
        let (text, rest) = rest.split_at(end);
        self.rest = rest;
        Some(Word { text, line: self.line })
    }

    fn next(&mut self, expected: &'static str) -> Result<Word<'a>, BvhError> {
        let line = self.line;
        self.next_word().ok_or_else(|| BvhError::Unexpected {
            line,
            found: "the end of the text".to_owned(),
            expected,
        })
    }

    fn expect(&mut self, keyword: &str, expected: &'static str) -> Result<(), BvhError> {
        let word = self.next(expected)?;
        if word.is(keyword) { Ok(()) } else { Err(word.unexpected(expected)) }
    }

    fn number(&mut self, expected: &'static str) -> Result<f64, BvhError> {
        self.next(expected)?.number(expected)
    }

    /// The rest of the line up to a brace: joint names may hold spaces.
    fn name(&mut self) -> Result<String, BvhError> {
        let end = self.rest.iter().position(|&b| b == b'\n' || b == b'{');
        let (name, rest) = self.rest.split_at(end.unwrap_or(self.rest.len()));
        self.rest = rest;
        let name: Cow<'_, str> = String::from_utf8_lossy(name.trim_ascii());
        if name.is_empty() {
            return Err(Word { text: b"", line: self.line }.unexpected("a joint name"));
        }
        Ok(name.chars().take(SHOWN_CHARS).collect())
    }
}

#[cfg(test)]
mod tests {
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
        assert!(Bvh::parse(TWO_JOINTS.replace("Frames: 2", "Frames: 1").as_bytes()).is_err());
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
}
