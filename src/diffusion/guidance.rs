//! Classifier-free guidance.
//!
//! J. Ho and T. Salimans, "Classifier-Free Diffusion Guidance", NeurIPS workshop 2021,
//! arXiv 2207.12598.

use ndarray::{Array3, ArrayView3, Axis, Zip, concatenate};

use super::config::DiffusionError;

/// Returns u + scale · (c − u), the prediction of a condition exaggerated by `scale`.
///
/// It is computed as scale · c + (1 − scale) · u, which is c itself for 1 and u itself for 0. Ho and
/// Salimans' w (eq. 6) is scale − 1. Any of ε, x0 and v may be guided: the three are linear in each
/// other at one x_t.
///
/// # Shapes
/// `conditional` (c), `unconditional` (u): \[batch, frames, channels\]
///
/// # Panics
/// Where shapes differ.
pub fn guided(
    conditional: ArrayView3<'_, f32>,
    unconditional: ArrayView3<'_, f32>,
    scale: f64,
) -> Array3<f32> {
    let (to, away) = (scale as f32, (1.0 - scale) as f32);
    Zip::from(conditional).and(unconditional).map_collect(|&c, &u| to * c + away * u)
}

/// Returns the guided prediction of a network that can be told to ignore its condition.
///
/// `evaluate` takes x, t and one flag for each sample, `true` where the condition is dropped. Both
/// halves are one batch: x twice, first with the condition, then without. A scale of 1 evaluates only
/// the half with the condition, a scale of 0 only the one without.
///
/// # Shapes
/// - `x_t`, and what is returned: \[batch, frames, channels\]
/// - `evaluate`: \[2 batch, frames, channels\], t and \[2 batch\] flags → \[2 batch, frames, channels\];
///   batch instead of 2 batch for the scales 1 and 0. Samples i and batch + i have one condition
///
/// # Errors
/// A `scale` below 0 or not finite; those of `evaluate`; a result whose shape is not that of its x.
pub fn denoise_guided<E: From<DiffusionError>>(
    scale: f64,
    x_t: ArrayView3<'_, f32>,
    t: usize,
    mut evaluate: impl FnMut(ArrayView3<'_, f32>, usize, &[bool]) -> Result<Array3<f32>, E>,
) -> Result<Array3<f32>, E> {
    if !(scale >= 0.0 && scale.is_finite()) {
        return Err(DiffusionError::GuidanceScale { scale }.into());
    }
    let batch = x_t.len_of(Axis(0));
    if scale == 1.0 || scale == 0.0 {
        return evaluate(x_t, t, &vec![scale == 0.0; batch]);
    }
    let twice = concatenate(Axis(0), &[x_t, x_t]).expect("two views of one shape");
    let dropped: Vec<bool> = (0..2 * batch).map(|i| i >= batch).collect();
    let both = evaluate(twice.view(), t, &dropped)?;
    let (what, like) = ("the prediction of both halves", "the doubled batch");
    DiffusionError::check_shape(what, both.shape(), like, twice.shape())?;
    let (conditional, unconditional) = both.view().split_at(Axis(0), batch);
    Ok(guided(conditional, unconditional, scale))
}

#[cfg(test)]
mod tests {
    use std::cell::RefCell;

    use ndarray::{Slice, arr3};

    use super::*;

    /// c = x + t, u = 2 x: what was evaluated is kept in `calls`.
    fn network(
        calls: &RefCell<Vec<Vec<bool>>>,
    ) -> impl FnMut(ArrayView3<'_, f32>, usize, &[bool]) -> Result<Array3<f32>, DiffusionError>
    {
        |x, t, dropped| {
            calls.borrow_mut().push(dropped.to_vec());
            let mut y = x.to_owned();
            for (mut y, &dropped) in y.outer_iter_mut().zip(dropped) {
                y.mapv_inplace(|x| if dropped { 2.0 * x } else { x + t as f32 });
            }
            Ok(y)
        }
    }

    #[test]
    fn halves_are_one_batch_and_combine_as_published() {
        let x = arr3(&[[[1.0_f32, 2.0, 3.0]], [[4.0, 5.0, 6.0]]]);
        let calls = RefCell::new(Vec::new());
        for (scale, flags) in [
            (0.0, vec![true, true]),
            (1.0, vec![false, false]),
            (2.5, vec![false, false, true, true]),
        ] {
            calls.borrow_mut().clear();
            let got = denoise_guided(scale, x.view(), 7, network(&calls)).expect("a prediction");
            // u + s (c − u); every number here is a multiple of 1/2 that f32 holds.
            let wanted = x.mapv(|x| 2.0 * x + scale as f32 * (x + 7.0 - 2.0 * x));
            assert_eq!(got, wanted, "scale {scale}");
            assert_eq!(*calls.borrow(), [flags], "scale {scale}");
        }
    }

    #[test]
    fn bad_scales_and_shapes_are_refused() {
        let calls = RefCell::new(Vec::new());
        let x = Array3::zeros((2, 3, 5));
        for (scale, written) in [(-0.5, "-0.5"), (f64::NAN, "NaN"), (f64::INFINITY, "inf")] {
            let result = denoise_guided(scale, x.view(), 0, network(&calls));
            assert_eq!(
                result.expect_err("a bad scale").to_string(),
                format!(
                    "the guidance scale is {written}; it must be a number of at least 0: 1 follows \
                     the condition, above 1 exaggerates it, 0 ignores it"
                )
            );
        }
        assert!(calls.borrow().is_empty());
        let half = |x: ArrayView3<'_, f32>, _: usize, _: &[bool]| {
            Ok::<_, DiffusionError>(x.slice_axis(Axis(0), Slice::from(..1)).to_owned())
        };
        assert_eq!(
            denoise_guided(3.0, x.view(), 0, half).expect_err("half a batch").to_string(),
            "the prediction of both halves has shape [1, 3, 5]; [4, 3, 5] is needed, the shape of \
             the doubled batch"
        );
    }
}
