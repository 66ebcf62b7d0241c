//! The path of a motion as it is seen from above.

use ndarray::{ArrayView2, s};

use super::axis::{self, Tick};
use super::scene::{Anchor, Point, Rect, Scene, SceneItem};
use super::style::{
    BLUE, CAP_HEIGHT, CURVE_PX, GREEN, GRID, HAIRLINE_PX, INK, MUTED, Rgb, TEXT_PX, VERMILLION,
};
use super::{font, frame};
use crate::motion::quaternion::{dot, normalize, rotate};
use crate::motion::{Channel, Trajectory};
use crate::units::FPS;

/// The margin around the path, as a share of its longer side, and the least side that is shown.
const PAD_SHARE: f64 = 0.08;
const MIN_SIDE_M: f64 = 0.5;
/// Room for a tick of either axis.
const TICK_ROOM_PX: f64 = 40.0;
/// Free space between two labels below the panel.
const LABEL_GAP_PX: f64 = 12.0;
/// Longest label beside the panel.
const MAX_LABEL_PX: f64 = 50.0;
/// Most marks that tell where the body faces.
const MAX_MARKS: usize = 60;
/// Widths of such a mark, of its dot, and of the dots at both ends; length of a mark.
const MARK_PX: f64 = 1.0;
const MARK_DOT_PX: f64 = 3.0;
const MARK_LENGTH_PX: f64 = 10.0;
const END_DOT_PX: f64 = 9.0;
/// Spaces in the legend, and its baseline above the panel, which is that of the heading.
const KEY_GAP_PX: f64 = 4.0;
const ENTRY_GAP_PX: f64 = 12.0;
const LEGEND_UP_PX: f64 = 12.0;
/// A heading that is shorter than this on the floor points up or down.
const MIN_FACING: f64 = 0.05;
/// More points than this are thinned out.
const MAX_POINTS: usize = 20_000;

/// A path on the floor: x and z in metres.
pub(super) struct FloorPath {
    /// One place per frame; `None` where it is not finite.
    places_m: Vec<Option<[f64; 2]>>,
    /// Frame and direction of the body's front, as long as it is on the floor (at most 1).
    facings: Vec<(usize, [f64; 2])>,
    /// Seconds from one facing to the next.
    every_s: usize,
}

/// The colours of a path, of its first and of its last place.
#[derive(Clone, Copy)]
pub(super) struct PathColors {
    pub path: Rgb,
    pub start: Rgb,
    pub end: Rgb,
}

impl FloorPath {
    pub fn of(motion: &Trajectory) -> Self {
        Self::of_frames(motion.view())
    }

    /// Takes the path of frames, `[T, 25]`.
    pub fn of_frames(frames: ArrayView2<f32>) -> Self {
        let channel = |channel: Channel| frames.slice_move(s![.., channel.range()]);
        let (position, quaternion) = (channel(Channel::Position), channel(Channel::Quaternion));
        let places = position.rows().into_iter().map(|p| {
            let place = [f64::from(p[0]), f64::from(p[2])];
            place.iter().all(|x| x.is_finite()).then_some(place)
        });
        let n_s = (frames.nrows() as f64 / FPS) as usize;
        let every_s = n_s.div_ceil(MAX_MARKS).max(1);
        let every_frames = every_s * FPS as usize;
        let facings = (0..frames.nrows()).step_by(every_frames).filter_map(|t| {
            let q = quaternion.row(t);
            let q = normalize(std::array::from_fn(|i| f64::from(q[i])));
            let [x, _, z] = rotate(q, [0.0, 0.0, 1.0]);
            // NaN is no more than anything, and a zero quaternion turns nothing.
            let is_facing = dot(q, q) > 0.5 && x.hypot(z) > MIN_FACING;
            is_facing.then_some((t, [x, z]))
        });
        Self { places_m: places.collect(), facings: facings.collect(), every_s }
    }

