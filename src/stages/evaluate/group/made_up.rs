//! Groups made up from generated ones, which generated groups are held against.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis};

use crate::motion::Channel;

/// Mean place of a dancer on the floor, m.
fn mean_place(dancer: ArrayView2<f32>) -> [f32; 2] {
    let first = Channel::Position.range().start;
    [first, first + 2].map(|i| dancer.column(i).mean().unwrap_or_default())
}

/// Moves a dancer so that its mean place is `to`.
fn moved(dancer: ArrayView2<f32>, to: [f32; 2]) -> Array2<f32> {
    let from = mean_place(dancer);
    let mut dancer = dancer.to_owned();
    let first = Channel::Position.range().start;
    for (i, (from, to)) in [first, first + 2].into_iter().zip(from.into_iter().zip(to)) {
        dancer.column_mut(i).mapv_inplace(|x| x + to - from);
    }
    dancer
}

/// The first dancer in the place of every dancer.
pub fn copied(group: ArrayView3<f32>) -> Array3<f32> {
    let mut copies = group.to_owned();
    let first = group.index_axis(Axis(0), 0);
    for (mut copy, dancer) in copies.outer_iter_mut().zip(group.outer_iter()) {
        copy.assign(&moved(first, mean_place(dancer)));
    }
    copies
}

/// Dancer k of group k in the place of dancer k.
pub fn independent(group: ArrayView3<f32>, others: &[Array3<f32>]) -> Array3<f32> {
    let mut mixed = group.to_owned();
    for (k, (mut dancer, other)) in mixed.outer_iter_mut().zip(others).enumerate() {
        let place = mean_place(group.index_axis(Axis(0), k));
        let from = other.index_axis(Axis(0), k.min(other.dim().0 - 1));
        dancer.assign(&moved(from, place));
    }
    mixed
}
