//! Whether p-values and intervals are what they say: simulated, with what was found printed.

#![expect(clippy::print_stderr, reason = "what was found is printed, for docs/evaluate.md")]

use std::f64::consts::TAU;
use std::thread;

use motiongen::chance::Draws;
use motiongen::evaluation::coupling::{
    CoupledPassage, Coupling, CouplingSums, Harmonics, consistency_p, rotation_p,
};
use motiongen::evaluation::interval::{
    Estimate, clustered_mean_estimate, clustered_share_estimate, jackknife_estimate,
    paired_difference,
};
use motiongen::evaluation::score::locking_above_chance;
use motiongen::units::FPS;

/// Random motion: waves of random phases, all in a band.
fn noise(n: usize, band_hz: [f64; 2], draws: &mut Draws) -> Vec<f64> {
    const N_WAVES: usize = 12;
    let mut signal = vec![0.0; n];
    for i in 0..N_WAVES {
        let share = (i as f64 + draws.uniform()) / N_WAVES as f64;
        let step = TAU * (band_hz[0] + share * (band_hz[1] - band_hz[0])) / FPS;
        let (mut c, mut s) = (TAU * draws.uniform()).sin_cos();
        let (sine, cosine) = step.sin_cos();
        for x in &mut signal {
            *x += c;
            (c, s) = (c * cosine - s * sine, s * cosine + c * sine);
        }
    }
    signal
}

/// Shares of trials in which 4 songs × 8 motions that ignore the music have p < 0.01 and p < 0.1, by the known
/// coupling and by consistency; each motion the best of `best_of`, by the score with which generate chooses.
fn false_alarms(band_hz: [f64; 2], best_of: usize, n_trials: u64) -> [[f64; 2]; 2] {
    const N_FRAMES: usize = 190;
    let trial = |seed: u64| -> [f64; 2] {
        let mut draws = Draws::new(seed);
        let (mut coupled, mut consistent) = (Vec::new(), Vec::new());
        for _ in 0..4 {
            // 100 to 150 bpm, so that the beat is in the band from 1.6 to 2.4 Hz, and the bar is anywhere.
            let bar_s = 240.0 / (100.0 + 50.0 * draws.uniform());
            let start_bars = draws.uniform();
            let bars: Vec<f64> =
                (0..N_FRAMES).map(|t| start_bars + t as f64 / FPS / bar_s).collect();
            let phase: Vec<f64> = bars.iter().map(|x| x.fract()).collect();
            let mut sums = CouplingSums::default();
            let mut harmonics = Harmonics::default();
            for _ in 0..8 {
                let mut best: Option<(f64, Vec<f64>)> = None;
                for _ in 0..best_of {
                    let motion = noise(N_FRAMES - 1, band_hz, &mut draws);
                    let score = match best_of {
                        1 => 0.0,
                        _ => locking_above_chance(&motion, &phase),
                    };
                    if best.as_ref().is_none_or(|(known, _)| score > *known) {
                        best = Some((score, motion));
                    }
                }
                let (_, motion) = best.expect("one at least");
                let passage = CoupledPassage {
                    rise_m_s: &motion,
                    bars: &bars,
                    beats_per_bar: 4,
                    activity: None,
                };
                sums.add(&Coupling::Constructed, &passage);
                harmonics.add(&passage);
            }
            coupled.push(sums);
            consistent.push(harmonics);
        }
        [
            rotation_p(&coupled, seed).expect("it moves"),
            consistency_p(&consistent, seed).expect("it moves"),
        ]
    };
    let halves: Vec<[f64; 2]> = thread::scope(|scope| {
        let workers: Vec<_> = [0, 1]
            .map(|half| {
                let trial = &trial;
                scope.spawn(move || (0..n_trials).filter(|i| i % 2 == half).map(trial).collect())
            })
            .into_iter()
            .collect();
        let found: Vec<Vec<[f64; 2]>> =
            workers.into_iter().map(|worker| worker.join().expect("no panic")).collect();
        found.concat()
    });
    [0, 1].map(|which| {
        [0.01, 0.1].map(|alpha| {
            halves.iter().filter(|p| p[which] < alpha).count() as f64 / n_trials as f64
        })
    })
}

/// The calibration that makes a p-value one: P(p < 0.01) ≤ 0.02 and P(p < 0.1) ≤ 0.13 over 400 trials, which
/// p-values that are uniform keep with a probability of 0.97 each (binomial: 8 of 400 at 0.01, 52 at 0.1).
#[test]
fn motion_that_ignores_the_music_is_seldom_significant() {
    for (band, band_hz) in [("0.3 to 12 Hz", [0.3, 12.0]), ("1.6 to 2.4 Hz", [1.6, 2.4])] {
        for best_of in [1, 8] {
            let found = false_alarms(band_hz, best_of, 400);
            for (name, [p01, p1]) in ["coupling", "consistency"].into_iter().zip(found) {
                eprintln!("{name}, {band}, best of {best_of}: P(p < 0.01) {p01}, P(p < 0.1) {p1}");
                assert!(p01 <= 0.02, "{name}, {band}, best of {best_of}: P(p < 0.01) = {p01}");
                assert!(p1 <= 0.13, "{name}, {band}, best of {best_of}: P(p < 0.1) = {p1}");
            }
        }
    }
}

