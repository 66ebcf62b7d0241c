//! The motions that a plot or a page shows: files, a phrase of a store, or what was generated for it.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::{anyhow, bail, ensure};
use ndarray::Array3;

use super::Stage as _;
use super::beats;
use super::generate::generation_id;
use super::ingest::{Ingest, read_beats, read_dancers, read_trajectory};
use super::plot::nearest::nearest;
use crate::motion::{Trajectory, exchange, npy};
use crate::store::tables::{self, FailureRow, GenerationRow, PhraseRow};
use crate::store::{
    ClientOptions, ItemTables, Location, Row as _, Snapshot, StoreError, StoreSnapshot,
    outdated_generations,
};

/// Most motions that one page shows.
const MAX_SHOWN: usize = 16;

/// What the user wants to look at.
#[derive(Clone, Debug, clap::Args)]
pub struct MotionParams {
    /// Motion file with 25 channels per frame at 30 fps, FILE.npy or FILE.csv.
    #[arg(long, value_name = "FILE", num_args = 1..)]
    pub motion: Vec<PathBuf>,
    /// Beats to mark instead of those that the store has: a file with one time in seconds per line.
    #[arg(long, value_name = "FILE")]
    pub beats: Option<PathBuf>,
    /// Folder or bucket of the tables, for --phrase.
    #[arg(long, value_name = "URL")]
    pub store: Option<String>,
    /// Instead of --motion: the phrase whose motion in the store is shown.
    #[arg(long, value_name = "ID")]
    pub phrase: Option<String>,
    /// With --phrase: the generation whose motion is shown, instead of the phrase's own.
    #[arg(long, value_name = "NAME")]
    pub run: Option<String>,
    /// With --run: which of the motions that were generated for the phrase, counted from 0 [default: the
    /// first in a plot, all in a page]
    #[arg(long = "sample", value_name = "N", value_delimiter = ',')]
    pub samples: Vec<usize>,
}

/// How many motions can be displayed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MotionCapacity {
    /// A plot's.
    One,
    /// A page's.
    Many,
}

/// Motions to display, with title and beats.
#[derive(Clone, Debug)]
pub struct MotionDisplay {
    /// The title above it.
    pub title: String,
    /// One or more.
    pub shown: Vec<DisplayedMotion>,
    pub beats_s: Vec<f64>,
    /// What the store says of the phrase.
    pub phrase: Option<PhraseRow>,
}

/// A motion and what is known of it.
#[derive(Clone, Debug)]
pub struct DisplayedMotion {
    pub name: String,
    /// Its values may be anything.
    pub motion: Trajectory,
    pub facts: Vec<(String, String)>,
}

impl MotionParams {
    /// Reads what the user wants to look at.
    ///
    /// # Errors
    /// One sentence for what is not there, cannot be read, or has no room.
    pub fn read(
        &self,
        room: MotionCapacity,
        options: &ClientOptions,
    ) -> anyhow::Result<MotionDisplay> {
        let mut subject = match (self.motion.as_slice(), &self.phrase, &self.store) {
            ([_, ..], Some(phrase), _) => {
                bail!("--motion and --phrase {phrase} name two things to show; give one of them")
            }
            (files @ [_, ..], None, _) => of_files(files, room)?,
            ([], Some(phrase), Some(store)) => {
                self.of_store(&Location::open(store, options)?, phrase, room)?
            }
            ([], Some(phrase), None) => {
                bail!("--phrase {phrase} is a name in a store; say which with --store")
            }
            ([], None, _) => {
                bail!("nothing to show: give --motion FILE, or --store URL and --phrase ID")
            }
        };
        if let Some(path) = &self.beats {
            let place = path.display().to_string();
            let beats = read_beats(&place, &bytes_of(path)?).map_err(|f| anyhow!(f.message))?;
            subject.beats_s = beats.times_s().to_vec();
        }
        Ok(subject)
    }

