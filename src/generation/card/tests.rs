use proptest::prelude::*;
use serde_json::{Value, json};

use super::*;

/// The card of the model that ships with the program, without its lists of music.
fn card() -> Value {
    let text = include_bytes!("../../../models/pretrained/model.json");
    let mut card: Value = serde_json::from_slice(text).unwrap();
    card["provenance"].as_object_mut().unwrap().remove("learned_from");
    card
}

fn read(card: &Value) -> Result<ModelCard, CardError> {
    ModelCard::read(card.to_string().as_bytes(), "m")
}

#[test]
fn files_have_names_of_a_closed_set_and_each_one_entry() {
    assert!(read(&card()).is_ok());
    for name in [
        "/root/.bashrc",
        "../../.ssh/authorized_keys",
        "unet.onnx/../../x",
        "UNET.onnx",
        "model.json",
        "",
        "unet.onnx\0",
    ] {
        let mut changed = card();
        changed["files"][0]["name"] = json!(name);
        let error = read(&changed).unwrap_err().to_string();
        let start = format!("m: is no description of a model (a model has no file {name:?}, only ");
        assert!(error.starts_with(&start), "{error}");
    }
    let mut doubled = card();
    doubled["files"][1] = doubled["files"][0].clone();
    let error = read(&doubled).unwrap_err().to_string();
    assert_eq!(error, "m: unet.onnx is listed twice; export the model again");
}

#[test]
fn names_of_files_are_written_as_they_are_read() {
    for name in ModelFileName::ALL {
        assert_eq!(ModelFileName::of_name(name.name()), Some(name));
        assert_eq!(serde_json::to_value(name).unwrap(), json!(name.name()));
    }
    let card = card();
    assert_eq!(serde_json::to_value(read(&card).unwrap()).unwrap()["files"], card["files"]);
}

/// Numbers that programs stumble over.
fn number() -> impl Strategy<Value = Value> {
    prop_oneof![
        any::<u64>().prop_map(|n| json!(n)),
        any::<i64>().prop_map(|n| json!(n)),
        (0_u64..70_000).prop_map(|n| json!(n)),
        prop::num::f64::NORMAL.prop_map(|x| json!(x)),
        Just(json!(null)),
        Just(json!([])),
        Just(json!("x")),
    ]
}

proptest! {
    #[test]
    fn arbitrary_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        prop_assert!(ModelCard::read(&bytes, "m").is_err());
    }

    #[test]
    fn no_number_in_a_card_breaks_the_reader(
        place in prop::sample::select(vec![
            "/unet/widths/1", "/unet/n_steps", "/unet/time_embed_dim", "/unet/num_res_blocks",
            "/unet/attention_levels/0", "/unet/num_heads", "/unet/num_head_channels", "/unet/style_dim",
            "/unet/context_dim", "/unet/dropout", "/decoder/hidden_dim", "/decoder/n_blocks",
            "/decoder/expansion", "/decoder/dropout", "/diffusion/n_steps", "/diffusion/beta_end",
            "/window_frames", "/files/0/n_bytes", "/normalizer/scale/3", "/feature_scale/scale/7",
            "/sampling/guidance", "/format",
        ]),
        value in number(),
    ) {
        let mut changed = card();
        *changed.pointer_mut(place).unwrap() = value;
        if let Ok(card) = read(&changed) {
            prop_assert!(card.unet.n_steps <= 1 << 25 && card.window_frames <= 1 << 16);
        }
    }
}
