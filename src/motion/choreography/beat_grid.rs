//! Beats over a whole song and a little more, counted in bars.

use crate::motion::phase::Beats;

/// Fewest beats of a choreographic phrase.
const MIN_PHRASE_BEATS: usize = 4;

/// One beat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Beat {
    /// Time in the song, s.
    pub time_s: f64,
    /// Number in the bar, from 1; 1 is the downbeat.
    pub number: u32,
}

/// The beats of a song from the last downbeat at or before its begin to the first at or after its
/// end, continued at the median interval where the song has none.
#[derive(Clone, Debug, PartialEq)]
pub struct BeatGrid {
    beats: Vec<Beat>,
    beats_per_bar: usize,
    interval_s: f64,
}

impl BeatGrid {
    /// Lays the grid over `0..=end_s`.
    ///
    /// Beats are counted from the first downbeat, as [`crate::motion::phase::bar_phase`] counts them.
    pub fn over(beats: &Beats, end_s: f64) -> Self {
        let times_s = beats.times_s();
        let interval_s = 60.0 / beats.tempo_bpm();
        let last = times_s.len() - 1;
        let time_of = |i: i64| match usize::try_from(i) {
            Err(_) => times_s[0] + i as f64 * interval_s,
            Ok(i) if i > last => times_s[last] + (i - last) as f64 * interval_s,
            Ok(i) => times_s[i],
        };
        let beats_per_bar = i64::from(beats.beats_per_bar());
        let downbeat = beats.first_downbeat();
        // The last beat at or before 0, then back to its downbeat.
        let at_zero = match times_s.partition_point(|&t| t <= 0.0) {
            0 => (-times_s[0] / interval_s).floor() as i64,
            n => n as i64 - 1,
        };
        let first = at_zero - (at_zero - downbeat).rem_euclid(beats_per_bar);
        let mut grid = Vec::new();
        for i in first.. {
            let number = (i - downbeat).rem_euclid(beats_per_bar);
            let time_s = time_of(i);
            grid.push(Beat { time_s, number: number as u32 + 1 });
            if number == 0 && time_s >= end_s && grid.len() > 1 {
                break;
            }
        }
        Self { beats: grid, beats_per_bar: beats_per_bar as usize, interval_s }
    }

    /// Returns the beats, ascending, the first and the last on a downbeat.
    pub fn beats(&self) -> &[Beat] {
        &self.beats
    }

    /// Returns the usual time from beat to beat, s.
    pub fn interval_s(&self) -> f64 {
        self.interval_s
    }

    /// Returns the number of beats in a bar.
    pub fn beats_per_bar(&self) -> usize {
        self.beats_per_bar
    }

    /// Returns how many beats have passed since the first of the grid at a time of the song, linear
    /// between beats and continued at the usual interval beyond both ends.
    pub fn position(&self, time_s: f64) -> f64 {
        let i = self.beats.partition_point(|beat| beat.time_s <= time_s);
        let (Some(before), Some(after)) = (i.checked_sub(1), self.beats.get(i)) else {
            let nearest = if i == 0 { 0 } else { i - 1 };
            return nearest as f64 + (time_s - self.beats[nearest].time_s) / self.interval_s;
        };
        let start_s = self.beats[before].time_s;
        before as f64 + (time_s - start_s) / (after.time_s - start_s)
    }

    /// Returns the time at which so many beats have passed, s: the inverse of [`BeatGrid::position`].
    pub fn time_s(&self, position: f64) -> f64 {
        let last = self.beats.len() - 1;
        let before = position.floor().clamp(0.0, last as f64) as usize;
        let interval_s = if position < 0.0 || before == last {
            self.interval_s
        } else {
            self.beats[before + 1].time_s - self.beats[before].time_s
        };
        self.beats[before].time_s + (position - before as f64) * interval_s
    }

    /// Returns the beats of a short phrase: whole bars, at least 4 beats; a long one has twice as many.
    pub fn short_phrase_beats(&self) -> usize {
        self.beats_per_bar * MIN_PHRASE_BEATS.div_ceil(self.beats_per_bar)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_grid_covers_the_song_in_whole_bars() {
        let beats = Beats::parse("0.5 2\n1.0 3\n1.5 1\n2.1 2\n").unwrap();
        let grid = BeatGrid::over(&beats, 3.0);
        let times: Vec<f64> = grid.beats().iter().map(|b| b.time_s).collect();
        let wanted = [0.0, 0.5, 1.0, 1.5, 2.1, 2.6, 3.1];
        assert!(times.iter().zip(wanted).all(|(t, w)| (t - w).abs() < 1e-12), "{times:?}");
        let numbers: Vec<u32> = grid.beats().iter().map(|b| b.number).collect();
        assert_eq!(numbers, [1, 2, 3, 1, 2, 3, 1]);
        assert_eq!(grid.short_phrase_beats(), 6);
        assert!((grid.interval_s() - 0.5).abs() < 1e-12);
    }

    #[test]
    fn beats_that_begin_late_or_early_are_continued() {
        let late = Beats::new(vec![9.0, 9.5], None, None).unwrap();
        let grid = BeatGrid::over(&late, 1.0);
        assert_eq!(grid.beats()[0], Beat { time_s: -1.0, number: 1 });
        assert_eq!(grid.beats().last().unwrap().time_s, 1.0);
        assert_eq!(grid.beats().len(), 5);
        // One bar at least, and the first downbeat may be at 0 itself.
        let early = Beats::new(vec![0.0, 0.5], None, Some(1)).unwrap();
        let grid = BeatGrid::over(&early, 0.0);
        assert_eq!(grid.beats().iter().map(|b| b.time_s).collect::<Vec<_>>(), [0.0, 0.5]);
        assert_eq!(grid.short_phrase_beats(), 4);
    }

    #[test]
    fn positions_count_beats_and_times_are_their_inverse() {
        let beats = Beats::parse("0.5 2\n1.0 3\n1.5 1\n2.1 2\n").unwrap();
        let grid = BeatGrid::over(&beats, 3.0);
        for (time_s, position) in
            [(-1.0, -2.0), (0.0, 0.0), (0.25, 0.5), (1.8, 3.5), (2.1, 4.0), (3.1, 6.0), (4.1, 8.0)]
        {
            assert!((grid.position(time_s) - position).abs() < 1e-9, "{time_s}");
            assert!((grid.time_s(position) - time_s).abs() < 1e-9, "{position}");
        }
    }

    #[test]
    fn phrases_are_whole_bars() {
        for (beats_per_bar, short) in [(1, 4), (2, 4), (3, 6), (4, 4), (5, 5), (7, 7)] {
            let beats = Beats::new(vec![0.0, 0.5], None, Some(beats_per_bar)).unwrap();
            assert_eq!(BeatGrid::over(&beats, 2.0).short_phrase_beats(), short, "{beats_per_bar}");
        }
    }
}
