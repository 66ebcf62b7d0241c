//! Is it varied?

use super::{Evidence, Rule, Test, estimate, real};
use crate::evaluation::interval::Estimate;

/// Distance over that of real motion: less is alike, more is noise.
const RATIO: [f64; 2] = [0.5, 2.0];

/// Windows of different songs are as different as in real motion, anywhere and at the same place, which one motion
/// for all songs is not.
pub(super) fn tests(evidence: &Evidence) -> Vec<Test> {
    let Evidence { own, truth, .. } = evidence;
    let test = |name, what: &str, variant: &str| {
        // Real motion at one place of different songs is as different as anywhere.
        let (a, b) =
            (estimate(own, "song_distance", variant), estimate(truth, "song_distance", "anywhere"));
        let over = |x: Option<f64>| Some(x? / b.value.filter(|b| *b > 0.0)?);
        let ratio = Estimate {
            value: over(a.value),
            ci_low: over(a.ci_low),
            ci_high: over(a.ci_high),
            n: a.n,
        };
        Test::of_value(
            name,
            format!("{what} over that of real motion"),
            ratio,
            "",
            Rule::Within(RATIO[0], RATIO[1]),
            real(truth, "song_distance", "anywhere"),
        )
    };
    vec![
        test("songs", "distance of windows of different songs", "anywhere"),
        test(
            "one_for_all",
            "distance of windows of different songs at the same place",
            "same_place",
        ),
    ]
}
