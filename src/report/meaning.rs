//! What the metrics mean: the one place that knows.

/// Which way a number is better.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Better {
    Higher,
    Lower,
    /// Best as near as can be to what real motion has.
    AsReal,
}

/// Headings of the report, in order.
pub const SECTIONS: [&str; 6] = [
    "Does it follow the music?",
    "Is it like real motion?",
    "Is it varied?",
    "Is it sound?",
    "Does it do what was asked?",
    "Other numbers",
];

/// What a metric means.
#[derive(Clone, Copy, Debug)]
pub struct Meaning {
    pub metric: &'static str,
    /// Place of its heading in [`SECTIONS`].
    pub section: usize,
    pub better: Better,
    pub text: &'static str,
}

const fn of(metric: &'static str, section: usize, better: Better, text: &'static str) -> Meaning {
    Meaning { metric, section, better, text }
}

use Better::{AsReal, Higher, Lower};

/// Every metric, in the order in which they are shown.
const MEANINGS: [Meaning; 29] = [
    of(
        "locking_r2",
        0,
        Higher,
        "Share of the vertical velocity that repeats with the bar, 0 to 1.",
    ),
    of(
        "locking_wrong_r2",
        0,
        AsReal,
        "The same at tempi that the music does not have: what chance gives.",
    ),
    of(
        "locking_effect",
        0,
        Higher,
        "How far the share is above that, in standard deviations over wrong tempi.",
    ),
    of("locking_p", 0, Lower, "How often a wrong tempo does as well; below 0.01 is no chance."),
    of(
        "beat_alignment",
        0,
        AsReal,
        "Beat score of the field, 0 to 1; says nothing without what chance gives.",
    ),
    of("beat_alignment_chance", 0, AsReal, "The same score of the motion shifted in time."),
    of(
        "beat_alignment_lift",
        0,
        Higher,
        "How much of what chance leaves open is reached; 0 is chance.",
    ),
    of("beat_alignment_z", 0, Higher, "Score above chance in standard deviations over shifts."),
    of(
        "phase_error",
        0,
        Lower,
        "Distance of the motion's bar phase from the music's; 1/4 is chance.",
    ),
    of("phase_coherence", 0, Higher, "1 where both phases run at one tempo."),
    of("rayleigh", 0, Higher, "1 where the slowest moments keep one place between the beats."),
    of("fid_k", 1, Lower, "Fréchet distance of speeds and accelerations from the ground truth's."),
    of(
        "fid_g",
        1,
        Lower,
        "Fréchet distance of sixteen geometric features from the ground truth's.",
    ),
    of(
        "channel_distance",
        1,
        Lower,
        "Wasserstein distance of a channel's values, in deviations of the ground truth.",
    ),
    of("mean_speed", 1, AsReal, "Mean speed of the body."),
    of(
        "log_dimensionless_jerk",
        1,
        AsReal,
        "Smoothness, whatever the size and speed; higher is smoother.",
    ),
    of("jerk_mean", 1, AsReal, "Mean rate of change of acceleration."),
    of("jerk_p95", 1, AsReal, "95th percentile of the same."),
    of("diversity", 2, AsReal, "Mean distance of the features of two motions."),
    of("mean_distance", 2, AsReal, "Mean distance of all pairs of features (Dist)."),
    of("multimodality", 2, AsReal, "Mean distance of two motions for the same music."),
    of("pass_rate", 3, Higher, "Share of motions that pass every check of a set."),
    of("velocity_error", 3, Lower, "How far velocity is from the change of position."),
    of("acceleration_error", 3, Lower, "How far acceleration is from the change of velocity."),
    of("turn_error", 3, Lower, "How far angular velocity is from the change of orientation."),
    of("norm_error", 3, Lower, "How far quaternions are from length 1."),
    of("share_over_limits", 3, Lower, "Share of frames beyond the limits of their channels."),
    of("control_position", 4, Lower, "Distance from constraints on the position."),
    of("control_orientation", 4, Lower, "Angle from constraints on the orientation."),
];

/// Returns what a metric means; of an unknown one, nothing but its name.
pub fn meaning_of(metric: &str) -> Meaning {
    let known = MEANINGS.iter().find(|meaning| meaning.metric == metric).copied();
    known.unwrap_or(of("", SECTIONS.len() - 1, AsReal, ""))
}

/// Returns the place of a metric among all.
pub fn order_of(metric: &str) -> usize {
    MEANINGS.iter().position(|meaning| meaning.metric == metric).unwrap_or(MEANINGS.len())
}

/// Returns whether the report can say what a metric means.
pub fn knows(metric: &str) -> bool {
    order_of(metric) < MEANINGS.len()
}

/// Returns whether a variant repeats a published formula that has a defect.
pub fn is_compat(variant: &str) -> bool {
    variant.ends_with("_compat")
}
