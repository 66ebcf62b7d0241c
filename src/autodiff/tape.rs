//! The interpreter for training: a list of what was done, to be gone through backwards.

use crate::model::{GraphError, ParameterId, Result};

use super::arena::Arena;
use super::element::Element;
use super::finite::check_finite;
use super::op::binary::add_assign;
use super::operation::{Backward, Interpreter, Operation, Run};
use super::parameters::{Gradients, Parameters};
use super::random::Stream;
use super::tensor::Tensor;

/// A value's place on its tape.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct NodeId(usize);

/// Records the operations of one forward pass.
pub struct Tape<'p, E: Element> {
    parameters: &'p Parameters<E>,
    arena: Arena<E>,
    nodes: Vec<Node<'p, E>>,
    /// Seed of what is dropped; `None` when nothing is.
    seed: Option<u64>,
    /// Operations that drew random numbers so far.
    n_random: u64,
    recording: bool,
    check_finite: bool,
    /// How often each parameter was used.
    n_uses: Vec<u32>,
}

/// Hears of every parameter whose gradient nothing will be added to any more.
pub type OnFinal<'h, E> = dyn FnMut(ParameterId, &mut Gradients<E>) + 'h;

/// Uses of parameters that a backward has still to come to.
struct Uses<'h, 'f, E: Element> {
    left: Vec<u32>,
    on_final: Option<&'h mut OnFinal<'f, E>>,
}

impl<E: Element> Uses<'_, '_, E> {
    /// Counts an operation that was passed.
    fn passed(&mut self, parameters: [Option<ParameterId>; 2], gradients: &mut Gradients<E>) {
        let Some(on_final) = &mut self.on_final else { return };
        for id in parameters.into_iter().flatten() {
            self.left[id.0] -= 1;
            if self.left[id.0] == 0 {
                on_final(id, gradients);
            }
        }
    }
}

struct Node<'p, E: Element> {
    step: NodeKind<'p, E>,
    inputs: Vec<Option<NodeId>>,
}

enum NodeKind<'p, E: Element> {
    /// An input whose gradient is wanted.
    Input,
    Operation(Box<dyn Operation<E>>),
    Part(Part<'p, E>),
}

/// A part that is run again when its gradient is due.
struct Part<'p, E: Element> {
    inputs: Vec<Tensor<E>>,
    run: Box<PartFunction<'p, E>>,
    n_random: u64,
}

