//! The low-pass filter of a conversion: exactly, and from a table of a few thousand values.

use crate::audio::SAMPLE_RATE_HZ;
use crate::audio::decimate::{Kaiser, sinc};

/// Cut-off relative to the lower rate's Nyquist frequency, midway between pass and stop band.
const CUT_OFF: f64 = 0.956_871_8;

/// A low-pass filter in time, in units of the lower rate's samples.
///
/// h(z) = c₀k(z) + Σⱼ cⱼ/2 · (k(z − j/2) + k(z + j/2)),
/// k(z) = F_c · sinc(F_c z) · I₀(β√(1 − (z/L)²)) / I₀(β)
#[derive(Clone, Debug, PartialEq)]
pub struct Filter {
    half_length: f64,
    window: Kaiser,
    droop: &'static [f64],
}

/// The constants of a filter.
struct Design {
    /// L: half the length of the window.
    half_length: f64,
    /// β of the window.
    beta: f64,
    /// c: the droop that libsoxr's last, shorter stage adds below the cut-off (10⁻³ there).
    droop: &'static [f64],
}

/// Rates in a ratio of small whole numbers: one stage of 2·97·m + 1 taps, no droop.
fn one_stage(largest_term: u32) -> Design {
    let half_length = 97.0 + 0.5 / f64::from(largest_term);
    Design { half_length, beta: 13.040_03, droop: &[1.0] }
}
const UP: Design = Design {
    half_length: 102.25,
    beta: 13.7112,
    droop: &[
        0.924_191_619,
        0.131_195_135,
        -0.084_007_933,
        0.038_117_398,
        -0.010_869_255,
        0.001_089_315,
        0.000_444_155,
        -0.000_182_88,
        0.000_022_634,
    ],
};
const DOWN: Design = Design {
    half_length: 102.211,
    beta: 13.7112,
    droop: &[
        0.963_511_202,
        0.061_499_433,
        -0.035_859_245,
        0.012_811_347,
        -0.001_203_796,
        -0.001_392_36,
        0.000_824_067,
        -0.000_216_649,
        0.000_025_904,
    ],
};
const FAR_UP: Design = Design {
    half_length: 107.248,
    beta: 14.3828,
    droop: &[
        0.849_698_686,
        0.268_055_395,
        -0.189_786_446,
        0.106_260_877,
        -0.046_813_29,
        0.016_144_197,
        -0.004_299_712,
        0.000_828_689,
        -0.000_088_476,
    ],
};
const FAR_DOWN: Design = Design {
    half_length: 106.805,
    beta: 14.3828,
    droop: &[
        1.025_930_121,
        -0.053_331_816,
        0.053_250_934,
        -0.044_982_632,
        0.029_572_914,
        -0.014_444_064,
        0.005_000_969,
        -0.001_124_291,
        0.000_127_873,
    ],
};

/// Largest term of a ratio that libsoxr converts in one stage.
const MAX_ONE_STAGE_TERM: u32 = 5;
/// Ratio of the rates from which libsoxr adds a stage, and with it attenuation.
const FAR: f64 = 4.0;

impl Filter {
    /// Returns the filter between `rate_hz` and 44.1 kHz, whose ratio in lowest terms is `up`/`down`.
    pub fn new(rate_hz: u32, up: u32, down: u32) -> Self {
        let is_far = |ratio: f64| ratio > FAR;
        let ratio = f64::from(SAMPLE_RATE_HZ) / f64::from(rate_hz);
        let design = if up.max(down) <= MAX_ONE_STAGE_TERM {
            one_stage(up.max(down))
        } else if ratio > 1.0 {
            if is_far(ratio) { FAR_UP } else { UP }
        } else if is_far(1.0 / ratio) {
            FAR_DOWN
        } else {
            DOWN
        };
        let Design { half_length, beta, droop } = design;
        Self { half_length, window: Kaiser::new(beta), droop }
    }

    /// Returns h(z).
    pub fn at(&self, z: f64) -> f64 {
        self.with_droop(|j| self.kernel(z + j as f64 / 2.0))
    }

    /// Returns h from the values k(z + j/2) of the kernel, by j.
    fn with_droop(&self, k: impl Fn(isize) -> f64) -> f64 {
        let pairs = (1..).zip(&self.droop[1..]);
        let echoes = pairs.map(|(j, c)| c / 2.0 * (k(-j) + k(j)));
        self.droop[0] * k(0) + echoes.sum::<f64>()
    }

    /// Returns k(z): a sine and a Bessel series, which is what a filter costs.
    fn kernel(&self, z: f64) -> f64 {
        #[cfg(test)]
        EVALUATIONS.set(EVALUATIONS.get() + 1);
        CUT_OFF * sinc(CUT_OFF * z) * self.window.at(z / self.half_length)
    }

    /// Returns the distance at which the filter has ended.
    pub fn reach(&self) -> f64 {
        self.half_length + (self.droop.len() - 1) as f64 / 2.0
    }
}