    /// Returns the length in metres, gaps left out.
    pub fn length_m(frames: ArrayView2<f32>) -> f64 {
        let position = frames.slice(s![.., Channel::Position.range()]);
        let steps = position.rows().into_iter().zip(position.rows().into_iter().skip(1));
        let lengths = steps.map(|(from, to)| {
            let parts = from.iter().zip(to).map(|(&a, &b)| f64::from(b) - f64::from(a));
            parts.map(|part| part * part).sum::<f64>().sqrt()
        });
        lengths.filter(|length| length.is_finite()).sum()
    }

    /// Writes heading, unit and legend over the panel at `rect`.
    pub fn heading(&self, scene: &mut Scene, rect: Rect, heading: &str, unit: &str) {
        let entries = [("start".to_owned(), GREEN), ("end".to_owned(), VERMILLION)];
        self.heading_with(scene, rect, [heading, unit], &entries);
    }

    /// Writes heading, unit and a legend of these entries over the panel at `rect`; a legend that has no
    /// room is cut at its beginning.
    pub fn heading_with(
        &self,
        scene: &mut Scene,
        rect: Rect,
        [heading, unit]: [&str; 2],
        entries: &[(String, Rgb)],
    ) {
        let width = |label: &str| END_DOT_PX + KEY_GAP_PX + font::width_px(label, TEXT_PX);
        let gaps = entries.len().saturating_sub(1) as f64 * ENTRY_GAP_PX;
        let mut x = rect.right() - entries.iter().map(|e| width(&e.0)).sum::<f64>() - gaps;
        let s = if self.every_s == 1 { "second".to_owned() } else { format!("{} s", self.every_s) };
        let meanings = [
            format!("from above, z downwards; marks: where the front points, every {s}"),
            "from above, z downwards".to_owned(),
            String::new(),
        ];
        let meanings = meanings.each_ref().map(String::as_str);
        frame::heading(scene, rect, x - ENTRY_GAP_PX, heading, &meanings, unit);
        let base = rect.top - LEGEND_UP_PX;
        for (label, &color) in entries.iter().map(|(label, color)| (label.as_str(), color)) {
            let middle = [x + END_DOT_PX / 2.0, base - CAP_HEIGHT * TEXT_PX / 2.0];
            scene.dot(middle, END_DOT_PX, color);
            let at = [x + END_DOT_PX + KEY_GAP_PX, base];
            scene.text(at, Anchor::Start, label, TEXT_PX, INK);
            x += width(label) + ENTRY_GAP_PX;
        }
    }

    /// Draws the path with its axes, a metre as long on one as on the other.
    pub fn draw(&self, scene: &mut Scene, rect: Rect) {
        let colors = PathColors { path: BLUE, start: GREEN, end: VERMILLION };
        Self::draw_all(&[(self, colors)], scene, rect);
    }

    /// Draws paths with common axes.
    pub fn draw_all(paths: &[(&Self, PathColors)], scene: &mut Scene, rect: Rect) {
        let Some(map) = Map::of(paths, rect) else {
            return frame::nothing(scene, rect, "no values");
        };
        let (x_m, z_m) = (map.ends_m(0, rect.width), map.ends_m(1, rect.height));
        let x_ticks = fitting_ticks(x_m, rect.width, |x| map.at([x, 0.0])[0]);
        for tick in &x_ticks {
            let x = map.at([tick.value, 0.0])[0];
            scene.vertical(x, rect.top, rect.bottom(), HAIRLINE_PX, GRID);
        }
        let mut z_ticks = axis::ticks(z_m[0], z_m[1], n_ticks(rect.height));
        for tick in &mut z_ticks {
            tick.label = font::elide(&tick.label, TEXT_PX, MAX_LABEL_PX);
        }
        frame::value_grid(scene, rect, &z_ticks, |z| map.at([0.0, z])[1]);
        for (path, colors) in paths {
            path.curve(scene, &map, *colors);
        }
        let labels = x_ticks.iter().map(|t| (map.at([t.value, 0.0])[0], t.label.as_str()));
        frame::x_ticks(scene, labels.clone().map(|(x, _)| x), rect.bottom());
        frame::x_labels(scene, labels, [rect.left, rect.right()], rect.bottom(), "x (m)");
    }

