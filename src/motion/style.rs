//! The eight style channels: how a body moves, measured over a window of two seconds.
//!
//! Each channel is a physical quantity `x` squashed with `tanh((x - centre) / scale)`; centres and
//! scales are fixed constants, not fitted to any file, so that clips can be compared. The window is
//! a Hann window of [`WINDOW_FRAMES`] frames, so the channels change gradually.

use crate::units::FPS;

use super::lowpass::lowpass;
use super::quantile::percentile;
use super::quaternion::{Quaternion, rotate};

/// Number of style channels.
pub const STYLE_DIM: usize = super::channels::Channel::Style.width();

/// Length of the averaging window, frames; shorter clips use their own length.
pub const WINDOW_FRAMES: usize = 60;

/// The quantity that one style channel measures and how it is squashed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct StyleChannel {
    /// Short name of the quantity.
    pub name: &'static str,
    /// The quantity and its unit.
    pub measures: &'static str,
    /// Value that maps to 0.
    pub centre: f64,
    /// Distance from the centre that maps to `tanh 1`.
    pub scale: f64,
}

/// The style channels in column order; `ln 0.5` and `ln 0.6` are the speeds 0.5 and 0.6 m/s.
pub const STYLE_CHANNELS: [StyleChannel; STYLE_DIM] = [
    StyleChannel {
        name: "root_speed",
        measures: "ln of RMS root speed, m/s",
        centre: -std::f64::consts::LN_2,
        scale: 1.5,
    },
    StyleChannel {
        name: "limb_speed",
        measures: "ln of RMS node speed relative to the root, m/s (root alone: RMS |a| / 4)",
        centre: -0.510_825_623_765_990_7,
        scale: 1.2,
    },
    StyleChannel {
        name: "travel",
        measures: "radius of gyration of the root path on the floor, m",
        centre: 0.35,
        scale: 0.35,
    },
    StyleChannel {
        name: "reach",
        measures: "mean node distance from the root per height (root alone: 0.2 + SD of y, m)",
        centre: 0.27,
        scale: 0.06,
    },
    StyleChannel {
        name: "jerkiness",
        measures: "ln of RMS jerk times (0.25 s)² per RMS speed",
        centre: 2.2,
        scale: 1.0,
    },
    StyleChannel {
        name: "pulse",
        measures: "peak autocorrelation of the speed envelope at lags 0.27 to 1.23 s, 0 to 1",
        centre: 0.35,
        scale: 0.3,
    },
    StyleChannel {
        name: "uprightness",
        measures: "root height per its 95th percentile, minus half the tilt",
        centre: 0.92,
        scale: 0.08,
    },
    StyleChannel {
        name: "tension",
        measures: "share of root and node acceleration power above 3 Hz, 0 to 1",
        centre: 0.35,
        scale: 0.2,
    },
];

/// Speeds this small, m/s, no longer change a logarithm.
const LOG_FLOOR: f64 = 1e-3;
/// Speed added below the jerk so that standing still is not infinitely jerky, m/s.
const JERK_SPEED_FLOOR: f64 = 0.02;
/// Time constant that makes jerk per speed a pure number, s.
const JERK_TIME_S: f64 = 0.25;
/// Lags of the pulse, frames.
const PULSE_LAGS_FRAMES: std::ops::Range<usize> = 8..38;
/// Added to the variance of the envelope, (m/s)².
const PULSE_FLOOR: f64 = 1e-6;
/// Boundary between slow and tense acceleration, Hz.
const TENSION_CUTOFF_HZ: f64 = 3.0;
/// Acceleration power that counts as standing still, (m/s²)².
const TENSION_FLOOR: f64 = 0.05;
/// Root acceleration to limb speed when there are no limbs, s².
const ROOT_ONLY_SPEED2_PER_ACCELERATION2: f64 = 1.0 / 16.0;
/// Reach of a root without limbs that keeps its height, m.
const ROOT_ONLY_REACH_M: f64 = 0.2;

/// The motion of a body at [`FPS`], all slices of `T` frames.
#[derive(Clone, Copy, Debug)]
pub struct BodyMotion<'a> {
    /// Root position, m.
    pub position_m: &'a [[f64; 3]],
    /// Root velocity, m/s.
    pub velocity_m_s: &'a [[f64; 3]],
    /// Root acceleration, m/s².
    pub acceleration_m_s2: &'a [[f64; 3]],
    /// Root orientation, unit, body to world.
    pub orientation: &'a [Quaternion],
    /// World coordinates of the skeleton's nodes, m, one signal of `T` values per coordinate:
    /// x, y, z of the first node (the root), of the second, and so on; empty for a root alone.
    pub nodes_m: &'a [Vec<f64>],
}

