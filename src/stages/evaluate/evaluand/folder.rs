//! The motions of any program, in a folder.

use std::collections::BTreeMap;
use std::path::Path;

use anyhow::{Context as _, bail, ensure};

use super::{Evaluand, MAX_NOTES};
use crate::motion::group::MAX_DANCERS;
use crate::motion::postprocess::PostProcessConfig;
use crate::stages::evaluate::foreign::{self, RefusedFile};
use crate::stages::evaluate::job::EvaluationMotion;
use crate::stages::evaluate::motions::{self, PhraseIndex};
use crate::stages::evaluate::params::Params;
use crate::stages::evaluate::splits::MusicSplit;
use crate::stages::failure::{Failure, FailureKind};
use crate::store::StoreSnapshot;
use crate::training::Ensemble;

impl Evaluand {
    /// Reads the names of the files of a folder; motions are read when they are measured.
    pub(super) fn of_folder(
        snapshot: StoreSnapshot,
        folder: &Path,
        params: &Params,
    ) -> anyhow::Result<Self> {
        let store = snapshot.store();
        let named = |path: &Path| path.file_name().map(|name| name.to_string_lossy().into_owned());
        let absolute = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
        let Some(run) = params.name.clone().or_else(|| named(&absolute)) else {
            bail!("--motions {} has no name; give one with --name", folder.display());
        };
        crate::stages::train::session::check_run_name(&run)
            .with_context(|| format!("--name {run}"))?;
        let known = motions::has_run(&snapshot, &run)?;
        ensure!(
            !known,
            "store {store} has a run \"{run}\" of generate, whose evaluation this one would replace; give \
             another --name"
        );
        let all = PhraseIndex::read(&snapshot, [])?;
        let mut files = foreign::read(folder, &all.foreign_phrases())?;
        if let Some(n) = params.num_samples {
            files.keep(n.get());
        }
        let mut phrases =
            PhraseIndex::read(&snapshot, files.files.iter().map(|file| file.phrase_id.as_str()))?;
        let mut refused = RefusedFile::all(folder, std::mem::take(&mut files.failures));
        // A look at every file, so that what holds no motion is known before the others are measured.
        let (mut motions, mut n_frames, mut notes) = (Vec::new(), Vec::new(), Vec::new());
        let mut has_phase = true;
        let mut derived: BTreeMap<&'static str, usize> = BTreeMap::new();
        let mut read = Vec::new();
        // The first file says whether groups or soloists are evaluated.
        let mut is_of_groups: Option<bool> = None;
        for file in std::mem::take(&mut files.files) {
            let wanted = |motion: foreign::ForeignMotion| {
                let n_dancers = motion.n_dancers();
                let is_group = n_dancers > 1;
                match *is_of_groups.get_or_insert(is_group) == is_group {
                    true => Ok(motion),
                    false => Err(mixed(&file.path, n_dancers)),
                }
            };
            match file.read().and_then(wanted) {
                Ok(motion) => {
                    for dancer in 0..motion.n_dancers() {
                        motions.push(EvaluationMotion {
                            phrase_id: file.phrase_id.clone(),
                            sample: i32::try_from(file.sample).unwrap_or(i32::MAX),
                            item: read.len(),
                            dancer,
                            split: MusicSplit::Unknown,
                            misses: [None; 2],
                            keyframes: Vec::new(),
                        });
                        n_frames.push(motion.frames.nrows());
                    }
                    has_phase &= motion.has_phase;
                    if let Some(what) = motion.content.derived() {
                        *derived.entry(what).or_default() += 1;
                    }
                    notes.extend(motion.note);
                    read.push(file);
                }
                Err(failure) => refused.extend(RefusedFile::all(folder, [(file.path, failure)])),
            }
        }
        files.files = read;
        ensure!(
            !motions.is_empty(),
            "--motions {} has no file that holds a motion for a phrase of the store: {}",
            folder.display(),
            refused.first().map_or_else(|| "it is empty".to_owned(), |r| r.failure.message.clone())
        );
        let is_of_groups = is_of_groups == Some(true);
        if is_of_groups {
            phrases.hold_against(Ensemble::Groups { most: MAX_DANCERS });
        }
        notes.truncate(MAX_NOTES);
        notes.extend(derived.into_iter().map(|(what, n)| format!("Of {n} files {what}.")));
        notes.push(
            "Nobody knows which of these songs the motions were learned from, since another program made them."
                .to_owned(),
        );
        Ok(Self {
            run,
            model: String::new(),
            phrases,
            motions,
            generations: Vec::new(),
            n_candidates: 1,
            notes,
            refused,
            n_frames,
            postprocess: PostProcessConfig::nothing(),
            decoder_derives: false,
            phase_given: false,
            files: Some(files),
            is_of_groups,
            has_phase,
            snapshot,
        })
    }
}

/// Refuses a file of a group among those of soloists, or the other way round.
fn mixed(path: &Path, n_dancers: usize) -> Failure {
    let place = path.display().to_string();
    let (what, others) = match n_dancers {
        1 => ("a soloist".to_owned(), "groups"),
        n => (format!("a group of {n} dancers"), "soloists"),
    };
    let message = format!(
        "{place}: is the motion of {what}, beside others of {others}; evaluate groups and soloists in folders of \
         their own"
    );
    Failure::new(FailureKind::Shape, &place, message)
}
