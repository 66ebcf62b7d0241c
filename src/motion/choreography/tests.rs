//! What the dance owes to the music, measured on songs whose beats and loudness are known.

use super::accent::LEVER_ARM_M;
use super::floor::HALF_FLOOR_M;
use super::selection::RATES;
use super::*;
use crate::motion::locking::bar_locking;
use crate::motion::phase::bar_phase_at_tempo;
use crate::motion::quaternion::{
    angular_velocity, from_axis_angle, make_sign_continuous, mul, normalize,
};
use crate::motion::trajectory::{ChannelLimits, Trajectory};
use crate::motion::vector::norm;
use crate::units::FPS;
use std::f64::consts::TAU;

/// A capture of somebody who steps and sways: twice as `lively` is twice as far in the same time.
fn capture(lively: f64, step_frames: f64, n_frames: usize) -> Trajectory {
    let mut poses = Poses::default();
    let (mut x, mut z) = (1.0, 2.0);
    for t in 0..n_frames + 2 {
        let cycle = TAU * t as f64 / step_frames;
        let yaw = 0.8 * lively * (cycle / 3.1).sin();
        let lean = from_axis_angle([1.0, 0.0, 0.0], 0.1 * lively * (cycle / 2.0).cos());
        poses.position_m.push([x, 0.9 + 0.03 * lively * (1.3 * cycle).sin(), z]);
        poses.orientation.push(mul(from_axis_angle(primitive::UP, yaw), lean));
        let speed = lively * (0.55 - 0.45 * cycle.cos());
        x += speed * yaw.sin() / FPS;
        z += speed * yaw.cos() / FPS;
    }
    make_sign_continuous(&mut poses.orientation);
    Trajectory::new(frames_of(&poses, n_frames)).unwrap()
}

pub(super) fn repertoire() -> Repertoire {
    let mut repertoire = Repertoire::new();
    for (lively, step_frames) in [
        (0.15, 40.0),
        (0.3, 31.0),
        (0.5, 22.0),
        (0.7, 27.0),
        (0.9, 18.0),
        (1.2, 24.0),
        (1.6, 33.0),
        (2.0, 20.0),
    ] {
        repertoire.add(&capture(lively, step_frames, 300)).unwrap();
    }
    repertoire
}

/// A song of steady beats whose loudness swells and falls every 12 s.
pub(super) struct SteadySong {
    pub(super) beats: Beats,
    rms: Vec<f32>,
    onset_strength: Vec<f32>,
    pub(super) times_s: Vec<f64>,
}

impl SteadySong {
    pub(super) fn new(tempo_bpm: f64, beats_per_bar: u32, duration_s: f64) -> Self {
        let n_beats = (duration_s * tempo_bpm / 60.0) as usize;
        let beat_s = |i: usize| 0.31 + i as f64 * 60.0 / tempo_bpm;
        let beats = Beats::new((0..n_beats).map(beat_s).collect(), None, Some(beats_per_bar));
        let times_s: Vec<f64> = (0..(duration_s * FPS) as usize).map(frames_to_s).collect();
        let swell = |t: &f64| (0.5 - 0.45 * (TAU * t / 12.0).cos()) as f32;
        let struck = |t: &f64| {
            let beat = (t - 0.31) * tempo_bpm / 60.0;
            swell(t) * if (beat - beat.round()).abs() < 0.1 { 1.0 } else { 0.1 }
        };
        Self {
            beats: beats.unwrap(),
            rms: times_s.iter().map(swell).collect(),
            onset_strength: times_s.iter().map(struck).collect(),
            times_s,
        }
    }

    pub(super) fn song(&self) -> Song<'_> {
        Song::new(&self.beats, &self.rms, &self.onset_strength).unwrap()
    }
}

pub(super) fn column(frames: &Array2<f32>, i: usize) -> Vec<f64> {
    frames.column(i).iter().map(|&x| f64::from(x)).collect()
}

fn vectors(frames: &Array2<f32>, channel: Channel) -> Vec<[f64; 3]> {
    let first = channel.range().start;
    let row = |r: ndarray::ArrayView1<'_, f32>| std::array::from_fn(|i| f64::from(r[first + i]));
    frames.rows().into_iter().map(row).collect()
}

fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let mean = |x: &[f64]| x.iter().sum::<f64>() / x.len() as f64;
    let (ma, mb) = (mean(a), mean(b));
    let sum = |f: &dyn Fn(f64, f64) -> f64| -> f64 {
        a.iter().zip(b).map(|(a, b)| f(a - ma, b - mb)).sum()
    };
    sum(&|a, b| a * b) / (sum(&|a, _| a * a) * sum(&|_, b| b * b)).sqrt()
}

/// The songs of these tests: tempo and beats in a bar.
pub(super) const SONGS: [(f64, u32); 5] =
    [(93.7, 4), (141.3, 3), (171.0, 4), (67.3, 4), (118.9, 3)];

