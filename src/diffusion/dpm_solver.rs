//! DPM-Solver++(2M): a multistep solver of second order for 8 to 20 steps.
//!
//! C. Lu et al., "DPM-Solver++: Fast Solver for Guided Sampling of Diffusion Probabilistic Models",
//! arXiv 2211.01095, 2022, algorithm 2.

use super::schedule::Schedule;

/// The factors of x_next = `x_t` · x_t + `x0` · x̂0 + `previous` · (x̂0 of the step before).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DpmCoefficients {
    pub x_t: f64,
    pub x0: f64,
    pub previous: f64,
}

/// Returns the step of the solver from t to `next`; `None` is clean data.
///
/// With λ = ln(√ᾱ/√(1−ᾱ)), h = λ_next − λ_t, and r = (λ_t − λ_previous) / h:
///
/// D = (1 + 1/2r) x̂0 − 1/2r x̂0_previous
/// x_next = √((1−ᾱ')/(1−ᾱ)) x_t − √ᾱ' (e^−h − 1) D
///
/// Without a `previous` step D = x̂0, which is first order and the same as DDIM with η = 0. So it is
/// where `next` is clean data: h is infinite there, and the limit of the first order is x̂0 itself.
///
/// - `t`, `next`, `previous`: below `schedule.len()`; `next` at most t, `previous` above t
pub fn dpm_solver_update(
    schedule: &Schedule,
    t: usize,
    next: Option<usize>,
    previous: Option<usize>,
) -> DpmCoefficients {
    let (from, to) = (schedule.level(Some(t)), schedule.level(next));
    let h = to.log_ratio() - from.log_ratio();
    let x_t = to.noise / from.noise;
    let x0 = -to.signal * (-h).exp_m1();
    match previous {
        Some(previous) if next.is_some() => {
            let h_before = from.log_ratio() - schedule.level(Some(previous)).log_ratio();
            let half = h / (2.0 * h_before);
            DpmCoefficients { x_t, x0: x0 * (1.0 + half), previous: -x0 * half }
        }
        _ => DpmCoefficients { x_t, x0, previous: 0.0 },
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::diffusion::DiffusionConfig;
    use crate::diffusion::ddim::ddim_update;

    #[test]
    fn the_first_order_is_ddim() {
        let schedule = Schedule::new(&DiffusionConfig::default()).expect("a schedule");
        for (t, next) in [(999, Some(949)), (400, Some(399)), (49, Some(0)), (49, None)] {
            let update = dpm_solver_update(&schedule, t, next, None);
            let ddim = ddim_update(&schedule, t, next, 0.0);
            // DDIM in x_t and x̂0: ε̂ = (x_t − √ᾱ x̂0) / √(1−ᾱ).
            let level = schedule.level(Some(t));
            let x_t = ddim.epsilon / level.noise;
            let x0 = ddim.x0 - level.signal * x_t;
            assert!((update.x_t - x_t).abs() < 1e-12, "{t} to {next:?}: {update:?}, {x_t}");
            assert!((update.x0 - x0).abs() < 1e-12, "{t} to {next:?}: {update:?}, {x0}");
            assert_eq!(update.previous, 0.0);
        }
    }

    #[test]
    fn the_last_step_is_the_estimate_whatever_came_before() {
        let schedule = Schedule::new(&DiffusionConfig::default()).expect("a schedule");
        let update = dpm_solver_update(&schedule, 49, None, Some(99));
        assert_eq!(update, DpmCoefficients { x_t: 0.0, x0: 1.0, previous: 0.0 });
    }

    #[test]
    fn the_second_order_is_exact_where_x0_is_linear_in_lambda() {
        // d(x/σ)/dλ = e^λ x̂0(λ). With x̂0 = λ the integral is e^λ (λ − 1); the method replaces λ by
        // its value at the middle of the step, so its error is of third order in h.
        let config = DiffusionConfig { n_steps: 1000, ..Default::default() };
        let schedule = Schedule::new(&config).expect("a schedule");
        let error = |width: usize| {
            let (previous, t, next) = (500 + width, 500, 500 - width);
            let level = |t| schedule.level(Some(t));
            let lambda = |t| level(t).log_ratio();
            let exact = |from: usize, to: usize| {
                let part = |t: usize| lambda(t).exp() * (lambda(t) - 1.0);
                level(to).noise * (part(to) - part(from))
            };
            let update = dpm_solver_update(&schedule, t, Some(next), Some(previous));
            let got = update.x0 * lambda(t) + update.previous * lambda(previous);
            (got - exact(t, next)).abs()
        };
        let order = (error(64) / error(32)).log2();
        assert!((order - 3.0).abs() < 0.3, "the error of a step falls with order {order}");
    }
}
