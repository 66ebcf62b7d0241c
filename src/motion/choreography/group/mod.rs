//! Groups: several dancers to one song, whose formation and unison are known at every moment.
//!
//! * Dancers stand in [`Formation`]s. These change on downbeats; everybody goes straight to the place that
//!   the assignment of least squared distance gives (`plan`).
//! * In every span the steps belong together in one known way, their [`Unison`] (`unison`).
//! * A dancer stays about its place: of its own wandering the quick part is kept (`voice`), within a
//!   leeway that keeps any two bodies apart at every moment (`floor_plan`).
//! * Everybody rises and falls with the bar as a soloist does, and all channels follow from the poses.

mod floor_plan;
mod formation;
mod plan;
#[cfg(test)]
mod tests;
mod unison;
mod voice;

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use ndarray::{Array3, ArrayView2, Axis, s};

use super::primitive::UP;
use super::{DIFFERENCED_FRAMES, Repertoire, STEPS_STREAM, Song, channels, floor, selection};
use crate::chance::Chance;
use crate::motion::channels::{Channel, MOTION_DIM};
use crate::motion::group::MAX_DANCERS;
use crate::motion::kinematics::Poses;
use crate::motion::phase::bar_phase;
use crate::motion::placement::Placement;
use crate::motion::quaternion::{
    Quaternion, from_axis_angle, make_sign_continuous, mul, nearer, rotate, slerp_as_signed,
};
use crate::units::frames_to_s;
pub use formation::{Formation, MIN_SPACING_M, side_by_side};
pub use plan::{GroupSpan, MIN_SPAN_S};
pub use unison::{Part, Timing, Unison};

use voice::Voice;

/// Sizes of a group.
pub const GROUP_SIZES: RangeInclusive<usize> = 1..=MAX_DANCERS;
/// Half the time in which a dancer goes over from one part to the next, about a border of spans, s.
const HALF_CHANGE_S: f64 = 0.5;
/// Streams of chance: of the plan, of the number of dancers, and of the first voice but one.
const PLAN_STREAM: u64 = 2;
const SIZE_STREAM: u64 = 3;
const VOICES_STREAM: u64 = 16;

/// Returns a number of dancers of a range, each equally likely; the same seed gives the same.
pub fn draw_group_size(sizes: RangeInclusive<usize>, seed: u64) -> usize {
    let n = (sizes.end() + 1).saturating_sub(*sizes.start());
    sizes.start() + Chance::new(seed, SIZE_STREAM).below(n)
}

/// What is asked of a group's dance beside the song.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GroupRules {
    /// Number of dancers, 1 to 16.
    pub n_dancers: usize,
    /// Least time between changes of formation and unison, s; 8 s at least, and less only at a song's end.
    pub min_span_s: f64,
    /// Chooses another dance.
    pub seed: u64,
}

/// The dance of a group to a whole song.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupDance {
    /// The 25 channels of every dancer and frame, shape `[N, T, 25]`; the audience is at +Z.
    pub frames: Array3<f32>,
    /// Formations and kinds of unison in order of time, without a gap.
    pub spans: Vec<GroupSpan>,
}

/// A stretch of a group's dance.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupPhrase {
    /// Shape `[N, n, 25]`; the group's centre at the first frame is over the origin.
    pub frames: Array3<f32>,
    /// The formation of most frames, and its share of all, in (0, 1].
    pub formation: (Formation, f64),
    /// The unison of most frames, and its share of all, in (0, 1].
    pub unison: (Unison, f64),
}

