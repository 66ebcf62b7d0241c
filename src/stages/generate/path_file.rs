//! A path or way points in a table: CSV with a row for each frame or time of which something is asked, or an array with a
//! row for each frame.

use anyhow::{anyhow, bail, ensure};

use crate::generation::{WantedValue, facing};
use crate::motion::npy::NpyArray;
use crate::motion::{CHANNEL_NAMES, Channel, MOTION_DIM};
use crate::units::{frames_to_s, s_to_frames};

/// What is asked of frames, in the order in which it is said.
pub type FrameConstraints = Vec<(usize, WantedValue)>;

/// A frame behind the end of every track, after which there is another number.
pub const LAST_FRAME: usize = usize::MAX / 2;

/// Components of a quaternion, and axes of a position.
const N_QUATERNION: usize = 4;
const N_AXES: usize = 3;

/// A column of a table.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Column {
    Frame,
    Time,
    /// A channel by its place in a frame; those of the orientation come together.
    Channel(usize),
    /// Degrees from +Z towards +X, upright.
    Heading,
}

impl Column {
    /// Returns the column of a name: that of a channel, or one of the short names of a pose.
    fn of(name: &str) -> Option<Self> {
        let position = |axis: usize| Some(Self::Channel(Channel::Position.range().start + axis));
        let quaternion = |i: usize| Some(Self::Channel(Channel::Quaternion.range().start + i));
        match name {
            "frame" => Some(Self::Frame),
            "time_s" => Some(Self::Time),
            "heading_deg" | "yaw_deg" => Some(Self::Heading),
            "x" => position(0),
            "y" => position(1),
            "z" => position(2),
            "qw" => quaternion(0),
            "qx" => quaternion(1),
            "qy" => quaternion(2),
            "qz" => quaternion(3),
            _ => CHANNEL_NAMES.iter().position(|known| *known == name).map(Self::Channel),
        }
    }
}

/// Reads a table: `time_s` or `frame`, and any of `x`, `y`, `z`, `heading_deg` (or `yaw_deg`), `qw`, `qx`, `qy`, `qz` and
/// the channels by their names; what is empty or `nan` is free.
///
/// # Errors
/// One sentence with the line, counted from 1.
pub fn of_csv(text: &str) -> anyhow::Result<FrameConstraints> {
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let lines = (1..).zip(text.lines()).filter(|(_, line)| !line.trim().is_empty());
    let mut lines = lines.map(|(number, line): (usize, &str)| {
        (number, line.split(',').map(str::trim).collect::<Vec<_>>())
    });
    let (_, names) =
        lines.next().ok_or_else(|| anyhow!("it has no lines; begin with names of columns"))?;
    let columns = columns(&names)?;
    let mut asked = Vec::new();
    for (line, cells) in lines {
        ensure!(
            cells.len() == names.len(),
            "line {line} has {} values where the first line names {} columns",
            cells.len(),
            names.len()
        );
        let mut row = Row::default();
        for ((column, name), cell) in columns.iter().zip(&names).zip(cells) {
            let value: f64 = match cell {
                "" => f64::NAN,
                _ => cell.parse().map_err(|_| {
                    anyhow!("line {line}: {name} reads {cell:?}, which is no number")
                })?,
            };
            match column {
                Column::Frame => row.frame = Some(value),
                Column::Time => row.time_s = Some(value),
                Column::Heading => row.heading_deg = value,
                Column::Channel(channel) => row.channels[*channel] = value,
            }
        }
        row.ask(&mut asked).map_err(|e| anyhow!("line {line}: {e}"))?;
    }
    ensure!(
        !asked.is_empty(),
        "no line asks for anything; give numbers in columns such as x, y and z"
    );
    Ok(asked)
}

/// Returns what each name of the first line is.
fn columns(names: &[&str]) -> anyhow::Result<Vec<Column>> {
    let mut columns: Vec<Column> = Vec::with_capacity(names.len());
    for name in names {
        let Some(column) = Column::of(name) else {
            bail!(
                "there is no column {name:?}; give time_s or frame, and x, y, z, heading_deg, qw, qx, qy, qz or one of {}",
                CHANNEL_NAMES.join(", ")
            );
        };
        ensure!(
            !columns.contains(&column),
            "the column {name} is named twice; keep one of the two"
        );
        columns.push(column);
    }
    ensure!(
        columns.contains(&Column::Frame) || columns.contains(&Column::Time),
        "no column says when: name one time_s or frame"
    );
    Ok(columns)
}

/// What a row says; what is free is NaN.
struct Row {
    frame: Option<f64>,
    time_s: Option<f64>,
    heading_deg: f64,
    channels: [f64; MOTION_DIM],
}

