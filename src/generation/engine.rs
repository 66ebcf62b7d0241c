//! The interface between samplers and a model, the same for every engine that runs it.

use ndarray::{Array3, ArrayView2, ArrayView3};

use crate::diffusion::DiffusionError;
use crate::model::GraphError;
use crate::onnx::OnnxError;

/// The inputs of a prediction.
#[derive(Clone, Copy, Debug)]
pub struct EngineInputs<'a> {
    /// Noisy motion, normalised, \[batch, frames, 25\].
    pub x: ArrayView3<'a, f32>,
    /// Step of each sample, \[batch\].
    pub t: &'a [usize],
    /// Features as the table has them, then the clock of a network that hears it, \[batch, frames,
    /// condition_dim\].
    pub audio: ArrayView3<'a, f32>,
    /// Whether each sample goes without music, \[batch\]; empty where all have music.
    pub drop_audio: &'a [bool],
    /// Normalised style, \[batch, 8\], for a network that takes one.
    pub style: Option<ArrayView2<'a, f32>>,
}

/// Why a model gave no answer.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum EngineError {
    #[error(transparent)]
    Graph(#[from] GraphError),
    #[error(transparent)]
    Onnx(#[from] OnnxError),
    #[error(transparent)]
    Diffusion(#[from] DiffusionError),
    #[error("{what} is {found:?}, {expected:?} is needed")]
    Shape { what: &'static str, found: Vec<usize>, expected: Vec<usize> },
    #[error("the tokenizer drafts no motion; it was trained by release 0.2 or with --no-draft")]
    NoDraft,
}

/// Runs the two networks of a model.
///
/// Calls may come from several threads; up to [`Engine::n_workers`] of them run at once.
pub trait Engine: Sync {
    /// Returns the name that flags and tables use.
    fn name(&self) -> &'static str;

    /// Returns how many calls run at once.
    fn n_workers(&self) -> usize;

    /// Predicts, in normalised units. → \[batch, frames, 25\]
    ///
    /// # Errors
    /// Shapes that do not fit, or errors of the runtime.
    fn predict(&self, inputs: &EngineInputs) -> Result<Array3<f32>, EngineError>;

    /// Decodes latents to motion, \[batch, frames, 25\] → \[batch, frames, 25\] in metres, seconds, radians.
    ///
    /// # Errors
    /// Shapes that do not fit, or errors of the runtime.
    fn decode(&self, latent: ArrayView3<f32>) -> Result<Array3<f32>, EngineError>;
}

impl EngineInputs<'_> {
    /// Refuses inputs whose sizes do not fit each other.
    pub(super) fn check(&self, n_features: usize) -> Result<(), EngineError> {
        let (batch, frames, _) = self.x.dim();
        let expect = |what, found: &[usize], expected: &[usize]| {
            if found == expected {
                return Ok(());
            }
            let (found, expected) = (found.to_vec(), expected.to_vec());
            Err(EngineError::Shape { what, found, expected })
        };
        expect("the shape of the condition", self.audio.shape(), &[batch, frames, n_features])?;
        expect("the number of steps", &[self.t.len()], &[batch])?;
        if !self.drop_audio.is_empty() {
            expect("the number of samples without music", &[self.drop_audio.len()], &[batch])?;
        }
        Ok(())
    }
}