/// Choreographs a song for a group; the same song, repertoire and rules give the same dance.
///
/// Dancer 0 has the steps that [`super::choreograph`] chooses with the same seed. Poses are made for the song
/// and two frames more, and every other channel follows from them. Any two dancers are at least
/// `2 ·` [`RADIUS_M`](crate::motion::group::RADIUS_M) apart on the floor at every frame.
///
/// # Panics
/// When the number of dancers is outside [`GROUP_SIZES`].
pub fn choreograph_group(
    song: &Song<'_>,
    repertoire: &Repertoire,
    rules: &GroupRules,
) -> GroupDance {
    let GroupRules { n_dancers, min_span_s, seed } = *rules;
    assert!(GROUP_SIZES.contains(&n_dancers), "{n_dancers} dancers");
    let n_poses = song.n_frames + DIFFERENCED_FRAMES;
    let grid = song.grid();
    let mut chance = Chance::new(seed, PLAN_STREAM);
    let spans = plan::spans(&grid, (n_dancers, song.n_frames), min_span_s, &mut chance);
    let mut voices: BTreeMap<usize, Voice> = BTreeMap::new();
    for part in spans.iter().flat_map(|span| &span.parts) {
        voices.entry(part.voice).or_insert_with(|| {
            let stream = match part.voice {
                0 => STEPS_STREAM,
                voice => VOICES_STREAM + voice as u64,
            };
            let mut chance = Chance::new(seed, stream);
            let (steps, _) = selection::steps(&grid, song.activity(), repertoire, &mut chance);
            Voice::new(&steps, repertoire, n_poses)
        });
    }

    let times_s: Vec<f64> = (0..n_poses).map(frames_to_s).collect();
    let phase = bar_phase(&times_s, song.beats);
    let beats_per_bar = song.beats.beats_per_bar();
    let bar_s = grid.interval_s() * f64::from(beats_per_bar);
    let rise_m = |t: usize| {
        let activity = song.activity[t.min(song.n_frames - 1)];
        floor::rise_m(phase[t], activity, bar_s, beats_per_bar)
    };
    let leeway_m = floor_plan::leeway_m(&spans, n_poses);
    let mut frames = Array3::zeros((n_dancers, song.n_frames, MOTION_DIM));
    for k in 0..n_dancers {
        let at_s = |span: &GroupSpan, t: f64| span.parts[k].voice_time_s(t, &grid, span.first_beat);
        let danced = |span: &GroupSpan, times_s: &[f64]| {
            let at_s: Vec<f64> = times_s.iter().map(|&t| at_s(span, t)).collect();
            mirrored_if(span.parts[k].is_mirrored, voices[&span.parts[k].voice].poses(&at_s))
        };
        let mut poses = in_turn(&spans, &times_s, danced);
        let mut i = 0;
        for (t, p) in poses.position_m.iter_mut().enumerate() {
            while i + 1 < spans.len() && times_s[t] >= spans[i + 1].start_s {
                i += 1;
            }
            let place = floor_plan::place(&spans, i, k, times_s[t]);
            let turn = from_axis_angle(UP, place.yaw_rad);
            let [x, z] = floor_plan::within_leeway([p[0], p[2]], leeway_m[t]);
            let [x, _, z] = rotate(turn, [x, 0.0, z]);
            let height_m = floor::ROOT_HEIGHT_M + floor::KEPT_HEIGHT * p[1] + rise_m(t);
            *p = [place.x_m + x, height_m, place.z_m + z];
            poses.orientation[t] = mul(turn, poses.orientation[t]);
        }
        make_sign_continuous(&mut poses.orientation);
        frames.index_axis_mut(Axis(0), k).assign(&channels(poses, &phase, song.n_frames));
    }
    GroupDance { frames, spans }
}

/// Returns poses and their mirror image in the plane x = 0: `(-x, y, z)`, and `(w, x, -y, -z)` of
/// orientations.
fn mirrored_if(is_mirrored: bool, mut poses: Poses) -> Poses {
    if is_mirrored {
        poses.position_m.iter_mut().for_each(|p| p[0] = -p[0]);
        let mirror = |[w, x, y, z]: Quaternion| [w, x, -y, -z];
        poses.orientation.iter_mut().for_each(|q| *q = mirror(*q));
    }
    poses
}

