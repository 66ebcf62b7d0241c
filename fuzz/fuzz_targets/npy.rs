//! Arbitrary bytes through the `.npy` reader: no panic, memory in proportion to the input, the
//! stream reader agrees with the slice reader, and what was read survives a write and a read.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/excerpt.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod excerpt;
#[path = "../../src/motion"]
#[allow(dead_code, reason = "this target reaches a part of the modules")]
mod motion {
    pub mod npy;
    pub mod npz;
}

use motion::npy;

fuzz_target!(|bytes: &[u8]| {
    let doubles = npy::read_f64(bytes);
    let array = match npy::read_f32(bytes) {
        Ok(array) => array,
        Err(error) => {
            let message = error.to_string();
            assert!(message.len() < 1000 && !error.kind().is_empty(), "{message}");
            let streamed = npy::read_f32_from(bytes, u64::MAX).map_err(|error| error.to_string());
            assert_eq!(streamed.unwrap_err(), message);
            return;
        }
    };
    assert_eq!(array.values.len(), array.shape.iter().product::<usize>());
    assert!(array.values.len() <= bytes.len() && array.values.capacity() <= 2 * bytes.len());
    if let Ok(doubles) = doubles {
        assert_eq!(doubles.shape, array.shape);
    }
    let streamed = npy::read_f32_from(bytes, u64::MAX).expect("the slice reader took it");
    let written = npy::write(&array.shape, &array.values);
    let again = npy::read_f32(&written).expect("written by us");
    for other in [streamed, again] {
        assert_eq!(other.shape, array.shape);
        // Bits, because a NaN differs from itself.
        assert!(
            other.values.iter().map(|v| v.to_bits()).eq(array.values.iter().map(|v| v.to_bits()))
        );
    }
});
