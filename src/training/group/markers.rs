//! Points that are fixed to a body, where its pose puts them.

use crate::autodiff::op::binary::{Binary, Pair};
use crate::autodiff::{Backward, Element, Interpreter, Operation, Run, Tensor};
use crate::model::{Graph, GraphError, Result};
use crate::motion::vector::{cross, inner};
use crate::motion::{Columns, Normalizer};

/// Points on a body of 0.35 m radius, in its own frame, m: sides, head and front.
const MARKERS_M: [[f64; 3]; 4] =
    [[0.35, 0.0, 0.0], [-0.35, 0.0, 0.0], [0.0, 0.35, 0.0], [0.0, 0.0, 0.35]];
/// Smallest norm that a quaternion is divided by.
const EPSILON: f64 = 1e-6;

/// R(q) m for fixed points m, q a unit quaternion (w, x, y, z): R m = m + 2 w (u × m) + 2 u × (u × m), u = (x, y, z).
///
/// \[…, 4\] → \[…, 3 points\]
struct RotatedPoints<E: Element> {
    q: Option<Tensor<E>>,
}

fn parts<E: Element>(q: &[E]) -> (f64, [f64; 3]) {
    (q[0].to_f64(), [q[1].to_f64(), q[2].to_f64(), q[3].to_f64()])
}

impl<E: Element> Operation<E> for RotatedPoints<E> {
    fn name(&self) -> &'static str {
        "markers"
    }

    fn forward(&mut self, x: &[&Tensor<E>], run: &Run<E>) -> Result<Tensor<E>> {
        let q = x[0];
        if q.channels() != 4 {
            let problem = format!("input has shape {:?}, expected [..., 4]", q.shape());
            return Err(GraphError::shape("markers", problem));
        }
        self.q = run.keep(q);
        let mut shape = q.shape().to_vec();
        *shape.last_mut().expect("checked above") = 3 * MARKERS_M.len();
        Ok(run.tensor(&shape, |y| {
            let rows = y.chunks_exact_mut(3 * MARKERS_M.len()).zip(q.data().chunks_exact(4));
            for (y, q) in rows {
                let (w, u) = parts(q);
                for (y, m) in y.chunks_exact_mut(3).zip(MARKERS_M) {
                    let c = cross(u, m);
                    let cc = cross(u, c);
                    for i in 0..3 {
                        y[i] = E::from_f64(m[i] + 2.0 * (w * c[i] + cc[i]));
                    }
                }
            }
        }))
    }

    /// With d the gradient of R m: dw = 2 d · (u × m); du = 2 w (m × d) + 2 (m (u · d) + d (u · m) − 2 u (m · d)),
    /// since u × (u × m) = u (u · m) − m (u · u).
    fn backward(&mut self, dy: Tensor<E>, at: &mut Backward<E>) -> Vec<Option<Tensor<E>>> {
        let q = self.q.take().expect("kept by the forward");
        at.only(|| {
            at.tensor(q.shape(), |dq| {
                let rows = dq.chunks_exact_mut(4).zip(q.data().chunks_exact(4));
                for ((dq, q), dy) in rows.zip(dy.data().chunks_exact(3 * MARKERS_M.len())) {
                    let (w, u) = parts(q);
                    let mut sum = [0.0; 4];
                    for (d, m) in dy.chunks_exact(3).zip(MARKERS_M) {
                        let d = [d[0].to_f64(), d[1].to_f64(), d[2].to_f64()];
                        let c = cross(m, d);
                        let (ud, um, md) = (inner(u, d), inner(u, m), inner(m, d));
                        sum[0] += 2.0 * inner(d, cross(u, m));
                        for i in 0..3 {
                            sum[1 + i] +=
                                2.0 * w * c[i] + 2.0 * (d[i] * um + m[i] * ud - 2.0 * u[i] * md);
                        }
                    }
                    dq.iter_mut().zip(sum).for_each(|(dq, sum)| *dq = E::from_f64(sum));
                }
            })
        })
    }
}

