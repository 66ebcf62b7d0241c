//! What the metrics mean, and under which heading they stand: the one place that knows.

use super::BetterDirection;
use BetterDirection::{Higher, Lower, Neither};
use Section::{Asked, Group, Music, Other, Real, Sound, Varied};

/// A question that numbers answer, and that of the verdicts which rest on them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Section {
    Music,
    Real,
    Varied,
    Sound,
    Group,
    Asked,
    Other,
}

impl Section {
    /// Every section, in the order in which they are shown.
    pub const ALL: [Self; 7] = [Music, Real, Varied, Sound, Group, Asked, Other];

    pub const fn heading(self) -> &'static str {
        match self {
            Music => "Does it follow its music?",
            Real => "Is it like real motion?",
            Varied => "Is it varied?",
            Sound => "Is it sound?",
            Group => "Do its dancers belong together?",
            Asked => "Does it do what was asked?",
            Other => "Other",
        }
    }

    /// Returns the name of the section in links.
    pub const fn id(self) -> &'static str {
        match self {
            Music => "music",
            Real => "real",
            Varied => "varied",
            Sound => "sound",
            Group => "together",
            Asked => "asked",
            Other => "other",
        }
    }
}

/// Verdicts that are asked of every run, in the order in which they are shown among equals.
pub(super) const VERDICTS: [(&str, Section); 4] =
    [("sound", Sound), ("like_real", Real), ("follows_music", Music), ("varied", Varied)];

/// The verdict that is asked of groups beside those.
pub(super) const OF_GROUPS: (&str, Section) = ("together", Group);

/// The meaning of a metric.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Meaning {
    pub metric: &'static str,
    pub section: Section,
    pub better: BetterDirection,
    /// The measured quantity.
    pub text: &'static str,
    /// The value by chance, or the perfect one.
    pub ideal: &'static str,
}

