//! The operations, each in a place of its own: forward, backward, shapes, source.

pub mod activation;
pub mod attention;
pub mod binary;
pub mod channels;
pub mod conv;
pub mod dancers;
pub mod dropout;
pub mod elementwise;
pub mod filter;
pub mod frames;
pub mod group_norm;
pub mod layer_norm;
pub mod lookup;
pub mod loss;
pub mod matmul;
pub mod modulation;
pub mod normalize;
pub mod parameter;
pub mod reduce;
pub mod rotary;
pub mod select;
pub mod shape;
pub mod softmax;
pub mod tokens;
