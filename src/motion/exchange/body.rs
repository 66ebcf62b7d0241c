//! The body that an exported motion moves: trunk, shoulders, head and nose around the root.
//!
//! The same figure as on the pages of the room `view`, in metres: the root is its origin, the head is
//! at +Y and the nose points to +Z.

/// A corner of a triangle; corners are not shared, so that every face is flat.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Corner {
    /// Relative to the root, m.
    pub position_m: [f32; 3],
    /// Unit, outward.
    pub normal: [f32; 3],
}

/// A convex part: its vertices, m, and the triangles between them, counter-clockwise from outside.
struct Part {
    vertices: Vec<[f64; 3]>,
    triangles: Vec<[usize; 3]>,
}

/// Returns the corners of the body's triangles, three for each, counter-clockwise from outside.
pub fn body() -> Vec<Corner> {
    parts().iter().flat_map(corners).collect()
}

fn parts() -> [Part; 4] {
    [
        tapered(-0.14, [0.13, 0.08], 0.36, [0.17, 0.1]),
        tapered(0.37, [0.24, 0.07], 0.45, [0.2, 0.06]),
        tapered(0.49, [0.075, 0.09], 0.72, [0.09, 0.1]),
        nose(),
    ]
}

/// A box that may be narrower at one end: height and half width and half depth at foot and head.
fn tapered(foot: f64, at_foot: [f64; 2], head: f64, at_head: [f64; 2]) -> Part {
    let ring = |y: f64, [w, d]: [f64; 2]| [[-w, y, d], [w, y, d], [w, y, -d], [-w, y, -d]];
    let faces: [[usize; 4]; 6] =
        [[0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7], [4, 5, 6, 7], [3, 2, 1, 0]];
    Part {
        vertices: [ring(foot, at_foot), ring(head, at_head)].concat(),
        triangles: faces.into_iter().flat_map(|[a, b, c, d]| [[a, b, c], [a, c, d]]).collect(),
    }
}

fn nose() -> Part {
    Part {
        vertices: vec![
            [-0.035, 0.57, 0.105],
            [0.035, 0.57, 0.105],
            [0.0, 0.64, 0.105],
            [0.0, 0.585, 0.2],
        ],
        triangles: vec![[0, 1, 3], [1, 2, 3], [2, 0, 3], [2, 1, 0]],
    }
}

fn corners(part: &Part) -> Vec<Corner> {
    let mut corners = Vec::with_capacity(3 * part.triangles.len());
    for triangle in &part.triangles {
        let positions_m = triangle.map(|i| part.vertices[i]);
        let normal = normal(positions_m).map(|c| c as f32);
        corners.extend(positions_m.map(|p| Corner { position_m: p.map(|c| c as f32), normal }));
    }
    corners
}

/// Unit normal of a triangle, `(b - a) × (c - a)` over its length.
fn normal([a, b, c]: [[f64; 3]; 3]) -> [f64; 3] {
    let [u, v] = [b, c].map(|p| [p[0] - a[0], p[1] - a[1], p[2] - a[2]]);
    let n = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
    let length = n.iter().map(|c| c * c).sum::<f64>().sqrt();
    n.map(|c| c / length)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_body_has_its_head_up_and_its_nose_in_front() {
        let corners = body();
        // Twelve triangles for each of three boxes, four for the nose.
        assert_eq!(corners.len(), 3 * (3 * 12 + 4));
        let coordinates = |axis: usize| corners.iter().map(move |corner| corner.position_m[axis]);
        assert_eq!(coordinates(2).reduce(f32::max), Some(0.2));
        assert_eq!(coordinates(1).reduce(f32::max), Some(0.72));
        assert_eq!(coordinates(0).reduce(f32::max), coordinates(0).map(|x| -x).reduce(f32::max));
    }

    #[test]
    fn every_face_looks_outward() {
        for part in parts() {
            let n = part.vertices.len() as f64;
            let middle: [f64; 3] =
                std::array::from_fn(|i| part.vertices.iter().map(|v| v[i]).sum::<f64>() / n);
            for corner in corners(&part) {
                let (p, n) = (corner.position_m, corner.normal.map(f64::from));
                let outward: f64 = (0..3).map(|i| (f64::from(p[i]) - middle[i]) * n[i]).sum();
                assert!(outward > 0.01, "{corner:?}");
                let norm2: f64 = n.iter().map(|c| c * c).sum();
                assert!((norm2 - 1.0).abs() < 3e-7, "{corner:?}");
            }
        }
    }

    #[test]
    fn every_part_is_closed() {
        for part in parts() {
            let edges: Vec<(usize, usize)> =
                part.triangles.iter().flat_map(|&[a, b, c]| [(a, b), (b, c), (c, a)]).collect();
            for &(a, b) in &edges {
                let count_of = |edge| edges.iter().filter(|&&other| other == edge).count();
                assert_eq!((count_of((a, b)), count_of((b, a))), (1, 1), "edge {a} to {b}");
            }
        }
    }
}
