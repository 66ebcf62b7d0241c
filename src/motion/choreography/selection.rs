//! Which primitive is danced when: energy follows the song's activity, ends fall on beats.

use std::ops::RangeInclusive;

use super::beat_grid::BeatGrid;
use super::primitive::{Primitive, Repertoire};
use crate::chance::Chance;
use crate::units::s_to_frames;

/// Slowest and fastest that a primitive is danced, as a multiple of its captured speed.
pub const RATES: RangeInclusive<f64> = 0.75..=1.33;
/// Highest speed of a primitive as it is danced, m/s.
const MAX_SPEED_M_S: f64 = 5.0;
/// Highest rate of turning of a primitive as it is danced, rad/s; the turns of the phrase come on top.
const MAX_TURN_RAD_S: f64 = 12.0;
/// Most beats that one primitive spans.
const MAX_STEP_BEATS: usize = 8;
/// Primitives of the nearest energy among which chance decides.
const N_NEAREST: usize = 5;
/// Primitives that are looked at for one step; of a larger repertoire, as many by chance.
const N_LOOKED_AT: usize = 256;

/// One step of a dance: a primitive between two beats, or a rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DanceStep {
    /// The beat on which it begins, an index into the grid.
    pub beat: usize,
    pub n_beats: usize,
    pub start_s: f64,
    pub end_s: f64,
    /// The primitive, an index into the repertoire; `None` where none fits the beats.
    pub primitive: Option<usize>,
    /// Speed as a multiple of the captured one.
    pub rate: f64,
}

impl DanceStep {
    /// Returns the length, s.
    pub fn duration_s(&self) -> f64 {
        self.end_s - self.start_s
    }
}

/// A choreographic phrase: the unit of turns.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DancePhrase {
    pub start_s: f64,
    pub end_s: f64,
}

/// Chooses the steps of a song, phrase by phrase; returns them with the phrases, gapless from the
/// first beat of the grid to its end.
///
/// A phrase is one short phrase of the grid or two, by chance. A step at beat b takes the n beats
/// and the primitive for which `|Q(E r²) - a|` is among the 5 smallest: `E r²` the primitive's
/// energy at the rate `r = duration / (t[b+n] - t[b])`, `Q` the quantile in the repertoire, `a` the
/// mean activity of the song there. The primitive of the step before is not taken again.
pub fn steps(
    grid: &BeatGrid,
    activity: &[f64],
    repertoire: &Repertoire,
    chance: &mut Chance,
) -> (Vec<DanceStep>, Vec<DancePhrase>) {
    let beats = grid.beats();
    let short = grid.short_phrase_beats();
    let chooser = Chooser { grid, activity, repertoire, fills: fills(grid, repertoire, 2 * short) };
    let (mut steps, mut phrases): (Vec<DanceStep>, Vec<DancePhrase>) = (Vec::new(), Vec::new());
    let mut start = 0;
    while start + 1 < beats.len() {
        let n_beats = if chance.below(2) == 0 { short } else { 2 * short };
        let end = (start + n_beats).min(beats.len() - 1);
        let mut beat = start;
        while beat < end {
            let before = steps.last().and_then(|step| step.primitive);
            let step = chooser.step(beat, end, before, chance);
            beat += step.n_beats;
            steps.push(step);
        }
        phrases.push(DancePhrase { start_s: beats[start].time_s, end_s: beats[end].time_s });
        start = end;
    }
    (steps, phrases)
}

/// Returns for every number of beats up to `longest` whether primitives can fill it at the usual tempo.
fn fills(grid: &BeatGrid, repertoire: &Repertoire, longest: usize) -> Vec<bool> {
    let fits_alone = |n: usize| {
        let duration_s = n as f64 * grid.interval_s();
        repertoire.primitives().iter().any(|p| fits(p, duration_s).is_some())
    };
    let alone: Vec<usize> = (1..=MAX_STEP_BEATS.min(longest)).filter(|&n| fits_alone(n)).collect();
    let mut fills = vec![false; longest + 1];
    fills[0] = true;
    for n in 1..=longest {
        fills[n] = alone.iter().any(|&step| step <= n && fills[n - step]);
    }
    fills
}

