//! Losses that hold motion together in time: what it says of its derivatives must be their differences.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use crate::autodiff::op::binary::{Binary, Pair};
use crate::autodiff::op::elementwise::{Function, Map};
use crate::autodiff::op::frames::TakeFrames;
use crate::autodiff::op::loss::{Cost, Loss};
use crate::autodiff::op::reduce::{Over, Reduce};
use crate::autodiff::{Element, Interpreter, Tensor};
use crate::model::{Activation, Graph, Result};
use crate::motion::phase::WRAP_BARS;
use crate::motion::{ColumnRole, Layout};
use crate::units::FPS;

/// Weights and targets of the losses; the defaults are the reference's \[7.2\].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TemporalConfig {
    pub velocity_weight: f64,
    pub acceleration_weight: f64,
    pub jerk_weight: f64,
    pub quaternion_delta_weight: f64,
    pub phase_weight: f64,
    /// Of steps longer than `max_step_m`, which a bounded velocity cannot keep up with \[14.1\].
    pub smoothness_weight: f64,
    /// m/s
    pub target_velocity: f64,
    /// m/s²
    pub target_acceleration: f64,
    /// m/s³
    pub target_jerk: f64,
    pub target_quaternion_dot: f64,
    /// Longest step of a coordinate between two frames, m.
    pub max_step_m: f64,
}

impl Default for TemporalConfig {
    /// Those of the reference but for two, with which the sum was not about coherence: the falls of the phase,
    /// 86 % of it when fine-tuning began, weigh a hundredth, and errors of acceleration, 0.25 m/s² of the
    /// target's 100, are divided by 10 m/s².
    fn default() -> Self {
        Self { phase_weight: 0.01, target_acceleration: 10.0, ..Self::reference() }
    }
}

impl TemporalConfig {
    /// The reference's weights and targets (7.2).
    pub fn reference() -> Self {
        Self {
            velocity_weight: 10.0,
            acceleration_weight: 5.0,
            jerk_weight: 1.0,
            quaternion_delta_weight: 2.0,
            phase_weight: 1.0,
            smoothness_weight: 1.0,
            target_velocity: 5.0,
            target_acceleration: 100.0,
            target_jerk: 50_000.0,
            target_quaternion_dot: 0.95,
            max_step_m: 0.5,
        }
    }
}

/// The losses, each with its weight.
#[derive(Clone, Debug)]
pub struct TemporalLosses<T> {
    pub velocity_coherence: T,
    pub acceleration_coherence: T,
    pub jerk: T,
    pub quaternion_delta: T,
    pub phase_monotonic: T,
    pub position_smoothness: T,
}

impl<T> TemporalLosses<T> {
    /// Names, as the table of training spells them.
    pub const NAMES: [&'static str; 6] = [
        "velocity_coherence",
        "acceleration_coherence",
        "jerk",
        "quaternion_delta",
        "phase_monotonic",
        "position_smoothness",
    ];

    /// Returns the losses in the order of their names.
    pub fn all(&self) -> [&T; 6] {
        [
            &self.velocity_coherence,
            &self.acceleration_coherence,
            &self.jerk,
            &self.quaternion_delta,
            &self.phase_monotonic,
            &self.position_smoothness,
        ]
    }
}

