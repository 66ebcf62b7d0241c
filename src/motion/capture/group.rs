//! From captures of several dancers to trajectories in one frame of reference, so that formations survive.
//!
//! What is found for each dancer of a take alone is found once for the group: the axis that is up, the length of
//! the pose that is cut off at the start, and the origin. The centre of the dancers' first positions comes over
//! the origin, the lowest floor of any dancer to 0.

use super::account::{CaptureAccount, CaptureNote};
use super::take::Take;
use super::track::{RigidTrack, up_of};
use super::upright::Axis;
use super::{CaptureError, trajectory_of};
use crate::motion::bvh::Bvh;
use crate::motion::dancers::{Dancers, DancersError};
use crate::motion::phase::Beats;

/// Units of length that differ by less than this share are one unit.
const UNIT_TOLERANCE: f64 = 1e-6;

/// The converted takes of a group.
#[derive(Clone, Debug, PartialEq)]
pub struct GroupCapture {
    pub dancers: Dancers,
    /// What holds for all of them; notes on one dancer name it.
    pub account: CaptureAccount,
}

/// Converts the captures of a group's dancers as [`super::convert_capture`] does that of a soloist, and keeps where
/// they stand to each other; one capture is a soloist's.
///
/// Errors: [`CaptureError`].
pub fn convert_captures(
    captures: &[Bvh],
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<GroupCapture, CaptureError> {
    let takes = captures.iter().map(|bvh| {
        let (take, mut account) = Take::of(bvh, up)?;
        let notes = bvh.notes().iter().map(|note| CaptureNote::Text(note.to_string()));
        account.notes.splice(0..0, notes);
        Ok((take, account))
    });
    group_of(takes.collect::<Result<_, CaptureError>>()?, beats, Vec::new())
}

/// Converts the tracks of a group's dancers as [`super::convert_track`] does that of a soloist, and keeps where they
/// stand to each other; one track is a soloist's.
///
/// Errors: [`CaptureError`].
pub fn convert_tracks(
    tracks: &[RigidTrack],
    beats: Option<&Beats>,
    up: Option<Axis>,
) -> Result<GroupCapture, CaptureError> {
    let mut notes = Vec::new();
    let up = match (up, tracks) {
        (None, [first, _, ..]) => {
            // One dancer may lie on the floor: all of them tell which axis is up.
            let orientation = tracks.iter().flat_map(|t| &t.orientation).copied().collect();
            let all = RigidTrack { orientation, ..first.clone() };
            Some(up_of(&all, &mut notes)?)
        }
        _ => up,
    };
    let takes = tracks.iter().map(|track| Take::of_track(track, up));
    group_of(takes.collect::<Result<_, CaptureError>>()?, beats, notes)
}

fn group_of(
    mut takes: Vec<(Take, CaptureAccount)>,
    beats: Option<&Beats>,
    notes: Vec<CaptureNote>,
) -> Result<GroupCapture, CaptureError> {
    let account = joined(&takes, notes)?;
    let longest_cut_s = takes.iter().map(|(_, account)| account.cut_s).fold(0.0, f64::max);
    for (take, account) in &mut takes {
        take.drop_start(longest_cut_s - account.cut_s);
    }
    let mut takes: Vec<Take> = takes.into_iter().map(|(take, _)| take).collect();
    let is_group = takes.len() > 1;
    if is_group {
        // Before the origin is taken, as of a soloist; each take is long enough to be filtered.
        for take in &mut takes {
            take.resampling_grid()?;
            take.smooth();
        }
    }
    let origin_m = is_group.then(|| origin_of(&takes));
    let trajectories = takes.into_iter().map(|take| trajectory_of(take, beats, origin_m));
    let trajectories = trajectories.collect::<Result<_, _>>()?;
    let dancers = Dancers::new(trajectories).map_err(CaptureError::Dancers)?;
    Ok(GroupCapture { dancers, account: CaptureAccount { cut_s: longest_cut_s, ..account } })
}

/// Returns where the centre of the dancers' first positions is on the floor; takes that this program wrote stay
/// where they are.
fn origin_of(takes: &[Take]) -> [f64; 3] {
    if takes.iter().all(|take| take.is_own) {
        return [0.0; 3];
    }
    let n = takes.len().max(1) as f64;
    let mean = |axis: usize| {
        takes.iter().map(|take| take.nodes[axis].first().copied().unwrap_or(0.0)).sum::<f64>() / n
    };
    let grounds = takes.iter().filter(|take| !take.is_root_alone).map(Take::ground);
    let ground = grounds.fold(f64::INFINITY, f64::min);
    [mean(0), if ground.is_finite() { ground } else { 0.0 }, mean(2)]
}

/// Returns one account of all dancers, whose captures share axis and unit.
fn joined(
    takes: &[(Take, CaptureAccount)],
    mut notes: Vec<CaptureNote>,
) -> Result<CaptureAccount, CaptureError> {
    let Some((_, first)) = takes.first() else {
        return Err(CaptureError::Dancers(DancersError::Count { n_dancers: 0 }));
    };
    for (dancer, (_, account)) in takes.iter().enumerate() {
        if account.up != first.up {
            return Err(CaptureError::GroupUp { dancer, up: account.up, first: first.up });
        }
        if (account.unit_m / first.unit_m - 1.0).abs() > UNIT_TOLERANCE {
            let (unit_m, first_m) = (account.unit_m, first.unit_m);
            return Err(CaptureError::GroupUnit { dancer, unit_m, first_m });
        }
    }
    for (dancer, (_, account)) in takes.iter().enumerate() {
        for note in &account.notes {
            let is_of_all = takes.iter().all(|(_, other)| other.notes.contains(note));
            if !is_of_all {
                notes.push(CaptureNote::Text(format!("dancer {dancer}: {note}")));
            } else if !notes.contains(note) {
                notes.push(note.clone());
            }
        }
    }
    Ok(CaptureAccount { notes, ..first.clone() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::capture::tests::post;
    use crate::motion::capture::{convert_capture, convert_track};
    use crate::motion::quaternion::from_axis_angle;

    /// A body at 60 Hz that walks along +Z at 0.5 m/s from a place, upright, or lying on its side.
    fn track(start: [f64; 3], n: usize, is_lying: bool) -> RigidTrack {
        let side = from_axis_angle([1.0, 0.0, 0.0], std::f64::consts::FRAC_PI_2);
        RigidTrack {
            format: "test",
            root: "pelvis".to_owned(),
            rate_hz: 60.0,
            up: None,
            unit_m: 1.0,
            position_m: (0..n)
                .map(|t| [start[0], start[1], start[2] + 0.5 * t as f64 / 60.0])
                .collect(),
            orientation: vec![if is_lying { side } else { [1.0, 0.0, 0.0, 0.0] }; n],
            points_m: Vec::new(),
            height_m: None,
            is_keyframed: true,
            notes: vec!["of the file".to_owned()],
        }
    }

    fn places(group: &GroupCapture, frame: usize) -> Vec<[f32; 3]> {
        let place = |dancer: &crate::motion::Trajectory| {
            let row = dancer.view().row(frame).to_vec();
            [row[0], row[1], row[2]]
        };
        group.dancers.trajectories().iter().map(place).collect()
    }

    #[test]
    fn dancers_keep_their_places_to_each_other_around_the_origin() {
        let tracks =
            [[4.0, 0.9, 1.0], [6.0, 0.95, 2.0], [9.5, 0.8, -4.5]].map(|p| track(p, 61, false));
        let group = convert_tracks(&tracks, None, None).expect("a group");
        assert_eq!((group.dancers.n_dancers(), group.dancers.n_frames()), (3, 29));
        // The mean of the first places is (6.5, -0.5); heights are as the file says.
        let expected = [[-2.5, 0.9, 1.5], [-0.5, 0.95, 2.5], [3.0, 0.8, -4.0]];
        for frame in [0, 12, 28] {
            for (found, expected) in places(&group, frame).into_iter().zip(expected) {
                let z = expected[2] + 0.5 * frame as f32 / 30.0;
                for (found, expected) in found.into_iter().zip([expected[0], expected[1], z]) {
                    assert!((found - expected).abs() < 1e-5, "frame {frame}: {found} {expected}");
                }
            }
        }
        let notes: Vec<String> = group.account.notes.iter().map(ToString::to_string).collect();
        assert_eq!(notes, ["of the file"]);
    }

    #[test]
    fn one_dancer_is_converted_as_a_soloist() {
        let solo = track([4.0, 0.9, 1.0], 61, false);
        let group = convert_tracks(std::slice::from_ref(&solo), None, None).expect("a group");
        let expected = convert_track(&solo, None, None).expect("a soloist");
        assert_eq!(group.dancers.trajectories(), [expected.trajectory]);
        assert_eq!(group.account, expected.account);
        let rows: Vec<[f64; 6]> =
            (0..40).map(|t| [0.02 * f64::from(t), 1.0, 3.0, 0.0, 0.0, 0.0]).collect();
        let bvh = post(30.0, &rows);
        let group = convert_captures(std::slice::from_ref(&bvh), None, None).expect("a group");
        let expected = convert_capture(&bvh, None, None).expect("a soloist");
        assert_eq!(group.dancers.trajectories(), [expected.trajectory]);
        assert_eq!(group.account, expected.account);
    }

    #[test]
    fn who_lies_on_the_floor_does_not_turn_the_room() {
        let tracks = [
            track([0.0, 0.9, 0.0], 61, false),
            track([2.0, 0.2, 0.0], 61, true),
            track([4.0, 0.9, 0.0], 61, false),
            track([6.0, 0.9, 0.0], 61, false),
            track([8.0, 0.9, 0.0], 61, false),
        ];
        let group = convert_tracks(&tracks, None, None).expect("a group");
        assert_eq!(group.account.up, Axis::Y);
        assert_eq!(places(&group, 0)[1], [-2.0, 0.2, 0.0]);
    }

    #[test]
    fn captures_share_a_floor_and_what_is_cut_off() {
        let rows = |x: f64, z: f64, jump: usize| -> Vec<[f64; 6]> {
            let row = |t: usize| {
                let away = if t < jump { 5.0 } else { 0.0 };
                [x + 0.01 * t as f64 + away, 1.0, z, 0.0, 0.0, 0.0]
            };
            (0..61).map(row).collect()
        };
        let captures = [post(30.0, &rows(1.0, 0.0, 0)), post(30.0, &rows(4.0, 2.0, 4))];
        let group = convert_captures(&captures, None, None).expect("a group");
        // Four frames of the second are a pose that it jumps out of; they are cut off the first, too.
        assert!((group.account.cut_s - 4.0 / 30.0).abs() < 1e-6, "{}", group.account.cut_s);
        assert_eq!(group.dancers.n_frames(), 55);
        let found = places(&group, 30);
        for (axis, expected) in [3.0, 0.0, 2.0].into_iter().enumerate() {
            let apart = found[1][axis] - found[0][axis];
            assert!((apart - expected).abs() < 1e-4, "{found:?}");
        }
        // The foot is at 0, the root a metre above.
        assert!((found[0][1] - 1.0).abs() < 1e-4, "{found:?}");
        let notes: Vec<String> = group.account.notes.iter().map(ToString::to_string).collect();
        assert_eq!(
            notes,
            ["dancer 1: the first 4 frames (0.13 s) are cut, a pose that the body jumps out of"]
        );
    }

    #[test]
    fn captures_that_do_not_go_together_are_refused() {
        let metres: Vec<[f64; 6]> =
            (0..31).map(|t| [0.02 * f64::from(t), 1.0, 0.0, 0.0, 0.0, 0.0]).collect();
        let refused = |others: &[[f64; 6]]| {
            let captures = [post(30.0, &metres), post(30.0, others)];
            convert_captures(&captures, None, None).expect_err("no group").to_string()
        };
        assert_eq!(
            refused(&metres[..28]),
            "dancer 1 has 26 frames and dancer 0 has 29; the dancers of a group may differ by 1 frame, so cut \
             them to one length"
        );
        let error = CaptureError::GroupUnit { dancer: 2, unit_m: 0.01, first_m: 1.0 };
        assert_eq!(
            error.to_string(),
            "dancer 2 is captured in units of 0.01 m and dancer 0 in units of 1.0 m, by the lengths of their \
             bones; export all dancers of a group in one unit"
        );
        let tracks = [track([0.0; 3], 61, false), track([1.0, 0.0, 0.0], 57, false)];
        assert_eq!(
            convert_tracks(&tracks, None, None).expect_err("no group").to_string(),
            "dancer 1 has 27 frames and dancer 0 has 29; the dancers of a group may differ by 1 frame, so cut \
             them to one length"
        );
        assert_eq!(
            convert_tracks(&[], None, None).expect_err("no dancer").to_string(),
            "motion has 0 dancers, expected 1 to 16; split it into several phrases"
        );
    }
}
