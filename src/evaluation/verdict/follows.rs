//! Does it follow its music?

use super::{
    Evidence, GroupEvidence, Outcome, Rule, Test, differences_by_song, estimate, find, real,
    rounded,
};
use crate::evaluation::interval::{Estimate, holm, paired_difference};
use crate::evaluation::metrics::Number;

/// Tests are won below this probability, adjusted for their number.
const ALPHA: f64 = 0.05;
/// Locked amplitude over that of real motion.
const AMPLITUDE: [f64; 2] = [0.5, 2.0];
/// Least R² of the dancer of a group who keeps the bar worst, over that of real groups.
const LEAST_DANCER_RATIO: f64 = 0.5;

/// The coefficient on the known coupling against chance, wrong tempi, other music, shifted bars and the untrained
/// network; and its size. Of groups also whether each dancer keeps the bar.
pub(super) fn tests(evidence: &Evidence) -> Vec<Test> {
    let Evidence { own, truth, .. } = evidence;
    let coupling = own.iter().find(|number| number.metric == "coupling");
    let mut tests = vec![chance(own), wrong_tempi(own)];
    tests.push(paired("other_music", "with the music of other songs", coupling, evidence.shuffled));
    tests.push(paired("shifted_bars", "with bars shifted by beats", coupling, evidence.shifted));
    if evidence.has_network {
        tests.push(paired("untrained", "of the untrained network", coupling, evidence.untrained));
    }
    adjust(&mut tests);
    tests.push(Test::of_value(
        "amplitude",
        "amplitude locked to the bar over that of real motion",
        coupling.map_or_else(Estimate::default, |number| {
            estimate(own, "coupling_ratio", &number.variant)
        }),
        "",
        Rule::Within(AMPLITUDE[0], AMPLITUDE[1]),
        coupling.map_or_else(
            || "no real motion whose coupling to the bar is known".to_owned(),
            |number| real(truth, "coupling", &number.variant),
        ),
    ));
    tests.extend(evidence.group.as_ref().map(every_dancer));
    tests
}

/// A test of whether the dancer who keeps the bar worst of a window's keeps it as in real groups.
fn every_dancer(group: &GroupEvidence) -> Test {
    let (metric, variant) = ("group_locking", "least_dancer");
    let held_out = estimate(group.truth, metric, variant).value;
    let value = match held_out {
        Some(_) => estimate(group.own, metric, variant),
        None => Estimate::default(),
    };
    Test::of_value(
        "every_dancer",
        "R² with the bar, above chance, of the dancer of each window who keeps it worst",
        value,
        "",
        Rule::AtLeast(LEAST_DANCER_RATIO * held_out.unwrap_or(0.0).max(0.0)),
        real(group.truth, metric, variant),
    )
}

/// A test of a probability that the bar has nothing to do with it.
fn chance(own: &[Number]) -> Test {
    let p = estimate(own, "locking_p", "per_song");
    let protocol = find(own, "locking_p", "per_song").map(|number| number.protocol.clone());
    let test = Test::of_value(
        "chance",
        "probability of as strong a coupling if the motion had nothing to do with where the bar begins",
        p,
        "",
        Rule::Below(ALPHA),
        protocol.unwrap_or_else(|| "no music with beats".to_owned()),
    );
    Test { p: p.value, ..test }
}

fn wrong_tempi(own: &[Number]) -> Test {
    let share = estimate(own, "locking_wrong_share", "per_song");
    let wrong = estimate(own, "locking_wrong_r2", "per_song").value;
    let r2 = estimate(own, "locking_r2", "per_song").value;
    let against = match (r2, wrong) {
        (Some(r2), Some(wrong)) => {
            format!("R² {}, at wrong tempi {}", rounded(r2), rounded(wrong))
        }
        _ => "no music with beats".to_owned(),
    };
    let test = Test::of_value(
        "wrong_tempi",
        "share of wrong tempi that do as well",
        share,
        "",
        Rule::Below(ALPHA),
        against,
    );
    Test { p: share.value, ..test }
}

/// A test of whether the coefficient is higher than that of a control, song by song.
fn paired(name: &'static str, what: &str, own: Option<&Number>, control: &[Number]) -> Test {
    let other = own.and_then(|own| find(control, own.metric, &own.variant));
    let differences = differences_by_song(own, other);
    let found = paired_difference(&differences);
    let against = match other.and_then(|other| other.estimate.value) {
        Some(x) => format!("{} {what}, {} songs", rounded(x), differences.len()),
        None => format!("nothing was measured {what}"),
    };
    let test = Test::of_value(
        name,
        format!("coefficient less that {what}"),
        found.estimate,
        "",
        Rule::Above(0.0),
        against,
    );
    // One song, or songs that are all alike, have no spread to be held against.
    let outcome = match (test.outcome, found.p_greater) {
        (Outcome::Won, None) => Outcome::Open,
        (outcome, _) => outcome,
    };
    Test { outcome, p: found.p_greater, ..test }
}

/// Adjusts the probabilities of the tests that have one, and lets the adjusted ones decide.
fn adjust(tests: &mut [Test]) {
    let places: Vec<usize> = (0..tests.len()).filter(|&i| tests[i].p.is_some()).collect();
    let p: Vec<f64> = places.iter().filter_map(|&i| tests[i].p).collect();
    for (i, adjusted) in places.into_iter().zip(holm(&p)) {
        let test = &mut tests[i];
        test.p_holm = Some(adjusted);
        if test.outcome == Outcome::Won && adjusted >= ALPHA {
            test.outcome = Outcome::Lost;
        }
    }
}
