use super::*;
use crate::motion::channels::{Channel, MOTION_DIM};
use crate::motion::quaternion::{angular_velocity, dot, from_axis_angle};
use crate::motion::trajectory::ChannelLimits;
use crate::units::FPS;
use proptest::prelude::*;

const PHASE: usize = Channel::Phase.range().start;
const W: usize = Channel::Quaternion.range().start;

/// A walk on a bow that turns about a leaning axis by `turn_rad` a frame, all else decoded as 0.
fn walk(n: usize, turn_rad: f64) -> Array2<f32> {
    let mut frames = Array2::zeros((n, MOTION_DIM));
    for (t, mut row) in frames.rows_mut().into_iter().enumerate() {
        let s = t as f32;
        for (i, x) in
            [0.01 * s * s, 0.9 + 0.02 * (0.4 * s).sin(), -0.05 * s].into_iter().enumerate()
        {
            row[i] = x;
        }
        for (i, c) in from_axis_angle([0.6, 0.8, 0.0], turn_rad * t as f64).into_iter().enumerate()
        {
            row[W + i] = c as f32;
        }
    }
    frames
}

fn orientations(frames: &Array2<f32>) -> Vec<Quaternion> {
    quaternions(frames, Channel::Quaternion.columns())
}

fn nothing_but(change: impl Fn(&mut PostProcessConfig)) -> PostProcessConfig {
    let mut config = PostProcessConfig::nothing();
    change(&mut config);
    config
}

fn processed(config: &PostProcessConfig, frames: &Array2<f32>) -> Array2<f32> {
    config.check().expect("settings that make sense");
    let mut frames = frames.clone();
    process(config, &mut frames, None);
    frames
}

fn assert_close(found: &[f32], wanted: &[f32], tolerance: f32) {
    assert_eq!(found.len(), wanted.len());
    for (t, (a, b)) in found.iter().zip(wanted).enumerate() {
        assert!((a - b).abs() <= tolerance, "{a} against {b} at {t}");
    }
}

#[test]
fn values_are_held_within_the_limits_of_their_channels() {
    let mut frames = walk(3, 0.0);
    for (i, x) in [(0, 101.0), (4, -50.5), (8, 1e6), (13, 21.0), (PHASE, 1.5), (20, -1e9)] {
        frames[[1, i]] = x;
    }
    let only = nothing_but(|config| config.clamp_values = true);
    let found = processed(&only, &frames);
    let at = |frames: &Array2<f32>| [0, 4, 8, 13, PHASE, 20].map(|i| frames[[1, i]]);
    assert_eq!(at(&found), [100.0, -50.0, 100.0, 20.0, 1.5, -1e9]);
    let reference = PostProcessConfig { limits: ChannelLimits::Reference, ..only };
    assert_eq!(at(&processed(&reference, &frames)), [100.0, -50.0, 100.0, 10.0, 1.5, -1e9]);
    assert_eq!(processed(&PostProcessConfig::nothing(), &frames), frames);
}

#[test]
fn quaternions_become_unit_and_zero_stays_zero() {
    let mut frames = walk(5, 0.3);
    let wanted = frames.clone();
    for i in W..W + 4 {
        frames[[1, i]] *= 7.0;
        frames[[2, i]] *= -0.02;
        frames[[4, i]] = 0.0;
    }
    let found = processed(&nothing_but(|config| config.normalize_quaternions = true), &frames);
    for t in 0..4 {
        // Scaled and divided again: two roundings.
        let (found, wanted) = (found.row(t).to_vec(), wanted.row(t).to_vec());
        assert_close(&found[W..W + 4], &wanted[W..W + 4], 2.0 * f32::EPSILON);
    }
    assert_eq!(found.row(4).to_vec()[W..W + 4], [0.0; 4]);
}

#[test]
fn signs_are_continuous_or_those_of_the_reference() {
    // w crosses 0 at π / 0.5 frames, and again.
    let path = walk(29, 0.5);
    let mut flipped = path.clone();
    for t in [0, 3, 4, 9, 17, 18, 28] {
        for i in W..W + 4 {
            flipped[[t, i]] = -flipped[[t, i]];
        }
    }
    let sequential = nothing_but(|config| config.normalize_quaternions = true);
    assert_eq!(processed(&sequential, &flipped), path);
    let per_frame = PostProcessConfig { hemisphere: Hemisphere::PerFrame, ..sequential };
    let found = processed(&per_frame, &flipped);
    assert!(found.column(W).iter().all(|&w| w >= 0.0));
    let q = orientations(&found);
    assert!(q.windows(2).any(|q| dot(q[0], q[1]) < -0.9), "w ≥ 0 jumps where w crosses 0");
}

