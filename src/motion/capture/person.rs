//! A person who moves, written as BVH in any unit, axes and skeleton, for tests.

use std::fmt::Write as _;

use super::Axis;
use crate::motion::exchange::euler_zxy;
use crate::motion::quaternion::{
    IDENTITY, Quaternion, conj, from_axis_angle, mul, normalize, rotate,
};

type Vector = [f64; 3];

const X: Vector = [1.0, 0.0, 0.0];
const Z: Vector = [0.0, 0.0, 1.0];

/// Name, parent, and offset from it, m, +Y up and +Z forward.
const BONES: [(&str, Option<usize>, Vector); 16] = [
    ("Hips", None, [0.0; 3]),
    ("LeftUpLeg", Some(0), [0.09, 0.0, 0.0]),
    ("LeftLeg", Some(1), [0.0, -0.44, 0.0]),
    ("LeftFoot", Some(2), [0.0, -0.42, 0.0]),
    ("RightUpLeg", Some(0), [-0.09, 0.0, 0.0]),
    ("RightLeg", Some(4), [0.0, -0.44, 0.0]),
    ("RightFoot", Some(5), [0.0, -0.42, 0.0]),
    ("Spine", Some(0), [0.0, 0.25, 0.0]),
    ("Neck", Some(7), [0.0, 0.28, 0.0]),
    ("Head", Some(8), [0.0, 0.1, 0.0]),
    ("LeftArm", Some(7), [0.18, 0.22, 0.0]),
    ("LeftForeArm", Some(10), [0.28, 0.0, 0.0]),
    ("LeftHand", Some(11), [0.25, 0.0, 0.0]),
    ("RightArm", Some(7), [-0.18, 0.22, 0.0]),
    ("RightForeArm", Some(13), [-0.28, 0.0, 0.0]),
    ("RightHand", Some(14), [-0.25, 0.0, 0.0]),
];
/// Ends of bones.
const ENDS: [(usize, Vector); 5] = [
    (3, [0.0, -0.08, 0.14]),
    (6, [0.0, -0.08, 0.14]),
    (9, [0.0, 0.2, 0.0]),
    (12, [0.15, 0.0, 0.0]),
    (15, [-0.15, 0.0, 0.0]),
];

/// The action of the person.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum PersonAction {
    Walks,
    /// Sits with the legs stretched out.
    Sits,
    /// Rolls a little on the back.
    Lies,
    Crouches,
    /// Dances on the spot, the hips quite still.
    StandsStill,
    /// Stands in a T-pose for two frames, then walks from elsewhere.
    Pops,
    /// Hits within a tenth of a second, then freezes.
    HitsAndFreezes,
}

/// A file of the person.
#[derive(Clone, Debug)]
pub struct Person {
    pub does: PersonAction,
    pub n_frames: usize,
    pub rate_hz: f64,
    pub units_per_m: f64,
    /// The axis that is up in the file.
    pub up: Axis,
    /// Whether joints have names.
    pub named: bool,
    /// Whether the bones of all joints but the root lie along +X of their own axes.
    pub own_axes: bool,
    /// Whether every joint has position channels, and offsets are zero.
    pub six_channels: bool,
    /// The nodes above the hips: place, m, and constant turn.
    pub above: Vec<(Vector, Quaternion)>,
    /// Whether the topmost joint also holds a thing that stays where it is.
    pub prop: bool,
}

impl Default for Person {
    fn default() -> Self {
        Self {
            does: PersonAction::Walks,
            n_frames: 121,
            rate_hz: 60.0,
            units_per_m: 100.0,
            up: Axis::Y,
            named: true,
            own_axes: false,
            six_channels: false,
            above: Vec::new(),
            prop: false,
        }
    }
}

