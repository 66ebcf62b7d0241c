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

use super::banded::{Equation, SPAN, Solution};
use crate::units::FPS;

/// L: of the correction at one frame a third is left ten frames on, and a thirtieth thirty.
const REACH_FRAMES: f64 = 10.0;
/// ε² of positions, velocities and accelerations: 0.1 mm, 1 mm/s, 1 cm/s².
const VARIANCES: [f64; 3] = [1e-8, 1e-6, 1e-4];
/// Third differences hold four neighbours.
const BANDWIDTH: usize = 3;

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
/// What would need frames beyond the last is left out.
pub fn smoothest(n: usize, missing: &[Missing]) -> Vec<f64> {
    // Groups of equations: what is asked, by derivative, then size and jerk.
    const SIZE: usize = 3;
    const JERK: usize = 4;
    let [position, velocity, acceleration] = VARIANCES;
    let variances = [position, velocity, acceleration, 1.0, REACH_FRAMES.powi(-6)];
    let mut equations = Vec::with_capacity(2 * n + missing.len());
    let mut add = |first: usize, differences: &[f64], value: f64, group: usize| {
        if first + differences.len() <= n {
            let mut coefficients = [0.0; SPAN];
            coefficients[..differences.len()].copy_from_slice(differences);
            equations.push(Equation { first, coefficients, value, group });
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
    Solution::new(&equations, &variances, vec![true; n], BANDWIDTH).x
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

    fn at(frame: usize, derivative: usize, value: f64) -> Missing {
        Missing { frame, derivative, value }
    }

    #[test]
    fn what_is_asked_is_met() {
        let missing =
            [at(0, 0, 0.0), at(41, 0, 0.7), at(60, 1, -0.4), at(97, 0, -0.2), at(99, 2, 1.5)];
        let u = smoothest(121, &missing);
        let v = rates(&u);
        let a = rates(&v);
        assert_eq!((u.len(), v.len(), a.len()), (121, 121, 121));
        for (found, wanted) in [(u[0], 0.0), (u[41], 0.7), (u[97], -0.2)] {
            assert!((found - wanted).abs() < 1e-4, "{found} for {wanted}");
        }
        assert!((v[60] + 0.4).abs() < 1e-3, "{}", v[60]);
        assert!((a[99] - 1.5).abs() < 1e-2, "{}", a[99]);
    }

    #[test]
    fn a_correction_is_no_spike_and_fades() {
        let u = smoothest(241, &[at(120, 0, 0.5)]);
        let largest = |x: &[f64]| x.iter().fold(0.0_f64, |a, b| a.max(b.abs()));
        assert!((u[120] - 0.5).abs() < 1e-4);
        // Half a metre on one frame alone would be 15 m/s and 900 m/s².
        let (v, a) = (rates(&u), rates(&rates(&u)));
        assert!(largest(&v) < 0.7 && largest(&a) < 2.3, "{} {}", largest(&v), largest(&a));
        assert!(u[..75].iter().all(|x| x.abs() < 0.05), "{u:?}");
        assert!(u[0].abs() < 1e-3 && u[240].abs() < 1e-3, "{} {}", u[0], u[240]);
        for t in 0..120 {
            assert!((u[120 - t] - u[120 + t]).abs() < 1e-9, "it is the same on either side");
        }
    }

    #[test]
    fn nothing_is_corrected_where_nothing_is_missing_and_short_motion_is_no_trouble() {
        assert!(smoothest(31, &[]).iter().all(|&x| x == 0.0));
        assert!(smoothest(31, &[at(7, 0, 0.0)]).iter().all(|&x| x == 0.0));
        assert_eq!(smoothest(0, &[at(0, 0, 1.0)]), Vec::<f64>::new());
        assert!((smoothest(1, &[at(0, 0, 1.0)])[0] - 1.0).abs() < 1e-4);
        assert_eq!(rates(&[2.0]), [0.0]);
        // A velocity at the last frame has no frame behind it.
        assert!(smoothest(2, &[at(1, 1, 1.0)]).iter().all(|&x| x == 0.0));
    }
}
