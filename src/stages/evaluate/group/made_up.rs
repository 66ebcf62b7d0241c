//! Groups made up of other motion, which generated groups are held against.

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis};

use crate::motion::Channel;

/// Mean place of a dancer on the floor, m.
pub(super) type FloorPoint = [f32; 2];

fn mean_place(dancer: ArrayView2<f32>) -> FloorPoint {
    let first = Channel::Position.range().start;
    [first, first + 2].map(|i| dancer.column(i).mean().unwrap_or_default())
}

/// Returns the mean places of the dancers of a group.
pub(super) fn places(group: ArrayView3<f32>) -> Vec<FloorPoint> {
    group.outer_iter().map(mean_place).collect()
}

/// Moves a dancer so that its mean place is `to`.
fn moved(dancer: ArrayView2<f32>, to: FloorPoint) -> Array2<f32> {
    let from = mean_place(dancer);
    let mut dancer = dancer.to_owned();
    let first = Channel::Position.range().start;
    for (i, (from, to)) in [first, first + 2].into_iter().zip(from.into_iter().zip(to)) {
        dancer.column_mut(i).mapv_inplace(|x| x + to - from);
    }
    dancer
}

/// The first dancer in the place of every dancer.
pub(super) fn copied(group: ArrayView3<f32>) -> Array3<f32> {
    let mut copies = group.to_owned();
    let first = group.index_axis(Axis(0), 0);
    for (mut copy, dancer) in copies.outer_iter_mut().zip(group.outer_iter()) {
        copy.assign(&moved(first, mean_place(dancer)));
    }
    copies
}

/// Strangers in the places of the dancers.
pub(super) fn independent(group: ArrayView3<f32>, strangers: &[ArrayView2<f32>]) -> Array3<f32> {
    let mut mixed = group.to_owned();
    for (k, (mut dancer, stranger)) in mixed.outer_iter_mut().zip(strangers).enumerate() {
        dancer.assign(&moved(*stranger, mean_place(group.index_axis(Axis(0), k))));
    }
    mixed
}

/// The dancers of a group in given places; who has none stays.
pub(super) fn placed(group: ArrayView3<f32>, to: &[FloorPoint]) -> Array3<f32> {
    let mut group = group.to_owned();
    for (mut dancer, &to) in group.outer_iter_mut().zip(to) {
        let there = moved(dancer.view(), to);
        dancer.assign(&there);
    }
    group
}
