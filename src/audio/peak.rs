//! The largest sample of a signal.

use crate::instructions::vectorized;

vectorized! {
    /// Returns the largest magnitude of some samples, 0 of none; not finite if one of them is not.
    pub fn peak(samples: &[f32]) -> f32 {
        // Magnitudes are ordered as the integers that their bits are, with NaN above infinity; and
        // maxima of integers vectorise.
        f32::from_bits(samples.iter().fold(0, |peak, y| peak.max(y.abs().to_bits())))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_largest_magnitude_is_found_wherever_it_is() {
        for n in [1, 7, 16, 33] {
            for at in 0..n {
                let mut samples: Vec<f32> = (0..n).map(|i| 0.01 * i as f32).collect();
                samples[at] = -0.75;
                assert_eq!(peak(&samples), 0.75, "{at} of {n}");
                samples[at] = f32::NEG_INFINITY;
                assert_eq!(peak(&samples), f32::INFINITY);
                samples[at] = -f32::NAN;
                assert!(peak(&samples).is_nan());
            }
        }
        assert_eq!(peak(&[]), 0.0);
    }
}
