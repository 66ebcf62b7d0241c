//! Order statistics with linear interpolation between ranks.

/// Percentile `p` of `values` by linear interpolation, `None` when there are none.
///
/// `Q(p) = x₍ₖ₎ + (h - k)(x₍ₖ₊₁₎ - x₍ₖ₎)` with `h = (n - 1) p / 100`, `k = ⌊h⌋` and `p` clamped to
/// `[0, 100]`; the values are reordered. Source: Hyndman and Fan, Sample Quantiles in Statistical
/// Packages, 1996, definition 7 (NumPy's default).
pub fn percentile(values: &mut [f64], p: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    let h = (values.len() - 1) as f64 * p.clamp(0.0, 100.0) / 100.0;
    let k = (h.floor() as usize).min(values.len() - 1);
    let (_, &mut low, above) = values.select_nth_unstable_by(k, f64::total_cmp);
    let high = above.iter().copied().min_by(f64::total_cmp).unwrap_or(low);
    Some(low + (h - k as f64) * (high - low))
}

/// Median of `values`, `None` when there are none; the values are reordered.
pub fn median(values: &mut [f64]) -> Option<f64> {
    percentile(values, 50.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_interpolate_between_ranks() {
        let x = [7.0, 1.0, 3.0, 11.0];
        assert_eq!(percentile(&mut x.clone(), 0.0), Some(1.0));
        assert_eq!(percentile(&mut x.clone(), 100.0), Some(11.0));
        assert_eq!(percentile(&mut x.clone(), 50.0), Some(5.0));
        // h = 3 * 0.9 = 2.7: seven tenths of the way from 7 to 11.
        let q = percentile(&mut x.clone(), 90.0).unwrap();
        assert!((q - 9.8).abs() < 1e-12, "{q}");
    }

    #[test]
    fn medians_of_odd_even_and_empty_sets() {
        assert_eq!(median(&mut [4.0, -2.0, 9.0]), Some(4.0));
        assert_eq!(median(&mut [4.0, -2.0]), Some(1.0));
        assert_eq!(median(&mut []), None);
    }
}
