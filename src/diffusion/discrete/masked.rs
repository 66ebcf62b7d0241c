//! Masked discrete diffusion: all tokens of a window are drawn again and again, and the surest stay.

use ndarray::Array2;

use super::{TokenSampling, n_masked};
use crate::diffusion::config::DiffusionError;

/// Draws the tokens of a window.
///
/// In iteration i of n, at r = i / (n − 1) of the way, the n_masked(r) least sure of the tokens that are not given are
/// masked, and drawn from what the planner says of all. A token is as sure as ln p + τ (1 − r) g, where p is its
/// probability when it was drawn, τ the confidence temperature and g Gumbel's noise; of equal ones the first is masked
/// first. Tokens that are not masked stay, so that with τ large and one token left from iteration to iteration the
/// chain rule gives the planner's joint distribution.
///
/// - `given`: the tokens of the window, none where one is to be drawn
/// - `n_codes`: K, which stands for a token that is not known
/// - `logits`: of the tokens of a window, K where masked, ln p of each token of each position up to a constant, \[N, K\]
/// - `uniform`: fills in the numbers of a draw; draw 2i are those of iteration i by which tokens are drawn, 2i + 1
///   those of Gumbel's noise, which is not asked for where τ is 0
///
/// # Errors
/// Settings that nothing can be drawn by, a token that is given and does not exist, errors of `logits`, and logits of
/// another shape or that are no numbers.
pub fn sample_masked<E: From<DiffusionError>>(
    sampling: &TokenSampling,
    given: &[Option<u32>],
    n_codes: usize,
    mut logits: impl FnMut(&[u32]) -> Result<Array2<f32>, E>,
    mut uniform: impl FnMut(usize, &mut [f64]),
) -> Result<Vec<u32>, E> {
    sampling.check()?;
    let mask = n_codes as u32;
    if let Some(&token) = given.iter().flatten().find(|&&token| token >= mask) {
        return Err(DiffusionError::Token { token, n_codes }.into());
    }
    let open: Vec<usize> = (0..given.len()).filter(|&n| given[n].is_none()).collect();
    let mut tokens: Vec<u32> = given.iter().map(|token| token.unwrap_or(mask)).collect();
    let mut sureness = vec![f64::NEG_INFINITY; given.len()];
    let mut numbers = vec![0.0; given.len()];
    let n = sampling.n_iterations;
    // Where everything is given there is nothing to ask.
    for i in 0..if open.is_empty() { 0 } else { n } {
        let r = if n == 1 { 0.0 } else { i as f64 / (n - 1) as f64 };
        let mut masked = open.clone();
        masked.sort_by(|&a, &b| sureness[a].total_cmp(&sureness[b]));
        for &n in &masked.split_off(n_masked(open.len(), r)) {
            sureness[n] = f64::INFINITY;
        }
        masked.iter().for_each(|&n| tokens[n] = mask);
        let logits = logits(&tokens)?;
        let wanted = [given.len(), n_codes];
        DiffusionError::check_shape(
            "what the planner says",
            logits.shape(),
            "tokens by codes",
            &wanted,
        )?;
        let logits = logits.as_standard_layout();
        let rows: Vec<&[f32]> =
            logits.as_slice().map(|all| all.chunks(n_codes).collect()).unwrap_or_default();
        uniform(2 * i, &mut numbers);
        for &n in &masked {
            (tokens[n], sureness[n]) = sampling.draw(rows[n], numbers[n])?;
        }
        let tau = sampling.confidence_temperature * (1.0 - r);
        if tau > 0.0 {
            uniform(2 * i + 1, &mut numbers);
            for &n in &masked {
                // −ln(−ln u), u kept off 0 and 1.
                let u = numbers[n].clamp(f64::MIN_POSITIVE, 1.0 - f64::EPSILON);
                sureness[n] -= tau * (-u.ln()).ln();
            }
        }
    }
    Ok(tokens)
}
