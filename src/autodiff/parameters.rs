//! Values and gradients of a network's parameters, each in one run of memory.
//!
//! Weights lie in panels (see [`kernel`](super::kernel)), everything else as in PyTorch; each begins
//! on a cache line, and what fills the gaps is zero. The optimizer, averages and norms walk through
//! the whole.

use std::ops::Range;
use std::sync::Arc;

use ndarray::Array1;
use rayon::prelude::*;

use crate::model::{Parameter, ParameterId, ParameterList, Role};

use super::arena::Arena;
use super::element::Element;
use super::kernel::{PANEL, pack_weight, packed_len, unpack_weight};
use super::op::elementwise::update;
use super::random::initial;
use super::shard::Shard;

/// Where each parameter lies.
#[derive(Debug)]
pub struct Plan {
    list: ParameterList,
    ranges: Vec<Range<usize>>,
    len: usize,
}

/// The sizes of a weight: outputs, channels of the input, taps.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WeightShape {
    pub outputs: usize,
    pub channels: usize,
    pub taps: usize,
}

impl WeightShape {
    /// Returns the sizes of a parameter with the role of a weight.
    fn of(parameter: &Parameter) -> Option<Self> {
        match (parameter.role, parameter.shape.as_slice()) {
            (Role::Weight, &[outputs, channels]) => Some(Self { outputs, channels, taps: 1 }),
            (Role::Weight, &[outputs, channels, taps]) => Some(Self { outputs, channels, taps }),
            _ => None,
        }
    }
}

impl Plan {
    fn new(list: ParameterList) -> Self {
        let mut ranges = Vec::with_capacity(list.len());
        let mut len = 0;
        for (_, parameter) in list.iter() {
            let own = match WeightShape::of(parameter) {
                Some(shape) => packed_len(shape.outputs, shape.channels * shape.taps),
                None => parameter.len(),
            };
            ranges.push(len..len + own);
            len += own.next_multiple_of(PANEL);
        }
        Self { list, ranges, len }
    }

    /// Returns the names, shapes and roles.
    pub fn list(&self) -> &ParameterList {
        &self.list
    }

    /// Returns where a parameter lies.
    pub fn range(&self, id: ParameterId) -> Range<usize> {
        self.ranges[id.0].clone()
    }

    /// Returns the elements of all, gaps and padding included.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Returns whether there are no elements.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Copies a parameter from PyTorch's order to where it lies.
    pub fn pack<E: Element>(&self, id: ParameterId, source: &[E], all: &mut [E]) {
        let target = &mut all[self.range(id)];
        match WeightShape::of(self.list.get(id)) {
            Some(s) => pack_weight(source, s.outputs, s.channels, s.taps, target),
            None => target.copy_from_slice(source),
        }
    }

    /// Returns a parameter, or what belongs to it, in PyTorch's order.
    pub fn unpack<E: Element>(&self, id: ParameterId, all: &[E]) -> Vec<E> {
        let source = &all[self.range(id)];
        match WeightShape::of(self.list.get(id)) {
            Some(s) => {
                let mut target = vec![E::ZERO; self.list.get(id).len()];
                unpack_weight(source, s.outputs, s.channels, s.taps, &mut target);
                target
            }
            None => source.to_vec(),
        }
    }
}

/// The values of a network's parameters.
#[derive(Clone, Debug)]
pub struct Parameters<E: Element> {
    plan: Arc<Plan>,
    values: Array1<E>,
}

impl<E: Element> Parameters<E> {
    /// Fills parameters as PyTorch does; a parameter depends on the seed and its own name alone.
    pub fn new(list: ParameterList, seed: u64) -> Self {
        Self::from_fn(list, |parameter| {
            initial(parameter.init, &parameter.name, seed, parameter.len())
        })
    }

    /// Fills parameters with what `values` returns for each, in PyTorch's order.
    pub fn from_fn(list: ParameterList, values: impl Fn(&Parameter) -> Vec<E> + Sync) -> Self {
        let plan = Arc::new(Plan::new(list));
        let mut all = Arena::aligned(plan.len());
        let mut rest = all.as_slice_mut().expect("one run of memory");
        let mut parts = Vec::new();
        for (id, parameter) in plan.list.iter() {
            let own = plan.range(id).len();
            let (part, others) = rest.split_at_mut(own.next_multiple_of(PANEL));
            rest = others;
            parts.push((parameter, &mut part[..own]));
        }
        parts.into_par_iter().for_each(|(parameter, target)| {
            let source = values(parameter);
            match WeightShape::of(parameter) {
                Some(s) => pack_weight(&source, s.outputs, s.channels, s.taps, target),
                None => target.copy_from_slice(&source),
            }
        });
        Self { plan, values: all }
    }

    /// Returns where each parameter lies.
    pub fn plan(&self) -> &Arc<Plan> {
        &self.plan
    }

    /// Returns the names, shapes and roles.
    pub fn list(&self) -> &ParameterList {
        &self.plan.list
    }

    /// Returns the values of one parameter, where they lie.
    pub fn get(&self, id: ParameterId) -> &[E] {
        &self.all()[self.plan.range(id)]
    }

    /// Returns the sizes of a weight, `None` for a parameter of another role.
    pub fn weight_shape(&self, id: ParameterId) -> Option<WeightShape> {
        WeightShape::of(self.list().get(id))
    }

