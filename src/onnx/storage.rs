//! How weights are kept in files.

/// How weights lie in the file; vectors are always f32.
#[derive(
    Clone,
    Copy,
    Debug,
    Default,
    PartialEq,
    Eq,
    clap::ValueEnum,
    serde::Serialize,
    serde::Deserialize,
)]
#[serde(rename_all = "snake_case")]
pub enum Storage {
    /// As they were trained.
    #[default]
    Fp32,
    /// Rounded to f16, and widened when the file is loaded: half the size.
    Fp16,
    /// Rounded to 8 bits with a scale for each output, and widened when loaded: a quarter of the size.
    Int8,
}

impl Storage {
    /// Returns the name that flags and tables use.
    pub fn name(self) -> &'static str {
        match self {
            Self::Fp32 => "fp32",
            Self::Fp16 => "fp16",
            Self::Int8 => "int8",
        }
    }
}
