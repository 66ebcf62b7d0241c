//! Music of our own: scores with known bars, and their sound.
//!
//! Data flow: [`compose()`] draws a [`Score`] from a seed, or [`abc`] reads one and [`arrange()`] gives it
//! accompaniment; [`synth::render`] plays it. Time is counted in beats; [`TempoMap`] alone knows seconds.
//!
//! Everything here is pure, and made of additions, multiplications and the functions of the crate `libm`, which
//! are the same on every machine: same seed, same bytes.

pub mod abc;
pub mod arrange;
pub mod compose;
mod drums;
pub mod harmony;
mod parts;
pub mod score;
#[cfg(feature = "soundfont")]
pub mod soundfont;
pub mod style;
mod styles;
pub mod synth;
pub mod tempo;
#[cfg(test)]
mod tests;
pub mod wav;

pub use arrange::arrange;
pub use compose::compose;
pub use score::{Beat, Note, Score, Section, SectionKind, Voice};
pub use tempo::TempoMap;

/// Raised when a seed gives another score, or a score another sound.
pub const VERSION: u32 = 1;
