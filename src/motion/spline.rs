//! Cubic spline interpolation with not-a-knot ends, on knots of any spacing.
//!
//! Same curve as `scipy.interpolate.CubicSpline`, including its straight line through two knots and
//! its parabola through three.

use thiserror::Error;

/// Why a spline could not be fitted.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum SplineError {
    /// Fewer than two knots, or not one value for each.
    #[error(
        "spline has {n_knots} knots and {n_values} values; give at least 2 knots, one value each"
    )]
    Shape { n_knots: usize, n_values: usize },
    /// Two neighbouring knots do not increase.
    #[error(
        "spline knot {index} is {knot} after {previous}; \
         knots must be finite and strictly increasing"
    )]
    NotIncreasing { index: usize, previous: f64, knot: f64 },
}

/// A piecewise cubic through given points with continuous second derivative.
#[derive(Clone, Debug)]
pub struct CubicSpline {
    knots: Vec<f64>,
    values: Vec<f64>,
    slopes: Vec<f64>,
}

impl CubicSpline {
    /// Fits the not-a-knot spline through `(knots[i], values[i])`, at least two points.
    ///
    /// With `h[i] = x[i+1] - x[i]` and `m[i] = (y[i+1] - y[i]) / h[i]`, the knot slopes `s` solve
    /// `h[i] s[i-1] + 2(h[i-1] + h[i]) s[i] + h[i-1] s[i+1] = 3(h[i] m[i-1] + h[i-1] m[i])`
    /// inside, and at the ends the third derivative is continuous across `x[1]` and `x[n-2]`.
    /// Errors: [`SplineError`]. Source: de Boor, A Practical Guide to Splines, 1978, chapter IV.
    pub fn fit(knots: &[f64], values: &[f64]) -> Result<Self, SplineError> {
        if knots.len() < 2 || knots.len() != values.len() {
            return Err(SplineError::Shape { n_knots: knots.len(), n_values: values.len() });
        }
        for (i, pair) in knots.windows(2).enumerate() {
            if !(pair[0].is_finite() && pair[1].is_finite() && pair[0] < pair[1]) {
                let (previous, knot) = (pair[0], pair[1]);
                return Err(SplineError::NotIncreasing { index: i + 1, previous, knot });
            }
        }
        let slopes = not_a_knot_slopes(knots, values);
        Ok(Self { knots: knots.to_vec(), values: values.to_vec(), slopes })
    }

    /// The spline at each of `at`; beyond the knots the outermost cubic continues.
    pub fn evaluate(&self, at: &[f64]) -> Vec<f64> {
        at.iter().map(|&x| self.evaluate_one(x)).collect()
    }

    fn evaluate_one(&self, x: f64) -> f64 {
        let last_piece = self.knots.len() - 2;
        let i = self.knots.partition_point(|&k| k <= x).saturating_sub(1).min(last_piece);
        let h = self.knots[i + 1] - self.knots[i];
        let m = (self.values[i + 1] - self.values[i]) / h;
        let (s0, s1) = (self.slopes[i], self.slopes[i + 1]);
        let t = (s0 + s1 - 2.0 * m) / h;
        let (c3, c2) = (t / h, (m - s0) / h - t);
        let u = x - self.knots[i];
        self.values[i] + u * (s0 + u * (c2 + u * c3))
    }
}

fn not_a_knot_slopes(x: &[f64], y: &[f64]) -> Vec<f64> {
    let n = x.len();
    let h: Vec<f64> = x.windows(2).map(|w| w[1] - w[0]).collect();
    let m: Vec<f64> = y.windows(2).zip(&h).map(|(w, h)| (w[1] - w[0]) / h).collect();
    match n {
        2 => vec![m[0]; 2],
        3 => {
            let c = (m[1] - m[0]) / (x[2] - x[0]);
            vec![m[0] - h[0] * c, m[0] + h[0] * c, m[1] + h[1] * c]
        }
        _ => {
            let mut lower = vec![0.0; n];
            let mut diagonal = vec![0.0; n];
            let mut upper = vec![0.0; n];
            let mut s = vec![0.0; n];
            let first = x[2] - x[0];
            (diagonal[0], upper[0]) = (h[1], first);
            s[0] = ((h[0] + 2.0 * first) * h[1] * m[0] + h[0] * h[0] * m[1]) / first;
            for i in 1..n - 1 {
                lower[i] = h[i];
                diagonal[i] = 2.0 * (h[i - 1] + h[i]);
                upper[i] = h[i - 1];
                s[i] = 3.0 * (h[i] * m[i - 1] + h[i - 1] * m[i]);
            }
            let last = x[n - 1] - x[n - 3];
            let (h1, h2) = (h[n - 2], h[n - 3]);
            (lower[n - 1], diagonal[n - 1]) = (last, h2);
            s[n - 1] = (h1 * h1 * m[n - 3] + (2.0 * last + h1) * h2 * m[n - 2]) / last;
            solve_tridiagonal(&lower, &mut diagonal, &upper, &mut s);
            s
        }
    }
}