/// Values of a [`Filter`] on a grid, between which a polynomial of degree 9 runs.
///
/// It costs some thousand evaluations of the kernel, whatever the rates; a tap costs none.
#[derive(Debug)]
pub struct FilterTable {
    /// h(i / [`GRID`]) from i = 1 − [`POINTS`]/2 on, until it has ended.
    values: Vec<f64>,
    /// The distance up to which no polynomial runs over an end of the window, where h jumps.
    smooth: f64,
}

/// Points of the table per sample of the lower rate. Even, so that the droop's shifts of half a
/// sample stay on the grid.
const GRID: usize = 32;
/// Points that a polynomial runs through.
const POINTS: usize = 10;
const BEFORE: usize = POINTS / 2 - 1;
/// Largest difference between a table's h and [`Filter::at`] where h is smooth.
///
/// h has no frequency above half a cycle per sample, so that its 10th derivative is below π¹⁰/11;
/// times (1/32)¹⁰ and the largest Π(t − i)/10! of 2.4·10⁻⁴ that is 2·10⁻¹⁵. Rounding comes to as much.
pub const TABLE_ERROR: f64 = 1e-14;
/// The same where it is not: a window ends at 1/I₀(β) < 2·10⁻⁵ of a kernel that is below 1/(97π).
#[cfg(test)]
pub const JUMP_ERROR: f64 = 2e-8;

impl FilterTable {
    pub fn new(filter: &Filter) -> Self {
        let n_shifts = filter.droop.len() - 1;
        let per_shift = GRID / 2;
        // Further than the filter reaches there are zeros only.
        let n = (filter.reach() * GRID as f64).ceil() as usize + POINTS;
        let kernel: Vec<f64> =
            (0..n + n_shifts * per_shift).map(|i| filter.kernel(i as f64 / GRID as f64)).collect();
        let value =
            |i: isize| filter.with_droop(|j| kernel[(i + j * per_shift as isize).unsigned_abs()]);
        let first_end = filter.half_length - n_shifts as f64 / 2.0;
        Self {
            values: (-(BEFORE as isize)..n as isize).map(value).collect(),
            smooth: first_end - POINTS as f64 / 2.0 / GRID as f64,
        }
    }

    /// Returns whether h(z) is good to [`TABLE_ERROR`].
    pub fn is_smooth_at(&self, z: f64) -> bool {
        z.abs() < self.smooth
    }

    /// Returns h(z).
    pub fn at(&self, z: f64) -> f64 {
        let position = z.abs() * GRID as f64;
        let whole = position.floor();
        let Some(values) =
            self.values.get(whole as usize..).and_then(|v| v.first_chunk::<POINTS>())
        else {
            return 0.0;
        };
        // Lagrange's formula at t, with the points at 0 … 9: Σ y_i Π_{j≠i} (t − j)/(i − j).
        let t = position - whole + BEFORE as f64;
        let mut above = [1.0; POINTS + 1];
        for i in (0..POINTS).rev() {
            above[i] = above[i + 1] * (t - i as f64);
        }
        let (mut below, mut sum) = (1.0, 0.0);
        for (i, (value, factor)) in values.iter().zip(&LAGRANGE).enumerate() {
            sum += value * factor * (below * above[i + 1]);
            below *= t - i as f64;
        }
        sum
    }
}

/// 1/Π_{j≠i} (i − j) = (−1)^(9−i) / (i! (9 − i)!).
const LAGRANGE: [f64; POINTS] = {
    let mut factors = [0.0; POINTS];
    let mut i = 0;
    while i < POINTS {
        let (mut product, mut j) = (1.0, 0);
        while j < POINTS {
            if j != i {
                product *= i as f64 - j as f64;
            }
            j += 1;
        }
        factors[i] = 1.0 / product;
        i += 1;
    }
    factors
};

#[cfg(test)]
thread_local! {
    /// How often this thread evaluated a kernel.
    pub static EVALUATIONS: std::cell::Cell<u64> = const { std::cell::Cell::new(0) };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_table_is_its_filter() {
        for (rate_hz, up, down) in [
            (22_050, 2, 1),
            (32_000, 441, 320),
            (8_000, 441, 80),
            (48_000, 147, 160),
            (192_000, 147, 640),
        ] {
            let filter = Filter::new(rate_hz, up, down);
            let table = FilterTable::new(&filter);
            // Both signs, whole numbers, the ends and beyond; 0.377 shares no factor with the grid.
            let end = filter.reach() + 3.0;
            assert!(table.is_smooth_at(filter.reach() - 9.0));
            let steps = (0..).map(|i| -end + 0.0377 * f64::from(i)).take_while(|z| *z < end);
            for z in steps.chain((-120..120).map(|i| f64::from(i) / 2.0)).chain([filter.reach()]) {
                let (found, exact) = (table.at(z), filter.at(z));
                let limit = if table.is_smooth_at(z) { TABLE_ERROR / 2.0 } else { JUMP_ERROR };
                assert!((found - exact).abs() < limit, "{rate_hz} Hz, {z}: {found} {exact}");
            }
        }
    }
}
