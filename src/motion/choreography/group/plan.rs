//! The plan of a group's dance: spans of whole bars with one formation and one kind of unison each.

use ndarray::Array2;

use super::formation::{Formation, distance_m};
use super::unison::{Part, Unison};
use crate::chance::Chance;
use crate::motion::choreography::beat_grid::BeatGrid;
use crate::motion::group::assign;
use crate::motion::placement::Placement;
use crate::units::s_to_frames;

/// Shortest span, s.
pub const MIN_SPAN_S: f64 = 8.0;
/// Highest speed of a dancer on the way to a new place, m/s; kept where the span has the time.
const MAX_TRAVEL_M_S: f64 = 1.8;
/// Peak of the rate of `10u³ - 15u⁴ + 6u⁵`.
const PEAK_RATE: f64 = 1.875;
/// Shortest time for a way, s.
const MIN_TRAVEL_S: f64 = 1.2;

/// A span of a dance with one formation and one kind of unison.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupSpan {
    /// The frames of the span, within the dance.
    pub first_frame: usize,
    pub end_frame: usize,
    /// The downbeats on which it begins and ends, s; the first may lie before the song.
    pub start_s: f64,
    pub end_s: f64,
    /// The beat of the grid on which it begins.
    pub first_beat: usize,
    pub formation: Formation,
    pub unison: Unison,
    /// The place of every dancer.
    pub places: Vec<Placement>,
    /// When everybody has come to its place; the way there begins with the span. The begin of the first.
    pub arrival_s: f64,
    /// What every dancer does.
    pub parts: Vec<Part>,
}

impl GroupSpan {
    /// Returns how much of the way to its places is done, `10u³ - 15u⁴ + 6u⁵`.
    pub fn arrived(&self, at_s: f64) -> f64 {
        if at_s >= self.arrival_s {
            return 1.0;
        }
        let u = ((at_s - self.start_s) / (self.arrival_s - self.start_s)).clamp(0.0, 1.0);
        u * u * u * (10.0 + u * (6.0 * u - 15.0))
    }
}

/// Plans a dance of `n_dancers` and `n_frames`; its spans follow each other without a gap.
///
/// A span is 1, 2, 4, … short phrases of the grid, the fewest that last `min_span_s` and 8 s; a rest of
/// less than half a span belongs to the last. Chance draws formations and kinds of unison, each
/// after all others, and never the same twice in a row; a canon only where every dancer has a bar to
/// repeat. Dancers take the places whose squared distances have the least sum.
pub fn spans(
    grid: &BeatGrid,
    (n_dancers, n_frames): (usize, usize),
    min_span_s: f64,
    chance: &mut Chance,
) -> Vec<GroupSpan> {
    let beats = grid.beats();
    let mut spans: Vec<GroupSpan> = Vec::new();
    let (mut formations, mut unisons) = (Vec::new(), Vec::new());
    for (first_beat, end_beat) in borders(grid, min_span_s) {
        let last = spans.last();
        let (start_s, end_s) = (beats[first_beat].time_s, beats[end_beat].time_s);
        let formation = draw(&mut formations, &Formation::ALL, chance, |f| {
            last.is_none_or(|last| last.formation != f)
        });
        let unison = draw(&mut unisons, &Unison::ALL, chance, |u| {
            let is_new = last.is_none_or(|last| last.unison != u);
            is_new && (u != Unison::Canon || has_canon(grid, first_beat, n_dancers))
        });
        let new = formation.places(n_dancers, chance);
        let (places, arrival_s) = match last {
            None => (new, start_s),
            Some(last) => {
                let places = taken(&last.places, &new);
                let arrival_s = arrival_s(grid, (first_beat, end_beat), &last.places, &places);
                (places, arrival_s)
            }
        };
        let frame = |at_s: f64| (s_to_frames(at_s).ceil().max(0.0) as usize).min(n_frames);
        let first_frame = spans.last().map_or(0, |last| last.end_frame);
        let parts = unison.parts(&places);
        spans.push(GroupSpan {
            first_frame,
            end_frame: frame(end_s),
            start_s,
            end_s,
            first_beat,
            formation,
            unison,
            places,
            arrival_s,
            parts,
        });
    }
    if let Some(last) = spans.last_mut() {
        last.end_frame = n_frames;
    }
    spans
}

/// Returns first and last beat of every span.
fn borders(grid: &BeatGrid, min_span_s: f64) -> Vec<(usize, usize)> {
    let last = grid.beats().len() - 1;
    let wanted_s = min_span_s.max(MIN_SPAN_S);
    let mut n_beats = grid.short_phrase_beats();
    while (n_beats as f64) * grid.interval_s() < wanted_s && n_beats < last {
        n_beats *= 2;
    }
    let n_spans = ((last + n_beats / 2) / n_beats).max(1);
    (0..n_spans)
        .map(|k| (k * n_beats, if k + 1 == n_spans { last } else { (k + 1) * n_beats }))
        .collect()
}

/// Takes one of the allowed values out of a bag, which is filled with all where it has none.
fn draw<T: Copy + PartialEq>(
    bag: &mut Vec<T>,
    all: &[T],
    chance: &mut Chance,
    is_allowed: impl Fn(T) -> bool,
) -> T {
    if !bag.iter().any(|&x| is_allowed(x)) {
        *bag = all.to_vec();
    }
    let allowed: Vec<usize> = (0..bag.len()).filter(|&i| is_allowed(bag[i])).collect();
    bag.remove(allowed[chance.below(allowed.len())])
}

/// Returns whether the last dancer of a canon repeats what lies within the song.
fn has_canon(grid: &BeatGrid, first_beat: usize, n_dancers: usize) -> bool {
    let delay = n_dancers.saturating_sub(1) * grid.beats_per_bar();
    first_beat.checked_sub(delay).is_some_and(|beat| grid.beats()[beat].time_s >= 0.0)
}

