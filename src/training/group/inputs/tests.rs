use super::*;
use crate::training::batch::Chances;

#[test]
fn a_stranger_in_the_place_of_another_keeps_its_steps_and_moves_over_the_floor() {
    // One window of 3 dancers in 4 places and 5 frames, of which the last 2 are held and do not count.
    let (slots, frames) = (4, 5);
    let mask = [1.0, 1.0, 1.0, 0.0, 0.0];
    let batch = Batch {
        n_windows: 1,
        n_frames: frames,
        n_slots: slots,
        n_dancers: vec![3],
        motion: vec![0.0; slots * frames * MOTION_DIM],
        audio: vec![0.0; frames],
        mask: mask.to_vec(),
        style: vec![0.0; 8],
        noise: vec![0.0; slots * frames * MOTION_DIM],
        chances: vec![Chances { step: 0.5, no_audio: 1.0, no_style: 1.0, no_clock: 1.0 }],
        phrase_ids: vec!["one".into()],
    };
    let of_places = |i: usize| mask.iter().map(move |&w| if i < 3 { w } else { 0.0 });
    let group = GroupBatch {
        batch: &batch,
        t: vec![500],
        t_dancers: vec![500; slots],
        x_t: Vec::new(),
        audio: Cow::Borrowed(&batch.audio),
        drop_audio: vec![0.0],
        number: vec![2.0],
        z: Vec::new(),
        mask: (0..slots).flat_map(of_places).collect(),
        width: 1,
        patch_frames: 1,
        seed: 0,
    };
    // Of dancer i in frame f: x = 10 i + f², z = -3 i, and every other channel 7.
    let mut x0 = vec![7.0; slots * frames * MOTION_DIM];
    for (row, values) in x0.chunks_exact_mut(MOTION_DIM).enumerate() {
        let (dancer, frame) = ((row / frames) as f32, (row % frames) as f32);
        (values[0], values[2]) = (10.0 * dancer + frame * frame, -3.0 * dancer);
    }
    // Dancer 2 dances in the place of 0; 1 where it is; 0 in the place of 1; the fourth place is empty.
    let dancers = [(2, 0), (1, 1), (0, 1), (3, 3)].map(|(dancer, floor)| DistinctDancer {
        dancer,
        floor,
        group: 0,
    });
    let moves = group.moves(&x0, &dancers);
    // Means over the frames that count differ by 10 a dancer along x and by 3 along z; held frames move as well.
    let expected = [(-20.0, 6.0), (0.0, 0.0), (10.0, -3.0), (0.0, 0.0)];
    assert_eq!(moves.len(), slots * frames * MOTION_DIM);
    for (place, (rows, (x, z))) in moves.chunks_exact(frames * MOTION_DIM).zip(expected).enumerate()
    {
        for row in rows.chunks_exact(MOTION_DIM) {
            for (channel, &by) in row.iter().enumerate() {
                let expected = [x, 0.0, z].get(channel).copied().unwrap_or(0.0);
                assert!((by - expected).abs() < 1e-5, "place {place}, channel {channel}: {by}");
            }
        }
    }
}
