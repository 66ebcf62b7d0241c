//! Losses on the estimate of clean motion: what it says of its derivatives, and how it changes from frame to
//! frame.
//!
//! A mean squared error of channels side by side lets positions tremble: at 30 frames a second a millimetre
//! of noise is 0.04 m/s of velocity and 140 m/s³ of jerk. Velocity and acceleration consistency are those of
//! Tevet et al., "Human Motion Diffusion Model", ICLR 2023 (arXiv 2209.14916, section 3.1, L_vel) and Tseng et
//! al., "EDGE", CVPR 2023 (arXiv 2211.10658, section 3.1); with the prediction of x0 they cost no further call.

use serde::{Deserialize, Serialize};

use crate::autodiff::op::binary::{Binary, Pair};
use crate::autodiff::op::frames::TakeFrames;
use crate::autodiff::op::loss::{Cost, Loss};
use crate::autodiff::{Element, Interpreter, Tensor};
use crate::diffusion::{Schedule, ddim_linear};
use crate::model::{Graph, Result};
use crate::motion::{Columns, Normalizer};
use crate::units::FPS;

/// Ratio of the size of a derivative of captured motion to that of the one before, 1/s: its jerk is 19 times its
/// acceleration (38 m/s³ and 2 m/s² on constructed dance, 42 and 2.2 on captured).
const RATE_PER_S: f64 = 20.0;

/// Weights of the losses on the estimate; with zeros nothing is added.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EstimateLosses {
    /// Of velocities against differences of positions.
    pub velocity: f64,
    /// Of accelerations against differences of velocities.
    pub acceleration: f64,
    /// Of the first, second and third differences of poses against the truth's.
    pub differences: [f64; 3],
}

impl EstimateLosses {
    /// Returns whether nothing is added.
    pub fn is_none(&self) -> bool {
        let Self { velocity, acceleration, differences } = self;
        *velocity == 0.0 && *acceleration == 0.0 && *differences == [0.0; 3]
    }

    /// Returns the weighted sum of the losses of a prediction; none where all weights are 0.
    ///
    /// With ẑ the estimate and z the motion in units of their spread, s the spread of a channel in its own unit,
    /// f = 30 Hz, D the difference to the next frame, and ⟨x⟩ the sum over differences whose frames all count over
    /// the number of frames that count, so that the losses of parts of a batch add up:
    ///
    /// - velocity ⟨(v̂ − f D p̂)² / s_v²⟩, acceleration ⟨(â − f D v̂)² / s_a²⟩
    /// - differences k = 1, 2, 3: ⟨(f^k D^k (p̂ − p))² / u_k²⟩ with u = s_v, s_a, 20 s_a, over positions, and over
    ///   quaternions with u = s_ω/2, 20 s_ω/2, 400 s_ω/2 (|q̇| = |ω|/2)
    ///
    /// Where the layout lacks a derivative, its residual is not added, and its spread counts as 20/s times that of what
    /// it would be the derivative of.
    ///
    /// # Shapes
    /// - `prediction`: \[batch, frames, columns\]; `x_t`, `motion`: the same, normalised; `t`: \[batch\]; `mask`:
    ///   \[batch, frames\], 1 or 0
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn loss<I: Interpreter>(
        &self,
        g: &mut I,
        normalizer: &Normalizer,
        (schedule, t): (&Schedule, &[usize]),
        [prediction, x_t]: [&Tensor<I::Element>; 2],
        (motion, mask): (&[f32], &[f32]),
    ) -> Result<Option<Tensor<I::Element>>> {
        // Of three frames there is no third difference.
        if self.is_none() || prediction.shape()[1] < 4 {
            return Ok(None);
        }
        let estimate = estimate(g, (schedule, t), [prediction, x_t])?;
        let body = normalizer.layout().body();
        let (p, v, a) = (body.position, body.velocity, body.acceleration);
        let mut terms: Vec<(f64, Tensor<I::Element>)> = Vec::new();
        for (weight, value, derivative) in [(self.velocity, Some(p), v), (self.acceleration, v, a)]
        {
            if let (true, Some(value), Some(derivative)) = (weight > 0.0, value, derivative) {
                let residual = residual(g, &estimate, [value, derivative], normalizer)?;
                terms.push((weight, mean_square(g, &residual, mask, 1)?));
            }
        }
        if self.differences != [0.0; 3] {
            let spread =
                |columns: Columns, i: usize| f64::from(normalizer.scale[columns.first + i]);
            let speed = |i: usize| v.map_or(RATE_PER_S * spread(p, i), |v| spread(v, i));
            let change = |i: usize| a.map_or(RATE_PER_S * speed(i), |a| spread(a, i));
            let turn = match body.angular_velocity {
                Some(omega) => (0..3).map(|i| spread(omega, i)).sum::<f64>() / 6.0,
                None => RATE_PER_S * (1..4).map(|i| spread(body.orientation, i)).sum::<f64>() / 3.0,
            };
            let poses = [p, body.orientation];
            let truth = constant(g, prediction.shape(), motion);
            let error = g.apply(Binary::new(Pair::Subtract), &[&estimate, &truth])?;
            let parts = poses
                .map(|columns| g.channels(&error, columns.range()))
                .into_iter()
                .collect::<Result<Vec<_>>>()?;
            let mut error = g.concat(&parts.iter().collect::<Vec<_>>())?;
            for (order, &weight) in (1..).zip(&self.differences) {
                error = difference(g, &error)?;
                if weight == 0.0 {
                    continue;
                }
                let growth = (FPS / RATE_PER_S).powi(order - 1);
                let units: Vec<f64> = (0..3)
                    .map(|i| match order {
                        1 => FPS * spread(p, i) / speed(i),
                        // f² / s_a, and f³ / (20 s_a).
                        _ => FPS * RATE_PER_S * growth * spread(p, i) / change(i),
                    })
                    .chain((0..4).map(|i| FPS * growth * spread(body.orientation, i) / turn))
                    .collect();
                let scaled = times(g, &error, &units)?;
                terms.push((weight, mean_square(g, &scaled, mask, order as usize)?));
            }
        }
        let mut sum: Option<Tensor<I::Element>> = None;
        for (weight, term) in terms {
            let term = g.scale(&term, weight)?;
            sum = Some(match sum {
                None => term,
                Some(sum) => g.apply(Binary::new(Pair::Add), &[&sum, &term])?,
            });
        }
        Ok(sum)
    }
}

