//! The expected values of metrics, which `tests/golden/metrics/make.py` writes.

use std::collections::BTreeMap;

use motiongen::evaluation::body::poses;
use motiongen::evaluation::geometric::GeometricThresholds;
use motiongen::evaluation::window_range::WindowRange;
use motiongen::motion::rates::MotionRange;
use motiongen::motion::{MOTION_DIM, Poses};
use ndarray::Array2;
use serde::Deserialize;

#[derive(Deserialize)]
pub struct Golden {
    pub motions: Vec<MotionRow>,
    pub thresholds: GeometricThresholds,
    pub training_range: MotionRange,
    pub locking: LockingRows,
    /// Rotations, and the coefficient on the constructed coupling at each.
    pub coupling: Vec<[f64; 2]>,
    pub postures: Vec<PostureRow>,
    pub window_range: WindowRange,
    pub channels: Vec<f64>,
    pub features: FeatureRows,
    pub control: ControlRows,
    pub intervals: IntervalRows,
}

#[derive(Deserialize)]
pub struct MotionRow {
    pub n_frames: usize,
    pub frames: Vec<f32>,
    pub music_s: Vec<f64>,
    pub bar_frames: f64,
    pub first_frame: f64,
    pub seed: u64,
    pub checks: BTreeMap<String, f64>,
    pub beats: BeatRows,
    pub phases: BTreeMap<String, f64>,
    pub axes: Vec<f64>,
    pub axes_compat: Vec<f64>,
    pub markers: Vec<f64>,
    pub markers_compat: Vec<f64>,
    pub geometric: Vec<f64>,
    pub consistency: BTreeMap<String, f64>,
}

#[derive(Deserialize)]
pub struct BeatRows {
    pub motion_beats: Vec<usize>,
    pub n_music_beats: usize,
    pub motion_to_music: Vec<BeatRow>,
    pub music_to_motion: Vec<BeatRow>,
}

#[derive(Deserialize)]
pub struct BeatRow {
    pub score: f64,
    pub chance: f64,
    pub lift: f64,
    pub z: f64,
}

#[derive(Deserialize)]
pub struct LockingRows {
    pub ratios: Vec<f64>,
    pub alone: LockingRow,
    pub together: LockingRow,
    pub mistimed: LockingRow,
}

#[derive(Deserialize)]
pub struct LockingRow {
    pub r2: f64,
    pub wrong_mean: f64,
    pub effect: f64,
    pub wrong_share: f64,
}

#[derive(Deserialize)]
pub struct PostureRow {
    pub speed_m_s: f64,
    pub turn_rate_rad_s: f64,
    pub tilt_rad: f64,
    pub lowest_m: f64,
    pub highest_m: f64,
    pub turning_rad_s: f64,
    pub jerk_m_s3: f64,
    pub axis_speed_m_s: [f64; 3],
}

#[derive(Deserialize)]
pub struct FeatureRows {
    pub truth: Vec<Vec<f64>>,
    pub other: Vec<Vec<f64>>,
    pub flat: Vec<Vec<f64>>,
    pub mean: Vec<f64>,
    pub deviation: Vec<f64>,
    pub covariance: Vec<Vec<f64>>,
    pub frechet: f64,
    pub frechet_raw: f64,
    pub frechet_flat: f64,
    pub mean_distance: f64,
    pub diversity: f64,
    pub diversity_all: f64,
    pub conditions: Vec<Vec<Vec<f64>>>,
    pub multimodality: f64,
}

#[derive(Deserialize)]
pub struct ControlRows {
    pub samples: Vec<SampleRow>,
    pub position: Vec<ControlRow>,
    pub rotation: Vec<ControlRow>,
    /// Mean over keyframes, and over the means of samples, s.
    pub timing: [f64; 2],
}

#[derive(Deserialize)]
pub struct SampleRow {
    pub at: Vec<usize>,
    pub position: Vec<[f64; 3]>,
    pub quaternion: Vec<[f64; 4]>,
    pub mm: Vec<f64>,
    pub deg: Vec<f64>,
    pub timing_s: Vec<f64>,
}

#[derive(Deserialize)]
pub struct ControlRow {
    pub threshold: f64,
    pub trajectory: f64,
    pub location: f64,
    pub location_by_sample: f64,
    pub mean: f64,
    pub mean_by_sample: f64,
}

#[derive(Deserialize)]
pub struct IntervalRows {
    pub values: Vec<f64>,
    pub clusters: Vec<usize>,
    pub mean: [f64; 3],
    pub clustered: [f64; 3],
    pub share: [f64; 3],
    pub clustered_share: [f64; 3],
    pub jackknife_of_pairs: [f64; 3],
    pub p_greater: f64,
}

pub fn golden() -> Golden {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/golden/metrics/metrics.json");
    let text = std::fs::read_to_string(path).expect("the golden file");
    serde_json::from_str(&text).expect("what make.py writes")
}

impl MotionRow {
    pub fn frames(&self) -> Array2<f32> {
        Array2::from_shape_vec((self.n_frames, MOTION_DIM), self.frames.clone()).expect("T × 25")
    }

    pub fn poses(&self) -> Poses {
        poses(self.frames().view()).expect("finite")
    }

    pub fn bars(&self) -> Vec<f64> {
        (0..self.n_frames).map(|t| (t as f64 + self.first_frame) / self.bar_frames).collect()
    }

    pub fn column(&self, i: usize) -> Vec<f64> {
        self.frames().column(i).iter().map(|&x| f64::from(x)).collect()
    }
}
