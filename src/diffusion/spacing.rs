//! Which of the trained steps a sampler visits.

use serde::{Deserialize, Serialize};

use super::config::DiffusionError;

/// How the steps of a sampler lie among the T that the network was trained on.
///
/// Lin et al., "Common Diffusion Noise Schedules and Sample Steps are Flawed", WACV 2024,
/// arXiv 2305.08891, table 2, whose steps count from 1; here they count from 0.
#[derive(
    Clone, Copy, Debug, PartialEq, Eq, Hash, Default, clap::ValueEnum, Serialize, Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum Spacing {
    /// From T − 1 down, T/n apart: begins with pure noise, as sampling does.
    #[default]
    Trailing,
    /// From 0 up, ⌊T/n⌋ apart: the first step visited is below T − 1.
    Leading,
    /// From T − 1 to 0 with both ends.
    Linspace,
    /// From T − 1 down, ⌊T/n⌋ apart, as the reference design samples: its last step leads to ᾱ_0
    /// instead of 1, so that what comes out keeps the noise of step 0. To reproduce its numbers only.
    Reference,
    /// The 27 steps of GLIDE (Nichol et al., ICML 2022, `respace.py`), dense where there is little noise; the first
    /// visited is T − 3.
    Fast27,
}

/// Steps that [`Spacing::Fast27`] has in each fifth of those that were trained, from the least noise on.
const FAST27: [usize; 5] = [10, 10, 3, 2, 2];
/// How many that are.
pub(super) const N_FAST27: usize = 27;

/// Returns GLIDE's 27 of T steps, T at least 50, highest first.
///
/// In each fifth n steps from its first to its last, evenly; then T − 3 in place of T − 1.
fn fast27(n_train: usize) -> Vec<usize> {
    let (size, more) = (n_train / FAST27.len(), n_train % FAST27.len());
    let (mut found, mut first) = (Vec::new(), 0);
    for (i, n) in FAST27.into_iter().enumerate() {
        let size = size + usize::from(i < more);
        found.extend((0..n).map(|j| first + rounded_ratio(j * (size - 1), n - 1)));
        first += size;
    }
    found.retain(|&t| t != n_train - 1);
    found.push(n_train - 3);
    found.sort_unstable_by(|a, b| b.cmp(a));
    found
}

/// One step of a sampler: from x_t to x at `next`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SamplerStep {
    pub t: usize,
    /// Where the step leads; `None` is clean data, ᾱ = 1.
    pub next: Option<usize>,
}

/// Returns the n steps that a sampler visits, highest first.
///
/// With i = 0 .. n − 1 and halves rounded to even:
///
/// - trailing: round(T − i T/n) − 1
/// - leading: (n − 1 − i) ⌊T/n⌋
/// - linspace: round((n − 1 − i) (T−1)/(n−1)), and T − 1 where n is 1
/// - reference: T − 1 − i ⌊T/n⌋
/// - fast27: see [`Spacing::Fast27`]
///
/// The timesteps are those of NumPy's `arange`, `linspace` and `round` in exact arithmetic.
///
/// # Errors
/// An `n_steps` of 0 or above `n_train`, or other than a spacing of a number of its own has.
pub fn timesteps(
    n_train: usize,
    n_steps: usize,
    spacing: Spacing,
) -> Result<Vec<usize>, DiffusionError> {
    if n_steps == 0 || n_steps > n_train {
        return Err(DiffusionError::SamplerSteps { n_steps, n_train });
    }
    if spacing == Spacing::Fast27 {
        // A fifth has at least as many steps as are taken of it.
        let is_long_enough = n_train / FAST27.len() >= FAST27[0];
        if n_steps != N_FAST27 || !is_long_enough {
            return Err(DiffusionError::Fast27 { n_steps, n_train });
        }
        return Ok(fast27(n_train));
    }
    let stride = n_train / n_steps;
    let step = |i: usize| match spacing {
        Spacing::Trailing => rounded_ratio(n_train * (n_steps - i), n_steps) - 1,
        Spacing::Leading => (n_steps - 1 - i) * stride,
        Spacing::Linspace if n_steps == 1 => n_train - 1,
        Spacing::Linspace => rounded_ratio((n_steps - 1 - i) * (n_train - 1), n_steps - 1),
        Spacing::Reference | Spacing::Fast27 => n_train - 1 - i * stride,
    };
    Ok((0..n_steps).map(step).collect())
}

/// Returns the steps of a sampler with where each leads: to the one after it, the last to clean
/// data (ᾱ = 1), or to t = 0 with [`Spacing::Reference`].
///
/// # Errors
/// Those of [`timesteps`].
pub fn steps(
    n_train: usize,
    n_steps: usize,
    spacing: Spacing,
) -> Result<Vec<SamplerStep>, DiffusionError> {
    let t = timesteps(n_train, n_steps, spacing)?;
    let end = (spacing == Spacing::Reference).then_some(0);
    let next = t.iter().skip(1).map(|&t| Some(t)).chain([end]);
    Ok(t.iter().zip(next).map(|(&t, next)| SamplerStep { t, next }).collect())
}

