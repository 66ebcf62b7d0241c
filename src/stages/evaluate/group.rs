//! Runs of groups: how dancers move together, keep apart and follow the music, beside real groups and made-up ones.

mod made_up;

use std::collections::{BTreeMap, BTreeSet};
use std::time::Instant;

use anyhow::bail;
use ndarray::{Array2, Array3, ArrayView3, Axis, concatenate, s};

use super::Evaluate;
use super::metrics_summary::MetricsSummary;
use super::motions::PhraseIndex;
use super::params::Params;
use super::rows::{EvaluationRows, RunIdentity};
use super::splits::{MusicSplit, splits_of};
use crate::evaluation::frechet::{Gaussian, frechet_distance};
use crate::evaluation::group::realism::kinetic_features;
use crate::evaluation::group::{GroupMeasures, dancers, measure};
use crate::evaluation::interval::{Estimate, clustered_mean_estimate};
use crate::evaluation::score::locking_above_chance;
use crate::motion::group::RADIUS_M;
use crate::motion::{Channel, bar_phase};
use crate::stages::{Progress, Stage as _, Summary, lease};
use crate::store::tables::{self, GenerationRow, MetricRow, PhraseRow};
use crate::store::{self, Location, Row as _, StoreError, StoreSnapshot, TimestampUs, digest};
use crate::units::{FPS, frames_to_s};
use made_up::{copied, independent};

/// Raised when this evaluation writes something else for the same motions.
const OUTPUT_VERSION: u32 = 1;
/// Frames of a window, unless real groups have fewer: 8 s, the least span of one kind of unison.
const WINDOW_FRAMES: usize = 240;
/// Most real groups that are looked at.
const MAX_REAL: usize = 400;

/// What motions are held against, and they themselves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum GroupSubject {
    Generated,
    /// Every dancer is one of another group, in the place of the one who was there.
    Independent,
    /// One dancer of the group, copied to the places of all.
    Copied,
    HeldOutTruth,
    TrainingTruth,
}

impl GroupSubject {
    fn name(self) -> &'static str {
        match self {
            Self::Generated => "generated",
            Self::Independent => "independent",
            Self::Copied => "copied",
            Self::HeldOutTruth => "held_out_truth",
            Self::TrainingTruth => "training_truth",
        }
    }
}

/// A number of every window: its name, its unit, and where it is.
type Measure = (&'static str, &'static str, fn(&GroupMeasures) -> Option<f64>);

/// The numbers of windows of groups.
const MEASURES: [Measure; 10] = [
    ("unison_index", "", |m| m.unison),
    ("gmc_correlation", "", |m| m.gmc_correlation),
    ("gmc_published", "", |m| m.gmc_published),
    ("tif", "", |m| m.tif),
    ("tif_published", "", |m| m.touching_pairs_per_frame),
    ("least_separation", "m", |m| m.least_separation_m),
    ("formation_coverage", "m²", |m| m.coverage_m2),
    ("formation_spread", "m", |m| m.spread_m),
    ("dancer_diversity", "", |m| m.dancer_diversity),
    ("dancer_velocity_difference", "m/s", |m| m.dancer_velocity_difference_m_s),
];

/// Windows of one subject.
#[derive(Default)]
struct Windows {
    measures: Vec<GroupMeasures>,
    /// R² of each dancer's vertical velocity with the bar, above chance; and with the bars of another song.
    locking: Vec<Option<f64>>,
    other_locking: Vec<Option<f64>>,
    /// Kinetic features of groups, \[chunks, 12\].
    features: Vec<Array2<f64>>,
    songs: Vec<usize>,
}

/// The music of a window.
#[derive(Clone)]
struct WindowMusic {
    song: usize,
    bar_frames: f64,
    phase: Vec<f64>,
}

