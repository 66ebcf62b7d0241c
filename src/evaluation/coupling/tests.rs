use super::*;
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
    let coefficient_of = |rise: &[f64], rotation: f64| {
        sums(&Coupling::Constructed, &[song.passage(rise)]).coefficient(rotation).expect("moves")
    };
    // The construction and the coupling are one function, computed twice.
    assert!((coefficient_of(&rise, 0.0) - 1.0).abs() < 1e-9, "{}", coefficient_of(&rise, 0.0));
    let half: Vec<f64> = rise.iter().map(|v| 0.5 * v + 0.7).collect();
    assert!((coefficient_of(&half, 0.0) - 0.5).abs() < 1e-9);
    let upside_down: Vec<f64> = rise.iter().map(|v| -v).collect();
    assert!((coefficient_of(&upside_down, 0.0) + 1.0).abs() < 1e-9);
    // A beat late: far from 1 with the bar where it is, and 1 with the bar a beat late too.
    let late = song.rise(bar_s, -0.25);
    assert!(coefficient_of(&late, 0.0).abs() < 0.4, "{}", coefficient_of(&late, 0.0));
    // The norm is that of the bar where it is, so that a rotated coefficient is off by a few percent.
    assert!((coefficient_of(&late, -0.25) - 1.0).abs() < 0.05, "{}", coefficient_of(&late, -0.25));
    // Another tempo, and a body that stands.
    let other = self::song(601, 1.3, 0.3).rise(1.3, 0.0);
    assert!(coefficient_of(&other, 0.0).abs() < 0.2, "{}", coefficient_of(&other, 0.0));
    assert!(coefficient_of(&[0.0; 600], 0.0).abs() < 1e-12);
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
