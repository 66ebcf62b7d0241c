//! Whether motions did what was asked of them, as generate wrote it down.

use super::{Motion, all_names, evaluate, locked, make_store, metrics, put, put_asked, value};
use crate::support::{Dir, rows, run};
use motiongen::store::tables::MetricRow;

/// Asks for the place of a motion at some frames, moved by so much along x, and for its orientation turned about the
/// vertical.
fn asked(motion: &Motion, at: &[(usize, f64)], turn_deg: f64) -> String {
    let half = (turn_deg / 2.0).to_radians();
    let keyframes: Vec<serde_json::Value> = at
        .iter()
        .map(|&(frame, apart_m)| {
            let [x, y, z] = [0, 1, 2].map(|i| f64::from(motion.frames[[frame, i]]));
            serde_json::json!({
                "frame": frame,
                "position_x": x + apart_m,
                "position_y": y,
                "position_z": z,
                "quaternion": [half.cos(), 0.0, half.sin(), 0.0],
            })
        })
        .collect();
    serde_json::json!({ "keyframe": keyframes }).to_string()
}

fn motions(n: usize) -> Vec<Motion> {
    let names = all_names();
    let mut all: Vec<Motion> = (0..n)
        .flat_map(|song| (0..2).map(move |sample| (song, sample)))
        .map(|(song, sample)| Motion {
            phrase: names[song].clone(),
            sample,
            frames: locked(song, sample),
        })
        .collect();
    all.sort_by(|a, b| (&a.phrase, a.sample).cmp(&(&b.phrase, b.sample)));
    all
}

#[test]
fn control_errors_are_those_of_the_motion_and_not_what_generate_says() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let all = motions(3);
    // The first sample of each song is off by 0.3 m at one of its two keyframes, the second is where it was asked to
    // be at its only one; nothing else than the row says that the largest miss was 12 mm.
    put_asked(&store, "asked", &all, &|motion| {
        let at: &[(usize, f64)] =
            if motion.sample == 0 { &[(40, 0.3), (200, 0.0)] } else { &[(90, 0.0)] };
        Some(asked(motion, at, 12.0))
    });
    let output = evaluate(&store, "asked", &[]);
    assert_eq!(output.code, 0, "{output:?}");
    let found = metrics(&store, "asked");
    let own = |metric: &str, variant: &str| {
        value(&found, ["generated", "trained_on", metric, variant]).expect("a value")
    };
    let is = |metric: &str, variant: &str, wanted: f64| {
        let value = own(metric, variant);
        assert!((value - wanted).abs() < 1e-4 * wanted.max(1.0), "{metric} {variant}: {value}");
    };
    is("control_trajectory_error", "position_200mm", 0.5);
    is("control_trajectory_error", "position_500mm", 0.0);
    is("control_location_error", "position_200mm", 1.0 / 3.0);
    is("control_location_error", "position_200mm_by_sample", 0.25);
    is("control_average_error", "position", 100.0);
    is("control_average_error", "position_by_sample", 75.0);
    is("control_average_error", "orientation", 12.0);
    is("control_trajectory_error", "orientation_10deg", 1.0);
    is("control_location_error", "orientation_30deg", 0.0);
    is("control_position", "largest", 12.0);
    assert!((0.0..=0.5).contains(&own("control_timing_error", "position")));
}

#[test]
fn a_run_that_was_asked_for_nothing_has_no_errors_of_control() {
    let dir = Dir::new();
    let store = make_store(&dir);
    put(&store, "free", &motions(2));
    assert_eq!(evaluate(&store, "free", &[]).code, 0);
    let metrics: Vec<MetricRow> = rows(&store);
    let asked =
        |row: &&MetricRow| row.metric.starts_with("control_") && row.metric.ends_with("error");
    assert!(metrics.iter().all(|row| !asked(&row)), "{metrics:?}");
}

#[test]
fn a_text_that_is_no_constraints_is_refused_with_the_motion() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let all = motions(1);
    put_asked(&store, "broken", &all, &|motion| {
        Some(if motion.sample == 0 { "{}".to_owned() } else { r#"{"keyframe": 7}"#.to_owned() })
    });
    let place = store.display().to_string();
    let output = run(["evaluate", "--quiet", "--store", &place, "--run", "broken"]);
    assert_eq!(output.code, 2, "{output:?}");
    let motion = format!("broken/{}/1", all_names()[0]);
    let expected = format!(
        "error: motion {motion}: its constraints cannot be read: invalid type: integer `7`"
    );
    assert!(output.stderr.starts_with(&expected), "{output:?}");
}
