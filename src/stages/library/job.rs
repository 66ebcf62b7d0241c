//! The work itself: captures are read, songs danced to and committed side by side.

use std::collections::BTreeSet;
use std::sync::Mutex;
use std::sync::mpsc::sync_channel;

use anyhow::{Context as _, bail};

use super::captures::{Captures, LoadedCaptures};
use super::layout::PhraseFolder;
use super::made::{self, Band, perform};
use super::report::{LibrarySummary, LibraryTally};
use super::songs::{Song, SongFiles, SongInput, Songs};
use super::store_contents::StoreContents;
use super::write::{Refusal, SongWriter, fingerprint, state};
use super::{Library, Params, one, params_hash};
use crate::stages::batch::BatchJob;
use crate::stages::extract::needed_bytes;
use crate::stages::failure::{guarded, query_of_failures};
use crate::stages::pool::{self, Budget, lock};
use crate::stages::touched::TouchedContent;
use crate::stages::{Progress, Stage as _};
use crate::store::{Ledger, Location};

/// Memory that songs under way may take while their audio is decoded.
const MEMORY_BYTES: u64 = 2_000_000_000;

/// Everything that the songs of a run share.
pub struct LibraryJob<'a> {
    pub store: &'a Location,
    pub ledger: Ledger,
    pub seen: TouchedContent,
    pub known: StoreContents,
    pub band: Band,
    pub params: &'a Params,
    pub progress: &'a dyn Progress,
}

