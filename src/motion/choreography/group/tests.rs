//! What the dancers of a group owe to each other and to the music.

use ndarray::Array2;

use super::*;
use crate::motion::choreography::choreograph;
use crate::motion::choreography::tests::{SONGS, SteadySong, check_identities, column, repertoire};
use crate::motion::group::RADIUS_M;
use crate::motion::locking::bar_locking;
use crate::units::FPS;

fn rules(n_dancers: usize, seed: u64) -> GroupRules {
    GroupRules { n_dancers, min_span_s: 0.0, seed }
}

fn dancer(dance: &GroupDance, k: usize) -> Array2<f32> {
    dance.frames.index_axis(Axis(0), k).to_owned()
}

/// Velocity and angular velocity of dancer `k` in the frame of its place.
fn own(dance: &GroupDance, span: &GroupSpan, k: usize, t: usize) -> [f64; 6] {
    let back = from_axis_angle(UP, -span.places[k].yaw_rad);
    let at = |i: usize| f64::from(dance.frames[[k, t, i]]);
    let v = rotate(back, [at(3), at(4), at(5)]);
    let w = rotate(back, [at(13), at(14), at(15)]);
    [v[0], v[1], v[2], w[0], w[1], w[2]]
}

/// Frames of a span in which everybody stands at its place and dances this span's part alone, and
/// `n_before` frames before each as well.
fn settled(dance: &GroupDance, span: &GroupSpan, n_before: usize) -> std::ops::Range<usize> {
    // The leeway changes over half a second more, and a velocity needs two frames.
    let begin_s = span.arrival_s.max(span.start_s + HALF_CHANGE_S) + 1.1;
    let is_first = span.first_frame == 0;
    let begin = if is_first { 0 } else { (begin_s * FPS).ceil() as usize };
    let is_last = span.end_frame == dance.frames.len_of(Axis(1));
    let end = if is_last { span.end_frame } else { span.end_frame.saturating_sub(36) };
    begin + n_before..end.max(begin + n_before)
}

/// Calls `check` with every span of a kind in dances of several songs, sizes and seeds; returns how many
/// frames of such spans were settled.
fn visit(
    unison: Unison,
    sizes: &[usize],
    mut check: impl FnMut(&SteadySong, &GroupDance, &GroupSpan, std::ops::Range<usize>),
) -> usize {
    let repertoire = repertoire();
    let mut n_frames = 0;
    // Bars of whole frames: 60, 54 and 72.
    for (tempo_bpm, beats_per_bar) in [(120.0, 4), (100.0, 3), (100.0, 4)] {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 100.0);
        for (seed, &n) in sizes.iter().enumerate() {
            let dance = choreograph_group(&music.song(), &repertoire, &rules(n, seed as u64));
            for span in dance.spans.iter().filter(|span| span.unison == unison) {
                let range = settled(&dance, span, 0);
                n_frames += range.len();
                check(&music, &dance, span, range);
            }
        }
    }
    n_frames
}

#[track_caller]
fn assert_near(a: [f64; 6], b: [f64; 6], tolerance: f64, t: usize) {
    let worst = a.iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
    assert!(worst < tolerance, "frame {t}: {a:?} and {b:?}");
}

/// Differences of single-precision velocities of up to 5 m/s and turns of up to 20 rad/s.
const ROUNDING: f64 = 2e-5;

#[test]
fn no_two_dancers_touch() {
    let repertoire = repertoire();
    let mut n_dances = 0;
    for (s, (tempo_bpm, beats_per_bar)) in SONGS.into_iter().enumerate() {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 80.0);
        let song = music.song();
        for n in [1, 2, 3, 5, 16] {
            for seed in 0..4 {
                let seed = seed + 100 * s as u64;
                let dance = choreograph_group(&song, &repertoire, &rules(n, seed));
                assert_eq!(dance.frames.dim(), (n, 2400, 25));
                let least = least_separation_m(&dance.frames);
                assert!(least >= 2.0 * RADIUS_M, "{tempo_bpm} {n} {seed}: {least}");
                n_dances += 1;
            }
        }
    }
    assert_eq!(n_dances, 100);
}

#[test]
fn the_same_steps_have_the_same_velocities() {
    let n = visit(Unison::Same, &[2, 3, 5, 7], |_, dance, span, range| {
        for t in range {
            for k in 1..span.places.len() {
                assert_near(own(dance, span, k, t), own(dance, span, 0, t), ROUNDING, t);
            }
        }
    });
    assert!(n > 1000, "{n}");
}

