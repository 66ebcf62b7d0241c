//! What training makes small: the distance of a prediction from what was added, and of decoded motion from
//! what it was.

use serde::{Deserialize, Serialize};

use crate::autodiff::op::binary::{Binary, Pair};
use crate::autodiff::op::loss::{Cost, Loss};
use crate::autodiff::{Element, Interpreter, Tensor};
use crate::diffusion::{LossType, Schedule, min_snr_weights};
use crate::model::{Graph, Result};
use crate::motion::{BodyColumns, ColumnRole, Columns, Layout, Normalizer};

use super::estimate::EstimateLosses;

/// How predictions of the diffusion are weighed.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Objective {
    pub loss: LossType,
    /// Where Huber's loss turns from squared to linear.
    pub huber_delta: f64,
    /// γ of min-SNR weighting; `None` weighs all steps alike.
    pub min_snr_gamma: Option<f64>,
    /// How channels are weighed; as release 0.1 did, all alike, where a run says nothing.
    #[serde(default)]
    pub channels: ChannelWeights,
    /// Additional losses on the estimate of clean motion.
    #[serde(default)]
    pub estimate: EstimateLosses,
}

/// Weights of channels in the distance of a prediction, before they are divided by their mean.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChannelWeights {
    /// Of each of the free channels, the eight of style, which change slowly and are a third of all.
    pub style: f64,
    /// Of vertical position, velocity and acceleration, by which dancers follow the beat.
    pub vertical: f64,
    /// Of position and orientation, times `vertical` where a channel is both.
    #[serde(default = "ChannelWeights::one")]
    pub pose: f64,
}

impl Default for ChannelWeights {
    fn default() -> Self {
        Self { style: 1.0, vertical: 1.0, pose: 1.0 }
    }
}

impl ChannelWeights {
    const fn one() -> f64 {
        1.0
    }

    /// Returns the weight of each column of a layout; their mean is 1.
    pub fn weights(&self, layout: Layout) -> Vec<f64> {
        let mut weights = vec![1.0; layout.width()];
        for columns in layout.spatial().filter(|columns| !layout.is_axial(*columns)) {
            weights[columns.first + 1] = self.vertical;
        }
        for columns in layout.with_role(ColumnRole::Free) {
            weights[columns.range()].fill(self.style);
        }
        let BodyColumns { position, orientation, .. } = layout.body();
        for weight in &mut weights[position.range()] {
            *weight *= self.pose;
        }
        for weight in &mut weights[orientation.range()] {
            *weight *= self.pose;
        }
        let mean = weights.iter().sum::<f64>() / layout.width() as f64;
        weights.into_iter().map(|weight| weight / mean).collect()
    }

    /// Multiplies both by `factor` of their channels' weights; \[batch, frames, columns\] each.
    pub(super) fn scaled<I: Interpreter>(
        &self,
        g: &mut I,
        layout: Layout,
        [prediction, target]: [&Tensor<I::Element>; 2],
        factor: impl Fn(f64) -> f64,
    ) -> Result<[Tensor<I::Element>; 2]> {
        if *self == Self::default() {
            return Ok([prediction.clone(), target.clone()]);
        }
        let weights = self.weights(layout).into_iter();
        let factors: Vec<_> = weights.map(|w| I::Element::from_f64(factor(w))).collect();
        let factors = g.constant(&[factors.len()], &factors);
        let mut times = |x: &Tensor<_>| g.apply(Binary::new(Pair::Multiply), &[x, &factors]);
        Ok([times(prediction)?, times(target)?])
    }
}

impl Default for Objective {
    fn default() -> Self {
        Self {
            loss: LossType::Mse,
            huber_delta: 1.0,
            min_snr_gamma: None,
            channels: ChannelWeights::default(),
            estimate: EstimateLosses::default(),
        }
    }
}

impl Objective {
    /// Multiplies both by the roots of their channels' weights.
    fn weighed<I: Interpreter>(
        &self,
        g: &mut I,
        layout: Layout,
        both: [&Tensor<I::Element>; 2],
    ) -> Result<[Tensor<I::Element>; 2]> {
        let factor = |weight: f64| match self.loss {
            LossType::L1 => weight,
            LossType::Mse | LossType::Huber => weight.sqrt(),
        };
        self.channels.scaled(g, layout, both, factor)
    }