/// The eight style channels of a motion, each in `[-1, 1]`, shape `[T][8]`.
///
/// `s[k] = tanh((x[k] - centre[k]) / scale[k])` with the quantities of [`STYLE_CHANNELS`]. All
/// slices must have the same number of frames; the shortest counts. A root without nodes has no
/// limbs, so limb speed, reach and tension then fall back on the root and differ in meaning.
pub fn style_channels(body: &BodyMotion) -> Vec<[f64; STYLE_DIM]> {
    let n_frames = [
        body.position_m.len(),
        body.velocity_m_s.len(),
        body.acceleration_m_s2.len(),
        body.orientation.len(),
    ]
    .into_iter()
    .chain(body.nodes_m.iter().map(Vec::len))
    .min()
    .unwrap_or(0);
    if n_frames == 0 {
        return Vec::new();
    }
    let window = Window::hann(WINDOW_FRAMES.min(n_frames));
    let position: [Vec<f64>; 3] = axes(&body.position_m[..n_frames]);
    let acceleration: [Vec<f64>; 3] = axes(&body.acceleration_m_s2[..n_frames]);
    let speed2: Vec<f64> = body.velocity_m_s[..n_frames].iter().map(norm2).collect();
    let limbs = Limbs::measure(&position, &acceleration, body.nodes_m, &window);

    let mean_speed2 = window.mean(&speed2);
    let mean_limb2 = window.mean(&limbs.speed2);
    let mean_jerk2 = window.mean(&jerk2(&body.acceleration_m_s2[..n_frames]));
    let travel2 = [0, 2].map(|axis| window.variance(&position[axis]));
    let pulse = pulse(&speed2, &limbs.speed2, &window);
    let height = window.mean(&position[1]);
    let usual_height = percentile(&mut position[1].clone(), 95.0).unwrap_or(0.0).max(1e-6);
    let up: Vec<f64> =
        body.orientation[..n_frames].iter().map(|&q| rotate(q, [0.0, 1.0, 0.0])[1]).collect();
    let upright = window.mean(&up);
    let (high, total) = (window.mean(&limbs.high_power), window.mean(&limbs.power));

    (0..n_frames)
        .map(|t| {
            let x = [
                (mean_speed2[t].sqrt() + LOG_FLOOR).ln(),
                (mean_limb2[t].sqrt() + LOG_FLOOR).ln(),
                (travel2[0][t] + travel2[1][t]).max(0.0).sqrt(),
                limbs.reach[t],
                (mean_jerk2[t].sqrt() * JERK_TIME_S * JERK_TIME_S
                    / (mean_speed2[t].sqrt() + JERK_SPEED_FLOOR)
                    + LOG_FLOOR)
                    .ln(),
                pulse[t],
                height[t] / usual_height - (1.0 - upright[t]) * 0.5,
                high[t] / (total[t] + TENSION_FLOOR),
            ];
            std::array::from_fn(|k| {
                ((x[k] - STYLE_CHANNELS[k].centre) / STYLE_CHANNELS[k].scale).tanh()
            })
        })
        .collect()
}

/// What the nodes contribute, or the root in their place; `reach` is already averaged.
struct Limbs {
    speed2: Vec<f64>,
    reach: Vec<f64>,
    power: Vec<f64>,
    high_power: Vec<f64>,
}

impl Limbs {
    fn measure(
        position: &[Vec<f64>; 3],
        acceleration: &[Vec<f64>; 3],
        nodes_m: &[Vec<f64>],
        window: &Window,
    ) -> Self {
        let n_frames = position[0].len();
        let (mut power, mut high_power) = (vec![0.0; n_frames], vec![0.0; n_frames]);
        for signal in acceleration {
            add_power(signal, &mut power, &mut high_power);
        }
        if nodes_m.is_empty() {
            // The root's acceleration counts twice, once for itself and once for the limbs.
            let speed2 = power.iter().map(|a2| a2 * ROOT_ONLY_SPEED2_PER_ACCELERATION2).collect();
            for p in power.iter_mut().chain(&mut high_power) {
                *p *= 2.0;
            }
            let bob2 = window.variance(&position[1]);
            let reach = bob2.iter().map(|v| ROOT_ONLY_REACH_M + v.max(0.0).sqrt()).collect();
            return Self { speed2, reach, power, high_power };
        }
        let n_nodes = nodes_m.len().div_ceil(3) as f64;
        let mut speed2 = vec![0.0; n_frames];
        let mut distance = vec![0.0; n_frames];
        for node in nodes_m.chunks(3) {
            let mut distance2 = vec![0.0; n_frames];
            for (signal, root) in node.iter().zip(position) {
                let relative: Vec<f64> = signal.iter().zip(root).map(|(x, p)| x - p).collect();
                let velocity = gradient(&relative);
                for t in 0..n_frames {
                    distance2[t] += relative[t] * relative[t];
                    speed2[t] += velocity[t] * velocity[t] / n_nodes;
                }
                add_power(&gradient(&velocity), &mut power, &mut high_power);
            }
            for (sum, d2) in distance.iter_mut().zip(distance2) {
                *sum += d2.sqrt() / n_nodes;
            }
        }
        let body_height = standing_height(nodes_m, n_frames);
        let relative: Vec<f64> = distance.iter().map(|d| d / body_height).collect();
        Self { speed2, reach: window.mean(&relative), power, high_power }
    }
}

