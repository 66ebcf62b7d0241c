//! Tests of whole plots of motion.

use ndarray::Array2;

use super::{check_texts, decode, texts};
use crate::motion::{Channel, MOTION_DIM, Trajectory};
use crate::plot::motion::scene;
use crate::plot::scene::{Point, Scene, SceneItem};
use crate::plot::style::{BLUE, GREEN, INK, PURPLE, Rgb, VERMILLION};
use crate::plot::*;

const JERK_LIMIT: f64 = 50_000.0;

/// A circle of 1 m once in 4 s at a height of 0.9 m, with a turning front and bars of 2 s.
fn circle(n_frames: usize) -> Array2<f32> {
    let mut frames = Array2::zeros((n_frames, MOTION_DIM));
    for t in 0..n_frames {
        let angle = t as f32 / 120.0 * std::f32::consts::TAU;
        let values = [
            (Channel::Position, vec![angle.sin(), 0.9, angle.cos()]),
            (Channel::Velocity, vec![angle.cos(), 0.0, -angle.sin()]),
            (Channel::Acceleration, vec![-angle.sin(), 0.0, -angle.cos()]),
            (Channel::Quaternion, vec![(angle / 2.0).cos(), 0.0, (angle / 2.0).sin(), 0.0]),
            (Channel::AngularVelocity, vec![0.0, 1.5, 0.0]),
            (Channel::Phase, vec![t as f32 / 60.0 % 1.0]),
        ];
        for (channel, values) in values {
            for (column, value) in channel.range().zip(values) {
                frames[[t, column]] = value;
            }
        }
    }
    frames
}

fn trajectory(frames: Array2<f32>) -> Trajectory {
    Trajectory::new(frames).expect("25 channels")
}

fn plot<'a>(motion: &'a Trajectory, beat_times_s: &'a [f64]) -> MotionPlot<'a> {
    let (title, first_frame, jerk_limit_m_s3) = ("gBR.t0.1", 0, JERK_LIMIT);
    MotionPlot { title, motion, beat_times_s, first_frame, jerk_limit_m_s3 }
}

/// Returns the lines of a colour that have more points than a key of a legend.
fn curves(scene: &Scene, wanted: Rgb) -> Vec<&[Point]> {
    let curves = scene.items.iter().filter_map(|item| match item {
        SceneItem::Polyline { points, color, .. } => {
            (*color == wanted && points.len() > 2).then_some(points.as_slice())
        }
        _ => None,
    });
    curves.collect()
}

fn assert_near(found: Point, wanted: Point, what: &str) {
    let far = (found[0] - wanted[0]).abs().max((found[1] - wanted[1]).abs());
    // Positions come as single precision.
    assert!(far < 1e-3, "{what}: {found:?} instead of {wanted:?}");
}

#[test]
fn text_touches_neither_text_nor_the_edge() {
    let beats = [0.1, 0.6, 1.1, 1.6];
    let sets: [&[MotionPanel]; 5] = [
        &MotionPanel::USUAL,
        &MotionPanel::ALL,
        &[MotionPanel::Path],
        &[MotionPanel::Jerk],
        &[MotionPanel::AngularVelocity, MotionPanel::Quaternion, MotionPanel::Path],
    ];
    for n_frames in [1, 2, 7, 241, 2000] {
        for factor in [0.0, 1.0, 3e-9, -7e12, 3e38] {
            let mut frames = circle(n_frames);
            frames.mapv_inplace(|value| value * factor);
            frames[[n_frames / 2, 1]] = f32::NAN;
            let motion = trajectory(frames);
            for width_px in [320, 457, 640, 1000, 2400] {
                for first_frame in [0, 371, 200_000_000] {
                    for panels in sets {
                        let mut plot = plot(&motion, &beats);
                        plot.first_frame = first_frame;
                        plot.title =
                            "A name that is much too long for a page of this width, I fear";
                        let scene = scene(&plot, panels, width_px).unwrap();
                        let case = format!(
                            "{n_frames} frames from {first_frame}, {width_px} px, × {factor}, {panels:?}"
                        );
                        check_texts(&scene, &case);
                    }
                }
            }
        }
    }
}