    fn of_store(
        &self,
        store: &Location,
        phrase: &str,
        room: MotionCapacity,
    ) -> anyhow::Result<MotionDisplay> {
        let rows = ItemTables::take(store, phrase)?;
        let known: Option<PhraseRow> = rows.rows()?.pop();
        let (title, shown) = match &self.run {
            Some(run) => {
                let shown = of_run(store, run, (phrase, known.as_ref()), &self.samples, room)?;
                (format!("{phrase} by {run}"), shown)
            }
            None => {
                let Some(frames) = rows.group(tables::motion())? else {
                    return Err(missing(store, phrase, &rows, known.is_some())?);
                };
                let facts = known.as_ref().map(facts_of_phrase).unwrap_or_default();
                (phrase.to_owned(), of_dancers(phrase, &frames, &facts, room)?)
            }
        };
        let beats_s = beats::of_item(&rows)?.times_s().to_vec();
        Ok(MotionDisplay { title, shown, beats_s, phrase: known })
    }
}

fn of_files(files: &[PathBuf], room: MotionCapacity) -> anyhow::Result<MotionDisplay> {
    check_room(files.len(), "--motion", room)?;
    let mut shown = Vec::new();
    for path in files {
        shown.extend(of_dancers(&name_of(path), &read_group(path)?, &[], room)?);
    }
    let title = match files {
        [first, rest @ ..] if !rest.is_empty() => {
            format!("{} and {} more", name_of(first), rest.len())
        }
        _ => shown.first().map(|shown| shown.name.clone()).unwrap_or_default(),
    };
    Ok(MotionDisplay { title, shown, beats_s: Vec::new(), phrase: None })
}

fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned()
}

/// Refuses more motions than have room.
fn check_room(n: usize, flag: &str, room: MotionCapacity) -> anyhow::Result<()> {
    match room {
        MotionCapacity::One if n > 1 => {
            bail!("a plot shows one motion, and {flag} names {n}; give one")
        }
        MotionCapacity::Many if n > MAX_SHOWN => {
            bail!("a page shows up to {MAX_SHOWN} motions, and {flag} names {n}; give fewer")
        }
        _ => Ok(()),
    }
}

/// Reads a motion file, `.npy` or `.csv`, of shape `[T, 25]`; its values are not looked at.
///
/// # Errors
/// One sentence that names the file.
pub fn read_motion(path: &Path) -> anyhow::Result<Trajectory> {
    let place = path.display().to_string();
    let extension = path.extension().map(|e| e.to_string_lossy().to_ascii_lowercase());
    match extension.as_deref() {
        Some("npy") => {
            read_trajectory(&place, &bytes_of(path)?).map_err(|failure| anyhow!(failure.message))
        }
        Some("csv") => {
            let text = String::from_utf8(bytes_of(path)?)
                .map_err(|_| anyhow!("{place}: is not UTF-8 text; write it as CSV again"))?;
            let frames = exchange::read_csv(&text).map_err(|e| anyhow!("{place}: {e}"))?;
            Trajectory::new(frames).map_err(|e| anyhow!("{place}: {e}"))
        }
        _ => bail!("{place}: is named like no motion; name a .npy or .csv file of 25 channels"),
    }
}

/// Reads a motion file of a soloist, or as `.npy` of a group, `[N, T, 25]`; its values are not looked at.
fn read_group(path: &Path) -> anyhow::Result<Array3<f32>> {
    let is_npy = path.extension().is_some_and(|e| e.eq_ignore_ascii_case("npy"));
    if !is_npy {
        return Ok(read_motion(path)?.into_array().insert_axis(ndarray::Axis(0)));
    }
    let dancers = read_dancers(&path.display().to_string(), &bytes_of(path)?);
    Ok(dancers.map_err(|failure| anyhow!(failure.message))?.to_array())
}

/// Reads a whole file that may be one.
fn bytes_of(path: &Path) -> anyhow::Result<Vec<u8>> {
    let place = path.display();
    let unreadable = |e: std::io::Error| {
        anyhow!("{place}: cannot be opened ({e}); check that it is still there")
    };
    ensure!(!path.is_dir(), "{place}: is a folder; name a file in it");
    let n_bytes = std::fs::metadata(path).map_err(unreadable)?.len();
    ensure!(
        n_bytes <= npy::MAX_ARRAY_BYTES,
        "{place}: has {n_bytes} bytes, more than the {} that are read; split it",
        npy::MAX_ARRAY_BYTES
    );
    std::fs::read(path).map_err(unreadable)
}

