//! Subjects and splits: their order, their words and what they are.

/// The subject that a report is about.
pub(super) const OWN: &str = "generated";
pub(super) const HELD_OUT_TRUTH: &str = "held_out_truth";
pub(super) const TRAINING_TRUTH: &str = "training_truth";
/// What tables of release 0.1 have in the place of the training truth.
const GROUND_TRUTH: &str = "ground_truth";

/// Real motion, the nearest to a perfect answer first.
pub(super) const TRUTHS: [&str; 3] = [HELD_OUT_TRUTH, TRAINING_TRUTH, GROUND_TRUTH];

pub(super) const ALL: &str = "all";
pub(super) const HELD_OUT: &str = "held_out";

/// Subjects in the order in which they are shown, with what they are.
#[rustfmt::skip]
pub(super) const SUBJECTS: [(&str, &str); 15] = [
    (OWN, "the motions of this run"),
    ("shuffled", "the same motions with the music of other songs: what following its own music must beat"),
    ("shifted", "the same motions with the bars of their own music shifted by a beat: what knowing where the \
                 bar begins must beat"),
    ("untrained", "the run’s own network with its first weights: what sampler and post-processing give \
                   before anything is learned"),
    ("no_music", "the trained network without its music: what it does whatever is played"),
    ("shuffled_plan", "the plans of the trained model with their tokens in an order of chance: what is owed to which \
                       tokens there are, not to where they stand"),
    ("reconstructed", "real motion that was written as tokens and made again"),
    ("draft", "the same without the diffusion decoder: what it adds is the difference"),
    ("retrieval", "the library’s phrase with the nearest music"),
    ("mean_motion", "the mean of the training motion, standing still: the best constant"),
    ("independent", "soloists who were sampled one by one, in the places of the dancers of a group: what belonging \
                     together must beat"),
    ("copied", "one dancer of each group in the places of all: what dancers with ways of their own must beat"),
    (HELD_OUT_TRUTH, "real motion of songs that nothing was learned from: how good a number can be"),
    (TRAINING_TRUTH, "real motion that the reference statistics come from"),
    (GROUND_TRUTH, "all real motion, as evaluations of release 0.1 have it"),
];

/// Splits in the order in which they are shown: a name, its music in a few words, and in a sentence.
const SPLITS: [(&str, &str, &str); 5] = [
    (ALL, "all music", "all songs of the run"),
    (HELD_OUT, "held-out music", "songs that nothing was learned from"),
    ("validation", "validation music", "songs that its checkpoints were chosen on"),
    ("trained_on", "music trained on", "songs that it was trained on"),
    ("unknown", "unknown music", "nobody knows whether these songs were learned from"),
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
    TRUTHS.contains(&subject)
}

/// Returns a name as words.
pub(super) fn words(name: &str) -> String {
    name.replace('_', " ")
}

/// Returns the place of a split among the known ones, and behind them for others.
pub(super) fn split_order(split: &str) -> usize {
    SPLITS.iter().position(|(name, ..)| *name == split).unwrap_or(SPLITS.len())
}

/// Returns a few words for the music of a split.
pub(super) fn music(split: &str) -> String {
    SPLITS.get(split_order(split)).map_or_else(|| words(split), |(_, music, _)| (*music).to_owned())
}

/// Returns which songs a split has, or what is not known of them.
pub(super) fn songs(split: &str) -> String {
    SPLITS.get(split_order(split)).map_or_else(|| words(split), |(.., songs)| (*songs).to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_become_words() {
        assert_eq!([words("held_out_truth"), words("")], ["held out truth", ""]);
        let splits = ["all", "held_out", "validation", "trained_on", "unknown", "night_music"];
        assert_eq!(
            splits.map(music),
            [
                "all music",
                "held-out music",
                "validation music",
                "music trained on",
                "unknown music",
                "night music"
            ]
        );
        assert_eq!(
            splits.map(songs),
            [
                "all songs of the run",
                "songs that nothing was learned from",
                "songs that its checkpoints were chosen on",
                "songs that it was trained on",
                "nobody knows whether these songs were learned from",
                "night music"
            ]
        );
        assert_eq!(splits.map(split_order), [0, 1, 2, 3, 4, 5]);
    }

    #[test]
    fn every_subject_has_a_place_and_a_meaning() {
        let names = ["generated", "shifted", "training_truth", "ground_truth", "other"];
        assert_eq!(names.map(order), [0, 2, 13, 14, 15]);
        assert_eq!(names.map(is_truth), [false, false, true, true, false]);
        assert_eq!(meaning("no_music"), {
            "the trained network without its music: what it does whatever is played"
        });
        assert_eq!(meaning("other"), "");
        assert!(SUBJECTS.iter().all(|(_, meaning)| !meaning.is_empty() && !meaning.contains("  ")));
    }
}
