use super::*;
use crate::motion::CLOCK_DIM;
use crate::training::batch::Chances;

#[test]
fn the_clock_alone_is_withheld_by_chance() {
    let (frames, width) = (3, FEATURE_DIM + CLOCK_DIM);
    let chance = |no_clock| Chances { step: 0.5, no_audio: 1.0, no_style: 1.0, no_clock };
    let batch = Batch {
        n_windows: 2,
        n_frames: frames,
        n_slots: 1,
        n_dancers: vec![1, 1],
        motion: vec![0.0; 2 * frames * MOTION_DIM],
        audio: (0..2 * frames * width).map(|i| 1.0 + i as f32).collect(),
        mask: vec![1.0; 2 * frames],
        style: vec![0.0; 2 * STYLE_DIM],
        noise: vec![0.0; 2 * frames * MOTION_DIM],
        chances: vec![chance(0.09), chance(0.11)],
        phrase_ids: vec!["a".into(), "b".into()],
    };
    let heard = without_clock(&batch, 0.1);
    for (i, (x, given)) in heard.iter().zip(&batch.audio).enumerate() {
        let is_withheld = i < frames * width && i % width >= FEATURE_DIM;
        assert_eq!(*x, if is_withheld { 0.0 } else { *given }, "{i}");
    }
    assert!(matches!(without_clock(&batch, 0.0), Cow::Borrowed(_)));
}

#[test]
fn seeds_of_tapes_differ() {
    let mut seen: Vec<_> =
        (0..20).flat_map(|seed| (0..20).map(move |n| tape_seed(seed, n))).collect();
    seen.sort_unstable();
    seen.dedup();
    assert_eq!(seen.len(), 400);
}