impl Default for Row {
    fn default() -> Self {
        Self { frame: None, time_s: None, heading_deg: f64::NAN, channels: [f64::NAN; MOTION_DIM] }
    }
}

impl Row {
    fn ask(&self, asked: &mut FrameConstraints) -> anyhow::Result<()> {
        let frame = self.frame()?;
        if !self.heading_deg.is_nan() {
            let quaternion = Channel::Quaternion.range();
            ensure!(
                self.channels[quaternion].iter().all(|x| x.is_nan()),
                "an orientation is given twice, as quaternion and heading_deg"
            );
            asked.push((frame, WantedValue::Orientation(facing(self.heading_deg.to_radians()))));
        }
        ask(frame, &self.channels, asked)
    }

    /// Returns the frame that is meant: that of `frame`, else the nearest to `time_s`.
    fn frame(&self) -> anyhow::Result<usize> {
        let of_time = self.time_s.map(frame_of).transpose()?;
        let Some(frame) = self.frame else {
            return of_time.ok_or_else(|| anyhow!("it says neither time_s nor frame"));
        };
        ensure!(frame >= 0.0 && frame.fract() == 0.0, "frame {frame} is no whole number from 0 on");
        let frame = (frame as usize).min(LAST_FRAME);
        if let (Some(of_time), Some(time_s)) = (of_time, self.time_s) {
            ensure!(
                of_time == frame,
                "frame {frame} is at {:.3} s, and time_s says {time_s}; leave one of the two columns out",
                frames_to_s(frame)
            );
        }
        Ok(frame)
    }
}

/// Returns the frame nearest to a time.
///
/// # Errors
/// A time before the track, or that is no number.
pub fn frame_of(time_s: f64) -> anyhow::Result<usize> {
    ensure!(time_s.is_finite() && time_s >= 0.0, "{time_s} s is no time in a track; begin at 0");
    Ok((s_to_frames(time_s).round() as usize).min(LAST_FRAME))
}

/// Adds what the channels of a frame ask for; NaN asks for nothing.
fn ask(
    frame: usize,
    channels: &[f64; MOTION_DIM],
    asked: &mut FrameConstraints,
) -> anyhow::Result<()> {
    let first = Channel::Quaternion.range().start;
    let quaternion: [f64; N_QUATERNION] = std::array::from_fn(|i| channels[first + i]);
    match quaternion.iter().filter(|x| x.is_nan()).count() {
        0 => asked.push((frame, WantedValue::Orientation(quaternion))),
        N_QUATERNION => {}
        n => bail!(
            "{} of the 4 numbers of a quaternion are given; give all or none",
            N_QUATERNION - n
        ),
    }
    for (channel, &value) in channels.iter().enumerate() {
        if !Channel::Quaternion.range().contains(&channel) && !value.is_nan() {
            asked.push((frame, WantedValue::Value { channel, value }));
        }
    }
    Ok(())
}

