//! The layout of this program's motion: seven named groups side by side, 25 columns in all.

use std::ops::Range;

use super::layout::{ColumnGroup, ColumnRole, Columns, GroupLimits, Layout};

/// The layout of a motion frame.
pub const BODY: Layout = Layout::new(&[
    ColumnGroup {
        name: "position",
        unit: "m",
        role: ColumnRole::Place,
        columns: &["position_x", "position_y", "position_z"],
        derivative_of: None,
        limits: GroupLimits::both((-100.0, 100.0)),
    },
    ColumnGroup {
        name: "velocity",
        unit: "m/s",
        role: ColumnRole::Vector,
        columns: &["velocity_x", "velocity_y", "velocity_z"],
        derivative_of: Some("position"),
        limits: GroupLimits::both((-50.0, 50.0)),
    },
    ColumnGroup {
        name: "acceleration",
        unit: "m/s²",
        role: ColumnRole::Vector,
        columns: &["acceleration_x", "acceleration_y", "acceleration_z"],
        derivative_of: Some("velocity"),
        limits: GroupLimits::both((-100.0, 100.0)),
    },
    ColumnGroup {
        name: "quaternion",
        unit: "1",
        role: ColumnRole::Turn,
        columns: &["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"],
        derivative_of: None,
        // Its norm bounds it.
        limits: GroupLimits::NONE,
    },
    ColumnGroup {
        name: "angular_velocity",
        unit: "rad/s",
        role: ColumnRole::Vector,
        columns: &["angular_velocity_x", "angular_velocity_y", "angular_velocity_z"],
        derivative_of: Some("quaternion"),
        limits: GroupLimits { wide: (-20.0, 20.0), reference: (-10.0, 10.0) },
    },
    ColumnGroup {
        name: "phase",
        unit: "bar",
        role: ColumnRole::Phase,
        columns: &["phase"],
        derivative_of: None,
        limits: GroupLimits::both((0.0, 1.0)),
    },
    ColumnGroup {
        name: "style",
        unit: "1",
        role: ColumnRole::Free,
        columns: &[
            "style_0", "style_1", "style_2", "style_3", "style_4", "style_5", "style_6", "style_7",
        ],
        derivative_of: None,
        limits: GroupLimits::NONE,
    },
]);

/// Numbers in one motion frame.
pub const MOTION_DIM: usize = BODY.width();

/// The name of every column of a motion frame, in order.
pub const CHANNEL_NAMES: [&str; MOTION_DIM] = {
    let mut names = [""; MOTION_DIM];
    let mut group = 0;
    while group < Channel::ALL.len() {
        let columns = BODY.group(group);
        let mut i = 0;
        while i < columns.width() {
            names[columns.first + i] = columns.group.columns[i];
            i += 1;
        }
        group += 1;
    }
    names
};

/// A group of [`BODY`] by its name, in frame order, for code that is about a dancing body.
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

    /// The group of the layout.
    pub const fn columns(self) -> Columns {
        BODY.group(self as usize)
    }

    /// The name of the group, with which its columns' names begin.
    pub const fn name(self) -> &'static str {
        self.columns().group.name
    }

    /// Number of columns of the group.
    pub const fn width(self) -> usize {
        self.columns().width()
    }

    /// The columns of the group within a motion frame.
    pub const fn range(self) -> Range<usize> {
        self.columns().range()
    }

    /// The unit of the group; `1` for numbers without one.
    pub const fn unit(self) -> &'static str {
        self.columns().group.unit
    }
}

/// The unit of column `i` of a motion frame, `None` when `i >= MOTION_DIM`.
pub fn channel_unit(i: usize) -> Option<&'static str> {
    BODY.group_of(i).map(|columns| columns.group.unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn groups_tile_the_frame_at_the_documented_columns() {
        let ranges = Channel::ALL.map(Channel::range);
        assert_eq!(ranges, [0..3, 3..6, 6..9, 9..13, 13..16, 16..17, 17..25]);
        assert_eq!(MOTION_DIM, 25);
        assert_eq!(BODY.groups().count(), Channel::ALL.len());
    }

    #[test]
    fn names_agree_with_the_groups() {
        let names = [
            "position",
            "velocity",
            "acceleration",
            "quaternion",
            "angular_velocity",
            "phase",
            "style",
        ];
        assert_eq!(Channel::ALL.map(Channel::name), names);
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