/// Solves the tridiagonal system in place, the right-hand side in `s` becoming the solution.
///
/// Elimination without pivoting: for the not-a-knot rows every pivot is positive, the first two
/// being `h[1]` and `h[0] + h[1]`, the inner ones diagonally dominant, and the last
/// `h (p - h - h') / p` with `p > h + h'`.
fn solve_tridiagonal(lower: &[f64], diagonal: &mut [f64], upper: &[f64], s: &mut [f64]) {
    let n = s.len();
    for i in 1..n {
        let factor = lower[i] / diagonal[i - 1];
        diagonal[i] -= factor * upper[i - 1];
        s[i] -= factor * s[i - 1];
    }
    s[n - 1] /= diagonal[n - 1];
    for i in (0..n - 1).rev() {
        s[i] = (s[i] - upper[i] * s[i + 1]) / diagonal[i];
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn cubic(c: [f64; 4], x: f64) -> f64 {
        c[0] + x * (c[1] + x * (c[2] + x * c[3]))
    }

    proptest! {
        #[test]
        fn a_cubic_is_its_own_spline(c in prop::array::uniform4(-2.0..2.0f64),
                                     steps in prop::collection::vec(0.05..0.9f64, 3..17)) {
            let mut knots = vec![-1.5];
            for step in steps {
                knots.push(knots[knots.len() - 1] + step);
            }
            let values: Vec<f64> = knots.iter().map(|&x| cubic(c, x)).collect();
            let spline = CubicSpline::fit(&knots, &values).unwrap();
            let end = knots[knots.len() - 1];
            for i in 0..=20 {
                // A little beyond both ends too: the outermost cubic continues.
                let x = -1.6 + (end + 1.7) * f64::from(i) / 20.0;
                let (got, want) = (spline.evaluate(&[x])[0], cubic(c, x));
                // Second differences over steps of 0.05 magnify rounding of values up to 1e4.
                prop_assert!((got - want).abs() < 1e-8 * (1.0 + want.abs()), "{got} {want} at {x}");
            }
        }
    }

    #[test]
    fn two_knots_give_the_line_and_three_the_parabola() {
        let line = CubicSpline::fit(&[1.0, 3.0], &[2.0, -4.0]).unwrap();
        assert_eq!(line.evaluate(&[0.0, 2.0, 5.0]), [5.0, -1.0, -10.0]);
        let square = |x: f64| x * x - x + 0.5;
        let knots = [-1.0, 0.5, 4.0];
        let parabola = CubicSpline::fit(&knots, &knots.map(square)).unwrap();
        for x in [-2.0, -0.25, 1.0, 3.0, 6.0] {
            assert!((parabola.evaluate(&[x])[0] - square(x)).abs() < 1e-12, "at {x}");
        }
    }

    #[test]
    fn the_curve_passes_through_every_knot() {
        let knots = [0.0, 0.1, 0.7, 0.75, 2.0, 2.2, 5.0];
        let values = [1.0, -1.0, 3.0, 2.0, 2.0, -7.0, 0.0];
        let got = CubicSpline::fit(&knots, &values).unwrap().evaluate(&knots);
        for (g, v) in got.iter().zip(&values) {
            // The last knot is reached by evaluating its piece at the far end.
            assert!((g - v).abs() < 1e-12, "{got:?}");
        }
    }

    #[test]
    fn errors_name_both_values_and_the_way_out() {
        let short = CubicSpline::fit(&[0.0], &[0.0]).unwrap_err();
        assert_eq!(
            short.to_string(),
            "spline has 1 knots and 1 values; give at least 2 knots, one value each"
        );
        let flat = CubicSpline::fit(&[0.0, 1.5, 1.5], &[0.0; 3]).unwrap_err();
        assert_eq!(
            flat.to_string(),
            "spline knot 2 is 1.5 after 1.5; knots must be finite and strictly increasing"
        );
        assert!(CubicSpline::fit(&[0.0, f64::NAN], &[0.0; 2]).is_err());
    }
}
