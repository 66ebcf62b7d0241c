//! Where bodies touch: trajectory intersection frequency and least separation.

use super::{n_frames, pairs};
use crate::motion::Poses;

/// How near the bodies of a group come to each other on the floor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contacts {
    /// TIF as a share: of all frames and pairs those whose bodies touch, in [0, 1].
    pub share: f64,
    /// TIF as published: pairs that touch, on the mean of all frames.
    pub per_frame: f64,
    /// Least distance of two centres, m.
    pub least_m: f64,
}

/// Returns how near bodies of `radius_m` come to each other: two touch while
/// `√(Δx² + Δz²) < 2 radius_m`.
///
/// None for fewer than two dancers or no frames. Source: Le et al., "Music-Driven Group Choreography", CVPR
/// 2023, which intersects meshes of the body and divides by the frames; pairs count once here.
pub fn contacts(dancers: &[Poses], radius_m: f64) -> Option<Contacts> {
    let n_frames = n_frames(dancers);
    let (mut n_touching, mut n_all, mut least_m) = (0_usize, 0_usize, f64::INFINITY);
    for (i, j) in pairs(dancers.len()) {
        let (a, b) = (&dancers[i].position_m, &dancers[j].position_m);
        for (a, b) in a.iter().zip(b).take(n_frames) {
            let distance_m = (a[0] - b[0]).hypot(a[2] - b[2]);
            n_touching += usize::from(distance_m < 2.0 * radius_m);
            n_all += 1;
            least_m = least_m.min(distance_m);
        }
    }
    (n_all > 0).then(|| Contacts {
        share: n_touching as f64 / n_all as f64,
        per_frame: n_touching as f64 / n_frames as f64,
        least_m,
    })
}
