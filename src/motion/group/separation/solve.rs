//! The least displacement that keeps bodies apart over some frames.

use ndarray::{ArrayView2, ArrayViewMut1};

use super::contact::{Contact, angle_in_circle, contacts};
use super::{MARGIN_M, Places};
use crate::motion::banded::BandedMatrix;
use crate::units::FPS;

/// τ: about as long before and after a contact paths bend, s.
const BEND_S: f64 = 0.3;
/// τ⁴ in frames.
const BEND: f64 = {
    let square = (BEND_S * FPS) * (BEND_S * FPS);
    square * square
};
/// What a metre squared of a distance that is missing costs, against one of displacement.
const STIFFNESS: f64 = 1e5;
/// Most convex problems of the sequence, fewest of them, and steps to solve one.
const MAX_PROBLEMS: usize = 12;
const MIN_PROBLEMS: usize = 3;
const MAX_STEPS: usize = 25;
/// Change after which there is no further step, m.
const SETTLED_M: f64 = 5e-4;
/// Halvings of a step that would raise the cost.
const MAX_HALVINGS: usize = 6;
/// Sweeps over the pairs of a frame before bodies are put in a circle.
const MAX_SWEEPS: usize = 300;

/// Frames whose bodies are to be kept apart.
pub struct Problem<'a> {
    /// Where the dancers stand, \[frames, dancers\].
    pub places: ArrayView2<'a, [f64; 2]>,
    /// At which frames a margin is asked for.
    pub is_core: Vec<bool>,
    /// Least distance, m.
    pub least_m: f64,
    /// Whether motion that stays as it is comes before the first frame, and after the last.
    pub is_held: [bool; 2],
}

impl Problem<'_> {
    /// Returns where the dancers stand when their bodies are kept apart.
    ///
    /// A sequence of convex problems, in each of which bodies are kept apart along the lines between them
    /// that the one before left.
    pub fn solve(&self) -> Places {
        let mut places = self.places.to_owned();
        for n_solved in 1..=MAX_PROBLEMS {
            let contacts = self.contacts(&places);
            let next = self.apart_along(&contacts, &places);
            let change = largest_move_m(&places, &next);
            places = next;
            let is_apart = || {
                self.contacts(&places).iter().all(|contact| {
                    let [p, q] = contact.dancers.map(|i| places[[contact.frame, i]]);
                    let wanted_m = contact.wanted_m.min(self.least_m);
                    (p[0] - q[0]).hypot(p[1] - q[1]) > wanted_m - MARGIN_M / 100.0
                })
            };
            if change < SETTLED_M || (n_solved >= MIN_PROBLEMS && is_apart()) {
                break;
            }
        }
        places
    }

    /// Solves one convex problem: Newton's method, in whose steps those contacts count that fall short;
    /// steps are halved until the cost falls. Source: Mangasarian, "A finite Newton method for
    /// classification", 2002 (a quadratic with squared one-sided losses).
    fn apart_along(&self, contacts: &[Contact], start: &Places) -> Places {
        let mut places = start.clone();
        let mut cost = self.cost(&places, contacts);
        for _ in 0..MAX_STEPS {
            let short: Vec<Contact> =
                contacts.iter().filter(|c| missing_m(c, places.view()) > 0.0).copied().collect();
            let aim = self.displaced(&short);
            let (mut next, mut share) = (aim.clone(), 1.0);
            let mut cost_there = self.cost(&next, contacts);
            for _ in 0..MAX_HALVINGS {
                if cost_there <= cost {
                    break;
                }
                share /= 2.0;
                next = places.clone();
                next.zip_mut_with(&aim, |place, aim| {
                    *place = [0, 1].map(|i| place[i] + share * (aim[i] - place[i]));
                });
                cost_there = self.cost(&next, contacts);
            }
            let change = largest_move_m(&places, &next);
            (places, cost) = (next, cost_there);
            if change < SETTLED_M {
                break;
            }
        }
        places
    }

    /// Returns what is minimised: `Σ |d|² + (τ FPS)⁴ Σ |d[t-1] - 2 d[t] + d[t+1]|² + k Σ max(0, m)²`, m
    /// what is missing of the distances of contacts.
    fn cost(&self, places: &Places, contacts: &[Contact]) -> f64 {
        let n_frames = self.places.nrows();
        let mut cost = 0.0;
        for (after, before) in places.columns().into_iter().zip(self.places.columns()) {
            if after == before {
                continue;
            }
            for axis in 0..2 {
                let d = |t: i64| match usize::try_from(t) {
                    Ok(t) if t < n_frames => after[t][axis] - before[t][axis],
                    _ => 0.0,
                };
                cost += (0..n_frames as i64).map(|t| d(t).powi(2)).sum::<f64>();
                let bends = self.bends().map(|t| (d(t - 1) - 2.0 * d(t) + d(t + 1)).powi(2));
                cost += BEND * bends.sum::<f64>();
            }
        }
        let missing = contacts.iter().map(|contact| missing_m(contact, places.view()).max(0.0));
        cost + STIFFNESS * missing.map(|m| m * m).sum::<f64>()
    }

    /// Frames with a second difference; motion that is held has no displacement on its side.
    fn bends(&self) -> std::ops::RangeInclusive<i64> {
        let first = if self.is_held[0] { -1 } else { 1 };
        first..=self.places.nrows() as i64 - if self.is_held[1] { 0 } else { 2 }
    }

    /// Returns the contacts of dancers at some places.
    fn contacts(&self, places: &Places) -> Vec<Contact> {
        let n = places.ncols();
        let mut found = Vec::new();
        let difference = |from: &[f64; 2], to: &[f64; 2]| [to[0] - from[0], to[1] - from[1]];
        for a in 0..n {
            for b in 0..a {
                let apart = |places: ArrayView2<[f64; 2]>| -> Vec<[f64; 2]> {
                    let (to, from) = (places.column(a), places.column(b));
                    from.iter().zip(to).map(|(from, to)| difference(from, to)).collect()
                };
                let roomy_m = self.least_m + MARGIN_M;
                // Beyond the core nobody is asked for more than there was.
                let wanted_m: Vec<f64> = apart(self.places)
                    .iter()
                    .zip(&self.is_core)
                    .map(
                        |(apart, &is_core)| {
                            if is_core { roomy_m } else { apart[0].hypot(apart[1]).min(roomy_m) }
                        },
                    )
                    .collect();
                let otherwise = angle_in_circle([a, b], n);
                found.extend(contacts([a, b], &apart(places.view()), &wanted_m, otherwise));
            }
        }
        found
    }

    /// Returns the places of least cost where all these contacts count, and no other.
    fn displaced(&self, contacts: &[Contact]) -> Places {
        let mut members: Vec<usize> = contacts.iter().flat_map(|c| c.dancers).collect();
        members.sort_unstable();
        members.dedup();
        let (n_frames, m) = (self.places.nrows(), members.len());
        let mut displaced = self.places.to_owned();
        if m == 0 {
            return displaced;
        }
        let at = |t: usize, member: usize, axis: usize| 2 * (t * m + member) + axis;
        let mut a = BandedMatrix::zeros(2 * m * n_frames, 4 * m);
        let mut x = vec![0.0; 2 * m * n_frames];
        for unknown in 0..2 * m {
            let at = |t: usize| at(t, unknown / 2, unknown % 2);
            for t in 0..n_frames {
                *a.at_mut(at(t), at(t)) += 1.0;
            }
            for middle in self.bends() {
                let terms = [(middle - 1, 1.0), (middle, -2.0), (middle + 1, 1.0)];
                let terms = terms.map(|(t, c)| (usize::try_from(t).ok(), c));
                let inside = terms.into_iter().filter_map(|(t, c)| Some((t?, c)));
                let inside = inside.filter(|(t, _)| *t < n_frames);
                for (s, c) in inside.clone() {
                    for (t, d) in inside.clone().filter(|(t, _)| *t <= s) {
                        *a.at_mut(at(s), at(t)) += BEND * c * d;
                    }
                }
            }
        }
        for contact in contacts {
            let [i, j] = contact.dancers.map(|dancer| {
                members.binary_search(&dancer).expect("invariant: who touches is a member")
            });
            let [u, v] = contact.direction;
            let terms = [(i, 0, u), (i, 1, v), (j, 0, -u), (j, 1, -v)];
            let terms = terms.map(|(member, axis, c)| (at(contact.frame, member, axis), c));
            let missing = missing_m(contact, self.places);
            for (row, c) in terms {
                x[row] += STIFFNESS * c * missing;
                for (column, d) in terms.into_iter().filter(|(column, _)| *column <= row) {
                    *a.at_mut(row, column) += STIFFNESS * c * d;
                }
            }
        }
        a.solve(&mut x);
        for (k, &dancer) in members.iter().enumerate() {
            for (t, place) in displaced.column_mut(dancer).iter_mut().enumerate() {
                place[0] += x[at(t, k, 0)];
                place[1] += x[at(t, k, 1)];
            }
        }
        displaced
    }
}