#[test]
fn the_six_panels_of_the_reference_are_in_three_rows() {
    let motion = trajectory(circle(120));
    let beats = [0.0, 0.5, 1.0, 9.0];
    let scene = scene(&plot(&motion, &beats), &MotionPanel::USUAL, 1000).unwrap();
    assert_eq!((scene.width_px, scene.height_px), (1000.0, 765.0));
    let places = texts(&scene);
    let at = |text: &str| {
        let (_, rect) = places.iter().find(|(found, _)| found == text).expect(text);
        (rect.left, rect.bottom().round())
    };
    // Panels begin at 102, 316 and 530; their headings are 12 px above.
    let left = ["Position", "Quaternion", "Quaternion norm"].map(at);
    assert_eq!(left, [(64.0, 90.0), (64.0, 304.0), (64.0, 518.0)]);
    // Half of what 1000 px leave beside margins, labels and the gap of 64 px is 422 px.
    let right = ["Velocity", "Phase", "Jerk"].map(at);
    assert_eq!(right, [(550.0, 90.0), (550.0, 304.0), (550.0, 518.0)]);
    for text in [
        "4.00 s",
        "120 frames at 30 fps",
        "3 beats",
        "change of the acceleration; limit 50000",
        "m/s³",
        "bar",
        "time (s)",
    ] {
        at(text);
    }
    // 119 chords of a circle of 1 m, 2 sin(π/120) each.
    let length = 119.0 * 2.0 * (std::f64::consts::PI / 120.0).sin();
    at(&format!("path of {length:.2} m"));
    assert!(!places.iter().any(|(text, _)| text.contains("not finite")));
}

#[test]
fn curves_are_where_their_values_are() {
    let motion = trajectory(circle(120));
    let usual = scene(&plot(&motion, &[]), &MotionPanel::USUAL, 1000).unwrap();
    let x = |left: f64, t: usize| left + (t as f64 + 0.5) / 120.0 * 422.0;
    // -1 to 1 m/s, with a twentieth of the span at either end.
    let velocity = |value: f64| 102.0 + 170.0 * (1.1 - value) / 2.2;
    let blue = curves(&usual, BLUE);
    assert_eq!(blue[0].len(), 120);
    assert_near(blue[1][0], [x(550.0, 0), velocity(1.0)], "x of the velocity");
    assert_near(blue[1][60], [x(550.0, 60), velocity(-1.0)], "x of the velocity");
    // The position has the same axis.
    assert_near(curves(&usual, GREEN)[0][7], [x(64.0, 7), velocity(0.9)], "y of the position");
    assert_near(curves(&usual, PURPLE)[0][0], [x(64.0, 0), velocity(1.0)], "z of the position");
    // w from 1 to -1 on an axis from -1 to 1.
    let w = curves(&usual, INK)[0];
    assert_near(w[0], [x(64.0, 0), 316.0], "w at the begin");
    assert_near(w[60], [x(64.0, 60), 316.0 + 85.0], "w after half a turn");
    // The phase begins anew after 60 frames: two curves, each from 0 to 59/60 of the panel.
    let bars: Vec<_> = blue.iter().filter(|c| c.len() == 60).collect();
    assert_eq!(bars.len(), 2);
    assert_near(bars[1][0], [x(550.0, 60), 486.0], "the second downbeat");
    assert_near(bars[1][59], [x(550.0, 119), 486.0 - 170.0 * 59.0 / 60.0], "the bar's end");
    // The norm is 1 throughout, in the middle of 0.95 to 1.05.
    let norm = blue.iter().find(|c| (c[0][1] - 615.0).abs() < 0.1).expect("the norm");
    assert_near(norm[119], [x(64.0, 119), 615.0], "the norm");
    // Jerk ends a frame earlier.
    let jerk = blue.iter().find(|c| c.len() == 119).expect("the jerk");
    assert_near([jerk[118][0], 0.0], [x(550.0, 118), 0.0], "the last jerk");
}

#[test]
fn what_is_not_finite_is_a_gap_and_is_counted() {
    let mut frames = circle(31);
    for (t, value) in [(10, f32::NAN), (11, f32::INFINITY), (29, f32::NEG_INFINITY)] {
        frames[[t, 0]] = value;
    }
    let motion = trajectory(frames);
    let panels = [MotionPanel::Position, MotionPanel::Path];
    let scene = scene(&plot(&motion, &[]), &panels, 700).unwrap();
    let lengths: Vec<_> = curves(&scene, BLUE).iter().map(|c| c.len()).collect();
    // x, and the path; both end in a single frame, which is a dot.
    assert_eq!(lengths, [10, 17, 10, 17]);
    assert!(texts(&scene).iter().any(|(text, _)| text == "3 values not finite"));
    let nothing = trajectory(Array2::from_elem((7, MOTION_DIM), f32::NAN));
    let empty = scene_of(&nothing);
    let texts = texts(&empty);
    let n_empty = texts.iter().filter(|(text, _)| text == "no values").count();
    assert_eq!(n_empty, MotionPanel::ALL.len());
    assert!(texts.iter().any(|(text, _)| text == "175 values not finite"));
}

