//! Where two windows of a track share frames: both are brought to one motion there.
//!
//! Every window stands where its own first frame stands, over the origin and facing +Z, because that is
//! what networks are trained on. What two neighbours share is therefore the same motion only after the
//! earlier one's part is placed like a window of its own.

use ndarray::{Array2, ArrayView2, s};

use crate::motion::blend::{align_signs, blend};
use crate::motion::{Layout, Placement};

/// Makes a window and the next agree on what they share; both in metres, `[T, columns]`.
///
/// The shared frames become a blend that begins as the earlier window and ends as the later one, seen from
/// the later window in it and from the earlier one in that. `shift` frames of the earlier window come
/// before the later one's first.
pub fn agree(layout: Layout, earlier: &mut Array2<f32>, later: &mut Array2<f32>, shift: usize) {
    let (shared, placement) = blended(layout, earlier.view(), later.view(), shift);
    later.slice_mut(s![..shared.nrows(), ..]).assign(&shared);
    let mut back = shared;
    placement.restore_in(layout, &mut back);
    let sign_of = earlier.slice(s![shift..shift + 1, ..]).to_owned();
    align_signs(layout, sign_of.view(), &mut back.view_mut());
    earlier.slice_mut(s![shift.., ..]).assign(&back);
}

/// Brings the beginning of a window to the end of one that does not change any more.
pub fn follow(layout: Layout, earlier: ArrayView2<f32>, later: &mut Array2<f32>, shift: usize) {
    let (shared, _) = blended(layout, earlier, later.view(), shift);
    later.slice_mut(s![..shared.nrows(), ..]).assign(&shared);
}

/// Returns the frames that two windows share, placed as the later one is, and where the earlier one has
/// the first of them.
fn blended(
    layout: Layout,
    earlier: ArrayView2<f32>,
    later: ArrayView2<f32>,
    shift: usize,
) -> (Array2<f32>, Placement) {
    let mut a = earlier.slice(s![shift.., ..]).to_owned();
    let placement = Placement::of_first_in(layout, a.view()).unwrap_or_default();
    placement.remove_in(layout, &mut a);
    let n = a.nrows().min(later.nrows());
    (cross_fade(layout, a.slice(s![..n, ..]), later.slice(s![..n, ..])), placement)
}

/// Fades one motion into another, `[T, columns]` each: all of the first at the first frame, all of the second
/// behind the last.
///
/// The weight is 3u² − 2u³, u = t / T, so that both ends join smoothly.
pub fn cross_fade(layout: Layout, a: ArrayView2<f32>, b: ArrayView2<f32>) -> Array2<f32> {
    let n = a.nrows();
    blend(layout, a, b, |t| {
        let u = t as f64 / n.max(1) as f64;
        u * u * (3.0 - 2.0 * u)
    })
}

/// Puts the windows of a track one after another, as they are finished.
#[derive(Debug)]
pub struct Joiner {
    layout: Layout,
    /// The frames of the latest window that the next one has too, where they lie in the world.
    shared: Option<Array2<f32>>,
}

impl Joiner {
    /// Begins with a track that stands at the origin and faces +Z.
    pub fn new(layout: Layout) -> Self {
        Self { layout, shared: None }
    }

