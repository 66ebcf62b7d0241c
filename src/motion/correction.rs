//! The smoothest correction of a motion that meets what is asked of it.
//!
//! Of one axis of a path, with Dⁿ the n-th difference in frames, a correction u of n frames is
//!
//! `u = argmin Σ (c · u − e)² / ε² + Σ u[t]² + L⁶ Σ (D³u)[t]²`,
//!
//! c · u the position, velocity or acceleration of the correction at a frame and e what is missing there. The last term
//! is that of jerk: without it only frames of which something is asked would move, and stand out as spikes. A
//! correction fades over about L frames. Velocities and accelerations follow as its differences, so that a path that
//! agrees with them does so still. The sum is quadratic: its least is found in time linear in the frames.
//!
//! How near positions come is a choice. An estimate is noisy, and to meet a position exactly at frames beside each other
//! is to follow its noise ([`Closeness::Near`] does not). Finished motion is smooth, and is moved to where `u[t] = e`
//! ([`Closeness::Exact`]), however far it is from there: a weight, be it large, would leave of a whole path what the term
//! of jerk does not want.

use super::banded::{Equation, SPAN, Solution};
use crate::units::FPS;

/// L: of the correction of one frame 0.94 are left ten frames on, 0.57 thirty, and nothing sixty. Half as far a body that
/// has metres to go was faster than any in training, and where its speed is held the jerk of motion rose by half.
const REACH_FRAMES: f64 = 20.0;
/// ε² of positions (and of angles in rad) that are to be near, of velocities and accelerations: 1 mm, 1 mm/s, 1 cm/s². With
/// L this lets what is missing through up to 2.4 Hz, where (2π f / FPS)⁶ = 1 / (ε² L⁶).
const VARIANCES: [f64; 3] = [1e-6, 1e-6, 1e-4];
/// Third differences hold four neighbours.
const BANDWIDTH: usize = 3;

/// How near a correction brings positions to what is asked.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Closeness {
    /// As near as is smooth.
    Near,
    /// Exactly.
    Exact,
}

/// Something that is missing at a frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Missing {
    pub frame: usize,
    /// 0 of the position, 1 of the velocity, 2 of the acceleration.
    pub derivative: usize,
    /// In units of the axis, per second or per second squared.
    pub value: f64,
}

/// Returns the correction of each of n frames, in units of the axis.
///
/// The first `n_pinned` frames are not corrected, but for what is asked of themselves. What would need frames beyond the
/// last is left out.
pub fn smoothest(n: usize, n_pinned: usize, missing: &[Missing], closeness: Closeness) -> Vec<f64> {
    // Groups of equations: what is asked, by derivative, then size and jerk.
    const SIZE: usize = 3;
    const JERK: usize = 4;
    let [position, velocity, acceleration] = VARIANCES;
    let variances = [position, velocity, acceleration, 1.0, REACH_FRAMES.powi(-6)];
    let mut known: Vec<Option<f64>> = vec![None; n];
    known[..n_pinned.min(n)].fill(Some(0.0));
    for asked in missing.iter().filter(|asked| asked.derivative == 0 && asked.frame < n) {
        known[asked.frame] = (closeness == Closeness::Exact).then_some(asked.value);
    }
    let mut equations = Vec::with_capacity(2 * n + missing.len());
    let mut add = |first: usize, differences: &[f64], value: f64, group: usize| {
        if first + differences.len() <= n {
            let mut coefficients = [0.0; SPAN];
            coefficients[..differences.len()].copy_from_slice(differences);
            // What is known goes to the other side.
            let of_known = differences.iter().zip(&known[first..]);
            let of_known: f64 = of_known.map(|(c, known)| c * known.unwrap_or(0.0)).sum();
            equations.push(Equation { first, coefficients, value: value - of_known, group });
        }
    };
    for t in 0..n {
        add(t, &[1.0], 0.0, SIZE);
        add(t, &[-1.0, 3.0, -3.0, 1.0], 0.0, JERK);
    }
    for &Missing { frame, derivative, value } in missing {
        match derivative {
            0 => add(frame, &[1.0], value, 0),
            1 => add(frame, &[-FPS, FPS], value, 1),
            _ => add(frame, &[1.0, -2.0, 1.0].map(|c| FPS * FPS * c), value, 2),
        }
    }
    let is_free = known.iter().map(Option::is_none).collect();
    let mut u = Solution::new(&equations, &variances, is_free, BANDWIDTH).x;
    u.iter_mut().zip(known).for_each(|(u, known)| *u = known.unwrap_or(*u));
    u
}

/// Returns the rates of change of a correction, per second; the last are those before them.
pub fn rates(correction: &[f64]) -> Vec<f64> {
    let mut rates: Vec<f64> = correction.windows(2).map(|pair| FPS * (pair[1] - pair[0])).collect();
    rates.push(rates.last().copied().unwrap_or(0.0));
    rates.truncate(correction.len());
    rates
}

#[cfg(test)]
mod tests {
    use super::*;

    fn exact(n: usize, missing: &[Missing]) -> Vec<f64> {
        smoothest(n, 0, missing, Closeness::Exact)
    }

    fn at(frame: usize, derivative: usize, value: f64) -> Missing {
        Missing { frame, derivative, value }
    }