/// What is missing of the distance of a contact along its line, m.
fn missing_m(contact: &Contact, places: ArrayView2<[f64; 2]>) -> f64 {
    let [p, q] = contact.dancers.map(|dancer| places[[contact.frame, dancer]]);
    let [u, v] = contact.direction;
    contact.wanted_m - u * (p[0] - q[0]) - v * (p[1] - q[1])
}

fn largest_move_m(from: &Places, to: &Places) -> f64 {
    from.iter().zip(to).map(|(a, b)| (a[0] - b[0]).hypot(a[1] - b[1])).fold(0.0, f64::max)
}

/// Moves bodies of one frame apart to `wanted_m` where any are nearer than `least_m`: pair by pair, and
/// where that does not end, into a circle around their middle.
pub fn part(mut places: ArrayViewMut1<[f64; 2]>, wanted_m: f64, least_m: f64) {
    let n = places.len();
    for _ in 0..MAX_SWEEPS {
        let mut is_apart = true;
        for a in 0..n {
            for b in 0..a {
                let apart = [0, 1].map(|axis| places[a][axis] - places[b][axis]);
                let distance = apart[0].hypot(apart[1]);
                if distance >= least_m {
                    continue;
                }
                is_apart = false;
                let angle = if distance > 0.0 {
                    apart[1].atan2(apart[0])
                } else {
                    angle_in_circle([a, b], n)
                };
                let half = (wanted_m - distance) / 2.0;
                for (axis, u) in [angle.cos(), angle.sin()].into_iter().enumerate() {
                    places[a][axis] += half * u;
                    places[b][axis] -= half * u;
                }
                // As motion holds them, so that what is apart stays so.
                for i in [a, b] {
                    places[i] = places[i].map(|x| f64::from(x as f32));
                }
            }
        }
        if is_apart {
            return;
        }
    }
    let middle = [0, 1].map(|axis| places.iter().map(|p| p[axis]).sum::<f64>() / n as f64);
    let radius = wanted_m / (2.0 * (std::f64::consts::PI / n as f64).sin());
    for (i, place) in places.iter_mut().enumerate() {
        let angle = std::f64::consts::TAU * i as f64 / n as f64;
        *place = [middle[0] + radius * angle.cos(), middle[1] + radius * angle.sin()]
            .map(|x| f64::from(x as f32));
    }
}