    /// Makes rings of the dots at the begin of paths that are drawn.
    pub fn hollow_starts(paths: &[(&Self, PathColors)], scene: &mut Scene, rect: Rect, paper: Rgb) {
        let Some(map) = Map::of(paths, rect) else { return };
        for place in paths.iter().filter_map(|(path, _)| path.places_m.iter().flatten().next()) {
            scene.dot(map.at(*place), END_DOT_PX / 2.0, paper);
        }
    }

    fn curve(&self, scene: &mut Scene, map: &Map, colors: PathColors) {
        let every = self.places_m.len().div_ceil(MAX_POINTS).max(1);
        let thinned: Vec<_> = self.places_m.iter().step_by(every).collect();
        for run in thinned.split(|place| place.is_none()) {
            let points: Vec<Point> = run.iter().filter_map(|p| p.map(|p| map.at(p))).collect();
            match points.as_slice() {
                [] => {}
                &[alone] => scene.dot(alone, MARK_DOT_PX, colors.path),
                _ => {
                    let (color, width_px) = (colors.path, CURVE_PX);
                    scene.items.push(SceneItem::Polyline { points, color, width_px });
                }
            }
        }
        for &(t, [x, z]) in &self.facings {
            let Some(from) = self.places_m[t].map(|place| map.at(place)) else { continue };
            let to = [from[0] + x * MARK_LENGTH_PX, from[1] + z * MARK_LENGTH_PX];
            let (points, color, width_px) = (vec![from, to], MUTED, MARK_PX);
            scene.items.push(SceneItem::Polyline { points, color, width_px });
            scene.dot(from, MARK_DOT_PX, MUTED);
        }
        let mut places = self.places_m.iter().flatten();
        let (start, end) = (places.next(), self.places_m.iter().flatten().next_back());
        for (place, color) in [(end, colors.end), (start, colors.start)] {
            if let Some(&place) = place {
                scene.dot(map.at(place), END_DOT_PX, color);
            }
        }
    }
}

/// From metres to the page: x to the right and z downwards, as who looks down sees it who has the
/// front of the stage before him.
struct Map {
    middle_m: [f64; 2],
    middle_px: Point,
    px_per_m: f64,
}

impl Map {
    /// Returns the map that has room for every place of paths; `None` without one.
    fn of(paths: &[(&FloorPath, PathColors)], rect: Rect) -> Option<Self> {
        Self::around(paths.iter().flat_map(|(path, _)| path.places_m.iter().flatten()), rect)
    }

    /// Returns the map that has room for every place; `None` without one.
    fn around<'a>(places_m: impl Iterator<Item = &'a [f64; 2]>, rect: Rect) -> Option<Self> {
        let mut ends: Option<[[f64; 2]; 2]> = None;
        for &[x, z] in places_m {
            let [low, high] = ends.get_or_insert([[x, z], [x, z]]);
            *low = [low[0].min(x), low[1].min(z)];
            *high = [high[0].max(x), high[1].max(z)];
        }
        let [low, high] = ends?;
        let sides_m = [high[0] - low[0], high[1] - low[1]];
        let pad_m = PAD_SHARE * sides_m[0].max(sides_m[1]).max(MIN_SIDE_M);
        let side_m = |i: usize| sides_m[i].max(MIN_SIDE_M) + 2.0 * pad_m;
        Some(Self {
            middle_m: [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0],
            middle_px: [rect.left + rect.width / 2.0, rect.top + rect.height / 2.0],
            px_per_m: (rect.width / side_m(0)).min(rect.height / side_m(1)),
        })
    }

    fn at(&self, place_m: [f64; 2]) -> Point {
        std::array::from_fn(|i| self.middle_px[i] + (place_m[i] - self.middle_m[i]) * self.px_per_m)
    }

    /// Returns what the panel shows on one axis, on which it is `side_px` long.
    fn ends_m(&self, axis: usize, side_px: f64) -> [f64; 2] {
        let half_m = side_px / 2.0 / self.px_per_m;
        [self.middle_m[axis] - half_m, self.middle_m[axis] + half_m]
    }
}

