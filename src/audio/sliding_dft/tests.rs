use super::*;
use crate::audio::framing::Framer;
use crate::audio::stft::PairDft;

fn check(y: &[f32], block: usize, tolerance: f64) {
    for octave in octaves().into_iter().skip(2) {
        let mut expected = Vec::new();
        let mut framer = Framer::new(octave.n_fft, HOP);
        let mut dft = PairDft::new(octave.n_fft);
        let mut add = |frame: &[f32]| {
            let mut bins = Spectrum::default();
            dft.transform(frame, None);
            dft.bins(0, *DFT_BINS.start(), &mut bins.re, &mut bins.im);
            expected.push(bins);
        };
        framer.push(y, &mut add);
        framer.finish(&mut add);
        let mut sliding = SlidingDft::new(octave).expect("a low octave");
        let mut found = Vec::new();
        for samples in y.chunks(block) {
            sliding.push(samples, |spectrum| found.push(spectrum.clone()));
        }
        sliding.finish(|spectrum| found.push(spectrum.clone()));
        assert_eq!(found.len(), expected.len(), "N {}", octave.n_fft);
        for (t, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let parts = |of: &Spectrum| of.re.into_iter().zip(of.im).collect::<Vec<_>>();
            for (f, e) in parts(found).into_iter().zip(parts(expected)) {
                let error = (f.0 - e.0).hypot(f.1 - e.1);
                assert!(error <= tolerance, "N {}, frame {t}: {f:?} {e:?}", octave.n_fft);
            }
        }
    }
}

#[test]
fn spectra_are_those_of_whole_frames() {
    let noise = |i: usize| ((i as f64 * 78.233).sin() * 43_758.547).fract() as f32;
    for n in [0, 1, 734, 735, 50_001, 120_000] {
        let y: Vec<f32> = (0..n).map(noise).collect();
        // |D| is about √N = 256; the basis is good to 10⁻¹³ of it, and 160 frames add up.
        check(&y, 10_007, 1e-9);
    }
}

#[test]
fn quiet_after_loud_is_still_exact_and_silence_is_zero() {
    let mut y: Vec<f32> = (0..60_000).map(|i| (i as f32 * 0.01).sin()).collect();
    y.extend((0..80_000).map(|i| 1e-7 * (i as f32 * 0.013).sin()));
    check(&y, 65_536, 1e-9);
    y.truncate(60_000);
    y.extend(vec![0.0; 140_000]);
    for octave in octaves().into_iter().skip(2) {
        let mut sliding = SlidingDft::new(octave).expect("a low octave");
        let mut last = Spectrum { re: [f64::NAN; N_DFT_BINS], ..Spectrum::default() };
        sliding.push(&y, |spectrum| last = spectrum.clone());
        sliding.finish(|spectrum| last = spectrum.clone());
        assert_eq!(last, Spectrum::default());
    }
}

#[test]
fn ranks_are_low_enough_to_pay() {
    for octave in octaves().into_iter().skip(2) {
        let plan = Plan::of(octave).expect("a low octave");
        let rank = plan.cosines.rank.max(plan.sines.rank);
        assert!(rank <= 64, "N {}: {rank}", octave.n_fft);
    }
}
