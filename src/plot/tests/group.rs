//! Tests of whole plots of groups.

use ndarray::Array3;

use super::{check_texts, decode, texts};
use crate::motion::MOTION_DIM;
use crate::motion::group::DANCER_COLORS;
use crate::plot::group::scene;
use crate::plot::scene::SceneItem;
use crate::plot::*;

/// Dancer i walks 2 m along x, at z = i; who looks along +Z.
fn walkers(n: usize, n_frames: usize) -> Array3<f32> {
    Array3::from_shape_fn((n, n_frames, MOTION_DIM), |(n, t, i)| match i {
        0 => 2.0 * t as f32 / (n_frames.max(2) - 1) as f32,
        2 => n as f32,
        9 => 1.0,
        _ => 0.0,
    })
}

#[test]
fn every_dancer_has_a_path_in_its_colour() {
    let group = walkers(5, 91);
    let plot = GroupPlot { title: "five", group: group.view() };
    let scene = scene(&plot, 1000).expect("a scene");
    for (i, wanted) in DANCER_COLORS.into_iter().enumerate() {
        let paths: Vec<_> = scene
            .items
            .iter()
            .filter_map(|item| match item {
                SceneItem::Polyline { points, color, .. }
                    if *color == wanted && points.len() > 2 =>
                {
                    Some(points)
                }
                _ => None,
            })
            .collect();
        assert_eq!(paths.len(), usize::from(i < 5), "{i}");
        if let [path] = paths[..] {
            assert_eq!(path.len(), 91);
            // z grows downwards, a metre as long as on x: 4 m in z and 2 m in x.
            let (first, last) = (path[0], path[90]);
            assert!((first[1] - last[1]).abs() < 1e-6 && last[0] > first[0]);
        }
    }
    let texts = texts(&scene);
    for text in ["5 dancers", "3.03 s", "91 frames at 30 fps", "4: 2 m", "x (m)"] {
        assert!(texts.iter().any(|(found, _)| found == text), "{text}: {texts:?}");
    }
}

#[test]
fn text_touches_neither_text_nor_the_edge() {
    for (n, n_frames) in [(1, 1), (2, 7), (16, 300)] {
        for factor in [0.0, 1.0, -7e12] {
            let group = walkers(n, n_frames).mapv(|x| x * factor);
            for width_px in [320, 1000, 2400] {
                let plot =
                    GroupPlot { title: "A name that is too long for it", group: group.view() };
                let scene = scene(&plot, width_px).expect("a scene");
                check_texts(&scene, &format!("{n} × {n_frames}, {width_px} px, × {factor}"));
            }
        }
    }
}

#[test]
fn groups_become_pictures_and_nobody_none() {
    let group = walkers(3, 31);
    let plot = GroupPlot { title: "trio", group: group.view() };
    let picture = crate::plot::group(&plot, 640, Format::Png).expect("a picture");
    let (width, height) = (picture.width_px, picture.height_px);
    assert_eq!(width, 1280);
    assert!(height > 720 && decode(&picture.bytes).0 == 1280);
    let svg = crate::plot::group(&plot, 640, Format::Svg).expect("a picture");
    assert!(svg.bytes.starts_with(b"<svg"));
    for shape in [(0, 31, 25), (3, 0, 25), (3, 31, 24)] {
        let group = Array3::zeros(shape);
        let plot = GroupPlot { title: "nobody", group: group.view() };
        let refused = scene(&plot, 640).expect_err("no group").to_string();
        let (n, t, c) = shape;
        assert_eq!(
            refused,
            format!(
                "group has shape [{n}, {t}, {c}]; a plot needs [N, T, 25] with dancers and frames"
            )
        );
    }
}