/// Returns a/b, b > 0, rounded to the nearest integer, halves to even.
fn rounded_ratio(a: usize, b: usize) -> usize {
    let (whole, rest) = (a / b, a % b);
    match (2 * rest).cmp(&b) {
        std::cmp::Ordering::Less => whole,
        std::cmp::Ordering::Equal => whole + whole % 2,
        std::cmp::Ordering::Greater => whole + 1,
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn ten_of_a_thousand_are_those_of_the_paper() {
        let ten_timesteps = |spacing| timesteps(1000, 10, spacing).expect("steps");
        // Table 2 counts from 1: 1, 101, .., 901; 1, 112, 223, .., 1000; 100, 200, .., 1000.
        assert_eq!(
            ten_timesteps(Spacing::Leading),
            [900, 800, 700, 600, 500, 400, 300, 200, 100, 0]
        );
        assert_eq!(
            ten_timesteps(Spacing::Linspace),
            [999, 888, 777, 666, 555, 444, 333, 222, 111, 0]
        );
        assert_eq!(
            ten_timesteps(Spacing::Trailing),
            [999, 899, 799, 699, 599, 499, 399, 299, 199, 99]
        );
        assert_eq!(ten_timesteps(Spacing::Reference), ten_timesteps(Spacing::Trailing));
        // 1000/3 is not whole: the reference's stride is 333, trailing rounds 666.67 and 333.33.
        assert_eq!(timesteps(1000, 3, Spacing::Reference), Ok(vec![999, 666, 333]));
        assert_eq!(timesteps(1000, 3, Spacing::Trailing), Ok(vec![999, 666, 332]));
    }

    #[test]
    fn the_fast_ones_are_glides() {
        // `space_timesteps(1000, "fast27")` of glide_text2im/respace.py.
        let mut glide = [
            0, 22, 44, 66, 88, 111, 133, 155, 177, 199, 200, 222, 244, 266, 288, 311, 333, 355,
            377, 399, 400, 500, 599, 600, 799, 800, 997,
        ];
        glide.reverse();
        assert_eq!(timesteps(1000, 27, Spacing::Fast27).as_deref(), Ok(&glide[..]));
        for n_train in [50, 53, 999] {
            let t = timesteps(n_train, 27, Spacing::Fast27).expect("steps");
            assert_eq!((t.len(), t[0], t[26]), (27, n_train - 3, 0), "{n_train}");
            assert!(t.windows(2).all(|pair| pair[0] > pair[1]), "{t:?}");
        }
        for (n_train, n_steps) in [(1000, 20), (49, 27)] {
            assert_eq!(
                timesteps(n_train, n_steps, Spacing::Fast27).expect_err("others").to_string(),
                format!(
                    "the spacing fast27 takes 27 of at least 50 steps, and {n_steps} of {n_train} are asked for; \
                     give the sampler 27 steps, or another spacing"
                )
            );
        }
    }

    #[test]
    fn the_last_step_leads_to_clean_data_but_for_the_reference() {
        let two_steps = |spacing| steps(20, 2, spacing).expect("steps");
        let step = |t, next| SamplerStep { t, next };
        assert_eq!(two_steps(Spacing::Trailing), [step(19, Some(9)), step(9, None)]);
        assert_eq!(two_steps(Spacing::Leading), [step(10, Some(0)), step(0, None)]);
        assert_eq!(two_steps(Spacing::Linspace), [step(19, Some(0)), step(0, None)]);
        assert_eq!(two_steps(Spacing::Reference), [step(19, Some(9)), step(9, Some(0))]);
    }

    #[test]
    fn too_few_and_too_many_steps_are_refused() {
        for n_steps in [0, 51] {
            assert_eq!(
                timesteps(50, n_steps, Spacing::Trailing).expect_err("steps").to_string(),
                format!(
                    "n_steps of the sampler is {n_steps}; it must be 1 to 50, the number of steps \
                     that the network was trained on"
                )
            );
        }
    }

    proptest! {
        #[test]
        fn steps_descend_from_the_top_within_range(
            (n_train, n_steps) in (1_usize..1500).prop_flat_map(|n| (Just(n), 1..=n)),
            spacing in proptest::sample::select(&[
                Spacing::Trailing, Spacing::Leading, Spacing::Linspace, Spacing::Reference,
            ][..]),
        ) {
            let t = timesteps(n_train, n_steps, spacing).expect("steps");
            prop_assert_eq!(t.len(), n_steps);
            prop_assert!(t.windows(2).all(|pair| pair[0] > pair[1]), "{:?}", t);
            prop_assert!(t[0] < n_train);
            if spacing != Spacing::Leading {
                prop_assert_eq!(t[0], n_train - 1);
            }
            if matches!(spacing, Spacing::Leading | Spacing::Linspace) && n_steps > 1 {
                prop_assert_eq!(t[n_steps - 1], 0);
            }
        }
    }
}