fn n_ticks(side_px: f64) -> usize {
    (side_px / TICK_ROOM_PX).max(2.0) as usize
}

/// Returns as many ticks on the horizontal axis as have room for their labels.
fn fitting_ticks(ends_m: [f64; 2], width_px: f64, x: impl Fn(f64) -> f64) -> Vec<Tick> {
    for max_ticks in (1..=n_ticks(width_px)).rev() {
        let ticks = axis::ticks(ends_m[0], ends_m[1], max_ticks);
        let widths = ticks.iter().map(|tick| font::width_px(&tick.label, TEXT_PX));
        let room_px = widths.fold(0.0, f64::max) + LABEL_GAP_PX;
        if ticks.windows(2).all(|t| x(t[1].value) - x(t[0].value) >= room_px) {
            return ticks;
        }
    }
    Vec::new()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use crate::motion::quaternion::from_axis_angle;
    use ndarray::Array2;

    const RECT: Rect = Rect { left: 10.0, top: 20.0, width: 400.0, height: 100.0 };

    fn walk(n_frames: usize, place: impl Fn(usize) -> [f32; 3]) -> Trajectory {
        let mut frames = Array2::zeros((n_frames, MOTION_DIM));
        for t in 0..n_frames {
            for (i, value) in place(t).into_iter().enumerate() {
                frames[[t, i]] = value;
            }
            // A quarter turn: the front points along +X.
            let q = from_axis_angle([0.0, 1.0, 0.0], std::f64::consts::FRAC_PI_2);
            for (i, value) in q.into_iter().enumerate() {
                frames[[t, Channel::Quaternion.range().start + i]] = value as f32;
            }
        }
        Trajectory::new(frames).unwrap()
    }

    #[test]
    fn a_metre_is_as_long_on_either_axis_and_z_points_down() {
        // 1 m in z: with the pads it is 1.16 m on 100 px.
        let path = FloorPath::of(&walk(61, |t| [0.0, 9.0, t as f32 / 60.0]));
        let map = Map::around(path.places_m.iter().flatten(), RECT).unwrap();
        assert!((map.px_per_m - 100.0 / 1.16).abs() < 1e-9, "{}", map.px_per_m);
        let [x, y] = map.at([1.0, 0.5]);
        assert!((x - (210.0 + 100.0 / 1.16)).abs() < 1e-6 && (y - 70.0).abs() < 1e-6, "{x}, {y}");
        assert!(map.at([0.0, 1.0])[1] > map.at([0.0, 0.0])[1]);
        // Frames 0, 30 and 60, all to the right.
        let facings: Vec<usize> = path.facings.iter().map(|f| f.0).collect();
        assert_eq!(facings, [0, 30, 60]);
        assert!(path.facings.iter().all(|(_, [x, z])| (x - 1.0).abs() < 1e-6 && z.abs() < 1e-6));
    }

    #[test]
    fn gaps_are_no_way_and_no_place() {
        let motion =
            walk(7, |t| [if t == 3 { f32::NAN } else { 3.0 * t as f32 }, 0.0, 4.0 * t as f32]);
        // Steps of 5 m, of which those to and from frame 3 are not known.
        assert!((FloorPath::length_m(motion.view()) - 20.0).abs() < 1e-5);
        let path = FloorPath::of(&motion);
        assert_eq!(path.places_m.iter().flatten().count(), 6);
        let nowhere = walk(3, |_| [f32::INFINITY, 0.0, 0.0]);
        let path = FloorPath::of(&nowhere);
        assert!(Map::around(path.places_m.iter().flatten(), RECT).is_none());
        assert_eq!(FloorPath::length_m(nowhere.view()), 0.0);
    }

    #[test]
    fn a_body_that_stands_still_has_a_map() {
        let path = FloorPath::of(&walk(2, |_| [7.0, 1.0, -3.0]));
        let map = Map::around(path.places_m.iter().flatten(), RECT).unwrap();
        assert_eq!(map.at([7.0, -3.0]), [210.0, 70.0]);
    }
}