/// Returns where markers of a normalised motion are, m. \[…, columns\] → \[…, 12\]
pub fn markers<I: Interpreter>(
    g: &mut I,
    normalizer: &Normalizer,
    motion: &Tensor<I::Element>,
) -> Result<Tensor<I::Element>> {
    let in_units = |g: &mut I, columns: Columns| -> Result<Tensor<I::Element>> {
        let x = g.channels(motion, columns.range())?;
        let constant = |g: &I, of: &[f32]| {
            let values: Vec<_> =
                columns.range().map(|i| I::Element::from_f64(of[i].into())).collect();
            g.constant(&[values.len()], &values)
        };
        let (scale, centre) = (constant(g, &normalizer.scale), constant(g, &normalizer.centre));
        let x = g.apply(Binary::new(Pair::Multiply), &[&x, &scale])?;
        g.apply(Binary::new(Pair::Add), &[&x, &centre])
    };
    let body = normalizer.layout().body();
    let p = in_units(g, body.position)?;
    let q = in_units(g, body.orientation)?;
    let q = g.normalize(&q, EPSILON)?;
    let around = g.apply(RotatedPoints { q: None }, &[&q])?;
    let places: Vec<&Tensor<I::Element>> = MARKERS_M.iter().map(|_| &p).collect();
    let places = g.concat(&places)?;
    g.add(&places, &around)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::autodiff::op::reduce::{Over, Reduce};
    use crate::autodiff::{Arena, Eager, Gradients, Parameters, Tape};
    use crate::model::ParameterList;
    use crate::motion::layout::tests::ROOT;
    use crate::motion::quaternion::rotate;
    use crate::motion::{BODY, Layout, MOTION_DIM};

    fn motion(width: usize) -> Vec<f64> {
        (0..3 * width).map(|i| ((i * 37 % 23) as f64 - 11.0) / 9.0).collect()
    }

    fn normalizer(layout: Layout) -> Normalizer {
        let mut normalizer = Normalizer::identity_of(layout);
        for (i, (scale, centre)) in
            normalizer.scale.iter_mut().zip(&mut normalizer.centre).enumerate()
        {
            *scale = 0.5 + 0.1 * i as f32;
            *centre = 0.25 - 0.125 * (i % 3) as f32;
        }
        normalizer
    }

    #[test]
    fn markers_stand_where_the_pose_puts_them() {
        let (parameters, arena) = (Parameters::new(ParameterList::default(), 0), Arena::default());
        for (layout, first) in [(BODY, 9), (ROOT, 6)] {
            let mut g = Eager::new(&parameters, &arena);
            let (values, normalizer) = (motion(layout.width()), normalizer(layout));
            let x = g.input(&[1, 3, layout.width()], &values);
            let y = markers(&mut g, &normalizer, &x).expect("shapes fit");
            for (row, found) in values.chunks(layout.width()).zip(y.data().chunks(12)) {
                let unnormalized = |i: usize| {
                    row[i] * f64::from(normalizer.scale[i]) + f64::from(normalizer.centre[i])
                };
                let q: [f64; 4] = std::array::from_fn(|i| unnormalized(first + i));
                let norm = q.iter().map(|x| x * x).sum::<f64>().sqrt();
                for (found, m) in found.chunks(3).zip(MARKERS_M) {
                    let turned = rotate(q.map(|x| x / norm), m);
                    for i in 0..3 {
                        let off = found[i] - (unnormalized(i) + turned[i]);
                        assert!(off.abs() < 1e-12, "{found:?}");
                    }
                }
            }
        }
    }

    #[test]
    fn gradients_are_those_of_central_differences() {
        let (parameters, arena) = (Parameters::new(ParameterList::default(), 0), Arena::default());
        let normalizer = normalizer(BODY);
        let value = |values: &[f64]| {
            let mut tape = Tape::new(&parameters, &arena, None);
            let x = tape.input(&[1, 3, MOTION_DIM], values);
            let y = markers(&mut tape, &normalizer, &x).expect("shapes fit");
            let weights: Vec<f64> = (0..y.len()).map(|i| 1.0 - 0.3 * (i % 7) as f64).collect();
            let weights = tape.constant(y.shape(), &weights);
            let y = tape.apply(Binary::new(Pair::Multiply), &[&y, &weights]).expect("fits");
            let sum = tape.apply(Reduce::sum(Over::All), &[&y]).expect("fits");
            let scalar: f64 = sum.scalar();
            let found = tape.backward(sum, &mut Gradients::new(&parameters)).expect("finite");
            (scalar, found.of(&x).expect("a gradient").data().to_vec())
        };
        let values = motion(MOTION_DIM);
        let (_, gradient) = value(&values);
        for i in 0..values.len() {
            let at = |by: f64| {
                let mut values = values.clone();
                values[i] += by;
                value(&values).0
            };
            let difference = (at(1e-6) - at(-1e-6)) / 2e-6;
            assert!((gradient[i] - difference).abs() < 1e-7, "{i}: {} {difference}", gradient[i]);
        }
    }
}
