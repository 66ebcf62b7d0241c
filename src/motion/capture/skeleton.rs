//! The body in a skeleton: where it begins, what its head and feet are, how tall it is.

use crate::motion::bvh::{Bvh, JointChannel};
use crate::motion::quantile::{median, percentile};

/// Frames that are looked at for lengths and directions.
const MAX_SAMPLED_FRAMES: usize = 256;
/// A node moves when its position changes by more than this share of the skeleton's size.
const MOVES_PER_SIZE: f64 = 1e-4;
/// A joint turns when an angle of its own changes by more than this, degrees.
const TURNS_DEG: f64 = 0.05;
/// Share of all joints below a branch that make it the body's.
const BODY_SHARE: f64 = 0.5;
/// Height of a body over the longest way along its bones, from a hand to a foot.
const HEIGHT_PER_DIAMETER: f64 = 0.62;
/// How far mirrored nodes may be from one another, of the skeleton's size.
const MIRROR_TOLERANCE: f64 = 0.03;
/// Share of mirrored nodes that make a plane one of symmetry.
const MIRRORED_SHARE: f64 = 0.8;
/// Fewest nodes off the plane of symmetry.
const MIN_MIRRORED: usize = 4;
/// How much longer than wide what stands must be.
pub const STANDING_RATIO: f64 = 1.5;
/// Share of the height at either end in which head and feet lie.
const END_SHARE: f64 = 0.1;

type Vector = [f64; 3];

/// World positions of nodes, one signal per coordinate: x, y, z of the first node, and so on.
pub type Positions = Vec<Vec<f64>>;

/// A part of a skeleton: a joint and all below it, with lengths as the take has them.
#[derive(Clone, Debug)]
pub struct Body {
    /// Nodes of the body, its root first, by their index in the file.
    pub nodes: Vec<usize>,
    /// Parent of each node, by its place among `nodes`.
    parents: Vec<Option<usize>>,
    /// Distance of each node from its parent, median over the take, file units.
    lengths: Vec<f64>,
    /// Rest position of each node, the root at the origin, file units.
    pub rest: Vec<Vector>,
    pub landmarks: Option<Landmarks>,
}

/// Landmarks that tell head from foot, by places among the nodes of a body.
#[derive(Clone, Debug, PartialEq)]
pub struct Landmarks {
    pub head: usize,
    pub feet: Vec<usize>,
    /// Where trunk and legs meet.
    pub pelvis: usize,
}

impl Body {
    /// Finds the body: the first joint that moves or branches, and all below it.
    pub fn find(bvh: &Bvh, world: &Positions) -> Self {
        let n = bvh.joints().len();
        let whole = Self::below(bvh, world, 0);
        let size = whole.diameter();
        let moves = |node: usize| range(&world[3 * node..3 * node + 3]) > MOVES_PER_SIZE * size;
        let channels = Channels::of(bvh);
        let mut node = 0;
        while let Some(child) = next_towards_body(bvh, &channels, node, n, size, &moves) {
            node = child;
        }
        if node == 0 { whole } else { Self::below(bvh, world, node) }
    }

    fn below(bvh: &Bvh, world: &Positions, root: usize) -> Self {
        let joints = bvh.joints();
        let mut place = vec![None; joints.len()];
        let mut nodes = Vec::new();
        // Parents come before children.
        for (i, joint) in joints.iter().enumerate() {
            if i == root || joint.parent.is_some_and(|parent| place[parent].is_some()) {
                place[i] = Some(nodes.len());
                nodes.push(i);
            }
        }
        let parents: Vec<Option<usize>> = nodes
            .iter()
            .map(|&i| if i == root { None } else { joints[i].parent.and_then(|p| place[p]) })
            .collect();
        let frames = sampled(world.first().map_or(0, Vec::len));
        let mut lengths = Vec::with_capacity(nodes.len());
        let mut rest: Vec<Vector> = Vec::with_capacity(nodes.len());
        for (&i, parent) in nodes.iter().zip(&parents) {
            let Some(parent) = *parent else {
                lengths.push(0.0);
                rest.push([0.0; 3]);
                continue;
            };
            let apart = |t: &usize| distance(at(world, i, *t), at(world, nodes[parent], *t));
            lengths.push(median(&mut frames.iter().map(apart).collect::<Vec<_>>()).unwrap_or(0.0));
            rest.push(std::array::from_fn(|c| rest[parent][c] + joints[i].offset[c]));
        }
        let mut body = Self { nodes, parents, lengths, rest, landmarks: None };
        body.landmarks = body.named(bvh).or_else(|| body.mirrored());
        body
    }

