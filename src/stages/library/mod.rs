//! `library`: songs and motion captures become constructed phrases in `phrases`, `motion`, `features`
//! and `beats`.

mod captures;
mod known;
mod layout;
mod one;
mod report;
mod songs;
mod split;
mod write;

use std::collections::BTreeSet;
use std::num::{NonZeroU32, NonZeroUsize};
use std::path::PathBuf;
use std::sync::Mutex;
use std::sync::mpsc::sync_channel;
use std::time::Instant;

use anyhow::{Context as _, bail};

use super::extract::needed_bytes;
use super::extract::pool::{self, Budget, lock};
use super::failure::{Failure, FailureKind, guarded};
use super::{ClientParams, Contract, Progress, Stage, Summary};
use crate::store::{ClientOptions, Ledger, Location, StoreError, digest};
use captures::Captures;
use known::Known;
use layout::Output;
use report::{Place, Report, Tally};
use songs::{Files, Input, Song, Songs};
use split::Share;
use write::{Refusal, Writer, fingerprint, is_settled};

/// Raised when library writes something else for the same inputs and parameters.
const OUTPUT_VERSION: u32 = 1;
/// Where items come from that the store itself has, as commits name it.
const FROM_STORE: &str = "phrases";
/// Memory that songs under way may take while their audio is decoded.
const MEMORY_BYTES: u64 = 2_000_000_000;

/// The stage.
pub struct Library;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables. Without --songs, its phrases with audio and features are the
    /// songs; without --captures, its phrases with motion and no audio are the captures.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Folder or bucket of songs: any tree of audio files, song.beats.txt beside song.ogg.
    #[arg(long, value_name = "DIR")]
    pub songs: Option<String>,
    /// Folder or bucket of motion captures: any tree of .bvh and .npy ([frames, 25]) files.
    #[arg(long, value_name = "DIR")]
    pub captures: Option<String>,
    /// Also write the phrases as files, in the layout that ingest reads.
    #[arg(long, value_name = "DIR")]
    pub output: Option<PathBuf>,
    #[command(flatten)]
    pub rules: Rules,
    /// Songs for validation: a number, or a fraction of all (at least one). Fewer than three songs all
    /// train.
    #[arg(long, value_name = "N|FRACTION", default_value_t = Share::Fraction(0.1))]
    pub validation_songs: Share,
    /// Songs for the test: a number, or a fraction of all (at least one).
    #[arg(long, value_name = "N|FRACTION", default_value_t = Share::Fraction(0.1))]
    pub test_songs: Share,
    /// Songs under way at once.
    #[arg(long, value_name = "N", default_value_t = default_workers())]
    pub workers: NonZeroUsize,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Do every song again, done or not.
    #[arg(long)]
    pub force: bool,
}

/// What determines the phrases beside songs and captures.
#[derive(Clone, Copy, Debug, clap::Args, serde::Serialize)]
pub struct Rules {
    /// Dances per song, each another choice of steps and turns.
    #[arg(long, value_name = "N", default_value_t = NonZeroU32::new(8).expect("8 is not 0"))]
    pub takes: NonZeroU32,
    /// Length of a phrase, in frames at 30 fps.
    #[arg(long, value_name = "FRAMES",
          default_value_t = NonZeroUsize::new(120).expect("120 is not 0"))]
    pub phrase_frames: NonZeroUsize,
    /// From the begin of a phrase to that of the next, in frames.
    #[arg(long, value_name = "FRAMES",
          default_value_t = NonZeroUsize::new(60).expect("60 is not 0"))]
    pub hop_frames: NonZeroUsize,
    /// Chooses other dances of the same songs and captures.
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub seed: u64,
}

fn default_workers() -> NonZeroUsize {
    std::thread::available_parallelism().unwrap_or(NonZeroUsize::MIN)
}