#[test]
fn mirrored_halves_are_mirror_images() {
    let n = visit(Unison::Mirrored, &[2, 3, 5, 6], |_, dance, span, range| {
        let n_mirrored = span.parts.iter().filter(|part| part.is_mirrored).count();
        assert_eq!(n_mirrored, span.places.len() / 2);
        let right = |k: usize| span.places[k].x_m >= 0.0;
        let plain = (0..span.places.len()).find(|&k| !span.parts[k].is_mirrored).unwrap();
        for k in (0..span.places.len()).filter(|&k| span.parts[k].is_mirrored) {
            let halves = span.formation == Formation::Scatter || right(k) || right(plain);
            assert!(halves, "{span:?}");
            for t in range.clone() {
                // M = diag(-1, 1, 1) takes v to M v and ω to -M ω.
                let [vx, vy, vz, wx, wy, wz] = own(dance, span, plain, t);
                let image = [-vx, vy, vz, wx, -wy, -wz];
                assert_near(own(dance, span, k, t), image, ROUNDING, t);
            }
        }
    });
    assert!(n > 1000, "{n}");
}

#[test]
fn a_canon_repeats_the_bar_before() {
    let n = visit(Unison::Canon, &[2, 3, 4, 2, 3], |music, dance, span, range| {
        let bar_frames = (music.song().grid().interval_s() * FPS).round() as usize
            * music.beats.beats_per_bar() as usize;
        for k in 1..span.places.len() {
            for t in range.clone().skip(bar_frames) {
                let mut before = own(dance, span, k - 1, t - bar_frames);
                // The height follows the music of its own moment.
                let mut here = own(dance, span, k, t);
                (before[1], here[1]) = (0.0, 0.0);
                // A spline at whole knots is the pose itself, up to the rounding of times.
                assert_near(here, before, 1e-3, t);
            }
        }
    });
    assert!(n > 1000, "{n}");
}

#[test]
fn the_response_repeats_the_call_while_it_rests() {
    let n = visit(Unison::CallAndResponse, &[2, 3, 5, 4], |music, dance, span, range| {
        let bar_frames = (music.song().grid().interval_s() * FPS).round() as usize
            * music.beats.beats_per_bar() as usize;
        let is = |timing: Timing| span.parts.iter().position(|part| part.timing == timing).unwrap();
        let (call, response) = (is(Timing::Call), is(Timing::Response));
        let start = span.start_s * FPS;
        for t in range.clone() {
            let bars = (t as f64 - start) / bar_frames as f64;
            let in_bar = bars.fract();
            // Starts and stops take 4.5 frames on either side.
            if !(0.2..0.7).contains(&in_bar) {
                continue;
            }
            let resting = if (bars as usize).is_multiple_of(2) { response } else { call };
            let [vx, _, vz, wx, wy, wz] = own(dance, span, resting, t);
            assert_near([vx, 0.0, vz, wx, wy, wz], [0.0; 6], ROUNDING, t);
        }
        for t in range.clone().skip(bar_frames) {
            let mut called = own(dance, span, call, t - bar_frames);
            let mut answered = own(dance, span, response, t);
            (called[1], answered[1]) = (0.0, 0.0);
            assert_near(answered, called, 1e-3, t);
        }
    });
    assert!(n > 1000, "{n}");
}

#[test]
fn free_dancers_have_steps_of_their_own() {
    let (mut apart, mut sum) = (0.0, 0.0);
    let n = visit(Unison::Free, &[2, 3, 5, 4], |_, dance, span, range| {
        for t in range {
            let first = own(dance, span, 0, t);
            for k in 1..span.places.len() {
                for (a, b) in first.iter().zip(own(dance, span, k, t)) {
                    apart += (a - b).powi(2);
                    sum += a.powi(2) + b.powi(2);
                }
            }
        }
    });
    // Independent motions differ by the sum of their energies; the rise with the bar is common.
    assert!(apart > 0.7 * sum, "{apart} of {sum}");
    assert!(n > 1000, "{n}");
}

#[test]
fn every_frame_of_every_dancer_obeys_the_identities() {
    let repertoire = repertoire();
    for (tempo_bpm, beats_per_bar) in SONGS {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 60.0);
        let dance = choreograph_group(&music.song(), &repertoire, &rules(5, 8));
        (0..5).for_each(|k| check_identities(&dancer(&dance, k), &music));
    }
}

#[test]
fn every_dancer_keeps_the_bar_as_a_soloist_does() {
    let repertoire = repertoire();
    for (tempo_bpm, beats_per_bar) in SONGS {
        let music = SteadySong::new(tempo_bpm, beats_per_bar, 80.0);
        let song = music.song();
        let locked = |frames: &Array2<f32>| bar_locking(&column(frames, 4), &column(frames, 16));
        let solo = locked(&choreograph(&song, &repertoire, 6).frames);
        let group = choreograph_group(&song, &repertoire, &rules(4, 6));
        for k in 0..4 {
            let found = locked(&dancer(&group, k));
            assert!(found > solo - 0.1, "{tempo_bpm}: dancer {k} {found}, soloist {solo}");
        }
        // A body that has no steps has the rise of the bar alone, exactly.
        let still = choreograph_group(&song, &Repertoire::new(), &rules(3, 6)).frames;
        let alone = choreograph(&song, &Repertoire::new(), 6).frames;
        for k in 0..3 {
            assert_eq!(still.slice(s![k, .., 1]), alone.column(1), "{tempo_bpm} {k}");
        }
    }
}

