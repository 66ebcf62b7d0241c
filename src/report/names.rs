//! Subjects and splits: their order, their words and what they are.

/// The subject that a report is about.
pub(super) const OWN: &str = "generated";
/// The same motions with the music of other songs.
pub(super) const CONTROL: &str = "shuffled";
pub(super) const HELD_OUT_TRUTH: &str = "held_out_truth";
pub(super) const GROUND_TRUTH: &str = "ground_truth";

pub(super) const ALL: &str = "all";
pub(super) const HELD_OUT: &str = "held_out";

/// Subjects in the order in which they are shown, with what they are.
pub(super) const SUBJECTS: [(&str, &str); 6] = [
    (OWN, "what the model made"),
    (CONTROL, "the same motions with the music of other songs"),
    ("retrieval", "the library’s phrase with the nearest music"),
    ("mean_motion", "the best constant"),
    (HELD_OUT_TRUTH, "real motion to music that the model did not learn from"),
    (GROUND_TRUTH, "all real motion"),
];

/// Returns the place of a subject among the known ones, and behind them for others.
pub(super) fn order(subject: &str) -> usize {
    SUBJECTS.iter().position(|(name, _)| *name == subject).unwrap_or(SUBJECTS.len())
}

/// Returns what a subject is; nothing for one that is not known.
pub(super) fn meaning(subject: &str) -> &'static str {
    SUBJECTS.get(order(subject)).map_or("", |(_, meaning)| meaning)
}

/// Returns whether a subject is real motion.
pub(super) fn is_truth(subject: &str) -> bool {
    subject == HELD_OUT_TRUTH || subject == GROUND_TRUTH
}

/// Returns a name as words.
pub(super) fn words(name: &str) -> String {
    name.replace('_', " ")
}

/// Returns the words for the music of a split.
pub(super) fn music(split: &str) -> String {
    match split {
        ALL => "all music".to_owned(),
        HELD_OUT => "unseen music".to_owned(),
        other => words(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_words() {
        assert_eq!([words("held_out_truth"), words("")], ["held out truth", ""]);
        assert_eq!(["all", "held_out", "night_music"].map(music).join(", "), {
            "all music, unseen music, night music"
        });
        assert_eq!([meaning("mean_motion"), meaning("other")], ["the best constant", ""]);
        assert_eq!(["generated", "ground_truth", "other"].map(order), [0, 5, 6]);
    }
}
