use super::*;

const N: usize = 94;

fn chirp(loudness: f32) -> Vec<f32> {
    (0..N).map(|i| loudness * ((i * i) as f32 * 0.37).sin() + 0.2 * loudness).collect()
}

fn tone(loudness: f32) -> Vec<f32> {
    (0..N).map(|i| loudness * (i as f32 * 0.71).cos()).collect()
}

/// The definition, bin by bin.
fn naive(y: &[f32], window: impl Fn(usize) -> f64) -> Vec<Complex64> {
    let bin = |k: usize| {
        let term = |i: usize| {
            let angle = -TAU * (k * i % N) as f64 / N as f64;
            Complex64::from_polar(window(i) * f64::from(y[i]), angle)
        };
        (0..N).map(term).sum()
    };
    (0..=N / 2).map(bin).collect()
}

fn powers(first: &[f32], second: Option<&[f32]>) -> [Vec<f64>; 2] {
    let mut dft = PairDft::hann(N);
    let mut powers = [vec![f64::NAN; N / 2 + 1], vec![f64::NAN; N / 2 + 1]];
    let [a, b] = &mut powers;
    dft.transform(first, second);
    dft.powers(a, b);
    powers
}

#[test]
fn two_frames_share_a_transform_however_loud_they_are() {
    for (first, second) in [(1.0, 1.0), (1.0, 1e-20), (1e-18, 1.0), (3e-9, 1e-8), (1e-30, 1e9)] {
        let frames = [chirp(first), tone(second)];
        let found = powers(&frames[0], Some(&frames[1]));
        for (y, found) in frames.iter().zip(&found) {
            let expected = naive(y, |i| hann(i, N));
            let loudest = expected.iter().map(|x| x.norm_sqr()).fold(0.0, f64::max);
            for (k, (p, x)) in found.iter().zip(&expected).enumerate() {
                // X is rounded to 24 bits, so its square is good to about 2⁻²³ of itself; where X is
                // small, rounding of the sums in f64 remains, 10⁻¹⁶ of the loudest at each of N terms,
                // and a thousand times that where the other frame may be louder by that much.
                let tolerance = 3e-7 * x.norm_sqr() + 1e-22 * loudest;
                assert!((p - x.norm_sqr()).abs() <= tolerance, "{first} {second}, bin {k}");
            }
        }
    }
}

#[test]
fn silence_beside_sound_is_exactly_silent_and_a_last_frame_may_stand_alone() {
    let (sound, silence) = (chirp(0.7), vec![0.0; N]);
    let alone = powers(&sound, None);
    assert_eq!(powers(&sound, Some(&silence)), alone);
    assert!(alone[1].iter().all(|&p| p == 0.0));
    let [first, second] = powers(&silence, Some(&sound));
    assert!(first.iter().all(|&p| p == 0.0));
    for (p, expected) in second.iter().zip(&alone[0]) {
        // Both are the square of the same number rounded to 24 bits, give or take one unit.
        assert!((p - expected).abs() <= 3e-7 * expected);
    }
    assert_eq!(powers(&silence, None), [vec![0.0; N / 2 + 1], vec![0.0; N / 2 + 1]]);
}

#[test]
fn a_sample_that_the_window_leaves_nothing_of_is_silence() {
    let mut edge = vec![0.0; N];
    edge[0] = 0.5;
    let [first, _] = powers(&edge, Some(&chirp(1.0)));
    assert!(first.iter().all(|&p| p == 0.0));
}

#[test]
fn bins_are_those_of_the_frame_as_it_is() {
    let frames = [chirp(0.3), tone(0.5)];
    let mut dft = PairDft::new(N);
    dft.transform(&frames[0], Some(&frames[1]));
    for (i, y) in frames.iter().enumerate() {
        let expected = &naive(y, |_| 1.0)[5..20];
        let (mut re, mut im) = ([f64::NAN; 15], [f64::NAN; 15]);
        dft.bins(i, 5, &mut re, &mut im);
        for ((re, im), expected) in re.into_iter().zip(im).zip(expected) {
            // Sums of 94 terms below 1 in f64.
            assert!((Complex64::new(re, im) - expected).norm() < 1e-12, "frame {i}");
        }
    }
}