fn scene_of(motion: &Trajectory) -> Scene {
    scene(&plot(motion, &[]), &MotionPanel::ALL, 1000).unwrap()
}

#[test]
fn long_motions_are_bands_and_means() {
    let motion = trajectory(circle(8440));
    let scene = scene(&plot(&motion, &[]), &MotionPanel::USUAL, 1000).unwrap();
    let bands = scene.items.iter().filter(|item| matches!(item, SceneItem::Polygon { .. })).count();
    // Three of position and velocity, four of the quaternion, and at least one of each other.
    assert!(bands >= 13, "{bands} bands");
    let texts = texts(&scene);
    assert!(texts.iter().any(|(text, _)| text == "curves: mean and range of 40 frames"));
}

#[test]
fn limits_and_beats_are_marked() {
    let motion = trajectory(circle(120));
    let marks = |beats: &[f64], panels: &[MotionPanel]| {
        let scene = scene(&plot(&motion, beats), panels, 1000).unwrap();
        let marks = scene.items.iter().filter_map(|item| match item {
            SceneItem::Area { rect, color, .. } if *color == VERMILLION => Some(*rect),
            _ => None,
        });
        marks.collect::<Vec<_>>()
    };
    // Alone: 908 px wide and 320 px high. One is the key.
    let phase = marks(&[0.0, 2.0], &[MotionPanel::Phase]);
    assert_eq!(phase.len(), 3);
    assert!(phase[1..].iter().all(|mark| mark.height == 320.0), "{phase:?}");
    assert!((phase[2].left - phase[1].left - 908.0 / 2.0).abs() < 0.6, "{phase:?}");
    let position = marks(&[0.0, 2.0], &[MotionPanel::Position]);
    assert!(position[1..].iter().all(|mark| mark.height == 4.0), "{position:?}");
    // Dashes of 6 px every 10 px, in the middle of the axis.
    let norm = marks(&[], &[MotionPanel::QuaternionNorm]);
    assert_eq!(norm.len(), 91);
    assert!(norm.iter().all(|dash| (dash.top - (102.0 + 160.0)).abs() <= 0.5), "{:?}", norm[0]);
    assert!(norm[..90].iter().all(|dash| dash.width == 6.0));
    // The limit is the head of the axis but for a tenth of a decade or 4 % of it.
    let jerk = marks(&[], &[MotionPanel::Jerk]);
    assert!(jerk.len() == 91 && jerk[0].top > 102.0 && jerk[0].top < 134.0, "{:?}", jerk[0]);
    // Beats every 10 ms would be a veil.
    let many: Vec<f64> = (0..400).map(|i| f64::from(i) / 100.0).collect();
    assert!(marks(&many, &[MotionPanel::Phase]).is_empty());
}

#[test]
fn the_bitmap_has_the_page_at_two_pixels_for_one() {
    let motion = trajectory(circle(61));
    let picture = motion_picture(&motion, 777, Format::Png);
    let (width, height, pixels) = decode(&picture.bytes);
    assert_eq!((picture.width_px as usize, picture.height_px as usize), (width, height));
    assert_eq!(width, 2 * 777);
    assert_eq!(pixels[..3], [255; 3], "the corner is paper");
    let svg = motion_picture(&motion, 777, Format::Svg);
    let text = String::from_utf8(svg.bytes).unwrap();
    assert!(text.contains("<title>gBR.t0.1</title>") && !text.contains("NaN"));
}

fn motion_picture(plotted: &Trajectory, width_px: u32, format: Format) -> Picture {
    motion(&plot(plotted, &[0.5]), &MotionPanel::ALL, width_px, format).unwrap()
}

#[test]
fn what_cannot_be_drawn_is_said() {
    let motion = trajectory(circle(3));
    let said = |panels: &[MotionPanel], width_px| {
        let picture = crate::plot::motion(&plot(&motion, &[]), panels, width_px, Format::Svg);
        picture.unwrap_err().to_string()
    };
    assert_eq!(
        said(&[], 1000),
        "no panels to plot; ask for one of position, velocity, quaternion, phase, \
         quaternion_norm, jerk, acceleration, angular_velocity, path"
    );
    assert_eq!(
        said(&MotionPanel::USUAL, 319),
        "plot is 319 px wide; choose a width from 320 to 8192 px"
    );
}