/// Returns the losses of motion in its own units.
///
/// With p, v, a, q, φ of the frames, Δ the difference to the next frame, f = 30 Hz, means over pairs of
/// frames that both count (and over coordinates):
///
/// - velocity: w ⟨(v − f Δp)²⟩ / target²; acceleration: w ⟨(a − f Δv)²⟩ / target²
/// - jerk: w ⟨‖f Δa‖²⟩ / target²
/// - quaternion: w ⟨max(target − |q · q'|, 0)⟩
/// - phase: w Σ max(−Δφ, 0) \[Δφ ≥ −1/2\], a sum over frames and mean over motions: a fall is a violation
///   unless it is that of a new bar. (The reference's relu(−Δφ − 0.5) punishes the new bar instead.)
/// - steps: w ⟨max(|Δp| − longest, 0)⟩
///
/// Those of columns that the layout lacks are 0.
///
/// # Shapes
/// - `motion`: \[batch, frames, columns\], at least two frames; `mask`: \[batch, frames\], 1 or 0
pub fn temporal_losses<I: Interpreter>(
    g: &mut I,
    layout: Layout,
    config: &TemporalConfig,
    motion: &Tensor<I::Element>,
    mask: &[f32],
) -> Result<TemporalLosses<Tensor<I::Element>>> {
    let c = config;
    let (batch, frames) = (motion.shape()[0], motion.shape()[1]);
    let pairs: Vec<I::Element> = mask
        .chunks_exact(frames.max(1))
        .flat_map(|mask| {
            mask.windows(2).map(|pair| I::Element::from_f64((pair[0] * pair[1]).into()))
        })
        .collect();
    let n_pairs: f64 = pairs.iter().map(|w| w.to_f64()).sum();
    let pairs = g.constant(&[batch, frames.saturating_sub(1)], &pairs);
    let head = g.apply(TakeFrames::inner(0, 1), &[motion])?;
    let tail = g.apply(TakeFrames::inner(1, 0), &[motion])?;
    let difference = g.apply(Binary::new(Pair::Subtract), &[&tail, &head])?;

    let body = layout.body();
    let [p, q] = [body.position, body.orientation].map(|columns| columns.range());
    let [v, a] =
        [body.velocity, body.acceleration].map(|found| found.map(|columns| columns.range()));
    let none = g.constant(&[], &[I::Element::ZERO]);
    let derivative = |g: &mut I, range: Range<usize>| {
        let change = g.channels(&difference, range)?;
        g.scale(&change, FPS)
    };
    let squared = |g: &mut I, x: &Tensor<_>, y: &Tensor<_>, factor: f64| {
        let loss = g.apply(Loss::new(Cost::Squared), &[x, y, &pairs])?;
        g.scale(&loss, factor)
    };
    let coherence = |g: &mut I,
                     of: Option<Range<usize>>,
                     said: Option<Range<usize>>,
                     factor: f64|
     -> Result<Tensor<I::Element>> {
        let (Some(of), Some(said)) = (of, said) else { return Ok(none.clone()) };
        let (change, said) = (derivative(g, of)?, g.channels(&head, said)?);
        squared(g, &said, &change, factor)
    };
    let factor = c.velocity_weight / c.target_velocity.powi(2);
    let velocity_coherence = coherence(g, Some(p.clone()), v.clone(), factor)?;
    let factor = c.acceleration_weight / c.target_acceleration.powi(2);
    let acceleration_coherence = coherence(g, v, a.clone(), factor)?;
    let jerk = match a {
        None => none.clone(),
        Some(a) => {
            let jerk = derivative(g, a)?;
            let still = g.scale(&jerk, 0.0)?;
            // The mean over three coordinates, three times, is that of the squared length.
            squared(g, &jerk, &still, 3.0 * c.jerk_weight / c.target_jerk.powi(2))?
        }
    };

    let (q, q_next) = (g.channels(&head, q.clone())?, g.channels(&tail, q)?);
    let product = g.mul(&q, &q_next)?;
    let dot = g.apply(Reduce::sum(Over::Axis(2)), &[&product])?;
    let dot = g.apply(Map::new(Function::Abs), &[&dot])?;
    let quaternion_delta = hinge(g, &dot, -1.0, c.target_quaternion_dot, &pairs)?;
    let quaternion_delta = g.scale(&quaternion_delta, c.quaternion_delta_weight)?;

    let phase_monotonic = match layout.with_role(ColumnRole::Phase).next() {
        None => none,
        Some(phase) => {
            let change = g.channels(&difference, phase.range())?;
            let is_fall: Vec<I::Element> = change
                .data()
                .iter()
                .map(|d| if d.to_f64() < -WRAP_BARS { I::Element::ZERO } else { I::Element::ONE })
                .collect();
            let is_fall = g.constant(change.shape(), &is_fall);
            let change = g.mul(&change, &is_fall)?;
            let falls = hinge(g, &change, -1.0, 0.0, &pairs)?;
            let per_motion = n_pairs / batch.max(1) as f64;
            g.scale(&falls, c.phase_weight * per_motion)?
        }
    };

    let step = g.channels(&difference, p)?;
    let step = g.apply(Map::new(Function::Abs), &[&step])?;
    let position_smoothness = hinge(g, &step, 1.0, -c.max_step_m, &pairs)?;
    let position_smoothness = g.scale(&position_smoothness, c.smoothness_weight)?;
    Ok(TemporalLosses {
        velocity_coherence,
        acceleration_coherence,
        jerk,
        quaternion_delta,
        phase_monotonic,
        position_smoothness,
    })
}