impl Stage for Library {
    const NAME: &'static str = "library";
    const ABOUT: &'static str = "construct phrases to train on from songs and motion captures";
    const CONTRACT: Contract = Contract {
        reads: "phrases, features, beats and motion, or folders of songs and captures",
        writes: "phrases, motion, features, beats, failures, or also a phrase layout",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        let started = Instant::now();
        let options = params.client.options();
        let store = Location::open(&params.store, &options)?;
        let mut known = Known::read(&store)?;
        let ledger = Ledger::read(&store, Self::NAME)?;
        let captures = match &params.captures {
            Some(url) => Captures::of_folder(url, &options)?,
            None => Captures::of_store(&store, &known),
        };
        let mut songs = match &params.songs {
            Some(url) => Songs::of_folder(url, &options)?,
            None => Songs::of_store(&store, &mut known)?,
        };
        prepare(&mut songs, &params)?;
        let job = Job { store: &store, ledger, known, options, params: &params, progress };
        let mut report = Report {
            place: Place { store: store.to_string(), output: params.output.clone() },
            dry_run: params.dry_run,
            splits: splits(&songs.songs),
            n_without_features: songs.n_without_features,
            tally: Tally::default(),
            took_s: 0.0,
        };
        job.run(captures, songs, &mut report)?;
        report.took_s = started.elapsed().as_secs_f64();
        report.tally.failed.sort_by(|a, b| a.0.cmp(&b.0));
        Ok(Box::new(report))
    }
}

/// Names what is wrong with songs already, and splits the others.
fn prepare(songs: &mut Songs, params: &Params) -> anyhow::Result<()> {
    songs.refuse_namesakes();
    let length = params.rules.phrase_frames.get();
    for song in songs.songs.iter_mut().filter(|song| song.problem.is_none()) {
        if let Files::Store { n_frames, .. } = &song.files
            && *n_frames < length
        {
            song.problem = Some(one::too_short(song, *n_frames, length));
        }
    }
    // A song that cannot be danced to takes no place in a split.
    let names: Vec<String> =
        songs.songs.iter().filter(|s| s.problem.is_none()).map(|s| s.id.clone()).collect();
    let of =
        split::assign(names.iter().map(String::as_str), params.validation_songs, params.test_songs)
            .map_err(anyhow::Error::msg)?;
    for song in &mut songs.songs {
        song.split = of.get(song.id.as_str()).copied().unwrap_or(split::TRAIN);
    }
    if names.len() < 3 {
        tracing::warn!("{} songs are too few to split: all of them are for training", names.len());
    }
    Ok(())
}

/// Counts the songs of every split.
fn splits(songs: &[Song]) -> [(usize, &'static str); 3] {
    [split::TRAIN, split::VALIDATION, split::TEST].map(|name| {
        let n = songs.iter().filter(|s| s.problem.is_none() && s.split == name).count();
        (n, name)
    })
}

/// Returns the failure of a file that could not be read.
fn unreadable(path: &str, error: &StoreError) -> Failure {
    let cause = std::error::Error::source(error).map(|e| format!(" ({e})")).unwrap_or_default();
    Failure::new(FailureKind::Unreadable, path, format!("{error}{cause}"))
}

/// Returns the digest of everything but the inputs that determines library's output.
fn params_hash(rules: &Rules) -> String {
    let text = serde_json::json!({ "output_version": OUTPUT_VERSION, "rules": rules });
    digest(text.to_string().as_bytes())
}

/// Everything that the songs of a run share.
struct Job<'a> {
    store: &'a Location,
    ledger: Ledger,
    known: Known,
    options: ClientOptions,
    params: &'a Params,
    progress: &'a dyn Progress,
}