impl Person {
    /// Place and turn of the hips, m, and turns of all other joints, +Y up.
    fn pose(&self, t: usize) -> (Vector, Vec<Quaternion>) {
        let s = t as f64 / self.rate_hz;
        let wave = |hz: f64, phase: f64| (std::f64::consts::TAU * hz * s + phase).sin();
        let mut p = [0.3 * wave(0.4, 0.0), 0.94 + 0.02 * wave(0.9, 0.3), 0.45 * s];
        let turn = |axis: Vector, degrees: f64| from_axis_angle(axis, degrees.to_radians());
        let y = [0.0, 1.0, 0.0];
        let mut q = vec![IDENTITY; BONES.len()];
        q[0] = mul(turn(y, 20.0 * wave(0.3, 0.2)), turn(X, 3.0 * wave(0.7, 0.0)));
        q[1] = turn(X, 25.0 * wave(1.0, 0.0));
        q[4] = turn(X, -25.0 * wave(1.0, 0.0));
        q[7] = turn(Z, 6.0 * wave(0.8, 0.5));
        q[10] = mul(turn(Z, -70.0), turn(y, 30.0 * wave(1.0, 1.0)));
        q[13] = mul(turn(Z, 70.0), turn(y, 30.0 * wave(1.0, 2.0)));
        match self.does {
            PersonAction::Walks => {}
            PersonAction::Sits => {
                p[1] = 0.18 + 0.01 * wave(0.9, 0.0);
                q[1] = turn(X, -85.0 + 4.0 * wave(0.6, 0.0));
                q[4] = turn(X, -85.0 - 4.0 * wave(0.6, 0.0));
            }
            PersonAction::Lies => {
                p[1] = 0.14 + 0.005 * wave(0.9, 0.0);
                // On the back, the head towards -Z.
                q[0] = mul(turn(X, -90.0), turn(y, 8.0 * wave(0.4, 0.0)));
                q[1] = turn(X, 5.0 * wave(0.5, 0.0));
                q[4] = turn(X, 5.0 * wave(0.5, 1.0));
            }
            PersonAction::Crouches => {
                p[1] = 0.45;
                q[1] = turn(X, -100.0);
                q[2] = turn(X, 130.0);
                q[4] = turn(X, -100.0);
                q[5] = turn(X, 130.0);
            }
            PersonAction::StandsStill => {
                p = [0.4, 0.94, -0.2];
                q[0] = IDENTITY;
            }
            PersonAction::Pops if t < 2 => {
                p = [-2.0, 0.94, 1.0];
                q = vec![IDENTITY; BONES.len()];
            }
            PersonAction::Pops => {}
            PersonAction::HitsAndFreezes => {
                // Smoothly in 0.1 s, up to 10 m/s at the hand.
                let u = ((s - 0.05) / 0.1).clamp(0.0, 1.0);
                let smooth = u * u * (3.0 - 2.0 * u);
                p = [0.1 * smooth, 0.94, 0.0];
                q = vec![IDENTITY; BONES.len()];
                q[10] = turn(Z, -70.0 * smooth);
            }
        }
        (p, q)
    }

    /// Turns of the joints' own axes against those of the body.
    fn axes(&self, joint: usize) -> Quaternion {
        if !self.own_axes || joint == 0 {
            return IDENTITY;
        }
        let bone = BONES
            .iter()
            .find(|(_, parent, _)| *parent == Some(joint))
            .map(|(_, _, offset)| *offset)
            .or_else(|| ENDS.iter().find(|(parent, _)| *parent == joint).map(|(_, o)| *o))
            .unwrap_or(X);
        from_x_to(bone)
    }

