//! Songs of known beats, and sounds without any.

use super::{Meter, MeterPass};

const RATE: f64 = 44_100.0;

fn found(samples: &[f32]) -> Meter {
    let mut pass = MeterPass::new();
    samples.chunks(7001).for_each(|block| pass.push(block));
    pass.finish()
}

/// A uniform number of −1 to 1 (an LCG; Knuth, The Art of Computer Programming 3.3.4).
fn noise(state: &mut u64) -> f64 {
    *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
    (*state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

struct Song {
    samples: Vec<f32>,
    state: u64,
}

impl Song {
    fn add(&mut self, time_s: f64, length_s: f64, sound: impl Fn(f64, f64) -> f64) {
        let first = (time_s * RATE).round() as usize;
        let n = (length_s * RATE) as usize;
        for (i, sample) in self.samples.iter_mut().skip(first).take(n).enumerate() {
            *sample += sound(i as f64 / RATE, noise(&mut self.state)) as f32;
        }
    }

    fn kick(&mut self, time_s: f64) {
        self.add(time_s, 0.25, |t, _| {
            0.8 * (std::f64::consts::TAU * (50.0 * t + 4.0 * (1.0 - (-30.0 * t).exp()))).sin()
                * (-t / 0.08).exp()
        });
    }

    fn snare(&mut self, time_s: f64) {
        self.add(time_s, 0.2, |t, noise| {
            0.4 * (noise + 0.5 * (1194.0 * t).sin()) * (-t / 0.05).exp()
        });
    }

    fn hat(&mut self, time_s: f64) {
        self.add(time_s, 0.05, |t, noise| 0.12 * noise * (-t / 0.015).exp());
    }

    /// MIDI's number of a note.
    fn note(&mut self, time_s: f64, length_s: f64, pitch: f64, gain: f64) {
        let w = std::f64::consts::TAU * 440.0 * ((pitch - 69.0) / 12.0).exp2();
        self.add(time_s, length_s, |t, _| {
            let tone = (w * t).sin() + 0.4 * (2.0 * w * t).sin() + 0.2 * (3.0 * w * t).sin();
            gain * tone * (t / 0.005).min(1.0) * (-t / 0.6).exp()
        });
    }
}

/// Drums, bass and chords that change with the bar, `n_bars` of them; the first downbeat at `begin_s`.
fn song(bpm: f64, beats_per_bar: usize, begin_s: f64, n_bars: usize) -> Vec<f32> {
    let beat_s = 60.0 / bpm;
    let length_s = begin_s + (n_bars * beats_per_bar) as f64 * beat_s;
    let mut song = Song { samples: vec![0.0; (length_s * RATE) as usize], state: 7 };
    for bar in 0..n_bars {
        let root = [0.0, 9.0, 5.0, 7.0][bar % 4];
        let at = |beat: f64| begin_s + ((bar * beats_per_bar) as f64 + beat) * beat_s;
        song.note(at(0.0), beats_per_bar as f64 * beat_s, 36.0 + root, 0.4);
        for third in [0.0, 4.0, 7.0] {
            song.note(at(0.0), beats_per_bar as f64 * beat_s, 60.0 + root + third, 0.1);
        }
        for beat in 0..beats_per_bar {
            let is_kick = if beats_per_bar == 3 { beat == 0 } else { beat % 2 == 0 };
            // A fast song whose drums alternate is a slow one as well.
            let is_even = beats_per_bar == 4 && bpm > 140.0;
            if is_kick || is_even {
                song.kick(at(beat as f64));
            }
            if !is_kick {
                song.snare(at(beat as f64));
            }
            song.hat(at(beat as f64));
            song.hat(at(beat as f64 + 0.5));
        }
        if beats_per_bar == 4 && bpm < 140.0 {
            song.kick(at(2.5));
        }
    }
    song.samples
}

/// Asserts that beats and downbeats are those of [`song`], to 20 ms.
fn assert_is(meter: &Meter, bpm: f64, beats_per_bar: usize, begin_s: f64) {
    let tempo = meter.tempo_bpm().expect("a tempo");
    assert!((tempo / bpm - 1.0).abs() < 0.005, "{tempo} for {bpm}");
    let bar = meter.bar.unwrap_or_else(|| panic!("no bars at {bpm}"));
    assert_eq!(bar.beats_per_bar, beats_per_bar, "{bpm}");
    for (time_s, number) in meter.numbered() {
        let beats = (time_s - begin_s) * bpm / 60.0;
        let off_s = (beats - beats.round()) * 60.0 / bpm;
        assert!(off_s.abs() < 0.02, "{bpm}: {time_s} is {off_s} s off");
        let expected = (beats.round() as i64).rem_euclid(beats_per_bar as i64) + 1;
        assert_eq!(number, Some(expected), "{bpm}: at {time_s}");
    }
}

#[test]
fn beats_and_bars_of_known_songs_are_found() {
    for (bpm, beats_per_bar, begin_s) in [
        (83.7, 4, 0.31),
        (97.0, 3, 0.05),
        (120.0, 4, 0.0),
        (133.3, 4, 1.77),
        (151.0, 3, 0.6),
        (172.0, 4, 0.2),
    ] {
        let n_bars = (30.0 * bpm / 60.0) as usize / beats_per_bar;
        let meter = found(&song(bpm, beats_per_bar, begin_s, n_bars));
        assert_is(&meter, bpm, beats_per_bar, begin_s);
        let n_beats = n_bars * beats_per_bar;
        assert!(
            n_beats - meter.beat_times_s.len() <= 2,
            "{bpm}: {} of {n_beats}",
            meter.beat_times_s.len()
        );
    }
}

#[test]
fn a_song_that_begins_within_a_bar_has_its_downbeat_later() {
    let (bpm, whole) = (126.0, song(126.0, 4, 0.2, 17));
    // Without its first beat, and without its first two.
    for n_gone in [1, 2] {
        let gone_s = f64::from(n_gone) * 60.0 / bpm;
        let meter = found(&whole[(gone_s * RATE).round() as usize..]);
        assert_is(&meter, bpm, 4, 0.2 - gone_s);
    }
}

#[test]
fn double_time_has_the_double_tempo() {
    for bpm in [80.0, 160.0] {
        assert_is(&found(&song(bpm, 4, 0.1, bpm as usize / 8)), bpm, 4, 0.1);
    }
}

#[test]
fn loudness_and_blocks_do_not_matter() {
    let loud = song(110.0, 4, 0.4, 12);
    let quiet: Vec<f32> = loud.iter().map(|x| x / 64.0).collect();
    let (a, b) = (found(&loud), found(&quiet));
    // A power of two changes no digit but the exponent's.
    assert_eq!(a, b);
    let mut pass = MeterPass::new();
    loud.chunks(333).for_each(|block| pass.push(block));
    assert_eq!(pass.finish(), a);
}

#[test]
fn what_has_no_pulse_has_no_beats() {
    let mut state = 3;
    let hiss: Vec<f32> = (0..20 * 44_100).map(|_| 0.3 * noise(&mut state) as f32).collect();
    let tone: Vec<f32> =
        (0..10 * 44_100).map(|i| 0.5 * (f64::from(i) * 0.0627).sin() as f32).collect();
    let mut click = vec![0.0; 8 * 44_100];
    click[100_000..100_300].fill(0.9);
    let short = song(120.0, 4, 0.0, 1)[..8820].to_vec();
    for (name, samples) in [
        ("silence", vec![0.0; 400_000]),
        ("hiss", hiss),
        ("a tone", tone),
        ("one click", click),
        ("0.2 s", short),
        ("one sample", vec![0.5]),
        ("nothing", Vec::new()),
    ] {
        assert_eq!(found(&samples).beat_times_s, [0.0; 0], "{name}");
    }
}

#[test]
fn clicks_are_beats_without_a_first_one() {
    let mut clicks = Song { samples: vec![0.0; 12 * 44_100], state: 5 };
    (0..24).for_each(|i| clicks.kick(0.1 + 0.5 * f64::from(i)));
    let meter = found(&clicks.samples);
    assert!((meter.tempo_bpm().expect("a tempo") - 120.0).abs() < 0.3);
    assert_eq!(meter.bar, None);
    assert!(meter.numbered().all(|(_, number)| number.is_none()));
}
