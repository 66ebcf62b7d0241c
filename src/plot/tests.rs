//! Tests of whole plots: what is on the page, and what is in the bytes.

mod group;
mod motion;
mod tokens;
mod training;

use ndarray::{Array2, ArrayView2};

use super::features::scene;
use super::panel::FEATURE_DIM;
use super::scene::{Rect, Scene, SceneItem, text_start_x};
use super::style::CAP_HEIGHT;
use super::*;

/// 128 frequencies that rise as mel bands do, roughly.
fn mel_hz() -> Vec<f64> {
    (0..128)
        .map(|i| 700.0 * (10f64.powf((0.02 + 1.08 * f64::from(i + 1) / 129.0) * 1.0) - 1.0))
        .collect()
}

/// Some plausible values: nothing in them is twice the same.
fn values(n_frames: usize) -> Array2<f32> {
    Array2::from_shape_fn((n_frames, FEATURE_DIM), |(t, k)| {
        let wave = (t as f32 * 0.37 + k as f32 * 1.7).sin();
        if (140..160).contains(&k) { 2.0 * wave } else { 0.5 + 0.5 * wave }
    })
}

fn plot<'a>(
    values: ArrayView2<'a, f32>,
    beat_times_s: &'a [f64],
    mel_hz: &'a [f64],
) -> FeaturesPlot<'a> {
    let title = "song.ogg";
    FeaturesPlot { title, values, beat_times_s, tempo_bpm: Some(120.0), mel_hz, start_s: 0.0 }
}

/// Decodes to width, height and red, green and blue bytes.
fn decode(bytes: &[u8]) -> (usize, usize, Vec<u8>) {
    let mut reader = ::png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    assert_eq!(info.color_type, ::png::ColorType::Rgb);
    (info.width as usize, info.height as usize, pixels)
}

/// Returns the texts of a scene with the boxes in which they are, as high as a capital.
fn texts(scene: &Scene) -> Vec<(String, Rect)> {
    let texts = scene.items.iter().filter_map(|item| match item {
        SceneItem::Text { at, anchor, text, size_px, .. } => {
            let left = text_start_x(*at, *anchor, text, *size_px);
            let (width, height) = (font::width_px(text, *size_px), size_px * CAP_HEIGHT);
            Some((text.clone(), Rect { left, top: at[1] - height, width, height }))
        }
        _ => None,
    });
    texts.collect()
}

fn images(scene: &Scene) -> Vec<Rect> {
    let images = scene.items.iter().filter_map(|item| match item {
        SceneItem::Image { rect, .. } => Some(*rect),
        _ => None,
    });
    images.collect()
}

#[test]
fn text_touches_neither_text_nor_heat_maps_nor_the_edge() {
    let (mel_hz, beats) = (mel_hz(), [0.1, 0.6, 1.1]);
    for n_frames in [0, 1, 2, 7, 241, 9000] {
        for width_px in [320, 457, 1000, 2400] {
            for start_s in [0.0, 12.34, -9e6, 9_999_999.0] {
                for panels in [&Panel::ALL[..], &[Panel::Mel], &[Panel::OnsetStrength]] {
                    let mut values = values(n_frames);
                    values.column_mut(150).map_inplace(|v| *v *= 1000.0);
                    values.column_mut(161).map_inplace(|v| *v *= -20_000.0);
                    let mut plot = plot(values.view(), &beats, &mel_hz);
                    plot.start_s = start_s;
                    plot.title = "A title that is much too long for a page of this width, I fear";
                    let scene = scene(&plot, panels, width_px).unwrap();
                    let case = format!("{n_frames} frames, {width_px} px, {start_s} s, {panels:?}");
                    check_texts(&scene, &case);
                }
            }
        }
    }
}

fn check_texts(scene: &Scene, case: &str) {
    let apart = |a: &Rect, b: &Rect| {
        a.right() <= b.left || b.right() <= a.left || a.bottom() <= b.top || b.bottom() <= a.top
    };
    let texts = texts(scene);
    assert!(texts.len() > 4, "{case}: {} texts", texts.len());
    for (i, (text, rect)) in texts.iter().enumerate() {
        let is_inside = rect.left >= 2.0
            && rect.top >= 2.0
            && rect.right() <= scene.width_px - 2.0
            && rect.bottom() <= scene.height_px - 2.0;
        assert!(is_inside, "{case}: {text:?} is cut off at {rect:?}");
        for (other, other_rect) in &texts[i + 1..] {
            assert!(apart(rect, other_rect), "{case}: {text:?} overlaps {other:?}");
        }
        for image in images(scene) {
            assert!(apart(rect, &image), "{case}: {text:?} overlaps an image at {image:?}");
        }
    }
}

