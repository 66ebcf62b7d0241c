//! The units that cross rooms: frames, seconds, and the rate between them.

/// Motion and feature frames per second.
pub const FPS: f64 = 30.0;

/// Returns the duration of `n_frames` frames in seconds: n / FPS.
pub fn frames_to_s(n_frames: usize) -> f64 {
    n_frames as f64 / FPS
}

/// Returns the (fractional) number of frames in `duration_s` seconds: duration_s · FPS.
pub fn s_to_frames(duration_s: f64) -> f64 {
    duration_s * FPS
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_seconds_are_120_frames() {
        assert_eq!(frames_to_s(120), 4.0);
        assert_eq!(s_to_frames(4.0), 120.0);
    }
}
