use super::*;

fn halve(y: &[f32], block: usize) -> Vec<f32> {
    let mut halver = Halver::new();
    let mut halved = Vec::new();
    for samples in y.chunks(block) {
        halver.push(samples, &mut halved);
    }
    halver.finish(&mut halved);
    halved
}

/// The definition, tap by tap.
fn naive(y: &[f32]) -> Vec<f32> {
    let h = taps();
    let at = |i: isize| usize::try_from(i).ok().and_then(|i| y.get(i)).copied().unwrap_or(0.0);
    (0..y.len().div_ceil(2))
        .map(|m| {
            let tap = |i: usize| h[i] * f64::from(at((2 * m + CENTRE) as isize - i as isize));
            (2f64.sqrt() * (0..N_TAPS).map(tap).sum::<f64>()) as f32
        })
        .collect()
}

#[test]
fn blocks_are_filtered_as_the_whole() {
    let noise = |i: usize| ((i as f64 * 12.9898).sin() * 43_758.547).fract() as f32;
    for n in [0, 1, 2, 387, 4001, 8191, 15_608, 20_011, 40_001] {
        let y: Vec<f32> = (0..n).map(noise).collect();
        let (found, expected) = (halve(&y, 777), naive(&y));
        assert_eq!(found.len(), expected.len());
        for (i, (f, e)) in found.iter().zip(&expected).enumerate() {
            // Both are f64 sums rounded to f32: one unit in the last place of values up to 2.
            assert!((f - e).abs() <= 2.4e-7, "n {n}, sample {i}: {f} != {e}");
        }
    }
}

#[test]
fn silence_stays_exactly_silent() {
    let mut y = vec![0.0; 12_000];
    y[5000..5100].fill(0.5);
    let halved = halve(&y, 4096);
    let is_zero = |m: usize| halved[m] == 0.0;
    // Sample 2m sees 2m − 194 … 2m + 194.
    assert!((0..2403).all(is_zero) && (2647..6000).all(is_zero));
    assert!((2404..2640).all(|m| !is_zero(m)));
}

#[test]
fn the_bessel_function_is_its_integral() {
    // I₀(x) = 1/π ∫₀^π e^(x cos θ) dθ; the midpoint rule converges geometrically.
    for x in [0.0, 0.5, 1.0, 13.040_03, 17.0] {
        let n = 64;
        let angle = |i: usize| PI * (i as f64 + 0.5) / n as f64;
        let integral = (0..n).map(|i| (x * angle(i).cos()).exp()).sum::<f64>() / n as f64;
        assert!((bessel_i0(x) / integral - 1.0).abs() < 1e-14, "{x}");
    }
}