    /// Height of the body, file units: along its bones where head and feet are known, so that no pose
    /// matters; else the greatest extent that it keeps.
    pub fn height(&self, world: &Positions) -> f64 {
        if let Some(Landmarks { head, feet, .. }) = &self.landmarks {
            let n_feet = feet.len() as f64;
            let way: f64 = feet.iter().map(|&foot| self.way(*head, foot)).sum::<f64>() / n_feet;
            return way + self.depth_below(*head);
        }
        let frames = sampled(world.first().map_or(0, Vec::len));
        let extent = |t: &usize| {
            let extents = (0..3).map(|axis| {
                let x = self.nodes.iter().map(|&i| world[3 * i + axis][*t]);
                let (low, high) =
                    x.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
                high - low
            });
            extents.fold(0.0, f64::max)
        };
        let mut extents: Vec<f64> = frames.iter().map(extent).collect();
        let extent = percentile(&mut extents, 90.0).unwrap_or(0.0);
        extent.max(HEIGHT_PER_DIAMETER * self.diameter())
    }

    /// Length of the way along bones between two nodes.
    fn way(&self, a: usize, b: usize) -> f64 {
        let (mut a, mut b, mut way) = (a, b, 0.0);
        // A parent's place is before its child's.
        while a != b {
            let later = if a > b { &mut a } else { &mut b };
            way += self.lengths[*later];
            match self.parents[*later] {
                Some(parent) => *later = parent,
                None => break,
            }
        }
        way
    }

    /// The node next to `above` on the way up from `node`; `node` where it is not below.
    pub fn branch_below(&self, above: usize, node: usize) -> usize {
        let way = std::iter::successors(Some(node), |&i| self.parents[i]);
        way.take_while(|&i| i != above).last().unwrap_or(node)
    }

    fn meeting(&self, a: usize, b: usize) -> usize {
        let (mut a, mut b) = (a, b);
        while a != b {
            let later = if a > b { &mut a } else { &mut b };
            match self.parents[*later] {
                Some(parent) => *later = parent,
                None => break,
            }
        }
        a.min(b)
    }

    /// Longest way from a node down to an end.
    fn depth_below(&self, node: usize) -> f64 {
        let mut below = vec![0.0f64; self.nodes.len()];
        for i in (1..self.nodes.len()).rev() {
            if let Some(parent) = self.parents[i] {
                below[parent] = below[parent].max(below[i] + self.lengths[i]);
            }
        }
        below[node]
    }

    /// Longest way along bones between any two nodes.
    fn diameter(&self) -> f64 {
        let mut below = vec![0.0f64; self.nodes.len()];
        let mut longest = 0.0f64;
        for i in (1..self.nodes.len()).rev() {
            if let Some(parent) = self.parents[i] {
                let way = below[i] + self.lengths[i];
                longest = longest.max(below[parent] + way);
                below[parent] = below[parent].max(way);
            }
        }
        longest
    }

    /// Head and feet by the names of joints.
    fn named(&self, bvh: &Bvh) -> Option<Landmarks> {
        let names: Vec<String> = self
            .nodes
            .iter()
            .map(|&i| {
                let joint = &bvh.joints()[i];
                // End sites are called after their parents.
                let is_joint = !joint.channels.is_empty();
                if is_joint { joint.name.to_ascii_lowercase() } else { String::new() }
            })
            .collect();
        let first = |word: &str| names.iter().position(|name| name.contains(word));
        let head = first("head").or_else(|| first("neck"))?;
        let highest = |words: &[&str]| -> Vec<usize> {
            let is = |i: usize| words.iter().any(|word| names[i].contains(word));
            let above =
                |i: usize| std::iter::successors(self.parents[i], |&parent| self.parents[parent]);
            (0..names.len()).filter(|&i| is(i) && !above(i).any(is)).collect()
        };
        let mut feet = highest(&["foot", "ankle"]);
        if feet.is_empty() {
            feet = highest(&["toe"]);
        }
        self.landmarks_of(head, feet)
    }

    /// Head and feet of a rest pose that is the same left and right: paired ends are feet, the end in the
    /// middle is the head.
    fn mirrored(&self) -> Option<Landmarks> {
        let extent = |axis: usize| {
            let x = self.rest.iter().map(|p| p[axis]);
            let (low, high) =
                x.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
            (low, high)
        };
        let extents: [(f64, f64); 3] = std::array::from_fn(extent);
        let size = extents.iter().map(|(low, high)| high - low).fold(0.0, f64::max);
        let near = MIRROR_TOLERANCE * size;
        if !(near > 0.0 && near.is_finite()) {
            return None;
        }
        (0..3).find_map(|side| {
            let off = |p: &&Vector| p[side].abs() > near;
            let n_off = self.rest.iter().filter(off).count();
            let is_mirrored = |p: &&Vector| {
                self.rest.iter().any(|other| {
                    (0..3).all(|c| {
                        let wanted = if c == side { -p[c] } else { p[c] };
                        (other[c] - wanted).abs() <= near
                    })
                })
            };
            let n_mirrored = self.rest.iter().filter(off).filter(is_mirrored).count();
            if n_off < MIN_MIRRORED || (n_mirrored as f64) < MIRRORED_SHARE * n_off as f64 {
                return None;
            }
            let [b, c] = [(side + 1) % 3, (side + 2) % 3];
            let long = |axis: usize| extents[axis].1 - extents[axis].0;
            let up = match (long(b) / long(c).max(near), long(c) / long(b).max(near)) {
                (ratio, _) if ratio >= STANDING_RATIO => b,
                (_, ratio) if ratio >= STANDING_RATIO => c,
                _ => return None,
            };
            let (low, high) = extents[up];
            let zone = END_SHARE * (high - low);
            let ends = |is_in: &dyn Fn(f64) -> bool| -> Vec<usize> {
                (0..self.rest.len()).filter(|&i| is_in(self.rest[i][up])).collect()
            };
            let (bottom, top) = (ends(&|x| x <= low + zone), ends(&|x| x >= high - zone));
            let in_middle = |end: &[usize]| end.iter().all(|&i| self.rest[i][side].abs() <= near);
            match (in_middle(&bottom), in_middle(&top)) {
                (false, true) => self.landmarks_of(*top.last()?, bottom),
                (true, false) => self.landmarks_of(*bottom.last()?, top),
                _ => None,
            }
        })
    }