/// ⟨max(scale · x + shift, 0)⟩ over rows that count.
fn hinge<I: Interpreter>(
    g: &mut I,
    x: &Tensor<I::Element>,
    scale: f64,
    shift: f64,
    rows: &Tensor<I::Element>,
) -> Result<Tensor<I::Element>> {
    let x = g.apply(Map::new(Function::Affine { scale, shift }), &[x])?;
    let x = g.activation(&x, Activation::Relu)?;
    let zero = g.constant(x.shape(), &vec![I::Element::ZERO; x.len()]);
    g.apply(Loss::new(Cost::Absolute), &[&x, &zero, rows])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::autodiff::{Arena, Eager, Parameters};
    use crate::model::ParameterList;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::{BODY, MOTION_DIM};

    /// The definitions, written out.
    fn by_definition(motion: &[f64], frames: usize, mask: &[f32], c: &TemporalConfig) -> [f64; 6] {
        let batch = mask.len() / frames;
        let at = |b: usize, t: usize, i: usize| motion[(b * frames + t) * MOTION_DIM + i];
        let (mut sums, mut n) = ([0.0; 6], 0.0);
        for b in 0..batch {
            for t in 0..frames - 1 {
                if mask[b * frames + t] * mask[b * frames + t + 1] == 0.0 {
                    continue;
                }
                n += 1.0;
                for i in 0..3 {
                    let dp = at(b, t + 1, i) - at(b, t, i);
                    sums[0] += (at(b, t, 3 + i) - 30.0 * dp).powi(2) / 3.0;
                    let dv = at(b, t + 1, 3 + i) - at(b, t, 3 + i);
                    sums[1] += (at(b, t, 6 + i) - 30.0 * dv).powi(2) / 3.0;
                    sums[2] += (30.0 * (at(b, t + 1, 6 + i) - at(b, t, 6 + i))).powi(2);
                    sums[5] += (dp.abs() - c.max_step_m).max(0.0) / 3.0;
                }
                let dot: f64 = (9..13).map(|i| at(b, t, i) * at(b, t + 1, i)).sum();
                sums[3] += (c.target_quaternion_dot - dot.abs()).max(0.0);
                let d = at(b, t + 1, 16) - at(b, t, 16);
                sums[4] += if d < -0.5 { 0.0 } else { (-d).max(0.0) };
            }
        }
        [
            10.0 * sums[0] / n / 25.0,
            5.0 * sums[1] / n / 1e4,
            sums[2] / n / 2.5e9,
            2.0 * sums[3] / n,
            sums[4] / batch as f64,
            sums[5] / n,
        ]
    }

    #[test]
    fn they_are_their_definitions_and_padding_counts_nowhere() {
        let (batch, frames) = (3, 7);
        let mut motion: Vec<f64> = (0..batch * frames * MOTION_DIM)
            .map(|i| ((i * 7919 + 13) % 1009) as f64 / 504.5 - 1.0)
            .collect();
        let mut mask = vec![1.0_f32; batch * frames];
        mask[frames + 5..2 * frames].fill(0.0);
        mask[2 * frames + 2..].fill(0.0);
        for t in 0..batch * frames {
            // Phases that rise, wrap, stay and fall a little.
            motion[t * MOTION_DIM + 16] = [0.1, 0.4, 0.9, 0.05, 0.3, 0.25, 0.2][t % 7];
        }
        let config = TemporalConfig::reference();
        let wanted = by_definition(&motion, frames, &mask, &config);
        let parameters = Parameters::<f64>::new(ParameterList::default(), 0);
        let arena = Arena::default();
        let losses = |motion: &[f64]| {
            let mut g = Eager::new(&parameters, &arena);
            let motion = g.input(&[batch, frames, MOTION_DIM], motion);
            let losses =
                temporal_losses(&mut g, BODY, &config, &motion, &mask).expect("shapes fit");
            losses.all().map(Tensor::scalar)
        };
        for (i, (got, wanted)) in losses(&motion).into_iter().zip(wanted).enumerate() {
            let name = TemporalLosses::<()>::NAMES[i];
            assert!((got - wanted).abs() <= 1e-12 * wanted.abs(), "{name}: {got}, {wanted}");
            assert!(wanted > 0.0, "{name} was not tried");
        }
        let before = losses(&motion);
        for t in [frames + 5, 2 * frames + 3] {
            motion[t * MOTION_DIM..(t + 1) * MOTION_DIM].fill(1e3);
        }
        assert_eq!(losses(&motion), before);
    }

    #[test]
    fn the_root_alone_has_the_losses_of_its_columns() {
        let (frames, width) = (6, ROOT.width());
        let motion: Vec<f64> = (0..2 * frames * width)
            .map(|i| ((i * 7919 + 13) % 1009) as f64 / 504.5 - 1.0)
            .collect();
        let config = TemporalConfig::reference();
        let parameters = Parameters::<f64>::new(ParameterList::default(), 0);
        let arena = Arena::default();
        let mut g = Eager::new(&parameters, &arena);
        let x = g.input(&[2, frames, width], &motion);
        let mask = vec![1.0; 2 * frames];
        let found = temporal_losses(&mut g, ROOT, &config, &x, &mask).expect("shapes fit");
        let (mut velocity, mut delta, mut steps) = (0.0, 0.0, 0.0);
        for (b, t) in (0..2).flat_map(|b| (0..frames - 1).map(move |t| (b, t))) {
            let at = |t: usize, i: usize| motion[(b * frames + t) * width + i];
            for i in 0..3 {
                let step = at(t + 1, i) - at(t, i);
                velocity += (at(t, 3 + i) - 30.0 * step).powi(2) / 30.0;
                steps += (step.abs() - 0.5).max(0.0) / 30.0;
            }
            let dot: f64 = (6..10).map(|i| at(t, i) * at(t + 1, i)).sum();
            delta += (0.95 - dot.abs()).max(0.0) / 10.0;
        }
        let wanted = [10.0 * velocity / 25.0, 0.0, 0.0, 2.0 * delta, 0.0, steps];
        for (got, wanted) in found.all().map(Tensor::scalar).into_iter().zip(wanted) {
            assert!((got - wanted).abs() <= 1e-12 * wanted, "{got}, {wanted}");
        }
    }
}
