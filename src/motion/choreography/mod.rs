//! Choreography: dance constructed from captured motion for a song, in time with it.
//!
//! What the result owes to the music is known exactly, because it is made here:
//!
//! * the height carries `h(φ, a)`, low harmonics of the bar phase ([`floor`]);
//! * which primitive is danced when follows the rank of the song's activity ([`selection`]);
//! * steps begin and end on beats, and turns take whole phrases of whole bars.
//!
//! Everything else (how a body moves from accent to accent) is captured motion. A model that has
//! learnt from such dance must show this coupling, and with another song's features must not.

pub mod accent;
pub mod activity;
pub mod beat_grid;
pub mod floor;
pub mod group;
mod joining;
pub mod primitive;
pub mod selection;
#[cfg(test)]
mod tests;

use ndarray::{Array2, ArrayView2, s};
use thiserror::Error;

use super::channels::Channel;
use super::kinematics::{Poses, forward_differences, frames_of};
use super::phase::{Beats, bar_phase};
use super::placement::Placement;
use super::style::{BodyMotion, style_channels};
use crate::chance::Chance;
use crate::units::frames_to_s;
pub use activity::activity;
pub use beat_grid::{Beat, BeatGrid};
pub use floor::Turn;
pub use group::{
    Formation, GROUP_SIZES, GroupDance, GroupPhrase, GroupRules, Unison, choreograph_group,
    draw_group_size, group_phrase,
};
pub use primitive::{Primitive, PrimitiveError, Repertoire};
pub use selection::DanceStep;

/// Tempi that are danced to, beats per minute; the upper end is the beat tracker's own.
pub const TEMPI_BPM: std::ops::RangeInclusive<f64> = 20.0..=320.0;
/// Frames that two forward differences use up.
const DIFFERENCED_FRAMES: usize = 2;
/// Streams of chance: each choice has its own, so that none depends on how often another was made.
const STEPS_STREAM: u64 = 0;
const TURNS_STREAM: u64 = 1;

/// Why a song cannot be danced to.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SongError {
    /// No features.
    #[error("song has no frames of features; extract it again")]
    Empty,
    /// Fewer than two beats within the song.
    #[error(
        "song has {n_beats} beats within its {duration_s:.1} s, and a dance needs at least 2; write \
         its beats, one time in seconds per line, into a .beats.txt file beside it"
    )]
    NoBeats { n_beats: usize, duration_s: f64 },
    /// A tempo outside of those that are danced to.
    #[error(
        "song has {tempo_bpm:.1} beats/min, and {} to {} are danced to; correct its .beats.txt file",
        TEMPI_BPM.start(),
        TEMPI_BPM.end()
    )]
    Tempo { tempo_bpm: f64 },
}

/// The music that a dance is constructed to; T frames at 30 fps.
#[derive(Clone, Debug)]
pub struct Song<'a> {
    beats: &'a Beats,
    n_frames: usize,
    activity: Vec<f64>,
}

impl<'a> Song<'a> {
    /// Takes a song's beats, and its RMS and onset strength of every frame (`[T]`, any unit).
    ///
    /// # Errors
    /// [`SongError`].
    pub fn new(beats: &'a Beats, rms: &[f32], onset_strength: &[f32]) -> Result<Self, SongError> {
        let activity = activity(rms, onset_strength);
        let n_frames = activity.len();
        if n_frames == 0 {
            return Err(SongError::Empty);
        }
        let duration_s = frames_to_s(n_frames);
        let n_beats = beats.times_s().iter().filter(|&&t| t <= duration_s).count();
        if n_beats < 2 {
            return Err(SongError::NoBeats { n_beats, duration_s });
        }
        let tempo_bpm = beats.tempo_bpm();
        if !TEMPI_BPM.contains(&tempo_bpm) {
            return Err(SongError::Tempo { tempo_bpm });
        }
        Ok(Self { beats, n_frames, activity })
    }

