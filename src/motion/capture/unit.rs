//! The unit of length of a take, guessed from how tall its body is.

use super::account::Unit;

/// Body heights that are a person's, m: from a small child's to over the tallest dancer's.
const PERSON_HEIGHT_M: std::ops::RangeInclusive<f64> = 0.9..=2.4;
/// Height along bones that most bodies are near, m.
const USUAL_HEIGHT_M: f64 = 1.65;
/// How much nearer, as a logarithm, a usual unit counts.
const USUAL_BONUS: f64 = 0.15;
/// Height given to a body that is no person's height in any unit, m.
pub const DEFAULT_HEIGHT_M: f64 = 1.7;

/// Centimetre and metre, which nearly all programs write.
const USUAL: [Unit; 2] =
    [Unit { name: "centimetres", size_m: 0.01 }, Unit { name: "metres", size_m: 1.0 }];
const OTHERS: [Unit; 4] = [
    Unit { name: "inches", size_m: 0.0254 },
    Unit { name: "millimetres", size_m: 0.001 },
    Unit { name: "feet", size_m: 0.3048 },
    // The CMU database: 0.45 of an inch.
    Unit { name: "units of 1/0.45 inch", size_m: 0.0254 / 0.45 },
];

/// Returns the unit in which a body of this height, in file units, is most likely a person's.
pub fn unit_of(height: f64) -> Option<Unit> {
    let distance =
        |unit: &Unit, bonus: f64| (height * unit.size_m / USUAL_HEIGHT_M).ln().abs() - bonus;
    USUAL
        .iter()
        .map(|unit| (unit, distance(unit, USUAL_BONUS)))
        .chain(OTHERS.iter().map(|unit| (unit, distance(unit, 0.0))))
        .filter(|(unit, _)| PERSON_HEIGHT_M.contains(&(height * unit.size_m)))
        .min_by(|(_, a), (_, b)| a.total_cmp(b))
        .map(|(unit, _)| *unit)
}

/// Whether a unit needs no word.
pub fn is_usual(unit: Unit) -> bool {
    USUAL.contains(&unit)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn people_of_any_size_are_known_in_every_unit() {
        for unit in USUAL.iter().chain(&OTHERS) {
            for height_m in [1.35, 1.5, 1.7, 1.9] {
                let found = unit_of(height_m / unit.size_m).expect("a person");
                assert_eq!(found.name, unit.name, "{height_m} m");
            }
        }
        // A child in the usual units.
        assert_eq!(unit_of(100.0).map(|unit| unit.name), Some("centimetres"));
        assert_eq!(unit_of(1.0).map(|unit| unit.name), Some("metres"));
        for nobody in [0.1, 12.0, 300.0, 1e6] {
            assert_eq!(unit_of(nobody), None, "{nobody}");
        }
    }
}
