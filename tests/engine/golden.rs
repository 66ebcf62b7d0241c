//! Golden files of `tests/golden/engine`, and of others that are made alike.

use std::collections::BTreeMap;
use std::path::Path;

use motiongen::autodiff::Element;
use safetensors::SafeTensors;

use super::golden_values::bits;
pub use super::golden_values::{given, parameters, uniform};

/// A golden file.
pub struct Golden {
    tensors: BTreeMap<String, (Vec<usize>, Vec<f64>)>,
    /// Names of the parameters that statistics are of, in order.
    pub parameters: Vec<String>,
}

impl Golden {
    pub fn open(name: &str) -> Self {
        Self::open_in("engine", name)
    }

    /// Opens a file of `tests/golden/<folder>`.
    pub fn open_in(folder: &str, name: &str) -> Self {
        let all = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden");
        let bytes = std::fs::read(all.join(folder).join(name)).expect("a golden file");
        let file = SafeTensors::deserialize(&bytes).expect("a safetensors file");
        let tensors = file
            .iter()
            .map(|(name, tensor)| {
                let (values, rest) = tensor.data().as_chunks::<8>();
                assert!(rest.is_empty(), "{name} is not f64");
                let values = values.iter().map(|&b| f64::from_le_bytes(b)).collect();
                (name.to_owned(), (tensor.shape().to_vec(), values))
            })
            .collect();
        let (_, header) = SafeTensors::read_metadata(&bytes).expect("a header");
        let names = header.metadata().as_ref().and_then(|m| m.get("parameters").cloned());
        let parameters =
            names.map_or_else(Vec::new, |names| serde_json::from_str(&names).expect("a list"));
        Self { tensors, parameters }
    }

    pub fn shape(&self, name: &str) -> &[usize] {
        &self.tensors[name].0
    }

    pub fn values(&self, name: &str) -> &[f64] {
        &self.tensors[name].1
    }

    pub fn get(&self, name: &str) -> Option<&[f64]> {
        self.tensors.get(name).map(|(_, values)| values.as_slice())
    }

    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Compares tensors with the statistics `prefix.norm`, `.dot` and `.sample` of row `row`.
    ///
    /// Errors are relative to the tensor's norm. Where that is below 1e-4 of the norm of all (the bias
    /// of keys, which softmax cancels), the tensor is zero but for rounding, and errors are relative to
    /// that floor.
    pub fn compare(
        &self,
        prefix: &str,
        row: usize,
        tolerance: f64,
        of: impl Fn(&str) -> Vec<f64>,
    ) -> f64 {
        const N_SAMPLES: usize = 16;
        const FLOOR: f64 = 1e-4;
        // A gradient that is zero by an invariance of the loss, as that of a bias under a softmax, is a sum whose
        // terms cancel: rounding leaves of it what it leaves of the whole, and it is compared with the whole.
        const ZERO: f64 = 1e-12;
        let n = self.parameters.len();
        let rows =
            |kind: &str, width: usize| &self.values(&format!("{prefix}.{kind}"))[row * n * width..];
        let (norms, dots, samples) = (rows("norm", 1), rows("dot", 1), rows("sample", N_SAMPLES));
        let total = norms[..n].iter().map(|x| x * x).sum::<f64>().sqrt();
        let mut worst = 0.0_f64;
        for (i, name) in self.parameters.iter().enumerate() {
            let got = of(name);
            let norm = got.iter().map(|x| x * x).sum::<f64>().sqrt();
            let probe = uniform(&format!("probe.{name}"), got.len());
            let probe_norm = probe.iter().map(|x| x * x).sum::<f64>().sqrt();
            let dot = got.iter().zip(&probe).map(|(x, p)| x * p).sum::<f64>();
            let scale = if norms[i] < ZERO * total { total } else { norms[i].max(FLOOR * total) };
            let mut check = |what: &str, got: f64, wanted: f64, scale: f64| {
                let error = (got - wanted).abs() / scale;
                worst = worst.max(error);
                assert!(
                    error <= tolerance,
                    "{prefix} of {name}: {what} is {got}, wanted {wanted}, off by {error:.2e} of {scale:.3e}"
                );
            };
            check("norm", norm, norms[i], scale);
            check("product with the probe", dot, dots[i], scale * probe_norm);
            let last = got.len() - 1;
            for j in 0..N_SAMPLES.min(got.len()) {
                let at = if got.len() < N_SAMPLES { j } else { j * last / (N_SAMPLES - 1) };
                check("a sample", got[at], samples[i * N_SAMPLES + j], scale);
            }
        }
        worst
    }
}

/// Asserts that ‖got − wanted‖ ≤ tolerance ‖wanted‖, and returns the error.
pub fn assert_near<E: Element>(what: &str, got: &[E], wanted: &[f64], tolerance: f64) -> f64 {
    assert_eq!(got.len(), wanted.len(), "{what}");
    let square = |x: f64| x * x;
    let norm = wanted.iter().copied().map(square).sum::<f64>().sqrt();
    let differences = got.iter().zip(wanted).map(|(got, wanted)| square(got.to_f64() - wanted));
    let error = differences.sum::<f64>().sqrt() / norm.max(1e-300);
    assert!(error <= tolerance, "{what}: off by {error:.2e} of its norm {norm:.3e}");
    error
}

/// A step of the diffusion for each sample.
pub fn steps<E: Element>(batch: usize) -> Vec<E> {
    bits("input.t", batch).map(|z| E::from_f64(((z * 1000) >> 24) as f64)).collect()
}