#[test]
fn a_steady_turn_is_as_smooth_as_it_gets() {
    let path = walk(31, 0.2);
    let mut flipped = path.clone();
    for t in [5, 6, 11, 30] {
        for i in W..W + 4 {
            flipped[[t, i]] = -flipped[[t, i]];
        }
    }
    let config = nothing_but(|config| {
        config.smooth_quaternions = true;
        config.normalize_quaternions = true;
    });
    // Neighbours on either side cancel but for a common factor; single precision of what is stored.
    let found = processed(&config, &flipped);
    for i in W..W + 4 {
        assert_close(&found.column(i).to_vec(), &path.column(i).to_vec(), 2.0 * f32::EPSILON);
    }
    // Without normalization every frame keeps the sign that it had.
    let kept = processed(&PostProcessConfig { normalize_quaternions: false, ..config }, &flipped);
    for i in W..W + 4 {
        assert_close(&kept.column(i).to_vec(), &flipped.column(i).to_vec(), 2.0 * f32::EPSILON);
    }
}

#[test]
fn a_jolt_is_shared_out_by_the_weights() {
    let mut frames = walk(11, 0.0);
    let jolt = from_axis_angle([0.0, 1.0, 0.0], 0.2);
    for (i, c) in jolt.into_iter().enumerate() {
        frames[[5, W + i]] = c as f32;
    }
    let found = processed(&nothing_but(|config| config.smooth_quaternions = true), &frames);
    let angle = |t: usize| 2.0 * f64::from(found[[t, W + 2]]).atan2(found[[t, W]].into());
    // Of weights 1/4, 3/4, 1, 3/4, 1/4, sum 3; small angles add like numbers, up to their cubes.
    for (t, share) in [(2, 0.0), (3, 0.25), (4, 0.75), (5, 1.0), (6, 0.75), (7, 0.25), (8, 0.0)] {
        assert!((angle(t) - 0.2 * share / 3.0).abs() < 5e-4, "{t}: {}", angle(t));
    }
}

#[test]
fn the_phase_is_clamped_held_and_set_to_the_music() {
    let mut frames = walk(10, 0.0);
    let decoded: [f32; 10] = [0.25, -0.5, 0.5, 0.375, 0.4375, 0.75, 0.25, 0.125, 1.75, 0.0625];
    frames.column_mut(PHASE).assign(&ndarray::arr1(&decoded));
    let phase = |frames: &Array2<f32>| frames.column(PHASE).to_vec();
    let clamped = nothing_but(|config| config.clamp_phase = true);
    let wanted = [0.25, 0.0, 0.5, 0.375, 0.4375, 0.75, 0.25, 0.125, 1.0, 0.0625];
    assert_eq!(phase(&processed(&clamped, &frames)), wanted);
    let narrow = PostProcessConfig { phase_min: 0.125, phase_max: 0.5, ..clamped.clone() };
    let wanted = [0.25, 0.125, 0.5, 0.375, 0.4375, 0.5, 0.25, 0.125, 0.5, 0.125];
    assert_eq!(phase(&processed(&narrow, &frames)), wanted);
    // From 0.75 to 0.25 is a fall of exactly half a bar and held, to 0.125 it is a step.
    let monotonic = PostProcessConfig { enforce_phase_monotonic: true, ..clamped };
    let wanted = [0.25, 0.25, 0.5, 0.5, 0.5, 0.75, 0.75, 0.125, 1.0, 0.0625];
    assert_eq!(phase(&processed(&monotonic, &frames)), wanted);

    let music: Vec<f64> = (0..10).map(|t| (0.1 * f64::from(t)).fract()).collect();
    let wanted: Vec<f32> = music.iter().map(|&x| x as f32).collect();
    let mut relocked = frames.clone();
    process(&PostProcessConfig::default(), &mut relocked, Some(&music));
    assert_eq!(phase(&relocked), wanted);
    let decoded = PostProcessConfig { relock_phase: false, ..PostProcessConfig::default() };
    let mut kept = frames.clone();
    process(&decoded, &mut kept, Some(&music));
    assert_eq!(phase(&kept), phase(&processed(&PostProcessConfig::default(), &frames)));
}

