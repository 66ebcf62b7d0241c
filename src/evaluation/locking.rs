//! How strongly motion is locked to the bar, against what it would be at wrong tempi.
//!
//! R² of a short signal is not small by chance, so it is held against R² of the same signal with the bar's
//! phase running at tempi that the music does not have.

use crate::motion::locking::BarSums;

use super::interval::mean_and_deviation;

/// Slowest and fastest of the wrong tempi, as multiples of the music's.
const TEMPO_RATIOS: [f64; 2] = [0.55, 1.8];
/// Wrong tempi keep away from the fractions of these small numbers, whose bars share beats with the music.
const SIMPLE: std::ops::RangeInclusive<u32> = 1..=4;
/// Least distance from such a fraction, as a natural logarithm.
const MIN_LOG_DISTANCE: f64 = 0.04;
/// Tempi among which wrong ones are chosen.
const N_CANDIDATES: usize = 4000;
/// Scores over wrong tempi that spread less than this do not spread.
const MIN_DEVIATION: f64 = 1e-12;

/// A stretch of a signal, such as vertical velocity, and the bars that had passed at each frame.
#[derive(Clone, Copy, Debug)]
pub struct Passage<'a> {
    pub signal: &'a [f64],
    /// Counted on from bar to bar: see [`unwrapped`](crate::motion::phase::unwrapped) and [`since_start`].
    pub bars: &'a [f64],
}

/// R² with the bar, and what it is at wrong tempi.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BarLocking {
    /// Share of the variance that follows the bar, in [0, 1]; the mean over fits.
    pub r2: f64,
    /// Mean over wrong tempi.
    pub wrong_mean: f64,
    /// `(r2 - wrong_mean) / s`, s the standard deviation over wrong tempi; none where they all agree.
    pub effect: Option<f64>,
    /// `(1 + number of wrong tempi that do as well) / (1 + number of them)`. No p-value: neighbouring tempi are no
    /// independent draws.
    pub wrong_share: f64,
    pub n_wrong: usize,
    /// Fits that were made.
    pub n_fits: usize,
}