    #[test]
    fn what_is_asked_is_met() {
        let missing =
            [at(0, 0, 0.0), at(41, 0, 0.7), at(60, 1, -0.4), at(97, 0, -0.2), at(99, 2, 1.5)];
        let u = exact(121, &missing);
        let v = rates(&u);
        let a = rates(&v);
        assert_eq!((u.len(), v.len(), a.len()), (121, 121, 121));
        for (found, wanted) in [(u[0], 0.0), (u[41], 0.7), (u[97], -0.2)] {
            assert_eq!(found, wanted);
        }
        assert!((v[60] + 0.4).abs() < 1e-3, "{}", v[60]);
        assert!((a[99] - 1.5).abs() < 1e-2, "{}", a[99]);
    }

    #[test]
    fn a_correction_is_no_spike_and_fades() {
        let u = exact(241, &[at(120, 0, 0.5)]);
        let largest = |x: &[f64]| x.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        assert_eq!(u[120], 0.5);
        // Half a metre on one frame alone would be 15 m/s and 900 m/s².
        let (v, a) = (rates(&u), rates(&rates(&u)));
        assert!(largest(&v) < 0.35 && largest(&a) < 0.6, "{} {}", largest(&v), largest(&a));
        assert!(u[..60].iter().all(|x| x.abs() < 0.08), "{u:?}");
        assert!(u[0].abs() < 0.08 && u[240].abs() < 0.08, "{} {}", u[0], u[240]);
        for t in 0..120 {
            assert!((u[120 - t] - u[120 + t]).abs() < 1e-6, "it is the same on either side");
        }
    }

    #[test]
    fn a_whole_path_is_met_however_rough_what_is_missing_is() {
        let rough: Vec<f64> = (0..90).map(|t| if t % 2 == 0 { 0.4 } else { -0.3 }).collect();
        let missing: Vec<_> = rough.iter().enumerate().map(|(t, &x)| at(t, 0, x)).collect();
        assert_eq!(exact(90, &missing), rough);
        // But for two frames, which go between their neighbours.
        let missing: Vec<_> =
            missing.into_iter().filter(|asked| !(40..42).contains(&asked.frame)).collect();
        let u = exact(90, &missing);
        assert!(
            u.iter().zip(&rough).enumerate().all(|(t, (u, x))| (40..42).contains(&t) || u == x)
        );
        assert!(u[40..42].iter().all(|x| x.abs() < 1.5), "{:?}", &u[38..44]);
    }

    #[test]
    fn what_is_to_be_near_follows_no_noise_and_pinned_frames_stay() {
        // A path half a metre off, at every other frame, by an estimate with a noise of 3 cm.
        let noise = |t: usize| 0.03 * (t as f64 * 2.399).sin();
        let missing: Vec<_> = (4..120).step_by(2).map(|t| at(t, 0, 0.5 + noise(t))).collect();
        let (near, met) = (smoothest(120, 3, &missing, Closeness::Near), exact(120, &missing));
        assert_eq!(near[..3], [0.0; 3]);
        assert!(near[20..118].iter().all(|u| (u - 0.5).abs() < 0.03), "{near:?}");
        let largest = |x: &[f64]| x.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        let rate = |u: &[f64]| largest(&rates(&u[45..110]));
        assert!(5.0 * rate(&near) < rate(&met), "{} {}", rate(&near), rate(&met));
        // What is asked of a pinned frame itself moves it.
        let moved = smoothest(60, 3, &[at(1, 0, 0.2)], Closeness::Near);
        assert_eq!((moved[0], moved[2]), (0.0, 0.0));
        assert!(moved[1] > 0.0, "{}", moved[1]);
    }

    #[test]
    fn the_sum_is_at_its_least() {
        let missing = [at(3, 0, 0.7), at(11, 0, -0.2), at(12, 0, 0.1), at(20, 1, 0.5)];
        let n = 31;
        let u = exact(n, &missing);
        let sum = |u: &[f64]| -> f64 {
            let jerk: f64 =
                u.windows(4).map(|w| (w[3] - 3.0 * w[2] + 3.0 * w[1] - w[0]).powi(2)).sum();
            let rate = FPS * (u[21] - u[20]) - 0.5;
            u.iter().map(|x| x * x).sum::<f64>() + 6.4e7 * jerk + 1e6 * rate * rate
        };
        let least = sum(&u);
        for t in (0..n).filter(|t| ![3, 11, 12].contains(t)) {
            for step in [1e-3, -1e-3] {
                let mut other = u.clone();
                other[t] += step;
                assert!(sum(&other) > least, "frame {t}");
            }
        }
    }

    #[test]
    fn nothing_is_corrected_where_nothing_is_missing_and_short_motion_is_no_trouble() {
        assert!(exact(31, &[]).iter().all(|&x| x == 0.0));
        assert!(exact(31, &[at(7, 0, 0.0)]).iter().all(|&x| x == 0.0));
        assert_eq!(exact(0, &[at(0, 0, 1.0)]), Vec::<f64>::new());
        assert_eq!(exact(1, &[at(0, 0, 1.0)]), [1.0]);
        assert_eq!(rates(&[2.0]), [0.0]);
        // A velocity at the last frame has no frame behind it.
        assert!(exact(2, &[at(1, 1, 1.0)]).iter().all(|&x| x == 0.0));
    }
}
