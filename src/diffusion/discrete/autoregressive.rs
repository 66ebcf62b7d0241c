//! Ancestral sampling: one token after the other, each by those before it.

use super::TokenSampling;
use crate::diffusion::config::DiffusionError;

/// Draws tokens until there are so many, in order.
///
/// p(z) = Π p(z_n | z_1 … z_{n−1}), the chain rule.
///
/// - `given`: the tokens of the window, none where one is to be drawn
/// - `logits`: of the tokens so far ln p of each token to come next up to a constant, \[K\]
/// - `uniform`: the number of the draw n, for token n
///
/// # Errors
/// Settings that nothing can be drawn by, a token that is given and does not exist, errors of `logits`, and logits of
/// another length or that are no numbers.
pub fn sample_autoregressive<E: From<DiffusionError>>(
    sampling: &TokenSampling,
    given: &[Option<u32>],
    n_codes: usize,
    mut logits: impl FnMut(&[u32]) -> Result<Vec<f32>, E>,
    mut uniform: impl FnMut(usize) -> f64,
) -> Result<Vec<u32>, E> {
    sampling.check()?;
    if let Some(&token) = given.iter().flatten().find(|&&token| token >= n_codes as u32) {
        return Err(DiffusionError::Token { token, n_codes }.into());
    }
    let mut tokens = Vec::with_capacity(given.len());
    for known in given {
        if let Some(token) = known {
            tokens.push(*token);
            continue;
        }
        let logits = logits(&tokens)?;
        let (what, like) = ("what the planner says of a token", "the codes");
        DiffusionError::check_shape(what, &[logits.len()], like, &[n_codes])?;
        let (token, _) = sampling.draw(&logits, uniform(tokens.len()))?;
        tokens.push(token);
    }
    Ok(tokens)
}