#[test]
fn dancers_face_as_their_formation_says() {
    let (music, repertoire) = (SteadySong::new(120.0, 4, 100.0), repertoire());
    let mut squares = Vec::new();
    for seed in 0..6 {
        let dance = choreograph_group(&music.song(), &repertoire, &rules(4, seed));
        for span in &dance.spans {
            for t in settled(&dance, span, 0) {
                for (k, place) in span.places.iter().enumerate() {
                    let q = std::array::from_fn(|c| f64::from(dance.frames[[k, t, 9 + c]]));
                    let [x, _, z] = rotate(q, [0.0, 0.0, 1.0]);
                    let off = x.atan2(z) - place.yaw_rad;
                    squares.push(off.sin().atan2(off.cos()).powi(2));
                }
            }
        }
    }
    let rms = (squares.iter().sum::<f64>() / squares.len() as f64).sqrt();
    // These captures swing by up to 1.6 rad about their way; any heading would be 1.8 (π/√3).
    assert!(squares.len() > 10_000 && rms < 0.7, "{rms}");
}

#[test]
fn phrases_lie_about_the_origin_and_tell_their_kinds() {
    let (music, repertoire) = (SteadySong::new(120.0, 4, 60.0), repertoire());
    let asked = GroupRules { min_span_s: 12.0, ..rules(3, 2) };
    let dance = choreograph_group(&music.song(), &repertoire, &asked);
    let (a, b) = (&dance.spans[0], &dance.spans[1]);
    let border = b.first_frame;
    for (first, n) in [(0, 120), (border - 31, 101), (border + 30, 7), (border - 90, 120)] {
        let phrase = group_phrase(&dance, first, n);
        assert_eq!(phrase.frames.dim(), (3, n, 25));
        let mean = |i: usize| (0..3).map(|k| phrase.frames[[k, 0, i]]).sum::<f32>() / 3.0;
        assert!(mean(0).abs() < 1e-6 && mean(2).abs() < 1e-6, "{} {}", mean(0), mean(2));
        let least = least_separation_m(&phrase.frames);
        assert!(least >= 2.0 * RADIUS_M, "{least}");
        for k in 0..3 {
            // Nothing is turned, and everybody is moved alike.
            for i in (1..9).chain(13..25).filter(|&i| i != 2) {
                let was = dance.frames.slice(s![k, first..first + n, i]);
                assert_eq!(phrase.frames.slice(s![k, .., i]), was, "{i}");
            }
            let moved =
                |k: usize| phrase.frames[[k, n - 1, 0]] - dance.frames[[k, first + n - 1, 0]];
            assert!((moved(k) - moved(0)).abs() < 2e-6);
        }
        let n_before = border.saturating_sub(first).min(n);
        let share = n_before.max(n - n_before) as f64 / n as f64;
        let most = if n_before > n - n_before { a.unison } else { b.unison };
        assert_eq!(phrase.unison, (most, share), "{first}");
    }
    // The first half of the way counts to the formation before.
    let halfway = ((b.start_s + b.arrival_s) / 2.0 * FPS).round() as usize;
    assert_eq!(dance.kinds_at(halfway - 1).0, a.formation);
    assert_eq!(dance.kinds_at(halfway + 1).0, b.formation);
    assert_eq!(group_phrase(&dance, 0, 30).formation, (a.formation, 1.0));
}

#[test]
fn every_size_of_a_range_is_drawn_alike() {
    let mut counts = [0_usize; 4];
    (0..2000).for_each(|seed| counts[draw_group_size(2..=5, seed) - 2] += 1);
    // Three standard deviations: 3 √(2000 · 0.25 · 0.75) = 58.
    assert!(counts.iter().all(|n| n.abs_diff(500) <= 58), "{counts:?}");
    assert_eq!(draw_group_size(2..=16, 7), draw_group_size(2..=16, 7));
    assert_eq!(draw_group_size(3..=3, 1), 3);
}

#[test]
fn a_dance_depends_on_its_rules_alone() {
    let (music, repertoire) = (SteadySong::new(110.0, 4, 30.0), repertoire());
    let song = music.song();
    let dance = |n: usize, seed: u64| choreograph_group(&song, &repertoire, &rules(n, seed));
    assert_eq!(dance(3, 1), dance(3, 1));
    assert_ne!(dance(3, 1).spans, dance(3, 2).spans);
    assert_ne!(dance(3, 1).frames, dance(3, 2).frames);
    assert_eq!(dance(1, 1).frames.dim(), (1, 900, 25));
}
