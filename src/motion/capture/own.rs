//! Takes that this program wrote: one joint, the root, at 100 units to the metre.
//!
//! They are motion already. What captures need (a low-pass, a floor, a unit) would only change them.

use crate::motion::bvh::{Bvh, JointChannel};
use crate::motion::exchange::{END_SITE_CM, ROOT_NAME};

/// Metres of a unit that this program writes.
pub const OWN_UNIT_M: f64 = 0.01;

/// Returns whether a take is one of [`crate::motion::exchange::write_bvh`].
pub fn is_own(bvh: &Bvh) -> bool {
    use JointChannel::{Position, Rotation};
    let [root, end] = bvh.joints() else { return false };
    root.name == ROOT_NAME
        && root.offset == [0.0; 3]
        && root.channels
            == [Position(0), Position(1), Position(2), Rotation(2), Rotation(0), Rotation(1)]
        && end.channels.is_empty()
        && end.offset == [0.0, END_SITE_CM, 0.0]
}
