//! The layout of one motion frame: seven named channel groups side by side, 25 numbers in all.

use std::ops::Range;

/// One group of columns of a motion frame, in frame order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Channel {
    /// Root position in the world, m.
    Position,
    /// Forward difference of the position, m/s.
    Velocity,
    /// Forward difference of the velocity, m/s².
    Acceleration,
    /// Body-to-world rotation, Hamilton `(w, x, y, z)`, unit norm.
    Quaternion,
    /// World-frame angular velocity, rad/s.
    AngularVelocity,
    /// Bar phase in `[0, 1)`, 0 on the downbeat.
    Phase,
    /// The eight style channels of [`crate::motion::style`], each in `(-1, 1)`.
    Style,
}

/// Numbers in one motion frame: the end of the last group.
pub const MOTION_DIM: usize = Channel::Style.range().end;

/// The name of every column of a motion frame, in order.
pub const CHANNEL_NAMES: [&str; MOTION_DIM] = [
    "position_x",
    "position_y",
    "position_z",
    "velocity_x",
    "velocity_y",
    "velocity_z",
    "acceleration_x",
    "acceleration_y",
    "acceleration_z",
    "quaternion_w",
    "quaternion_x",
    "quaternion_y",
    "quaternion_z",
    "angular_velocity_x",
    "angular_velocity_y",
    "angular_velocity_z",
    "phase",
    "style_0",
    "style_1",
    "style_2",
    "style_3",
    "style_4",
    "style_5",
    "style_6",
    "style_7",
];

impl Channel {
    /// Every group, in frame order.
    pub const ALL: [Self; 7] = [
        Self::Position,
        Self::Velocity,
        Self::Acceleration,
        Self::Quaternion,
        Self::AngularVelocity,
        Self::Phase,
        Self::Style,
    ];

    /// The name of the group, with which its columns' names begin.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::Acceleration => "acceleration",
            Self::Quaternion => "quaternion",
            Self::AngularVelocity => "angular_velocity",
            Self::Phase => "phase",
            Self::Style => "style",
        }
    }

    /// Number of columns of the group.
    pub const fn width(self) -> usize {
        match self {
            Self::Position | Self::Velocity | Self::Acceleration | Self::AngularVelocity => 3,
            Self::Quaternion => 4,
            Self::Phase => 1,
            Self::Style => 8,
        }
    }

    /// The columns of the group within a motion frame.
    pub const fn range(self) -> Range<usize> {
        let mut start = 0;
        let mut i = 0;
        while i < self as usize {
            start += Self::ALL[i].width();
            i += 1;
        }
        start..start + self.width()
    }

    /// The unit of the group; `1` for numbers without one.
    pub const fn unit(self) -> &'static str {
        match self {
            Self::Position => "m",
            Self::Velocity => "m/s",
            Self::Acceleration => "m/s²",
            Self::AngularVelocity => "rad/s",
            Self::Phase => "bar",
            Self::Quaternion | Self::Style => "1",
        }
    }
}

/// The unit of column `i` of a motion frame, `None` when `i >= MOTION_DIM`.
pub fn channel_unit(i: usize) -> Option<&'static str> {
    Channel::ALL.into_iter().find(|c| c.range().contains(&i)).map(Channel::unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_tile_the_frame_at_the_documented_columns() {
        let ranges = Channel::ALL.map(Channel::range);
        assert_eq!(ranges, [0..3, 3..6, 6..9, 9..13, 13..16, 16..17, 17..25]);
        assert_eq!(MOTION_DIM, 25);
    }

    #[test]
    fn names_agree_with_the_groups() {
        for group in Channel::ALL {
            for i in group.range() {
                assert!(CHANNEL_NAMES[i].starts_with(group.name()), "{}", CHANNEL_NAMES[i]);
            }
        }
        assert_eq!(CHANNEL_NAMES[9], "quaternion_w");
        assert_eq!(CHANNEL_NAMES[24], "style_7");
    }

    #[test]
    fn units_follow_the_groups() {
        assert_eq!(channel_unit(2), Some("m"));
        assert_eq!(channel_unit(5), Some("m/s"));
        assert_eq!(channel_unit(8), Some("m/s²"));
        assert_eq!(channel_unit(12), Some("1"));
        assert_eq!(channel_unit(13), Some("rad/s"));
        assert_eq!(channel_unit(16), Some("bar"));
        assert_eq!(channel_unit(24), Some("1"));
        assert_eq!(channel_unit(25), None);
    }
}
