//! The numbers that every language computes alike: `tests/golden/engine/weights.py`.

use motiongen::autodiff::{Element, Parameters};
use motiongen::model::ParameterList;

/// The numbers u of a name.
pub fn uniform(name: &str, n: usize) -> Vec<f64> {
    bits(name, n).map(|z| z as f64 * 2.0_f64.powi(-23) - 1.0).collect()
}

pub fn bits(name: &str, n: usize) -> impl Iterator<Item = u64> {
    let digest = name.bytes().fold(0xCBF2_9CE4_8422_2325_u64, |digest, byte| {
        (digest ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3)
    });
    (0..n as u64).map(move |i| {
        let z = i.wrapping_mul(0x9E37_79B9_7F4A_7C15).wrapping_add(digest);
        let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        (z ^ (z >> 31)) >> 40
    })
}

/// An input by its name.
pub fn given<E: Element>(name: &str, n: usize) -> Vec<E> {
    let scale = if name == "input.x" { 1.5 } else { 1.0 };
    uniform(name, n).into_iter().map(|u| E::from_f64(f64::from((scale * u) as f32))).collect()
}

/// Parameters with the values that the golden files were made with.
pub fn parameters<E: Element>(list: ParameterList) -> Parameters<E> {
    Parameters::from_fn(list, |parameter| {
        let u = uniform(&parameter.name, parameter.len());
        let value = |u: f64| match parameter.shape.as_slice() {
            [_, inner @ ..] if !inner.is_empty() => {
                u / (inner.iter().product::<usize>() as f64).sqrt()
            }
            _ if parameter.name.ends_with(".weight") => 1.0 + 0.1 * u,
            _ => 0.1 * u,
        };
        u.into_iter().map(|u| E::from_f64(f64::from(value(u) as f32))).collect()
    })
}
