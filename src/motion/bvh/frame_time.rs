//! The frame time as it was meant: `0.0333333` is 1/30 s.

/// Highest rate that a rounded frame time is taken for, Hz.
const MAX_RATE_HZ: u32 = 10_000;
/// Rates of cameras and capture systems are multiples of one of these, Hz.
const RATES_HZ: [u32; 2] = [5, 12];

/// Returns the sampling interval, s, that a decimal number stands for.
///
/// Where the interval of exactly one usual rate, rounded or cut to as many places, is what is written, that
/// interval; else the number as it is. `0.0333667` (29.97 Hz) and `0.01` stay what they are.
pub fn frame_time_of(written: &str, value_s: f64) -> f64 {
    let half_unit_s = half_of_last_place(written);
    if value_s <= half_unit_s || is_whole_rate(value_s) {
        return value_s;
    }
    let lowest = (1.0 / (value_s + 2.0 * half_unit_s)).ceil().max(1.0) as u32;
    let highest = ((1.0 / (value_s - half_unit_s)).floor() as u32).min(MAX_RATE_HZ);
    let is_usual = |rate: &u32| RATES_HZ.iter().any(|step| rate.is_multiple_of(*step));
    let mut meant = (lowest..=highest).filter(is_usual);
    match (meant.next(), meant.next()) {
        (Some(rate_hz), None) => 1.0 / f64::from(rate_hz),
        _ => value_s,
    }
}

fn is_whole_rate(value_s: f64) -> bool {
    let rate_hz = 1.0 / value_s;
    (rate_hz.round() * value_s - 1.0).abs() < 1e-12
}

/// Half of a unit in the last written place, with a hair for the rounding of binary numbers.
fn half_of_last_place(written: &str) -> f64 {
    let (mantissa, exponent) = match written.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => (mantissa, exponent.parse().unwrap_or(0)),
        None => (written, 0),
    };
    let n_places = mantissa.split_once(['.', ',']).map_or(0, |(_, places)| places.len());
    let places: i32 = n_places.try_into().unwrap_or(i32::MAX);
    0.5001 * 10f64.powi(exponent - places.min(400))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn read(written: &str) -> f64 {
        frame_time_of(written, written.replace(',', ".").parse().unwrap())
    }

    #[test]
    fn a_rounded_frame_time_is_that_of_the_whole_rate() {
        for (written, rate_hz) in [
            ("0.0333333", 30.0),
            ("0.033333", 30.0),
            ("0.0333", 30.0),
            ("0.033", 30.0),
            ("3.33333e-2", 30.0),
            ("0,0333333", 30.0),
            ("0.03333333333333333", 30.0),
            ("0.0083333", 120.0),
            ("0.008333", 120.0),
            ("0.00833333", 120.0),
            ("0.00833", 120.0),
            ("0.0166667", 60.0),
            ("0.016667", 60.0),
            ("0.016666", 60.0),
            ("0.01667", 60.0),
            ("0.0416667", 24.0),
            ("0.042", 24.0),
            ("0.0111111", 90.0),
            ("0.0666667", 15.0),
            ("0.04", 25.0),
            ("0.01", 100.0),
            ("1", 1.0),
        ] {
            assert!((read(written) * rate_hz - 1.0).abs() < 1e-15, "{written}: {}", read(written));
        }
    }

    #[test]
    fn other_frame_times_stay_as_they_are() {
        for written in
            ["0.0333667", "0.033367", "0.0417083", "0.0127", "0.0123456", "0.03", "0.007", "1e-4"]
        {
            let exact: f64 = written.parse().unwrap();
            assert_eq!(read(written), exact, "{written}");
        }
    }
}
