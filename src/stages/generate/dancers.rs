//! The numbers of a motion of one dancer or several.

use ndarray::Array3;

use crate::evaluation::{Score, derivative_error, score};
use crate::motion::{Channel, ChannelLimits};

/// Returns the score of a motion, \[N, T, 25\], and the error of its velocities as they were decoded, m/s: means over the
/// dancers, and sums of their checks.
pub fn score_of_dancers(
    frames: &Array3<f32>,
    decoded: &Array3<f32>,
    limits: ChannelLimits,
    bars: Option<&[f64]>,
) -> (Score, f64) {
    let n_dancers = frames.dim().0 as f64;
    let errors = decoded.outer_iter().map(|dancer| {
        derivative_error(dancer, Channel::Position.columns(), Channel::Velocity.columns())
    });
    let velocity_error = errors.sum::<f64>() / n_dancers;
    let scores: Vec<Score> =
        frames.outer_iter().map(|dancer| score(dancer, limits, bars, velocity_error)).collect();
    let mean = |values: Vec<Option<f64>>| {
        let values: Option<Vec<f64>> = values.into_iter().collect();
        values.map(|values| values.iter().sum::<f64>() / n_dancers)
    };
    let sum = |of: fn(&Score) -> usize| scores.iter().map(of).sum::<usize>();
    let score = Score {
        total: mean(scores.iter().map(|score| score.total).collect()),
        n_passed: sum(|score| score.n_passed),
        n_checks: sum(|score| score.n_checks),
        locking: mean(scores.iter().map(|score| score.locking).collect()),
    };
    (score, velocity_error)
}