/// Every metric that is known, in the order in which they are shown.
#[rustfmt::skip]
const MEANINGS: [Meaning; 64] = [
    of("locking_r2", Music, Higher,
        "Share of the vertical velocity that repeats with the bar (R²).",
        "1 is perfect; chance is not 0 but locking_wrong_r2."),
    of("locking_wrong_r2", Music, Neither,
        "The same at tempi that the music does not have.",
        "What chance gives for locking_r2."),
    of("locking_effect", Music, Higher,
        "locking_r2 less its mean at wrong tempi, in standard deviations over these.",
        "0 by chance."),
    of("locking_wrong_share", Music, Lower,
        "Share of wrong tempi that do as well as the music’s own.",
        "About 0.5 by chance; no probability, since neighbouring tempi are alike."),
    of("locking_p", Music, Lower,
        "Probability of as strong a coupling to the bar if the motion had nothing to do with where the bar \
         begins (bars rotated, song by song).",
        "About 0.5 by chance; small alone is not enough, see what it is held against."),
    of("coupling", Music, Neither,
        "Coefficient, with its sign, of the vertical velocity on the coupling to the bar that is known.",
        "0 by chance, 1 is as real motion, below 0 is against it."),
    of("coupling_ratio", Music, Neither,
        "Amplitude that is locked to the bar over that of held-out real motion.",
        "1 is right; above is over-locking."),
    of("beat_alignment", Music, Neither,
        "How near beats of motion and of music are, from 0 to 1, for a width in seconds.",
        "Says little alone: chance is beat_alignment_chance."),
    of("beat_alignment_chance", Music, Neither,
        "The same score of the motion shifted in time.",
        "What chance gives for beat_alignment."),
    of("beat_alignment_lift", Music, Higher,
        "Share of what chance leaves open that is reached: (score − chance) / (1 − chance).",
        "0 by chance, 1 is perfect."),
    of("beat_alignment_z", Music, Higher,
        "Score above chance, in standard deviations over shifts.",
        "0 by chance."),
    of("phase_error", Music, Lower,
        "Distance of the bar phase that the motion says from the music’s, in bars.",
        "1/4 by chance, 0 is perfect; by construction where the phase was relocked."),
    of("phase_coherence", Music, Higher,
        "Whether both phases run at one tempo, whatever lies between them.",
        "Near 0 by chance, 1 is perfect; by construction where the phase was relocked."),
    of("rayleigh", Music, Higher,
        "Whether beats of motion keep one place between the beats of music, whichever.",
        "√(π / 4n) by chance with n beats, 1 is perfect."),
    of("fid_k", Real, Lower,
        "Fréchet distance of speeds and accelerations from real motion’s.",
        "As low as the held-out truth’s is perfect."),
    of("fid_g", Real, Lower,
        "Fréchet distance of sixteen geometric features from real motion’s.",
        "As low as the held-out truth’s is perfect."),
    of("mean_speed", Real, Neither, "Mean speed of the body.", "Best near the truth’s."),
    of("axis_speed", Real, Neither,
        "Root mean square of the velocity along an axis.", "Best near the truth’s."),
    of("speed_ratio", Real, Neither,
        "Speed along an axis over that of real motion.",
        "1 is right; below is stiller, above is faster."),
    of("position_jerk", Real, Neither,
        "Mean third derivative of positions.", "Best near the truth’s."),
    of("tilt", Real, Neither,
        "Mean angle between the body’s up axis and the vertical.", "Best near the truth’s."),
    of("turn_rate", Real, Neither,
        "Mean turn rate, as orientations say it.", "Best near the truth’s."),
    of("jerk_ratio", Real, Neither,
        "Jerk over that of real motion.",
        "1 is right; above is rougher."),
    of("jerk_mean", Real, Neither,
        "Mean rate of change of the acceleration.",
        "Best near the truth’s; lower is stiller, higher is rougher."),
    of("jerk_p95", Real, Neither, "95th percentile of the same.", "Best near the truth’s."),
    of("log_dimensionless_jerk", Real, Neither,
        "Smoothness, whatever size and speed; higher is smoother.",
        "Best near the truth’s."),
    of("feature_shift", Real, Lower,
        "Root mean square of the shifts of mean features from real motion’s, in its standard deviations.",
        "As low as the held-out truth’s is perfect."),
    of("channel_distance", Real, Lower,
        "Wasserstein distance of a channel’s values from real motion’s, in its standard deviations.",
        "As low as the held-out truth’s is perfect."),
    of("reconstruction_position", Real, Lower,
        "Distance of positions from those that a tokenizer makes of their tokens again.",
        "0 is perfect."),
    of("reconstruction_orientation", Real, Lower,
        "Angle of orientations to those that a tokenizer makes of their tokens again.",
        "0 is perfect."),
    of("tokens_per_frame", Real, Lower,
        "Tokens that stand for a frame.",
        "1/ρ by construction."),
    of("code_perplexity", Varied, Higher,
        "How many codes are in use, were all used alike: in codes, or as a share of the codebook.",
        "K, or 1, where all are used alike."),
    of("diversity", Varied, Neither,
        "Mean distance of the features of two motions.",
        "Best near the truth’s."),
    of("mean_distance", Varied, Neither,
        "Mean distance of the features of all pairs of motions (Dist).",
        "Best near the truth’s."),
    of("song_distance", Varied, Neither,
        "Mean distance of the features of windows of different songs, anywhere or at the same place.",
        "Best near the truth’s; 0 at the same place where all songs get one motion."),
    of("multimodality", Varied, Neither,
        "Mean distance of the features of two motions for the same music.",
        "0 where music decides all; best near the truth’s where it has several."),
    of("pass_rate", Sound, Higher,
        "Share of the motions that pass every check of a set.",
        "1 is perfect; real motion need not be."),
    of("share_upright", Sound, Higher,
        "Share of the windows whose uprightness is within the range of training motion.",
        "As high as the held-out truth’s is perfect."),
    of("share_height", Sound, Higher,
        "Share of the windows whose height is within the range of training motion.",
        "As high as the held-out truth’s is perfect."),
    of("share_turning", Sound, Higher,
        "Share of the windows whose turning is within the range of training motion.",
        "As high as the held-out truth’s is perfect."),
    of("share_jerk", Sound, Higher,
        "Share of the windows whose jerk is within the range of training motion.",
        "As high as the held-out truth’s is perfect."),
    of("velocity_error", Sound, Lower,
        "How far velocity is from the change of position.",
        "0 is perfect."),
    of("acceleration_error", Sound, Lower,
        "How far acceleration is from the change of velocity.",
        "0 is perfect."),
    of("turn_error", Sound, Lower,
        "How far angular velocity is from the change of orientation.",
        "0 is perfect."),
    of("norm_error", Sound, Lower, "How far quaternions are from length 1.", "0 is perfect."),
    of("share_over_limits", Sound, Lower,
        "Share of the frames with a channel beyond its limits.",
        "0 is perfect."),
    of("unison_index", Group, Neither,
        "Correlation of the dancers’ velocities, each in its own heading frame, at the lag of up to a bar that the other half \
         of the bars tells.",
        "1 for copies, about 0 for independent dancers; best near the truth’s."),
    of("gmc_correlation", Group, Neither,
        "Group motion correlation, as a correlation of the dancers’ energies.",
        "1 where all put in and spare their energy together; best near the truth’s."),
    of("gmc_published", Group, Neither,
        "Group motion correlation by the published formula, which has a unit.",
        "Grows with how much is moved; for comparison with published numbers."),
    of("tif", Group, Lower,
        "Share of frames and pairs of dancers whose bodies touch.",
        "0 is perfect."),
    of("tif_published", Group, Lower,
        "Trajectory intersection frequency: touching pairs per frame.",
        "0 is perfect."),
    of("least_separation", Group, Neither,
        "Least distance of two bodies’ centres in a window, mean over windows, or the least of all.",
        "Bodies touch below 0.7 m."),
    of("formation_coverage", Group, Neither,
        "Area of the hull of the group.", "Best near the truth’s."),
    of("formation_spread", Group, Neither,
        "Spread of the group about its middle.", "Best near the truth’s."),
    of("dancer_diversity", Group, Neither,
        "Distance of the dancers’ kinetic features: how much each moves, not when.",
        "0 for copies; best near the truth’s."),
    of("dancer_velocity_difference", Group, Neither,
        "Difference of two dancers’ velocities at the same moment.",
        "0 for copies; best near the truth’s."),
    of("group_locking", Group, Higher,
        "R² of the dancers’ vertical velocities with the bar, above that at wrong tempi: their mean, the least dancer’s, and \
         with the bars of another song.",
        "About 0 by chance; best near the truth’s."),
    of("gmr", Group, Lower,
        "Group motion realism: Fréchet distance of groups’ kinetic features from the training groups’.",
        "As low as the held-out truth’s is perfect."),
    of("control_position", Asked, Lower,
        "Distance from where the body was asked to be.",
        "0 is perfect."),
    of("control_orientation", Asked, Lower,
        "Angle from how the body was asked to be turned.",
        "0 is perfect."),
    of("control_trajectory_error", Asked, Lower,
        "Share of the motions with a keyframe that is off by more than a threshold (Traj. err.).",
        "0 is perfect."),
    of("control_location_error", Asked, Lower,
        "Share of the keyframes that are off by more than a threshold (Loc. err.).",
        "0 is perfect."),
    of("control_average_error", Asked, Lower,
        "Mean miss over keyframes (Avg. err.).",
        "0 is perfect."),
    of("control_timing_error", Asked, Lower,
        "How long before or after its time the body is nearest to the place of a keyframe.",
        "0 is perfect; at most half a second, beyond which nothing is looked for."),
];

