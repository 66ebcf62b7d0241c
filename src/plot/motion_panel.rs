//! The panels of a plot of motion.

use std::str::FromStr;

use super::{PlotError, names_of, panel_named};
use crate::motion::Channel;

/// A panel of a plot of motion: one quantity over time, or the path from above.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum MotionPanel {
    Position,
    Velocity,
    Quaternion,
    Phase,
    QuaternionNorm,
    Jerk,
    Acceleration,
    AngularVelocity,
    Path,
}

impl MotionPanel {
    /// Every panel, in the order in which messages list them.
    pub const ALL: [Self; 9] = [
        Self::Position,
        Self::Velocity,
        Self::Quaternion,
        Self::Phase,
        Self::QuaternionNorm,
        Self::Jerk,
        Self::Acceleration,
        Self::AngularVelocity,
        Self::Path,
    ];

    /// The panels that are drawn unless others are asked for: those of the reference's
    /// `visualize_motion` \[14.2\], from the left and the top.
    pub const USUAL: [Self; 6] = [
        Self::Position,
        Self::Velocity,
        Self::Quaternion,
        Self::Phase,
        Self::QuaternionNorm,
        Self::Jerk,
    ];

    /// Returns the panel's name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Position => "position",
            Self::Velocity => "velocity",
            Self::Quaternion => "quaternion",
            Self::Phase => "phase",
            Self::QuaternionNorm => "quaternion_norm",
            Self::Jerk => "jerk",
            Self::Acceleration => "acceleration",
            Self::AngularVelocity => "angular_velocity",
            Self::Path => "path",
        }
    }

    /// Returns the names of every panel, as messages list them.
    pub(super) fn known() -> String {
        names_of(&Self::ALL, Self::name)
    }

    pub(super) fn heading(self) -> &'static str {
        match self {
            Self::Position => "Position",
            Self::Velocity => "Velocity",
            Self::Quaternion => "Quaternion",
            Self::Phase => "Phase",
            Self::QuaternionNorm => "Quaternion norm",
            Self::Jerk => "Jerk",
            Self::Acceleration => "Acceleration",
            Self::AngularVelocity => "Angular velocity",
            Self::Path => "Path",
        }
    }

    /// Returns what the values mean, shown where it has room.
    pub(super) fn meaning(self) -> &'static str {
        match self {
            Self::Position => "y is up",
            Self::Velocity | Self::Acceleration | Self::AngularVelocity => "axes of the world",
            Self::Quaternion => "from the body to the world",
            Self::Phase => "0 on the downbeat",
            Self::QuaternionNorm => "1 is a rotation",
            Self::Jerk => "change of the acceleration",
            Self::Path => "from above",
        }
    }

    /// Returns the unit of the vertical axis; empty without one.
    pub(super) fn unit(self) -> &'static str {
        let unit_of = |channel: Channel| match channel.unit() {
            "1" => "",
            unit => unit,
        };
        match self {
            Self::Position | Self::Path => unit_of(Channel::Position),
            Self::Velocity => unit_of(Channel::Velocity),
            Self::Quaternion | Self::QuaternionNorm => unit_of(Channel::Quaternion),
            Self::Phase => unit_of(Channel::Phase),
            Self::Jerk => "m/s³",
            Self::Acceleration => unit_of(Channel::Acceleration),
            Self::AngularVelocity => unit_of(Channel::AngularVelocity),
        }
    }
}

impl FromStr for MotionPanel {
    type Err = PlotError;

    fn from_str(name: &str) -> Result<Self, PlotError> {
        panel_named(&Self::ALL, Self::name, name)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for panel in MotionPanel::ALL {
            assert_eq!(panel.name().parse::<MotionPanel>().unwrap(), panel);
        }
        assert_eq!(
            "speed".parse::<MotionPanel>().unwrap_err().to_string(),
            "panel \"speed\" is unknown; the panels are position, velocity, quaternion, phase, \
             quaternion_norm, jerk, acceleration, angular_velocity, path"
        );
    }

    #[test]
    fn the_usual_panels_are_the_first_of_all() {
        assert_eq!(MotionPanel::ALL[..6], MotionPanel::USUAL);
        assert_eq!(MotionPanel::USUAL.map(MotionPanel::unit), ["m", "m/s", "", "bar", "", "m/s³"]);
    }
}
