//! What is read although it is not as the format has it.

use std::fmt;

/// Something unusual of a file that was read; what it does to the take, if anything.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum BvhNote {
    /// The text was UTF-16.
    Utf16,
    /// A label is written in an unusual way.
    Spelling { line: usize, found: String, usual: &'static str },
    /// Numbers have a comma for their decimal point.
    DecimalComma { line: usize },
    /// End sites have names of their own.
    NamedEndSites { line: usize, count: usize },
    /// Joints have no names.
    UnnamedJoints { line: usize, count: usize },
    /// One frame more or less than declared is there.
    FrameCount { line: usize, declared: usize, found: usize },
}

impl fmt::Display for BvhNote {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Utf16 => write!(f, "text is UTF-16"),
            Self::Spelling { line, found, usual } => {
                write!(f, "line {line} has {found}, usual is `{usual}`")
            }
            Self::DecimalComma { line } => {
                write!(f, "numbers have decimal commas, the first in line {line}")
            }
            Self::NamedEndSites { line, count } => {
                write!(f, "{count} end sites have names, the first in line {line}")
            }
            Self::UnnamedJoints { line, count } => {
                write!(f, "{count} joints have no names, the first in line {line}")
            }
            Self::FrameCount { line, declared, found } => {
                write!(
                    f,
                    "line {line} declares {declared} frames, all {found} that are there are read"
                )
            }
        }
    }
}
