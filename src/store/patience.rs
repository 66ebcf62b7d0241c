//! Waiting for a store that does not answer: a network that is gone for minutes must not end a night's work.

use std::time::{Duration, Instant};

use super::StoreError;

/// How long and how often to try again.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Patience {
    /// Time after which the last error is final.
    pub limit: Duration,
    /// Pause before the second try; each next one is twice as long, up to 15 s.
    pub first_pause: Duration,
}

/// The longest pause between two tries.
const LONGEST_PAUSE: Duration = Duration::from_secs(15);

impl Default for Patience {
    fn default() -> Self {
        Self { limit: Duration::from_secs(600), first_pause: Duration::from_secs(1) }
    }
}

impl Patience {
    /// Does `work` until it succeeds, fails for good, or the time is over; `notice` hears of every
    /// failure that is waited out, with the pause that follows.
    ///
    /// Comes on top of the client's own retries, which repeat single requests.
    ///
    /// # Errors
    /// The last error of `work`.
    pub fn wait_out<T>(
        self,
        mut notice: impl FnMut(&StoreError, Duration),
        mut work: impl FnMut() -> Result<T, StoreError>,
    ) -> Result<T, StoreError> {
        let started = Instant::now();
        let mut pause = self.first_pause;
        loop {
            let error = match work() {
                Err(error) if error.may_pass() => error,
                done => return done,
            };
            if started.elapsed() + pause > self.limit {
                return Err(error);
            }
            notice(&error, pause);
            std::thread::sleep(pause);
            pause = (pause * 2).min(LONGEST_PAUSE);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SHORT: Patience =
        Patience { limit: Duration::from_millis(200), first_pause: Duration::from_millis(1) };

    fn gone() -> StoreError {
        let source = std::io::Error::from(std::io::ErrorKind::TimedOut);
        StoreError::Io { action: "read", place: "x".to_owned(), source }
    }

    #[test]
    fn what_comes_back_is_waited_for() {
        let (mut n_tries, mut n_notices) = (0, 0);
        let done = SHORT.wait_out(
            |_, _| n_notices += 1,
            || {
                n_tries += 1;
                if n_tries < 4 { Err(gone()) } else { Ok(7) }
            },
        );
        assert_eq!((done.ok(), n_tries, n_notices), (Some(7), 4, 3));
    }

    #[test]
    fn what_stays_away_is_an_error_and_a_full_disk_is_one_at_once() {
        let mut n_tries = 0;
        let outcome: Result<(), _> = SHORT.wait_out(
            |_, _| (),
            || {
                n_tries += 1;
                Err(gone())
            },
        );
        assert_eq!(outcome.expect_err("gone").to_string(), "x: could not read");
        assert!(n_tries > 2, "{n_tries}");
        let source = std::io::Error::from(std::io::ErrorKind::StorageFull);
        let full = StoreError::Io { action: "write", place: "x".to_owned(), source };
        let mut full = Some(full);
        let outcome: Result<(), _> =
            SHORT.wait_out(|_, _| (), || Err(full.take().expect("tried once")));
        assert_eq!(outcome.expect_err("full").to_string(), "x: could not write");
    }
}
