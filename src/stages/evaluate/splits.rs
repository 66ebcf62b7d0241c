//! Of which music numbers are: whether the model learned from it.

pub use crate::generation::MusicSplit;

/// Everything that was generated.
pub const ALL: &str = "all";

/// Every split, in the order in which they are measured.
pub const SPLITS: [MusicSplit; 4] =
    [MusicSplit::HeldOut, MusicSplit::Validation, MusicSplit::TrainedOn, MusicSplit::Unknown];

/// Returns the most telling of the given splits: held out, else unknown, else validation, else trained on.
pub fn telling(splits: impl IntoIterator<Item = MusicSplit>) -> Option<MusicSplit> {
    splits.into_iter().min_by_key(|split| match split {
        MusicSplit::HeldOut => 0,
        MusicSplit::Unknown => 1,
        MusicSplit::Validation => 2,
        MusicSplit::TrainedOn => 3,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn validation_never_counts_as_held_out() {
        use MusicSplit::{HeldOut, TrainedOn, Unknown, Validation};
        assert_eq!(telling([TrainedOn, Validation, HeldOut]), Some(HeldOut));
        assert_eq!(telling([TrainedOn, Validation, Unknown]), Some(Unknown));
        assert_eq!(telling([TrainedOn, Validation]), Some(Validation));
        assert_eq!(telling([]), None);
    }
}
