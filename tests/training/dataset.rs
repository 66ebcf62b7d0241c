//! A dataset of phrases that are at hand.

use motiongen::training::{Dataset, Split};
use ndarray::Array2;

fn frames(n: usize, width: usize, first: f32) -> Array2<f32> {
    Array2::from_shape_fn((n, width), |(t, i)| first + (t * width + i) as f32)
}

#[test]
fn phrases_at_hand_are_read_back_in_order_of_name() {
    let of = |last: f32| {
        let phrases = [
            ("b", Split::Train, frames(7, 25, 0.5), frames(8, 163, last)),
            ("a", Split::Validation, frames(5, 25, 1.5), frames(4, 163, 2.5)),
        ];
        Dataset::in_memory(phrases).expect("memory")
    };
    let dataset = of(3.5);
    let [a, b] = dataset.phrases() else { panic!("two phrases") };
    assert_eq!((&*a.id, a.split, a.n_frames), ("a", Split::Validation, 4));
    assert_eq!((&*b.id, b.split, b.n_frames), ("b", Split::Train, 7));
    assert_eq!(dataset.motion(b, 2, 3).expect("frames"), frames(3, 25, 50.5));
    assert_eq!(dataset.features(b, 1, 6).expect("frames"), frames(6, 163, 166.5));
    assert_eq!(dataset.motion(a, 0, 4).expect("frames"), frames(4, 25, 1.5));
    assert_eq!(dataset.fingerprint(), of(3.5).fingerprint());
    assert_ne!(dataset.fingerprint(), of(4.5).fingerprint());
}
