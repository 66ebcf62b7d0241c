//! Beats of motion, and how near they are to the beats of music.
//!
//! A beat score alone says little: it rises with the number of beats on either side. Each is given with
//! what chance reaches, from the same beats of motion shifted round the clip.

use crate::motion::Poses;
use crate::motion::kinematics::forward_differences;
use crate::units::frames_to_s;

use super::body::{BODY_RADIUS_M, turn_rates};
use super::interval::mean_and_deviation;
use crate::chance::Draws;
use crate::motion::vector::norm;

/// Frames on either side that a beat of motion is slower than; as in GCD at 30 fps.
pub const MINIMUM_ORDER_FRAMES: usize = 5;

/// Widths σ of the published scores, s: AIST++ and Bailando; GCD; Lodge and POPDG at 30 fps.
pub const WIDTHS_S: [f64; 3] = [0.05, 0.0707, 0.1];

/// Shifts that tell what chance reaches.
pub const N_SHIFTS: usize = 200;

/// Scores over shifts that spread less than this do not spread.
const MIN_DEVIATION: f64 = 1e-9;

/// Returns the speed of a body frame by frame, m/s, 0 at the first.
///
/// `e[t] = √(|Δp/Δt|² + (ρ |ω|)²)`, differences from frame t - 1 to t as in AIST++, ρ = 0.25 m. The zero
/// keeps the first five frames from being beats, as it does there.
pub fn speed_envelope(poses: &Poses) -> Vec<f64> {
    let n = poses.len();
    let velocity = forward_differences(&poses.position_m[..n]);
    let turns = turn_rates(&poses.orientation[..n]);
    let speeds =
        velocity.into_iter().zip(turns).map(|(v, w)| norm(v).hypot(BODY_RADIUS_M * norm(w)));
    (n > 0).then_some(0.0).into_iter().chain(speeds).collect()
}

/// Returns the frames that are slower than each of `order` on either side.
///
/// Beyond the ends the end itself counts, so no end is a minimum: `scipy.signal.argrelextrema(x, np.less,
/// order=order)`.
pub fn minima(x: &[f64], order: usize) -> Vec<usize> {
    let last = x.len().saturating_sub(1);
    let is_minimum = |t: usize| {
        (1..=order).all(|s| x[t] < x[t.saturating_sub(s)] && x[t] < x[(t + s).min(last)])
    };
    (0..x.len()).filter(|&t| is_minimum(t)).collect()
}

/// Returns the frames at which a body is slowest.
pub fn motion_beats(poses: &Poses) -> Vec<usize> {
    minima(&speed_envelope(poses), MINIMUM_ORDER_FRAMES)
}

/// A beat score of one width.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BeatScore {
    /// σ, s.
    pub width_s: f64,
    /// In [0, 1].
    pub score: f64,
    /// Mean of the score over shifts of the motion.
    pub chance: f64,
    /// `(score - chance) / (1 - chance)`.
    pub lift: Option<f64>,
    /// `(score - chance) / s`, s its standard deviation over shifts.
    pub z: Option<f64>,
}

/// Beat scores of both directions, by width.
#[derive(Clone, Debug, PartialEq)]
pub struct BeatAlignment {
    pub n_motion_beats: usize,
    /// Those within the motion.
    pub n_music_beats: usize,
    /// BAS_m, how near each beat of motion is to music (AIST++, POPDG, GCD).
    pub motion_to_music: [BeatScore; WIDTHS_S.len()],
    /// BAS_a, how near each beat of music is to motion (Bailando, Lodge).
    pub music_to_motion: [BeatScore; WIDTHS_S.len()],
}

/// Scores how near beats of motion (frames) and of music (s) are, in a motion of `n_frames`.
///
/// `BAS_m = mean over t of exp(-min over u (t - u)² / 2σ²)`, t the beats of motion and u those of music;
/// BAS_a with both exchanged. Chance: the beats of motion moved on by one time in each of [`N_SHIFTS`]
/// equal parts of the motion, drawn in it, those that leave at the end coming in at the beginning.
/// None where the motion has no beat, or the music none within it.
pub fn beat_alignment(
    motion_beats: &[usize],
    music_beats_s: &[f64],
    n_frames: usize,
    seed: u64,
) -> Option<BeatAlignment> {
    let duration_s = frames_to_s(n_frames);
    let inside = |t: &f64| (0.0..duration_s).contains(t);
    let motion: Vec<f64> =
        motion_beats.iter().map(|&t| frames_to_s(t)).filter(|t| inside(t)).collect();
    let mut music: Vec<f64> = music_beats_s.iter().copied().filter(inside).collect();
    if motion.is_empty() || music.is_empty() {
        return None;
    }
    music.sort_unstable_by(f64::total_cmp);
    let mut draws = Draws::new(seed);
    // The first is the motion as it is.
    let mut scores: [Vec<[f64; 2]>; WIDTHS_S.len()] = Default::default();
    for i in 0..=N_SHIFTS {
        let shift_s = match i {
            0 => 0.0,
            _ => duration_s * ((i - 1) as f64 + draws.uniform()) / N_SHIFTS as f64,
        };
        let mut moved: Vec<f64> =
            motion.iter().map(|t| (t + shift_s).rem_euclid(duration_s)).collect();
        moved.sort_unstable_by(f64::total_cmp);
        let (to_music, to_motion) = (distances(&moved, &music), distances(&music, &moved));
        for (of, width_s) in scores.iter_mut().zip(WIDTHS_S) {
            of.push([closeness(&to_music, width_s), closeness(&to_motion, width_s)]);
        }
    }
    let score = |width: usize, direction: usize| {
        let pairs = &scores[width];
        let shifted: Vec<f64> = pairs[1..].iter().map(|pair| pair[direction]).collect();
        BeatScore::against_chance(WIDTHS_S[width], pairs[0][direction], &shifted)
    };
    Some(BeatAlignment {
        n_motion_beats: motion.len(),
        n_music_beats: music.len(),
        motion_to_music: std::array::from_fn(|width| score(width, 0)),
        music_to_motion: std::array::from_fn(|width| score(width, 1)),
    })
}