#[test]
fn vertical_velocity_is_locked_to_the_bar_and_to_no_other_tempo() {
    let repertoire = repertoire();
    for (tempo_bpm, beats_per_bar) in SONGS {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 60.0);
        let dance = choreograph(&music.song(), &repertoire, 11);
        let velocity_y = column(&dance.frames, 4);
        let locked = bar_locking(&velocity_y, &column(&dance.frames, 16));
        // Ratios between simple ones, whose harmonics would meet those of the bar.
        let mut wrong: Vec<f64> = (0..60)
            .map(|k| tempo_bpm * (0.617 + 0.0131 * f64::from(k)))
            .filter(|bpm| (bpm / tempo_bpm - 1.0).abs() > 0.04)
            .map(|bpm| {
                let phase = bar_phase_at_tempo(&music.times_s, bpm, 0.31, beats_per_bar);
                bar_locking(&velocity_y, &phase)
            })
            .collect();
        wrong.sort_by(f64::total_cmp);
        let median = wrong[wrong.len() / 2];
        assert!(locked > 0.6, "{tempo_bpm}: {locked}");
        assert!(median < 0.03, "{tempo_bpm}: {median}");
    }
}

#[test]
fn energy_follows_the_activity_of_the_song() {
    let repertoire = repertoire();
    for (tempo_bpm, beats_per_bar) in SONGS {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 60.0);
        let song = music.song();
        let dance = choreograph(&song, &repertoire, 3);
        let energy = accent::energy(
            &vectors(&dance.frames, Channel::Velocity),
            &vectors(&dance.frames, Channel::AngularVelocity),
        );
        let window = crate::motion::style::Window::hann(60);
        let found = correlation(&window.mean(&energy), song.activity());
        assert!(found > 0.7, "{tempo_bpm}: {found}");
    }
}

#[test]
fn steps_follow_each_other_on_beats_at_allowed_rates() {
    let repertoire = repertoire();
    for (tempo_bpm, beats_per_bar) in SONGS {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 30.0);
        let song = music.song();
        let dance = choreograph(&song, &repertoire, 0);
        let grid = song.grid();
        let mut beat = 0;
        for step in &dance.steps {
            assert_eq!(step.beat, beat);
            beat += step.n_beats;
            assert_eq!(step.start_s, grid.beats()[step.beat].time_s);
            assert_eq!(step.end_s, grid.beats()[beat].time_s);
            let primitive = &repertoire.primitives()[step.primitive.expect("no rest is needed")];
            assert!(RATES.contains(&step.rate), "{step:?}");
            let danced_s = primitive.duration_s / step.rate;
            assert!((danced_s - (step.end_s - step.start_s)).abs() < 1e-9, "{step:?}");
        }
        assert_eq!(beat + 1, grid.beats().len());
        let mut at_s = dance.steps[0].start_s;
        for turn in &dance.turns {
            assert_eq!(turn.phrase.start_s, at_s);
            at_s = turn.phrase.end_s;
        }
        let repeats = dance.steps.windows(2).filter(|s| s[0].primitive == s[1].primitive).count();
        assert_eq!(repeats, 0);
    }
}

#[test]
fn accents_fall_on_beats() {
    let music = SteadySong::new(104.0, 4, 60.0);
    let dance = choreograph(&music.song(), &repertoire(), 2);
    // The bar's rise and fall is no part of an accent.
    let effort: Vec<f64> = vectors(&dance.frames, Channel::Velocity)
        .iter()
        .zip(vectors(&dance.frames, Channel::AngularVelocity))
        .map(|(v, w)| v[0].hypot(v[2]) + LEVER_ARM_M * norm(w))
        .collect();
    let mean = effort.iter().sum::<f64>() / effort.len() as f64;
    let ends: Vec<f64> = dance
        .steps
        .iter()
        .filter_map(|step| effort.get((step.end_s * FPS).round() as usize))
        .copied()
        .collect();
    let at_ends = ends.iter().sum::<f64>() / ends.len() as f64;
    // A turn of the phrase goes on over beats.
    assert!(at_ends < 0.7 * mean, "{at_ends} of {mean}");
}

#[test]
fn every_frame_obeys_the_identities_and_moves_as_people_do() {
    let repertoire = repertoire();
    for (tempo_bpm, beats_per_bar) in SONGS {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 40.0);
        let dance = choreograph(&music.song(), &repertoire, 9).frames;
        check_identities(&dance, &music);
        let is_on_floor =
            |i: usize| dance.column(i).iter().all(|x| f64::from(x.abs()) < HALF_FLOOR_M);
        assert!(is_on_floor(0) && is_on_floor(2), "{tempo_bpm}");
        let acceleration = vectors(&dance, Channel::Acceleration);
        let jerk = forward_differences(&acceleration);
        let mean = jerk.iter().copied().map(norm).sum::<f64>() / jerk.len() as f64;
        // The range of 64 real captures.
        assert!((5.0..=404.0).contains(&mean), "{tempo_bpm}: {mean}");
    }
}

