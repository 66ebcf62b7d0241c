//! The engine and the networks against PyTorch.

mod determinism;
pub mod golden;
mod golden_values;
mod group;
mod messages;
mod networks;
mod operations;
mod optimizer;
mod outline;
mod overfit;
mod planner;
mod state_dict;
mod tokens;
