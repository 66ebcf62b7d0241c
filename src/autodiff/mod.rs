//! Arrays, and the products that networks are made of, for training and inference on a CPU.
//!
//! What is here so far: the numbers ([`element`]), buffers that come back ([`arena`]), and the three
//! products of a layer ([`kernel`]).

pub mod arena;
pub mod element;
pub mod kernel;
