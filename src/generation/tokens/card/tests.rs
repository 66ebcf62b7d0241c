use super::*;
use crate::generation::card::{CardError, MODEL_FORMAT, own_channels, own_features};
use crate::model::{PlannerKind, Preset};

/// A fault that a card may have.
type Change = fn(&mut TokensCard);

fn card() -> TokensCard {
    let tokens = TokensConfig::of(Preset::Tiny).expect("a preset of the family");
    let planner = PlannerConfig::of(Preset::Tiny, PlannerKind::Masked, &tokens).expect("a preset");
    TokensCard {
        format: MODEL_FORMAT,
        family: Family::Tokens,
        name: "tokens".to_owned(),
        program: "p".to_owned(),
        provenance: TokensProvenance {
            run: "plan".to_owned(),
            tokenizer: "tok".to_owned(),
            step: 7,
            validation_loss: Some(2.5),
            data: "d".to_owned(),
            learned_from: None,
        },
        precision: Storage::default(),
        tokens,
        planner,
        diffusion: DiffusionConfig { prediction: Prediction::Sample, ..Default::default() },
        alphas_cumprod: Vec::new(),
        n_parameters: TokensNetworks { tokenizer: 1, planner: 2 },
        weights_sha256: TokensNetworks { tokenizer: "t".to_owned(), planner: "p".to_owned() },
        window_frames: 120,
        fps: crate::units::FPS,
        channels: own_channels(),
        features: own_features(),
        normalizer: Normalizer::identity(),
        feature_scale: FeatureScale::identity(FEATURE_DIM),
        motion_range: None,
        styles: crate::motion::style_name::NamedStyles::default(),
        sampling: None,
        licence: "none".to_owned(),
        files: Vec::new(),
    }
}

fn read(change: impl FnOnce(&mut TokensCard)) -> Result<TokensCard, CardError> {
    let mut card = card();
    change(&mut card);
    TokensCard::read(&serde_json::to_vec(&card).expect("JSON"), "m")
}

#[test]
fn a_card_survives_its_text() {
    assert_eq!(read(|_| ()).expect("a card"), card());
}

#[test]
fn networks_that_do_not_fit_each_other_are_refused() {
    let refusal = |change: fn(&mut TokensCard)| read(change).expect_err("unfit").to_string();
    assert_eq!(
        refusal(|card| card.planner.codes = 37),
        "m: the planner knows 37 tokens, the tokenizer 32; take the planner that was trained with this tokenizer"
    );
    assert_eq!(
        refusal(|card| card.window_frames = 122),
        "m: window_frames is 122; it must be a multiple of the 4 that a token stands for; export the model again"
    );
    assert_eq!(
        refusal(|card| card.planner.style_dim = 5),
        "m: style_dim is 5, expected 8; export the model again"
    );
    assert_eq!(
        refusal(|card| card.diffusion.prediction = Prediction::Epsilon),
        "m: the denoiser of a model of tokens predicts clean motion, and the diffusion says otherwise; export the \
         model again"
    );
    let sizes: [(Change, &str); 3] = [
        (|card| card.tokens.width = 4_000_000, "width is 4000000; it must be at most 16384"),
        (
            |card| (card.tokens.n_steps, card.diffusion.n_steps) = (1 << 20, 1 << 20),
            "n_steps 1048576 and width 48 make a table of 50331648 values; at most 33554432 are kept, so lower one of \
             the two",
        ),
        (|card| card.planner.layers = 1_000_000, "layers is 1000000; it must be at most 64"),
    ];
    for (change, expected) in sizes {
        assert_eq!(refusal(change), format!("m: {expected}"));
    }
    assert_eq!(
        refusal(|card| card.family = Family::Group),
        "m: is a model of the family group, and one of the family tokens is needed"
    );
    assert_eq!(
        refusal(|card| {
            let sha256 = "s".to_owned();
            card.files = vec![FileEntry { name: ModelFileName::Score, n_bytes: 1, sha256 }];
        }),
        "m: score.onnx is no file of a model of the family tokens; export the model again"
    );
}