impl BeatScore {
    fn against_chance(width_s: f64, score: f64, shifted: &[f64]) -> Self {
        let (chance, deviation) = mean_and_deviation(shifted).unwrap_or((score, 0.0));
        let above = score - chance;
        Self {
            width_s,
            score,
            chance,
            lift: (1.0 - chance > MIN_DEVIATION).then(|| above / (1.0 - chance)),
            z: (deviation > MIN_DEVIATION).then(|| above / deviation),
        }
    }
}

/// Distance of each time from the nearest of sorted others, of which there is one.
fn distances(times: &[f64], others: &[f64]) -> Vec<f64> {
    let nearest = |&t: &f64| {
        let i = others.partition_point(|&u| u < t);
        let after = others.get(i).map_or(f64::INFINITY, |u| u - t);
        let before = i.checked_sub(1).map_or(f64::INFINITY, |i| t - others[i]);
        after.min(before)
    };
    times.iter().map(nearest).collect()
}

fn closeness(distances: &[f64], width_s: f64) -> f64 {
    let near = |d: &f64| (-d * d / (2.0 * width_s * width_s)).exp();
    distances.iter().map(near).sum::<f64>() / distances.len() as f64
}

/// Returns Rayleigh's `R = |mean exp(2πi B φ)|` over beats of motion, φ the bar phase of every frame and B
/// the beats in a bar.
///
/// 1 where motion keeps one place between the beats, whichever, and about `√(π / 4n)` by chance with n
/// beats. None without beats, where one has no phase, or a phase is not finite.
pub fn rayleigh(phase: &[f64], motion_beats: &[usize], beats_per_bar: u32) -> Option<f64> {
    let at: Option<Vec<f64>> = motion_beats.iter().map(|&t| phase.get(t).copied()).collect();
    resultant(at?.into_iter().map(|phase| f64::from(beats_per_bar) * phase))
}

/// Returns `|mean exp(2πi h (φ - φ̂))|` over frames, φ and φ̂ two phases: 1 where they run at one tempo,
/// whatever lies between them. Harmonic h = 1 is of bars, the number of beats in a bar of beats.
///
/// None without frames, or where a phase is not finite.
pub fn phase_coherence(said: &[f64], music: &[f64], harmonic: u32) -> Option<f64> {
    resultant(said.iter().zip(music).map(|(a, b)| f64::from(harmonic) * (a - b)))
}

/// Returns the mean of `|φ - φ̂|` over frames, the shorter way round the bar, in bars: 0 to 1/2, by chance
/// 1/4.
///
/// None without frames, or where a phase is not finite.
pub fn phase_error(said: &[f64], music: &[f64]) -> Option<f64> {
    let n = said.len().min(music.len());
    let wrapped = |(a, b): (&f64, &f64)| ((a - b) - (a - b).round()).abs();
    let mean = said.iter().zip(music).map(wrapped).sum::<f64>() / n as f64;
    mean.is_finite().then_some(mean)
}

