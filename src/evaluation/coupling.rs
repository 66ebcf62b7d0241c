//! The coupling of vertical velocity to the bar that is known beforehand, as one signed coefficient.
//!
//! R² of a free fit of harmonics cannot tell which way round a motion follows the bar: reversed, turned upside
//! down or shifted by a beat it is the same, and keeping the best of several motions raises it. Where it is
//! known what vertical velocity owes to the bar (a library was constructed with ḣ(φ, a); captured motion has a
//! mean over the training songs) one coefficient says how much of that is there: 1 as in real motion, 0 by
//! chance, below 0 the wrong way.

use std::f64::consts::TAU;

use crate::motion::choreography::floor::rise_amplitudes_m;
use crate::units::FPS;

use crate::chance::Draws;

/// Harmonics of the bar that a learned coupling has.
pub const N_HARMONICS: usize = 4;

/// Rotations that a p-value rests on, which can be as small as 1 / 1000.
pub const N_ROTATIONS: usize = 999;

/// Activity where that of the song is not known: that of half of all frames.
const MEAN_ACTIVITY: f64 = 0.5;

/// A coupling of less than this mean square, m²/s², says nothing.
const MIN_POWER: f64 = 1e-12;

/// Real and imaginary part.
type Complex = [f64; 2];

/// The known dependence of vertical velocity on the phase in the bar.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Coupling {
    /// The forward difference of h(φ, a), with which `library` constructs motion.
    Constructed,
    /// The mean over training songs.
    Learned(Template),
}

impl Coupling {
    /// Returns the name of the coupling in tables.
    pub const fn name(&self) -> &'static str {
        match self {
            Self::Constructed => "constructed",
            Self::Learned(_) => "learned",
        }
    }
}

/// A vertical velocity by bar phase, `v(φ) = Re Σ W_n exp(2πi n φ)`, n = 1 … 4, m/s.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Template {
    weights: [Complex; N_HARMONICS],
}

impl Template {
    /// Returns the mean over songs of `W_n = 2 ⟨v exp(-2πi n φ)⟩`, each song counting as one; none without songs.
    ///
    /// Over whole bars of frames the harmonics are orthogonal, and this is their least-squares fit.
    pub fn fit(songs: &[Harmonics]) -> Option<Self> {
        let n = songs.len() as f64;
        let mut weights = [[0.0; 2]; N_HARMONICS];
        for song in songs {
            for (sum, w) in weights.iter_mut().zip(song.weights()?) {
                *sum = [sum[0] + w[0] / n, sum[1] + w[1] / n];
            }
        }
        (!songs.is_empty()).then_some(Self { weights })
    }
}

/// A stretch of vertical velocity with the bars of its music.
#[derive(Clone, Copy, Debug)]
pub struct CoupledPassage<'a> {
    /// Vertical velocity from frame to frame, m/s: one fewer than there are frames.
    pub rise_m_s: &'a [f64],
    /// Bars that had passed at each frame.
    pub bars: &'a [f64],
    pub beats_per_bar: u32,
    /// Activity of the song at each frame, in (0, 1); none where it is not known.
    pub activity: Option<&'a [f64]>,
}

impl CoupledPassage<'_> {
    fn n_frames(&self) -> usize {
        (self.rise_m_s.len() + 1).min(self.bars.len())
    }

    /// Length of a bar, s; none for music that stands still.
    fn bar_s(&self) -> Option<f64> {
        let n = self.n_frames();
        let passed = self.bars.get(n.checked_sub(1)?)? - self.bars.first()?;
        let bar_s = (n - 1) as f64 / FPS / passed;
        (bar_s.is_finite() && bar_s > 0.0).then_some(bar_s)
    }
}

/// Sums over a signal and its bar phase, `Σ v exp(-2πi n φ)`; those of two stretches add up to those of both.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Harmonics {
    n: usize,
    sum: f64,
    square: f64,
    waves: [Complex; N_HARMONICS],
    products: [Complex; N_HARMONICS],
}

impl Harmonics {
    /// Adds a passage.
    pub fn add(&mut self, passage: &CoupledPassage) {
        for (v, bars) in passage.rise_m_s.iter().zip(passage.bars) {
            self.n += 1;
            self.sum += v;
            self.square += v * v;
            for (h, (wave, product)) in self.waves.iter_mut().zip(&mut self.products).enumerate() {
                let (sine, cosine) = (TAU * (h + 1) as f64 * bars.fract()).sin_cos();
                *wave = [wave[0] + cosine, wave[1] - sine];
                *product = [product[0] + v * cosine, product[1] - v * sine];
            }
        }
    }