impl Windows {
    /// Measures a window of a group, and holds it against its own bars and those of another song.
    fn add(&mut self, group: ArrayView3<f32>, music: &WindowMusic, other: Option<&WindowMusic>) {
        self.measures.push(measure(group, music.bar_frames, RADIUS_M));
        if let Some(poses) = dancers(group) {
            self.features.push(kinetic_features(&poses));
        }
        let mean_locking = |music: &WindowMusic| {
            let locking = group.outer_iter().map(|dancer| {
                let vertical = dancer.column(Channel::Velocity.range().start + 1);
                let vertical: Vec<f64> = vertical.iter().map(|&v| f64::from(v)).collect();
                let n = vertical.len().min(music.phase.len());
                locking_above_chance(&vertical[..n], &music.phase[..n])
            });
            let locking: Vec<f64> = locking.collect();
            (!locking.is_empty()).then(|| locking.iter().sum::<f64>() / locking.len() as f64)
        };
        self.locking.push(mean_locking(music));
        self.other_locking.push(other.and_then(mean_locking));
        self.songs.push(music.song);
    }

    /// Returns a clustered mean over windows that have a number.
    fn mean(&self, values: Vec<Option<f64>>) -> Estimate {
        let known: Vec<(f64, usize)> = values
            .into_iter()
            .zip(&self.songs)
            .filter_map(|(value, &song)| Some((value.filter(|x| x.is_finite())?, song)))
            .collect();
        let (values, songs): (Vec<f64>, Vec<usize>) = known.into_iter().unzip();
        clustered_mean_estimate(&values, &songs)
    }

    fn gaussian(&self) -> Option<Gaussian> {
        let views: Vec<_> = self.features.iter().map(|features| features.view()).collect();
        let all = concatenate(Axis(0), &views).ok()?;
        Gaussian::fit(all.view())
    }
}

/// A generated group and what is known of it.
struct GeneratedGroup {
    split: &'static str,
    music: WindowMusic,
    frames: Array3<f32>,
}

/// Real groups with their music.
type RealGroups = BTreeMap<GroupSubject, Vec<(WindowMusic, Array3<f32>)>>;

/// Returns whether all motions of a run are of groups.
///
/// # Errors
/// [`StoreError`].
pub fn is_of_groups(store: &Location, run: &str) -> Result<bool, StoreError> {
    let snapshot = StoreSnapshot::take(store)?;
    let table = snapshot.table(GenerationRow::schema())?;
    let (mut n_groups, mut n_soloists) = (0_usize, 0_usize);
    table.rows_where(|row: &GenerationRow| {
        if row.run == run {
            match row.count_dancers() {
                1 => n_soloists += 1,
                _ => n_groups += 1,
            }
        }
        false
    })?;
    Ok(n_groups > 0 && n_soloists == 0)
}

/// The motions of a run of groups, and what they are held against.
pub struct GroupEvaluand {
    snapshot: StoreSnapshot,
    generations: Vec<GenerationRow>,
    phrases: PhraseIndex,
    splits: Vec<MusicSplit>,
    notes: Vec<String>,
    real_rows: Vec<PhraseRow>,
    /// Digest of the motions, of the splits that they are in, and of real groups.
    pub input_hash: String,
}

impl GroupEvaluand {
    /// Reads what is known of the motions of a run, without their frames.
    ///
    /// # Errors
    /// When the store cannot be read.
    pub fn read(snapshot: StoreSnapshot, run: &str) -> anyhow::Result<Self> {
        let mut generations: Vec<GenerationRow> = snapshot
            .table(GenerationRow::schema())?
            .rows_where(|row: &GenerationRow| row.run == run && row.selected)?;
        generations.sort_by(|a, b| a.generation.cmp(&b.generation));
        let ids = generations.iter().map(|row| row.phrase_id.as_str());
        let phrases = PhraseIndex::read(&snapshot, ids)?;
        let (splits, notes) = splits_of(snapshot.store(), &phrases, &generations)?;
        let lines: Vec<String> = generations
            .iter()
            .zip(&splits)
            .map(|(row, split)| {
                format!("{} {} {} {}", row.generation, row.weights, row.time.0, split.name())
            })
            .collect();
        let real_rows = real_groups(&snapshot)?;
        let data = digest(
            real_rows
                .iter()
                .map(|row| format!("{} {}\n", row.phrase_id, row.content_hash))
                .collect::<String>()
                .as_bytes(),
        );
        let input_hash = digest(format!("{data}\n{}", lines.join("\n")).as_bytes());
        Ok(Self { snapshot, generations, phrases, splits, notes, real_rows, input_hash })
    }
}