/// x̂0 = A x_t + B prediction, sample by sample.
fn estimate<I: Interpreter>(
    g: &mut I,
    (schedule, t): (&Schedule, &[usize]),
    [prediction, x_t]: [&Tensor<I::Element>; 2],
) -> Result<Tensor<I::Element>> {
    let factors: Vec<(f64, f64)> = t.iter().map(|&t| ddim_linear(schedule, t, None)).collect();
    if factors.iter().all(|&factors| factors == (0.0, 1.0)) {
        return Ok(prediction.clone());
    }
    let size = prediction.len() / t.len().max(1);
    let whole = |g: &I, factor: fn(&(f64, f64)) -> f64| {
        let values: Vec<_> = factors
            .iter()
            .flat_map(|factors| std::iter::repeat_n(I::Element::from_f64(factor(factors)), size))
            .collect();
        g.constant(prediction.shape(), &values)
    };
    let (a, b) = (whole(g, |factors| factors.0), whole(g, |factors| factors.1));
    let (x, y) = (g.mul(x_t, &a)?, g.mul(prediction, &b)?);
    g.add(&x, &y)
}

/// (ŷ − f D x̂) / s_y for columns x and their derivative y, \[batch, frames − 1, 3\].
fn residual<I: Interpreter>(
    g: &mut I,
    estimate: &Tensor<I::Element>,
    [value, derivative]: [Columns; 2],
    normalizer: &Normalizer,
) -> Result<Tensor<I::Element>> {
    let scale = |i: usize| f64::from(normalizer.scale[i]);
    let centre = |i: usize| f64::from(normalizer.centre[i]);
    let (x, y) = (value.range(), derivative.range());
    let change = g.channels(estimate, x.clone())?;
    let change = difference(g, &change)?;
    let units: Vec<f64> =
        x.clone().zip(y.clone()).map(|(x, y)| -FPS * scale(x) / scale(y)).collect();
    let change = times(g, &change, &units)?;
    let said = g.channels(estimate, y.clone())?;
    let said = g.apply(TakeFrames::inner(0, 1), &[&said])?;
    let shift: Vec<f32> = y.map(|y| (centre(y) / scale(y)) as f32).collect();
    let shift = constant(g, &[shift.len()], &shift);
    let said = g.apply(Binary::new(Pair::Add), &[&said, &shift])?;
    g.add(&said, &change)
}

