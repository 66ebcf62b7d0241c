//! Arbitrary bytes through the reader of weights: no panic, and what was read survives a write and a
//! read, bit for bit.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/instructions.rs"]
#[allow(dead_code, unused_imports, unused_macros, reason = "this target reaches a part of the module")]
mod instructions;
#[path = "../../src/autodiff/mod.rs"]
#[allow(dead_code, reason = "this target reaches a part of the modules")]
mod autodiff;
#[path = "../../src/model"]
#[allow(unused_imports, dead_code, reason = "this target reaches a part of the modules")]
mod model {
    mod graph;
    mod parameter;
    pub use graph::*;
    pub use parameter::*;
}
#[path = "../../src/weights.rs"]
mod weights;

use model::{Init, ParameterList, Role, Scope};
use weights::{Precision, WeightsError};

/// A convolution of 3 outputs, as in the seed.
fn network() -> ParameterList {
    let mut list = ParameterList::default();
    let mut scope = Scope::root(&mut list);
    scope.parameter("weight", &[3, 2, 3], Init::Zeros, Role::Weight);
    scope.parameter("bias", &[3], Init::Zeros, Role::Vector);
    list
}

fuzz_target!(|bytes: &[u8]| {
    let parameters = match weights::load::<f64>(bytes, network()) {
        Ok(parameters) => parameters,
        Err(error) => {
            assert!(!error.to_string().is_empty());
            if let WeightsError::Mismatch(problems) = error {
                assert!(!problems.is_empty());
            }
            return;
        }
    };
    let (plan, all) = (parameters.plan(), parameters.all());
    let written = weights::save(plan, all, Precision::F64, &[].into()).expect("in memory");
    let again = weights::load::<f64>(&written, network()).expect("written by us");
    // Bits, because a NaN differs from itself.
    assert!(again.all().iter().map(|x| x.to_bits()).eq(all.iter().map(|x| x.to_bits())));
});