#[test]
fn the_png_has_the_page_at_two_pixels_for_one() {
    let (values, mel_hz) = (values(33), mel_hz());
    let plot = plot(values.view(), &[], &mel_hz);
    for width_px in [333, 1000] {
        let scene = scene(&plot, &Panel::ALL, width_px).unwrap();
        let picture = features(&plot, &Panel::ALL, width_px, Format::Png).unwrap();
        let (width, height, pixels) = decode(&picture.bytes);
        assert_eq!((picture.width_px as usize, picture.height_px as usize), (width, height));
        assert_eq!((width, height), (2 * width_px as usize, (2.0 * scene.height_px) as usize));
        assert_eq!(pixels[..3], [255; 3], "the corner is paper");
    }
}

#[test]
fn a_bright_cell_is_where_its_band_and_frame_are() {
    let mel_hz = mel_hz();
    let mut values = Array2::zeros((10, FEATURE_DIM));
    values[[7, 2]] = 1.0;
    values[[3, 127]] = f32::NAN;
    let plot = plot(values.view(), &[], &mel_hz);
    let map = images(&scene(&plot, &[Panel::Mel], 800).unwrap())[0];
    let (width, _, pixels) =
        decode(&features(&plot, &[Panel::Mel], 800, Format::Png).unwrap().bytes);
    let color = |frame: f64, band: f64| {
        let x = 2.0 * (map.left + (frame + 0.5) / 10.0 * map.width);
        let y = 2.0 * (map.bottom() - (band + 0.5) / 128.0 * map.height);
        let at = 3 * (y as usize * width + x as usize);
        [pixels[at], pixels[at + 1], pixels[at + 2]]
    };
    let (bright, dark, missing) = ([0xfc, 0xfd, 0xbf], [0, 0, 4], style::MISSING);
    let cases = [
        (7.0, 2.0, bright),
        (6.0, 2.0, dark),
        (8.0, 2.0, dark),
        (7.0, 1.0, dark),
        (7.0, 3.0, dark),
        (3.0, 127.0, missing),
        (3.0, 126.0, dark),
        // Just inside the four edges of the bright cell.
        (6.52, 2.0, bright),
        (7.48, 2.0, bright),
        (7.0, 1.7, bright),
        (7.0, 2.3, bright),
    ];
    for (frame, band, wanted) in cases {
        assert_eq!(color(frame, band), wanted, "frame {frame}, band {band}");
    }
}

#[test]
fn beats_are_lines_over_the_onset_panel() {
    let (mel_hz, beats) = (mel_hz(), [0.5, 99.0, f64::NAN]);
    let values = Array2::zeros((31, FEATURE_DIM));
    let plot = plot(values.view(), &beats, &mel_hz);
    let panels = [Panel::OnsetStrength];
    let (width, height, pixels) =
        decode(&features(&plot, &panels, 500, Format::Png).unwrap().bytes);
    // Half a second is frame 15 of 31: the middle of the panel.
    let is_beat = |x: usize| pixels[3 * (height / 2 * width + x)..][..3] == style::VERMILLION;
    let found: Vec<_> = (0..width).filter(|&x| is_beat(x)).collect();
    let middle = 64 + (500 - 64 - 28) / 2;
    assert_eq!(found, [2 * middle - 1, 2 * middle]);
    let texts = texts(&scene(&plot, &panels, 500).unwrap());
    assert!(texts.iter().any(|(text, _)| text == "1 beat"), "{texts:?}");
}

#[test]
fn the_svg_has_its_labels_and_stays_small() {
    let (mel_hz, beats) = (mel_hz(), [0.5, 1.0]);
    let values = values(241);
    let mut plot = plot(values.view(), &beats, &mel_hz);
    plot.title = "Tom & Jerry <live>";
    let picture = features(&plot, &Panel::ALL, 1000, Format::Svg).unwrap();
    assert_eq!(picture.width_px, 1000);
    let svg = String::from_utf8(picture.bytes).unwrap();
    let wanted = [
        "<title>Tom &amp; Jerry &lt;live&gt;</title>",
        ">Tom &amp; Jerry &lt;live&gt;</text>",
        ">8.03 s<",
        ">241 frames at 30 fps<",
        ">120.0 bpm<",
        ">2 beats<",
        ">Mel spectrum<",
        ">Hz<",
        ">100<",
        ">200<",
        ">500<",
        ">1000<",
        ">2000<",
        ">5000<",
        ">C♯<",
        ">B<",
        ">MFCC<",
        ">RMS<",
        ">Spectral centroid<",
        ">Onset strength<",
        ">time (s)<",
        ">0.5<",
    ];
    for text in wanted {
        assert!(svg.contains(text), "no {text} in the plot");
    }
    assert_eq!(svg.matches("<image ").count(), 6, "three heat maps and three bars");
    assert!(svg.len() < 150_000, "{} bytes", svg.len());
}

