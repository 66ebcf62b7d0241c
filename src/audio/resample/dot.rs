//! Dot products.

/// Partial sums: as many as a vector register holds, so that the loop vectorises.
pub const LANES: usize = 8;

/// Returns Σ a\[i\] b\[i\] of slices whose lengths are a multiple of [`LANES`].
pub fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0f32; LANES];
    for (a, b) in a.chunks_exact(LANES).zip(b.chunks_exact(LANES)) {
        for i in 0..LANES {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum()
}