    /// Returns `W_n`, m/s; none without frames or where a value is not finite.
    fn weights(&self) -> Option<[Complex; N_HARMONICS]> {
        let (n, mean) = (self.n as f64, self.sum / self.n as f64);
        let weights: [Complex; N_HARMONICS] = std::array::from_fn(|h| {
            std::array::from_fn(|i| 2.0 * (self.products[h][i] - mean * self.waves[h][i]) / n)
        });
        weights.iter().flatten().all(|x| x.is_finite()).then_some(weights)
    }

    /// Returns `W_n` over the deviation of the signal; none where it does not vary.
    fn normalized(&self) -> Option<[Complex; N_HARMONICS]> {
        let n = self.n as f64;
        let variance = self.square / n - (self.sum / n).powi(2);
        let weights = self.weights()?;
        (variance > MIN_POWER).then(|| weights.map(|w| w.map(|x| x / variance.sqrt())))
    }
}

/// Sums from which the coefficient of a song's vertical velocity on a coupling follows, with the bar where it is
/// or rotated; those of two stretches add up to those of both.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CouplingSums {
    n: usize,
    rise: f64,
    /// Of the coupling u and its square.
    coupling: f64,
    square: f64,
    /// Harmonics, `Σ W_n b_n` and `Σ v W_n b_n` with `u = Re Σ W_n b_n`.
    harmonics: [f64; N_HARMONICS],
    first: [Complex; N_HARMONICS],
    product: [Complex; N_HARMONICS],
}

impl CouplingSums {
    /// Adds a passage; one without two frames, or whose music stands still, adds nothing.
    pub fn add(&mut self, coupling: &Coupling, passage: &CoupledPassage) {
        match coupling {
            Coupling::Constructed => self.add_constructed(passage),
            Coupling::Learned(template) => self.add_learned(template, passage),
        }
    }

    /// `b_n[t] = ((1/2 + a[t+1]) exp(2πi n φ[t+1]) - (1/2 + a[t]) exp(2πi n φ[t])) FPS`, `W_n = -A_n`.
    fn add_constructed(&mut self, passage: &CoupledPassage) {
        let Some(bar_s) = passage.bar_s() else { return };
        let amplitudes = rise_amplitudes_m(bar_s, passage.beats_per_bar);
        let at = |t: usize, harmonic: f64, amplitude_m: f64| -> Complex {
            let activity =
                passage.activity.and_then(|a| a.get(t)).copied().unwrap_or(MEAN_ACTIVITY);
            let (sine, cosine) = (TAU * harmonic * passage.bars[t].fract()).sin_cos();
            let scale = -amplitude_m * (0.5 + activity) * FPS;
            [scale * cosine, scale * sine]
        };
        let mut before: Vec<Complex> = amplitudes.iter().map(|&(h, a)| at(0, h, a)).collect();
        for t in 1..passage.n_frames() {
            let mut terms = [(0.0, [0.0; 2]); N_HARMONICS];
            for (i, &(harmonic, amplitude_m)) in amplitudes.iter().enumerate() {
                let here = at(t, harmonic, amplitude_m);
                terms[i] = (harmonic, [here[0] - before[i][0], here[1] - before[i][1]]);
                before[i] = here;
            }
            self.add_frame(passage.rise_m_s[t - 1], terms);
        }
    }

    fn add_learned(&mut self, template: &Template, passage: &CoupledPassage) {
        for (v, bars) in passage.rise_m_s.iter().zip(passage.bars) {
            let terms = std::array::from_fn(|i| {
                let harmonic = (i + 1) as f64;
                let (sine, cosine) = (TAU * harmonic * bars.fract()).sin_cos();
                let [re, im] = template.weights[i];
                (harmonic, [re * cosine - im * sine, re * sine + im * cosine])
            });
            self.add_frame(*v, terms);
        }
    }

