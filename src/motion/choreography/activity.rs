//! How active a song is at every frame, as a rank among its own frames.

use crate::motion::style::{WINDOW_FRAMES, Window};

/// Returns the activity of every frame, in (0, 1).
///
/// `a = rank(rank(R) + rank(O))` with `R` and `O` the RMS and the onset strength averaged over a
/// Hann window of 2 s, and `rank` the share of the song's frames that are lower, equal ones counting
/// half. Ranks make songs of any loudness comparable: half of every song is more active than 0.5.
pub fn activity(rms: &[f32], onset_strength: &[f32]) -> Vec<f64> {
    let n_frames = rms.len().min(onset_strength.len());
    if n_frames == 0 {
        return Vec::new();
    }
    let window = Window::hann(WINDOW_FRAMES.min(n_frames));
    let smooth =
        |x: &[f32]| window.mean(&x[..n_frames].iter().map(|&x| f64::from(x)).collect::<Vec<_>>());
    let (loud, struck) = (ranks(&smooth(rms)), ranks(&smooth(onset_strength)));
    ranks(&loud.iter().zip(&struck).map(|(a, b)| a + b).collect::<Vec<_>>())
}

/// Returns the rank of every value among all, in (0, 1): the share that is lower, equal ones counting
/// half.
pub fn ranks(values: &[f64]) -> Vec<f64> {
    // Means of equal values in different order differ by rounding; that is no difference.
    let rounded: Vec<f64> = values.iter().map(|x| (x * 1e9).round()).collect();
    let mut sorted = rounded.clone();
    sorted.sort_by(f64::total_cmp);
    rounded.iter().map(|&x| mid_rank(&sorted, x)).collect()
}

/// Returns the share of `sorted` that is lower than `x`, equal ones counting half.
pub fn mid_rank(sorted: &[f64], x: f64) -> f64 {
    let lower = sorted.partition_point(|&y| y < x);
    let not_higher = sorted.partition_point(|&y| y <= x);
    (lower + not_higher) as f64 / (2 * sorted.len()).max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranks_count_equal_values_half() {
        assert_eq!(ranks(&[3.0, 1.0, 3.0, 9.0]), [0.5, 0.125, 0.5, 0.875]);
        assert_eq!(ranks(&[2.0; 5]), [0.5; 5]);
        assert_eq!(mid_rank(&[], 1.0), 0.0);
    }

    #[test]
    fn a_song_that_grows_is_most_active_at_its_end() {
        let n = 301;
        let grows: Vec<f32> = (0..n).map(|t| t as f32 / n as f32).collect();
        let found = activity(&grows, &vec![0.25; n]);
        assert_eq!(found.len(), n);
        // The window repeats the first and the last value, so both ends are flat for a second.
        assert!(found.is_sorted() && found[0] < 0.01 && found[n - 1] > 0.99, "{found:?}");
        assert!((found[150] - 0.5).abs() < 0.01, "{}", found[150]);
    }

    #[test]
    fn loudness_and_onsets_count_alike() {
        let loud_then_soft: Vec<f32> = (0..400).map(|t| if t < 200 { 1.0 } else { 0.1 }).collect();
        let soft_then_struck: Vec<f32> = loud_then_soft.iter().rev().copied().collect();
        let found = activity(&loud_then_soft, &soft_then_struck);
        assert!((found[50] - found[350]).abs() < 0.05, "{} {}", found[50], found[350]);
        assert_eq!(activity(&[0.5; 7], &[0.5; 7]), [0.5; 7]);
        assert!(activity(&[], &[0.5]).is_empty());
    }
}
