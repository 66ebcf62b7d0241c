//! Groups of dancers: several bodies on one music, `[N, T, 25]`, in one frame of reference.
//!
//! `assignment` finds who is who in two pieces that overlap, `stitch` joins the pieces, `separation` keeps
//! bodies apart.

pub mod assignment;
pub mod separation;
pub mod stitch;

pub use assignment::assign;
pub use separation::{SeparationError, distance_m, separate};
pub use stitch::{blend, match_dancers, stitch};

/// Most dancers of a group.
pub const MAX_DANCERS: usize = 16;

/// Radius of a body on the floor, m: two whose centres are nearer than twice this touch.
pub const RADIUS_M: f64 = 0.35;
