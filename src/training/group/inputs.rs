//! A batch of groups as the networks see it, and its losses.

use std::borrow::Cow;

use crate::autodiff::op::dancers::TakeSamples;
use crate::autodiff::op::loss::{Cost, Loss};
use crate::autodiff::op::shape::Reshape;
use crate::autodiff::op::softmax::CrossEntropy;
use crate::autodiff::{Interpreter, Stream, Tensor};
use crate::diffusion::Schedule;
use crate::model::{
    Graph, GroupConfig, GroupInputs, GroupNetworks, Result as GraphResult, ScoredDancers,
    ScoredGroups,
};
use crate::motion::{Channel, MOTION_DIM, Normalizer};
use crate::training::batch::Batch;
use crate::training::diffusion::without_clock;
use crate::training::error::TrainingError;
use crate::training::learner::Losses;
use crate::training::sampling::motion_view;

use super::GroupTraining;
use super::markers::markers;
use super::negatives::{DistinctDancer, DistinctGroups, mixed};

/// Streams of random numbers of a batch, told apart by their use.
const EMBEDDING_NOISE: u64 = 1 << 61;
const NEGATIVES: u64 = (1 << 61) + 1;

/// Probabilities with which conditions are withheld.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WithholdAll {
    pub audio: f64,
    pub clock: f64,
}

impl From<&GroupTraining> for WithholdAll {
    fn from(config: &GroupTraining) -> Self {
        Self { audio: config.condition_dropout, clock: config.clock_dropout }
    }
}

/// Inputs of the networks for a batch of B groups with places for N dancers, with its target.
pub struct GroupBatch<'a> {
    batch: &'a Batch,
    /// Step of each group, \[B\].
    t: Vec<usize>,
    /// Step of each dancer, \[B N\].
    t_dancers: Vec<usize>,
    /// \[B N, T, 25\]
    x_t: Vec<f32>,
    audio: Cow<'a, [f32]>,
    drop_audio: Vec<f32>,
    /// Row of the number of dancers, \[B\].
    number: Vec<f32>,
    z: Vec<f32>,
    /// Dancers who are there, in frames that count, \[B N, T\].
    mask: Vec<f32>,
    width: usize,
    patch_frames: usize,
    seed: u64,
}

impl<'a> GroupBatch<'a> {
    /// Adds noise to a batch, and withholds what chance withholds.
    pub fn of(
        batch: &'a Batch,
        schedule: &Schedule,
        sizes: &GroupConfig,
        withhold: WithholdAll,
        seed: u64,
    ) -> Self {
        let (n, slots, frames) = (batch.n_windows, batch.n_slots, batch.n_frames);
        let step = |u: f64| ((u * schedule.len() as f64) as usize).min(schedule.len() - 1);
        let t: Vec<usize> = batch.chances.iter().map(|chance| step(chance.step)).collect();
        let t_dancers: Vec<usize> = t.iter().flat_map(|&t| std::iter::repeat_n(t, slots)).collect();
        let rows = n * slots;
        let (x0, noise) =
            (motion_view(&batch.motion, rows, frames), motion_view(&batch.noise, rows, frames));
        let x_t = schedule.add_noise(x0, noise, &t_dancers).into_raw_vec_and_offset().0;
        let drop_audio = batch
            .chances
            .iter()
            .map(|chance| f32::from(u8::from(chance.no_audio < withhold.audio)))
            .collect();
        let number = batch.n_dancers.iter().map(|&n| sizes.embedded_number(n) as f32).collect();
        let mut z = vec![0.0; n * sizes.width];
        Stream::new(seed, EMBEDDING_NOISE).normal(0, &mut z);
        let mask = (0..n)
            .flat_map(|b| {
                let of_frames = &batch.mask[b * frames..][..frames];
                let n_there = batch.n_dancers[b];
                (0..slots).flat_map(move |i| {
                    of_frames.iter().map(move |&w| if i < n_there { w } else { 0.0 })
                })
            })
            .collect();
        Self {
            batch,
            t,
            t_dancers,
            x_t,
            audio: without_clock(batch, withhold.clock),
            drop_audio,
            number,
            z,
            mask,
            width: sizes.width,
            patch_frames: sizes.score_patch_frames,
            seed,
        }
    }

