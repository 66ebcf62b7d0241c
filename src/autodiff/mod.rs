//! Arrays with gradients, for training and inference on a CPU.
//!
//! A [`Tape`] runs a network and records it, [`Eager`] only runs it; both are graphs in the sense of
//! [`model`](crate::model). Operations lie in `op`, each with its forward and its backward; the
//! products that networks are made of lie in `kernel`, the only code with `unsafe`. The same code runs
//! in `f32` and in `f64`.

mod adamw;
mod arena;
mod eager;
mod element;
mod finite;
#[cfg(test)]
mod gradient_tests;
mod graph;
mod kernel;
pub mod op;
mod operation;
mod parameters;
mod random;
mod shard;
mod tape;
mod tensor;
mod threads;

pub use adamw::{AdamW, AdamWConfig, norm_of, squares};
pub use arena::{Arena, Usage};
pub use eager::Eager;
pub use element::Element;
pub use kernel::{Level, level, peak_gflops};
pub use operation::{Backward, Interpreter, Operation, Run};
pub use parameters::{Gradients, Parameters, Plan, WeightShape, part_of};
pub use random::Stream;
pub use shard::{SHARD_CHUNK, Shard, chunk_range};
pub use tape::{InputGradients, OnFinal, Tape};
pub use tensor::Tensor;
pub use threads::{Threads, keep_awake};
