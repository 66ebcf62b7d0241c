//! Groups by tokens: dancers who share a plan, each along a way of its own.

use std::path::Path;

use motiongen::motion::MOTION_DIM;
use motiongen::motion::npy::read_f32;

use super::{AUTOREGRESSIVE, MASKED, export, generate, song, store_with_tokenizer};
use crate::support::Dir;
use crate::tokens::train;

const N_FRAMES: usize = 211;

/// A motion of several dancers, frame by frame.
struct Group {
    n_dancers: usize,
    values: Vec<f32>,
}

impl Group {
    fn read(folder: &Path) -> Self {
        let bytes = std::fs::read(folder.join("song.npy")).expect("a file");
        let array = read_f32(&bytes).expect("an array");
        let n_dancers = if array.shape.len() == 3 { array.shape[0] } else { 1 };
        assert_eq!(array.shape[array.shape.len() - 2..], [N_FRAMES, MOTION_DIM]);
        Self { n_dancers, values: array.values }
    }

    fn at(&self, dancer: usize, frame: usize, channel: usize) -> f64 {
        f64::from(self.values[(dancer * N_FRAMES + frame) * MOTION_DIM + channel])
    }

    /// Least distance of two dancers on the floor, m.
    fn least_distance(&self) -> f64 {
        let mut least = f64::INFINITY;
        for i in 0..self.n_dancers {
            for j in i + 1..self.n_dancers {
                for frame in 0..N_FRAMES {
                    let apart = |axis| self.at(i, frame, axis) - self.at(j, frame, axis);
                    least = least.min(apart(0).hypot(apart(2)));
                }
            }
        }
        least
    }
}

#[test]
fn dancers_share_a_plan_and_keep_apart() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    let (audio, out) = (song(&dir), dir.at("out"));
    for (run, flags) in [("masked", &MASKED[..]), ("next", &AUTOREGRESSIVE)] {
        assert_eq!(train(&store, run, &[flags, &["--steps=60"]].concat()).code, 0);
        assert_eq!(export(&store, run, run).code, 0);
        let made = |more: &[&str]| {
            let output = generate(&store, run, &audio, &out, &[&["--format=npy"], more].concat());
            assert_eq!(output.code, 0, "{output:?}");
            Group::read(&out)
        };
        let free = made(&["--dancers=4"]);
        let alike = made(&["--dancers=4", "--consistency=1"]);
        assert_eq!((free.n_dancers, alike.n_dancers), (4, 4));
        // The plan that is shared is the first dancer's, who is left alone by it; the others are not.
        for frame in [0, 17, N_FRAMES - 1] {
            assert_eq!(free.at(0, frame, 1), alike.at(0, frame, 1), "{run}: frame {frame}");
            assert_ne!(free.at(2, frame, 1), alike.at(2, frame, 1), "{run}: frame {frame}");
        }
        // Bodies have a radius of 0.35 m; 32-bit positions round.
        assert!(free.least_distance() > 0.7 - 1e-5, "{run}: {}", free.least_distance());
        assert_eq!(made(&["--dancers=4", "--consistency=1"]).values, alike.values, "{run}");
        // The first dancer is the soloist of the same seed, elsewhere on the floor.
        let (first, soloist) = (made(&["--dancers=2", "--no-separation"]), made(&["--dancers=1"]));
        for frame in [0, 17, N_FRAMES - 1] {
            for channel in [1, 5, 12, 24] {
                let (a, b) = (first.at(0, frame, channel), soloist.at(0, frame, channel));
                assert!(
                    (a - b).abs() < 1e-4,
                    "{run}: frame {frame}, channel {channel}: {a} and {b}"
                );
            }
        }
    }
}

#[test]
fn a_group_goes_along_a_path_side_by_side() {
    let dir = Dir::new();
    let store = store_with_tokenizer(&dir);
    assert_eq!(train(&store, "plan", &MASKED).code, 0);
    assert_eq!(export(&store, "plan", "m").code, 0);
    let (audio, out) = (song(&dir), dir.at("out"));
    let path = |t: usize| [0.3 + 0.01 * t as f64, (0.05 * t as f64).sin()];
    let table: String =
        (0..N_FRAMES).step_by(5).map(|t| format!("{t},{},{}\n", path(t)[0], path(t)[1])).collect();
    let table = dir.write("path.csv", format!("frame,x,z\n{table}")).display().to_string();
    let flags = ["--format=npy", "--dancers=3", "--consistency=0.5", "--constraints", &table];
    let output = generate(&store, "m", &audio, &out, &flags);
    assert_eq!(output.code, 0, "{output:?}");
    let group = Group::read(&out);
    for dancer in 0..3 {
        let beside = [group.at(dancer, 0, 0) - path(0)[0], group.at(dancer, 0, 2) - path(0)[1]];
        for t in (0..N_FRAMES).step_by(5) {
            let error =
                |axis: usize, i: usize| (group.at(dancer, t, axis) - path(t)[i] - beside[i]).abs();
            let miss_mm = 1e3 * error(0, 0).hypot(error(2, 1));
            assert!(miss_mm < 0.01, "dancer {dancer}, frame {t}: {miss_mm} mm");
        }
    }
    // 1.6 m is the least between two places of a formation.
    let apart = group.at(0, 0, 0) - group.at(1, 0, 0);
    assert!((1.6..=2.08).contains(&apart.abs()), "{apart}");

    let mistake = |more: &[&str], code: i32, expected: &str| {
        let output = generate(&store, "m", &audio, &out, more);
        assert_eq!(output.code, code, "{output:?}");
        assert!(format!("{}{}", output.stderr, output.stdout).contains(expected), "{output:?}");
    };
    mistake(&["--dancers=17"], 2, "--dancers 17 is none of 1 to 16; make larger groups of several");
    mistake(
        &["--consistency=0.5"],
        2,
        "--consistency 0.5: one dancer of model m, of the family tokens, has nobody to share a plan with; give \
         --dancers 2 or more, or leave it out",
    );
    mistake(
        &["--dancers=2", "--consistency=-0.5"],
        2,
        "--consistency -0.5: dancers of model m, of the family tokens, share from none, 0, to all, 1, of a plan; give \
         a number from 0 to 1, or name a model of the family group",
    );
    mistake(
        &["--dancers=2", "--stream"],
        2,
        "--stream: frames of 2 dancers are not final before all have been made; leave it out, or give --dancers 1",
    );
    let far = dir.write("far.csv", "frame,x,z\n9,99.9,0\n").display().to_string();
    mistake(&["--dancers=16", "--constraints", &far], 1, "position_x at frame 9 is ");
}
