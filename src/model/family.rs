//! The families of models.

use serde::{Deserialize, Serialize};

/// What kind of networks a model has, which decides how it is trained, sampled and written down.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Family {
    /// A UNet that denoises the motion of one dancer, and a decoder.
    #[default]
    Unet,
    /// A transformer that denoises the motion of several dancers, and a score of how well they fit together.
    Group,
    /// A tokenizer: motion of one dancer becomes tokens, and a diffusion makes motion of them.
    Tokens,
}

impl Family {
    /// Returns the name that flags, cards and messages use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Unet => "unet",
            Self::Group => "group",
            Self::Tokens => "tokens",
        }
    }

    /// Returns whether it is the family of release 0.1, whose cards name none.
    pub fn is_unet(&self) -> bool {
        *self == Self::Unet
    }
}