/// Reads the motions of a phrase that a run generated, with what the table says of each.
fn of_run(
    store: &Location,
    run: &str,
    (phrase, known): (&str, Option<&PhraseRow>),
    wanted: &[usize],
    room: MotionCapacity,
) -> anyhow::Result<Vec<DisplayedMotion>> {
    let (mut runs, mut phrases) = (BTreeSet::new(), BTreeSet::new());
    let table = Snapshot::take(store, GenerationRow::schema())?;
    let rows: Vec<GenerationRow> = table.rows_where(|row: &GenerationRow| {
        let is_of_run = row.run == run;
        let (names, name) =
            if is_of_run { (&mut phrases, &row.phrase_id) } else { (&mut runs, &row.run) };
        if !names.contains(name) {
            names.insert(name.clone());
        }
        is_of_run && row.phrase_id == phrase
    })?;
    if rows.is_empty() && !phrases.is_empty() {
        let nearest = nearest(phrase, phrases);
        bail!(
            "store {store}: run \"{run}\" has no motion for phrase \"{phrase}\"; nearest: {nearest}"
        );
    }
    if rows.is_empty() && !runs.is_empty() {
        bail!(
            "store {store} has no generated motion of run \"{run}\"; nearest: {}",
            nearest(run, runs)
        );
    }
    if rows.is_empty() {
        bail!(
            "store {store} has no generated motion; run motiongen generate --store {store} first"
        );
    }

    let present = known.map(|row| row.content_hash.as_str());
    ensure!(
        outdated_generations(&StoreSnapshot::take(store)?, &rows, |_| present)?.is_empty(),
        "store {store}: the motion of run \"{run}\" for phrase \"{phrase}\" was made for files that were replaced \
         since; run motiongen extract and generate again"
    );

    // By number: how many candidates there were, and the one that was kept.
    let mut samples: BTreeMap<usize, (usize, Option<GenerationRow>)> = BTreeMap::new();
    for row in rows {
        let Ok(sample) = usize::try_from(row.sample) else { continue };
        let (n_candidates, kept) = samples.entry(sample).or_default();
        *n_candidates += 1;
        if row.selected {
            *kept = Some(row);
        }
    }
    let place = format!("store {store}: run \"{run}\"");
    let numbers: BTreeSet<usize> = match (wanted, room) {
        ([], MotionCapacity::One) => samples.keys().copied().take(1).collect(),
        ([], MotionCapacity::Many) => samples.keys().copied().collect(),
        _ => wanted.iter().copied().collect(),
    };
    check_room(numbers.len(), "--sample", room)?;
    let mut shown = Vec::new();
    for number in numbers {
        let Some((n_candidates, Some(row))) = samples.get(&number) else {
            let known: Vec<String> = samples.keys().map(usize::to_string).collect();
            bail!(
                "{place} has no sample {number} of phrase \"{phrase}\"; ask for one of its own: {}",
                known.join(", ")
            );
        };
        let frames = generated_group(store, run, phrase, number)?;
        let facts = facts_of_generation(row, *n_candidates);
        shown.extend(of_dancers(&format!("sample {number}"), &frames, &facts, room)?);
    }
    Ok(shown)
}

/// Returns the dancers of a motion, `[N, T, 25]`, one beside the other; in a plot, which has room for one, the first.
fn of_dancers(
    name: &str,
    frames: &Array3<f32>,
    facts: &[(String, String)],
    room: MotionCapacity,
) -> anyhow::Result<Vec<DisplayedMotion>> {
    let n_dancers = frames.len_of(ndarray::Axis(0));
    let n_shown = match room {
        MotionCapacity::One => n_dancers.min(1),
        MotionCapacity::Many => n_dancers,
    };
    let shown = frames.outer_iter().take(n_shown).enumerate().map(|(dancer, frames)| {
        let motion = Trajectory::new(frames.to_owned())?;
        let (mut name, mut facts) = (name.to_owned(), facts.to_vec());
        if n_dancers > 1 {
            name = format!("{name}, dancer {dancer}");
            facts.push(("dancer".to_owned(), format!("{dancer}, of {n_dancers}")));
        }
        Ok(DisplayedMotion { name, motion, facts })
    });
    shown.collect()
}

