//! The networks of motion by tokens, which the interpreter that trains them runs, or onnxruntime.

use ndarray::{Array3, ArrayView2, ArrayView3};

use crate::generation::engine::EngineError;
use crate::motion::style::STYLE_DIM;

/// Runs the networks of a tokenizer; calls may come from several threads.
pub trait TokenizerNetworks: Sync {
    /// Returns the name that flags and tables use.
    fn name(&self) -> &'static str;

    /// Returns how many calls run at once.
    fn n_workers(&self) -> usize;

    /// Returns the tokens of windows, one window after the other.
    ///
    /// `motion`: normalised, \[n, T, 25\]
    ///
    /// # Errors
    /// Errors of the runtime.
    fn encode(&self, motion: ArrayView3<f32>) -> Result<Vec<u32>, EngineError>;

    /// Returns the signal of the tokens of n windows of so many frames, \[n, frames, d\].
    ///
    /// # Errors
    /// A token that the codebook does not have, and errors of the runtime.
    fn signal(&self, tokens: &[u32], windows: (usize, usize)) -> Result<Array3<f32>, EngineError>;

    /// Estimates clean motion of step t, normalised, \[n, T, 25\].
    ///
    /// # Errors
    /// Shapes that do not fit, and errors of the runtime.
    fn denoise(
        &self,
        x: ArrayView3<f32>,
        t: usize,
        signal: ArrayView3<f32>,
    ) -> Result<Array3<f32>, EngineError>;

    /// Returns the motion that the signal alone gives, normalised, \[n, T, 25\]; none where no draft can be had.
    ///
    /// # Errors
    /// Shapes that do not fit.
    fn draft(&self, _signal: ArrayView3<f32>) -> Result<Option<Array3<f32>>, EngineError> {
        Ok(None)
    }
}

/// The conditions of a window that is planned.
#[derive(Clone, Copy, Debug)]
pub struct PlanWindow<'a> {
    /// Features as the table has them, then the clock of a network that hears it, \[T, condition_dim\].
    pub condition: ArrayView2<'a, f32>,
    /// Normalised style, for a network that takes one.
    pub style: Option<[f32; STYLE_DIM]>,
    /// Constraints on its motion, for a network that takes them, \[T, 12\]; none where absent.
    pub constraints: Option<ArrayView2<'a, f32>>,
    /// The conditions that each answer goes without; one answer for each.
    pub withheld: &'a [WithheldConditions],
}

/// The conditions that an answer goes without, for guidance.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct WithheldConditions {
    pub music: bool,
    pub constraints: bool,
}

impl PlanWindow<'_> {
    /// Returns 1 for each answer of which `is_withheld` is true, else 0.
    pub(super) fn drops(&self, is_withheld: impl Fn(&WithheldConditions) -> bool) -> Vec<f32> {
        self.withheld.iter().map(|withheld| f32::from(u8::from(is_withheld(withheld)))).collect()
    }
}

/// Runs a planner; calls may come from several threads.
pub trait PlannerNetworks: Sync {
    /// Returns the name that flags and tables use.
    fn name(&self) -> &'static str;

    /// Begins a plan: the conditions of the window are computed once.
    ///
    /// # Errors
    /// Shapes that do not fit, and errors of the runtime.
    fn begin<'a>(&'a self, window: &PlanWindow) -> Result<Box<dyn WindowPlan + 'a>, EngineError>;
}

/// The plan of a window that has begun.
pub trait WindowPlan {
    /// Returns ln p of each token up to a constant, answer after answer.
    ///
    /// Of the masked kind those of every position, \[answers · N · K\]. Of the autoregressive kind those of the position
    /// behind the tokens, \[answers · K\]; from one call to the next tokens only come to those before.
    ///
    /// # Errors
    /// A token that does not exist, and errors of the runtime.
    fn logits(&mut self, tokens: &[u32]) -> Result<Vec<f32>, EngineError>;
}
