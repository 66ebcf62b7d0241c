//! Groups by tokens: the first dancer's plan, of which the others keep a share and draw the rest anew.
//!
//! A planner of the masked kind draws any tokens of a window given any others, so that dancers who share some of their
//! tokens need no network of their own: with all of them they dance in unison, each in its own way of carrying it out, and
//! with none each dances its own dance to the same music. Our own; the paper knows one body.

use super::planner::shuffle;
use crate::autodiff::Stream;

/// Streams of random numbers that choose tokens, one for each window, apart from those of plans.
const CHOICES: u64 = 3 << 61;

/// Returns the tokens of another dancer's plans that a dancer keeps, window by window.
///
/// Of the n tokens of a window round(s n) are kept, any as likely; those of a smaller share s are among those of a larger
/// one.
///
/// - `share`: s, in \[0, 1\]
/// - `seed`: that of the dancer who keeps them
pub fn kept_of(plans: &[Vec<u32>], share: f64, seed: u64) -> Vec<Vec<Option<u32>>> {
    let of_window = |(window, plan): (usize, &Vec<u32>)| {
        let mut order: Vec<u32> = (0..plan.len() as u32).collect();
        shuffle(&mut order, Stream::new(seed, CHOICES + window as u64));
        let n_kept = (share.clamp(0.0, 1.0) * plan.len() as f64).round() as usize;
        let mut kept = vec![None; plan.len()];
        for &n in &order[..n_kept] {
            kept[n as usize] = Some(plan[n as usize]);
        }
        kept
    };
    plans.iter().enumerate().map(of_window).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_share_of_every_window_is_kept_and_a_larger_one_has_it() {
        let plans = [(0..30).collect(), (100..123).collect(), Vec::new()];
        let kept = |share, seed| kept_of(&plans, share, seed);
        let n_kept = |kept: &[Vec<Option<u32>>]| -> Vec<usize> {
            kept.iter().map(|window| window.iter().flatten().count()).collect()
        };
        assert_eq!(n_kept(&kept(0.0, 7)), [0, 0, 0]);
        assert_eq!(n_kept(&kept(0.25, 7)), [8, 6, 0]);
        assert_eq!(n_kept(&kept(0.5, 7)), [15, 12, 0]);
        assert_eq!(n_kept(&kept(1.0, 7)), [30, 23, 0]);
        let (less, more) = (kept(0.25, 7), kept(0.5, 7));
        for ((less, more), plan) in less.iter().zip(&more).zip(&plans) {
            for ((less, more), token) in less.iter().zip(more).zip(plan) {
                assert!(less.is_none() || less == more);
                assert!(more.is_none_or(|kept| kept == *token));
            }
        }
        assert_ne!(kept(0.5, 7), kept(0.5, 8), "dancers keep different tokens");
        assert_ne!(kept(0.5, 7)[0][..23], kept(0.5, 7)[1][..], "so do windows");
    }
}
