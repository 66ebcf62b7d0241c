//! `plot training`: the losses of a run over its steps, stage by stage.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::str::FromStr;

use anyhow::{bail, ensure};

use crate::plot::{
    self, PanelCurves, PlotError, StageCurves, TrainingPanel, TrainingPlot, TrainingStage,
};
use crate::stages::{ClientParams, Summary};
use crate::store::tables::TrainingLogRow;
use crate::store::{Location, Row as _, Snapshot};
use crate::training::RowKind;

use super::nearest::nearest;
use super::output::{WIDTHS_PX, format_of, write_picture};

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// The run whose losses are drawn.
    #[arg(long, value_name = "NAME")]
    pub run: String,
    /// The picture, FILE.png or FILE.svg; written whole or not at all.
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// Stages to draw: the flag several times, or names with commas between them [default: all that
    /// the run has]
    #[arg(long = "stage", value_enum, value_name = "STAGE", value_delimiter = ',')]
    pub stages: Vec<TrainingStage>,
    #[arg(long = "panel", value_name = "PANEL", value_delimiter = ',', help = panel_help())]
    pub panels: Vec<PanelChoice>,
    /// Width in CSS pixels, 320 to 8192; a PNG has two pixels for each.
    #[arg(long, value_name = "PX", default_value_t = 1000,
          value_parser = clap::value_parser!(u32).range(WIDTHS_PX))]
    pub width: u32,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
}

/// A panel by its name, or every panel of a stage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PanelChoice {
    All,
    One(TrainingPanel),
}

const ALL: &str = "all";

fn panel_help() -> String {
    let usual = |stage: TrainingStage| names(stage.usual_panels().iter().map(|p| p.name()));
    format!(
        "Panels to draw: {ALL}, or names with commas between them, of {} [default: {}; of \
         finetune {}; of tokens {}]",
        TrainingPanel::known(),
        usual(TrainingStage::Diffusion),
        usual(TrainingStage::Finetune),
        usual(TrainingStage::Tokens)
    )
}

impl FromStr for PanelChoice {
    type Err = PlotError;

    fn from_str(name: &str) -> Result<Self, PlotError> {
        if name == ALL {
            return Ok(Self::All);
        }
        name.parse().map(Self::One).map_err(|_| PlotError::UnknownPanel {
            name: name.to_owned(),
            known: format!("{ALL}, {}", TrainingPanel::known()),
        })
    }
}

/// Draws the plot.
///
/// # Errors
/// When there is nothing to draw, or the picture cannot be written.
pub fn run(params: &Params) -> anyhow::Result<Box<dyn Summary>> {
    let format = format_of(&params.output)?;
    let store = Location::open(&params.store, &params.client.options())?;
    let rows = rows(&store, &params.run)?;
    let place = format!("store {store}: run \"{}\"", params.run);
    let stages = stages(&place, &rows, &params.stages)?;
    let stages: Vec<(TrainingStage, Vec<TrainingPanel>)> =
        stages.into_iter().map(|stage| (stage, panels(stage, &params.panels))).collect();
    check_panels(&place, &stages, &params.panels)?;
    let stages: Vec<StageCurves> = stages
        .into_iter()
        .filter(|(_, panels)| !panels.is_empty())
        .map(|(stage, panels)| curves(stage, &panels, &rows))
        .collect();

    let plot = TrainingPlot { title: &params.run, stages: &stages };
    let picture = plot::training(&plot, params.width, format)?;
    write_picture(account(&stages), &params.output, &picture, params.dry_run)
}

/// Reads what was logged of a run, in order of steps.
fn rows(store: &Location, run: &str) -> anyhow::Result<Vec<TrainingLogRow>> {
    let log = Snapshot::take(store, TrainingLogRow::schema())?;
    let mut runs = BTreeSet::new();
    let mut rows: Vec<TrainingLogRow> = log.rows_where(|row: &TrainingLogRow| {
        if !runs.contains(&row.run) {
            runs.insert(row.run.clone());
        }
        row.run == run
    })?;
    if runs.is_empty() {
        bail!(
            "store {store} has no log of a training; run motiongen train --store {store} --run \
             {run} first"
        );
    }
    ensure!(
        !rows.is_empty(),
        "store {store} has no run \"{run}\"; nearest: {}",
        nearest(run, runs)
    );
    rows.sort_by_key(|row| row.step);
    Ok(rows)
}

/// Returns the stages to draw: those that were asked for, or all that the run has.
fn stages(
    place: &str,
    rows: &[TrainingLogRow],
    wanted: &[TrainingStage],
) -> anyhow::Result<Vec<TrainingStage>> {
    let has = |stage: &TrainingStage| rows.iter().any(|row| row.stage == stage.name());
    let known: Vec<TrainingStage> = TrainingStage::ALL.into_iter().filter(has).collect();
    ensure!(
        !known.is_empty(),
        "{place} has no stage that can be drawn ({}); install a newer motiongen",
        names(TrainingStage::ALL.into_iter().map(TrainingStage::name))
    );
    if let Some(missing) = wanted.iter().find(|stage| !known.contains(stage)) {
        bail!(
            "{place} has no stage {}; ask for one of its own: {}",
            missing.name(),
            names(known.into_iter().map(TrainingStage::name))
        );
    }
    let mut stages = known;
    stages.retain(|stage| wanted.is_empty() || wanted.contains(stage));
    Ok(stages)
}

/// Returns the panels of a stage that are wanted, in the order of the stage's.
fn panels(stage: TrainingStage, wanted: &[PanelChoice]) -> Vec<TrainingPanel> {
    if wanted.is_empty() {
        return stage.usual_panels().to_vec();
    }
    let is_wanted = |panel: &TrainingPanel| {
        wanted.contains(&PanelChoice::All) || wanted.contains(&PanelChoice::One(*panel))
    };
    stage.panels().iter().copied().filter(is_wanted).collect()
}