/// Asserts that a dance keeps to the limits, that its derivatives are those of its poses, and its phase the music's.
pub(super) fn check_identities(dance: &Array2<f32>, music: &SteadySong) {
    Trajectory::new(dance.clone()).unwrap().check(&ChannelLimits::Wide).unwrap();
    let x = dance.mapv(f64::from);
    for t in 0..x.nrows() - 1 {
        for i in 0..6 {
            let derived = (x[[t + 1, i]] - x[[t, i]]) * FPS;
            let size = (x[[t, i]].abs() + x[[t + 1, i]].abs()) * FPS + derived.abs();
            // Three roundings to f32, two of them times 30.
            let tolerance = f64::from(f32::EPSILON) * size + 1e-9;
            assert!((x[[t, i + 3]] - derived).abs() <= tolerance, "{i} at {t}");
        }
        let q = |t: usize| normalize(std::array::from_fn(|c| x[[t, 9 + c]]));
        let omega = angular_velocity(q(t), q(t + 1), FPS);
        for axis in 0..3 {
            // Rounding of quaternions (3e-8 each) times 2 · 30.
            assert!((x[[t, 13 + axis]] - omega[axis]).abs() < 2e-5, "{axis} at {t}");
        }
    }
    let phase = bar_phase(&music.times_s, &music.beats);
    assert!(phase.iter().zip(dance.column(16)).all(|(p, &x)| *p as f32 == x));
}

#[test]
fn a_dance_is_the_same_for_one_seed_and_another_for_the_next() {
    let (music, repertoire) = (SteadySong::new(120.5, 4, 20.0), repertoire());
    let song = music.song();
    let dance = |seed| choreograph(&song, &repertoire, seed);
    assert_eq!(dance(1), dance(1));
    assert_ne!(dance(1).steps, dance(2).steps);
    assert_ne!(dance(1).turns, dance(2).turns);
}

#[test]
fn phrases_begin_over_the_origin_and_face_forward() {
    let music = SteadySong::new(120.5, 4, 20.0);
    let dance = choreograph(&music.song(), &repertoire(), 1).frames;
    assert_eq!(dance.nrows(), 600);
    let starts: Vec<usize> = (0..n_phrases(600, 120, 60)).map(|k| 60 * k).collect();
    assert_eq!(starts, [0, 60, 120, 180, 240, 300, 360, 420, 480]);
    for first in starts {
        let part = phrase(dance.view(), first, 120);
        assert_eq!(part.dim(), (120, 25));
        let q: [f32; 4] = std::array::from_fn(|c| part[[0, 9 + c]]);
        assert!(part[[0, 0]].abs() < 1e-6 && part[[0, 2]].abs() < 1e-6);
        assert!(q[0] >= 0.0 && q[2].abs() < 1e-6, "{q:?}");
        // What does not depend on where and which way is the song's own.
        for i in [1, 4, 7, 14, 16, 17, 24] {
            assert_eq!(part.column(i), dance.slice(s![first..first + 120, i]), "{i}");
        }
        let speed = |x: &Array2<f32>, t: usize| x[[t, 3]].hypot(x[[t, 5]]);
        for t in 0..120 {
            let (here, there) = (speed(&part, t), speed(&dance, first + t));
            assert!((here - there).abs() < 1e-5, "{t}: {here} for {there}");
        }
    }
    assert_eq!((n_phrases(119, 120, 60), n_phrases(120, 120, 60)), (0, 1));
    assert_eq!((n_phrases(239, 120, 60), n_phrases(240, 120, 60)), (2, 3));
}

#[test]
fn without_a_fitting_primitive_the_body_rests() {
    let music = SteadySong::new(100.0, 4, 10.0);
    let dance = choreograph(&music.song(), &Repertoire::new(), 5);
    assert!(dance.steps.iter().all(|step| step.primitive.is_none() && step.n_beats == 1));
    let x = &dance.frames;
    assert!(x.column(0).iter().chain(x.column(2)).all(|&x| x == 0.0));
    let locked = bar_locking(&column(x, 4), &column(x, 16));
    // Only the amplitude changes, with the activity.
    assert!(locked > 0.8, "{locked}");
}

#[test]
fn songs_that_cannot_be_danced_to_say_why() {
    let refused = |times_s: &[f64], n_frames: usize| {
        let beats = Beats::new(times_s.to_vec(), None, None).unwrap();
        let curve = vec![0.5; n_frames];
        Song::new(&beats, &curve, &curve).unwrap_err().to_string()
    };
    assert_eq!(refused(&[0.5, 1.0], 0), "song has no frames of features; extract it again");
    assert_eq!(
        refused(&[1.0, 3.0, 4.0], 60),
        "song has 1 beats within its 2.0 s, and a dance needs at least 2; write its beats, one time \
         in seconds per line, into a .beats.txt file beside it"
    );
    assert_eq!(
        refused(&[0.1, 0.2, 0.3], 60),
        "song has 600.0 beats/min, and 20 to 320 are danced to; correct its .beats.txt file"
    );
}
