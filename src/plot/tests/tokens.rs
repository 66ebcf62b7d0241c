//! Tests of whole plots of tokens.

use super::{check_texts, decode, texts};
use crate::plot::scene::SceneItem;
use crate::plot::style::BLUE;
use crate::plot::tokens::scene;
use crate::plot::*;

fn plot(counts: &[u64]) -> TokensPlot<'_> {
    TokensPlot { title: "run tok", counts, perplexity: 2.83, n_phrases: 3 }
}

#[test]
fn codes_stand_in_the_order_of_their_use() {
    let counts = [0, 3, 12, 0, 5];
    let scene = scene(&plot(&counts), 640).expect("a scene");
    let bars: Vec<_> = scene
        .items
        .iter()
        .filter_map(|item| match item {
            SceneItem::Area { rect, color, .. } if *color == BLUE => Some(*rect),
            _ => None,
        })
        .collect();
    let heights: Vec<f64> = bars.iter().map(|bar| bar.height / bars[0].height * 12.0).collect();
    assert_eq!(heights.len(), 3, "codes that are not used have no bar");
    for (found, wanted) in heights.iter().zip([12.0, 5.0, 3.0]) {
        assert!((found - wanted).abs() < 1e-9, "{heights:?}");
    }
    assert!(bars.windows(2).all(|pair| pair[0].right() < pair[1].left));
    let texts = texts(&scene);
    for text in ["20 tokens", "of 3 phrases", "3 of 5 codes in use", "usage", "codes"] {
        assert!(texts.iter().any(|(found, _)| found == text), "{text}: {texts:?}");
    }
}

#[test]
fn many_codes_fit_and_none_are_refused() {
    let counts: Vec<u64> = (0..1024).map(|i| 1 + i * i % 97).collect();
    for width_px in [320, 1000, 2400] {
        let scene = scene(&plot(&counts), width_px).expect("a scene");
        check_texts(&scene, &format!("{width_px} px"));
        let picture = tokens(&plot(&counts), width_px, Format::Png).expect("a picture");
        let (width, height, _) = decode(&picture.bytes);
        assert_eq!((width, height), (picture.width_px as usize, picture.height_px as usize));
    }
    for counts in [&[][..], &[0, 0]] {
        let error = tokens(&plot(counts), 640, Format::Svg).expect_err("nothing to draw");
        assert_eq!(error.to_string(), "no tokens to plot; run motiongen tokenize first");
    }
}
