//! Training and fine-tuning: losses, gradients and steps against PyTorch.

mod dataset;
mod finetune;
mod given;
mod losses;
mod step;