#[test]
fn blending_takes_half_of_each_by_forward_differences() {
    let mut frames = Array2::zeros((5, MOTION_DIM));
    for t in 0..5 {
        frames[[t, 0]] = (t * t) as f32;
        frames[[t, 3]] = 10.0;
        frames[[t, 6]] = 2.0;
    }
    let config = nothing_but(|config| config.coherence = Coherence::Blend);
    let found = processed(&config, &frames);
    // Derived velocity 30 (2t + 1), the last repeated: 30, 90, 150, 210, 210.
    assert_eq!(found.column(3).to_vec(), [20.0, 50.0, 80.0, 110.0, 110.0]);
    // From the blended velocity: 900, 900, 900, 0, 0.
    assert_eq!(found.column(6).to_vec(), [451.0, 451.0, 451.0, 1.0, 1.0]);
    let velocity = PostProcessConfig { enforce_accel_coherence: false, ..config.clone() };
    let found = processed(&velocity, &frames);
    assert_eq!(found.column(3).to_vec(), [20.0, 50.0, 80.0, 110.0, 110.0]);
    assert_eq!(found.column(6).to_vec(), [2.0; 5]);
    let acceleration = PostProcessConfig { enforce_velocity_coherence: false, ..config.clone() };
    let found = processed(&acceleration, &frames);
    assert_eq!(found.column(3).to_vec(), [10.0; 5]);
    assert_eq!(found.column(6).to_vec(), [1.0; 5]);
    let one = frames.slice(s![..1, ..]).to_owned();
    assert_eq!(processed(&config, &one), one);
}

#[test]
fn what_is_derived_obeys_the_identities() {
    let frames = processed(&PostProcessConfig::default(), &walk(27, 0.13));
    let at = |t: usize, i: usize| f64::from(frames[[t, i]]);
    for t in 0..26 {
        for i in 0..3 {
            let v = (at(t + 1, i) - at(t, i)) * FPS;
            assert_eq!(frames[[t, 3 + i]], v as f32);
            // Of velocities before they were rounded: half a unit of either, times 30, and half a unit
            // of the acceleration itself.
            let a = (at(t + 1, 3 + i) - at(t, 3 + i)) * FPS;
            let size = at(t + 1, 3 + i).abs().max(at(t, 3 + i).abs());
            assert!(t == 25 || (at(t, 6 + i) - a).abs() <= 61.0 * f64::from(f32::EPSILON) * size);
        }
        let q = orientations(&frames);
        let omega = angular_velocity(q[t], q[t + 1], FPS);
        assert_eq!([13, 14, 15].map(|i| frames[[t, i]]), omega.map(|c| c as f32));
    }
    for i in [3, 6, 14] {
        assert_eq!(frames[[26, i]], frames[[25, i]], "the last difference is repeated");
    }
    // 0.13 rad a frame about (0.6, 0.8, 0); rounded quaternions turn by up to 2e-7 more.
    let column = |i: usize| frames.column(i).to_vec();
    assert_close(&column(13), &[0.6 * 3.9; 27], 3e-5);
    assert_close(&column(14), &[0.8 * 3.9; 27], 3e-5);
}

#[test]
fn the_moving_average_smooths_vectors_alone() {
    let mut frames = walk(7, 0.4);
    for i in [1, 4, 7, 14, PHASE, 21] {
        frames.column_mut(i).fill(0.0);
        frames[[3, i]] = 3.0;
    }
    let found = processed(&nothing_but(|config| config.apply_smoothing = true), &frames);
    for i in [1, 4, 7, 14] {
        assert_eq!(found.column(i).to_vec(), [0.0, 0.0, 1.0, 1.0, 1.0, 0.0, 0.0], "{i}");
    }
    for i in [W, W + 1, PHASE, 21] {
        assert_eq!(found.column(i), frames.column(i), "{i}");
    }
}

#[test]
fn polynomial_smoothing_keeps_parabolas_and_what_is_derived_follows() {
    let savitzky_golay = Some(SavitzkyGolay { window: 7, order: 2 });
    let config = PostProcessConfig { savitzky_golay, ..PostProcessConfig::default() };
    let mut frames = walk(23, 0.1);
    let clean = processed(&PostProcessConfig::default(), &frames);
    let found = processed(&config, &frames);
    for i in [0, 2] {
        // A parabola and a line, up to both ends; a few roundings of 4.84 m to single precision.
        assert_close(&found.column(i).to_vec(), &clean.column(i).to_vec(), 2e-6);
    }
    frames[[11, 1]] += 0.1;
    let found = processed(&config, &frames);
    for (t, q) in orientations(&found).into_iter().enumerate() {
        assert!((dot(q, q) - 1.0).abs() < 3e-7, "{t}");
    }
    let at = |t: usize, i: usize| f64::from(found[[t, i]]);
    for t in 0..22 {
        assert_eq!(found[[t, 4]], ((at(t + 1, 1) - at(t, 1)) * FPS) as f32);
    }
    // 7/21 of the jolt is left at its frame: the middle weight of a parabola over seven frames.
    let left = found[[11, 1]] - processed(&config, &walk(23, 0.1))[[11, 1]];
    assert!((left - 0.1 / 3.0).abs() < 1e-6, "{left}");
}

