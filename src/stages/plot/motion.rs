//! `plot motion`: the channels of a motion over time, and its path from above.

use std::path::PathBuf;

use anyhow::anyhow;
use ndarray::s;

use crate::motion::Trajectory;
use crate::plot::{self, MOTION_WIDTH_PX, MotionPanel, MotionPlot};
use crate::stages::motion_source::{MotionCapacity, MotionParams};
use crate::stages::{ClientParams, Summary};
use crate::training::TemporalConfig;
use crate::units::frames_to_s;

use super::excerpt::ExcerptParams;
use super::output::{WIDTHS_PX, format_of, write_picture};

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    #[command(flatten)]
    pub source: MotionParams,
    /// The picture, FILE.png or FILE.svg; written whole or not at all.
    #[arg(long, value_name = "FILE")]
    pub output: PathBuf,
    /// Panels to draw, from the left and the top: the flag several times, or names with commas between
    /// them, of position, velocity, quaternion, phase, quaternion_norm, jerk, acceleration,
    /// angular_velocity and path.
    #[arg(long = "panel", value_name = "PANEL", value_delimiter = ',',
          default_values = MotionPanel::USUAL.map(MotionPanel::name))]
    pub panels: Vec<MotionPanel>,
    #[command(flatten)]
    pub excerpt: ExcerptParams,
    /// Width in CSS pixels, 320 to 8192; a PNG has two pixels for each.
    #[arg(long, value_name = "PX", default_value_t = MOTION_WIDTH_PX,
          value_parser = clap::value_parser!(u32).range(WIDTHS_PX))]
    pub width: u32,
    #[command(flatten)]
    pub client: ClientParams,
    /// Say what would be done, and do nothing.
    #[arg(long)]
    pub dry_run: bool,
}

/// Draws the plot.
///
/// # Errors
/// When there is nothing to draw, or the picture cannot be written.
pub fn run(params: &Params) -> anyhow::Result<Box<dyn Summary>> {
    let output = &params.output;
    let format = format_of(output)?;
    params.excerpt.check()?;
    let subject = params.source.read(MotionCapacity::One, &params.client.options())?;
    let shown = subject.shown.first().ok_or_else(|| anyhow!("there is no motion to draw"))?;
    let frames = params.excerpt.frames(shown.motion.n_frames(), &subject.title)?;
    let motion = Trajectory::new(shown.motion.view().slice(s![frames.clone(), ..]).to_owned())?;
    let plotted = MotionPlot {
        title: &subject.title,
        motion: &motion,
        beat_times_s: &subject.beats_s,
        first_frame: frames.start,
        jerk_limit_m_s3: TemporalConfig::default().target_jerk,
    };
    let picture = plot::motion(&plotted, &params.panels, params.width, format)?;
    let unit = if frames.len() == 1 { "frame" } else { "frames" };
    let what = format!("{} {unit} ({:.2} s)", frames.len(), frames_to_s(frames.len()));
    write_picture(what, output, &picture, params.dry_run)
}
