//! The part of a file or a phrase that is drawn.

use std::ops::Range;

use anyhow::bail;

use crate::units::{frames_to_s, s_to_frames};

/// What the user asks for.
#[derive(Clone, Copy, Debug, clap::Args)]
pub struct ExcerptParams {
    /// Where the picture begins, in seconds.
    #[arg(long, value_name = "S", default_value_t = 0.0, allow_negative_numbers = true)]
    pub start: f64,
    /// Length of the excerpt, in seconds; without it, up to the end.
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    pub duration: Option<f64>,
}

impl ExcerptParams {
    /// Refuses times that no file has.
    ///
    /// # Errors
    /// One sentence.
    pub fn check(&self) -> anyhow::Result<()> {
        let Self { start, duration } = self;
        if !(start.is_finite() && *start >= 0.0) {
            bail!("--start {start} is no time in a file; give seconds from 0 on");
        }
        match duration {
            Some(s) if !(s.is_finite() && *s > 0.0) => {
                bail!("--duration {s} is not above 0; give a positive number of seconds")
            }
            _ => Ok(()),
        }
    }

    /// Returns the frames of the excerpt among `n_frames` of what is called `title`, at least one.
    ///
    /// # Errors
    /// When it begins after the end.
    pub fn frames(&self, n_frames: usize, title: &str) -> anyhow::Result<Range<usize>> {
        let nearest = |time_s: f64| s_to_frames(time_s).round() as usize;
        let first = nearest(self.start);
        if first >= n_frames {
            bail!(
                "--start {} is after the end of {title}, whose last frame of {n_frames} is at {:.2} s; \
                 begin earlier",
                self.start,
                frames_to_s(n_frames.saturating_sub(1))
            );
        }
        let length = self.duration.map_or(n_frames, nearest).max(1);
        Ok(first..first.saturating_add(length).min(n_frames))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frames(start: f64, duration: Option<f64>) -> anyhow::Result<Range<usize>> {
        let excerpt = ExcerptParams { start, duration };
        excerpt.check()?;
        excerpt.frames(121, "a")
    }

    #[test]
    fn excerpts_are_whole_frames_of_what_is_there() {
        let cases = [
            (0.0, None, 0..121),
            (1.5, Some(0.7), 45..66),
            (4.0, Some(1e300), 120..121),
            (0.0, Some(1e-9), 0..1),
        ];
        for (start, duration, wanted) in cases {
            assert_eq!(frames(start, duration).unwrap(), wanted, "{start}, {duration:?}");
        }
    }

    #[test]
    fn times_that_are_not_there_are_refused() {
        let cases = [
            (-1.0, None, "--start -1 is no time in a file; give seconds from 0 on"),
            (
                0.0,
                Some(f64::NAN),
                "--duration NaN is not above 0; give a positive number of seconds",
            ),
            (
                4.1,
                None,
                "--start 4.1 is after the end of a, whose last frame of 121 is at 4.00 s; begin \
                 earlier",
            ),
        ];
        for (start, duration, wanted) in cases {
            assert_eq!(frames(start, duration).unwrap_err().to_string(), wanted);
        }
    }
}