/// Returns what an array asks for, frame by frame: \[T, 3\] positions, \[T, 25\] all channels; NaN is free.
///
/// # Errors
/// One sentence for another shape, and for an orientation of which a part is given.
pub fn of_array(array: &NpyArray<f64>) -> anyhow::Result<FrameConstraints> {
    let width = match array.shape[..] {
        [_, width @ (N_AXES | MOTION_DIM)] => width,
        _ => bail!(
            "it has the shape {:?}; give [frames, {N_AXES}], positions in m, or [frames, {MOTION_DIM}], all channels, \
             with NaN for what is free",
            array.shape
        ),
    };
    let mut asked = Vec::new();
    for (frame, row) in array.values.chunks_exact(width).enumerate() {
        let mut channels = [f64::NAN; MOTION_DIM];
        let first = if width == N_AXES { Channel::Position.range().start } else { 0 };
        channels[first..first + width].copy_from_slice(row);
        ask(frame, &channels, &mut asked).map_err(|e| anyhow!("frame {frame}: {e}"))?;
    }
    ensure!(!asked.is_empty(), "all its numbers are NaN, so that nothing is asked for");
    Ok(asked)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn value(frame: usize, channel: usize, value: f64) -> (usize, WantedValue) {
        (frame, WantedValue::Value { channel, value })
    }

    #[test]
    fn way_points_are_read_by_time_or_by_frame() {
        let text = "\u{feff}time_s, x, y ,z\r\n0,0.5,,-1\r\n\r\n2.51,1.0,0.9,nan\r\n";
        let expected = [value(0, 0, 0.5), value(0, 2, -1.0), value(75, 0, 1.0), value(75, 1, 0.9)];
        assert_eq!(of_csv(text).expect("way points"), expected);
        let text = "frame,position_y,heading_deg,style_0\n7,0.25,90,\n3,,,0.5\n";
        let expected = [
            (7, WantedValue::Orientation(facing(std::f64::consts::FRAC_PI_2))),
            value(7, 1, 0.25),
            value(3, 17, 0.5),
        ];
        assert_eq!(of_csv(text).expect("way points"), expected);
        let text = "frame,time_s,qw,qx,qy,qz\n30,1.0,1,0,0,0\n";
        let expected = [(30, WantedValue::Orientation([1.0, 0.0, 0.0, 0.0]))];
        assert_eq!(of_csv(text).expect("way points"), expected);
    }

    #[test]
    fn arrays_are_read_frame_by_frame() {
        let array = |shape: &[usize], values: Vec<f64>| NpyArray { shape: shape.to_vec(), values };
        let path = array(&[3, 3], vec![1., 2., 3., f64::NAN, f64::NAN, f64::NAN, 4., f64::NAN, 6.]);
        let expected = [
            value(0, 0, 1.0),
            value(0, 1, 2.0),
            value(0, 2, 3.0),
            value(2, 0, 4.0),
            value(2, 2, 6.0),
        ];
        assert_eq!(of_array(&path).expect("a path"), expected);
        let mut motion = vec![f64::NAN; 50];
        (motion[25 + 9], motion[25 + 16]) = (1.0, 0.75);
        motion[25 + 10..25 + 13].fill(0.0);
        let expected = [(1, WantedValue::Orientation([1.0, 0.0, 0.0, 0.0])), value(1, 16, 0.75)];
        assert_eq!(of_array(&array(&[2, 25], motion.clone())).expect("a motion"), expected);

        let said = |array: NpyArray<f64>| of_array(&array).expect_err("a mistake").to_string();
        assert_eq!(
            said(array(&[4, 2], vec![0.0; 8])),
            "it has the shape [4, 2]; give [frames, 3], positions in m, or [frames, 25], all channels, with NaN for \
             what is free"
        );
        assert_eq!(
            said(array(&[2, 3], vec![f64::NAN; 6])),
            "all its numbers are NaN, so that nothing is asked for"
        );
        motion[25 + 9] = f64::NAN;
        assert_eq!(
            said(array(&[2, 25], motion)),
            "frame 1: 3 of the 4 numbers of a quaternion are given; give all or none"
        );
    }

    #[test]
    fn mistakes_are_named() {
        let said = |text: &str| of_csv(text).expect_err("a mistake").to_string();
        assert_eq!(said(""), "it has no lines; begin with names of columns");
        assert!(
            said("time_s,speed\n0,1")
                .starts_with("there is no column \"speed\"; give time_s or frame, and x, ")
        );
        assert_eq!(said("x,y\n0,1"), "no column says when: name one time_s or frame");
        assert_eq!(
            said("time_s,x,position_x\n0,1,1"),
            "the column position_x is named twice; keep one of the two"
        );
        assert_eq!(
            said("time_s,x\n0,1\n1"),
            "line 3 has 1 values where the first line names 2 columns"
        );
        assert_eq!(said("time_s,x\n0,left"), "line 2: x reads \"left\", which is no number");
        assert_eq!(said("time_s,x\n-1,2"), "line 2: -1 s is no time in a track; begin at 0");
        assert_eq!(said("time_s,x\n,2"), "line 2: NaN s is no time in a track; begin at 0");
        assert_eq!(said("frame,x\n1.5,2"), "line 2: frame 1.5 is no whole number from 0 on");
        assert_eq!(said("frame,x\n,2"), "line 2: frame NaN is no whole number from 0 on");
        assert_eq!(
            said("frame,time_s,x\n30,2.0,1"),
            "line 2: frame 30 is at 1.000 s, and time_s says 2; leave one of the two columns out"
        );
        assert_eq!(
            said("frame,qw,qx,qy,qz\n3,1,0,,0"),
            "line 2: 3 of the 4 numbers of a quaternion are given; give all or none"
        );
        assert_eq!(
            said("frame,heading_deg,qw,qx,qy,qz\n3,0,1,0,0,0"),
            "line 2: an orientation is given twice, as quaternion and heading_deg"
        );
        assert_eq!(
            said("frame,x\n3,\n4,nan"),
            "no line asks for anything; give numbers in columns such as x, y and z"
        );
    }

    proptest! {
        #[test]
        fn no_text_breaks_the_reader(
            text in r"((frame|time_s|x|y|z|qw|heading_deg|-?[0-9]{1,3}(e[0-9]{1,3})?|nan|inf)[,\n ]|[ -~]){0,24}",
        ) {
            let _ = of_csv(&text);
        }
    }
}
