//! What the dance does on the floor as a whole: turns with the phrase, rises and falls with the bar,
//! and stays on its floor.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use super::primitive::UP;
use super::selection::DancePhrase;
use crate::chance::Chance;
use crate::motion::kinematics::Poses;
use crate::motion::quaternion::{from_axis_angle, make_sign_continuous, mul, rotate};
use crate::units::frames_to_s;

/// Half the side of the square that the dance never leaves, m.
pub const HALF_FLOOR_M: f64 = 3.5;
/// From here on, what moves outwards is slowed down, m from the middle.
const SLOWED_FROM_M: f64 = 2.4;
/// Here nothing moves outwards any more, m from the middle.
const STOPPED_AT_M: f64 = 3.4;
/// Turns over a short phrase and over a long one, rad.
const SHORT_TURNS: [f64; 2] = [FRAC_PI_2, -FRAC_PI_2];
const LONG_TURNS: [f64; 4] = [FRAC_PI_2, -FRAC_PI_2, PI, -PI];
/// Turns that are tried where those of the phrase would leave the inner floor.
const OTHER_TURNS: [f64; 5] = [0.0, FRAC_PI_2, -FRAC_PI_2, PI, -PI];
/// A phrase from this length on is long, s.
const LONG_PHRASE_S: f64 = 3.0;
/// Least time for a turn, s per rad: a half turn takes 2 s, so it peaks at 3 rad/s.
const MIN_TURN_S_PER_RAD: f64 = 2.0 / PI;

/// Height of the root at rest, m.
pub const ROOT_HEIGHT_M: f64 = 0.95;
/// Share of the captures' own rise and fall that is kept.
pub const KEPT_HEIGHT: f64 = 0.2;
/// Amplitude of the first and the second harmonic of the bar and of its beats, m, at activity 0.5.
const RISE_M: [f64; 3] = [0.03, 0.02, 0.012];
/// Above this frequency an amplitude falls with the square of the frequency, so that no fast song asks
/// for more acceleration than this one; Hz.
const FULL_RISE_HZ: f64 = 2.0;
/// Harmonics above this frequency are left out, Hz.
const MAX_RISE_HZ: f64 = 6.0;

/// Where each phrase turns and how far.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Turn {
    pub phrase: DancePhrase,
    pub angle_rad: f64,
}

/// Turns a path with its phrases and keeps it within a square of 7 m; returns the turns.
///
/// Steps of the path turn by the heading `ψ(t)`: `p[t+1] = p[t] + R(ψ[t]) d[t]`. Within a phrase `ψ`
/// grows by a quarter turn (in a long phrase a quarter or a half turn) to either side, as
/// `10u³ - 15u⁴ + 6u⁵`. Which, is chance among those that stay within 2.4 m of the middle; where none
/// does, whichever strays least. Beyond 2.4 m what still moves outwards is slowed smoothly, to nothing
/// at 3.4 m.
pub fn wander(path: &mut Poses, phrases: &[DancePhrase], chance: &mut Chance) -> Vec<Turn> {
    let n_frames = path.len();
    let Some(&first) = path.position_m.first() else { return Vec::new() };
    let steps: Vec<[f64; 3]> = path
        .position_m
        .windows(2)
        .map(|p| std::array::from_fn(|axis| p[1][axis] - p[0][axis]))
        .collect();
    let mut position = [0.0, first[1], 0.0];
    let mut heading_rad = (chance.uniform() - 0.5) * TAU;
    let mut turns = Vec::new();
    let mut frame = 0;
    for (k, &phrase) in phrases.iter().enumerate() {
        let is_last = k + 1 == phrases.len();
        let within = |t: usize| t < n_frames && (is_last || frames_to_s(t) < phrase.end_s);
        let n = (frame..).take_while(|&t| within(t)).count();
        let from = Stretch { frame, n, position, heading_rad, phrase };
        let chosen = choose_turn(&from, &steps, chance);
        let angle_rad = chosen.angle_rad;
        for (i, p) in chosen.positions.iter().enumerate() {
            let turn = from_axis_angle(UP, from.heading(i, angle_rad));
            let height = path.position_m[frame + i][1];
            path.position_m[frame + i] = [p[0], height, p[2]];
            path.orientation[frame + i] = mul(turn, path.orientation[frame + i]);
        }
        position = chosen.next;
        heading_rad += angle_rad;
        frame += n;
        turns.push(Turn { phrase, angle_rad });
    }
    make_sign_continuous(&mut path.orientation);
    turns
}