    fn cost(&self) -> Cost {
        match self.loss {
            LossType::Mse => Cost::Squared,
            LossType::L1 => Cost::Absolute,
            LossType::Huber => Cost::Huber { delta: self.huber_delta },
        }
    }

    /// ⟨w(t) cost(√w_c (prediction − target))⟩ over frames that count, w_c the weights of channels (w_c itself where
    /// the cost is |d|).
    ///
    /// # Shapes
    /// - `prediction`, `target`: \[batch, frames, columns\]; `mask`: \[batch, frames\]; `t`: \[batch\]
    pub fn loss<I: Interpreter>(
        &self,
        g: &mut I,
        layout: Layout,
        schedule: &Schedule,
        t: &[usize],
        [prediction, target]: [&Tensor<I::Element>; 2],
        mask: &[f32],
    ) -> Result<Tensor<I::Element>> {
        let frames = prediction.shape()[1];
        let [prediction, target] = &self.weighed(g, layout, [prediction, target])?;
        let Some(gamma) = self.min_snr_gamma else {
            let mask: Vec<_> = mask.iter().map(|&w| I::Element::from_f64(w.into())).collect();
            let mask = g.constant(&prediction.shape()[..2], &mask);
            return g.apply(Loss::new(self.cost()), &[prediction, target, &mask]);
        };
        let by_step = min_snr_weights(schedule, t, gamma).unwrap_or_else(|_| vec![1.0; t.len()]);
        let weights: Vec<f64> =
            mask.iter().enumerate().map(|(row, &w)| f64::from(w) * by_step[row / frames]).collect();
        let (total, n) =
            (weights.iter().sum::<f64>(), mask.iter().map(|&w| f64::from(w)).sum::<f64>());
        let weights: Vec<_> = weights.into_iter().map(I::Element::from_f64).collect();
        let weights = g.constant(&prediction.shape()[..2], &weights);
        let loss = g.apply(Loss::new(self.cost()), &[prediction, target, &weights])?;
        // The operation divides by the sum of weights; the mean is over frames.
        g.scale(&loss, total / n.max(1.0))
    }
}

/// How far decoded motion is from the motion that it should be.
#[derive(Clone, Debug)]
pub struct Reconstruction<T> {
    /// ⟨(p − p̂)²⟩, m².
    pub position: T,
    /// ⟨min((q − q̂)², (q + q̂)²)⟩ over the four components.
    pub quaternion: T,
    /// ⟨(z − ẑ)²⟩ over all channels, in units of their spread.
    pub all: T,
}

