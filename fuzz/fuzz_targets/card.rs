//! Arbitrary bytes through the reader of models' cards: no panic, and in a card that is taken sizes of which
//! networks can be made and files of which there is one each.
#![no_main]

use libfuzzer_sys::fuzz_target;

#[path = "../../src/instructions.rs"]
#[allow(dead_code, unused_imports, unused_macros, reason = "this target reaches a part of the module")]
mod instructions;
#[path = "../../src/excerpt.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod excerpt;
#[path = "../../src/audio/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod audio;
#[path = "../../src/chance.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod chance;
#[path = "../../src/diffusion/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod diffusion;
#[path = "../../src/model/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod model;
#[path = "../../src/motion/mod.rs"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod motion;
#[path = "../../src/units.rs"]
#[allow(dead_code, reason = "this target reaches a part of the module")]
mod units;
#[path = "../../src/generation"]
#[allow(dead_code, unused_imports, reason = "this target reaches a part of the modules")]
mod generation {
    mod card;
    mod group {
        mod card;
        pub use card::*;
    }
    mod learned;
    mod tokens {
        mod card;
        pub use card::*;
    }
    pub use card::*;
    pub use group::GroupCard;
    pub use tokens::TokensCard;
    pub use learned::*;
}
#[path = "../../src/onnx"]
#[allow(dead_code, reason = "this target reaches a part of the modules")]
mod onnx {
    mod storage;
    pub use storage::Storage;
}

use generation::{FamilyCard as _, ModelCard};

/// A card of each family that is taken, whose parts the input replaces.
const SOUND: [&str; 3] = [
    include_str!("../../models/pretrained/model.json"),
    include_str!("../seeds/card/group.json"),
    include_str!("../seeds/card/tokens.json"),
];

fn check(bytes: &[u8]) {
    if let Ok(card) = generation::GroupCard::read(bytes, "m") {
        let _ = model::GroupNetworks::new(&card.group);
    }
    if let Ok(card) = generation::TokensCard::read(bytes, "m") {
        let _ = model::Tokenizer::new(&card.tokens);
        let _ = model::Planner::new(&card.planner);
    }
    match ModelCard::read(bytes, "m") {
        Ok(card) => {
            assert!(card.files.len() <= generation::ModelFileName::ALL.len());
            let _ = model::UNet1D::new(&card.unet);
            let _ = model::MotionDecoder::new(&card.decoder);
            let text = serde_json::to_vec(&card).expect("JSON");
            assert_eq!(ModelCard::read(&text, "m").expect("written by us"), card);
        }
        Err(error) => assert!(!error.to_string().is_empty()),
    }
}

fuzz_target!(|bytes: &[u8]| {
    check(bytes);
    // What follows the first three bytes takes the place of a stretch of the settings, which are in front.
    let [which, at, n, patch @ ..] = bytes else { return };
    let sound = SOUND[usize::from(*which) % SOUND.len()];
    let settings = sound.find("\"alphas_cumprod\"").unwrap_or(sound.len());
    let at = usize::from(*at) * settings / 256;
    let end = (at + usize::from(*n)).min(settings);
    let text = sound.as_bytes();
    check(&[&text[..at], patch, &text[end..]].concat());
});