const fn of(
    metric: &'static str,
    section: Section,
    better: BetterDirection,
    text: &'static str,
    ideal: &'static str,
) -> Meaning {
    Meaning { metric, section, better, text, ideal }
}

/// The metric of which there is a number for every channel.
pub(super) const CHANNELS: &str = "channel_distance";

/// Metrics about what was asked of a motion, which nothing else has, have names that begin so.
const ASKED: &str = "control_";

/// Returns what a metric means; of an unknown one, only its section.
pub(super) fn meaning_of(metric: &str) -> Meaning {
    let known = MEANINGS.iter().find(|meaning| meaning.metric == metric).copied();
    let section = if is_asked(metric) { Asked } else { Other };
    known.unwrap_or(of("", section, Neither, "", ""))
}

/// Returns the place of a metric among the known ones, and behind them for others.
pub(super) fn order(metric: &str) -> usize {
    MEANINGS.iter().position(|meaning| meaning.metric == metric).unwrap_or(MEANINGS.len())
}

/// Returns whether a metric is about what was asked, and so needs no baseline.
pub(super) fn is_asked(metric: &str) -> bool {
    metric.starts_with(ASKED)
}

/// Returns whether a variant reproduces a published formula that has a defect.
pub(super) fn is_compat(variant: &str) -> bool {
    variant.ends_with("_compat")
}

/// Returns which way a metric is better; neither for one that is not known.
pub fn better(metric: &str) -> BetterDirection {
    meaning_of(metric).better
}

/// Returns whether a report can say what a metric means.
pub fn knows(metric: &str) -> bool {
    order(metric) < MEANINGS.len()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_metric_stands_under_a_heading() {
        let cases = [
            ("locking_p", Music, Lower),
            ("rayleigh", Music, Higher),
            ("coupling", Music, Neither),
            ("coupling_ratio", Music, Neither),
            ("speed_ratio", Real, Neither),
            ("jerk_ratio", Real, Neither),
            ("feature_shift", Real, Lower),
            ("share_upright", Sound, Higher),
            ("share_height", Sound, Higher),
            ("share_turning", Sound, Higher),
            ("share_jerk", Sound, Higher),
            ("fid_k", Real, Lower),
            ("diversity", Varied, Neither),
            ("pass_rate", Sound, Higher),
            ("tif", Group, Lower),
            ("unison_index", Group, Neither),
            ("control_position", Asked, Lower),
            ("control_of_something_new", Asked, Neither),
            ("something_new", Other, Neither),
        ];
        for (metric, section, way) in cases {
            assert_eq!((meaning_of(metric).section, better(metric)), (section, way), "{metric}");
        }
        assert_eq!(["fid_g", "something_new"].map(knows), [true, false]);
        assert_eq!(["axes_compat", "axes"].map(is_compat), [true, false]);
    }

    #[test]
    fn metrics_of_a_section_stand_together_and_all_say_something() {
        let mut order: Vec<&str> = MEANINGS.iter().map(|m| m.section.id()).collect();
        order.dedup();
        assert_eq!(order, ["music", "real", "varied", "sound", "together", "asked"]);
        for meaning in MEANINGS {
            assert!(meaning.text.ends_with('.') && meaning.ideal.ends_with('.'), "{meaning:?}");
            assert_eq!(MEANINGS.iter().filter(|m| m.metric == meaning.metric).count(), 1);
        }
    }
}