/// Adds the square of a signal, and of what the tension filter removes from it.
fn add_power(signal: &[f64], power: &mut [f64], high_power: &mut [f64]) {
    let n_frames = power.len();
    let mut low = signal.to_vec();
    lowpass(&mut low, TENSION_CUTOFF_HZ, FPS);
    for t in 0..n_frames {
        power[t] += signal[t] * signal[t];
        high_power[t] += (signal[t] - low[t]).powi(2);
    }
}

/// 99th percentile over nodes and frames of the height above the lowest node of the frame, m.
fn standing_height(nodes_m: &[Vec<f64>], n_frames: usize) -> f64 {
    let heights: Vec<&Vec<f64>> = nodes_m.iter().skip(1).step_by(3).collect();
    let mut above = Vec::with_capacity(heights.len() * n_frames);
    for t in 0..n_frames {
        let lowest = heights.iter().map(|y| y[t]).fold(f64::INFINITY, f64::min);
        above.extend(heights.iter().map(|y| y[t] - lowest));
    }
    percentile(&mut above, 99.0).unwrap_or(1.0)
}

/// Windowed mean of the highest windowed autocorrelation of the speed envelope, clipped to 0..1.
///
/// `e = √(limb² + root²)` less its windowed mean; `ρ(t) = max over lags ⟨e[t] e[t+l]⟩ / ⟨e²⟩`, the
/// products beyond the end repeating the last one.
fn pulse(root2: &[f64], limb2: &[f64], window: &Window) -> Vec<f64> {
    let n_frames = root2.len();
    let envelope: Vec<f64> = root2.iter().zip(limb2).map(|(r, l)| (r + l).sqrt()).collect();
    let mean = window.mean(&envelope);
    let e: Vec<f64> = envelope.iter().zip(mean).map(|(x, m)| x - m).collect();
    let energy = window.mean(&e.iter().map(|x| x * x).collect::<Vec<_>>());
    let mut best = vec![0.0f64; n_frames];
    for lag in PULSE_LAGS_FRAMES.take_while(|&lag| lag < n_frames) {
        let overlap = n_frames - lag;
        let mut products: Vec<f64> = (0..overlap).map(|t| e[t] * e[t + lag]).collect();
        products.resize(n_frames, products[overlap - 1]);
        for (t, mean) in window.mean(&products).into_iter().enumerate() {
            best[t] = best[t].max(mean / (energy[t] + PULSE_FLOOR));
        }
    }
    window.mean(&best.into_iter().map(|x| x.clamp(0.0, 1.0)).collect::<Vec<_>>())
}

/// Squared jerk, forward differences, the last frame repeating the one before; (m/s³)².
fn jerk2(acceleration: &[[f64; 3]]) -> Vec<f64> {
    let mut j2: Vec<f64> = acceleration
        .windows(2)
        .map(|a| norm2(&std::array::from_fn(|i| (a[1][i] - a[0][i]) * FPS)))
        .collect();
    j2.push(j2.last().copied().unwrap_or(0.0));
    j2
}

/// Derivative per second: central differences inside, one-sided ones at the two ends.
fn gradient(x: &[f64]) -> Vec<f64> {
    let last = x.len() - 1;
    (0..x.len())
        .map(|t| {
            let (from, to) = (t.saturating_sub(1), (t + 1).min(last));
            (x[to] - x[from]) * FPS / (to - from).max(1) as f64
        })
        .collect()
}

/// A normalised Hann window that averages a signal around every frame.
pub(super) struct Window {
    weights: Vec<f64>,
}

impl Window {
    /// `w[i] ∝ sin²(π (i + 1) / (n + 1))`, `i = 0..n`: a Hann window without its zero ends.
    pub(super) fn hann(n: usize) -> Self {
        let w = |i: usize| (std::f64::consts::PI * (i + 1) as f64 / (n + 1) as f64).sin().powi(2);
        let sum: f64 = (0..n).map(w).sum();
        Self { weights: (0..n).map(|i| w(i) / sum).collect() }
    }

