//! The layout of motion frames as a value: which columns a frame has, and what each group of them is.
//!
//! Code that treats columns by what they are (scaling, losses, blending, mirroring, checks) takes a [`Layout`] and asks
//! it for the columns; [`BODY`](super::channels::BODY) is the layout of this program's motion.

use std::ops::Range;

/// What a group of columns is: it decides how they are scaled, blended, turned and mirrored.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum ColumnRole {
    /// A point of the world, three columns: it moves and turns with the placement of its motion.
    Place,
    /// A vector in world axes, three columns: it turns and does not move.
    Vector,
    /// A rotation, body to world, four columns: a quaternion `(w, x, y, z)`, whose two signs mean the same.
    Turn,
    /// A place in the bar, one column, in bars: 1 is 0 of the next bar.
    Phase,
    /// Numbers that space and time leave alone, any number of columns.
    Free,
}

impl ColumnRole {
    /// Returns how many columns a group of the role has; none where any number will do.
    const fn width(self) -> Option<usize> {
        match self {
            Self::Place | Self::Vector => Some(3),
            Self::Turn => Some(4),
            Self::Phase => Some(1),
            Self::Free => None,
        }
    }
}

/// Lowest and highest allowed value of a group, in its unit; the presets are those of
/// [`ChannelLimits`](super::trajectory::ChannelLimits).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupLimits {
    pub wide: (f32, f32),
    pub reference: (f32, f32),
}

impl GroupLimits {
    /// Any finite value.
    pub const NONE: Self = Self::both((f32::MIN, f32::MAX));

    /// The same bounds in both presets.
    pub const fn both(bounds: (f32, f32)) -> Self {
        Self { wide: bounds, reference: bounds }
    }
}

/// A group of neighbouring columns that are one quantity.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColumnGroup {
    pub name: &'static str,
    /// `1` for numbers without a unit.
    pub unit: &'static str,
    pub role: ColumnRole,
    /// Names of the columns, each of which begins with the group's.
    pub columns: &'static [&'static str],
    /// Name of the group of which this one is the derivative by time.
    pub derivative_of: Option<&'static str>,
    pub limits: GroupLimits,
}

/// A group and where it stands in a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Columns {
    pub group: &'static ColumnGroup,
    pub first: usize,
}

impl Columns {
    /// Returns the columns of the group within a frame.
    pub const fn range(&self) -> Range<usize> {
        self.first..self.first + self.group.columns.len()
    }

    /// Returns the number of columns.
    pub const fn width(&self) -> usize {
        self.group.columns.len()
    }
}

/// The groups of a rigid body; a layout has at least the first two.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyColumns {
    pub position: Columns,
    pub orientation: Columns,
    pub velocity: Option<Columns>,
    pub acceleration: Option<Columns>,
    pub angular_velocity: Option<Columns>,
}

impl BodyColumns {
    /// Returns every group that follows from position and orientation.
    pub fn derived(&self) -> impl Iterator<Item = Columns> + use<> {
        [self.velocity, self.acceleration, self.angular_velocity].into_iter().flatten()
    }
}

/// Groups of columns side by side.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Layout {
    groups: &'static [ColumnGroup],
}

impl Layout {
    /// Takes groups in the order of a frame.
    ///
    /// # Panics
    /// When a group has another number of columns than its role needs, or none is a place or none a turn. Of constants
    /// the compiler says so.
    pub const fn new(groups: &'static [ColumnGroup]) -> Self {
        let (mut has_place, mut has_turn, mut i) = (false, false, 0);
        while i < groups.len() {
            if let Some(width) = groups[i].role.width() {
                assert!(groups[i].columns.len() == width, "a group has the columns of its role");
            }
            has_place |= matches!(groups[i].role, ColumnRole::Place);
            has_turn |= matches!(groups[i].role, ColumnRole::Turn);
            i += 1;
        }
        assert!(has_place && has_turn, "a layout has a place and a turn");
        Self { groups }
    }