/// Runs the stage on a run of groups.
///
/// # Errors
/// What the store says, and a run without motion.
pub fn run(
    params: &Params,
    store: &Location,
    run: &str,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let started = Instant::now();
    let GroupEvaluand { snapshot, generations, phrases, splits, notes, real_rows, input_hash } =
        GroupEvaluand::read(StoreSnapshot::take(store)?, run)?;
    for note in &notes {
        progress.note(note);
    }
    let params_hash = digest(format!("groups {OUTPUT_VERSION}").as_bytes());
    let identity = RunIdentity {
        store,
        run,
        params_hash: &params_hash,
        whole_hash: &params_hash,
        input_hash: &input_hash,
    };
    let is_up_to_date = !params.force && identity.is_up_to_date(Evaluate::NAME)?;
    let n_frames: i64 = generations.iter().map(|row| row.n_frames).sum();
    let length_s = n_frames as f64 / FPS;
    let mut summary = MetricsSummary {
        store: store.to_string(),
        run: run.to_owned(),
        items: "groups",
        n_motions: generations.len(),
        length_s,
        is_up_to_date,
        dry_run: params.dry_run,
        metrics: Vec::new(),
        shown: &[],
        took_s: 0.0,
    };
    if params.dry_run {
        return Ok(Box::new(summary));
    }
    if is_up_to_date {
        summary.metrics = EvaluationRows::read(store, run, false)?.metrics;
        summary.took_s = started.elapsed().as_secs_f64();
        return Ok(Box::new(summary));
    }
    let (name, what) = (format!("{}/{run}", Evaluate::NAME), format!("evaluation of {run}"));
    let (lease, _) = lease::take(store, &name, &what, &|text| progress.note(text))?;
    store.sweep();
    let real = real_windows(&snapshot, &phrases, &real_rows)?;
    let window = real
        .values()
        .flatten()
        .map(|(_, frames)| frames.dim().1)
        .min()
        .unwrap_or(WINDOW_FRAMES)
        .min(WINDOW_FRAMES);
    let split_names: BTreeMap<&str, &'static str> = generations
        .iter()
        .map(|row| row.generation.as_str())
        .zip(splits.iter().map(|split| split.name()))
        .collect();
    let generated = generated_groups(&snapshot, &phrases, &generations, &split_names)?;
    let model = generations.first().map(|row| row.model.clone()).unwrap_or_default();
    progress.start("evaluate", "groups", generated.len() as u64);
    let found = measured(&generated, &real, window, progress);
    progress.finish();
    let mut rows = EvaluationRows {
        metrics: metric_rows(run, &model, window, &found),
        ..EvaluationRows::default()
    };
    rows.metrics.sort_by_cached_key(|row| {
        [&row.metric, &row.variant, &row.split, &row.subject].map(String::clone)
    });
    lease.check()?;
    identity.commit_numbers(&rows)?;
    store::checkpoint(store, &[Evaluate::NAME]);
    summary.metrics = rows.metrics;
    summary.took_s = started.elapsed().as_secs_f64();
    Ok(Box::new(summary))
}