/// Returns R² of each fit with the bar's tempo multiplied by `ratio`; `groups[i]` is the fit of passage i, and
/// all passages of a fit lie one behind the other in it.
///
/// Fits that have no more values than are fitted are left out.
pub fn r2_at(passages: &[Passage<'_>], groups: &[usize], ratio: f64) -> Vec<f64> {
    let n_fits = groups.iter().max().map_or(0, |last| last + 1);
    let mut fits = vec![BarSums::default(); n_fits];
    for (Passage { signal, bars }, group) in passages.iter().zip(groups) {
        let phases = bars.iter().map(|bars| bars * ratio);
        fits[*group].add(&BarSums::of(signal.iter().copied().zip(phases)));
    }
    fits.into_iter().filter(BarSums::can_be_fitted).map(|fit| fit.r2()).collect()
}

impl BarLocking {
    /// Holds R² of fits against those of the same fits at wrong tempi.
    ///
    /// None without fits, for fewer than two wrong tempi, or where something is not finite.
    pub fn against(r2: &[f64], wrong: &[Vec<f64>]) -> Option<Self> {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let n_fits = r2.len();
        let r2 = mean(r2);
        let wrong: Vec<f64> = wrong.iter().map(|values| mean(values)).collect();
        let (wrong_mean, deviation) = mean_and_deviation(&wrong)?;
        let n_as_good = wrong.iter().filter(|&&x| x >= r2).count();
        r2.is_finite().then(|| Self {
            r2,
            wrong_mean,
            effect: (deviation > MIN_DEVIATION).then(|| (r2 - wrong_mean) / deviation),
            wrong_share: (1 + n_as_good) as f64 / (1 + wrong.len()) as f64,
            n_wrong: wrong.len(),
            n_fits,
        })
    }
}

/// Returns `n` wrong tempi as multiples of the music's: evenly from 0.55 to 1.8 on a scale of logarithms,
/// 4 % away from the fractions of 1 to 4.
pub fn wrong_tempi(n: usize) -> Vec<f64> {
    let simple: Vec<f64> =
        SIMPLE.flat_map(|a| SIMPLE.map(move |b| f64::from(a) / f64::from(b))).collect();
    let [low, high] = TEMPO_RATIOS;
    let apart: Vec<f64> = (0..N_CANDIDATES)
        .map(|i| low * (high / low).powf(i as f64 / (N_CANDIDATES - 1) as f64))
        .filter(|ratio| simple.iter().all(|s| (ratio / s).ln().abs() > MIN_LOG_DISTANCE))
        .collect();
    let step = n.saturating_sub(1).max(1);
    (0..n).map(|i| apart[i * (apart.len() - 1) / step]).collect()
}

/// Returns bars since the song began, of a passage that begins `start_frames` into it: as many whole bars
/// more as its tempo makes until there.
///
/// Wrong tempi then drift from the music over the whole song, so that one fit for all passages of a song is
/// as strict as one for the song would be. Passages of a single frame stay as they are.
pub fn since_start(bars: &[f64], start_frames: f64) -> Vec<f64> {
    let [first, .., last] = bars else { return bars.to_vec() };
    let bars_per_frame = (last - first) / (bars.len() - 1) as f64;
    let before = (start_frames * bars_per_frame - first).round();
    bars.iter().map(|x| x + before).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::f64::consts::TAU;

    fn bars(n: usize, bar_frames: f64, start_frames: f64) -> Vec<f64> {
        (0..n).map(|t| (start_frames + t as f64) / bar_frames).collect()
    }

    /// One regression for each item of `fits`, against tempi.
    fn locking_against(fits: &[Vec<Passage<'_>>], ratios: &[f64]) -> Option<BarLocking> {
        let groups: Vec<usize> =
            fits.iter().enumerate().flat_map(|(i, fit)| fit.iter().map(move |_| i)).collect();
        let passages: Vec<Passage<'_>> = fits.iter().flatten().copied().collect();
        let wrong: Vec<Vec<f64>> =
            ratios.iter().map(|&ratio| r2_at(&passages, &groups, ratio)).collect();
        BarLocking::against(&r2_at(&passages, &groups, 1.0), &wrong)
    }

    fn wave(bars: &[f64]) -> Vec<f64> {
        bars.iter().map(|x| (TAU * x).sin() + 0.3 * (TAU * 2.0 * x).cos()).collect()
    }

    #[test]
    fn a_wave_of_the_bar_is_locked_and_no_wrong_tempo_does_as_well() {
        let bars = bars(601, 57.3, 0.0);
        let signal = wave(&bars);
        let fits = [vec![Passage { signal: &signal, bars: &bars }]];
        let found = locking_against(&fits, &wrong_tempi(99)).expect("finite");
        assert!((found.r2 - 1.0).abs() < 1e-9, "{found:?}");
        // Ten bars tell tempi a tenth apart; nearer ones share a part of the wave.
        assert!(found.wrong_mean < 0.2 && found.effect > Some(3.0), "{found:?}");
        assert_eq!((found.wrong_share, found.n_wrong, found.n_fits), (0.01, 99, 1));
    }

    #[test]
    fn a_wave_of_another_tempo_is_not_better_than_wrong_ones() {
        let (own, other) = (bars(601, 57.3, 0.0), bars(601, 57.3 / 1.13, 0.0));
        let signal = wave(&other);
        let fits = [vec![Passage { signal: &signal, bars: &own }]];
        let found = locking_against(&fits, &wrong_tempi(60)).expect("finite");
        assert!(found.r2 < 0.1 && found.wrong_share > 0.2, "{found:?}");
    }

    #[test]
    fn one_fit_of_a_song_sees_what_fits_of_its_passages_do_not() {
        // Each passage follows the bar, but from another beat on.
        let passages: Vec<Vec<f64>> =
            (0..5).map(|i| bars(121, 60.0, f64::from(i) * 300.0)).collect();
        let signals: Vec<Vec<f64>> = passages
            .iter()
            .enumerate()
            .map(|(i, bars)| bars.iter().map(|x| (TAU * (x + i as f64 / 5.0)).sin()).collect())
            .collect();
        let all: Vec<Passage> =
            signals.iter().zip(&passages).map(|(signal, bars)| Passage { signal, bars }).collect();
        let alone: Vec<Vec<Passage>> = all.iter().map(|passage| vec![*passage]).collect();
        let ratios = wrong_tempi(20);
        let alone = locking_against(&alone, &ratios).expect("finite");
        let together = locking_against(&[all], &ratios).expect("finite");
        assert!(alone.r2 > 0.99 && alone.n_fits == 5, "{alone:?}");
        assert!(together.r2 < 0.05 && together.n_fits == 1, "{together:?}");
    }

    #[test]
    fn wrong_tempi_are_in_order_and_none_is_simple() {
        let ratios = wrong_tempi(199);
        assert_eq!((ratios.len(), ratios[0]), (199, 0.55));
        assert!((ratios[198] - 1.8).abs() < 1e-12);
        assert!(ratios.windows(2).all(|pair| pair[0] < pair[1]));
        for simple in [1.0, 2.0 / 3.0, 0.75, 4.0 / 3.0, 1.5] {
            assert!(ratios.iter().all(|r| (r / simple - 1.0).abs() > 0.039), "{simple}");
        }
        assert_eq!(wrong_tempi(0), [0.0; 0]);
        assert_eq!(wrong_tempi(1), [0.55]);
    }

    #[test]
    fn bars_are_counted_from_the_beginning_of_the_song() {
        let bars = [0.4, 0.7, 1.0, 1.3, 1.6];
        // 0.3 bars a frame: 35 frames are 10.5 bars, nearest to which are 10 bars and 0.4.
        assert_eq!(since_start(&bars, 35.0)[0], 10.4);
        assert_eq!(since_start(&[0.3], 21.0), [0.3]);
    }

    #[test]
    fn what_is_short_or_not_finite_has_no_locking() {
        let bars = bars(60, 30.0, 0.0);
        let mut signal = wave(&bars);
        let ratios = wrong_tempi(9);
        let short = Passage { signal: &signal[..9], bars: &bars };
        assert_eq!(locking_against(&[vec![short]], &ratios), None);
        assert_eq!(locking_against(&[], &ratios), None);
        let whole = [vec![Passage { signal: &signal, bars: &bars }]];
        assert_eq!(locking_against(&whole, &ratios[..1]), None);
        // Motion that stands still is not locked, at this tempo or at any other.
        let still = [0.0; 60];
        let found = locking_against(&[vec![Passage { signal: &still, bars: &bars }]], &ratios);
        assert_eq!(found.map(|x| (x.r2, x.effect, x.wrong_share)), Some((0.0, None, 1.0)));
        signal[5] = f64::NAN;
        assert_eq!(
            locking_against(&[vec![Passage { signal: &signal, bars: &bars }]], &ratios),
            None
        );
    }
}
