//! Smoothing of a signal that delays nothing: moving average and fitted polynomials.

use std::f64::consts::TAU;

use ndarray::Array2;

/// Returns the Hann weights of an odd window of `n` frames, all above 0:
/// `w[k] = (1 + cos(2π k / (n + 1))) / 2`, k from `-⌊n/2⌋` to `⌊n/2⌋`.
pub fn hann(n: usize) -> Vec<f64> {
    let half = (n / 2) as f64;
    (0..n).map(|i| 0.5 * (1.0 + (TAU * (i as f64 - half) / (n + 1) as f64).cos())).collect()
}

/// Returns the mean over `n` frames, odd, around each; near the ends the window shrinks evenly, so
/// that it stays centred and a straight line stays a line.
pub fn moving_average(x: &[f64], n: usize) -> Vec<f64> {
    (0..x.len())
        .map(|t| {
            let reach = (n / 2).min(t).min(x.len() - 1 - t);
            let around = &x[t - reach..=t + reach];
            around.iter().sum::<f64>() / around.len() as f64
        })
        .collect()
}

/// The polynomials of an order that are fitted to windows of a signal by least squares.
///
/// A frame takes the value of the polynomial fitted to the window around it; the frames near the ends
/// that of the first or last whole window. Source: Savitzky and Golay, Smoothing and Differentiation
/// of Data by Simplified Least Squares Procedures, Analytical Chemistry 36(8), 1964; for the ends,
/// Gorry, General Least-Squares Smoothing and Differentiation by the Convolution (Savitzky-Golay)
/// Method, Analytical Chemistry 62(6), 1990.
#[derive(Clone, Debug)]
pub struct Polynomials {
    /// `H = Q Qᵀ`, `[window, window]`: row i makes the value at frame i of a window out of the
    /// window's values; Q has orthonormal polynomials as its columns.
    fit: Array2<f64>,
}

impl Polynomials {
    /// Polynomials of `order` in odd windows of `window` frames, for signals of `n_frames`: a longer
    /// window, or a higher order than it allows, is cut to what the signal has room for.
    pub fn new(window: usize, order: usize, n_frames: usize) -> Self {
        let room = window.min(n_frames);
        // The longest odd window; none for no frames.
        let window = if room % 2 == 1 { room } else { room.saturating_sub(1) };
        let basis = orthonormal_polynomials(window, order.min(window.saturating_sub(1)));
        let fit = Array2::from_shape_fn((window, window), |(i, k)| {
            basis.iter().map(|p| p[i] * p[k]).sum::<f64>()
        });
        Self { fit }
    }

    /// Returns the signal, of the length given to [`Polynomials::new`], as the polynomials have it.
    pub fn smooth(&self, x: &[f64]) -> Vec<f64> {
        let window = self.fit.nrows();
        (0..x.len())
            .map(|t| {
                let start = t.saturating_sub(window / 2).min(x.len() - window);
                let weights = self.fit.row(t - start);
                weights.iter().zip(&x[start..]).map(|(w, x)| w * x).sum()
            })
            .collect()
    }
}

/// Polynomials of order 0 to `order` on `n` evenly spaced points, orthonormal as vectors: each is the
/// one before times x, less its parts along all before.
fn orthonormal_polynomials(n: usize, order: usize) -> Vec<Vec<f64>> {
    let half = (n / 2) as f64;
    let x: Vec<f64> = (0..n).map(|k| (k as f64 - half) / half.max(1.0)).collect();
    let mut basis: Vec<Vec<f64>> = Vec::with_capacity(order + 1);
    for _ in 0..=order {
        let mut p: Vec<f64> = match basis.last() {
            Some(before) => before.iter().zip(&x).map(|(p, x)| p * x).collect(),
            None => vec![1.0; n],
        };
        // Twice, since what the first pass leaves of a nearly parallel part is not small.
        for _ in 0..2 {
            for other in &basis {
                let along: f64 = p.iter().zip(other).map(|(p, q)| p * q).sum();
                for (p, q) in p.iter_mut().zip(other) {
                    *p -= along * q;
                }
            }
        }
        let norm = p.iter().map(|p| p * p).sum::<f64>().sqrt();
        for p in &mut p {
            *p /= norm;
        }
        basis.push(p);
    }
    basis
}

