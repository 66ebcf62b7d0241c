use super::*;
use crate::model::{DecoderConfig, MotionDecoder, Preset, UNet1D, UNetInputs};

#[test]
fn base_costs_what_was_counted_by_hand() {
    let (unet, list) = UNet1D::new(&Preset::Base.config());
    let mut outline = Outline::new(&list);
    let [x, t, audio] = [&[1, 120, 25][..], &[1], &[1, 120, 163]].map(|shape| outline.input(shape));
    let (drop_audio, mask, style) = (None, None, None);
    let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
    let y = unet.forward(&mut outline, inputs).unwrap();
    assert_eq!(y, [1, 120, 25]);
    // 5.84 GFLOP, the specification's figure.
    assert!((5.8e9..5.9e9).contains(&(outline.flops() as f64)), "{}", outline.flops());
    let conv = outline.layers().iter().find(|l| l.name == "encoder.1.res.0.conv1").unwrap();
    assert_eq!(conv.shape, [1, 60, 512]);
    assert_eq!(conv.n_parameters, 512 * 256 * 3 + 512);
    assert_eq!(conv.flops, 2 * 60 * 512 * 256 * 3);
    // Everything but the null context, which only dropped music uses.
    let met: usize = outline.layers().iter().map(|layer| layer.n_parameters).sum();
    assert_eq!(met, list.n_elements() - 256);
}

#[test]
fn any_number_of_blocks_and_levels_fits_together() {
    for num_res_blocks in [1, 2, 3] {
        for widths in [vec![8], vec![8, 12], vec![16, 8, 24, 12]] {
            let attention_levels = (0..widths.len()).collect();
            let config = crate::model::UNetConfig {
                widths,
                num_res_blocks,
                attention_levels,
                ..Preset::Tiny.config()
            };
            let (unet, list) = UNet1D::new(&config);
            let mut outline = Outline::new(&list);
            let [x, t, audio] =
                [&[2, 9, 25][..], &[2], &[2, 9, 163]].map(|shape| outline.input(shape));
            let (drop_audio, mask, style) = (Some(&t), None, None);
            let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
            let y = unet.forward(&mut outline, inputs);
            assert_eq!(y.as_deref(), Ok(&[2, 9, 25][..]), "{config:?}");
            let met: usize = outline.layers().iter().map(|layer| layer.n_parameters).sum();
            assert_eq!(met, list.n_elements(), "{config:?}");
        }
    }
}

#[test]
fn the_decoder_is_followed_too() {
    let (decoder, list) = MotionDecoder::new(&DecoderConfig::default());
    let mut outline = Outline::new(&list);
    let x = outline.input(&[2, 7, 25]);
    assert_eq!(decoder.forward(&mut outline, &x).unwrap(), [2, 7, 25]);
    let met: usize = outline.layers().iter().map(|layer| layer.n_parameters).sum();
    assert_eq!(met, list.n_elements());
}

#[test]
fn a_wrong_number_of_features_is_refused() {
    let (unet, list) = UNet1D::new(&Preset::Tiny.config());
    let mut outline = Outline::new(&list);
    let [x, t, audio] = [&[1, 8, 25][..], &[1], &[1, 8, 162]].map(|shape| outline.input(shape));
    let (drop_audio, mask, style) = (None, None, None);
    let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
    let error = unet.forward(&mut outline, inputs).unwrap_err();
    assert_eq!(
        error.to_string(),
        "linear: input has shape [1, 8, 162], audio_proj.weight has [32, 163]"
    );
}