    /// Weighted mean around every frame, the first and last value repeated beyond the ends.
    pub(super) fn mean(&self, x: &[f64]) -> Vec<f64> {
        let (n, before) = (self.weights.len(), self.weights.len() / 2);
        let Some((&first, &last)) = x.first().zip(x.last()) else { return Vec::new() };
        let mut padded = vec![first; before];
        padded.extend_from_slice(x);
        padded.resize(x.len() + n - 1, last);
        padded
            .windows(n)
            .map(|around| around.iter().zip(&self.weights).map(|(x, w)| x * w).sum())
            .collect()
    }

    /// `⟨x²⟩ - ⟨x⟩²` around every frame; rounding may leave it slightly negative.
    fn variance(&self, x: &[f64]) -> Vec<f64> {
        let squares = self.mean(&x.iter().map(|v| v * v).collect::<Vec<_>>());
        squares.iter().zip(self.mean(x)).map(|(m2, m)| m2 - m * m).collect()
    }
}

fn axes(vectors: &[[f64; 3]]) -> [Vec<f64>; 3] {
    std::array::from_fn(|axis| vectors.iter().map(|v| v[axis]).collect())
}

fn norm2(v: &[f64; 3]) -> f64 {
    v.iter().map(|c| c * c).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::quaternion::IDENTITY;

    fn walk(n: usize, speed_m_s: f64) -> Vec<[f64; 8]> {
        let position: Vec<[f64; 3]> =
            (0..n).map(|t| [speed_m_s * t as f64 / FPS, 0.9, 0.0]).collect();
        style_channels(&BodyMotion {
            position_m: &position,
            velocity_m_s: &vec![[speed_m_s, 0.0, 0.0]; n],
            acceleration_m_s2: &vec![[0.0; 3]; n],
            orientation: &vec![IDENTITY; n],
            nodes_m: &[],
        })
    }

    #[test]
    fn steady_walking_upright_has_closed_forms() {
        let style = walk(151, 0.5);
        assert_eq!(style.len(), 151);
        let s = style[75];
        // ln(0.5 + 0.001) against a centre of ln 0.5.
        assert!((s[0] - (1.002f64.ln() / 1.5).tanh()).abs() < 1e-12);
        assert!((s[3] - ((0.2 - 0.27) / 0.06f64).tanh()).abs() < 1e-7, "{}", s[3]);
        assert!((s[4] - (1e-3f64.ln() - 2.2).tanh()).abs() < 1e-12);
        assert!((s[6] - 1f64.tanh()).abs() < 1e-12);
        assert!((s[7] - (-0.35 / 0.2f64).tanh()).abs() < 1e-12);
    }

    #[test]
    fn the_travel_of_a_straight_walk_is_its_windowed_spread() {
        let n = WINDOW_FRAMES as f64;
        let weights = Window::hann(WINDOW_FRAMES).weights;
        let centre = (n - 1.0) / 2.0;
        let spread2: f64 =
            weights.iter().enumerate().map(|(i, w)| w * (i as f64 - centre).powi(2)).sum();
        let travel_m = 1.2 / FPS * spread2.sqrt();
        let want = ((travel_m - 0.35) / 0.35).tanh();
        // The difference of two means of squares of metres.
        assert!((walk(181, 1.2)[90][2] - want).abs() < 1e-12);
    }

    #[test]
    fn a_faster_walk_raises_root_speed_and_travel_alone() {
        let (slow, fast) = (walk(97, 0.3)[48], walk(97, 0.9)[48]);
        assert!(fast[0] > slow[0] && fast[2] > slow[2]);
        assert_eq!([slow[1], slow[3], slow[7]], [fast[1], fast[3], fast[7]]);
    }

    #[test]
    fn the_window_averages_a_constant_to_itself_and_a_ramp_to_its_middle() {
        for n in [1, 2, 7, 60] {
            let window = Window::hann(n);
            assert!(window.mean(&[2.5; 71]).iter().all(|m| (m - 2.5).abs() < 1e-12));
            let ramp: Vec<f64> = (0..201).map(f64::from).collect();
            // An even window has its centre half a frame early.
            let shift = if n % 2 == 0 { 0.5 } else { 0.0 };
            assert!((window.mean(&ramp)[100] - (100.0 - shift)).abs() < 1e-11, "n = {n}");
        }
    }

    #[test]
    fn gradients_of_a_parabola_are_exact_inside() {
        let x: Vec<f64> = (0..7).map(|t| f64::from(t * t)).collect();
        let got: Vec<f64> = gradient(&x).iter().map(|d| d / FPS).collect();
        assert_eq!(got, [1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 11.0]);
        assert_eq!(gradient(&[3.0]), [0.0]);
    }

    #[test]
    fn very_short_and_empty_motions_stay_finite() {
        assert!(walk(0, 1.0).is_empty());
        for n in [1, 2, 9] {
            assert!(walk(n, 1.0).iter().flatten().all(|s| s.is_finite()));
        }
    }
}