#[test]
fn polynomial_smoothing_keeps_the_signs_that_it_meets() {
    let mut frames = walk(40, 0.3);
    for i in W..W + 4 {
        frames[[13, i]] = -frames[[13, i]];
    }
    let config = nothing_but(|config| {
        config.coherence = Coherence::Derive;
        config.savitzky_golay = Some(SavitzkyGolay { window: 5, order: 3 });
    });
    let found = processed(&config, &frames);
    for (found, before) in orientations(&found).into_iter().zip(orientations(&frames)) {
        // A cubic over five frames of a turn by 0.3 rad each misses it by less than 1e-3.
        assert!(dot(found, before) > 1.0 - 1e-6, "{found:?} against {before:?}");
    }
}

#[test]
fn what_is_not_finite_stays_to_be_found() {
    let mut frames = walk(21, 0.6);
    let bad = [(3, 0, f32::NAN), (5, 4, f32::INFINITY), (7, 8, f32::NEG_INFINITY)];
    let more = [(9, W + 1, f32::NAN), (11, 14, f32::NAN), (13, PHASE, f32::INFINITY)];
    for (t, i, x) in bad.into_iter().chain(more) {
        frames[[t, i]] = x;
    }
    for i in W..W + 4 {
        frames[[10, i]] = -frames[[10, i]];
    }
    let config =
        PostProcessConfig { enforce_phase_monotonic: true, ..PostProcessConfig::default() };
    let music = vec![0.5; 21];
    let mut found = frames.clone();
    process(&config, &mut found, Some(&music));
    for (t, i, x) in bad.into_iter().chain(more) {
        assert!(found[[t, i]].is_nan() && x.is_nan() || found[[t, i]] == x, "{t}, {i}");
    }
    // Differences of what is not a number are none either; the rest is sound.
    assert!(found[[2, 3]].is_nan() && found[[3, 3]].is_nan() && found[[1, 6]].is_nan());
    assert!(found[[8, 13]].is_nan() && found[[9, 15]].is_nan());
    assert!((found[[10, 13]] - 0.6 * 18.0).abs() < 1e-4);
    let q = orientations(&found);
    assert!(dot(q[8], q[10]) > 0.8 && dot(q[10], q[11]) > 0.9, "signs are continuous over the gap");
    assert!(found.column(PHASE).iter().enumerate().all(|(t, &x)| t == 13 || x == 0.5));
}

#[test]
fn no_frames_and_one_frame_are_fine() {
    let savitzky_golay = Some(SavitzkyGolay { window: 9, order: 3 });
    for coherence in [Coherence::Derive, Coherence::Fuse, Coherence::Blend] {
        let config = PostProcessConfig {
            coherence,
            smooth_quaternions: true,
            enforce_phase_monotonic: true,
            apply_smoothing: true,
            savitzky_golay: savitzky_golay.filter(|_| coherence.derives()),
            ..PostProcessConfig::default()
        };
        for n in [0, 1] {
            let frames = walk(n, 0.0);
            assert_eq!(processed(&config, &frames), frames);
        }
    }
}