/// Returns the phrases of real groups, at most [`MAX_REAL`] of each split, in order of the digests of their names.
fn real_groups(snapshot: &StoreSnapshot) -> Result<Vec<PhraseRow>, StoreError> {
    let mut rows: Vec<PhraseRow> = snapshot
        .table(PhraseRow::schema())?
        .rows_where(|row: &PhraseRow| row.count_dancers() > 1)?;
    rows.sort_by_cached_key(|row| digest(row.phrase_id.as_bytes()));
    let mut n_of_split: BTreeMap<String, usize> = BTreeMap::new();
    rows.retain(|row| {
        let n = n_of_split.entry(row.split.clone()).or_default();
        *n += 1;
        *n <= MAX_REAL
    });
    rows.sort_by(|a, b| a.phrase_id.cmp(&b.phrase_id));
    Ok(rows)
}

/// Reads real groups with their music, by subject.
fn real_windows(
    snapshot: &StoreSnapshot,
    phrases: &PhraseIndex,
    rows: &[PhraseRow],
) -> anyhow::Result<RealGroups> {
    let wanted: BTreeSet<String> = rows.iter().map(|row| row.phrase_id.clone()).collect();
    let mut found = RealGroups::new();
    snapshot.table(tables::motion())?.visit_groups(&wanted, |id, frames| {
        let subject = match phrases.row(id).map(|row| row.split.as_str()) {
            Some("train") => GroupSubject::TrainingTruth,
            _ => GroupSubject::HeldOutTruth,
        };
        // The bars of real motion are those of its own phase.
        let phase: Vec<f64> = frames
            .slice(s![0, .., Channel::Phase.range().start])
            .iter()
            .map(|&x| f64::from(x))
            .collect();
        if let Some(bar_frames) = bar_frames(phrases, id) {
            let music = WindowMusic { song: phrases.song(id), bar_frames, phase };
            found.entry(subject).or_default().push((music, frames));
        }
        Ok::<_, StoreError>(())
    })?;
    Ok(found)
}

/// Returns the length of a bar of a phrase's music; none where its tempo is not known.
fn bar_frames(phrases: &PhraseIndex, phrase_id: &str) -> Option<f64> {
    if let Some(beats) = phrases.beats(phrase_id) {
        return Some(FPS * 60.0 / beats.tempo_bpm() * f64::from(beats.beats_per_bar()));
    }
    let row = phrases.row(phrase_id)?;
    Some(FPS * 60.0 / row.tempo_bpm? * f64::from(row.beats_per_bar?))
}

fn generated_groups(
    snapshot: &StoreSnapshot,
    phrases: &PhraseIndex,
    generations: &[GenerationRow],
    splits: &BTreeMap<&str, &'static str>,
) -> anyhow::Result<Vec<GeneratedGroup>> {
    let names: BTreeSet<String> = generations.iter().map(|row| row.generation.clone()).collect();
    let phrase_of: BTreeMap<&str, &str> =
        generations.iter().map(|row| (row.generation.as_str(), row.phrase_id.as_str())).collect();
    let mut found = Vec::new();
    snapshot.table(tables::generated())?.visit_groups(&names, |name, frames| {
        let (Some(&id), Some(&split)) = (phrase_of.get(name), splits.get(name)) else {
            return Ok(());
        };
        if let Some(bar_frames) = bar_frames(phrases, id)
            && let Some(beats) = phrases.beats(id)
        {
            let times_s: Vec<f64> = (0..frames.dim().1).map(frames_to_s).collect();
            let phase = bar_phase(&times_s, &beats);
            let music = WindowMusic { song: phrases.song(id), bar_frames, phase };
            found.push(GeneratedGroup { split, music, frames });
        }
        Ok::<_, StoreError>(())
    })?;
    if found.is_empty() {
        bail!(
            "store {}: no group of the run has music whose beats are known; run motiongen extract first",
            snapshot.store()
        );
    }
    Ok(found)
}

