//! How numbers are written: three significant figures, and ASCII alone, so that they can be copied.

/// The text in place of a number that is missing.
pub(super) const MISSING: &str = "–";

/// Exponents of ten of the numbers that are written out.
const PLAIN_EXPONENTS: std::ops::Range<i32> = -3..6;
/// Figures after the first.
const MORE_FIGURES: i32 = 2;
/// Shares are written with a figure less than this share would lose.
const NEARLY_ALL_PERCENT: f64 = 99.95;
const NEARLY_NONE_PERCENT: f64 = 0.05;

/// Writes a number with three significant figures, or all those of its whole part; very small and very
/// large ones as powers of ten.
pub(super) fn number(x: f64) -> String {
    match decimals(x) {
        Some(n) => fixed(x, n),
        None if x == 0.0 => "0".to_owned(),
        None => power(x),
    }
}

/// Writes a number like [`number`] without idle zeros, as it stands in a sentence.
pub(super) fn short(x: f64) -> String {
    let text = number(x);
    if text.contains('.') && !text.contains('e') { trimmed(&text).to_owned() } else { text }
}

/// Writes a number that may be missing, or not finite.
pub(super) fn value(x: Option<f64>) -> String {
    x.filter(|x| x.is_finite()).map_or_else(|| MISSING.to_owned(), number)
}

/// Writes a difference, with its sign.
pub(super) fn difference(x: f64) -> String {
    if x > 0.0 { format!("+{}", number(x)) } else { number(x) }
}

/// Writes an interval, `[0.10, 0.15]`, with the figures that tell its half width.
pub(super) fn interval(low: f64, high: f64) -> String {
    let most = decimals(low.abs().max(high.abs()));
    // Half of the half width, so that 0.02 and 0.19 are told to a hundredth, and 0.21 to a tenth.
    let scale = (high - low) / 4.0;
    let end = |x: f64| match most {
        Some(most) if scale > 0.0 && x != 0.0 => {
            let needed = (-scale.log10().floor()).clamp(0.0, (most + 1) as f64) as usize;
            let text = fixed(x, needed);
            if is_zero(&text) { number(x) } else { text }
        }
        _ => number(x),
    };
    format!("[{}, {}]", end(low), end(high))
}

/// Writes a share of one in percent; only all is 100 % and only none is 0 %.
pub(super) fn percent(share: f64) -> String {
    let percent = 100.0 * share;
    if percent > NEARLY_ALL_PERCENT && percent < 100.0 {
        return "> 99.9 %".to_owned();
    }
    if percent > 0.0 && percent < NEARLY_NONE_PERCENT {
        return "< 0.1 %".to_owned();
    }
    let text = fixed(percent, 1);
    format!("{} %", trimmed(&text))
}

/// Returns the decimals with which a number has three significant figures; none where it is written as a
/// power of ten, is zero or not finite.
fn decimals(x: f64) -> Option<usize> {
    // Rounded first: 0.9996 is 1.00.
    let text = format!("{x:.2e}");
    let exponent: i32 = text.split_once('e')?.1.parse().ok()?;
    let is_plain = x != 0.0 && PLAIN_EXPONENTS.contains(&exponent);
    is_plain.then(|| usize::try_from(MORE_FIGURES - exponent).unwrap_or(0))
}

fn power(x: f64) -> String {
    let text = format!("{x:.2e}");
    match text.split_once('e') {
        Some((figures, exponent)) => format!("{}e{exponent}", trimmed(figures)),
        None => text,
    }
}

fn fixed(x: f64, decimals: usize) -> String {
    let text = format!("{x:.decimals$}");
    match text.strip_prefix('-') {
        // A zero from below is a zero.
        Some(digits) if is_zero(digits) => digits.to_owned(),
        _ => text,
    }
}

fn is_zero(text: &str) -> bool {
    text.chars().all(|c| matches!(c, '0' | '.' | '-'))
}

fn trimmed(text: &str) -> &str {
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.') } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_have_three_significant_figures() {
        let cases = [
            (0.0, "0"),
            (-0.0, "0"),
            (1.0, "1.00"),
            (0.1234, "0.123"),
            (0.9996, "1.00"),
            (-3.456, "-3.46"),
            (12.34, "12.3"),
            (99.97, "100"),
            (1234.5, "1234"),
            (50_000.0, "50000"),
            (999_999.9, "1e6"),
            (1_234_567.0, "1.23e6"),
            (0.001_234, "0.00123"),
            (0.000_31, "3.1e-4"),
            (3.14159e-5, "3.14e-5"),
            (-2e-9, "-2e-9"),
            (f64::NAN, "NaN"),
            (f64::INFINITY, "inf"),
            (f64::NEG_INFINITY, "-inf"),
        ];
        for (x, wanted) in cases {
            assert_eq!(number(x), wanted);
        }
    }

    #[test]
    fn sentences_have_no_idle_zeros() {
        let cases = [(0.005, "0.005"), (1.0, "1"), (100.0, "100"), (0.1, "0.1"), (2e-7, "2e-7")];
        for (x, wanted) in cases {
            assert_eq!(short(x), wanted);
        }
    }

    #[test]
    fn what_is_missing_is_a_dash() {
        let values = [None, Some(f64::NAN), Some(f64::INFINITY), Some(0.5)].map(value);
        assert_eq!(values, ["–", "–", "–", "0.500"]);
    }

    #[test]
    fn differences_have_a_sign() {
        assert_eq!([0.25, -0.25, 0.0].map(difference), ["+0.250", "-0.250", "0"]);
    }

    #[test]
    fn intervals_tell_their_width() {
        let cases = [
            (0.1, 0.15, "[0.10, 0.15]"),
            (0.118, 0.129, "[0.118, 0.129]"),
            (0.12281, 0.12323, "[0.1228, 0.1232]"),
            (118.2, 121.9, "[118.2, 121.9]"),
            (112.0, 131.0, "[112, 131]"),
            (-0.02, 0.3, "[-0.02, 0.30]"),
            (0.002, 0.9, "[0.00200, 0.9]"),
            (0.0, 0.031, "[0, 0.031]"),
            (0.5, 0.5, "[0.500, 0.500]"),
            (1e-5, 3e-5, "[1e-5, 3e-5]"),
            (2e6, 3e6, "[2e6, 3e6]"),
            (0.0, 0.0, "[0, 0]"),
        ];
        for (low, high, wanted) in cases {
            assert_eq!(interval(low, high), wanted);
        }
    }

    #[test]
    fn only_all_is_a_hundred_percent() {
        let cases = [
            (1.0, "100 %"),
            (0.9999, "> 99.9 %"),
            (0.983, "98.3 %"),
            (0.5, "50 %"),
            (0.0001, "< 0.1 %"),
            (0.0, "0 %"),
        ];
        for (share, wanted) in cases {
            assert_eq!(percent(share), wanted);
        }
    }
}