/// x\[t + 1\] − x\[t\], \[batch, frames − 1, channels\].
fn difference<I: Interpreter>(g: &mut I, x: &Tensor<I::Element>) -> Result<Tensor<I::Element>> {
    let head = g.apply(TakeFrames::inner(0, 1), &[x])?;
    let tail = g.apply(TakeFrames::inner(1, 0), &[x])?;
    g.apply(Binary::new(Pair::Subtract), &[&tail, &head])
}

/// Multiplies each channel by a number of its own.
fn times<I: Interpreter>(
    g: &mut I,
    x: &Tensor<I::Element>,
    factors: &[f64],
) -> Result<Tensor<I::Element>> {
    let factors: Vec<_> = factors.iter().map(|&factor| I::Element::from_f64(factor)).collect();
    let factors = g.constant(&[factors.len()], &factors);
    g.apply(Binary::new(Pair::Multiply), &[x, &factors])
}

/// ⟨x²⟩: the sum over rows of differences of an order all of whose frames count, over the frames that count.
fn mean_square<I: Interpreter>(
    g: &mut I,
    x: &Tensor<I::Element>,
    mask: &[f32],
    order: usize,
) -> Result<Tensor<I::Element>> {
    let (batch, rows) = (x.shape()[0], x.shape()[1]);
    let weights: Vec<f32> = mask
        .chunks_exact(rows + order)
        .flat_map(|mask| mask.windows(order + 1).map(|frames| frames.iter().product()))
        .collect();
    let sum = |values: &[f32]| values.iter().map(|&w| f64::from(w)).sum::<f64>();
    let share = sum(&weights) / sum(mask).max(1.0);
    let weights = constant(g, &[batch, rows], &weights);
    let zero = g.constant(x.shape(), &vec![I::Element::ZERO; x.len()]);
    let mean = g.apply(Loss::new(Cost::Squared), &[x, &zero, &weights])?;
    g.scale(&mean, share)
}