impl LibraryJob<'_> {
    /// Reads the captures, dances to every song that is not done, and tells `report`.
    ///
    /// # Errors
    /// When there is no usable capture or song, or the store cannot be read or written; what was
    /// committed stays.
    pub fn run(
        &self,
        captures: Captures,
        songs: &Songs,
        report: &mut LibrarySummary,
    ) -> anyhow::Result<()> {
        let Params { rules, output, compose_audio, force, dry_run, .. } = self.params;
        let params_hash = params_hash(rules);
        let capture_names = captures.names();
        let (captures_origin, captures_print) =
            (captures.origin.clone(), captures.fingerprint.clone());
        let batches = BatchJob {
            store: self.store,
            stage: Library::NAME,
            params_hash: &params_hash,
            origin: &songs.origin,
            ledger: &self.ledger,
        };
        let is_done = |song: &Song| {
            let print = fingerprint(song, &captures_print);
            !force
                && output.is_none()
                && (compose_audio.is_none() || !song.is_made())
                && state(
                    song,
                    self.ledger.get(&one::phrase_id(song, rules, 0, 0)),
                    (&self.ledger, &self.seen),
                    (&songs.origin, &params_hash),
                    &print,
                )
                .is_done()
        };
        let (sound, problems): (Vec<Song>, Vec<Song>) =
            songs.songs.iter().cloned().partition(|song| song.problem.is_none());
        let (done, todo): (Vec<Song>, Vec<Song>) = sound.into_iter().partition(is_done);
        report.tally.n_todo = todo.len();
        report.tally.n_unchanged = done.len();
        for song in &problems {
            report.tally.failed.extend(song.problem.clone().map(|f| (song.id.clone(), f)));
        }
        if *dry_run {
            return Ok(());
        }
        self.store.sweep();
        // Captures are read where they are danced, or where one may have been mended.
        let loaded =
            if todo.is_empty() && !capture_names.iter().any(|name| batches.has_failed(name)) {
                None
            } else {
                Some(captures.load()?)
            };
        let folder = output
            .as_ref()
            .map(|path| {
                PhraseFolder::new(path).with_context(|| format!("while making {}", path.display()))
            })
            .transpose()?;
        let empty = LoadedCaptures::default();
        let loaded = loaded.as_ref().unwrap_or(&empty);
        let writer = SongWriter {
            batches,
            rules,
            repertoire: &loaded.repertoire,
            captures_hash: &loaded.content_hash,
            captures_fingerprint: &captures_print,
            constructed: &self.known.constructed,
            others: &self.known.others,
            output: folder.as_ref(),
            force: *force,
            seen: &self.seen,
        };
        writer.captures(&captures_origin, &capture_names, &loaded.failed)?;
        for song in &problems {
            if let Some(failure) = &song.problem {
                writer.failed_song(song, failure)?;
            }
        }
        let failed = loaded.failed.iter().map(|(name, _, f)| (name.clone(), f.clone()));
        report.tally.failed.extend(failed);
        report.tally.noted.clone_from(&loaded.noted);
        report.tally.n_captures = loaded.repertoire.n_captures();
        report.tally.n_primitives = loaded.repertoire.primitives().len();
        if !todo.is_empty() && loaded.repertoire.primitives().is_empty() {
            let first = loaded.failed.first().map_or(String::new(), |(_, _, f)| f.message.clone());
            bail!(
                "none of the {} captures can be danced ({first}); name others with --captures; all of them: {}",
                capture_names.len(),
                query_of_failures(&self.store.to_string())
            );
        }
        self.dance(songs, todo, &writer, report)?;
        if report.tally.is_stopped {
            return Ok(());
        }
        warn_of_empty_splits(&songs.songs, report);
        self.forget(songs, &writer, &captures_origin, capture_names, report)?;
        if let Some(folder) = folder {
            folder.finish().context("while writing --output")?;
        }
        if report.tally.n_done + report.tally.n_unchanged == 0 {
            let first = report.tally.failed.first().map_or("", |(_, f)| f.message.as_str());
            bail!(
                "none of the {} songs can be danced to ({first}); all of them: {}",
                songs.songs.len(),
                query_of_failures(&self.store.to_string())
            );
        }
        Ok(())
    }

    /// Reads and dances the songs `todo`, on several threads.
    fn dance(
        &self,
        songs: &Songs,
        todo: Vec<Song>,
        writer: &SongWriter<'_>,
        report: &mut LibrarySummary,
    ) -> anyhow::Result<()> {
        if todo.is_empty() {
            return Ok(());
        }
        self.progress.start("library", "songs", todo.len() as u64);
        let feeding = songs.feeding(todo);
        let (sender, receiver) = sync_channel::<(Song, SongInput)>(1);
        let all = Mutex::new(std::mem::take(&mut report.tally));
        let tally = &all;
        let budget = Budget::new(MEMORY_BYTES);
        let outcome = std::thread::scope(|scope| {
            let reader = scope.spawn(move || feeding.run(&sender));
            let worked = pool::run(
                self.params.workers,
                // The receiver goes with the pool, and then the reader stops, too.
                move || {
                    let song = receiver.recv().ok()?;
                    if self.progress.is_interrupted() {
                        lock(tally).is_stopped = true;
                        return None;
                    }
                    Some(song)
                },
                |(song, input)| self.song(&song, input, writer, &budget, tally),
            );
            let read = reader.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            worked.and(read.map_err(anyhow::Error::from))
        });
        self.progress.finish();
        report.tally = all.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        outcome
    }

    fn song(
        &self,
        song: &Song,
        input: SongInput,
        writer: &SongWriter<'_>,
        budget: &Budget,
        tally: &Mutex<LibraryTally>,
    ) -> anyhow::Result<()> {
        let danced = guarded(&song.id, || {
            let music = {
                let _share = budget.take(input.needed_bytes());
                let input = match &song.files {
                    SongFiles::Score { piece, seed, .. } => {
                        let performance = perform(song, piece, *seed, &self.band)?;
                        if let Some(folder) = &self.params.compose_audio
                            && let Err(e) = made::write(folder, song, &performance)
                        {
                            let e = anyhow::Error::new(e).context("while writing --compose-audio");
                            return Ok(Err(Refusal::Store(e)));
                        }
                        SongInput::Performed(performance)
                    }
                    _ => input,
                };
                one::read(song, input)?
            };
            Ok(writer.song(song, &music))
        });
        let failure = match danced {
            Ok(Ok(written)) => {
                lock(tally).add(song, &written);
                None
            }
            Ok(Err(Refusal::Store(error))) => return Err(error),
            Ok(Err(Refusal::Song(failure))) | Err(failure) => Some(failure),
        };
        if let Some(failure) = failure {
            writer.failed_song(song, &failure)?;
            lock(tally).failed.push((song.id.clone(), failure));
        }
        self.progress.advance(1);
        Ok(())
    }

    /// Removes what is no longer among the songs and captures.
    fn forget(
        &self,
        songs: &Songs,
        writer: &SongWriter<'_>,
        captures_origin: &str,
        mut capture_names: BTreeSet<String>,
        report: &mut LibrarySummary,
    ) -> anyhow::Result<()> {
        let mut names: BTreeSet<String> = songs.songs.iter().map(|s| s.id.clone()).collect();
        let slugs: BTreeSet<&str> = songs.songs.iter().map(|s| s.slug.as_str()).collect();
        if captures_origin == songs.origin {
            names.append(&mut capture_names);
        } else {
            writer.forget(captures_origin, &capture_names, None)?;
        }
        report.tally.n_forgotten = writer.forget(&songs.origin, &names, Some(&slugs))?;
        Ok(())
    }
}

/// Tells of a split that has songs of which none could be danced to.
fn warn_of_empty_splits(songs: &[Song], report: &LibrarySummary) {
    let failed: BTreeSet<&str> =
        report.tally.failed.iter().map(|(name, _)| name.as_str()).collect();
    for (n, split) in report.splits {
        let mut of_split = songs.iter().filter(|s| s.problem.is_none() && s.split == split);
        if n > 0 && of_split.all(|song| failed.contains(song.id.as_str())) {
            tracing::warn!("no song of the {split} split could be danced to, so it has no phrases");
        }
    }
}

impl SongInput {
    /// Returns an estimate of the memory that reading takes.
    fn needed_bytes(&self) -> u64 {
        match self {
            SongInput::Features(_) => 0,
            SongInput::Unplayed { duration_s } => {
                needed_bytes(*duration_s, 0) + made::needed_bytes(*duration_s)
            }
            SongInput::Performed(_) => 0,
            // Its length is not known before it is decoded: room for what is held of the longest.
            SongInput::Files { .. } => needed_bytes(360.0, 0),
        }
    }
}
