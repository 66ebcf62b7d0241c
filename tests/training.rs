//! Training and fine-tuning: data, and losses, gradients and steps against PyTorch.

mod codebook;
mod dataset;
mod finetune;
mod given;
mod losses;
mod step;
mod windows;
