//! Formations: where the dancers of a group stand, and which way they face.

use std::f64::consts::{FRAC_PI_2, PI, TAU};

use crate::chance::Chance;
use crate::motion::placement::Placement;

/// Least distance between two places of a formation, m.
pub const MIN_SPACING_M: f64 = 1.6;
/// Largest distance between neighbours, as a multiple of the least.
const MAX_SPREAD: f64 = 1.3;
/// Most dancers in one rank of a line.
const MAX_RANK: usize = 8;
/// Distance between rows that face each other, as a multiple of that between neighbours.
const ROW_GAP: f64 = 1.25;
/// Half the angle between the arms of a V, rad.
const V_HALF_ANGLES_RAD: std::ops::Range<f64> = 0.61..1.05;
/// Side of the square of a scatter per root of the number of dancers, in distances of neighbours.
const SCATTER_SIDE: f64 = 1.4;
/// Throws after which a scatter gets a larger square, and by how much.
const SCATTER_TRIES: usize = 200;
const SCATTER_GROWTH: f64 = 1.1;

/// How a group stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Formation {
    /// Side by side, facing the audience, in ranks of at most 8.
    Line,
    /// Two arms that meet in front or behind.
    V,
    /// On a circle, facing the audience.
    Circle,
    /// Two rows that face each other.
    Rows,
    /// Anywhere, at a distance.
    Scatter,
}

impl Formation {
    /// All formations.
    pub const ALL: [Self; 5] = [Self::Line, Self::V, Self::Circle, Self::Rows, Self::Scatter];

    /// The formation as tables spell it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Line => "line",
            Self::V => "v",
            Self::Circle => "circle",
            Self::Rows => "rows",
            Self::Scatter => "scatter",
        }
    }

    /// Returns the places of `n` dancers around the origin, the audience at +Z; no two are nearer than
    /// [`MIN_SPACING_M`].
    ///
    /// Chance decides the distance of neighbours (1.6 to 2.08 m), the angle of a V and whether it points
    /// to the audience, how a circle is turned, and all of a scatter. Rows stand at both sides and face
    /// each other along X; all others face the audience.
    pub fn places(self, n: usize, chance: &mut Chance) -> Vec<Placement> {
        let spacing_m = MIN_SPACING_M * (1.0 + (MAX_SPREAD - 1.0) * chance.uniform());
        let mut places = match self {
            Self::Line => line(n, spacing_m),
            Self::V => {
                let std::ops::Range { start, end } = V_HALF_ANGLES_RAD;
                let half_angle_rad = start + (end - start) * chance.uniform();
                let is_in_front = chance.below(2) == 0;
                v(n, spacing_m, half_angle_rad, if is_in_front { 1.0 } else { -1.0 })
            }
            Self::Circle => circle(n, spacing_m, chance.below(2) == 0),
            Self::Rows => rows(n, spacing_m),
            Self::Scatter => scatter(n, spacing_m, chance),
        };
        centre(&mut places);
        places
    }
}

/// Returns the places of `n` dancers side by side, facing the audience at +Z, around the origin; the seed decides their
/// distance.
pub fn side_by_side(n: usize, seed: u64) -> Vec<Placement> {
    Formation::Line.places(n, &mut Chance::new(seed, 0))
}

fn at(x_m: f64, z_m: f64) -> Placement {
    Placement { x_m, z_m, yaw_rad: 0.0 }
}

/// Positions of `n` in a row, around 0, `spacing_m` apart.
fn in_row(n: usize, spacing_m: f64) -> impl Iterator<Item = f64> {
    (0..n).map(move |i| (i as f64 - (n as f64 - 1.0) / 2.0) * spacing_m)
}

fn line(n: usize, spacing_m: f64) -> Vec<Placement> {
    let n_ranks = n.div_ceil(MAX_RANK).max(1);
    let mut places = Vec::with_capacity(n);
    for rank in 0..n_ranks {
        let n_here = n / n_ranks + usize::from(rank < n % n_ranks);
        let z_m = -(rank as f64) * spacing_m;
        places.extend(in_row(n_here, spacing_m).map(|x_m| at(x_m, z_m)));
    }
    places
}

/// The tip is `to_audience`: 1 in front, -1 behind.
fn v(n: usize, spacing_m: f64, half_angle_rad: f64, to_audience: f64) -> Vec<Placement> {
    let (sin, cos) = half_angle_rad.sin_cos();
    let place = |i: usize| {
        let along_m = i.div_ceil(2) as f64 * spacing_m;
        let side = if i % 2 == 1 { -1.0 } else { 1.0 };
        at(side * along_m * sin, -to_audience * along_m * cos)
    };
    (0..n).map(place).collect()
}

fn circle(n: usize, spacing_m: f64, has_one_in_front: bool) -> Vec<Placement> {
    if n < 2 {
        return vec![at(0.0, 0.0); n];
    }
    let radius_m = spacing_m / (2.0 * (PI / n as f64).sin());
    let first = if has_one_in_front { 0.0 } else { 0.5 };
    let place = |i: usize| {
        let (sin, cos) = ((i as f64 + first) / n as f64 * TAU).sin_cos();
        at(radius_m * sin, radius_m * cos)
    };
    (0..n).map(place).collect()
}

