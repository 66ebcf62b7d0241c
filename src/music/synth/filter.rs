//! One-pole filters, noise and decays.

use super::RATE_HZ;

/// y\[n\] = y\[n−1\] + c (x\[n\] − y\[n−1\]), c = 1 − e^(−2πf/rate).
#[derive(Clone, Copy, Debug, Default)]
pub struct OnePole {
    c: f32,
    y: f32,
}

impl OnePole {
    /// A low-pass filter with its corner at `hz`.
    pub fn new(hz: f64) -> Self {
        let mut filter = Self::default();
        filter.set(hz);
        filter
    }

    /// Moves the corner.
    pub fn set(&mut self, hz: f64) {
        let turn = (hz / RATE_HZ).clamp(1e-5, 0.45);
        self.c = (1.0 - libm::exp(-std::f64::consts::TAU * turn)) as f32;
    }

    /// Returns the part of the signal below the corner.
    pub fn low(&mut self, x: f32) -> f32 {
        self.y += self.c * (x - self.y);
        self.y
    }

    /// Returns the part of the signal above the corner.
    pub fn high(&mut self, x: f32) -> f32 {
        x - self.low(x)
    }
}

/// White noise in [−1, 1): a linear congruential generator, modulus 2³².
///
/// Source: Press et al., "Numerical Recipes", 1992, section 7.1.
#[derive(Clone, Copy, Debug)]
pub struct Noise(u32);

impl Noise {
    pub fn new(seed: u32) -> Self {
        Self(seed)
    }

    pub fn next(&mut self) -> f32 {
        self.0 = self.0.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (self.0 >> 8) as f32 * (2.0 / 16_777_216.0) - 1.0
    }
}

/// Returns the factor per sample of a decay to 1/e in `seconds`.
pub fn decay(seconds: f64) -> f32 {
    libm::exp(-1.0 / (seconds.max(1e-4) * RATE_HZ)) as f32
}

/// Returns decibels as a factor.
pub fn gain(db: f64) -> f32 {
    libm::pow(10.0, db / 20.0) as f32
}

/// Returns the frequency of a MIDI note, in Hz: 440 · 2^((pitch − 69)/12).
pub fn pitch_hz(pitch: f64) -> f64 {
    440.0 * libm::exp2((pitch - 69.0) / 12.0)
}