/// Returns the new place of every dancer.
///
/// Who goes straight to the places with the least sum of squared distances, all in the same time, comes no
/// nearer to another than the least distance of places over √2. Source: Turpin, Michael and Kumar, CAPT:
/// concurrent assignment and planning of trajectories for multiple robots, IJRR 33 (1), 2014, theorem 4.
fn taken(from: &[Placement], to: &[Placement]) -> Vec<Placement> {
    let squared = |(i, j): (usize, usize)| distance_m(&from[i], &to[j]).powi(2);
    let cost = Array2::from_shape_fn((from.len(), to.len()), squared);
    assign(cost.view()).into_iter().map(|j| to[j]).collect()
}

/// Returns the downbeat on which the slowest way allowed ends, s.
fn arrival_s(
    grid: &BeatGrid,
    (first_beat, end_beat): (usize, usize),
    from: &[Placement],
    to: &[Placement],
) -> f64 {
    let longest_m = from.iter().zip(to).map(|(a, b)| distance_m(a, b)).fold(0.0, f64::max);
    let needed_s = (longest_m * PEAK_RATE / MAX_TRAVEL_M_S).max(MIN_TRAVEL_S);
    let beats = grid.beats();
    let downbeats = (first_beat..=end_beat).step_by(grid.beats_per_bar()).skip(1);
    downbeats
        .map(|beat| beats[beat].time_s)
        .find(|at_s| at_s - beats[first_beat].time_s >= needed_s)
        .unwrap_or(beats[end_beat].time_s)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::choreography::group::formation::pairs;
    use crate::motion::phase::Beats;

    fn grid(tempo_bpm: f64, beats_per_bar: u32, duration_s: f64) -> BeatGrid {
        let n = (duration_s * tempo_bpm / 60.0) as usize + 1;
        let times = (0..n).map(|i| i as f64 * 60.0 / tempo_bpm).collect();
        let beats = Beats::new(times, None, Some(beats_per_bar)).unwrap();
        BeatGrid::over(&beats, duration_s)
    }

    #[test]
    fn spans_are_whole_phrases_and_cover_the_song() {
        for (tempo_bpm, beats_per_bar, min_span_s) in
            [(120.0, 4, 0.0), (93.0, 3, 12.0), (171.0, 4, 30.0), (67.0, 5, 10.0)]
        {
            let grid = grid(tempo_bpm, beats_per_bar, 100.0);
            let spans = spans(&grid, (3, 3000), min_span_s, &mut Chance::new(4, 0));
            let mut frame = 0;
            for (i, span) in spans.iter().enumerate() {
                assert_eq!(span.first_frame, frame);
                assert_eq!(grid.beats()[span.first_beat].number, 1);
                frame = span.end_frame;
                let is_long = span.end_s - span.start_s >= min_span_s.max(8.0) - 1e-9;
                assert!(is_long || i + 1 == spans.len(), "{span:?}");
                assert!(span.arrival_s <= span.end_s);
                if let Some(next) = spans.get(i + 1) {
                    assert_eq!(span.end_s, next.start_s);
                    assert_ne!(span.formation, next.formation);
                    assert_ne!(span.unison, next.unison);
                    assert!(next.start_s * 30.0 <= next.first_frame as f64);
                    assert!(next.start_s * 30.0 > next.first_frame as f64 - 1.0);
                }
            }
            assert_eq!(frame, 3000);
            assert!(spans.len() >= 2, "{tempo_bpm}");
        }
        // A song shorter than a span is one.
        assert_eq!(borders(&grid(120.0, 4, 3.0), 60.0), [(0, 8)]);
    }

    #[test]
    fn every_kind_comes_before_one_comes_again() {
        let grid = grid(120.0, 4, 200.0);
        for seed in 0..20 {
            let spans = spans(&grid, (2, 6000), 0.0, &mut Chance::new(seed, 0));
            assert!(spans.len() >= 15);
            let mut kinds: Vec<Unison> = spans[..5].iter().map(|s| s.unison).collect();
            kinds.sort_unstable();
            assert_eq!(kinds, Unison::ALL);
            // Nobody has a bar to repeat in the first.
            assert_ne!(spans[0].unison, Unison::Canon);
            let mut shapes: Vec<Formation> = spans[..5].iter().map(|s| s.formation).collect();
            shapes.sort_unstable();
            assert_eq!(shapes, Formation::ALL);
        }
        let canons = |n: usize| (0..5).filter(|&i| has_canon(&grid, 16 * i, n)).count();
        assert_eq!((canons(1), canons(2), canons(5), canons(16)), (5, 4, 4, 1));
    }

    #[test]
    fn ways_of_least_squares_stay_apart() {
        for n in [2, 3, 5, 8, 16] {
            for seed in 0..100 {
                let mut chance = Chance::new(seed, 9);
                let from = Formation::ALL[chance.below(5)].places(n, &mut chance);
                let to = Formation::ALL[chance.below(5)].places(n, &mut chance);
                let to = taken(&from, &to);
                let mut least = f64::INFINITY;
                for (i, j) in pairs(n) {
                    for step in 0..=200 {
                        let u = f64::from(step) / 200.0;
                        let at = |k: usize| Placement {
                            x_m: from[k].x_m + u * (to[k].x_m - from[k].x_m),
                            z_m: from[k].z_m + u * (to[k].z_m - from[k].z_m),
                            yaw_rad: 0.0,
                        };
                        least = least.min(distance_m(&at(i), &at(j)));
                    }
                }
                assert!(least >= 1.6 / 2.0_f64.sqrt() - 1e-9, "{n} {seed}: {least}");
            }
        }
    }
}