/// Windows by split and subject.
type SubjectWindows = BTreeMap<(&'static str, GroupSubject), Windows>;

/// Measures windows of generated groups, of groups made up from them, and of real groups.
fn measured(
    generated: &[GeneratedGroup],
    real: &RealGroups,
    window: usize,
    progress: &dyn Progress,
) -> SubjectWindows {
    let mut found = SubjectWindows::new();
    for (i, group) in generated.iter().enumerate() {
        let n_frames = group.frames.dim().1;
        let other = (1..generated.len())
            .map(|k| &generated[(i + k) % generated.len()])
            .find(|other| other.music.song != group.music.song);
        for first in (0..).step_by(window).take_while(|first| first + window <= n_frames) {
            let cut = |group: &GeneratedGroup| {
                let frames = group.frames.slice(s![.., first..first + window, ..]).to_owned();
                let phase = group.music.phase[first..first + window].to_vec();
                (frames, WindowMusic { phase, ..group.music.clone() })
            };
            let is_long = |group: &&GeneratedGroup| first + window <= group.frames.dim().1;
            let (frames, music) = cut(group);
            let other = other.filter(is_long).map(|other| cut(other).1);
            let other = other.as_ref();
            let mut add = |subject, frames: ArrayView3<f32>| {
                found.entry((group.split, subject)).or_default().add(frames, &music, other);
            };
            add(GroupSubject::Generated, frames.view());
            add(GroupSubject::Copied, copied(frames.view()).view());
            let others: Vec<Array3<f32>> = (0..generated.len())
                .map(|k| &generated[(i + k) % generated.len()])
                .filter(is_long)
                .take(frames.dim().0)
                .map(|group| cut(group).0)
                .collect();
            if others.len() == frames.dim().0 {
                add(GroupSubject::Independent, independent(frames.view(), &others).view());
            }
        }
        progress.advance(1);
    }
    for (subject, groups) in real {
        for (i, (music, frames)) in groups.iter().enumerate() {
            let other = (1..groups.len())
                .map(|k| &groups[(i + k) % groups.len()].0)
                .find(|other| other.song != music.song);
            for first in (0..).step_by(window).take_while(|first| first + window <= frames.dim().1)
            {
                let cut = |music: &WindowMusic| WindowMusic {
                    phase: music.phase.get(first..first + window).unwrap_or(&music.phase).to_vec(),
                    ..music.clone()
                };
                let group = frames.slice(s![.., first..first + window, ..]);
                let windows = found.entry(("all", *subject)).or_default();
                windows.add(group, &cut(music), other.map(cut).as_ref());
            }
        }
    }
    found
}

fn metric_rows(run: &str, model: &str, window: usize, found: &SubjectWindows) -> Vec<MetricRow> {
    let time = TimestampUs::now();
    let protocol =
        format!("windows of {window} frames, bodies of {RADIUS_M} m, intervals over songs");
    let truth = found.get(&("all", GroupSubject::TrainingTruth)).and_then(Windows::gaussian);
    let mut rows = Vec::new();
    for ((split, subject), windows) in found {
        let mut row = |metric: &str, variant: &str, unit: &str, estimate: Estimate| {
            rows.push(MetricRow {
                run: run.to_owned(),
                model: model.to_owned(),
                subject: subject.name().to_owned(),
                split: (*split).to_owned(),
                metric: metric.to_owned(),
                variant: variant.to_owned(),
                unit: unit.to_owned(),
                value: estimate.value,
                ci_low: estimate.ci_low,
                ci_high: estimate.ci_high,
                n: estimate.n as i64,
                protocol: protocol.clone(),
                time,
            });
        };
        for (metric, unit, of) in MEASURES {
            row(metric, "", unit, windows.mean(windows.measures.iter().map(of).collect()));
        }
        row("group_locking", "", "", windows.mean(windows.locking.clone()));
        row("group_locking", "other_song", "", windows.mean(windows.other_locking.clone()));
        let least = windows.measures.iter().filter_map(|m| m.least_separation_m);
        let least = least.reduce(f64::min);
        row("least_separation", "least", "m", Estimate::plain(least, windows.measures.len()));
        let gmr = truth.as_ref().zip(windows.gaussian()).and_then(|(a, b)| frechet_distance(a, &b));
        let n = windows.features.iter().map(Array2::nrows).sum();
        row("gmr", "", "", Estimate::plain(gmr, n));
    }
    rows
}