/// The frames of a phrase, from where and as the dance comes into it.
struct Stretch {
    frame: usize,
    n: usize,
    position: [f64; 3],
    heading_rad: f64,
    phrase: DancePhrase,
}

impl Stretch {
    fn heading(&self, i: usize, angle_rad: f64) -> f64 {
        let DancePhrase { start_s, end_s } = self.phrase;
        let u = ((frames_to_s(self.frame + i) - start_s) / (end_s - start_s)).clamp(0.0, 1.0);
        self.heading_rad + angle_rad * u * u * u * (10.0 + u * (6.0 * u - 15.0))
    }
}

/// A phrase danced with one turn.
struct TurnedPhrase {
    angle_rad: f64,
    positions: Vec<[f64; 3]>,
    /// Where the next phrase begins.
    next: [f64; 3],
    /// Largest distance from the middle along either axis, m.
    strays_m: f64,
}

fn choose_turn(from: &Stretch, steps: &[[f64; 3]], chance: &mut Chance) -> TurnedPhrase {
    let duration_s = from.phrase.end_s - from.phrase.start_s;
    let mut wanted =
        if duration_s >= LONG_PHRASE_S { LONG_TURNS.to_vec() } else { SHORT_TURNS.to_vec() };
    let mut others = OTHER_TURNS.to_vec();
    chance.shuffle(&mut wanted);
    chance.shuffle(&mut others);
    let in_time = |angle_rad: &f64| angle_rad.abs() * MIN_TURN_S_PER_RAD <= duration_s;
    let mut best: Option<TurnedPhrase> = None;
    for angle_rad in wanted.into_iter().chain(others).filter(in_time) {
        let danced = dance(from, steps, angle_rad);
        if danced.strays_m <= SLOWED_FROM_M {
            return danced;
        }
        if best.as_ref().is_none_or(|best| danced.strays_m < best.strays_m) {
            best = Some(danced);
        }
    }
    best.unwrap_or_else(|| dance(from, steps, 0.0))
}

fn dance(from: &Stretch, steps: &[[f64; 3]], angle_rad: f64) -> TurnedPhrase {
    let mut position = from.position;
    let mut positions = Vec::with_capacity(from.n);
    let mut strays_m = 0.0_f64;
    for i in 0..from.n {
        positions.push(position);
        strays_m = strays_m.max(position[0].abs()).max(position[2].abs());
        let Some(&step) = steps.get(from.frame + i) else { continue };
        let step = rotate(from_axis_angle(UP, from.heading(i, angle_rad)), step);
        for axis in [0, 2] {
            position[axis] += step[axis] * freedom(position[axis], step[axis]);
        }
    }
    TurnedPhrase { angle_rad, positions, next: position, strays_m }
}

/// Returns the share of a step that is made: 1 inwards and near the middle, 0 outwards at the edge.
fn freedom(position_m: f64, step_m: f64) -> f64 {
    if position_m * step_m <= 0.0 {
        return 1.0;
    }
    let u = (position_m.abs() - SLOWED_FROM_M) / (STOPPED_AT_M - SLOWED_FROM_M);
    let u = u.clamp(0.0, 1.0);
    1.0 - u * u * (3.0 - 2.0 * u)
}

/// Returns the height above rest that the bar asks for, m.
///
/// `h(φ, a) = -(0.5 + a) Σₖ Aₖ g(hₖ/T) cos 2πhₖφ` with `A` = 3, 2 and 1.2 cm at the harmonics 1, 2 and
/// 4 of the bar (3 for bars of up to three beats), `a` the activity, and `g(f) = min(1, (2 Hz / f)²)`,
/// 0 above 6 Hz; `T` is the length of a bar. So every downbeat is low.
pub fn rise_m(phase: f64, activity: f64, bar_s: f64, beats_per_bar: u32) -> f64 {
    let wave = |(harmonic, amplitude_m): (f64, f64)| amplitude_m * (TAU * harmonic * phase).cos();
    let waves = rise_amplitudes_m(bar_s, beats_per_bar).into_iter().map(wave);
    -(0.5 + activity) * waves.sum::<f64>()
}

