//! What was asked of a motion, as the table of generations keeps it: the JSON that `--constraints` reads.

use anyhow::Context as _;
use serde_json::{Map, Value, json};

use super::constraints_file::ConstraintsRequest;
use crate::evaluation::keyframe::Keyframe;
use crate::generation::{Constraints, WantedValue};
use crate::motion::{CHANNEL_NAMES, Channel, ChannelLimits};

/// Returns all that is asked of a track, frame by frame, as a file of constraints would ask it.
pub fn text_of(constraints: &Constraints) -> String {
    let mut keyframes: Vec<Map<String, Value>> = Vec::new();
    let mut last = None;
    for (frame, wanted) in constraints.wanted() {
        if last != Some(*frame) {
            keyframes.push(Map::from_iter([("frame".to_owned(), json!(frame))]));
            last = Some(*frame);
        }
        if let Some(keyframe) = keyframes.last_mut() {
            let (name, value) = match wanted {
                WantedValue::Value { channel, value } => (CHANNEL_NAMES[*channel], json!(value)),
                WantedValue::Orientation(q) => (Channel::Quaternion.name(), json!(q)),
            };
            keyframe.insert(name.to_owned(), value);
        }
    }
    json!({ "keyframe": keyframes }).to_string()
}

/// Reads what a motion of `n_frames` was asked to do with its body: places and orientations, frame by frame.
///
/// # Errors
/// One sentence for a text that no program of this kind wrote.
pub fn keyframes_of(text: &str, n_frames: usize) -> anyhow::Result<Vec<Keyframe>> {
    let read = || ConstraintsRequest::of_text(text, true)?.of_track(n_frames, ChannelLimits::Wide);
    let constraints = read().context("its constraints cannot be read")?;
    let mut keyframes: Vec<Keyframe> = Vec::new();
    for (frame, wanted) in constraints.wanted() {
        let is_of_body = match wanted {
            WantedValue::Value { channel, .. } => Channel::Position.range().contains(channel),
            WantedValue::Orientation(_) => true,
        };
        if !is_of_body {
            continue;
        }
        if keyframes.last().is_none_or(|last| last.frame != *frame) {
            keyframes.push(Keyframe { frame: *frame, ..Keyframe::default() });
        }
        let Some(keyframe) = keyframes.last_mut() else { continue };
        match *wanted {
            WantedValue::Value { channel, value } => {
                keyframe.position_m[channel - Channel::Position.range().start] = Some(value);
            }
            WantedValue::Orientation(q) => keyframe.orientation = Some(q),
        }
    }
    Ok(keyframes)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn constraints(text: &str) -> Constraints {
        let asked = ConstraintsRequest::of_text(text, false).expect("constraints");
        asked.of_track(101, ChannelLimits::Wide).expect("constraints of a track")
    }

    const TEXT: &str = "
        [start]
        position = [0.5, 0.9, 0.0]
        heading_deg = 90.0
        [[keyframe]]
        frame = 7
        position_y = 0.1
        phase = 0.25
        [[hold]]
        from_s = 2.0
        to_s = 2.1
        velocity_x = 0.0
    ";

    #[test]
    fn what_was_asked_is_read_back_as_it_was() {
        let asked = constraints(TEXT);
        let text = text_of(&asked);
        let again = ConstraintsRequest::of_text(&text, true).expect("JSON");
        assert_eq!(again.of_track(101, ChannelLimits::Wide).expect("constraints"), asked);
        assert!(
            text.starts_with("{\"keyframe\":[{\"frame\":0,\"position_x\":0.5,\"position_y\":0.9,"),
            "{text}"
        );
    }

    #[test]
    fn keyframes_are_those_of_the_body() {
        let found = keyframes_of(&text_of(&constraints(TEXT)), 101).expect("keyframes");
        let half = 0.5_f64.sqrt();
        let orientation = found[0].orientation.expect("an orientation");
        assert!(orientation.iter().zip([half, 0.0, half, 0.0]).all(|(a, b)| (a - b).abs() < 1e-12));
        assert_eq!(found[0].position_m, [Some(0.5), Some(0.9), Some(0.0)]);
        let second = Keyframe { frame: 7, position_m: [None, Some(0.1), None], orientation: None };
        assert_eq!(found[1..], [second]);
    }

    #[test]
    fn a_text_of_another_kind_is_refused() {
        let refused = |text: &str| format!("{:#}", keyframes_of(text, 9).expect_err("refused"));
        assert!(refused("7").starts_with("its constraints cannot be read: invalid type: integer"));
        assert_eq!(
            refused(r#"{"keyframe": [{"frame": 9, "position_y": 0.0}]}"#),
            "its constraints cannot be read: a constraint on position_y is at frame 9 (0.30 s), but the track has 9 \
             frames (0.30 s); move it or leave it out"
        );
    }
}
