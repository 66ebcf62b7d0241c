//! The library's phrase whose music is nearest.

use ndarray::{Array1, Array2, ArrayBase, ArrayView1, ArrayView2, Axis, Data, Ix2, s};

use crate::audio::FEATURE_DIM;

/// Frames whose features are averaged before they are compared: short enough for a beat to keep its place,
/// long enough for the noise of single frames not to count.
pub const BLOCK_FRAMES: usize = 4;

/// Features that spread less over the library are constant, and say nothing.
const MIN_DEVIATION: f64 = 1e-6;

/// Phrases by their features.
#[derive(Clone, Debug)]
pub struct Retrieval {
    window_frames: usize,
    /// Of every feature over the blocks of all phrases.
    mean: Array1<f64>,
    /// 1 over the standard deviation; 0 for a feature that is constant.
    weight: Array1<f64>,
    /// Standardised means of blocks, \[n, n_blocks · 163\].
    keys: Array2<f32>,
}

impl Retrieval {
    /// Makes an index of phrases by the features of their first `window_frames` frames, `[T, 163]` each.
    ///
    /// They are taken one at a time, and of each only its key is kept, 163 numbers for every block. None without
    /// phrases, for one that is shorter, and where a feature is not finite.
    pub fn new<S: Data<Elem = f32>>(
        window_frames: usize,
        phrases: impl IntoIterator<Item = ArrayBase<S, Ix2>>,
    ) -> Option<Self> {
        let width = window_frames.div_ceil(BLOCK_FRAMES) * FEATURE_DIM;
        let mut rows: Vec<f32> = Vec::new();
        for features in phrases {
            if features.nrows() < window_frames {
                return None;
            }
            rows.extend(blocks(features.slice(s![..window_frames, ..])));
        }
        let n_phrases = rows.len() / width.max(1);
        if n_phrases == 0 || rows.iter().any(|x| !x.is_finite()) {
            return None;
        }
        let mut keys = Array2::from_shape_vec((n_phrases, width), rows).ok()?;
        let values_of_feature = |j: usize| keys.slice(s![.., j..;FEATURE_DIM]).mapv(f64::from);
        let mean =
            Array1::from_shape_fn(FEATURE_DIM, |j| values_of_feature(j).mean().unwrap_or(0.0));
        let weight = Array1::from_shape_fn(FEATURE_DIM, |j| {
            let deviation = values_of_feature(j).std(0.0);
            if deviation > MIN_DEVIATION { 1.0 / deviation } else { 0.0 }
        });
        for mut row in keys.rows_mut() {
            let key = standardised(row.view(), &mean, &weight);
            row.assign(&key);
        }
        Some(Self { window_frames, mean, weight, keys })
    }

    /// Returns the number of phrases.
    pub fn len(&self) -> usize {
        self.keys.nrows()
    }

    /// Whether there are no phrases; an index has some.
    pub fn is_empty(&self) -> bool {
        self.keys.is_empty()
    }

    /// Returns the phrase that is nearest to features, `[T, 163]`, and its distance; among equal distances the
    /// first phrase.
    ///
    /// `d² = mean over blocks and features of ((x - y) / s)²`, of the blocks that both have, x and y means
    /// over a block and s the standard deviation over the library. None for no frames, and where a feature is
    /// not finite.
    pub fn nearest(&self, features: ArrayView2<f32>) -> Option<(usize, f64)> {
        self.nearest_among(features, |_| true)
    }

    /// Returns the same among the phrases that `is_among` takes; none where there is no such phrase.
    pub fn nearest_among(
        &self,
        features: ArrayView2<f32>,
        is_among: impl Fn(usize) -> bool,
    ) -> Option<(usize, f64)> {
        let n = features.nrows().min(self.window_frames);
        let own = Array1::from(blocks(features.slice(s![..n, ..])));
        let own = standardised(own.view(), &self.mean, &self.weight);
        if own.is_empty() || own.iter().any(|x| !x.is_finite()) {
            return None;
        }
        let distance = |key: ArrayView1<f32>| {
            let squares = key.iter().zip(&own).map(|(a, b)| (a - b) * (a - b));
            f64::from(squares.sum::<f32>())
        };
        let nearest = self
            .keys
            .axis_iter(Axis(0))
            .enumerate()
            .filter(|(i, _)| is_among(*i))
            .map(|(i, key)| (i, distance(key)))
            .reduce(|best, next| if next.1 < best.1 { next } else { best })?;
        Some((nearest.0, (nearest.1 / own.len() as f64).sqrt()))
    }
}