/// Returns the harmonics of the bar that [`rise_m`] has, and the amplitude `A g(n / T)` of each, m.
pub fn rise_amplitudes_m(bar_s: f64, beats_per_bar: u32) -> [(f64, f64); 3] {
    let harmonics = [1.0, 2.0, f64::from(beats_per_bar.clamp(3, 4))];
    std::array::from_fn(|i| {
        let frequency_hz = harmonics[i] / bar_s;
        let gain = if frequency_hz > MAX_RISE_HZ {
            0.0
        } else {
            (FULL_RISE_HZ / frequency_hz).powi(2).min(1.0)
        };
        (harmonics[i], RISE_M[i] * gain)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::IDENTITY;
    use crate::units::FPS;

    fn straight(n: usize, speed_m_s: f64) -> Poses {
        let position_m = (0..n).map(|t| [0.0, 0.1, speed_m_s * t as f64 / FPS]).collect();
        Poses { position_m, orientation: vec![IDENTITY; n] }
    }

    fn phrases(n: usize, length_s: f64) -> Vec<DancePhrase> {
        let phrase = |k: usize| {
            let start_s = k as f64 * length_s;
            DancePhrase { start_s, end_s: start_s + length_s }
        };
        (0..n).map(phrase).collect()
    }

    #[test]
    fn a_runner_stays_on_the_floor() {
        for seed in 0..20 {
            let mut path = straight(1800, 4.0);
            wander(&mut path, &phrases(25, 2.4), &mut Chance::new(seed, 0));
            let furthest = path.position_m.iter().flat_map(|p| [p[0].abs(), p[2].abs()]);
            let furthest = furthest.fold(0.0, f64::max);
            assert!(furthest > 2.0 && furthest <= STOPPED_AT_M, "{seed}: {furthest}");
            for p in path.position_m.windows(2) {
                let step = (p[1][0] - p[0][0]).hypot(p[1][2] - p[0][2]);
                assert!(step <= 4.0 / FPS + 1e-9, "{seed}: {step}");
            }
        }
    }

    #[test]
    fn a_stroller_turns_by_quarters_and_halves_with_each_phrase() {
        let mut path = straight(900, 0.2);
        let turns = wander(&mut path, &phrases(8, 4.0), &mut Chance::new(5, 0));
        assert_eq!(turns.len(), 8);
        let heading = |t: usize| {
            let q = path.orientation[t];
            2.0 * q[2].atan2(q[0])
        };
        for (k, turn) in turns.iter().enumerate().take(7) {
            assert!(LONG_TURNS.contains(&turn.angle_rad), "{turn:?}");
            // 120 frames a phrase; whole rounds do not show in a quaternion.
            let found = heading(120 * (k + 1)) - heading(120 * k) - turn.angle_rad;
            assert!((found / TAU - (found / TAU).round()).abs() < 1e-9, "{k}: {found}");
        }
        // It walks where it faces: 0.2 m/s along its heading.
        for t in 0..898 {
            let (a, b) = (path.position_m[t], path.position_m[t + 1]);
            let ahead = (b[0] - a[0]) * heading(t).sin() + (b[2] - a[2]) * heading(t).cos();
            assert!((ahead * FPS - 0.2).abs() < 1e-9, "{t}: {ahead}");
        }
    }

    #[test]
    fn short_phrases_have_no_time_for_half_turns() {
        let turns = wander(&mut straight(300, 0.1), &phrases(8, 1.2), &mut Chance::new(1, 0));
        assert!(turns.iter().all(|t| SHORT_TURNS.contains(&t.angle_rad)), "{turns:?}");
        let turns = wander(&mut straight(300, 0.1), &phrases(16, 0.7), &mut Chance::new(1, 0));
        assert!(turns.iter().all(|t| t.angle_rad == 0.0), "{turns:?}");
        assert!(wander(&mut Poses::default(), &[], &mut Chance::new(1, 0)).is_empty());
    }

    #[test]
    fn the_downbeat_is_low_and_louder_songs_rise_higher() {
        // Two seconds a bar: 0.5, 1 and 2 Hz, all in full.
        assert!((rise_m(0.0, 0.5, 2.0, 4) + 0.062).abs() < 1e-12);
        assert!((rise_m(0.5, 0.5, 2.0, 4) - (0.03 - 0.02 - 0.012)).abs() < 1e-12);
        assert!((rise_m(0.0, 1.0, 2.0, 4) / rise_m(0.0, 0.0, 2.0, 4) - 3.0).abs() < 1e-12);
        // One second a bar of three: the beats at 3 Hz have (2/3)² of their amplitude.
        assert!((rise_m(0.0, 0.5, 1.0, 3) + 0.05 + 0.012 * 4.0 / 9.0).abs() < 1e-12);
        // A fifth of a second a bar: 5 Hz is left, at (2/5)²; 10 and 15 Hz are not.
        assert!((rise_m(0.0, 0.5, 0.2, 1) + 0.03 * 0.16).abs() < 1e-12);
    }
}