/// Refuses panels that no stage has.
fn check_panels(
    place: &str,
    stages: &[(TrainingStage, Vec<TrainingPanel>)],
    wanted: &[PanelChoice],
) -> anyhow::Result<()> {
    for choice in wanted {
        let PanelChoice::One(panel) = choice else { continue };
        if stages.iter().any(|(_, panels)| panels.contains(panel)) {
            continue;
        }
        let known = TrainingPanel::ALL
            .into_iter()
            .filter(|panel| stages.iter().any(|(stage, _)| stage.panels().contains(panel)));
        bail!(
            "{place} has no panel {} in {}; ask for one of {}",
            panel.name(),
            names(stages.iter().map(|(stage, _)| stage.name())),
            names(known.map(TrainingPanel::name))
        );
    }
    Ok(())
}

fn names(names: impl Iterator<Item = &'static str>) -> String {
    names.collect::<Vec<_>>().join(", ")
}

/// Collects what was logged of a stage.
fn curves(stage: TrainingStage, panels: &[TrainingPanel], rows: &[TrainingLogRow]) -> StageCurves {
    let rows: Vec<&TrainingLogRow> = rows.iter().filter(|row| row.stage == stage.name()).collect();
    let rows_of_kind =
        |kind: RowKind| rows.iter().copied().filter(move |row| row.kind == kind.name());
    let best = rows_of_kind(RowKind::Validation)
        .filter_map(|row| Some((steps_done(row), row.loss.filter(|loss| loss.is_finite())?)))
        // Among equal losses the first, as training keeps it.
        .min_by(|a, b| a.1.total_cmp(&b.1));
    let panels = panels.iter().map(|&panel| {
        let value = |row: &TrainingLogRow| value(row, panel);
        PanelCurves {
            steps: points(rows_of_kind(RowKind::Step), value),
            decoder_steps: match panel {
                TrainingPanel::LearningRate => {
                    points(rows_of_kind(RowKind::Step), |row| row.lr_decoder)
                }
                _ => Vec::new(),
            },
            epochs: at_middles(points(rows_of_kind(RowKind::Epoch), value)),
            validation: points(rows_of_kind(RowKind::Validation), value),
            live_validation: match panel {
                TrainingPanel::Loss => {
                    points(rows_of_kind(RowKind::Validation), |row| row.loss_live)
                }
                _ => Vec::new(),
            },
            ..PanelCurves::new(panel)
        }
    });
    StageCurves {
        stage,
        n_steps: rows.iter().map(|row| steps_done(row)).max().unwrap_or(0),
        n_epochs: rows_of_kind(RowKind::Epoch)
            .map(|row| u64::try_from(row.epoch).unwrap_or(0))
            .max()
            .unwrap_or(0),
        elapsed_s: rows.iter().map(|row| row.elapsed_s).fold(0.0, f64::max),
        n_skipped: rows_of_kind(RowKind::Step).filter(|row| row.skipped).count() as u64,
        best,
        panels: panels.collect(),
    }
}

fn steps_done(row: &TrainingLogRow) -> u64 {
    u64::try_from(row.step).unwrap_or(0)
}

/// Returns the steps of which a value was logged, with the value.
fn points<'a>(
    rows: impl Iterator<Item = &'a TrainingLogRow>,
    value: impl Fn(&TrainingLogRow) -> Option<f64>,
) -> Vec<(u64, f64)> {
    // What is not finite in a step that was skipped for it is counted as that.
    let told = |row: &&TrainingLogRow, value: &f64| value.is_finite() || !row.skipped;
    rows.filter_map(|row| Some((steps_done(row), value(row).filter(|v| told(&row, v))?))).collect()
}

/// Moves each mean of an epoch from the last step of the epoch to the middle of it.
fn at_middles(mut means: Vec<(u64, f64)>) -> Vec<(u64, f64)> {
    let mut start = 0;
    for (step, _) in &mut means {
        let end = *step;
        *step = start + end.saturating_sub(start) / 2;
        start = end;
    }
    means
}

fn value(row: &TrainingLogRow, panel: TrainingPanel) -> Option<f64> {
    match panel {
        TrainingPanel::Loss => row.loss,
        TrainingPanel::Diffusion => row.diffusion,
        TrainingPanel::DecoderPosition => row.decoder_position,
        TrainingPanel::VelocityCoherence => row.velocity_coherence,
        TrainingPanel::AccelerationCoherence => row.acceleration_coherence,
        TrainingPanel::Jerk => row.jerk,
        TrainingPanel::DecoderQuaternion => row.decoder_quaternion,
        TrainingPanel::QuaternionDelta => row.quaternion_delta,
        TrainingPanel::PhaseMonotonic => row.phase_monotonic,
        TrainingPanel::PositionSmoothness => row.position_smoothness,
        TrainingPanel::Markers => row.markers,
        TrainingPanel::Contrast => row.contrast,
        TrainingPanel::Commitment => row.commitment,
        TrainingPanel::Perplexity => row.perplexity,
        TrainingPanel::GradientNorm => row.gradient_norm,
        TrainingPanel::LearningRate => row.learning_rate,
    }
}

/// Returns what was drawn: `2000 steps of diffusion, 1 of decoder`.
fn account(stages: &[StageCurves]) -> String {
    let counts = stages.iter().enumerate().map(|(i, curves)| {
        let unit = match (i, curves.n_steps) {
            (0, 1) => " step",
            (0, _) => " steps",
            _ => "",
        };
        format!("{}{unit} of {}", curves.n_steps, curves.stage.name())
    });
    counts.collect::<Vec<_>>().join(", ")
}