impl Job<'_> {
    fn run(&self, captures: Captures, songs: Songs, report: &mut Report) -> anyhow::Result<()> {
        let Params { rules, output, force, dry_run, .. } = self.params;
        let params_hash = params_hash(rules);
        let capture_names = captures.names();
        let (captures_origin, captures_print) =
            (captures.origin.clone(), captures.fingerprint.clone());
        let is_done = |song: &Song| {
            let print = fingerprint(song, &captures_print);
            !force
                && output.is_none()
                && is_settled(song, &self.ledger, &params_hash, rules, &print)
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
        self.store.sweep()?;
        let failed_before =
            |name: &String| self.ledger.get(name).is_some_and(|k| k.item.failure.is_some());
        // Captures are read where they are danced, or where one may have been mended.
        let loaded = if todo.is_empty() && !capture_names.iter().any(failed_before) {
            None
        } else {
            Some(captures.load()?)
        };
        let folder = output
            .as_ref()
            .map(|path| {
                Output::new(path).with_context(|| format!("while making {}", path.display()))
            })
            .transpose()?;
        let empty = captures::Loaded::default();
        let loaded = loaded.as_ref().unwrap_or(&empty);
        let writer = Writer {
            store: self.store,
            ledger: &self.ledger,
            params_hash: &params_hash,
            origin: &songs.origin,
            rules,
            repertoire: &loaded.repertoire,
            captures_hash: &loaded.content_hash,
            captures_fingerprint: &captures_print,
            constructed: &self.known.constructed,
            others: &self.known.others,
            output: folder.as_ref(),
            force: *force,
        };
        writer.captures(&captures_origin, &capture_names, &loaded.failed)?;
        for song in &problems {
            if let Some(failure) = &song.problem {
                writer.failed_song(song, failure)?;
            }
        }
        let failed = loaded.failed.iter().map(|(name, _, f)| (name.clone(), f.clone()));
        report.tally.failed.extend(failed);
        report.tally.n_captures = loaded.repertoire.n_captures();
        report.tally.n_primitives = loaded.repertoire.primitives().len();
        if !todo.is_empty() && loaded.repertoire.primitives().is_empty() {
            let first = loaded.failed.first().map_or(String::new(), |(_, _, f)| f.message.clone());
            bail!(
                "none of the {} captures can be danced ({first}); name others with --captures; all \
                 of them: motiongen query --store {} \"select phrase_id, kind, message from failures\"",
                capture_names.len(),
                self.store
            );
        }
        self.dance(&songs, todo, &writer, report)?;
        self.forget(&songs, &writer, &captures_origin, capture_names, report)?;
        if let Some(folder) = folder {
            folder.finish().context("while writing --output")?;
        }
        if report.tally.n_done + report.tally.n_unchanged == 0 {
            let first = report.tally.failed.first().map_or("", |(_, f)| f.message.as_str());
            bail!(
                "none of the {} songs can be danced to ({first}); all of them: motiongen query --store \
                 {} \"select phrase_id, kind, message from failures\"",
                songs.songs.len(),
                self.store
            );
        }
        Ok(())
    }

    /// Reads and dances the songs `todo`, on several threads.
    fn dance(
        &self,
        songs: &Songs,
        todo: Vec<Song>,
        writer: &Writer<'_>,
        report: &mut Report,
    ) -> anyhow::Result<()> {
        if todo.is_empty() {
            return Ok(());
        }
        self.progress.start("library", "songs", todo.len() as u64);
        let feeding = songs.feeding(todo);
        let (sender, receiver) = sync_channel::<(Song, Input)>(1);
        let tally = Mutex::new(std::mem::take(&mut report.tally));
        let budget = Budget::new(MEMORY_BYTES);
        let outcome = std::thread::scope(|scope| {
            let reader = scope.spawn(move || feeding.run(&sender));
            let worked = pool::run(
                self.params.workers,
                // The receiver goes with the pool, and then the reader stops, too.
                move || receiver.recv().ok(),
                |(song, input)| self.song(&song, input, writer, &budget, &tally),
            );
            let read = reader.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            worked.and(read.map_err(anyhow::Error::from))
        });
        self.progress.finish();
        report.tally = tally.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        outcome
    }

    fn song(
        &self,
        song: &Song,
        input: Input,
        writer: &Writer<'_>,
        budget: &Budget,
        tally: &Mutex<Tally>,
    ) -> anyhow::Result<()> {
        let danced = guarded(&song.id, || {
            let music = {
                let _share = budget.take(input.needed_bytes());
                one::read(song, input, &self.options)?
            };
            Ok(writer.song(song, &music))
        });
        let failure = match danced {
            Ok(Ok(written)) => {
                lock(tally).add(song, written);
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
        writer: &Writer<'_>,
        captures_origin: &str,
        mut capture_names: BTreeSet<String>,
        report: &mut Report,
    ) -> anyhow::Result<()> {
        let mut names: BTreeSet<String> = songs.songs.iter().map(|s| s.id.clone()).collect();
        let urls: BTreeSet<&str> = songs.songs.iter().map(|s| s.url.as_str()).collect();
        if captures_origin == songs.origin {
            names.append(&mut capture_names);
        } else {
            writer.forget(captures_origin, &capture_names, None)?;
        }
        report.tally.n_forgotten = writer.forget(&songs.origin, &names, Some(&urls))?;
        Ok(())
    }
}

impl Input {
    /// Returns an estimate of the memory that reading takes.
    fn needed_bytes(&self) -> u64 {
        match self {
            Input::Features(_) => 0,
            // Its length is not known before it is decoded: room for what is held of the longest.
            Input::Files { .. } => needed_bytes(360.0, 0),
        }
    }
}