#[test]
fn settings_without_sense_are_refused_in_a_sentence() {
    let refusal = |change: &dyn Fn(&mut PostProcessConfig)| {
        let mut config = PostProcessConfig::default();
        change(&mut config);
        config.check().expect_err("a setting without sense").to_string()
    };
    assert_eq!(
        refusal(&|config| config.quat_smooth_window = 4),
        "quat_smooth_window is 4 frames; a window needs a frame in its middle, so give an odd \
         number from 1 to 301"
    );
    assert_eq!(
        refusal(&|config| config.smoothing_kernel_size = 303),
        "smoothing_kernel_size is 303 frames; a window needs a frame in its middle, so give an odd \
         number from 1 to 301"
    );
    assert_eq!(
        refusal(&|config| config.savitzky_golay = Some(SavitzkyGolay { window: 0, order: 0 })),
        "window of savitzky_golay is 0 frames; a window needs a frame in its middle, so give an \
         odd number from 1 to 301"
    );
    assert_eq!(
        refusal(&|config| config.savitzky_golay = Some(SavitzkyGolay { window: 5, order: 5 })),
        "order of savitzky_golay is 5 in a window of 5 frames; a polynomial of that order smooths \
         nothing there, give at most 4 or a wider window"
    );
    assert_eq!(
        refusal(&|config| {
            config.coherence = Coherence::Keep;
            config.savitzky_golay = Some(SavitzkyGolay { window: 5, order: 2 });
        }),
        "savitzky_golay smooths positions and orientations, and coherence is keep, which leaves \
         velocities that no longer belong to them; set coherence to derive or fuse"
    );
    assert_eq!(
        refusal(&|config| {
            let mut variances = FusionVariances::default();
            variances.orientation_rad2.vertical = -1.0;
            config.fusion_variances = Some(variances);
        }),
        "orientation_rad2 of fusion_variances is -1; fusion divides by it, so give a number above 0, a \
         very large one for what shall not count"
    );
    assert_eq!(
        refusal(&|config| (config.phase_min, config.phase_max) = (0.5, 0.25)),
        "phase_min is 0.5 and phase_max is 0.25; both must lie within 0 and 1 bars, and the second \
         not below the first"
    );
    assert!(refusal(&|config| config.phase_max = f32::NAN).starts_with("phase_min is 0 and"));
    assert_eq!(
        refusal(&|config| config.quat_eps = 0.0),
        "quat_eps is 0e0; it must lie above 0 and below 1, the norm of a quaternion; 1e-8 is usual"
    );
}

#[test]
fn a_configuration_is_read_by_name_and_defaults_to_ours() {
    let read = |text: &str| serde_json::from_str::<PostProcessConfig>(text);
    let default = PostProcessConfig::default();
    assert_eq!(read("{}").expect("nothing is asked"), default);
    assert!(default.check().is_ok() && PostProcessConfig::nothing().check().is_ok());
    let config = read(
        r#"{"hemisphere": "per_frame", "coherence": "blend", "limits": "reference",
            "quat_smooth_window": 7, "savitzky_golay": {"window": 9, "order": 3}}"#,
    )
    .expect("names that exist");
    let wanted = PostProcessConfig {
        hemisphere: Hemisphere::PerFrame,
        coherence: Coherence::Blend,
        limits: ChannelLimits::Reference,
        quat_smooth_window: 7,
        savitzky_golay: Some(SavitzkyGolay { window: 9, order: 3 }),
        ..PostProcessConfig::default()
    };
    assert_eq!(config, wanted);
    let text = serde_json::to_string(&config).expect("a configuration");
    assert_eq!(read(&text).expect("what was written"), config);
    assert!(read(r#"{"max_position": 100.0}"#).is_err());
    for coherence in [Coherence::Keep, Coherence::Blend, Coherence::Derive, Coherence::Fuse] {
        let text = serde_json::to_string(&coherence).expect("a name");
        assert_eq!(text, format!("\"{}\"", coherence.name()));
    }
}

proptest! {
    #[test]
    fn a_second_time_changes_nothing(
        values in prop::collection::vec(-150.0..150.0f32, MOTION_DIM..9 * MOTION_DIM),
        has_music in any::<bool>()
    ) {
        let n = values.len() / MOTION_DIM;
        let values = values[..n * MOTION_DIM].to_vec();
        let mut frames = Array2::from_shape_vec((n, MOTION_DIM), values).expect("whole frames");
        let phase: Vec<f64> = (0..n).map(|t| 0.11 * t as f64).collect();
        let phase = has_music.then_some(phase.as_slice());
        let config = PostProcessConfig::default();
        process(&config, &mut frames, phase);
        let once = frames.clone();
        process(&config, &mut frames, phase);
        prop_assert_eq!(&frames, &once);
        for q in orientations(&frames) {
            prop_assert!((dot(q, q) - 1.0).abs() < 3e-7);
        }
        for channel in [Channel::Position, Channel::Phase] {
            let (low, high) = ChannelLimits::Wide.bounds(channel);
            for i in channel.range() {
                prop_assert!(frames.column(i).iter().all(|x| (low..=high).contains(x)));
            }
        }
    }
}