    /// Returns the values of all.
    pub fn all(&self) -> &[E] {
        self.values.as_slice().expect("one run of memory")
    }

    /// Returns the values of all for writing. The caller keeps gaps and padding zero.
    pub fn all_mut(&mut self) -> &mut [E] {
        self.values.as_slice_mut().expect("one run of memory")
    }

    /// Returns the values of one parameter in PyTorch's order.
    pub fn unpacked(&self, id: ParameterId) -> Vec<E> {
        self.plan.unpack(id, self.all())
    }

    /// Moves a process's share towards others by a share of the way: θ ← θ + share (other − θ).
    ///
    /// # Panics
    /// When the others are of another network.
    pub fn approach(&mut self, other: &Self, share: f64, shard: Shard) {
        let (share, other) = (E::from_f64(share), other.all());
        assert_eq!(self.all().len(), other.len(), "parameters of one network");
        let step = move |x, y| x + share * (y - x);
        if shard.is_whole() {
            return update(self.all_mut(), other, step);
        }
        for range in shard.ranges(other.len()) {
            update(&mut self.all_mut()[range.clone()], &other[range], step);
        }
    }

    /// Returns a copy of a process's share; the rest is zero, in memory that is not touched.
    pub fn part(&self, shard: Shard) -> Self {
        if shard.is_whole() {
            return self.clone();
        }
        Self { plan: Arc::clone(&self.plan), values: part_of(self.all(), shard) }
    }
}

/// Returns a copy of a process's share of some numbers; the rest is zero, in memory that is not touched.
pub fn part_of<E: Element>(values: &[E], shard: Shard) -> Array1<E> {
    let mut part = Arena::aligned(values.len());
    let all = part.as_slice_mut().expect("one run of memory");
    for range in shard.ranges(values.len()) {
        all[range.clone()].copy_from_slice(&values[range]);
    }
    part
}

/// The gradients of a network's parameters.
#[derive(Debug)]
pub struct Gradients<E: Element> {
    plan: Arc<Plan>,
    values: Array1<E>,
    /// Whether a parameter's gradient holds something since it was last cleared.
    written: Vec<bool>,
}

impl<E: Element> Gradients<E> {
    /// Returns gradients that are zero.
    pub fn new(parameters: &Parameters<E>) -> Self {
        let plan = Arc::clone(&parameters.plan);
        let values = Arena::aligned(plan.len());
        let written = vec![false; plan.list.len()];
        Self { plan, values, written }
    }

    /// Makes all gradients zero. Nothing is cleared yet: the next to come overwrites.
    pub fn clear(&mut self) {
        self.written.fill(false);
    }

    /// Returns a place to write to and whether what is there must be added to.
    pub fn write(&mut self, id: ParameterId) -> (&mut [E], bool) {
        let add = std::mem::replace(&mut self.written[id.0], true);
        let range = self.plan.range(id);
        (&mut self.values.as_slice_mut().expect("one run of memory")[range], add)
    }

    /// Returns the places of a weight and its bias, which lie one behind the other.
    pub fn write_two(&mut self, first: ParameterId, second: ParameterId) -> [(&mut [E], bool); 2] {
        let add = [first, second].map(|id| std::mem::replace(&mut self.written[id.0], true));
        let (a, b) = (self.plan.range(first), self.plan.range(second));
        let values = self.values.as_slice_mut().expect("one run of memory");
        let [a, b] = values.get_disjoint_mut([a, b]).expect("two parameters lie apart");
        [(a, add[0]), (b, add[1])]
    }

    /// Adds to a parameter's gradient.
    pub fn add(&mut self, id: ParameterId, gradient: &[E]) {
        let (target, add) = self.write(id);
        if add {
            for (x, &dx) in target.iter_mut().zip(gradient) {
                *x += dx;
            }
        } else {
            target.copy_from_slice(gradient);
        }
    }

    /// Returns the gradients of all; those that nothing was added to are zero.
    pub fn all(&mut self) -> &mut [E] {
        let values = self.values.as_slice_mut().expect("one run of memory");
        for (id, _) in self.plan.list.iter() {
            if !std::mem::replace(&mut self.written[id.0], true) {
                values[self.plan.range(id)].fill(E::ZERO);
            }
        }
        values
    }

    /// Returns the gradients in a range whose parameters are all final; those that nothing was added to are zero.
    pub fn settled(&mut self, ids: Range<usize>, range: Range<usize>) -> &mut [E] {
        let values = self.values.as_slice_mut().expect("one run of memory");
        for id in ids {
            if !std::mem::replace(&mut self.written[id], true) {
                values[self.plan.range(ParameterId(id))].fill(E::ZERO);
            }
        }
        &mut values[range]
    }

    /// Returns where each parameter lies.
    pub fn plan(&self) -> &Arc<Plan> {
        &self.plan
    }

    /// Adds all gradients of another part of the same batch.
    ///
    /// # Panics
    /// When they are of another network.
    pub fn add_all(&mut self, other: &mut Self) {
        let (own, other) = (self.all(), other.all());
        assert_eq!(own.len(), other.len(), "gradients of one network");
        update(own, other, |x, y| x + y);
    }

    /// Returns the gradient of one parameter in PyTorch's order.
    pub fn unpacked(&mut self, id: ParameterId) -> Vec<E> {
        self.all();
        self.plan.unpack(id, self.values.as_slice().expect("one run of memory"))
    }
}