    /// The file.
    pub fn bvh(&self) -> String {
        let file = conj(self.up.to_y());
        let length = |v: Vector| rotate(file, v).map(|c| c * self.units_per_m);
        let in_axes = |q: Quaternion| mul(mul(file, q), conj(file));
        let vector = |v: Vector| format!("{:.6} {:.6} {:.6}", v[0], v[1], v[2]);
        let six = "CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation";
        let three = "CHANNELS 3 Zrotation Xrotation Yrotation";
        let offset_of = |joint: usize, offset: Vector| {
            let parent = BONES[joint].1.map_or(IDENTITY, |parent| self.axes(parent));
            length(rotate(conj(parent), offset))
        };
        let mut text = String::from("HIERARCHY\n");
        let mut open = 0;
        for (i, (place, _)) in self.above.iter().enumerate() {
            let word = if i == 0 { "ROOT" } else { "JOINT" };
            let _ =
                writeln!(text, "{word} above_{i}\n{{\nOFFSET {}\n{six}", vector(length(*place)));
            if i == 0 && self.prop {
                let thing = vector(length([1.0, 0.5, 1.0]));
                let _ = writeln!(text, "JOINT thing\n{{\nOFFSET {thing}\n{three}\n}}");
            }
            open += 1;
        }
        let mut path: Vec<usize> = Vec::new();
        let close = |text: &mut String, joint: usize| {
            for (_, end) in ENDS.iter().filter(|(parent, _)| *parent == joint) {
                let end = length(rotate(conj(self.axes(joint)), *end));
                let _ = writeln!(text, "End Site\n{{\nOFFSET {}\n}}", vector(end));
            }
            text.push_str("}\n");
        };
        for (joint, (name, parent, offset)) in BONES.iter().enumerate() {
            while path.last().copied() != *parent {
                let Some(done) = path.pop() else { break };
                close(&mut text, done);
            }
            let word = if parent.is_none() && self.above.is_empty() { "ROOT" } else { "JOINT" };
            let name = if self.named { (*name).to_owned() } else { format!("bone{joint}") };
            let is_free = parent.is_none() || self.six_channels;
            let offset = if self.six_channels { [0.0; 3] } else { offset_of(joint, *offset) };
            let channels = if is_free { six } else { three };
            let _ = writeln!(text, "{word} {name}\n{{\nOFFSET {}\n{channels}", vector(offset));
            path.push(joint);
        }
        while let Some(done) = path.pop() {
            close(&mut text, done);
        }
        for _ in 0..open {
            text.push_str("}\n");
        }
        let _ = writeln!(
            text,
            "MOTION\nFrames: {}\nFrame Time: {:.7}",
            self.n_frames,
            1.0 / self.rate_hz
        );
        let mut before = vec![[0.0; 3]; BONES.len()];
        for t in 0..self.n_frames {
            let (p, q) = self.pose(t);
            let mut row: Vec<f64> = Vec::new();
            let angles = |q: Quaternion, before: Vector| {
                let [z, x, y] = euler_zxy(normalize(q), before);
                [z, x, y]
            };
            for (i, (place, turn)) in self.above.iter().enumerate() {
                row.extend(length(*place));
                row.extend(angles(in_axes(*turn), [0.0; 3]).map(f64::to_degrees));
                if i == 0 && self.prop {
                    row.extend([0.0; 3]);
                }
            }
            // Where the hips are as seen from above.
            let (mut origin, mut turned) = ([0.0; 3], IDENTITY);
            for (place, turn) in &self.above {
                let place = rotate(turned, *place);
                origin = std::array::from_fn(|c| origin[c] + place[c]);
                turned = mul(turned, *turn);
            }
            let p = rotate(conj(turned), std::array::from_fn(|c| p[c] - origin[c]));
            for (joint, (_, parent, offset)) in BONES.iter().enumerate() {
                let own = match parent {
                    None => mul(conj(turned), q[joint]),
                    Some(parent) => mul(conj(self.axes(*parent)), mul(q[joint], self.axes(joint))),
                };
                match parent {
                    None => row.extend(length(p)),
                    Some(_) if self.six_channels => row.extend(offset_of(joint, *offset)),
                    Some(_) => {}
                }
                before[joint] = angles(in_axes(own), before[joint]);
                row.extend(before[joint].map(f64::to_degrees));
            }
            let words: Vec<String> = row.iter().map(|x| format!("{x:.8}")).collect();
            let _ = writeln!(text, "{}", words.join(" "));
        }
        text
    }
}

/// A turn of +X to a direction.
fn from_x_to(v: Vector) -> Quaternion {
    let length = v.iter().map(|c| c * c).sum::<f64>().sqrt();
    let v = v.map(|c| c / length);
    if v[0] < -0.999 {
        return from_axis_angle(Z, std::f64::consts::PI);
    }
    // X × v, and 1 + X · v.
    normalize([1.0 + v[0], 0.0, -v[2], v[1]])
}
