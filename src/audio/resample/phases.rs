//! The taps of a conversion at every phase, or at enough of them.

use std::sync::{Arc, Mutex, OnceLock, PoisonError};

use super::dot::{LANES, dot};
use super::filter::{Filter, FilterTable, TABLE_ERROR};
use crate::audio::SAMPLE_RATE_HZ;

/// Taps up to which a conversion holds every phase: 768 kHz has 569,184. Beyond, phases are blended.
const MAX_EXACT_TAPS: usize = 600_000;
/// Rows of blended phases per sample of the lower rate.
///
/// A tap between two rows is off by at most max |h″| / (8 · 2048²) = 9·10⁻⁸ of full scale, because
/// |h″| ≤ π² F_c³ / 3 = 2.9; the filter itself is fitted to 3·10⁻⁷.
const BLENDED_ROWS: f64 = 2048.0;

/// The taps of a conversion by `up`/`down`.
#[derive(Debug, PartialEq)]
pub struct Phases {
    pub up: usize,
    pub down: usize,
    /// Taps of one phase, a multiple of [`LANES`].
    pub n_taps: usize,
    /// Samples before an output's position that its first tap covers.
    pub n_before: usize,
    /// Steps between two input samples: `up`, or fewer if phases are blended.
    n_steps: usize,
    /// Row by row: of every phase, or of every step and the one after the last.
    taps: Vec<f32>,
}

impl Phases {
    pub fn new(rate_hz: u32) -> Self {
        let divisor = gcd(rate_hz, SAMPLE_RATE_HZ);
        let (up, down) = (SAMPLE_RATE_HZ / divisor, rate_hz / divisor);
        let filter = Filter::new(rate_hz, up, down);
        let table = FilterTable::new(&filter);
        // The lower rate's samples per input sample; also the gain that keeps the level.
        let scale = (f64::from(SAMPLE_RATE_HZ) / f64::from(rate_hz)).min(1.0);
        let n_before = (filter.reach() / scale).floor() as usize;
        let n_taps = (2 * n_before + 2).next_multiple_of(LANES);
        // Output at input position p + step/n_steps, tap on input sample p − n_before + i.
        let distance = |step: usize, n_steps: usize, i: usize| {
            step as f64 / n_steps as f64 + n_before as f64 - i as f64
        };
        let exact = |z: f64| {
            // What the table leaves open is evaluated, so that all taps are those of the filter.
            let value = |h: f64| (scale * h) as f32;
            let h = table.at(z);
            let (low, high) = (value(h - TABLE_ERROR), value(h + TABLE_ERROR));
            let is_known = table.is_smooth_at(z) && low.to_bits() == high.to_bits();
            if is_known { low } else { value(filter.at(z)) }
        };
        let is_exact = up as usize * n_taps <= MAX_EXACT_TAPS;
        let (n_steps, taps) = if is_exact {
            let n_steps = up as usize;
            let row =
                |step: usize| (0..n_taps).map(move |i| exact(distance(step, n_steps, i) * scale));
            (n_steps, (0..n_steps).flat_map(row).collect())
        } else {
            let n_steps = (BLENDED_ROWS * scale).ceil() as usize;
            let blended = |z: f64| (scale * table.at(z)) as f32;
            let row =
                |step: usize| (0..n_taps).map(move |i| blended(distance(step, n_steps, i) * scale));
            (n_steps, (0..=n_steps).flat_map(row).collect())
        };
        Self { up: up as usize, down: down as usize, n_taps, n_before, n_steps, taps }
    }

    /// Returns the output at `phase`/`up` behind the sample `n_before` of `window`, which has as
    /// many samples as there are taps.
    pub fn filtered(&self, window: &[f32], phase: usize) -> f32 {
        let row = |step: usize| &self.taps[step * self.n_taps..(step + 1) * self.n_taps];
        if self.n_steps == self.up {
            return dot(window, row(phase));
        }
        let position = phase * self.n_steps;
        let (step, rest) = (position / self.up, position % self.up);
        let share = rest as f32 / self.up as f32;
        let (before, after) = (dot(window, row(step)), dot(window, row(step + 1)));
        before + share * (after - before)
    }
}

fn gcd(a: u32, b: u32) -> u32 {
    if b == 0 { a } else { gcd(b, a % b) }
}

/// The phases of the rates that were asked for last.
pub struct PhaseCache(Mutex<Vec<(u32, SharedPhases)>>);

type SharedPhases = Arc<OnceLock<Arc<Phases>>>;

/// Rates that are kept, of at most 2.4 MB each.
const MAX_KEPT: usize = 8;

impl PhaseCache {
    pub const fn new() -> Self {
        Self(Mutex::new(Vec::new()))
    }

