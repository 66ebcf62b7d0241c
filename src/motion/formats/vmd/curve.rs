//! Between keys: Bézier curves from (0, 0) to (1, 1).

/// Halvings of the interval in which the curve's parameter lies: to 1e-12.
const N_HALVINGS: usize = 40;
/// The value of a control byte that stands for 1.
const FULL: f64 = 127.0;

/// A cubic Bézier curve of progress over time, by its two inner control points.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Curve {
    time: [f64; 2],
    progress: [f64; 2],
}

impl Curve {
    /// The curve with these control points, 127 for 1; larger bytes count as 127.
    pub fn new([x1, y1]: [u8; 2], [x2, y2]: [u8; 2]) -> Self {
        let share = |byte: u8| (f64::from(byte) / FULL).min(1.0);
        Self { time: [share(x1), share(x2)], progress: [share(y1), share(y2)] }
    }

    /// Progress at a share of the time, both in `[0, 1]`.
    pub fn at(&self, time: f64) -> f64 {
        // Times of control points within [0, 1] let time grow with the parameter.
        let (mut low, mut high) = (0.0, 1.0);
        for _ in 0..N_HALVINGS {
            let middle = (low + high) / 2.0;
            if bezier(self.time, middle) < time { low = middle } else { high = middle }
        }
        bezier(self.progress, (low + high) / 2.0)
    }
}

/// `3 (1-s)² s a + 3 (1-s) s² b + s³`.
fn bezier([a, b]: [f64; 2], s: f64) -> f64 {
    let r = 1.0 - s;
    3.0 * r * r * s * a + 3.0 * r * s * s * b + s * s * s
}

/// A key by its frame.
pub trait Keyed {
    fn frame(&self) -> u32;
}

/// Keys of one track in order of time.
#[derive(Clone, Debug)]
pub struct Keys<K>(Vec<K>);

impl<K: Keyed> Keys<K> {
    /// Sorts keys; of several at one frame the last of the file counts.
    pub fn sorted(mut keys: Vec<K>) -> Self {
        keys.reverse();
        keys.sort_by_key(Keyed::frame);
        keys.dedup_by_key(|key| key.frame());
        Self(keys)
    }

    pub fn is_empty(&self) -> bool {
        self.0.is_empty()
    }

    pub fn last_frame(&self) -> Option<u32> {
        self.0.last().map(Keyed::frame)
    }

    /// The keys around a frame with the share of the way between them; a single one before the first key,
    /// at a key and after the last.
    pub fn around(&self, frame: u32) -> Option<(&K, Option<(&K, f64)>)> {
        let next = self.0.partition_point(|key| key.frame() <= frame);
        let Some(before) = next.checked_sub(1).and_then(|i| self.0.get(i)) else {
            return self.0.first().map(|first| (first, None));
        };
        let after = self.0.get(next).filter(|_| before.frame() < frame).map(|after| {
            let way = f64::from(after.frame() - before.frame());
            (after, f64::from(frame - before.frame()) / way)
        });
        Some((before, after))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn curves_have_their_closed_forms() {
        let straight = Curve::new([20, 20], [107, 107]);
        // Both control points on the diagonal.
        for i in 0..=8 {
            let time = f64::from(i) / 8.0;
            assert!((straight.at(time) - time).abs() < 1e-11, "{time}");
        }
        // x = s³ and y = 1 - (1-s)³.
        let late = Curve::new([0, 127], [0, 127]);
        for s in [0.1, 0.35, 0.8f64] {
            let want = 1.0 - (1.0 - s).powi(3);
            assert!((late.at(s.powi(3)) - want).abs() < 1e-9, "{s}: {}", late.at(s.powi(3)));
        }
        assert_eq!(Curve::new([255, 0], [255, 255]), Curve::new([127, 0], [127, 127]));
    }

    impl Keyed for (u32, &'static str) {
        fn frame(&self) -> u32 {
            self.0
        }
    }

    #[test]
    fn the_last_of_several_keys_at_one_frame_counts() {
        let keys = Keys::sorted(vec![(9, "b"), (4, "old"), (4, "a")]);
        assert_eq!(keys.around(0), Some((&(4, "a"), None)));
        assert_eq!(keys.around(4), Some((&(4, "a"), None)));
        assert_eq!(keys.around(5), Some((&(4, "a"), Some((&(9, "b"), 0.2)))));
        assert_eq!(keys.around(9), Some((&(9, "b"), None)));
        assert_eq!(keys.around(u32::MAX), Some((&(9, "b"), None)));
        assert_eq!(Keys::<(u32, &str)>::sorted(Vec::new()).around(3), None);
    }
}