    fn landmarks_of(&self, head: usize, feet: Vec<usize>) -> Option<Landmarks> {
        let pelvis = self.meeting(head, *feet.first()?);
        let apart = feet.iter().all(|&foot| foot != pelvis) && head != pelvis;
        apart.then_some(Landmarks { head, feet, pelvis })
    }

    /// Range of the root's position, file units, over all axes.
    pub fn root_range(&self, world: &Positions) -> f64 {
        self.nodes.first().map_or(0.0, |&root| range(&world[3 * root..3 * root + 3]))
    }
}

/// Which channels of a file change over the take.
struct Channels {
    /// By node: the greatest range of its position channels, file units.
    position_range: Vec<f64>,
    /// By node: the greatest range of its rotation channels, degrees.
    rotation_range_deg: Vec<f64>,
}

impl Channels {
    fn of(bvh: &Bvh) -> Self {
        let n = bvh.joints().len();
        let mut found = Self { position_range: vec![0.0; n], rotation_range_deg: vec![0.0; n] };
        let mut column = 0;
        for (i, joint) in bvh.joints().iter().enumerate() {
            for channel in &joint.channels {
                let x = bvh.frames();
                let x = x.column(column).to_vec();
                column += 1;
                let greatest = match channel {
                    JointChannel::Position(_) => &mut found.position_range[i],
                    JointChannel::Rotation(_) => &mut found.rotation_range_deg[i],
                };
                *greatest = greatest.max(range(&[x]));
            }
        }
        found
    }

    fn changes(&self, node: usize, size: f64) -> bool {
        self.travels(node, size) || self.rotation_range_deg[node] > TURNS_DEG
    }

    fn travels(&self, node: usize, size: f64) -> bool {
        self.position_range[node] > MOVES_PER_SIZE * size
    }
}

/// Returns the child of a joint that does not move in which to look for the body; none where the joint is
/// the body's root.
fn next_towards_body(
    bvh: &Bvh,
    channels: &Channels,
    node: usize,
    n_nodes: usize,
    size: f64,
    moves: &dyn Fn(usize) -> bool,
) -> Option<usize> {
    if moves(node) {
        return None;
    }
    let joints = bvh.joints();
    // An end site is no branch.
    let is_joint = |i: usize| {
        !joints[i].channels.is_empty() || joints.iter().any(|joint| joint.parent == Some(i))
    };
    let children: Vec<usize> =
        (node + 1..n_nodes).filter(|&i| joints[i].parent == Some(node) && is_joint(i)).collect();
    // Nodes follow their parents, so those below a child end where the next of another branch begins.
    let below = |child: usize| {
        let end = (child + 1..n_nodes).find(|&i| joints[i].parent.is_none_or(|p| p < child));
        child..end.unwrap_or(n_nodes)
    };
    let turns = channels.rotation_range_deg[node] > TURNS_DEG;
    if let &[child] = children.as_slice() {
        let goes_on = if turns {
            below(child).any(|i| channels.travels(i, size))
        } else {
            below(child).any(|i| channels.changes(i, size))
        };
        return goes_on.then_some(child);
    }
    let is_body = |&child: &usize| {
        let share = below(child).len() as f64 / below(node).len().max(1) as f64;
        share >= BODY_SHARE && below(child).any(|i| channels.travels(i, size))
    };
    children.into_iter().find(is_body)
}

/// Frames of a take that are looked at, evenly over it.
pub fn sampled(n_frames: usize) -> Vec<usize> {
    let n = n_frames.min(MAX_SAMPLED_FRAMES);
    (0..n).map(|i| i * n_frames / n.max(1)).collect()
}

/// World position of a node in a frame.
pub fn at(world: &Positions, node: usize, t: usize) -> Vector {
    std::array::from_fn(|axis| world[3 * node + axis][t])
}

fn distance(a: Vector, b: Vector) -> f64 {
    (0..3).map(|c| (a[c] - b[c]).powi(2)).sum::<f64>().sqrt()
}

/// Greatest range of any of the signals.
fn range(signals: &[Vec<f64>]) -> f64 {
    let range_of_signal = |x: &Vec<f64>| {
        let (low, high) =
            x.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)));
        high - low
    };
    signals.iter().map(range_of_signal).fold(0.0, f64::max)
}