type PartFunction<'p, E> =
    dyn Fn(&mut Tape<'p, E>, &[Tensor<E>]) -> Result<Tensor<E>> + Send + 'static;

/// The gradients of a tape's inputs.
pub struct InputGradients<E: Element>(Vec<Option<Tensor<E>>>);

impl<E: Element> InputGradients<E> {
    /// Returns the gradient of an input, `None` where the result does not depend on it.
    pub fn of(&self, input: &Tensor<E>) -> Option<&Tensor<E>> {
        input.node.and_then(|node| self.0.get(node.0)).and_then(Option::as_ref)
    }
}

impl<'p, E: Element> Tape<'p, E> {
    /// Begins a tape for a network with these parameters, with buffers from `arena`.
    ///
    /// With a seed, this is training: numbers are dropped, the same for the same seed.
    pub fn new(parameters: &'p Parameters<E>, arena: &Arena<E>, seed: Option<u64>) -> Self {
        Self {
            parameters,
            arena: arena.clone(),
            nodes: Vec::new(),
            seed,
            n_random: 0,
            recording: true,
            check_finite: false,
            n_uses: vec![0; parameters.list().len()],
        }
    }

    /// Looks at every result and every gradient, and stops at the first number that is not finite.
    pub fn checking_finite(mut self) -> Self {
        self.check_finite = true;
        self
    }

    /// Returns an input whose gradient [`Tape::backward`] gives.
    pub fn input(&mut self, shape: &[usize], values: &[E]) -> Tensor<E> {
        let x = self.constant(shape, values);
        self.mark(x)
    }

    fn mark(&mut self, mut x: Tensor<E>) -> Tensor<E> {
        x.node = Some(self.push(NodeKind::Input, Vec::new()));
        x
    }

    fn push(&mut self, step: NodeKind<'p, E>, inputs: Vec<Option<NodeId>>) -> NodeId {
        self.nodes.push(Node { step, inputs });
        NodeId(self.nodes.len() - 1)
    }

    /// Goes back from a scalar and adds its gradients to those of the parameters.
    ///
    /// d result / d result = 1; each operation then turns the gradient of its result into those of
    /// its inputs, the last first. What an operation kept is given back as soon as it has been passed.
    ///
    /// # Errors
    /// If it looks for numbers that are not finite and finds one.
    ///
    /// # Panics
    /// If `result` is no scalar.
    pub fn backward(
        self,
        result: Tensor<E>,
        gradients: &mut Gradients<E>,
    ) -> Result<InputGradients<E>> {
        assert_eq!(result.len(), 1, "gradients begin at a scalar, not at {:?}", result.shape());
        let shape = result.shape().to_vec();
        let one = Tensor::new(self.arena.filled(&shape, E::ONE), &self.arena);
        self.backward_from(result, one, gradients)
    }

    /// Goes back from any result, given its gradient.
    ///
    /// # Errors
    /// As [`Tape::backward`].
    pub fn backward_from(
        mut self,
        result: Tensor<E>,
        d_result: Tensor<E>,
        gradients: &mut Gradients<E>,
    ) -> Result<InputGradients<E>> {
        let mut uses = Uses { left: std::mem::take(&mut self.n_uses), on_final: None };
        self.go_back(result, d_result, gradients, &mut uses)
    }

    /// Goes back as [`Tape::backward_from`] does, and tells of each gradient of a parameter that is final. A parameter
    /// that plays no part in the result is not told of.
    ///
    /// # Errors
    /// As [`Tape::backward`].
    pub fn backward_telling(
        mut self,
        result: Tensor<E>,
        d_result: Tensor<E>,
        gradients: &mut Gradients<E>,
        on_final: &mut OnFinal<'_, E>,
    ) -> Result<InputGradients<E>> {
        let left = std::mem::take(&mut self.n_uses);
        self.go_back(result, d_result, gradients, &mut Uses { left, on_final: Some(on_final) })
    }

    fn go_back(
        mut self,
        result: Tensor<E>,
        d_result: Tensor<E>,
        gradients: &mut Gradients<E>,
        uses: &mut Uses<'_, '_, E>,
    ) -> Result<InputGradients<E>> {
        let mut slots: Vec<Option<Tensor<E>>> = Vec::new();
        slots.resize_with(self.nodes.len(), || None);
        if let Some(node) = result.node {
            slots[node.0] = Some(d_result);
        }
        drop(result);
        while let Some(node) = self.nodes.pop() {
            let place = self.nodes.len();
            if matches!(node.step, NodeKind::Input) {
                continue;
            }
            let Some(dy) = slots[place].take() else {
                if let NodeKind::Operation(operation) = &node.step {
                    uses.passed(operation.parameters(), gradients);
                }
                continue;
            };
            let needs: Vec<_> = node.inputs.iter().map(Option::is_some).collect();
            let found = match node.step {
                NodeKind::Input => continue,
                NodeKind::Operation(mut operation) => {
                    let parameters = self.parameters;
                    let mut at =
                        Backward { parameters, gradients, arena: &self.arena, needs: &needs };
                    let found = operation.backward(dy, &mut at);
                    if self.check_finite {
                        let (name, id) = (operation.name(), operation.parameter());
                        for dx in found.iter().flatten() {
                            check_finite(name, id, parameters, "gradient", dx)?;
                        }
                    }
                    uses.passed(operation.parameters(), gradients);
                    found
                }
                NodeKind::Part(part) => self.backward_part(part, dy, &needs, gradients, uses)?,
            };
            for (input, dx) in node.inputs.iter().zip(found) {
                if let (Some(input), Some(dx)) = (input, dx) {
                    accumulate(&mut slots[input.0], dx);
                }
            }
        }
        Ok(InputGradients(slots))
    }

    /// Runs a part again, recorded this time, and goes back through it.
    fn backward_part(
        &self,
        part: Part<'p, E>,
        dy: Tensor<E>,
        needs: &[bool],
        gradients: &mut Gradients<E>,
        uses: &mut Uses<'_, '_, E>,
    ) -> Result<Vec<Option<Tensor<E>>>> {
        let mut tape = Tape::new(self.parameters, &self.arena, self.seed);
        tape.n_random = part.n_random;
        tape.check_finite = self.check_finite;
        let inputs: Vec<_> = part
            .inputs
            .into_iter()
            .zip(needs)
            .map(|(mut x, &needed)| {
                x.node = None;
                if needed { tape.mark(x) } else { x }
            })
            .collect();
        let y = (part.run)(&mut tape, &inputs)?;
        // The uses of its parameters were counted when it ran for the first time.
        let found = tape.go_back(y, dy, gradients, uses)?;
        Ok(inputs.iter().map(|x| found.of(x).cloned()).collect())
    }
}

/// Adds a gradient to those that came before.
fn accumulate<E: Element>(slot: &mut Option<Tensor<E>>, dx: Tensor<E>) {
    *slot = Some(match slot.take() {
        None => dx,
        Some(mut sum) => {
            // Whichever may be overwritten is; the sum is the same either way round.
            if sum.is_unique() || !dx.is_unique() {
                add_assign(sum.data_mut(), dx.data());
                sum
            } else {
                let mut dx = dx;
                add_assign(dx.data_mut(), sum.data());
                dx
            }
        }
    });
}

impl<'p, E: Element> Interpreter for Tape<'p, E> {
    type Element = E;

    fn constant(&self, shape: &[usize], values: &[E]) -> Tensor<E> {
        Tensor::new(self.arena.copy(shape, values), &self.arena)
    }

    fn apply<O: Operation<E>>(&mut self, mut operation: O, x: &[&Tensor<E>]) -> Result<Tensor<E>> {
        let inputs: Vec<_> = x.iter().map(|x| x.node).collect();
        let learns = operation.parameter().is_some() || inputs.iter().any(Option::is_some);
        let recording = self.recording && learns;
        for id in operation.parameters().into_iter().flatten() {
            self.n_uses[id.0] += 1;
        }
        let random = self.seed.map(|seed| Stream::new(seed, self.n_random));
        let run = Run { parameters: self.parameters, arena: &self.arena, recording, random };
        let mut y = operation.forward(x, &run)?;
        self.n_random += 1;
        if self.check_finite {
            let (name, id) = (operation.name(), operation.parameter());
            check_finite(name, id, self.parameters, "result", &y)?;
        }
        y.node = recording.then(|| self.push(NodeKind::Operation(Box::new(operation)), inputs));
        Ok(y)
    }

    fn run_part<F>(&mut self, inputs: &[&Tensor<E>], part: F) -> Result<Tensor<E>>
    where
        F: Fn(&mut Self, &[Tensor<E>]) -> Result<Tensor<E>> + Send + 'static,
    {
        let nodes: Vec<_> = inputs.iter().map(|x| x.node).collect();
        let inputs: Vec<_> = inputs.iter().map(|&x| x.clone()).collect();
        if !self.recording {
            return part(self, &inputs);
        }
        let n_random = self.n_random;
        self.recording = false;
        let y = part(self, &inputs);
        self.recording = true;
        let mut y = y?;
        let run = Box::new(part);
        y.node = Some(self.push(NodeKind::Part(Part { inputs, run, n_random }), nodes));
        Ok(y)
    }

    fn is_training(&self) -> bool {
        self.seed.is_some()
    }
}

impl<E: Element> Tape<'_, E> {
    /// Refuses a loss that is not a finite scalar.
    ///
    /// # Errors
    /// Names the value.
    pub fn finite_loss(loss: &Tensor<E>) -> Result<E> {
        let value = loss.scalar();
        if value.is_finite() {
            return Ok(value);
        }
        Err(GraphError::NonFinite {
            operation: "loss".to_owned(),
            what: "result",
            value: value.to_string(),
            index: Vec::new(),
            shape: Vec::new(),
        })
    }
}