/// Returns means over blocks of frames, one behind the other; the last block may be shorter.
fn blocks(features: ArrayView2<f32>) -> Vec<f32> {
    features
        .axis_chunks_iter(Axis(0), BLOCK_FRAMES)
        .filter_map(|block| block.mean_axis(Axis(0)))
        .flatten()
        .collect()
}

fn standardised(blocks: ArrayView1<f32>, mean: &Array1<f64>, weight: &Array1<f64>) -> Array1<f32> {
    let standardise = |(i, x): (usize, &f32)| {
        let j = i % FEATURE_DIM;
        ((f64::from(*x) - mean[j]) * weight[j]) as f32
    };
    blocks.iter().enumerate().map(standardise).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    const WINDOW: usize = 11;

    /// Features of a phrase: one channel has pulses every `period` frames, another is `level`.
    fn phrase(period: usize, level: f32) -> Array2<f32> {
        Array2::from_shape_fn((WINDOW + 2, FEATURE_DIM), |(t, j)| match j {
            5 => f32::from(u8::from(t % period == 0)),
            9 => level,
            _ => 0.25,
        })
    }

    fn index() -> Retrieval {
        let phrases = [phrase(3, 0.0), phrase(5, 0.0), phrase(5, 0.8), phrase(5, 0.8)];
        Retrieval::new(WINDOW, phrases.iter().map(|p| p.view())).expect("phrases")
    }

    #[test]
    fn a_phrase_is_nearest_to_itself_and_the_first_of_equals_is_told() {
        let index = index();
        assert_eq!((index.len(), index.is_empty()), (4, false));
        assert_eq!(index.nearest(phrase(5, 0.0).view()), Some((1, 0.0)));
        assert_eq!(index.nearest(phrase(5, 0.8).view()), Some((2, 0.0)));
        let (nearest, distance) = index.nearest(phrase(3, 0.1).view()).expect("finite");
        // Level: mean 0.4, deviation 0.4; off by a quarter of a deviation in one of 163 features.
        assert_eq!(nearest, 0);
        assert!((distance - 0.25 / (163.0_f64).sqrt()).abs() < 1e-6, "{distance}");
    }

    #[test]
    fn units_and_constant_features_do_not_count_and_less_than_a_window_is_enough() {
        let phrases = || [phrase(3, 0.0), phrase(5, 0.0), phrase(5, 0.8)];
        let plain = Retrieval::new(WINDOW, phrases()).expect("phrases");
        let scaled = |p: Array2<f32>| p * 1000.0 + 7.0;
        let index = Retrieval::new(WINDOW, phrases().map(scaled)).expect("phrases");
        let mut own = scaled(phrase(5, 0.7));
        own.column_mut(100).fill(-1e6);
        let (nearest, distance) = index.nearest(own.view()).expect("finite");
        let (same, as_far) = plain.nearest(phrase(5, 0.7).view()).expect("finite");
        // Single precision of 1000.
        assert!(
            nearest == 2 && same == 2 && (distance - as_far).abs() < 1e-5,
            "{distance}, {as_far}"
        );
        assert_eq!(index.nearest(own.slice(s![..6, ..])).map(|found| found.0), Some(2));
    }

    #[test]
    fn what_is_short_or_not_finite_is_no_phrase() {
        let short = Array2::<f32>::zeros((WINDOW - 1, FEATURE_DIM));
        assert!(Retrieval::new(WINDOW, [short.view()]).is_none());
        assert!(Retrieval::new(WINDOW, std::iter::empty::<Array2<f32>>()).is_none());
        let mut holed = phrase(3, 0.0);
        holed[[4, 8]] = f32::NAN;
        assert!(Retrieval::new(WINDOW, [holed.view()]).is_none());
        assert_eq!(index().nearest(holed.view()), None);
        assert_eq!(index().nearest(holed.slice(s![..0, ..])), None);
    }
}