    /// Returns the activity of every frame, in (0, 1), shape `[T]`.
    pub fn activity(&self) -> &[f64] {
        &self.activity
    }

    /// Returns the song's beats from the last downbeat at or before its begin to the first at or after
    /// its end.
    pub fn grid(&self) -> BeatGrid {
        BeatGrid::over(self.beats, frames_to_s(self.n_frames + DIFFERENCED_FRAMES))
    }
}

/// A dance to a whole song.
#[derive(Clone, Debug, PartialEq)]
pub struct Dance {
    /// The 25 channels of every frame, shape `[T, 25]`.
    pub frames: Array2<f32>,
    /// The steps in order of time.
    pub steps: Vec<DanceStep>,
    /// The turns in order of time.
    pub turns: Vec<Turn>,
}

/// Choreographs a song; the same song, repertoire and seed give the same dance.
///
/// Poses are made for the song and two frames more, and every other channel follows from them by
/// forward differences ([`frames_of`]), so every frame obeys the identities. An empty repertoire gives
/// rests: a body that only rises and falls.
pub fn choreograph(song: &Song<'_>, repertoire: &Repertoire, seed: u64) -> Dance {
    let n_poses = song.n_frames + DIFFERENCED_FRAMES;
    let grid = song.grid();
    let mut chance = Chance::new(seed, STEPS_STREAM);
    let (steps, phrases) = selection::steps(&grid, &song.activity, repertoire, &mut chance);
    let mut poses = joining::path(&steps, repertoire, n_poses);
    let turns = floor::wander(&mut poses, &phrases, &mut Chance::new(seed, TURNS_STREAM));

    let times_s: Vec<f64> = (0..n_poses).map(frames_to_s).collect();
    let phase = bar_phase(&times_s, song.beats);
    let beats_per_bar = song.beats.beats_per_bar();
    let bar_s = grid.interval_s() * f64::from(beats_per_bar);
    for (t, p) in poses.position_m.iter_mut().enumerate() {
        let activity = song.activity[t.min(song.n_frames - 1)];
        let rise_m = floor::rise_m(phase[t], activity, bar_s, beats_per_bar);
        p[1] = floor::ROOT_HEIGHT_M + floor::KEPT_HEIGHT * p[1] + rise_m;
    }
    Dance { frames: channels(poses, &phase, song.n_frames), steps, turns }
}

/// Returns all channels of the first `n_frames` frames, shape `[n_frames, 25]`.
fn channels(poses: Poses, phase: &[f64], n_frames: usize) -> Array2<f32> {
    let velocity = forward_differences(&poses.position_m);
    let acceleration = forward_differences(&velocity);
    let style = style_channels(&BodyMotion {
        position_m: &poses.position_m[..n_frames],
        velocity_m_s: &velocity[..n_frames],
        acceleration_m_s2: &acceleration[..n_frames],
        orientation: &poses.orientation[..n_frames],
        nodes_m: &[],
    });
    let mut frames = frames_of(&poses, n_frames);
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        row[Channel::Phase.range().start] = phase[t] as f32;
        for (i, &x) in Channel::Style.range().zip(&style[t]) {
            row[i] = x as f32;
        }
    }
    frames
}

/// Returns how many phrases of `phrase_frames`, `hop_frames` apart, fit into a song of `n_frames`.
pub fn n_phrases(n_frames: usize, phrase_frames: usize, hop_frames: usize) -> usize {
    n_frames.checked_sub(phrase_frames).map_or(0, |rest| rest / hop_frames.max(1) + 1)
}

/// Returns `n` frames from `first` on, over the origin and facing +Z; shape `[n, 25]`.
///
/// # Panics
/// When the dance ends before.
pub fn phrase(dance: ArrayView2<'_, f32>, first: usize, n: usize) -> Array2<f32> {
    let mut frames = dance.slice(s![first..first + n, ..]).to_owned();
    if let Some(placement) = Placement::of_first(frames.view()) {
        placement.remove(&mut frames);
    }
    frames
}