fn constant<I: Interpreter>(g: &I, shape: &[usize], values: &[f32]) -> Tensor<I::Element> {
    let values: Vec<_> = values.iter().map(|&x| I::Element::from_f64(x.into())).collect();
    g.constant(shape, &values)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::autodiff::{Arena, Eager, Parameters};
    use crate::diffusion::{DiffusionConfig, Prediction};
    use crate::model::ParameterList;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::{BODY, Layout, MOTION_DIM};

    const FRAMES: usize = 7;

    fn normalizer(layout: Layout) -> Normalizer {
        let mut normalizer = Normalizer::identity_of(layout);
        for i in 0..layout.width() {
            normalizer.scale[i] = 0.5 + 0.1 * i as f32;
            normalizer.centre[i] = 0.02 * i as f32 - 0.1;
        }
        normalizer
    }

    /// Numbers that no two channels share.
    fn numbers(layout: Layout, seed: f64) -> Vec<f32> {
        (0..2 * FRAMES * layout.width()).map(|i| (0.7 * i as f64 + seed).sin() as f32).collect()
    }

    fn loss_of(
        layout: Layout,
        losses: &EstimateLosses,
        prediction: Prediction,
        t: [usize; 2],
        [says, x_t, motion]: [&[f32]; 3],
        mask: &[f32],
    ) -> f64 {
        let config = DiffusionConfig { prediction, ..DiffusionConfig::default() };
        let schedule = Schedule::new(&config).expect("a schedule");
        let parameters = Parameters::<f64>::new(ParameterList::default(), 0);
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        let shape = [2, FRAMES, layout.width()];
        let [says, x_t] = [says, x_t].map(|values| constant(&g, &shape, values));
        let n = normalizer(layout);
        let loss = losses.loss(&mut g, &n, (&schedule, &t), [&says, &x_t], (motion, mask));
        loss.expect("shapes fit").expect("a loss").scalar()
    }

    /// The definition, in loops.
    fn expected(losses: &EstimateLosses, estimate: &[f64], motion: &[f32], mask: &[f32]) -> f64 {
        let n = normalizer(BODY);
        let at = |values: &dyn Fn(usize) -> f64, b: usize, t: usize, i: usize| {
            values((b * FRAMES + t) * MOTION_DIM + i) * f64::from(n.scale[i])
                + f64::from(n.centre[i])
        };
        let said = |b, t, i| at(&|k| estimate[k], b, t, i);
        let true_at = |b, t, i| at(&|k| f64::from(motion[k]), b, t, i);
        let mean = |order: usize, vector: &dyn Fn(usize, usize) -> Vec<f64>| {
            let mut sum = 0.0;
            for b in 0..2 {
                for t in 0..FRAMES - order {
                    let counts = (t..=t + order).all(|t| mask[b * FRAMES + t] == 1.0);
                    if counts {
                        let values = vector(b, t);
                        sum += values.iter().map(|x| x * x).sum::<f64>() / values.len() as f64;
                    }
                }
            }
            sum / mask.iter().map(|&w| f64::from(w)).sum::<f64>()
        };
        let scale = |i: usize| f64::from(n.scale[i]);
        let velocity = mean(1, &|b, t| {
            (0..3)
                .map(|i| {
                    let rate = 30.0 * (said(b, t + 1, i) - said(b, t, i));
                    (said(b, t, 3 + i) - rate) / scale(3 + i)
                })
                .collect()
        });
        let acceleration = mean(1, &|b, t| {
            (3..6)
                .map(|i| {
                    let rate = 30.0 * (said(b, t + 1, i) - said(b, t, i));
                    (said(b, t, 3 + i) - rate) / scale(3 + i)
                })
                .collect()
        });
        let turn = (scale(13) + scale(14) + scale(15)) / 6.0;
        let mut total = losses.velocity * velocity + losses.acceleration * acceleration;
        for (k, weight) in losses.differences.iter().enumerate() {
            let order = k + 1;
            let binomials =
                [[-1.0, 1.0, 0.0, 0.0], [1.0, -2.0, 1.0, 0.0], [-1.0, 3.0, -3.0, 1.0]][k];
            let found = mean(order, &|b, t| {
                (0..3)
                    .chain(9..13)
                    .map(|i| {
                        let d: f64 = (0..=order)
                            .map(|j| binomials[j] * (said(b, t + j, i) - true_at(b, t + j, i)))
                            .sum();
                        let unit = match (i < 3, order) {
                            (true, 1) => scale(3 + i),
                            (true, 2) => scale(6 + i),
                            (true, _) => 20.0 * scale(6 + i),
                            (false, order) => turn * 20.0_f64.powi(order as i32 - 1),
                        };
                        30.0_f64.powi(order as i32) * d / unit
                    })
                    .collect()
            });
            total += weight * found;
        }
        total
    }

    #[test]
    fn losses_are_those_of_their_definition() {
        let mut mask = vec![1.0; 2 * FRAMES];
        mask[2 * FRAMES - 2..].fill(0.0);
        let (says, x_t, motion) = (numbers(BODY, 0.0), numbers(BODY, 5.0), numbers(BODY, 11.0));
        let all = EstimateLosses { velocity: 0.7, acceleration: 0.3, differences: [0.5, 0.2, 0.1] };
        let only = |k: usize| {
            let mut differences = [0.0; 3];
            differences[k] = 1.0;
            EstimateLosses { differences, ..EstimateLosses::default() }
        };
        let as_f64: Vec<f64> = says.iter().map(|&x| f64::from(x)).collect();
        for losses in [all.clone(), only(0), only(1), only(2)] {
            let given = [says.as_slice(), &x_t, &motion];
            let found = loss_of(BODY, &losses, Prediction::Sample, [3, 900], given, &mask);
            let expected = expected(&losses, &as_f64, &motion, &mask);
            assert!((found - expected).abs() < 1e-6 * expected, "{found} {expected}");
        }
        // Of a prediction of noise the estimate is (x_t − √(1 − ᾱ) ε̂) / √ᾱ.
        let schedule = Schedule::new(&DiffusionConfig::default()).expect("a schedule");
        let t = [40, 500];
        let estimate: Vec<f64> = (0..says.len())
            .map(|k| {
                let level = schedule.level(Some(t[k / (FRAMES * MOTION_DIM)]));
                (f64::from(x_t[k]) - level.noise * as_f64[k]) / level.signal
            })
            .collect();
        let found = loss_of(BODY, &all, Prediction::Epsilon, t, [&says, &x_t, &motion], &mask);
        let expected = expected(&all, &estimate, &motion, &mask);
        assert!((found - expected).abs() < 1e-6 * expected, "{found} {expected}");
    }

    #[test]
    fn the_root_alone_has_the_losses_of_its_columns() {
        let losses =
            EstimateLosses { velocity: 0.7, acceleration: 0.3, differences: [0.5, 0.2, 0.1] };
        let [says, motion] = [numbers(ROOT, 0.0), numbers(ROOT, 11.0)];
        let mask = vec![1.0; 2 * FRAMES];
        let given = [says.as_slice(), &says, &motion];
        let found = loss_of(ROOT, &losses, Prediction::Sample, [3, 900], given, &mask);
        let n = normalizer(ROOT);
        let scale = |i: usize| f64::from(n.scale[i]);
        let error = |k: usize| f64::from(says[k]) - f64::from(motion[k]);
        let frames = 2.0 * FRAMES as f64;
        let mut expected = 0.0;
        for b in 0..2 {
            let at = |t: usize, i: usize| (b * FRAMES + t) * 13 + i;
            let value =
                |t: usize, i: usize| f64::from(says[at(t, i)]) * scale(i) + f64::from(n.centre[i]);
            for (t, i) in (0..FRAMES - 1).flat_map(|t| (0..3).map(move |i| (t, i))) {
                let rate = 30.0 * (value(t + 1, i) - value(t, i));
                let residual = (value(t, 3 + i) - rate) / scale(3 + i);
                expected += 0.7 * residual.powi(2) / 3.0 / frames;
            }
            let turn = (scale(10) + scale(11) + scale(12)) / 6.0;
            for i in (0..3).chain(6..10) {
                let e = |t: usize| scale(i) * error(at(t, i));
                // Without accelerations their spread is 20 times that of velocities.
                let unit = if i < 3 { scale(3 + i) } else { turn };
                let first = |t: usize| 30.0 * (e(t + 1) - e(t)) / unit;
                let second = |t: usize| 30.0 * (first(t + 1) - first(t)) / 20.0;
                let third = |t: usize| 30.0 * (second(t + 1) - second(t)) / 20.0;
                let sum = |n: usize, x: &dyn Fn(usize) -> f64| -> f64 {
                    (0..n).map(|t| x(t).powi(2)).sum::<f64>() / 7.0 / frames
                };
                expected += 0.5 * sum(FRAMES - 1, &first)
                    + 0.2 * sum(FRAMES - 2, &second)
                    + 0.1 * sum(FRAMES - 3, &third);
            }
        }
        assert!((found - expected).abs() < 1e-6 * expected, "{found} {expected}");
    }

    #[test]
    fn motion_that_is_its_own_derivative_costs_nothing() {
        use crate::motion::kinematics::{Poses, frames_of};
        let pose = |t: usize| [0.1 * (0.3 * t as f64).sin(), 0.02 * t as f64, 0.01];
        let position_m: Vec<_> = (0..FRAMES + 2).map(pose).collect();
        let orientation = vec![[1.0, 0.0, 0.0, 0.0]; FRAMES + 2];
        let mut frames = frames_of(&Poses { position_m, orientation }, FRAMES);
        normalizer(BODY).normalize(frames.view_mut());
        let motion: Vec<f32> = frames.iter().copied().collect::<Vec<_>>().repeat(2);
        let mask = vec![1.0; 2 * FRAMES];
        let all = EstimateLosses { velocity: 1.0, acceleration: 1.0, differences: [1.0; 3] };
        let loss =
            loss_of(BODY, &all, Prediction::Sample, [0, 9], [&motion, &motion, &motion], &mask);
        // Positions are rounded to single precision, and accelerations differ by thirty times that.
        assert!(loss < 1e-6, "{loss}");
    }

    #[test]
    fn nothing_is_added_without_weights() {
        assert!(EstimateLosses::default().is_none());
        assert!(!EstimateLosses { differences: [0.0, 0.0, 1e-3], ..Default::default() }.is_none());
    }
}
