//! `plot`: pictures of what files and tables hold.

mod excerpt;
mod features;
mod motion;
pub(super) mod nearest;
mod output;
mod tokens;
mod training;

use super::{Contract, Progress, Stage, Summary};

/// The stage.
pub struct Plot;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    #[command(subcommand)]
    pub kind: PlotKind,
}

/// The kinds of plot.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum PlotKind {
    /// draw the audio features of a file or a phrase over time
    Features(features::Params),
    /// draw the losses of a training run over its steps
    Training(training::Params),
    /// draw a motion: its channels over time, its path
    Motion(motion::Params),
    /// draw how often each code of a tokenizer is used
    Tokens(tokens::Params),
}

impl Stage for Plot {
    const NAME: &'static str = "plot";
    const ABOUT: &'static str = "draw features, training, motion and tokens as PNG or SVG";
    const CONTRACT: Contract = Contract {
        reads: "an audio file, or features, extractions and beats; training_log; motion or generated, or a motion file; tokens and tokenizations",
        writes: "an image file",
    };
    type Params = Params;

    fn run(params: Params, _progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        match params.kind {
            PlotKind::Features(params) => features::run(&params),
            PlotKind::Training(params) => training::run(&params),
            PlotKind::Motion(params) => motion::run(&params),
            PlotKind::Tokens(params) => tokens::run(&params),
        }
    }
}
