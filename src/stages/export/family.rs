//! How a run of any family becomes a model: the course of the command, and what it asks of each family.

use super::checks::CheckResults;
use super::files::ExportedFiles;
use super::report::{ExportSummary, ExportedCard};
use super::{Export, MAX_TRAIN_PHRASES, Params, motion_range, named_styles, put_in_place};
use crate::generation::{LearnedFrom, SamplingDefaults};
use crate::model::Family;
use crate::motion::rates::MotionRange;
use crate::motion::style_name::NamedStyles;
use crate::onnx::Runtime;
use crate::stages::model_files::folder_of;
use crate::stages::train::session::{ProgressWatch, read_phrases};
use crate::stages::{Progress, Stage as _, Summary};
use crate::store::Location;
use crate::training::Dataset;

/// What `export` asks of what training left of a run of one family.
pub trait FamilyExport: Sized {
    type Card: ExportedCard + 'static;

    /// Decides which phrases are read.
    const FAMILY: Family;

    /// Reads the run.
    ///
    /// # Errors
    /// One sentence about what is missing or does not belong together.
    fn of_run(store: &Location, params: &Params) -> anyhow::Result<Self>;

    /// Returns what the weights learned from; none where it is not known.
    ///
    /// # Errors
    /// When the store cannot be read.
    fn learned_from(
        &self,
        store: &Location,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<LearnedFrom>>;

    /// Returns the size of the style that the network takes, 0 of one that takes none.
    fn style_dim(&self) -> usize {
        0
    }

    /// Measures how the model is best sampled; none without phrases to measure on.
    ///
    /// # Errors
    /// When frames cannot be read, or errors of the engines.
    fn sampling(
        &self,
        dataset: &Dataset,
        params: &Params,
        progress: &dyn Progress,
    ) -> anyhow::Result<Option<SamplingDefaults>>;

    /// Writes the networks and their card.
    ///
    /// # Errors
    /// A network that cannot be written, or one that breaks a rule of the format.
    fn files(
        &mut self,
        params: &Params,
        measured: CardMeasures,
    ) -> anyhow::Result<ExportedFiles<Self::Card>>;

    /// Holds the files against the interpreter that trained the networks.
    ///
    /// # Errors
    /// When onnxruntime refuses a file, or there is nothing to check with.
    fn checks(
        &self,
        files: &ExportedFiles<Self::Card>,
        dataset: &Dataset,
        params: &Params,
        on: (&Runtime, &dyn Progress),
    ) -> anyhow::Result<CheckResults>;
}

/// What a card says of the data and of sampling.
pub struct CardMeasures {
    pub learned_from: Option<LearnedFrom>,
    pub motion_range: Option<MotionRange>,
    pub styles: NamedStyles,
    pub sampling: Option<SamplingDefaults>,
}

/// Runs the stage.
///
/// # Errors
/// What the family and the store say, a model of the same name that may not be replaced, and a check that failed.
pub fn run<F: FamilyExport>(
    params: &Params,
    store: &Location,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let mut trained = F::of_run(store, params)?;
    let watch = ProgressWatch(progress);
    let phrases = read_phrases(
        store,
        Export::NAME,
        (&params.machine, F::FAMILY),
        Some(MAX_TRAIN_PHRASES),
        progress,
        &watch,
        params.dry_run,
    )?;
    let dataset = &phrases.dataset;
    let learned_from = trained.learned_from(store, params, progress)?;
    let sampling = trained.sampling(dataset, params, progress)?;
    let styles = named_styles(dataset, trained.style_dim())?;
    let motion_range = motion_range(dataset)?;
    let measured = CardMeasures { learned_from, motion_range, styles, sampling };
    let files = trained.files(params, measured)?;
    let place = store.url_of(&folder_of(&params.model));
    let mut summary = ExportSummary::new(files.card.clone(), place);
    if params.dry_run {
        summary.is_dry_run = true;
        return Ok(Box::new(summary));
    }
    let model = (&files.bytes[..], &files.card_text);
    let results = put_in_place(params, store, model, progress, |runtime| {
        trained.checks(&files, dataset, params, (runtime, progress))
    })?;
    match results {
        Some(results) => summary.checks = results.rows,
        None => summary.is_up_to_date = true,
    }
    Ok(Box::new(summary))
}
