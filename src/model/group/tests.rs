use super::*;
use crate::model::outline::Outline;
use crate::model::unet::Preset;

fn counts(preset: Preset) -> [usize; 2] {
    let config = GroupConfig::of(preset).expect("a preset of the family");
    [GroupDenoiser::new(&config).1.n_elements(), GroupScore::new(&config).1.n_elements()]
}

#[test]
fn the_base_is_as_large_as_the_network_of_the_paper_and_the_small_fits_beside_a_program() {
    let [denoiser, score] = counts(Preset::Base);
    let all = denoiser + score;
    // 62.16 M were counted in the published code.
    assert!((58_000_000..66_000_000).contains(&all), "{denoiser} + {score} = {all}");
    let small: usize = counts(Preset::Small).iter().sum();
    // 8 MB in half precision.
    assert!(small < 4_000_000, "{small}");
}

#[test]
fn shapes_are_followed_through_both_networks_and_every_parameter_is_met() {
    let config =
        GroupConfig { score_patch_frames: 4, ..GroupConfig::of(Preset::Tiny).expect("one") };
    let (batch, n_dancers, frames) = (2, 3, 7);
    let (denoiser, list) = GroupDenoiser::new(&config);
    let mut g = Outline::new(&list);
    let x = g.input(&[batch * n_dancers, frames, 25]);
    let (t, z) = (g.input(&[batch]), g.input(&[batch, config.width]));
    let audio = g.input(&[batch, frames, config.condition().dim()]);
    let mask = g.input(&[batch, n_dancers * frames]);
    let inputs = GroupInputs {
        x: &x,
        t: &t,
        audio: &audio,
        drop_audio: Some(&t),
        number: &t,
        z: &z,
        mask: Some(&mask),
    };
    let found = denoiser.forward(&mut g, &inputs).expect("shapes fit");
    assert_eq!((found.x0, found.w), (x.clone(), vec![batch, config.width]));
    let met: usize = unique(&g, &list);
    assert_eq!(met, list.n_elements());

    let (score, list) = GroupScore::new(&config);
    let mut g = Outline::new(&list);
    let of_each = g.input(&[batch * n_dancers]);
    let w = g.input(&[batch, config.width]);
    let mask = g.input(&[batch, n_dancers * 2]);
    let there = g.input(&[batch, n_dancers]);
    let (mask, there) = (Some(&mask), Some(&there));
    let inputs = GroupScoreInputs { x0: &x, t: &of_each, w: &w, number: &t, mask, there };
    let of_each = vec![batch, 1];
    let scores = GroupScores { log_ratio: of_each.clone(), agreement: of_each };
    assert_eq!(score.forward(&mut g, &inputs), Ok(scores));
    assert_eq!(unique(&g, &list), list.n_elements());
}

/// Returns the elements of all parameters that a network met, those of a layer that ran twice once.
fn unique(g: &Outline, list: &ParameterList) -> usize {
    let met: std::collections::BTreeSet<&str> =
        g.layers().iter().map(|layer| layer.name.as_str()).collect();
    let layer = |name: &str| name.rsplit_once('.').map_or(name, |(layer, _)| layer).to_owned();
    let is_met = |name: &str| met.contains(layer(name).as_str());
    list.iter().filter(|(_, p)| is_met(&p.name)).map(|(_, p)| p.len()).sum()
}
