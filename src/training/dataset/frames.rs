//! The frames of phrases, read from a table and kept at hand unless they are not sound.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use ndarray::{Array3, Axis};

use super::{DatasetOptions, Ensemble, ExcludedPhrase};
use crate::motion::{ChannelLimits, Dancers, MOTION_DIM};
use crate::store::{FrameSpool, Snapshot, StoreError, digest};

/// The frames of a phrase as read from one table.
pub struct PhraseFrames {
    pub row: u64,
    pub n_dancers: usize,
    /// Frames of each dancer.
    pub n_frames: usize,
    pub digest: String,
}

/// Frames of one table by phrase, or why they are of no use.
pub type PhraseResults = BTreeMap<String, Result<PhraseFrames, ExcludedPhrase>>;

/// Reads the wanted phrases of a frame table into a spool, parts side by side.
pub fn gather(
    table: &Snapshot,
    spool: &FrameSpool,
    wanted: &BTreeSet<String>,
    (reading, ensemble): (&DatasetOptions, Ensemble),
    notice: &(dyn Fn(&StoreError, Duration) + Sync),
    count: &(dyn Fn() + Sync),
) -> Result<PhraseResults, StoreError> {
    let next = AtomicUsize::new(0);
    let all = Mutex::new(PhraseResults::new());
    let failed: Mutex<Option<StoreError>> = Mutex::new(None);
    let lock = |all: &Mutex<PhraseResults>, found: PhraseResults| {
        all.lock().unwrap_or_else(PoisonError::into_inner).extend(found);
    };
    let work = || {
        loop {
            let i = next.fetch_add(1, Ordering::Relaxed);
            if i >= table.parts().len() {
                return;
            }
            let part = table.part(i);
            // A part that breaks off is read again from its beginning: what it left in the spool is
            // never looked at.
            let outcome = reading.patience.wait_out(notice, || {
                let mut found = PhraseResults::new();
                part.visit_groups(wanted, |id, frames| {
                    let one = keep(id, frames, spool, ensemble)?;
                    found.insert(id.to_owned(), one);
                    Ok::<_, StoreError>(())
                })?;
                Ok(found)
            });
            match outcome {
                Ok(found) => lock(&all, found),
                Err(error) => {
                    next.store(table.parts().len(), Ordering::Relaxed);
                    *failed.lock().unwrap_or_else(PoisonError::into_inner) = Some(error);
                    return;
                }
            }
            count();
        }
    };
    std::thread::scope(|scope| {
        for _ in 0..reading.n_threads.get().min(table.parts().len()) {
            scope.spawn(work);
        }
    });
    match failed.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some(error) => Err(error),
        None => Ok(all.into_inner().unwrap_or_else(PoisonError::into_inner)),
    }
}

/// Puts frames into the spool, dancer by dancer, unless they are not sound or not of those that are learned from.
fn keep(
    id: &str,
    frames: Array3<f32>,
    spool: &FrameSpool,
    ensemble: Ensemble,
) -> Result<Result<PhraseFrames, ExcludedPhrase>, StoreError> {
    let (n_dancers, n_frames, n_channels) = frames.dim();
    let refused =
        |kind, message| Ok(Err(ExcludedPhrase { phrase_id: id.to_owned(), kind, message }));
    if let Some(why) = ensemble.refusal(n_dancers) {
        return refused(ExcludedPhrase::GROUP, format!("phrase {id} has {why}"));
    }
    if let Err((kind, what)) = check(&frames) {
        return refused(kind, format!("phrase {id}: {what}"));
    }
    let rows = frames
        .into_shape_with_order((n_dancers * n_frames, n_channels))
        .expect("invariant: frames are gathered in order");
    let bytes: Vec<u8> = rows.iter().flat_map(|x| x.to_le_bytes()).collect();
    let row = spool.append(rows.view())?;
    let of_frames = digest(&bytes);
    let digest = match n_dancers {
        1 => of_frames,
        n => digest(format!("{n} dancers\n{of_frames}").as_bytes()),
    };
    Ok(Ok(PhraseFrames { row, n_dancers, n_frames, digest }))
}

/// Refuses frames that are not finite; those of motion are checked as ingest does, because a table may
/// have been written by another program.
fn check(frames: &Array3<f32>) -> Result<(), (&'static str, String)> {
    if frames.len_of(Axis(2)) == MOTION_DIM {
        let dancers = Dancers::of_frames(frames.clone()).map_err(|e| (e.kind(), e.to_string()))?;
        return match dancers.trajectories() {
            [soloist] => soloist.check(&ChannelLimits::Wide).map_err(|e| (e.kind(), e.to_string())),
            _ => dancers.check(&ChannelLimits::Wide).map_err(|e| (e.kind(), e.to_string())),
        };
    }
    match frames.indexed_iter().find(|(_, x)| !x.is_finite()) {
        None => Ok(()),
        Some(((_, frame, column), value)) => {
            let name = crate::audio::feature_names().nth(column).map(|(name, _)| name);
            let name = name.unwrap_or_default();
            let what = format!("feature {name} is {value} at frame {frame}; extract it again");
            Err(("non_finite", what))
        }
    }
}
