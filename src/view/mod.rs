//! Pages that play motion: one file of HTML, complete in itself.
//!
//! A page shows a body on its way through space, plays the music to it, and draws channels over time.
//! It asks nothing of any network, works from a folder without a server, and holds its numbers as
//! they are: 32-bit floats. The scripts are `motion.js` (numbers), `stage.js` and `body.js` (space),
//! `charts.js` (time), `page.js` (clock and controls), and `group.js` on pages with several bodies.

mod page;

use ndarray::{Array2, ArrayView3};

pub use page::page;

/// The content of a page.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// The title of the page.
    pub title: String,
    /// Motions to choose from, the first of which is shown at first.
    pub samples: Vec<ViewSample>,
    /// Beats in seconds on the clock of motion and audio; what is not finite is left out.
    pub beats_s: Vec<f64>,
    pub audio: Option<Audio>,
}

/// A motion and what is known of it.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSample {
    pub name: String,
    /// `[T, 25]` at [`crate::units::FPS`]; what is not finite is a gap. Of a group the first dancer's.
    pub frames: Array2<f32>,
    /// The further dancers of a group, `[T, 25]` each; none of a soloist.
    pub further_dancers: Vec<Array2<f32>>,
    /// Names and values, in the order in which they are listed.
    pub facts: Vec<(String, String)>,
}

impl ViewSample {
    /// Returns a sample of a group, `[N, T, 25]`; one without dancers has no frames.
    pub fn of_group(name: String, group: ArrayView3<f32>, facts: Vec<(String, String)>) -> Self {
        let mut dancers = group.outer_iter().map(|dancer| dancer.to_owned());
        let frames = dancers.next().unwrap_or_else(|| Array2::zeros((0, group.dim().2)));
        Self { name, frames, further_dancers: dancers.collect(), facts }
    }
}

/// An audio file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Audio {
    /// What [`mime_of`] says of the file's extension.
    pub mime: String,
    pub bytes: Vec<u8>,
}

/// Returns the media type of an audio file by its extension, in any case; a general one for others,
/// of which browsers look at the bytes.
pub fn mime_of(extension: &str) -> &'static str {
    match extension.to_ascii_lowercase().as_str() {
        "mp3" | "mpga" => "audio/mpeg",
        "wav" | "wave" => "audio/wav",
        "flac" => "audio/flac",
        "ogg" | "oga" | "opus" => "audio/ogg",
        "m4a" | "m4b" | "mp4" => "audio/mp4",
        "aac" => "audio/aac",
        "aif" | "aifc" | "aiff" => "audio/aiff",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn media_types_follow_the_extension() {
        let found = ["mp3", "WAV", "opus", "m4a", "txt", ""].map(mime_of);
        let general = "application/octet-stream";
        assert_eq!(found, ["audio/mpeg", "audio/wav", "audio/ogg", "audio/mp4", general, general]);
    }
}