/// Reads the frames of all dancers of a generated motion, `[N, T, 25]`: the one place that knows how `generated` names
/// them.
///
/// # Errors
/// [`StoreError`], or one sentence where the table has no such motion.
pub fn generated_group(
    store: &Location,
    run: &str,
    phrase: &str,
    sample: usize,
) -> anyhow::Result<Array3<f32>> {
    let name = generation_id(run, phrase, sample);
    let mut found = None;
    let table = Snapshot::take(store, tables::generated())?;
    table.visit_groups(&BTreeSet::from([name.clone()]), |_, frames| {
        found = Some(frames);
        Ok::<(), StoreError>(())
    })?;
    found.ok_or_else(|| {
        anyhow!(
            "store {store} has no frames of {name}, though it lists the motion; run motiongen \
             generate again with --force"
        )
    })
}

/// Returns why a phrase has no motion in the store, and the way out.
fn missing(
    store: &Location,
    phrase: &str,
    rows: &ItemTables,
    is_known: bool,
) -> anyhow::Result<anyhow::Error> {
    let failures: Vec<FailureRow> = rows.rows()?;
    if let Some(failure) = failures.into_iter().find(|failure| failure.stage == Ingest::NAME) {
        return Ok(anyhow!(
            "store {store} has no motion of phrase \"{phrase}\", since {} failed on it: {}",
            failure.stage,
            failure.message
        ));
    }
    if is_known {
        return Ok(anyhow!(
            "store {store}: phrase \"{phrase}\" has no motion of its own; name the run that generated \
             motion for it with --run"
        ));
    }
    let phrases: Vec<PhraseRow> = Snapshot::take(store, PhraseRow::schema())?.rows()?;
    if phrases.is_empty() {
        return Ok(anyhow!(
            "store {store} has no phrases; run motiongen ingest --source … --store {store} first"
        ));
    }
    let nearest = nearest(phrase, phrases.into_iter().map(|row| row.phrase_id));
    Ok(anyhow!("store {store} has no phrase \"{phrase}\"; nearest: {nearest}"))
}

fn facts_of_phrase(row: &PhraseRow) -> Vec<(String, String)> {
    let mut facts = vec![("split", row.split.clone())];
    facts.extend(row.motion_format.clone().map(|format| ("format", format)));
    facts.extend(row.tempo_bpm.map(|bpm| ("tempo", format!("{bpm:.1} bpm"))));
    facts.push(("source", row.source.clone()));
    named(facts)
}

/// Returns what is told of a generated motion, which was the best of `n_candidates`.
pub fn facts_of_generation(row: &GenerationRow, n_candidates: usize) -> Vec<(String, String)> {
    let mut facts = vec![
        ("model", row.model.clone()),
        ("run", row.run.clone()),
        ("engine", row.engine.clone()),
        ("sampler", format!("{}, {} steps", row.sampler, row.n_steps)),
        ("guidance", row.guidance.to_string()),
        // The table keeps the bits of a number without sign.
        ("seed", (row.seed as u64).to_string()),
    ];
    if n_candidates > 1 {
        facts.push(("candidates", n_candidates.to_string()));
    }
    facts.extend(row.score.map(|score| ("score", format!("{score:.3}"))));
    facts.push(("checks", format!("{} of {} passed", row.checks_passed, row.n_checks)));
    facts.extend(row.locking.map(|r2| ("bar locking R²", format!("{r2:.3}"))));
    facts.extend(row.control_error_mm.map(|mm| ("control", format!("within {mm:.1} mm"))));
    facts.extend(row.control_error_deg.map(|deg| ("control", format!("within {deg:.1}°"))));
    facts.push(("real-time factor", format!("{:.2}", row.real_time_factor)));
    named(facts)
}

fn named(facts: Vec<(&str, String)>) -> Vec<(String, String)> {
    facts.into_iter().map(|(name, value)| (name.to_owned(), value)).collect()
}
