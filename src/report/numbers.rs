//! Numbers as people read them.

use super::Metric;

/// Stands for a number that is not there.
pub const MISSING: &str = "–";

/// Returns a number with three digits that count; very small and very large ones with a power of ten.
pub fn number(x: f64) -> String {
    if !x.is_finite() {
        return MISSING.to_owned();
    }
    let size = x.abs();
    if size == 0.0 {
        return "0".to_owned();
    }
    if !(1e-3..1e6).contains(&size) {
        return format!("{x:.1e}");
    }
    let digits = (2 - size.log10().floor() as i32).clamp(0, 5) as usize;
    let text = format!("{x:.digits$}");
    if text.contains('.') {
        return text.trim_end_matches('0').trim_end_matches('.').to_owned();
    }
    text
}

/// Returns a value, or what stands for none.
pub fn value(x: Option<f64>) -> String {
    x.map_or_else(|| MISSING.to_owned(), number)
}

/// Returns a value with its interval: `0.123 [0.1, 0.15]`.
pub fn with_interval(metric: &Metric) -> String {
    let text = value(metric.value);
    match (metric.value, metric.ci_low, metric.ci_high) {
        (Some(_), Some(low), Some(high)) => {
            format!("{text} [{}, {}]", number(low), number(high))
        }
        _ => text,
    }
}

/// Returns the name of something in words.
pub fn words(name: &str) -> String {
    name.replace('_', " ")
}