/// Returns what `danced` says of every span at its times, one going over into the next.
///
/// From 0.5 s before a border to 0.5 s after it, positions and orientations are `(1 - s) a + s b` and the slerp
/// at `s = 3u² - 2u³`.
fn in_turn(
    spans: &[GroupSpan],
    times_s: &[f64],
    danced: impl Fn(&GroupSpan, &[f64]) -> Poses,
) -> Poses {
    let mut poses = Poses::default();
    for (i, span) in spans.iter().enumerate() {
        let is_last = i + 1 == spans.len();
        let change_start_s = span.start_s - HALF_CHANGE_S;
        let first = if i == 0 { 0 } else { times_s.partition_point(|&t| t < change_start_s) };
        let end = times_s.partition_point(|&t| is_last || t < span.end_s + HALF_CHANGE_S);
        let mut before: Option<(Quaternion, Quaternion)> = None;
        let new = danced(span, &times_s[first..end]);
        for (j, t) in (first..end).enumerate() {
            let (p, q) = (new.position_m[j], new.orientation[j]);
            if t >= poses.len() {
                poses.position_m.push(p);
                poses.orientation.push(q);
                continue;
            }
            let u = ((times_s[t] - change_start_s) / (2.0 * HALF_CHANGE_S)).clamp(0.0, 1.0);
            let s = u * u * (3.0 - 2.0 * u);
            let old = poses.position_m[t];
            poses.position_m[t] = std::array::from_fn(|axis| old[axis] + s * (p[axis] - old[axis]));
            // Both turn meanwhile: the arc between them stays on the side on which it began.
            let (a, b) = match before {
                None => (poses.orientation[t], nearer(poses.orientation[t], q)),
                Some((a, b)) => (nearer(a, poses.orientation[t]), nearer(b, q)),
            };
            before = Some((a, b));
            poses.orientation[t] = slerp_as_signed(a, b, s);
        }
    }
    poses
}

impl GroupDance {
    /// Returns the formation and unison of a frame; on the way to a formation, its first half counts to
    /// the one before.
    pub fn kinds_at(&self, frame: usize) -> (Formation, Unison) {
        let i =
            self.spans.partition_point(|span| span.end_frame <= frame).min(self.spans.len() - 1);
        let here = &self.spans[i];
        let before = i.checked_sub(1).map(|before| &self.spans[before]);
        let is_there = here.arrived(frames_to_s(frame)) >= 0.5;
        let formation = before.filter(|_| !is_there).map_or(here.formation, |b| b.formation);
        (formation, here.unison)
    }
}

/// Returns the kind of most frames, and its share; of equal ones the first in their order.
fn most<K: Ord + Copy>(kinds: impl Iterator<Item = K>) -> Option<(K, f64)> {
    let mut counts: BTreeMap<K, usize> = BTreeMap::new();
    kinds.for_each(|kind| *counts.entry(kind).or_default() += 1);
    let n: usize = counts.values().sum();
    let most = counts.into_iter().rev().max_by_key(|&(_, n)| n);
    most.map(|(kind, count)| (kind, count as f64 / n as f64))
}

/// Returns `n` frames from `first` on, the centre of the group at the first frame over the origin; the
/// audience stays at +Z.
///
/// # Panics
/// When the dance ends before, or `n` is 0.
pub fn group_phrase(dance: &GroupDance, first: usize, n: usize) -> GroupPhrase {
    let mut frames = dance.frames.slice(s![.., first..first + n, ..]).to_owned();
    let x = Channel::Position.range().start;
    let mean = |i: usize| {
        let at = frames.slice(s![.., 0, i]);
        at.iter().map(|&x| f64::from(x)).sum::<f64>() / at.len() as f64
    };
    let centre = Placement { x_m: mean(x), z_m: mean(x + 2), yaw_rad: 0.0 };
    for mut dancer in frames.axis_iter_mut(Axis(0)) {
        let mut moved = dancer.to_owned();
        centre.remove(&mut moved);
        dancer.assign(&moved);
    }
    let kinds = || (first..first + n).map(|t| dance.kinds_at(t));
    let has_frames = "invariant: a phrase has frames";
    GroupPhrase {
        frames,
        formation: most(kinds().map(|kinds| kinds.0)).expect(has_frames),
        unison: most(kinds().map(|kinds| kinds.1)).expect(has_frames),
    }
}

/// Returns the least distance on the floor between two dancers at any frame, m; infinite for fewer than two.
/// Shape `[N, T, 25]`.
pub fn least_separation_m(frames: &Array3<f32>) -> f64 {
    let dancers: Vec<ArrayView2<'_, f32>> = frames.axis_iter(Axis(0)).collect();
    let x = Channel::Position.range().start;
    let distance = |t: usize, i: usize, j: usize| {
        let apart = |c: usize| f64::from(dancers[i][[t, c]]) - f64::from(dancers[j][[t, c]]);
        apart(x).hypot(apart(x + 2))
    };
    (0..frames.len_of(Axis(1)))
        .flat_map(|t| formation::pairs(dancers.len()).map(move |(i, j)| (t, i, j)))
        .map(|(t, i, j)| distance(t, i, j))
        .fold(f64::INFINITY, f64::min)
}
