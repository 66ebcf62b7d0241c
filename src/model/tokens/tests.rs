use super::*;
use crate::model::outline::Outline;
use crate::model::unet::Preset;

#[test]
fn shapes_are_followed_at_every_rate_and_every_parameter_is_met() {
    for frames_per_token in [1, 2, 4, 8, 16] {
        let config = TokensConfig {
            frames_per_token,
            ..TokensConfig::of(Preset::Tiny).expect("a preset of the family")
        };
        let (tokenizer, list) = Tokenizer::new(&config);
        let mut g = Outline::new(&list);
        let (batch, frames) = (3, 37);
        let n_tokens = config.n_tokens(frames);
        let (x, t) = (g.input(&[batch, frames, 25]), g.input(&[batch]));
        let found = tokenizer.quantize(&mut g, &x).expect("shapes fit");
        assert_eq!(found.latents, [batch, n_tokens, 48], "ρ = {frames_per_token}");
        assert_eq!(found.tokens, [batch, n_tokens]);
        assert_eq!(found.codes, found.latents);
        let q = g.straight_through(&found.latents, &found.codes).expect("shapes fit");
        let s = tokenizer.signal(&mut g, &q, &x).expect("shapes fit");
        assert_eq!(s, [batch, frames, 48]);
        assert_eq!(tokenizer.denoise(&mut g, &x, &t, &s), Ok(x));
        let met: usize = g.layers().iter().map(|layer| layer.n_parameters).sum();
        assert_eq!(met, list.n_elements(), "ρ = {frames_per_token}");
    }
}

#[test]
fn the_denoiser_of_the_base_costs_what_was_estimated() {
    let config = TokensConfig::of(Preset::Base).expect("a preset of the family");
    let (tokenizer, list) = Tokenizer::new(&config);
    let mut g = Outline::new(&list);
    let (x, t, s) = (g.input(&[1, 120, 25]), g.input(&[1]), g.input(&[1, 120, 768]));
    tokenizer.denoise(&mut g, &x, &t, &s).expect("shapes fit");
    // 4 blocks of 5 d² for the convolution, 3 d² for the modulation and 2 d² for the MLP, and 2 d² behind them.
    let macs_per_frame = g.flops() as f64 / 2.0 / 120.0;
    let expected = 42.0 * 768.0 * 768.0;
    assert!((0.99..1.02).contains(&(macs_per_frame / expected)), "{macs_per_frame}");
}