/// Compares decoded motion with motion, frame by frame where they count.
///
/// # Shapes
/// - `decoded`: \[batch, frames, columns\] of the normalizer's layout in metres and the like; `motion`: the same, normalised;
///   `mask`: \[batch, frames\]
pub fn reconstruction<I: Interpreter>(
    g: &mut I,
    normalizer: &Normalizer,
    decoded: &Tensor<I::Element>,
    motion: &[f32],
    mask: &[f32],
) -> Result<Reconstruction<Tensor<I::Element>>> {
    let element = |x: f32| I::Element::from_f64(x.into());
    let rows = decoded.shape()[..2].to_vec();
    let mask: Vec<_> = mask.iter().map(|&w| element(w)).collect();
    let mask = g.constant(&rows, &mask);
    let squared =
        |g: &mut I, x: &Tensor<_>, y: &Tensor<_>| g.apply(Loss::new(Cost::Squared), &[x, y, &mask]);
    // The same turn has two quaternions: the one on the side of the decoded one is meant.
    let layout = normalizer.layout();
    let (body, width) = (layout.body(), layout.width());
    let q = body.orientation.range();
    let mut wanted = motion.to_vec();
    let frames = decoded.data().chunks_exact(width).zip(wanted.chunks_exact_mut(width));
    for (decoded, wanted) in frames {
        let scaled = |i: usize| wanted[i] * normalizer.scale[i] + normalizer.centre[i];
        let dot: f64 = q.clone().map(|i| decoded[i].to_f64() * f64::from(scaled(i))).sum();
        if dot < 0.0 {
            for i in q.clone() {
                // -q in units of its spread; the centre of quaternions is 0.
                wanted[i] = -wanted[i];
            }
        }
    }
    let constant = |g: &I, values: &[f32]| {
        let values: Vec<_> = values.iter().map(|&x| element(x)).collect();
        g.constant(&[values.len()], &values)
    };
    let scale: Vec<f32> = normalizer.scale.iter().map(|s| 1.0 / s).collect();
    let (centre, scale) = (constant(g, &normalizer.centre), constant(g, &scale));
    let z = g.apply(Binary::new(Pair::Subtract), &[decoded, &centre])?;
    let z = g.apply(Binary::new(Pair::Multiply), &[&z, &scale])?;
    let values: Vec<_> = wanted.iter().map(|&x| element(x)).collect();
    let wanted_z = g.constant(decoded.shape(), &values);
    let all = squared(g, &z, &wanted_z)?;

    let group = |g: &mut I, columns: Columns| -> Result<[Tensor<I::Element>; 2]> {
        let got = g.channels(decoded, columns.range())?;
        let values: Vec<_> = wanted
            .chunks_exact(width)
            .flat_map(|row| {
                columns.range().map(|i| row[i] * normalizer.scale[i] + normalizer.centre[i])
            })
            .map(element)
            .collect();
        let wanted = g.constant(got.shape(), &values);
        Ok([got, wanted])
    };
    let [p, wanted_p] = group(g, body.position)?;
    let position = squared(g, &p, &wanted_p)?;
    let [q, wanted_q] = group(g, body.orientation)?;
    let quaternion = squared(g, &q, &wanted_q)?;
    Ok(Reconstruction { position, quaternion, all })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::autodiff::{Arena, Eager, Parameters};
    use crate::diffusion::DiffusionConfig;
    use crate::model::ParameterList;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::{BODY, MOTION_DIM};

    fn parameters() -> Parameters<f64> {
        Parameters::new(ParameterList::default(), 0)
    }

    #[test]
    fn min_snr_weighs_steps_and_padding_counts_nowhere() {
        let schedule = Schedule::new(&DiffusionConfig::default()).expect("a schedule");
        let (parameters, arena) = (parameters(), Arena::default());
        let mut g = Eager::new(&parameters, &arena);
        let prediction: Vec<f64> = (0..2 * 3 * 2).map(f64::from).collect();
        let prediction = g.input(&[2, 3, 2], &prediction);
        let target = g.input(&[2, 3, 2], &[0.0; 12]);
        let mask = [1.0, 1.0, 0.0, 1.0, 0.0, 0.0];
        let t = [20, 700];
        let loss_of = |g: &mut Eager<f64>, objective: &Objective| {
            let loss = objective.loss(g, BODY, &schedule, &t, [&prediction, &target], &mask);
            loss.expect("shapes fit").scalar()
        };
        // Squares of 0 to 3 and of 6 and 7, over six numbers.
        assert_eq!(loss_of(&mut g, &Objective::default()), (14.0 + 85.0) / 6.0);
        let l1 = Objective { loss: LossType::L1, ..Objective::default() };
        assert_eq!(loss_of(&mut g, &l1), (6.0 + 13.0) / 6.0);
        let weighted = Objective { min_snr_gamma: Some(5.0), ..Objective::default() };
        let w = t.map(|t| schedule.snr(t).min(5.0) / schedule.snr(t));
        let wanted = (w[0] * 14.0 + w[1] * 85.0) / 6.0;
        assert!((loss_of(&mut g, &weighted) - wanted).abs() < 1e-12 * wanted);
    }

    #[test]
    fn columns_weigh_by_their_roles() {
        let weights = ChannelWeights { style: 0.5, vertical: 3.0, pose: 1.0 };
        let (root, body) = (weights.weights(ROOT), weights.weights(BODY));
        // Two of 13 weigh 3; three of 25 do, and eight a half.
        let (of_root, of_body) = (17.0 / 13.0, 27.0 / 25.0);
        for (i, found) in root.into_iter().enumerate() {
            let weight = if [1, 4].contains(&i) { 3.0 } else { 1.0 };
            assert!((found - weight / of_root).abs() < 1e-15, "{i}: {found}");
        }
        for (i, found) in body.into_iter().enumerate() {
            let weight = match i {
                1 | 4 | 7 => 3.0,
                17.. => 0.5,
                _ => 1.0,
            };
            assert!((found - weight / of_body).abs() < 1e-15, "{i}: {found}");
        }
    }

    #[test]
    fn the_root_alone_is_weighed_and_compared() {
        let schedule = Schedule::new(&DiffusionConfig::default()).expect("a schedule");
        let (parameters, arena) = (parameters(), Arena::default());
        let mut g = Eager::new(&parameters, &arena);
        let objective = Objective {
            channels: ChannelWeights { vertical: 2.0, ..ChannelWeights::default() },
            ..Objective::default()
        };
        let says: Vec<f64> = (0..26).map(|i| f64::from(i) / 8.0).collect();
        let (says_x, zero) = (g.input(&[1, 2, 13], &says), g.input(&[1, 2, 13], &[0.0; 26]));
        let loss = objective.loss(&mut g, ROOT, &schedule, &[20], [&says_x, &zero], &[1.0, 1.0]);
        let weight = |i: usize| if [1, 4].contains(&(i % 13)) { 26.0 / 15.0 } else { 13.0 / 15.0 };
        let wanted = (0..26).map(|i| weight(i) * says[i].powi(2)).sum::<f64>() / 26.0;
        assert!((loss.expect("shapes fit").scalar() - wanted).abs() < 1e-12 * wanted);

        // Two frames, the second 0.3 m off and with the other sign of its quaternion.
        let mut motion = [0.0_f32; 26];
        (motion[6], motion[13 + 6]) = (1.0, 1.0);
        let mut decoded = motion.map(f64::from);
        (decoded[13], decoded[13 + 6]) = (0.3, -1.0);
        let x = g.input(&[1, 2, 13], &decoded);
        let normalizer = Normalizer::identity_of(ROOT);
        let found = reconstruction(&mut g, &normalizer, &x, &motion, &[1.0, 1.0]);
        let found = found.expect("shapes fit");
        assert!((found.position.scalar() - 0.09 / 6.0).abs() < 1e-12);
        assert_eq!(found.quaternion.scalar(), 0.0);
        assert!((found.all.scalar() - 0.09 / 26.0).abs() < 1e-12);
    }

    #[test]
    fn either_sign_of_a_quaternion_will_do() {
        let mut normalizer = Normalizer::identity();
        normalizer.scale[9..13].fill(0.5);
        (normalizer.scale[0], normalizer.centre[0]) = (2.0, 1.0);
        let mut motion = [0.0_f32; 2 * MOTION_DIM];
        // In units of spread: position 1 + 2 · 0.5 = 2 m, quaternion (0.8, 0.6, 0, 0).
        for row in motion.chunks_exact_mut(MOTION_DIM) {
            row[0] = 0.5;
            (row[9], row[10]) = (1.6, 1.2);
        }
        let mut decoded = [0.0_f64; 2 * MOTION_DIM];
        (decoded[0], decoded[25]) = (2.0, 2.3);
        (decoded[9], decoded[10]) = (-0.8, -0.6);
        (decoded[25 + 9], decoded[25 + 10]) = (0.6, 0.8);
        let (parameters, arena) = (parameters(), Arena::default());
        let mut g = Eager::new(&parameters, &arena);
        let decoded = g.input(&[1, 2, MOTION_DIM], &decoded);
        let found = reconstruction(&mut g, &normalizer, &decoded, &motion, &[1.0, 1.0]);
        let found = found.expect("shapes fit");
        // 0.3² over two frames and three coordinates; 0.2² twice over two frames and four components.
        assert!((found.position.scalar() - 0.09 / 6.0).abs() < 1e-7);
        assert!((found.quaternion.scalar() - 0.08 / 8.0).abs() < 1e-7);
        // In units of spread: (0.3 / 2)² + 2 (0.2 / 0.5)², over 50 numbers.
        assert!((found.all.scalar() - (0.0225 + 0.32) / 50.0).abs() < 1e-7);
    }
}
