//! A second layout, the root alone, that keeps code from knowing the first one's indices.

use super::*;
use crate::motion::channels::BODY;

/// Position, velocity, quaternion and angular velocity: 13 columns.
pub(crate) const ROOT: Layout = Layout::new(&[
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
        name: "quaternion",
        unit: "1",
        role: ColumnRole::Turn,
        columns: &["quaternion_w", "quaternion_x", "quaternion_y", "quaternion_z"],
        derivative_of: None,
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
]);

#[test]
fn groups_tile_the_frame() {
    for layout in [ROOT, BODY] {
        let mut next = 0;
        for columns in layout.groups() {
            assert_eq!(columns.first, next);
            next = columns.range().end;
            for i in columns.range() {
                assert_eq!(layout.group_of(i), Some(columns));
                let name = layout.names().nth(i).expect("a name for each column");
                assert!(name.starts_with(columns.group.name), "{name}");
            }
        }
        assert_eq!((layout.width(), layout.names().count()), (next, next));
        assert_eq!(layout.group_of(next), None);
    }
    assert_eq!((ROOT.width(), BODY.width()), (13, 25));
}

#[test]
fn derivatives_are_found_by_name() {
    let ranges = |layout: Layout| -> Vec<[Range<usize>; 2]> {
        layout.derivatives().map(|pair| pair.map(|columns| columns.range())).collect()
    };
    assert_eq!(ranges(ROOT), [[0..3, 3..6], [6..10, 10..13]]);
    assert_eq!(ranges(BODY), [[0..3, 3..6], [3..6, 6..9], [9..13, 13..16]]);
    let named: usize = [ROOT, BODY]
        .into_iter()
        .flat_map(Layout::groups)
        .filter(|columns| columns.group.derivative_of.is_some())
        .count();
    assert_eq!(named, 5, "every derivative is one of a group that is there");
}

#[test]
fn a_body_is_found_by_roles() {
    let root = ROOT.body();
    assert_eq!((root.position.range(), root.orientation.range()), (0..3, 6..10));
    assert_eq!(root.acceleration, None);
    let derived: Vec<_> = root.derived().map(|columns| columns.range()).collect();
    assert_eq!(derived, [3..6, 10..13]);
    let body = BODY.body();
    assert_eq!((body.position.range(), body.orientation.range()), (0..3, 9..13));
    assert_eq!(body.acceleration.map(|columns| columns.range()), Some(6..9));
}

#[test]
fn a_mirror_flips_axial_vectors_the_other_way() {
    assert_eq!(ROOT.mirrored_in_x(), [0, 3, 8, 9, 11, 12]);
    assert_eq!(BODY.mirrored_in_x(), [0, 3, 6, 11, 12, 14, 15]);
}