/// Length of the mean of `exp(2πi x)`.
fn resultant(turns: impl Iterator<Item = f64>) -> Option<f64> {
    let (mut n, mut cosines, mut sines) = (0_u32, 0.0, 0.0);
    for x in turns {
        let (sine, cosine) = (std::f64::consts::TAU * x).sin_cos();
        n += 1;
        cosines += cosine;
        sines += sine;
    }
    let r = f64::hypot(cosines, sines) / f64::from(n);
    r.is_finite().then_some(r)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::IDENTITY;
    use crate::units::FPS;

    /// Stands still for a moment every `period` frames, half-way between two of them.
    fn pulsing(n: usize, period: f64) -> Poses {
        let angle = |t: usize| std::f64::consts::TAU * (t as f64 - 0.5) / period;
        // Speed 1 - cos.
        let x = |t: usize| (t as f64 - period / std::f64::consts::TAU * angle(t).sin()) / FPS;
        Poses {
            position_m: (0..n).map(|t| [x(t), 0.0, 0.0]).collect(),
            orientation: vec![IDENTITY; n],
        }
    }

    #[test]
    fn minima_are_those_of_argrelextrema() {
        let x = [0.0, 5.0, 3.0, 4.0, 4.0, 1.0, 2.0, 6.0, 0.5];
        assert_eq!(minima(&x, 1), [2, 5]);
        assert_eq!(minima(&x, 2), [5]);
        assert_eq!(minima(&[2.0, 2.0, 2.0], 1), [0; 0]);
        assert_eq!(minima(&[], 3), [0; 0]);
        assert_eq!(minima(&[3.0, f64::NAN, 1.0, 2.0], 1), [0; 0]);
    }

    #[test]
    fn a_pulse_of_fifteen_frames_beats_every_fifteen() {
        // The slowest step is that which ends at frame 15 i + 1; the first is kept out by the zero.
        assert_eq!(motion_beats(&pulsing(121, 15.0)), [16, 31, 46, 61, 76, 91, 106]);
        assert_eq!(speed_envelope(&Poses::default()), [0.0; 0]);
    }

    #[test]
    fn motion_on_the_beat_scores_one_and_above_chance() {
        let motion: Vec<usize> = (1..8).map(|i| 15 * i).collect();
        let music: Vec<f64> = (1..8).map(|i| 0.5 * f64::from(i)).chain([-0.5, 4.0, 9.0]).collect();
        let found = beat_alignment(&motion, &music, 120, 7).expect("beats");
        assert_eq!((found.n_motion_beats, found.n_music_beats), (7, 7));
        for (score, width) in found.motion_to_music.iter().zip(WIDTHS_S) {
            assert_eq!((score.width_s, score.score), (width, 1.0));
            // Of a period P, a width σ covers σ √2π / P; one of eight places in the clip has no music.
            let expected = width * std::f64::consts::TAU.sqrt() / 0.5 * 7.0 / 8.0;
            assert!((score.chance - expected).abs() < 0.03, "{score:?}, {expected}");
            assert!(score.lift == Some(1.0) && score.z > Some(1.0), "{score:?}");
        }
        assert_eq!(found, beat_alignment(&motion, &music, 120, 7).expect("beats"));
    }

    #[test]
    fn the_two_directions_differ() {
        // One beat of motion on one of two beats of music, which are half a second apart.
        let found = beat_alignment(&[30], &[1.0, 1.5], 77, 0).expect("beats");
        assert_eq!(found.motion_to_music[2].score, 1.0);
        let far = (-0.25_f64 / (2.0 * 0.1 * 0.1)).exp();
        assert!((found.music_to_motion[2].score - (1.0 + far) / 2.0).abs() < 1e-15);
    }

    #[test]
    fn without_beats_there_is_no_score() {
        assert_eq!(beat_alignment(&[], &[1.0], 90, 0), None);
        assert_eq!(beat_alignment(&[30], &[], 90, 0), None);
        assert_eq!(beat_alignment(&[30], &[3.0, f64::NAN, -1.0], 90, 0), None);
        assert_eq!(beat_alignment(&[30], &[1.0], 0, 0), None);
    }

    #[test]
    fn phases_are_compared_round_the_bar() {
        let error = phase_error(&[0.95, 0.5, 0.1], &[0.05, 0.5, 0.9]).expect("finite");
        assert!((error - 0.3 / 3.0).abs() < 1e-12);
        assert_eq!(phase_error(&[], &[]), None);
        assert_eq!(phase_error(&[f64::NAN], &[0.0]), None);
        let music: Vec<f64> = (0..97).map(|t| (f64::from(t) / 61.0).fract()).collect();
        let later: Vec<f64> = music.iter().map(|x| (x + 0.3).fract()).collect();
        let coherence = phase_coherence(&later, &music, 4).expect("finite");
        assert!((coherence - 1.0).abs() < 1e-12);
        assert_eq!(phase_coherence(&[f64::INFINITY], &[0.0], 1), None);
    }

    #[test]
    fn beats_at_one_place_of_the_bar_have_a_long_resultant() {
        let phase: Vec<f64> = (0..120).map(|t| (f64::from(t) / 60.0).fract()).collect();
        let steady = rayleigh(&phase, &[4, 19, 34, 64], 4).expect("beats");
        assert!((steady - 1.0).abs() < 1e-12);
        // Two beats half a beat apart cancel.
        let apart = rayleigh(&[0.0, 0.125], &[0, 1], 4).expect("beats");
        assert!(apart < 1e-15);
        assert_eq!(rayleigh(&phase, &[], 4), None);
        assert_eq!(rayleigh(&phase, &[120], 4), None);
    }
}