    /// Takes the next window; returns its first `n_final` frames, which no later window changes, in the world: those
    /// before the first of the window behind it, or all of the last window.
    pub fn push(&mut self, mut window: Array2<f32>, n_final: usize) -> Array2<f32> {
        if let Some(shared) = self.shared.take() {
            let layout = self.layout;
            let own = Placement::of_first_in(layout, window.view()).unwrap_or_default();
            own.remove_in(layout, &mut window);
            let place = Placement::of_first_in(layout, shared.view()).unwrap_or_default();
            place.restore_in(layout, &mut window);
            align_signs(layout, shared.view(), &mut window.view_mut());
            let n = shared.nrows().min(window.nrows());
            let blend = cross_fade(layout, shared.slice(s![..n, ..]), window.slice(s![..n, ..]));
            window.slice_mut(s![..n, ..]).assign(&blend);
        }
        self.shared = Some(window.slice(s![n_final.., ..]).to_owned());
        window.slice(s![..n_final, ..]).to_owned()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::generation::walk::walk;
    use crate::generation::windows::Windows;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::{BODY, Channel, MOTION_DIM};
    use ndarray::{Axis, concatenate};

    fn windows_of(track: &Array2<f32>, windows: &Windows) -> Vec<Array2<f32>> {
        let cut = |i: usize| {
            let mut window = track.slice(s![windows.frames(i), ..]).to_owned();
            Placement::of_first(window.view()).expect("frames").remove(&mut window);
            window
        };
        (0..windows.len()).map(cut).collect()
    }

    fn same(a: &Array2<f32>, b: &Array2<f32>, tolerance: f32) {
        assert_eq!(a.dim(), b.dim());
        for ((t, i), x) in a.indexed_iter() {
            // One rotation has two quaternions.
            let quaternion = Channel::Quaternion.range();
            let sign = |m: &Array2<f32>| m[[t, quaternion.start]].signum();
            let y = if quaternion.contains(&i) { b[[t, i]] * sign(a) * sign(b) } else { b[[t, i]] };
            assert!((x - y).abs() <= tolerance, "channel {i} at {t}: {x} and {y}");
        }
    }

    #[test]
    fn windows_of_a_motion_are_joined_to_that_motion() {
        let track = walk(431);
        for (length, overlap) in [(120, 30), (97, 1), (64, 40)] {
            let windows = Windows::new(431, length, overlap);
            let mut joiner = Joiner::new(BODY);
            let mut parts: Vec<Array2<f32>> = Vec::new();
            for (i, window) in windows_of(&track, &windows).into_iter().enumerate() {
                let part = joiner.push(window, windows.n_final(i));
                assert_eq!(part.nrows(), windows.n_final(i));
                parts.push(part);
            }
            let views: Vec<_> = parts.iter().map(|part| part.view()).collect();
            let joined = concatenate(Axis(0), &views).expect("of 25 channels");
            // Placements are found anew at every seam, each off by the rounding of 10 m; accelerations
            // are up to 5 m/s².
            same(&joined, &track, 5e-5);
        }
    }

    #[test]
    fn windows_that_agree_stay_as_they_are() {
        let track = walk(200);
        let windows = Windows::new(200, 120, 30);
        let cut = windows_of(&track, &windows);
        let (mut a, mut b) = (cut[0].clone(), cut[1].clone());
        agree(BODY, &mut a, &mut b, windows.shift(1));
        // Rounding of numbers up to 5, turned there and back.
        same(&a, &cut[0], 1e-5);
        same(&b, &cut[1], 1e-5);
        follow(BODY, a.view(), &mut b, windows.shift(1));
        same(&b, &cut[1], 1e-5);
    }

    #[test]
    fn windows_that_disagree_meet() {
        let track = walk(200);
        let windows = Windows::new(200, 120, 30);
        let shift = windows.shift(1);
        let cut = windows_of(&track, &windows);
        let (mut a, mut b) = (cut[0].clone(), cut[1].clone());
        b.column_mut(1).mapv_inplace(|y| y + 0.3);
        b.column_mut(16).mapv_inplace(|x| (x + 0.9).fract());
        agree(BODY, &mut a, &mut b, shift);
        let n = 120 - shift;
        assert_eq!(
            a[[shift, 1]],
            cut[0][[shift, 1]],
            "the first shared frame is the earlier one's"
        );
        for t in 0..n {
            let u = t as f64 / n as f64;
            let w = (u * u * (3.0 - 2.0 * u)) as f32;
            let expected = cut[0][[shift + t, 1]] + 0.3 * w;
            assert!(
                (a[[shift + t, 1]] - expected).abs() < 1e-5 && (b[[t, 1]] - expected).abs() < 1e-5
            );
            // A tenth of a bar back, not nine tenths on.
            let expected = (cut[0][[shift + t, 16]] - 0.1 * w).rem_euclid(1.0);
            let off = (b[[t, 16]] - expected).abs();
            assert!(!(1e-5..=1.0 - 1e-5).contains(&off), "{t}: {} for {expected}", b[[t, 16]]);
        }
        assert_eq!(a.slice(s![..shift, ..]), cut[0].slice(s![..shift, ..]));
        assert_eq!(b.slice(s![n.., ..]), {
            let mut rest = cut[1].slice(s![n.., ..]).to_owned();
            rest.column_mut(1).mapv_inplace(|y| y + 0.3);
            rest.column_mut(16).mapv_inplace(|x| (x + 0.9).fract());
            rest
        });
    }

    #[test]
    fn windows_of_the_root_alone_are_joined_as_within_a_body() {
        let columns: Vec<usize> = (0..6).chain(9..16).collect();
        let root_of = |frames: &Array2<f32>| frames.select(Axis(1), &columns);
        let track = walk(300);
        let windows = Windows::new(300, 120, 30);
        let mut both = [Joiner::new(BODY), Joiner::new(ROOT)];
        for (i, window) in windows_of(&track, &windows).into_iter().enumerate() {
            let root = both[1].push(root_of(&window), windows.n_final(i));
            assert_eq!(root, root_of(&both[0].push(window, windows.n_final(i))));
        }
        let cut = windows_of(&track, &windows);
        let (mut a, mut b) = (root_of(&cut[0]), root_of(&cut[1]));
        agree(ROOT, &mut a, &mut b, windows.shift(1));
        let off = |x: &Array2<f32>, y: Array2<f32>| {
            x.iter().zip(&y).map(|(x, y)| (x - y).abs()).fold(0.0, f32::max)
        };
        // Rounding of numbers up to 5, turned there and back.
        assert!(off(&a, root_of(&cut[0])) < 1e-5 && off(&b, root_of(&cut[1])) < 1e-5);
    }

    #[test]
    fn estimates_without_a_length_are_blended_as_numbers() {
        let (a, b) = (Array2::zeros((3, MOTION_DIM)), Array2::from_elem((3, MOTION_DIM), 0.5));
        let blend = cross_fade(BODY, a.view(), b.view());
        assert!(blend.iter().all(|x| x.is_finite()));
        assert_eq!((blend[[0, 9]], blend[[0, 3]]), (0.0, 0.0));
    }
}
