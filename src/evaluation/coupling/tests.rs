use std::thread;

use super::*;
use crate::evaluation::score::locking_above_chance;
use crate::motion::choreography::floor::rise_m;

/// A song of a constant tempo that begins anywhere in a bar.
struct Song {
    bars: Vec<f64>,
    activity: Vec<f64>,
}

fn song(n_frames: usize, bar_s: f64, start_bars: f64) -> Song {
    let bars = (0..n_frames).map(|t| start_bars + t as f64 / FPS / bar_s).collect();
    let activity =
        (0..n_frames).map(|t| 0.5 + 0.4 * (0.013 * t as f64 + start_bars).sin()).collect();
    Song { bars, activity }
}

impl Song {
    /// Vertical velocity of a body at h(φ + `shift`, a), by the constructing function itself.
    fn rise(&self, bar_s: f64, shift_bars: f64) -> Vec<f64> {
        let height =
            |t: usize| rise_m((self.bars[t] + shift_bars).fract(), self.activity[t], bar_s, 4);
        (1..self.bars.len()).map(|t| FPS * (height(t) - height(t - 1))).collect()
    }

    fn passage<'a>(&'a self, rise_m_s: &'a [f64]) -> CoupledPassage<'a> {
        let activity = Some(&self.activity[..]);
        CoupledPassage { rise_m_s, bars: &self.bars, beats_per_bar: 4, activity }
    }
}

fn sums(coupling: &Coupling, passages: &[CoupledPassage]) -> CouplingSums {
    let mut sums = CouplingSums::default();
    passages.iter().for_each(|passage| sums.add(coupling, passage));
    sums
}

#[test]
fn constructed_motion_has_coefficient_one_and_its_faults_are_told() {
    let bar_s = 1.9;
    let song = song(601, bar_s, 0.3);
    let rise = song.rise(bar_s, 0.0);
    let of = |rise: &[f64], rotation: f64| {
        sums(&Coupling::Constructed, &[song.passage(rise)]).coefficient(rotation).expect("moves")
    };
    // The construction and the coupling are one function, computed twice.
    assert!((of(&rise, 0.0) - 1.0).abs() < 1e-9, "{}", of(&rise, 0.0));
    let half: Vec<f64> = rise.iter().map(|v| 0.5 * v + 0.7).collect();
    assert!((of(&half, 0.0) - 0.5).abs() < 1e-9);
    let upside_down: Vec<f64> = rise.iter().map(|v| -v).collect();
    assert!((of(&upside_down, 0.0) + 1.0).abs() < 1e-9);
    // A beat late: far from 1 with the bar where it is, and 1 with the bar a beat late too.
    let late = song.rise(bar_s, -0.25);
    assert!(of(&late, 0.0).abs() < 0.4, "{}", of(&late, 0.0));
    // The norm is that of the bar where it is, so that a rotated coefficient is off by a few percent.
    assert!((of(&late, -0.25) - 1.0).abs() < 0.05, "{}", of(&late, -0.25));
    // Another tempo, and a body that stands.
    let other = self::song(601, 1.3, 0.3).rise(1.3, 0.0);
    assert!(of(&other, 0.0).abs() < 0.2, "{}", of(&other, 0.0));
    assert!(of(&[0.0; 600], 0.0).abs() < 1e-12);
    let still = CoupledPassage { bars: &[0.4; 601], ..song.passage(&rise) };
    assert_eq!(sums(&Coupling::Constructed, &[still]).coefficient(0.0), None);
    let nan = [f64::NAN; 600];
    assert_eq!(sums(&Coupling::Constructed, &[song.passage(&nan)]).coefficient(0.0), None);
}

#[test]
fn sums_of_stretches_are_those_of_the_whole() {
    let (bar_s, whole) = (1.7, song(421, 1.7, 0.1));
    let rise: Vec<f64> = whole
        .rise(bar_s, 0.0)
        .iter()
        .enumerate()
        .map(|(t, v)| 0.8 * v + 0.1 * (0.9 * t as f64).sin())
        .collect();
    let stretch = |from: usize, to: usize| CoupledPassage {
        rise_m_s: &rise[from..to],
        bars: &whole.bars[from..=to],
        beats_per_bar: 4,
        activity: Some(&whole.activity[from..=to]),
    };
    let coupling = Coupling::Constructed;
    let together = sums(&coupling, &[stretch(0, 170), stretch(170, 420)]).coefficient(0.1);
    let alone = sums(&coupling, &[stretch(0, 420)]).coefficient(0.1);
    assert!((together.unwrap() - alone.unwrap()).abs() < 1e-9, "{together:?} {alone:?}");
}

#[test]
fn a_learned_coupling_is_the_mean_of_its_songs() {
    let songs: Vec<Song> =
        (0..3).map(|i| song(900, 1.5 + 0.5 * f64::from(i), 0.21 * f64::from(i))).collect();
    let wave = |song: &Song, amplitude: f64| -> Vec<f64> {
        let v = |b: &f64| amplitude * ((TAU * b).sin() + 0.5 * (TAU * 4.0 * b).cos());
        song.bars[..899].iter().map(v).collect()
    };
    let harmonics: Vec<Harmonics> = songs
        .iter()
        .enumerate()
        .map(|(i, song)| {
            let mut harmonics = Harmonics::default();
            harmonics.add(&song.passage(&wave(song, 0.1 * (i + 1) as f64)));
            harmonics
        })
        .collect();
    let template = Template::fit(&harmonics).expect("songs");
    let coupling = Coupling::Learned(template);
    // Amplitudes 0.1, 0.2 and 0.3: the mean is 0.2; 900 frames are nearly whole bars.
    let found = sums(&coupling, &[songs[0].passage(&wave(&songs[0], 0.2))]).coefficient(0.0);
    assert!((found.unwrap() - 1.0).abs() < 0.01, "{found:?}");
    assert!(consistency_p(&harmonics, 3).unwrap() <= 0.03, "{:?}", consistency_p(&harmonics, 3));
    assert_eq!(consistency_p(&harmonics[..1], 3), None);
    assert_eq!(Template::fit(&[]), None);
}

#[test]
fn following_four_songs_is_no_chance() {
    let tempi = [1.6, 1.9, 2.2, 1.6];
    let songs: Vec<CouplingSums> = tempi
        .iter()
        .enumerate()
        .map(|(i, &bar_s)| {
            let song = song(600, bar_s, 0.17 * i as f64);
            // A fifth of the coupling, under twenty times as much of something else.
            let rise: Vec<f64> = song
                .rise(bar_s, 0.0)
                .iter()
                .enumerate()
                .map(|(t, v)| 0.2 * v + (7.3 * t as f64 + i as f64).sin())
                .collect();
            sums(&Coupling::Constructed, &[song.passage(&rise)])
        })
        .collect();
    assert!(rotation_p(&songs, 5) <= Some(0.005), "{:?}", rotation_p(&songs, 5));
    assert_eq!(rotation_p(&[], 5), None);
}

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
            let song = song(N_FRAMES, bar_s, draws.uniform());
            let phase: Vec<f64> = song.bars.iter().map(|x| x.fract()).collect();
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
                sums.add(&Coupling::Constructed, &song.passage(&motion));
                harmonics.add(&song.passage(&motion));
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
