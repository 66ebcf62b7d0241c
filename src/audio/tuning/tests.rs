use super::*;
use std::f64::consts::TAU;

fn tuning_of(y: &[f32]) -> Tuning {
    let mut pass = TuningPass::new();
    pass.push(y);
    pass.finish()
}

#[test]
fn a_detuned_tone_shows_its_deviation() {
    // 35 cents are 1.05 bins of 33.3 cents, that is 0.05 bins above the next bin.
    let hz = 440.0 * 2f64.powf(35.0 / 1200.0);
    let y: Vec<f32> =
        (0..44_100).map(|i| (0.5 * (TAU * hz * f64::from(i) / 44_100.0).sin()) as f32).collect();
    let bins = tuning_of(&y).bins();
    // Parabolic interpolation under a Hann window is biased by up to 0.05 DFT bins of 21.5 Hz,
    // which are 4 cents here: 0.12 bins of 33.3 cents.
    assert!((bins - 0.05).abs() <= 0.12, "{bins}");
}

#[test]
fn silence_has_the_standard_tuning() {
    assert_eq!(tuning_of(&[0.0; 5000]), Tuning::STANDARD);
    assert_eq!(tuning_of(&[]), Tuning::STANDARD);
}

#[test]
fn candidates_are_closed_on_the_left() {
    assert_eq!(candidate(27.5), 50);
    assert_eq!(candidate(440.0), 50);
    // Just below and above half a bin over A440.
    let hz = |bins: f64| (440.0 * 2f64.powf(bins / 36.0)) as f32;
    assert_eq!((candidate(hz(0.4951)), candidate(hz(0.5049))), (99, 0));
    assert_eq!((candidate(hz(0.0149)), candidate(hz(-0.0149))), (51, 48));
}

#[test]
fn the_highest_of_any_number_of_values_is_found() {
    let values: Vec<f64> = (0..41).map(|i| f64::from((i * 17) % 41) * 0.5).collect();
    for n in [1, 7, 8, 9, 41] {
        let expected = values[..n].iter().copied().fold(0.0, f64::max);
        assert_eq!(highest(&values[..n]), expected, "{n}");
    }
    assert_eq!((highest(&[]), highest(&[0.0, 1e-300])), (0.0, 1e-300));
}

#[test]
fn medians_of_odd_and_even_counts() {
    assert_eq!(median(&mut [3.0, 1.0, 2.0]), 2.0);
    assert_eq!(median(&mut [4.0, 1.0, 3.0, 2.0]), 2.5);
}

#[test]
fn tunings_of_other_bins_are_refused() {
    let error = "0.5".parse::<Tuning>().expect_err("half a bin is the next bin's");
    assert_eq!(
        error,
        "tuning 0.5 is outside -0.5 <= tuning < 0.5 (in bins of 1/36 octave); give the \
         nearest bin's"
    );
    assert_eq!("-0.5".parse::<Tuning>().map(Tuning::bins), Ok(-0.5));
    assert!("x".parse::<Tuning>().is_err());
}
