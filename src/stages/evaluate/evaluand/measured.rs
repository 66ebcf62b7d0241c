//! Motions on their way from the store, or from files, to what was measured of them.

use std::collections::{BTreeMap, BTreeSet};

use anyhow::bail;
use ndarray::{Array2, Array3, Axis};

use super::Evaluand;
use crate::evaluation::keyframe::{KeyframeMisses, keyframe_misses};
use crate::stages::Progress;
use crate::stages::evaluate::group::GroupMeasurer;
use crate::stages::evaluate::job::{EvaluatedMotion, EvaluationJob};
use crate::stages::evaluate::measure::{MeasuredMotion, stride_for};
use crate::store::tables;
use crate::store::{Location, StoreError};

impl Evaluand {
    /// Reads and measures the motions, as they are and as they were decoded, and groups as groups.
    pub(super) fn measured(
        &self,
        store: &Location,
        job: &EvaluationJob,
        mut groups: Option<&mut GroupMeasurer>,
        progress: &dyn Progress,
    ) -> anyhow::Result<Vec<EvaluatedMotion>> {
        let stride = stride_for(self.n_frames.iter().sum());
        let measurer = job.measurer(stride);
        // The place of the first dancer of each generation or file.
        let firsts: Vec<usize> =
            (0..self.motions.len()).filter(|&i| self.motions[i].dancer == 0).collect();
        progress.start("evaluate", "motions", firsts.len() as u64);
        let mut look = |first: usize, group: &Array3<f32>| {
            if let Some(groups) = groups.as_mut() {
                let motion = &self.motions[first];
                groups.add(&self.phrases, (&motion.phrase_id, motion.split), group.view());
            }
        };
        if let Some(files) = &self.files {
            let found = measurer.run(self.motions.len(), |give| {
                for (file, &first) in files.files.iter().zip(&firsts) {
                    let motion = file.read().map_err(|failure| anyhow::anyhow!(failure.message))?;
                    let dancers: Vec<Array2<f32>> = motion.into_dancers().collect();
                    if self.is_of_groups {
                        let views: Vec<_> = dancers.iter().map(|dancer| dancer.view()).collect();
                        look(first, &ndarray::stack(Axis(0), &views)?);
                    }
                    for (dancer, frames) in dancers.into_iter().enumerate() {
                        give(first + dancer, frames);
                    }
                    progress.advance(1);
                }
                anyhow::Ok(())
            })?;
            progress.finish();
            return Ok(found
                .into_iter()
                .flatten()
                .map(|is| EvaluatedMotion {
                    is,
                    decoded: None,
                    keyframes: KeyframeMisses::default(),
                })
                .collect());
        }
        let names: BTreeSet<String> =
            self.generations.iter().map(|row| row.generation.clone()).collect();
        let places: BTreeMap<&str, usize> = firsts
            .iter()
            .map(|&first| (self.generations[self.motions[first].item].generation.as_str(), first))
            .collect();
        let read = |schema, look: &mut dyn FnMut(usize, &Array3<f32>)| {
            let table = self.snapshot.table(schema)?;
            measurer.run(self.motions.len(), |give| {
                table.visit_groups(&names, |name, group: Array3<f32>| {
                    if let Some(&first) = places.get(name) {
                        look(first, &group);
                        for (dancer, frames) in group.axis_iter(Axis(0)).enumerate() {
                            give(first + dancer, frames.to_owned());
                        }
                    }
                    Ok::<_, StoreError>(())
                })
            })
        };
        let decoded: Vec<Option<MeasuredMotion>> = read(tables::decoded(), &mut |_, _| {})?;
        let mut keyframes = vec![KeyframeMisses::default(); self.motions.len()];
        let is: Vec<Option<MeasuredMotion>> = read(tables::generated(), &mut |first, group| {
            look(first, group);
            for (i, frames) in (first..).zip(group.axis_iter(Axis(0))) {
                keyframes[i] = keyframe_misses(frames, &self.motions[i].keyframes);
            }
            progress.advance(1);
        })?;
        progress.finish();
        let missing = self.motions.iter().zip(&is).find(|(_, found)| found.is_none());
        if let Some((motion, _)) = missing {
            bail!(
                "store {store} has no frames of {}, though it lists the motion; run motiongen generate \
                 again with --force",
                self.generations[motion.item].generation
            );
        }
        Ok(is
            .into_iter()
            .flatten()
            .zip(decoded)
            .zip(keyframes)
            .map(|((is, decoded), keyframes)| EvaluatedMotion { is, decoded, keyframes })
            .collect())
    }
}
