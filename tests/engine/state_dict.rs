//! A state dict that PyTorch saved as safetensors loads unchanged.

use std::path::Path;

use motiongen::model::{Preset, UNet1D, UNetConfig};
use motiongen::weights::{Precision, load, save};

use super::golden::parameters;

#[test]
fn a_state_dict_of_pytorch_loads_unchanged_and_is_written_as_it_was() {
    let config = UNetConfig {
        widths: vec![8, 16],
        attention_levels: vec![1],
        num_heads: 2,
        time_embed_dim: 8,
        context_dim: 8,
        ..Preset::Tiny.config()
    };
    let (_, list) = UNet1D::new(&config);
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/engine");
    let bytes = std::fs::read(folder.join("state_dict.safetensors")).expect("a golden file");
    let loaded = load::<f32>(&bytes, list.clone()).expect("the same network");
    // The values are those that make.py filled it with, to the last bit.
    assert_eq!(loaded.all(), parameters::<f32>(list.clone()).all());
    let written = save(loaded.plan(), loaded.all(), Precision::F32, &[].into()).expect("saved");
    assert_eq!(load::<f32>(&written, list).expect("the same network").all(), loaded.all());
}