#[cfg(test)]
mod tests {
    use super::*;

    fn assert_close(found: &[f64], wanted: &[f64], tolerance: f64) {
        assert_eq!(found.len(), wanted.len());
        for (t, (a, b)) in found.iter().zip(wanted).enumerate() {
            assert!((a - b).abs() <= tolerance, "{a} against {b} at {t}");
        }
    }

    #[test]
    fn weights_of_five_frames_are_those_of_hann() {
        // cos(π/3) = 1/2, cos(2π/3) = -1/2.
        assert_close(&hann(5), &[0.25, 0.75, 1.0, 0.75, 0.25], 1e-15);
        assert_eq!(hann(1), [1.0]);
    }

    #[test]
    fn means_are_centred_up_to_the_ends() {
        let x = [3.0, 0.0, 0.0, 9.0, 0.0, 0.0, -6.0];
        assert_eq!(moving_average(&x, 3), [3.0, 1.0, 3.0, 3.0, 3.0, -2.0, -6.0]);
        assert_eq!(moving_average(&x, 1), x);
        let line: Vec<f64> = (0..11).map(|t| 2.0 - 0.5 * f64::from(t)).collect();
        assert_close(&moving_average(&line, 5), &line, 1e-15);
        assert_eq!(moving_average(&[], 5), [0.0; 0]);
    }

    #[test]
    fn the_weights_of_a_parabola_over_five_frames_are_the_published_ones() {
        let mut impulse = vec![0.0; 15];
        impulse[7] = 35.0;
        let found = Polynomials::new(5, 2, 15).smooth(&impulse);
        // Savitzky and Golay 1964, table I, in thirty-fifths.
        let wanted = [-3.0, 12.0, 17.0, 12.0, -3.0];
        assert_close(&found[5..10], &wanted, 1e-12);
        assert_close(&found[..5], &[0.0; 5], 1e-12);
        // A parabola and a cubic smooth alike in the middle of a window, not at its ends.
        assert_close(&Polynomials::new(5, 3, 15).smooth(&impulse), &found, 1e-12);
    }

    #[test]
    fn polynomials_of_the_order_stay_up_to_both_ends() {
        for (window, order, n) in [(5, 2, 5), (7, 3, 23), (9, 0, 10), (21, 5, 64), (31, 7, 31)] {
            let signal = |order: usize| -> Vec<f64> {
                let u = |t: usize| 2.0 * t as f64 / (n - 1) as f64 - 1.0;
                let power = |t: usize, k: usize| u(t).powi(k as i32) * (1.0 + 0.3 * k as f64);
                (0..n).map(|t| (0..=order).map(|k| power(t, k)).sum()).collect()
            };
            let polynomials = Polynomials::new(window, order, n);
            let x = signal(order);
            // Rounding of sums of up to 31 numbers of size 10.
            assert_close(&polynomials.smooth(&x), &x, 1e-12);
            let above = signal(order + 2);
            let found = polynomials.smooth(&above);
            assert!(found.iter().zip(&above).any(|(a, b)| (a - b).abs() > 1e-9), "{window}");
        }
    }

    #[test]
    fn a_signal_shorter_than_the_window_is_fitted_as_a_whole() {
        let x = [1.0, -2.0, 0.5, 4.0];
        // Three of the four frames, of which a parabola misses none.
        assert_close(&Polynomials::new(7, 3, 4).smooth(&x), &x, 1e-14);
        let mean = Polynomials::new(7, 0, 3).smooth(&x[..3]);
        assert_close(&mean, &[-1.0 / 6.0; 3], 1e-15);
        for n in 0..3 {
            assert_close(&Polynomials::new(7, 3, n).smooth(&x[..n]), &x[..n], 1e-15);
        }
    }

    #[test]
    fn what_is_not_a_number_spreads_over_its_windows_and_no_further() {
        let mut x = vec![1.0; 20];
        x[9] = f64::NAN;
        let found = Polynomials::new(5, 2, 20).smooth(&x);
        let nan: Vec<usize> = (0..20).filter(|&t| found[t].is_nan()).collect();
        assert_eq!(nan, [7, 8, 9, 10, 11]);
    }
}