    /// Returns the phases of a rate, and makes them if they are not kept.
    ///
    /// They are made outside the lock: only threads that want the same rate wait.
    pub fn phases(&self, rate_hz: u32, make: impl FnOnce(u32) -> Phases) -> Arc<Phases> {
        let made = {
            let mut kept = self.0.lock().unwrap_or_else(PoisonError::into_inner);
            let found = kept.iter().position(|(kept_hz, _)| *kept_hz == rate_hz);
            let made = found.map_or_else(SharedPhases::default, |i| kept.remove(i).1);
            // The latest stands last.
            kept.push((rate_hz, Arc::clone(&made)));
            if kept.len() > MAX_KEPT {
                kept.remove(0);
            }
            made
        };
        Arc::clone(made.get_or_init(|| Arc::new(make(rate_hz))))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::audio::resample::filter::EVALUATIONS;
    use proptest::prelude::*;
    use std::sync::mpsc::channel;
    use std::time::Duration;

    /// The filter's taps at a phase by its definition, in f64.
    fn exact_taps(phases: &Phases, rate_hz: u32, phase: usize) -> Vec<f64> {
        let filter = Filter::new(rate_hz, phases.up as u32, phases.down as u32);
        let scale = (44_100.0 / f64::from(rate_hz)).min(1.0);
        let position = phases.n_before as f64 + phase as f64 / phases.up as f64;
        (0..phases.n_taps).map(|i| scale * filter.at((position - i as f64) * scale)).collect()
    }

    /// Returns the taps that are in effect at a phase: what comes out of an impulse on each.
    fn effective_taps(phases: &Phases, phase: usize) -> Vec<f64> {
        let mut window = vec![0.0; phases.n_taps];
        (0..phases.n_taps)
            .map(|i| {
                window[i] = 1.0;
                let tap = phases.filtered(&window, phase);
                window[i] = 0.0;
                f64::from(tap)
            })
            .collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 24, ..ProptestConfig::default() })]
        #[test]
        fn every_rate_costs_little_and_is_its_filter(
            rate_hz in 1_000u32..=768_000,
            is_round in any::<bool>(),
            place in 0f64..1.0,
        ) {
            let rate_hz = if is_round { rate_hz.next_multiple_of(1000).min(768_000) } else { rate_hz };
            EVALUATIONS.set(0);
            let phases = Phases::new(rate_hz);
            // With every tap evaluated 768 kHz took 10 million, 44,101 Hz 162 million.
            prop_assert!(EVALUATIONS.get() < 1_500_000, "{rate_hz} Hz: {}", EVALUATIONS.get());
            let n_bytes = size_of_val(&phases.taps[..]);
            prop_assert!(n_bytes <= 2_400_000, "{rate_hz} Hz: {n_bytes} bytes");
            let reach = 112.0 * f64::from(rate_hz.max(44_100)) / 44_100.0;
            prop_assert!((phases.n_taps as f64) < 2.0 * reach + 10.0, "{rate_hz} Hz");
            let phase = (place * phases.up as f64) as usize;
            let (found, exact) = (effective_taps(&phases, phase), exact_taps(&phases, rate_hz, phase));
            // Blending gives 9e-8 of full scale at most; the row and its share are rounded to f32,
            // each to half a unit in the last place, which is 6e-8 of a value below a power of two.
            for (i, (f, e)) in found.iter().zip(&exact).enumerate() {
                let scale = (44_100.0 / f64::from(rate_hz)).min(1.0);
                prop_assert!((f - e).abs() < 2.1e-7 * scale, "{rate_hz} Hz, {phase}, tap {i}: {f} {e}");
            }
        }
    }

    #[test]
    fn usual_rates_have_the_taps_of_their_filter_to_the_last_bit() {
        for rate_hz in [8_000, 11_025, 16_000, 22_050, 32_000, 48_000, 88_200, 96_000, 192_000] {
            let phases = Phases::new(rate_hz);
            for phase in (0..phases.up).step_by(11) {
                let exact = exact_taps(&phases, rate_hz, phase);
                let exact: Vec<f32> = exact.iter().map(|&tap| tap as f32).collect();
                let row = &phases.taps[phase * phases.n_taps..][..phases.n_taps];
                assert!(row.iter().zip(&exact).all(|(a, b)| a == b), "{rate_hz} Hz, phase {phase}");
            }
        }
    }

    #[test]
    fn few_rates_are_kept_and_the_latest_longest() {
        let kept = PhaseCache::new();
        let mut n_made = 0;
        let mut ask = |rate_hz| {
            kept.phases(rate_hz, |rate_hz| {
                n_made += 1;
                assert_eq!(rate_hz % 44_100, 0);
                Phases::new(rate_hz)
            });
            n_made
        };
        // Whole multiples have one phase.
        assert_eq!((1..=8).map(|i| ask(44_100 * i)).last(), Some(8));
        assert_eq!((ask(44_100), ask(44_100 * 9)), (8, 9));
        // The second was not asked for since the others were.
        assert_eq!((ask(44_100), ask(44_100 * 2)), (9, 10));
        assert_eq!(kept.0.lock().expect("no panic").len(), MAX_KEPT);
    }

    #[test]
    fn nobody_waits_for_another_rate() {
        let kept = PhaseCache::new();
        let (started, is_started) = channel();
        let (release, is_released) = channel::<()>();
        let (done, is_done) = channel();
        std::thread::scope(|scope| {
            let kept = &kept;
            scope.spawn(move || {
                kept.phases(88_200, |rate_hz| {
                    started.send(()).expect("a listener");
                    is_released.recv().expect("a release");
                    Phases::new(rate_hz)
                })
            });
            is_started.recv().expect("the first begins");
            scope.spawn(move || {
                kept.phases(22_050, Phases::new);
                done.send(()).expect("a listener");
            });
            let second = is_done.recv_timeout(Duration::from_secs(60));
            release.send(()).expect("the first waits");
            assert_eq!(second, Ok(()), "the second rate waits for the first");
        });
    }
}
