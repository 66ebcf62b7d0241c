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

/// The colours of dancers, red, green and blue in sRGB: the first eight after Okabe and Ito, "Color Universal
/// Design", 2008, which colour-blind readers can tell apart, and the same darker.
pub const DANCER_COLORS: [[u8; 3]; MAX_DANCERS] = [
    [0x00, 0x72, 0xb2],
    [0xe6, 0x9f, 0x00],
    [0x00, 0x9e, 0x73],
    [0xcc, 0x79, 0xa7],
    [0xd5, 0x5e, 0x00],
    [0x56, 0xb4, 0xe9],
    [0xb3, 0xa1, 0x00],
    [0x8f, 0x6b, 0xb8],
    [0x00, 0x49, 0x6f],
    [0x94, 0x66, 0x00],
    [0x00, 0x65, 0x49],
    [0x84, 0x50, 0x6c],
    [0x89, 0x3c, 0x00],
    [0x37, 0x72, 0x95],
    [0x73, 0x67, 0x00],
    [0x5b, 0x44, 0x76],
];