fn rows(n: usize, spacing_m: f64) -> Vec<Placement> {
    let half_gap_m = ROW_GAP * spacing_m / 2.0;
    let n_left = n.div_ceil(2);
    let left = in_row(n_left, spacing_m);
    let right = in_row(n - n_left, spacing_m);
    left.map(|z_m| Placement { x_m: -half_gap_m, z_m, yaw_rad: FRAC_PI_2 })
        .chain(right.map(|z_m| Placement { x_m: half_gap_m, z_m, yaw_rad: -FRAC_PI_2 }))
        .collect()
}

fn scatter(n: usize, spacing_m: f64, chance: &mut Chance) -> Vec<Placement> {
    let mut side_m = SCATTER_SIDE * spacing_m * (n as f64).sqrt();
    let mut places: Vec<Placement> = Vec::with_capacity(n);
    let mut n_tries = 0;
    while places.len() < n {
        let thrown = at((chance.uniform() - 0.5) * side_m, (chance.uniform() - 0.5) * side_m);
        if places.iter().all(|other| distance_m(&thrown, other) >= spacing_m) {
            places.push(thrown);
            n_tries = 0;
        }
        n_tries += 1;
        if n_tries > SCATTER_TRIES {
            (side_m, n_tries) = (side_m * SCATTER_GROWTH, 0);
        }
    }
    places
}

fn centre(places: &mut [Placement]) {
    let n = places.len().max(1) as f64;
    let (x_m, z_m) = places.iter().fold((0.0, 0.0), |(x, z), p| (x + p.x_m, z + p.z_m));
    for p in places {
        p.x_m -= x_m / n;
        p.z_m -= z_m / n;
    }
}

/// Returns the distance of two places on the floor, m.
pub fn distance_m(a: &Placement, b: &Placement) -> f64 {
    (a.x_m - b.x_m).hypot(a.z_m - b.z_m)
}

/// Returns the least distance between two places, m; infinite for fewer than two.
pub fn least_distance_m(places: &[Placement]) -> f64 {
    pairs(places.len())
        .map(|(i, j)| distance_m(&places[i], &places[j]))
        .fold(f64::INFINITY, f64::min)
}

/// Returns every pair `(i, j)` with `i < j < n`.
pub fn pairs(n: usize) -> impl Iterator<Item = (usize, usize)> {
    (0..n).flat_map(move |i| (i + 1..n).map(move |j| (i, j)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_keep_their_distance_around_the_origin() {
        for formation in Formation::ALL {
            for n in 1..=16 {
                for seed in 0..50 {
                    let places = formation.places(n, &mut Chance::new(seed, n as u64));
                    assert_eq!(places.len(), n);
                    // Rounding of a sum of squares.
                    let least = least_distance_m(&places);
                    assert!(least >= MIN_SPACING_M - 1e-12, "{formation:?} {n} {seed}: {least}");
                    let mean = places.iter().map(|p| p.x_m).sum::<f64>()
                        + places.iter().map(|p| p.z_m).sum::<f64>();
                    assert!(mean.abs() < 1e-9, "{formation:?} {n}: {mean}");
                    // A V of 16 has arms of 8 · 2.08 m.
                    assert!(places.iter().all(|p| p.x_m.hypot(p.z_m) < 17.0), "{formation:?} {n}");
                }
            }
        }
    }

    #[test]
    fn formations_have_their_shapes() {
        let places = |formation: Formation, n: usize| formation.places(n, &mut Chance::new(3, 0));
        let line = places(Formation::Line, 5);
        assert!(line.iter().all(|p| p.z_m.abs() < 1e-12 && p.yaw_rad == 0.0));
        assert!(line.windows(2).all(|p| p[1].x_m - p[0].x_m >= MIN_SPACING_M - 1e-12));
        let ranks: std::collections::BTreeSet<i64> =
            places(Formation::Line, 11).iter().map(|p| (p.z_m * 1e6) as i64).collect();
        assert_eq!(ranks.len(), 2);
        let circle = places(Formation::Circle, 7);
        let radius = circle[0].x_m.hypot(circle[0].z_m);
        assert!(circle.iter().all(|p| (p.x_m.hypot(p.z_m) - radius).abs() < 1e-9));
        let rows = places(Formation::Rows, 5);
        assert_eq!(rows.iter().filter(|p| p.yaw_rad == FRAC_PI_2).count(), 3);
        // Who faces +X stands at the side of -X.
        assert!(rows.iter().all(|p| p.x_m * p.yaw_rad < 0.0), "{rows:?}");
        let v = places(Formation::V, 5);
        assert!((v[1].x_m + v[2].x_m - 2.0 * v[0].x_m).abs() < 1e-12);
        assert!((v[3].z_m - 2.0 * v[1].z_m + v[0].z_m).abs() < 1e-12);
        let names = Formation::ALL.map(Formation::name);
        assert_eq!(names, ["line", "v", "circle", "rows", "scatter"]);
    }
}
