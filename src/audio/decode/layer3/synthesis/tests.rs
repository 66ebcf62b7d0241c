use super::*;

/// Two granules of a channel or two from the same left channel; all of the left samples.
fn left_samples(n_channels: usize) -> Vec<f32> {
    let (mut memory, mut rows) = ([0.0; 960], [[0.0; 4]; SYN_ROWS]);
    let mut left = Vec::new();
    for granule in 0..2 {
        let line = |i: usize| ((i * i + 7 * i + granule) % 101) as f32 - 50.0;
        let mut spectra = [[0.0; 576]; 2];
        spectra[0] = std::array::from_fn(line);
        spectra[1] = std::array::from_fn(|i| 3.0 * line(575 - i));
        let mut pcm = vec![f32::NAN; 576 * n_channels];
        synthesize_granule(&mut memory, &mut spectra, n_channels, &mut pcm, &mut rows);
        left.extend(pcm.chunks(n_channels).map(|frame| frame[0]));
    }
    left
}

#[test]
fn the_left_channel_sounds_the_same_alone() {
    assert_eq!(left_samples(1), left_samples(2));
}

#[test]
fn a_constant_subband_makes_a_tone_in_the_middle_of_it() {
    // Subband s lies around (s + 1/2)/64 of the sample rate; by the standard's matrix a constant c
    // in it comes out as a tone of amplitude c.
    for s in [2, 9, 30] {
        let (mut memory, mut rows) = ([0.0; 960], [[0.0; 4]; SYN_ROWS]);
        let mut pcm = vec![0.0; 576];
        for _ in 0..2 {
            let mut spectra = [[0.0; 576]; 2];
            for step in 0..18 {
                // Hybrid synthesis turns every other step of odd bands; a tone in the middle of a
                // band turns by a quarter every step.
                let turn = [1.0, 0.0, -1.0, 0.0][step % 4];
                spectra[0][18 * s + step] = 1000.0 * turn;
            }
            synthesize_granule(&mut memory, &mut spectra, 1, &mut pcm, &mut rows);
        }
        let power = |cycles: f64| {
            let (mut re, mut im) = (0.0, 0.0);
            for (i, &y) in pcm.iter().enumerate() {
                let angle = std::f64::consts::TAU * cycles * i as f64;
                re += f64::from(y) * angle.cos();
                im += f64::from(y) * angle.sin();
            }
            re * re + im * im
        };
        let strongest = (0..64).map(|k| (k, power((f64::from(k) + 0.5) / 64.0 / 2.0)));
        let strongest = strongest.max_by(|a, b| a.1.total_cmp(&b.1)).map(|best| best.0);
        // Subband s is the 64ths 2s and 2s + 1 of half the rate.
        assert!(matches!(strongest, Some(k) if k as usize / 2 == s), "{s}: {strongest:?}");
    }
}
