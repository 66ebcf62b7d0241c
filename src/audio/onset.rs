//! Onset strength: how much louder a frame is than the one before, over all mel bands.

use super::mel::N_MELS;

/// Onset strength of every frame, by mean and by median over the bands.
#[derive(Clone, Debug, PartialEq)]
pub struct Onset {
    /// The feature.
    pub mean: Vec<f32>,
    /// The envelope that the beat tracker follows.
    pub median: Vec<f32>,
}

/// Returns the spectral flux of mel decibels, [T, 128] row by row.
///
/// o\[0\] = 0, o\[t\] = aggregate over bands b of max(0, D\[t, b\] − D\[t−1, b\]) (Böck and Widmer 2013
/// without the maximum filter, as librosa's default).
pub fn onset_strength(db: &[f32]) -> Onset {
    let frames = || db.chunks_exact(N_MELS);
    let n_frames = frames().len();
    let (mut mean, mut median) = (vec![0.0; n_frames.min(1)], vec![0.0; n_frames.min(1)]);
    for (before, now) in frames().zip(frames().skip(1)) {
        let mut rise = [0f32; N_MELS];
        for ((r, b), n) in rise.iter_mut().zip(before).zip(now) {
            *r = (n - b).max(0.0);
        }
        mean.push((rise.iter().map(|&r| f64::from(r)).sum::<f64>() / N_MELS as f64) as f32);
        let (below, &mut upper, _) = rise.select_nth_unstable_by(N_MELS / 2, f32::total_cmp);
        let lower = below.iter().copied().fold(0.0, f32::max);
        // An even number of bands has two middle values.
        median.push((lower + upper) / 2.0);
    }
    Onset { mean, median }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rises_count_and_falls_do_not() {
        // Bands rise by their index, then fall back, then only the last 32 rise by 8.
        let ramp: Vec<f32> = (0..N_MELS).map(|b| b as f32).collect();
        let flat = vec![0.0; N_MELS];
        let late: Vec<f32> = (0..N_MELS).map(|b| if b >= 96 { 8.0 } else { 0.0 }).collect();
        let onset = onset_strength(&[flat.clone(), ramp, flat, late].concat());
        assert_eq!(onset.mean, [0.0, 63.5, 0.0, 2.0]);
        assert_eq!(onset.median, [0.0, 63.5, 0.0, 0.0]);
    }

    #[test]
    fn one_frame_has_no_onset() {
        let onset = onset_strength(&[-3.0; N_MELS]);
        assert_eq!((onset.mean, onset.median), (vec![0.0], vec![0.0]));
        assert_eq!(onset_strength(&[]).mean, Vec::<f32>::new());
    }
}