    /// Returns the loss of what the networks say, and its parts.
    ///
    /// # Errors
    /// Shapes that do not fit.
    pub fn loss<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        networks: &GroupNetworks,
        normalizer: &Normalizer,
        schedule: &Schedule,
        config: &GroupTraining,
    ) -> Result<(Tensor<f32>, Losses), TrainingError> {
        let Batch { n_windows: n, n_slots: slots, n_frames: frames, .. } = *self.batch;
        let rows = n * slots;
        let x_t = g.constant(&[rows, frames, MOTION_DIM], &self.x_t);
        let t: Vec<f32> = self.t.iter().map(|&t| t as f32).collect();
        let t = g.constant(&[n], &t);
        let audio_dim = self.audio.len() / (n * frames).max(1);
        let audio = g.constant(&[n, frames, audio_dim], &self.audio);
        let drop_audio = g.constant(&[n], &self.drop_audio);
        let number = g.constant(&[n], &self.number);
        let z = g.constant(&[n, self.width], &self.z);
        let mask = g.constant(&[n, slots * frames], &self.mask);
        let inputs = GroupInputs {
            x: &x_t,
            t: &t,
            audio: &audio,
            drop_audio: Some(&drop_audio),
            number: &number,
            z: &z,
            mask: Some(&mask),
        };
        let found = networks.denoiser.forward(g, &inputs)?;

        let target = g.constant(&[rows, frames, MOTION_DIM], &self.batch.motion);
        let objective = &config.objective;
        let both = [&found.x0, &target];
        let layout = normalizer.layout();
        let mut loss = objective.loss(g, layout, schedule, &self.t_dancers, both, &self.mask)?;
        let mut losses = Losses { total: 0.0, parts: Vec::new() };
        losses.parts.push(("diffusion", loss.scalar().into()));
        let of_estimate = objective.estimate.loss(
            g,
            normalizer,
            (schedule, &self.t_dancers),
            [&found.x0, &x_t],
            (&self.batch.motion, &self.mask),
        )?;
        if let Some(of_estimate) = of_estimate {
            loss = g.add(&loss, &of_estimate)?;
        }
        if config.losses.markers > 0.0 {
            let places = markers(g, normalizer, &found.x0)?;
            let wanted = markers(g, normalizer, &target)?;
            let weights = g.constant(&[rows, frames], &self.mask);
            let apart = g.apply(Loss::new(Cost::Squared), &[&places, &wanted, &weights])?;
            losses.parts.push(("markers", apart.scalar().into()));
            let apart = g.scale(&apart, config.losses.markers)?;
            loss = g.add(&loss, &apart)?;
        }
        if let Some(contrast) = self.contrast(g, networks, &found.x0, &found.w, config)? {
            losses.parts.push(("contrast", contrast.scalar().into()));
            let contrast = g.scale(&contrast, config.losses.contrast)?;
            loss = g.add(&loss, &contrast)?;
        }
        losses.total = loss.scalar().into();
        Ok((loss, losses))
    }

    /// −log f(x̂, w) / (f(x̂, w) + Σ_j f(x̂^j, w)): the estimate against mixed groups (paper, eq. 10); none for one
    /// group alone.
    fn contrast<I: Interpreter<Element = f32>>(
        &self,
        g: &mut I,
        networks: &GroupNetworks,
        x0: &Tensor<f32>,
        w: &Tensor<f32>,
        config: &GroupTraining,
    ) -> GraphResult<Option<Tensor<f32>>> {
        let Batch { n_windows: n, n_slots: slots, n_frames: frames, .. } = *self.batch;
        if config.losses.contrast == 0.0 {
            return Ok(None);
        }
        let random = Stream::new(self.seed, NEGATIVES);
        let n_negatives = config.losses.n_negatives;
        let Some(mixed) = mixed(&self.batch.n_dancers, slots, n_negatives, random) else {
            return Ok(None);
        };
        let DistinctGroups { dancers, places, groups, of_all } = mixed.distinct();
        let n_groups = groups.len();
        let t: Vec<f32> = dancers.iter().map(|it| self.t_dancers[it.dancer] as f32).collect();
        let t = g.constant(&[t.len()], &t);
        let number: Vec<f32> = groups.iter().map(|&b| self.number[b]).collect();
        let number = g.constant(&[n_groups], &number);
        // A patch counts where its first frame does.
        let patches = frames.div_ceil(self.patch_frames);
        let mask: Vec<f32> = groups
            .iter()
            .flat_map(|&b| {
                (0..slots * patches).map(move |i| {
                    let (slot, patch) = (i / patches, i % patches);
                    self.mask[(b * slots + slot) * frames + patch * self.patch_frames]
                })
            })
            .collect();
        let mask = g.constant(&[n_groups, slots * patches], &mask);
        let is_there = |&b: &usize| {
            let n_there = self.batch.n_dancers[b];
            (0..slots).map(move |slot| f32::from(u8::from(slot < n_there)))
        };
        let there: Vec<f32> = groups.iter().flat_map(is_there).collect();
        let there = g.constant(&[n_groups, slots], &there);

        let moves = self.moves(x0.data(), &dancers);
        let who = dancers.iter().map(|it| it.dancer).collect();
        let x0 = g.apply(TakeSamples::new(who), &[x0])?;
        let moves = g.constant(x0.shape(), &moves);
        let x0 = g.add(&x0, &moves)?;
        let within = networks.score.token(g, w)?;
        let whose = dancers.iter().map(|it| it.group).collect();
        let of_each = g.apply(TakeSamples::new(whose), &[&within])?;
        let found = networks.score.dancers(g, &x0, &t, &of_each)?;
        let of_places = ScoredDancers {
            token: g.apply(TakeSamples::new(places.clone()), &[&found.token])?,
            frames: g.apply(TakeSamples::new(places), &[&found.frames])?,
        };
        let within = g.apply(TakeSamples::new(groups), &[&within])?;
        let groups = ScoredGroups {
            within: &within,
            number: &number,
            mask: Some(&mask),
            there: Some(&there),
        };
        let logits = networks.score.together(g, &of_places, &groups)?.log_ratio;
        let logits = g.apply(TakeSamples::new(of_all), &[&logits])?;
        let logits = g.apply(Reshape::new(&[n, 1 + n_negatives]), &[&logits])?;
        let labels = g.constant(&[n], &vec![0.0; n]);
        g.apply(CrossEntropy::default(), &[&logits, &labels]).map(Some)
    }

    /// Returns what is added to dancers of mixed groups that dance in the place of another: the difference of their mean
    /// places on the floor, \[rows, T, 25\].
    fn moves(&self, x0: &[f32], dancers: &[DistinctDancer]) -> Vec<f32> {
        let frames = self.batch.n_frames;
        let mean = |dancer: usize, channel: usize| -> f32 {
            let (mask, rows) = (&self.mask[dancer * frames..], &x0[dancer * frames * MOTION_DIM..]);
            let rows = rows.chunks_exact(MOTION_DIM).zip(mask).take(frames);
            let (sum, n) = rows.fold((0.0_f64, 0.0), |(sum, n), (row, &w)| {
                (sum + f64::from(w * row[channel]), n + f64::from(w))
            });
            (sum / f64::max(n, 1.0)) as f32
        };
        let mut moves = vec![0.0; dancers.len() * frames * MOTION_DIM];
        let of_dancer = moves.chunks_exact_mut(frames * MOTION_DIM);
        for (rows, &DistinctDancer { dancer, floor, .. }) in of_dancer.zip(dancers) {
            if dancer != floor {
                let first = Channel::Position.range().start;
                for channel in [first, first + 2] {
                    let by = mean(floor, channel) - mean(dancer, channel);
                    rows.chunks_exact_mut(MOTION_DIM).for_each(|row| row[channel] = by);
                }
            }
        }
        moves
    }
}

#[cfg(test)]
mod tests;
