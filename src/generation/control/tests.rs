use super::*;

fn value(frame: usize, channel: usize, value: f64) -> (usize, WantedValue) {
    (frame, WantedValue::Value { channel, value })
}

/// Standing at (1, 0.9, 0), facing +Z.
fn standing(n: usize) -> Array2<f32> {
    let mut frames = Array2::zeros((n, MOTION_DIM));
    frames.column_mut(0).fill(1.0);
    frames.column_mut(1).fill(0.9);
    frames.column_mut(9).fill(1.0);
    frames
}

fn constraints(wanted: Vec<(usize, WantedValue)>) -> Constraints {
    Constraints::new(wanted, 101, ChannelLimits::Wide).expect("constraints that can be kept")
}

#[test]
fn motion_passes_through_what_is_asked_and_is_left_alone_elsewhere() {
    let turned = facing(1.2);
    let asked = constraints(vec![
        value(50, 0, 2.0),
        value(57, 0, 0.5),
        (30, WantedValue::Orientation(turned)),
    ]);
    let mut frames = standing(101);
    assert!((asked.errors(frames.view())[0].error - 1.2).abs() < 1e-6);
    asked.bend(&mut frames, 0, 1.0);
    for miss in asked.errors(frames.view()) {
        // Rounding of 2 m, and of a quaternion's components.
        assert!(miss.error < 1e-6, "{miss:?}");
    }
    assert_eq!((frames[[50, 0]], frames[[57, 0]]), (2.0, 0.5));
    // Half way between two constraints 7 apart, 3.5 is not a frame: 4 of 7 frames on from the first.
    let u = 4.0_f64 / 7.0;
    let w = 1.0 - u * u * (3.0 - 2.0 * u);
    let expected = 1.0 + 1.0 * w - 0.5 * (1.0 - w);
    assert!((f64::from(frames[[54, 0]]) - expected).abs() < 1e-6, "{}", frames[[54, 0]]);
    let held = asked.held(60);
    let frames_held = |axis: usize| (0..60).filter(|t| held.position[*t][axis]).collect::<Vec<_>>();
    assert_eq!((frames_held(0), frames_held(1)), (vec![50, 57], vec![]));
    assert!((0..60).all(|t| held.orientation[t] == (t == 30)));
    let before = standing(101);
    assert_eq!(frames[[35, 0]], 1.0, "15 frames before the first nothing is left of it");
    assert_eq!(frames.row(72), before.row(72));
    assert_eq!(frames.column(1), before.column(1));
    let turn = |t: usize| 2.0 * frames[[t, 11]].atan2(frames[[t, 9]]);
    assert!((turn(30) - 1.2).abs() < 1e-6 && turn(15).abs() < 1e-6 && turn(45).abs() < 1e-6);
    assert!(turn(24) > 0.1 && turn(24) < turn(28));
}

#[test]
fn a_part_of_a_track_and_a_part_of_the_way() {
    let asked = constraints(vec![value(50, 1, 1.9), value(3, 1, 0.0)]);
    let mut frames = standing(20);
    asked.bend(&mut frames, 45, 0.25);
    assert!((frames[[5, 1]] - 1.15).abs() < 1e-6, "{}", frames[[5, 1]]);
    assert_eq!(frames[[5, 0]], 1.0);
}

#[test]
fn the_first_frame_says_where_a_track_begins() {
    let origin = Placement::default();
    assert_eq!(constraints(vec![value(9, 0, 3.0)]).placement(origin), origin);
    let asked = constraints(vec![
        value(0, 0, 3.0),
        value(0, 2, -1.0),
        (0, WantedValue::Orientation(facing(0.5))),
    ]);
    let placement = asked.placement(origin);
    assert_eq!((placement.x_m, placement.z_m), (3.0, -1.0));
    assert!((placement.yaw_rad - 0.5).abs() < 1e-12);
    // What is not asked for is as it is otherwise.
    let otherwise = Placement { x_m: 7.0, z_m: 2.5, yaw_rad: -0.25 };
    let begun = constraints(vec![value(0, 2, -1.0)]).placement(otherwise);
    assert_eq!((begun.x_m, begun.z_m), (7.0, -1.0));
    assert!((begun.yaw_rad + 0.25).abs() < 1e-12);
}

#[test]
fn what_is_asked_of_a_body_is_asked_of_one_beside_it() {
    let turned = (9, WantedValue::Orientation(facing(0.5)));
    let asked = constraints(vec![value(3, 0, 1.0), value(3, 1, 0.9), value(9, 2, 2.0), turned]);
    let moved = |x_m, z_m| asked.moved([x_m, z_m], 101, ChannelLimits::Wide);
    let beside = moved(0.5, -3.0).expect("within limits");
    assert_eq!(
        beside,
        constraints(vec![value(3, 0, 1.5), value(3, 1, 0.9), value(9, 2, -1.0), turned])
    );
    let (low, high) = (-1e9, 1e9);
    assert!(moved(high, 0.0).is_err() && moved(0.0, low).is_err());
}

#[test]
fn a_motion_is_continued_from_its_last_frames() {
    let mut before = standing(40);
    for t in 0..40 {
        before[[t, 2]] = t as f32 * 0.1;
    }
    let asked = constraints(continuing(before.view(), 7));
    let mut frames = standing(101);
    asked.bend(&mut frames, 0, 1.0);
    for t in 0..7 {
        assert_eq!(frames[[t, 2]], before[[33 + t, 2]]);
    }
    assert_eq!(asked.errors(frames.view()).len(), 28);
}

#[test]
fn constraints_that_cannot_be_kept_are_named() {
    let said = |wanted: Vec<(usize, WantedValue)>| {
        let refused = Constraints::new(wanted, 101, ChannelLimits::Wide);
        refused.expect_err("no constraints").to_string()
    };
    assert_eq!(
        said(vec![value(101, 1, 0.5)]),
        "a constraint on position_y is at frame 101 (3.37 s), but the track has 101 frames (3.37 s); move \
         it or leave it out"
    );
    assert_eq!(
        said(vec![value(7, 1, 0.5), value(8, 1, 0.5), value(7, 1, 0.75)]),
        "position_y at frame 7 must be 0.5 and 0.75 at once; keep one of the two"
    );
    assert_eq!(
        said(vec![value(7, 3, 60.0)]),
        "velocity_x at frame 7 is 60, allowed -50 to 50 m/s; correct the constraint"
    );
    assert_eq!(
        said(vec![(7, WantedValue::Orientation([1.0, 1.0, 0.0, 0.0]))]),
        "the orientation at frame 7 has length 1.4142; a quaternion has length 1"
    );
    let twice = constraints(vec![value(7, 1, 0.5), value(7, 1, 0.5)]);
    assert_eq!(twice.wanted.len(), 1);
}
