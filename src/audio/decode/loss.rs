//! What is lost of a file: frames that could not be decoded, and what its header promised.

use super::DecodeError;

/// Share of a file that may be lost within it, and the longest time.
const MAX_LOST_SHARE: f64 = 0.001;
const MAX_LOST_S: f64 = 1.0;

/// Time by which a file may end early without counting as truncated: a frame of features.
const FRAME_S: f64 = 1.0 / 30.0;

/// What a file lacks.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Loss {
    /// Whether the samples end more than a frame of features before the end that the file states.
    pub is_truncated: bool,
    /// Seconds that are missing at the end or could not be decoded.
    pub lost_s: f64,
}

/// Counts what could not be decoded, in samples at the file's rate.
#[derive(Default)]
pub(super) struct Losses {
    /// At the start, where a stream was cut out of another one.
    n_leading: u64,
    /// Between samples that were decoded, given as silence.
    n_silent: u64,
    /// Between samples that were decoded, left out.
    n_left_out: u64,
    /// At the end.
    n_trailing: u64,
    first: Option<u64>,
    is_started: bool,
}

impl Losses {
    /// Notes that a packet was decoded.
    pub fn start(&mut self) {
        self.is_started = true;
    }

    /// Counts samples, at position `at`, that were given as silence. `is_cut`: because what is
    /// before them is missing.
    pub fn silence(&mut self, n: u64, at: u64, is_cut: bool) {
        if is_cut && !self.is_started {
            self.n_leading += n;
            return;
        }
        self.n_silent += n;
        self.first.get_or_insert(at);
    }

    /// Counts samples that were left out.
    pub fn left_out(&mut self, n: u64, at: u64) {
        if n > 0 && self.is_started {
            self.n_left_out += n;
            self.first.get_or_insert(at);
        }
    }

    /// Counts samples that nothing intact follows, unless some does.
    pub fn trail(&mut self, n: u64) {
        self.n_trailing += n;
    }

    /// Refuses a loss of over a second, and with the number of samples, at the end, one of over a
    /// thousandth.
    pub fn check(
        &self,
        codec: &'static str,
        sample_rate_hz: u32,
        n_samples: Option<u64>,
    ) -> Result<(), DecodeError> {
        let seconds = |n: u64| n as f64 / f64::from(sample_rate_hz);
        let Some(first) = self.first else { return Ok(()) };
        let lost_s = seconds(self.n_silent + self.n_left_out);
        let limit_s =
            n_samples.map_or(f64::INFINITY, |n| MAX_LOST_SHARE * seconds(n + self.n_left_out));
        if lost_s > MAX_LOST_S.min(limit_s) {
            return Err(DecodeError::Lost { codec, time_s: seconds(first), lost_s });
        }
        Ok(())
    }

    /// Sums up what is lost of `n_stated` samples when `n_given` were given.
    pub fn sum(&self, n_stated: Option<u64>, n_given: u64, sample_rate_hz: u32) -> Loss {
        let seconds = |n: u64| n as f64 / f64::from(sample_rate_hz);
        let missing = n_stated.map_or(0, |n| n.saturating_sub(n_given + self.n_left_out));
        let at_end_s = seconds(missing.max(self.n_trailing));
        let within_s = seconds(self.n_leading + self.n_silent + self.n_left_out);
        let is_truncated = at_end_s > FRAME_S;
        // Less than a frame at the end is how containers round.
        Loss { is_truncated, lost_s: within_s + if is_truncated { at_end_s } else { 0.0 } }
    }
}