    fn add_frame(&mut self, rise_m_s: f64, terms: [(f64, Complex); N_HARMONICS]) {
        let u: f64 = terms.iter().map(|(_, term)| term[0]).sum();
        self.n += 1;
        self.rise += rise_m_s;
        self.coupling += u;
        self.square += u * u;
        for (i, (harmonic, term)) in terms.into_iter().enumerate() {
            self.harmonics[i] = harmonic;
            for (j, x) in term.into_iter().enumerate() {
                self.first[i][j] += x;
                self.product[i][j] += rise_m_s * x;
            }
        }
    }

    /// Returns the regression coefficient of vertical velocity on the coupling, `Σ (v - v̄) u / Σ (u - ū)²`, with
    /// the bar rotated by `rotation_bars`.
    ///
    /// The denominator is that of the bar where it is. None without frames, for a coupling that says nothing,
    /// or where a value is not finite.
    pub fn coefficient(&self, rotation_bars: f64) -> Option<f64> {
        let n = self.n as f64;
        let power = self.square - self.coupling * self.coupling / n;
        let mean = self.rise / n;
        let sum: f64 = (0..N_HARMONICS)
            .map(|i| {
                let (sine, cosine) = (TAU * self.harmonics[i] * rotation_bars).sin_cos();
                let re = self.product[i][0] - mean * self.first[i][0];
                let im = self.product[i][1] - mean * self.first[i][1];
                re * cosine - im * sine
            })
            .sum();
        let found = sum / power;
        (power > MIN_POWER * n && found.is_finite()).then_some(found)
    }
}

/// Returns the probability that motion which has nothing to do with where the bar begins has as high a mean
/// coefficient over songs.
///
/// `p = (1 + #{r: T_r ≥ T}) / (1 + 999)` with T the mean coefficient of the songs as they are and T_r that with the
/// bar of each song rotated by an angle of its own, uniform over the bar. A rotation keeps the spectrum of the
/// motion and how much of it lies at the harmonics of the bar, so that motion which happens to be about as fast as
/// the beat, or was chosen for a high R² of free harmonics, is no more significant than other motion. None
/// without songs that have a coefficient.
pub fn rotation_p(songs: &[CouplingSums], seed: u64) -> Option<f64> {
    let songs: Vec<&CouplingSums> =
        songs.iter().filter(|song| song.coefficient(0.0).is_some()).collect();
    let total = |rotations: &mut dyn FnMut() -> f64| -> f64 {
        songs.iter().filter_map(|song| song.coefficient(rotations())).sum()
    };
    rotation_test(songs.len(), total, seed)
}

/// Returns the probability that motion which has nothing to do with where the bar begins does as much alike at
/// the same place of the bar in different songs: for music of which no coupling is known.
///
/// As [`rotation_p`] with `T = Σ_n |Σ_s w_{s,n}|²`, w the harmonics of a song over the deviation of its vertical
/// velocity. None for fewer than two songs that move.
pub fn consistency_p(songs: &[Harmonics], seed: u64) -> Option<f64> {
    let songs: Vec<[Complex; N_HARMONICS]> =
        songs.iter().filter_map(Harmonics::normalized).collect();
    let total = |rotations: &mut dyn FnMut() -> f64| -> f64 {
        let mut sums = [[0.0; 2]; N_HARMONICS];
        for song in &songs {
            let rotation = rotations();
            for (h, (sum, w)) in sums.iter_mut().zip(song).enumerate() {
                let (sine, cosine) = (TAU * (h + 1) as f64 * rotation).sin_cos();
                *sum = [sum[0] + w[0] * cosine - w[1] * sine, sum[1] + w[0] * sine + w[1] * cosine];
            }
        }
        sums.iter().map(|[re, im]| re * re + im * im).sum()
    };
    // One song alone is as consistent with itself under any rotation.
    if songs.len() < 2 { None } else { rotation_test(songs.len(), total, seed) }
}

fn rotation_test(
    n_songs: usize,
    total: impl Fn(&mut dyn FnMut() -> f64) -> f64,
    seed: u64,
) -> Option<f64> {
    if n_songs == 0 {
        return None;
    }
    let own = total(&mut || 0.0);
    // Rounding must not make a rotation of a tie less than the tie.
    let threshold = own - 1e-12 * own.abs();
    let mut draws = Draws::new(seed);
    let n_as_high =
        (0..N_ROTATIONS).filter(|_| total(&mut || draws.uniform()) >= threshold).count();
    own.is_finite().then(|| (1 + n_as_high) as f64 / (1 + N_ROTATIONS) as f64)
}

#[cfg(test)]
mod tests;
