//! What is left of motion that was written as tokens.

use super::{Number, by_song};
use crate::evaluation::ReconstructionError;
use crate::evaluation::interval::{Estimate, clustered_mean_estimate};

/// A phrase that was made again.
#[derive(Clone, Copy, Debug)]
pub struct ReconstructedPhrase {
    /// Number of the song.
    pub song: usize,
    pub error: ReconstructionError,
}

/// How a codebook is used by some motion.
#[derive(Clone, Copy, Debug)]
pub struct CodeUse {
    /// K, rows of the codebook.
    pub n_codes: usize,
    /// exp(−Σ p ln p) over all tokens.
    pub perplexity: f64,
    pub n_tokens: usize,
    pub n_frames: usize,
}

/// Measures how far phrases that were made again are off, and how the codebook is used.
pub fn reconstruction_numbers(phrases: &[ReconstructedPhrase], codes: CodeUse) -> Vec<Number> {
    let songs: Vec<usize> = phrases.iter().map(|phrase| phrase.song).collect();
    let error = |metric, unit, value: &dyn Fn(&ReconstructionError) -> f64| {
        let values: Vec<f64> = phrases.iter().map(|phrase| value(&phrase.error)).collect();
        let mean = clustered_mean_estimate(&values, &songs).non_negative();
        let protocol = "mean over the frames of a phrase, mean over phrases";
        Number::new(metric, "", unit, mean, protocol).with_songs(by_song(&values, &songs))
    };
    let CodeUse { n_codes, perplexity, n_tokens, n_frames } = codes;
    let share = Estimate::plain(Some(perplexity / n_codes as f64), n_tokens);
    let protocol = format!("exp(−Σ p ln p) of {n_tokens} tokens over K = {n_codes}");
    let per_frame = Estimate::plain(Some(n_tokens as f64 / n_frames as f64), n_tokens);
    vec![
        error("reconstruction_position", "cm", &|error| 100.0 * error.position_m),
        error("reconstruction_orientation", "°", &|error| error.orientation_deg),
        Number::new("code_perplexity", "share", "", share, protocol),
        Number::new(
            "code_perplexity",
            "codes",
            "codes",
            Estimate::plain(Some(perplexity), n_tokens),
            format!("exp(−Σ p ln p) of {n_tokens} tokens"),
        ),
        Number::new(
            "tokens_per_frame",
            "",
            "1/frame",
            per_frame,
            format!("{n_tokens} tokens for {n_frames} frames"),
        ),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_means_over_phrases_and_codes_are_counted_together() {
        let phrase = |song, position_m, orientation_deg| ReconstructedPhrase {
            song,
            error: ReconstructionError { position_m, orientation_deg },
        };
        let phrases = [phrase(3, 0.01, 2.0), phrase(3, 0.03, 4.0), phrase(5, 0.08, 3.0)];
        let codes = CodeUse { n_codes: 32, perplexity: 8.0, n_tokens: 75, n_frames: 300 };
        let numbers = reconstruction_numbers(&phrases, codes);
        let values: Vec<_> = numbers
            .iter()
            .map(|number| {
                (number.metric, &*number.variant, number.estimate.value.expect("a value"))
            })
            .collect();
        let wanted = [
            ("reconstruction_position", "", 4.0),
            ("reconstruction_orientation", "", 3.0),
            ("code_perplexity", "share", 0.25),
            ("code_perplexity", "codes", 8.0),
            ("tokens_per_frame", "", 0.25),
        ];
        for ((metric, variant, value), wanted) in values.into_iter().zip(wanted) {
            assert_eq!((metric, variant), (wanted.0, wanted.1));
            assert!((value - wanted.2).abs() < 1e-12, "{metric}: {value}");
        }
        assert_eq!(numbers[0].by_song[&3], 2.0);
        assert!(numbers[0].estimate.ci_low < Some(4.0) && numbers[0].estimate.n == 3);
    }
}