#[test]
fn two_hours_are_brought_to_the_width_of_the_page() {
    let (values, mel_hz) = (values(216_000), mel_hz());
    let beats: Vec<f64> = (0..14_400).map(|i| f64::from(i) * 0.5).collect();
    let plot = plot(values.view(), &beats, &mel_hz);
    let svg = features(&plot, &Panel::ALL, 1000, Format::Svg).unwrap().bytes;
    assert!(svg.len() < 1_000_000, "{} bytes", svg.len());
    let svg = String::from_utf8(svg).unwrap();
    assert!(svg.contains(">14400 beats, too close to draw<"));
    assert!(svg.contains(">columns: means of "), "the plot does not say that it shows means");
    assert!(features(&plot, &Panel::ALL, 1000, Format::Png).unwrap().bytes.len() < 2_000_000);
}

#[test]
fn odd_input_is_drawn_all_the_same() {
    let mel_hz = mel_hz();
    let nothing = Array2::zeros((0, FEATURE_DIM));
    let broken = Array2::from_elem((50, FEATURE_DIM), f32::NAN);
    let mut huge = values(50);
    huge.row_mut(10).fill(f32::MAX);
    huge.row_mut(11).fill(f32::MIN);
    huge.row_mut(12).fill(f32::INFINITY);
    for values in [nothing, broken, huge, values(1), values(2)] {
        for format in [Format::Png, Format::Svg] {
            let mut plot = plot(values.view(), &[0.0, f64::NAN, f64::INFINITY, -1e300], &mel_hz);
            plot.tempo_bpm = Some(f64::NAN);
            plot.title = "";
            let bytes = features(&plot, &Panel::ALL, 321, format).unwrap().bytes;
            assert!(bytes.len() > 1000, "{} bytes", bytes.len());
        }
    }
}

#[test]
fn the_same_plot_gives_the_same_bytes() {
    let (values, mel_hz) = (values(60), mel_hz());
    let plot = plot(values.view(), &[0.5], &mel_hz);
    for format in [Format::Png, Format::Svg] {
        let bytes = || features(&plot, &Panel::ALL, 640, format).unwrap();
        assert_eq!(bytes(), bytes());
    }
}

#[test]
fn what_cannot_be_plotted_is_said() {
    let (values, mel_hz) = (values(5), mel_hz());
    let good = plot(values.view(), &[], &mel_hz);
    let narrow = Array2::zeros((5, 25));
    let (mut flat, short) = (mel_hz.clone(), &mel_hz[..100]);
    flat[7] = flat[6];
    let all = &Panel::ALL[..];
    let cases: [(FeaturesPlot<'_>, &[Panel], u32, &str); 8] = [
        (
            good,
            &[],
            800,
            "no panels to plot; ask for one of mel, chroma, mfcc, rms, spectral_centroid, onset_strength",
        ),
        (good, all, 319, "plot is 319 px wide; choose a width from 320 to 8192 px"),
        (good, all, 8193, "plot is 8193 px wide; choose a width from 320 to 8192 px"),
        (
            FeaturesPlot { values: narrow.view(), ..good },
            all,
            800,
            "features have 25 values per frame; a plot needs 163",
        ),
        (
            FeaturesPlot { mel_hz: short, ..good },
            all,
            800,
            "100 mel band frequencies; a plot needs 128 that are finite, above 0 Hz and rise",
        ),
        (
            FeaturesPlot { mel_hz: &flat, ..good },
            all,
            800,
            "128 mel band frequencies; a plot needs 128 that are finite, above 0 Hz and rise",
        ),
        (
            FeaturesPlot { start_s: f64::NAN, ..good },
            all,
            800,
            "the first frame is at NaN s; a plot needs a time within ±10000000 s",
        ),
        (
            good,
            &[Panel::Mel; 50],
            800,
            "plot is 1600 × 36646 px; ask for fewer panels or a smaller width",
        ),
    ];
    for (plot, panels, width_px, wanted) in cases {
        let found = features(&plot, panels, width_px, Format::Png).unwrap_err();
        assert_eq!(found.to_string(), wanted);
    }
}

#[test]
fn formats_are_told_by_the_extension() {
    let cases = [("png", Some(Format::Png)), ("SVG", Some(Format::Svg)), ("pdf", None), ("", None)];
    for (extension, wanted) in cases {
        assert_eq!(Format::of_path_extension(extension), wanted, "{extension:?}");
    }
}
