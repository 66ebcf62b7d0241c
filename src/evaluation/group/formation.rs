//! How a group is spread over the floor.

use super::{mean, n_frames};
use crate::motion::Poses;

/// How much of the floor a group takes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coverage {
    /// Area of the convex hull of the dancers' places, mean over the frames, m²; 0 for two.
    pub hull_m2: f64,
    /// Root of the mean squared distance of the dancers from their middle, mean over the frames, m.
    pub spread_m: f64,
}

/// Returns how much of the floor a group takes; none without dancers or frames.
pub fn coverage(dancers: &[Poses]) -> Option<Coverage> {
    let places = |t: usize| -> Vec<[f64; 2]> {
        let place = |dancer: &Poses| [dancer.position_m[t][0], dancer.position_m[t][2]];
        dancers.iter().map(place).collect()
    };
    Some(Coverage {
        hull_m2: mean((0..n_frames(dancers)).map(|t| hull_area(places(t))))?,
        spread_m: mean((0..n_frames(dancers)).map(|t| spread(&places(t))))?,
    })
}

fn spread(places: &[[f64; 2]]) -> f64 {
    let n = places.len() as f64;
    let middle = [0, 1].map(|axis| places.iter().map(|p| p[axis]).sum::<f64>() / n);
    let square = |p: &[f64; 2]| (p[0] - middle[0]).powi(2) + (p[1] - middle[1]).powi(2);
    (places.iter().map(square).sum::<f64>() / n).sqrt()
}

/// Area of the convex hull of points on a plane.
///
/// Andrew's monotone chain, and the shoelace formula. Source: Andrew, "Another efficient algorithm for
/// convex hulls in two dimensions", 1979.
fn hull_area(mut points: Vec<[f64; 2]>) -> f64 {
    points.sort_by(|a, b| a[0].total_cmp(&b[0]).then(a[1].total_cmp(&b[1])));
    let mut hull: Vec<[f64; 2]> = Vec::new();
    let backwards = points.iter().rev().skip(1);
    let mut n_settled = 1;
    for (i, &point) in points.iter().chain(backwards).enumerate() {
        // On the way back what the way there has left stays.
        if i == points.len() {
            n_settled = hull.len();
        }
        while hull.len() > n_settled
            && turn(hull[hull.len() - 2], hull[hull.len() - 1], point) <= 0.0
        {
            hull.pop();
        }
        hull.push(point);
    }
    let twice: f64 = hull.windows(2).map(|e| e[0][0] * e[1][1] - e[1][0] * e[0][1]).sum();
    twice.abs() / 2.0
}

/// Above 0 where a, b, c turn to the left.
fn turn(a: [f64; 2], b: [f64; 2], c: [f64; 2]) -> f64 {
    (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
}