/// Returns the rate at which a primitive fills a time, if it may be danced so.
fn fits(primitive: &Primitive, duration_s: f64) -> Option<f64> {
    let rate = primitive.duration_s / duration_s;
    let is_allowed = RATES.contains(&rate)
        && primitive.top_speed_m_s * rate <= MAX_SPEED_M_S
        && primitive.top_turn_rad_s * rate <= MAX_TURN_RAD_S;
    is_allowed.then_some(rate)
}

struct Chooser<'a> {
    grid: &'a BeatGrid,
    activity: &'a [f64],
    repertoire: &'a Repertoire,
    /// Whether a number of beats can be filled with primitives, by that number.
    fills: Vec<bool>,
}

impl Chooser<'_> {
    fn step(
        &self,
        beat: usize,
        end: usize,
        before: Option<usize>,
        chance: &mut Chance,
    ) -> DanceStep {
        let n_primitives = self.repertoire.primitives().len();
        let some: Vec<usize> = if n_primitives <= N_LOOKED_AT {
            (0..n_primitives).collect()
        } else {
            let mut some: Vec<_> = (0..N_LOOKED_AT).map(|_| chance.below(n_primitives)).collect();
            some.sort_unstable();
            some.dedup();
            some
        };
        let mut found = self.candidates(beat, end, &some, before, true);
        if found.is_empty() {
            // What chance left out, then what leaves a remainder, then the same again.
            let all: Vec<usize> = (0..n_primitives).collect();
            for (before, fills) in [(before, true), (before, false), (None, false)] {
                found = self.candidates(beat, end, &all, before, fills);
                if !found.is_empty() {
                    break;
                }
            }
        }
        found.sort_by(|a, b| a.0.total_cmp(&b.0).then(key(&a.1).cmp(&key(&b.1))));
        found.truncate(N_NEAREST);
        let rest = DanceStep { primitive: None, rate: 1.0, ..self.span(beat, 1) };
        if found.is_empty() { rest } else { found[chance.below(found.len())].1 }
    }

    /// Returns every way to go on from `beat`, with its distance from the song's activity.
    fn candidates(
        &self,
        beat: usize,
        end: usize,
        primitives: &[usize],
        before: Option<usize>,
        rest_must_fill: bool,
    ) -> Vec<(f64, DanceStep)> {
        let mut found = Vec::new();
        for n_beats in 1..=MAX_STEP_BEATS.min(end - beat) {
            if rest_must_fill && !self.fills[end - beat - n_beats] {
                continue;
            }
            let span = self.span(beat, n_beats);
            let activity = self.mean_activity(&span);
            for &i in primitives.iter().filter(|&&i| Some(i) != before) {
                let primitive = &self.repertoire.primitives()[i];
                if let Some(rate) = fits(primitive, span.duration_s()) {
                    let quantile = self.repertoire.energy_quantile(primitive.energy * rate * rate);
                    let step = DanceStep { primitive: Some(i), rate, ..span };
                    found.push(((quantile - activity).abs(), step));
                }
            }
        }
        found
    }

    fn span(&self, beat: usize, n_beats: usize) -> DanceStep {
        let beats = self.grid.beats();
        let (start_s, end_s) = (beats[beat].time_s, beats[beat + n_beats].time_s);
        DanceStep { beat, n_beats, start_s, end_s, primitive: None, rate: 1.0 }
    }

    /// Mean activity from begin to end of a step; beyond the song, that of its nearest frame.
    fn mean_activity(&self, step: &DanceStep) -> f64 {
        let Some(last) = self.activity.len().checked_sub(1) else { return 0.5 };
        let frame = |s: f64| (s_to_frames(s).round().max(0.0) as usize).min(last);
        let (first, end) = (frame(step.start_s), frame(step.end_s));
        let part = &self.activity[first..end.max(first + 1)];
        part.iter().sum::<f64>() / part.len() as f64
    }
}

/// Returns the sort key of candidates that are equally near.
fn key(step: &DanceStep) -> (usize, Option<usize>) {
    (step.n_beats, step.primitive)
}
