//! The rows of batches that are done.

use super::{PhraseBatch, PhraseOutcome, PhraseTask, beside};
use crate::stages::batch::{BatchCommit, BatchJob};
use crate::stages::beats;
use crate::stages::extract::one::ExtractedFeatures;
use crate::stages::failure::{Failure, FailureKind};
use crate::store::tables::{self, BeatRow, ExtractionRow};
use crate::store::{Item, StoreError};

/// Writes finished batches.
pub struct BatchWriter<'a> {
    pub job: BatchJob<'a>,
    pub force: bool,
}

impl BatchWriter<'_> {
    pub fn commit(&self, batch: PhraseBatch) -> Result<(), StoreError> {
        let mut commit = self.job.start();
        let (mut extractions, mut beats) = (Vec::new(), Vec::new());
        for (id, (task, outcome)) in batch.outcomes {
            let id = self.name_for(id, &outcome, &mut commit);
            let failure = outcome.as_ref().err().map(Failure::digest);
            let input_hash = task.row.content_hash.clone();
            let fingerprint = task.fingerprint();
            let unchanged = self.job.known(&id).is_some_and(|known| {
                known.item.input_hash == input_hash
                    && known.item.fingerprint == fingerprint
                    && known.item.failure == failure
            });
            if unchanged && !(self.force && failure.is_none()) {
                continue;
            }
            match outcome {
                Ok(extracted) => {
                    let part = commit.part(tables::FEATURES, tables::features)?;
                    part.write_frames(&id, extracted.frames.view())?;
                    extractions.push(extraction_row(&id, &task, &extracted));
                    if !task.has_listed_beats {
                        beats.extend(beat_rows(&id, &extracted));
                    }
                }
                Err(failure) => commit.list_failure(&id, &task.url, &failure),
            }
            commit.settle(Item { id, fingerprint, input_hash, failure });
        }
        commit.rows(&extractions)?;
        commit.rows::<BeatRow>(&beats)?;
        commit.publish()
    }

    /// Returns the name to settle: the phrase's own, or one beside it when a file that cannot be
    /// read just now says nothing against the rows that are there.
    fn name_for(
        &self,
        id: String,
        outcome: &PhraseOutcome,
        commit: &mut BatchCommit<'_>,
    ) -> String {
        let beside = beside(&id);
        let is_out_of_reach =
            outcome.as_ref().is_err_and(|failure| failure.kind == FailureKind::Unreadable);
        if is_out_of_reach && self.job.has_rows(&id) {
            return beside;
        }
        if self.job.has_failed(&beside) {
            commit.forget(&beside);
        }
        id
    }
}

fn extraction_row(id: &str, task: &PhraseTask, extracted: &ExtractedFeatures) -> ExtractionRow {
    let heard = extracted.audio;
    ExtractionRow {
        phrase_id: id.to_owned(),
        origin: extracted.origin.name().to_owned(),
        source_url: task.url.clone(),
        n_frames: extracted.frames.nrows() as i64,
        n_samples: heard.map(|h| h.n_samples as i64),
        duration_s: extracted.duration_s(),
        tuning: heard.map(|h| h.tuning.bins()),
        tuning_source: heard.map(|h| h.tuning_source.to_owned()),
        tempo_bpm: extracted.tempo_bpm,
        n_beats: extracted.beats.len() as i32,
        audio_codec: heard.map(|h| h.encoding.codec.to_owned()),
        sample_rate_hz: heard.map(|h| h.encoding.sample_rate_hz as i32),
        n_channels: heard.map(|h| i32::from(h.encoding.n_channels)),
        content_hash: Some(task.row.content_hash.clone()),
        truncated: heard.map(|h| h.loss.is_truncated),
        lost_s: heard.map(|h| h.loss.lost_s),
    }
}

fn beat_rows<'a>(
    id: &'a str,
    extracted: &'a ExtractedFeatures,
) -> impl Iterator<Item = BeatRow> + 'a {
    let beats = extracted.pulse.iter().copied();
    beats::rows(id, beats, extracted.frames.nrows(), extracted.origin.beat_source())
}
