//! The tables of styles.

mod band;
mod club;
mod three;

pub use three::THREE;

use super::style::Style;

/// Styles in bars of four.
pub const FOUR: [Style; 17] = [
    club::HOUSE,
    club::TECHNO,
    club::TRANCE,
    club::DISCO,
    club::HIP_HOP,
    club::BREAKBEAT,
    club::DRUM_AND_BASS,
    club::HALF_TIME,
    club::DEMBOW,
    band::ROCK,
    band::BALLAD,
    band::FUNK,
    band::REGGAE,
    band::SWING,
    band::BOSSA,
    band::SALSA,
    band::MARCH,
];
