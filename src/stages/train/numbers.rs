//! The ranges of numbers that flags take.

use anyhow::ensure;

/// Refuses a number outside \[0, 1).
pub fn check_share(flag: &str, x: f64) -> anyhow::Result<()> {
    ensure!((0.0..1.0).contains(&x), "{flag} {x} is no share; give a number from 0 to below 1");
    Ok(())
}

/// Refuses a weight below 0.
pub fn check_weight(flag: &str, x: f64) -> anyhow::Result<()> {
    ensure!(x.is_finite() && x >= 0.0, "{flag} {x} is no weight; give 0 or more");
    Ok(())
}

/// Refuses what is not above 0.
pub fn check_positive(flag: &str, x: f64) -> anyhow::Result<()> {
    ensure!(x > 0.0 && x.is_finite(), "{flag} {x} is not above 0; give a positive number");
    Ok(())
}
