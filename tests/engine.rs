//! The engine and the networks against PyTorch.

mod determinism;
mod golden;
mod messages;
mod networks;
mod operations;
mod optimizer;
mod overfit;