    /// Returns the number of columns.
    pub const fn width(&self) -> usize {
        self.first(self.groups.len())
    }

    /// Returns the first column of group `i`; of the one after the last, the number of columns.
    const fn first(&self, i: usize) -> usize {
        let (mut first, mut k) = (0, 0);
        while k < i {
            first += self.groups[k].columns.len();
            k += 1;
        }
        first
    }

    /// Returns group `i`, in frame order.
    ///
    /// # Panics
    /// When there are fewer groups.
    pub const fn group(&self, i: usize) -> Columns {
        Columns { group: &self.groups[i], first: self.first(i) }
    }

    /// Returns every group, in frame order.
    pub fn groups(self) -> impl Iterator<Item = Columns> {
        (0..self.groups.len()).map(move |i| self.group(i))
    }

    /// Returns the groups of a role, in frame order.
    pub fn with_role(self, role: ColumnRole) -> impl Iterator<Item = Columns> {
        self.groups().filter(move |columns| columns.group.role == role)
    }

    /// Returns the groups that are three numbers in world axes, places and vectors, in frame order.
    pub fn spatial(self) -> impl Iterator<Item = Columns> {
        self.groups()
            .filter(|columns| matches!(columns.group.role, ColumnRole::Place | ColumnRole::Vector))
    }

    /// Returns the group of which a column is one; none past the last.
    pub fn group_of(self, column: usize) -> Option<Columns> {
        self.groups().find(|columns| columns.range().contains(&column))
    }

    /// Returns the names of all columns, in order.
    pub fn names(self) -> impl Iterator<Item = &'static str> {
        self.groups.iter().flat_map(|group| group.columns.iter().copied())
    }

    /// Returns the group that is the derivative of another by time.
    pub fn derivative(self, of: Columns) -> Option<Columns> {
        self.groups().find(|columns| columns.group.derivative_of == Some(of.group.name))
    }

    /// Returns the group that is the derivative of another, and that other one, in frame order.
    pub fn derivatives(self) -> impl Iterator<Item = [Columns; 2]> {
        self.groups().filter_map(move |derivative| {
            let name = derivative.group.derivative_of?;
            let source = self.groups().find(|columns| columns.group.name == name)?;
            Some([source, derivative])
        })
    }

    /// Returns whether a vector is axial: the derivative of a turn, which a mirror changes the other way.
    pub fn is_axial(self, columns: Columns) -> bool {
        let source = self
            .derivatives()
            .find_map(|[source, derivative]| (derivative == columns).then_some(source));
        source.is_some_and(|source| source.group.role == ColumnRole::Turn || self.is_axial(source))
    }

    /// Returns the columns that a mirror in the plane x = 0 gives the other sign.
    ///
    /// A reflection M = diag(-1, 1, 1) turns vectors into M v, rotations R into M R M, which is (w, x, -y, -z), and
    /// axial vectors into -M ω.
    pub fn mirrored_in_x(self) -> Vec<usize> {
        let flipped = |columns: Columns| -> &'static [usize] {
            match columns.group.role {
                ColumnRole::Place | ColumnRole::Vector if !self.is_axial(columns) => &[0],
                ColumnRole::Vector => &[1, 2],
                ColumnRole::Turn => &[2, 3],
                ColumnRole::Place | ColumnRole::Phase | ColumnRole::Free => &[],
            }
        };
        self.groups()
            .flat_map(|columns| flipped(columns).iter().map(move |i| columns.first + i))
            .collect()
    }

    /// Returns the first place and turn and what follows from them.
    pub fn body(self) -> BodyColumns {
        let first = |role| self.with_role(role).next().expect("invariant: every layout has one");
        let (position, orientation) = (first(ColumnRole::Place), first(ColumnRole::Turn));
        let velocity = self.derivative(position);
        BodyColumns {
            position,
            orientation,
            velocity,
            acceleration: velocity.and_then(|velocity| self.derivative(velocity)),
            angular_velocity: self.derivative(orientation),
        }
    }
}

#[cfg(test)]
pub(crate) mod tests;