/// Draws of a normal distribution, by Box and Muller.
fn normal(draws: &mut Draws) -> f64 {
    let (u, v) = (1.0 - draws.uniform(), draws.uniform());
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// Songs that differ (a third of the variance is between songs), with `n` windows each of `dim` numbers.
fn songs(n_songs: usize, n: usize, dim: usize, draws: &mut Draws) -> Vec<Vec<Vec<f64>>> {
    let (between, within) = ((1.0_f64 / 3.0).sqrt(), (2.0_f64 / 3.0).sqrt());
    (0..n_songs)
        .map(|_| {
            let own: Vec<f64> = (0..dim).map(|_| between * normal(draws)).collect();
            (0..n).map(|_| own.iter().map(|x| x + within * normal(draws)).collect()).collect()
        })
        .collect()
}

/// Share of `n_trials` intervals that hold the truth; trials without an interval do not.
fn coverage(n_trials: usize, truth: f64, mut trial: impl FnMut() -> Estimate) -> f64 {
    let holds = |e: Estimate| {
        e.ci_low.is_some_and(|low| low <= truth) && e.ci_high.is_some_and(|high| high >= truth)
    };
    (0..n_trials).filter(|_| holds(trial())).count() as f64 / n_trials as f64
}

#[test]
fn intervals_hold_the_truth_as_often_as_they_say() {
    let mut draws = Draws::new(7);
    for n_songs in [4, 8, 20] {
        let clusters: Vec<usize> = (0..n_songs).flat_map(|song| [song; 9]).collect();
        let mean = coverage(2000, 0.0, || {
            let values: Vec<f64> = songs(n_songs, 9, 1, &mut draws).concat().concat();
            clustered_mean_estimate(&values, &clusters)
        });
        // Skewed as speeds and errors are: a log-normal song with log-normal windows, deviations of 0.25.
        let skewed_truth = (0.25_f64 * 0.25).exp();
        let skewed = coverage(2000, skewed_truth, || {
            let song = |draws: &mut Draws| {
                let own = 0.25 * normal(draws);
                (0..9).map(|_| (own + 0.25 * normal(draws)).exp()).collect::<Vec<f64>>()
            };
            let values: Vec<f64> = (0..n_songs).flat_map(|_| song(&mut draws)).collect();
            clustered_mean_estimate(&values, &clusters).non_negative()
        });
        let pairs = coverage(2000, 0.3, || {
            let differences: Vec<f64> = (0..n_songs).map(|_| 0.3 + normal(&mut draws)).collect();
            paired_difference(&differences).estimate
        });
        // Songs of which a window is true with a probability of its own, uniform from 0.6 to 1.
        let share = coverage(2000, 0.8, || {
            let one = |draws: &mut Draws| {
                let p = 0.6 + 0.4 * draws.uniform();
                (0..9).map(|_| draws.uniform() < p).collect::<Vec<bool>>()
            };
            let is_true: Vec<bool> = (0..n_songs).flat_map(|_| one(&mut draws)).collect();
            clustered_share_estimate(&is_true, &clusters)
        });
        eprintln!("{n_songs} songs: mean {mean}, skewed {skewed}, paired {pairs}, share {share}");
        // 2000 trials tell a coverage to ±0.01 (two deviations).
        for (what, found) in [("mean", mean), ("skewed mean", skewed), ("pairs", pairs)] {
            assert!((0.93..=0.97).contains(&found), "{what}, {n_songs} songs: {found}");
        }
        // The windows of four songs cannot say how alike songs are, so that a share is rather too careful.
        assert!((0.93..=0.995).contains(&share), "share, {n_songs} songs: {share}");
    }
}

#[test]
fn numbers_of_sets_hold_the_truth_as_often_as_they_say() {
    let mut draws = Draws::new(11);
    // E |a - b| of two songs' windows, each standard normal in three dimensions: √2 E|N₃| = 4 / √π.
    let truth = 4.0 / std::f64::consts::PI.sqrt();
    for n_songs in [4, 8, 20] {
        let found = coverage(1000, truth, || {
            let all = songs(n_songs, 4, 3, &mut draws);
            let distance = |a: &[f64], b: &[f64]| {
                a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt()
            };
            // Pairs of different songs, as song_distance takes them.
            jackknife_estimate(n_songs, 4 * n_songs, |left_out| {
                let (mut sum, mut n) = (0.0, 0);
                for i in (0..n_songs).filter(|i| Some(*i) != left_out) {
                    for j in (0..i).filter(|j| Some(*j) != left_out) {
                        for (a, b) in all[i].iter().flat_map(|a| all[j].iter().map(move |b| (a, b)))
                        {
                            sum += distance(a, b);
                            n += 1;
                        }
                    }
                }
                (n > 0).then(|| sum / f64::from(n))
            })
        });
        eprintln!("{n_songs} songs: distance of pairs {found}");
        assert!((0.92..=0.97).contains(&found), "{n_songs} songs: {found}");
    }
}
