//! Tests of whole plots of training.

use super::{check_texts, decode, texts};
use crate::plot::scene::{Point, Rect, Scene, SceneItem};
use crate::plot::style::{BLUE, GREEN, INK, PURPLE, Rgb, VERMILLION};
use crate::plot::training::scene;
use crate::plot::*;

/// A loss that falls from 1 to 0.01 on a straight line of a log scale.
fn loss(step: u64, n_steps: u64) -> f64 {
    10f64.powf(-2.0 * (step - 1) as f64 / (n_steps.max(2) - 1) as f64)
}

/// Curves of a stage with `n_steps` steps, four epochs and four validations.
fn stage(stage: TrainingStage, n_steps: u64, panels: &[TrainingPanel]) -> StageCurves {
    let scattered = |step: u64| loss(step, n_steps) * (1.0 + 0.5 * (step as f64 * 1.7).sin());
    let some: Vec<u64> =
        (1..=4).map(|i| (i * u128::from(n_steps) / 4) as u64).filter(|&step| step > 0).collect();
    let at_some = |factor: f64| some.iter().map(|&s| (s, factor * loss(s, n_steps))).collect();
    let panels = panels.iter().map(|&panel| PanelCurves {
        steps: (1..=n_steps).map(|step| (step, scattered(step))).collect(),
        decoder_steps: match panel {
            TrainingPanel::LearningRate => (1..=n_steps).map(|step| (step, 0.4)).collect(),
            _ => Vec::new(),
        },
        epochs: at_some(1.0),
        validation: at_some(1.1),
        live_validation: at_some(1.3),
        ..PanelCurves::new(panel)
    });
    StageCurves {
        stage,
        n_steps,
        n_epochs: 4,
        elapsed_s: 754.0,
        n_skipped: 2,
        best: some.last().map(|&step| (step, 1.1 * loss(step, n_steps))),
        panels: panels.collect(),
    }
}

/// A stage with one panel and one curve.
fn alone(panel: TrainingPanel, steps: Vec<(u64, f64)>, n_steps: u64) -> StageCurves {
    let panels = vec![PanelCurves { steps, ..PanelCurves::new(panel) }];
    StageCurves {
        panels,
        best: None,
        n_skipped: 0,
        ..stage(TrainingStage::Diffusion, n_steps, &[])
    }
}

fn plot(stages: &[StageCurves]) -> TrainingPlot<'_> {
    TrainingPlot { title: "first-run", stages }
}

/// Returns the lines of a colour that are no dots.
fn lines(scene: &Scene, wanted: Rgb) -> Vec<&[Point]> {
    let lines = scene.items.iter().filter_map(|item| match item {
        SceneItem::Polyline { points, color, .. } => {
            let is_line = points.iter().any(|p| (p[0] - points[0][0]).abs() > 0.1);
            (*color == wanted && is_line).then_some(points.as_slice())
        }
        _ => None,
    });
    lines.collect()
}

fn assert_near(found: Point, wanted: Point, what: &str) {
    let far = (found[0] - wanted[0]).abs().max((found[1] - wanted[1]).abs());
    assert!(far < 1e-6, "{what}: {found:?} instead of {wanted:?}");
}

#[test]
fn text_touches_neither_text_nor_the_edge() {
    let usual = |s: TrainingStage| (s, s.usual_panels());
    let all = |s: TrainingStage| (s, s.panels());
    let sets = [
        TrainingStage::ALL.map(usual).to_vec(),
        TrainingStage::ALL.map(all).to_vec(),
        vec![(TrainingStage::Finetune, &[TrainingPanel::Jerk][..])],
        vec![(TrainingStage::Decoder, &[TrainingPanel::DecoderPosition][..])],
    ];
    for n_steps in [0, 1, 2, 7, 240, 30_000] {
        for width_px in [320, 457, 560, 1000, 2400] {
            for factor in [1.0, 3e-9, 7e12] {
                for set in &sets {
                    let mut stages: Vec<_> =
                        set.iter().map(|&(s, panels)| stage(s, n_steps, panels)).collect();
                    for panel in stages.iter_mut().flat_map(|s| &mut s.panels) {
                        panel.steps.iter_mut().for_each(|(_, value)| *value *= factor);
                        // One more line of facts.
                        panel.epochs.push((n_steps, -1.0));
                    }
                    let mut plot = plot(&stages);
                    plot.title = "A name that is much too long for a page of this width, I fear";
                    let scene = scene(&plot, width_px).unwrap();
                    let case = format!("{n_steps} steps, {width_px} px, × {factor}, {set:?}");
                    check_texts(&scene, &case);
                }
            }
        }
    }
}

#[test]
fn curves_are_where_their_values_are() {
    let steps: Vec<_> = (1..=40).map(|step| (step, loss(step, 40))).collect();
    let mut stage = alone(TrainingPanel::Loss, steps, 40);
    stage.panels[0].epochs = vec![(10, 0.1), (40, 0.02)];
    stage.panels[0].validation = vec![(20, 0.1), (30, f64::NAN), (40, 1.0)];
    stage.panels[0].live_validation = vec![(20, 0.01), (40, 0.1)];
    stage.best = Some((20, 0.1));
    let scene = scene(&plot(&[stage]), 1000).unwrap();
    // The panel begins below title, heading, facts, legend and its own heading; two decades and a
    // tenth of one at each end share its height.
    let (top, height) = (76.0 + 20.0 + 17.0 + 2.0 + 14.0 + 26.0, 320.0);
    let at = |step: f64, decades: f64| {
        [64.0 + step / 40.0 * 908.0, top + height * (0.1 - decades) / 2.2]
    };
    let blue = lines(&scene, BLUE);
    assert_eq!(blue.len(), 2, "the curve and its key");
    assert_eq!(blue[1].len(), 40);
    assert_near(blue[1][0], at(1.0, 0.0), "first step");
    assert_near(blue[1][13], at(14.0, -2.0 / 3.0), "step 14");
    assert_near(blue[1][39], at(40.0, -2.0), "last step");
    assert_near(lines(&scene, INK)[1][1], at(40.0, 0.02f64.log10()), "last epoch");
    let validation = lines(&scene, VERMILLION)[1];
    assert_eq!(validation.len(), 2, "what is not a number is left out");
    assert_near(validation[0], at(20.0, -1.0), "first validation");
    assert_near(validation[1], at(40.0, 0.0), "last validation");
    assert_near(lines(&scene, GREEN)[1][0], at(20.0, -2.0), "first validation of live weights");
    let places = texts(&scene);
    for (label, decades) in [("1", 0.0), ("0.5", 0.5f64.log10()), ("0.1", -1.0), ("0.01", -2.0)] {
        let middle = |rect: &Rect| rect.top + rect.height / 2.0;
        let is_there = places.iter().any(|(text, rect)| {
            text == label && (middle(rect) - at(0.0, decades)[1]).abs() < 0.3 && rect.left < 64.0
        });
        assert!(is_there, "no {label} beside its place in {places:?}");
    }
    assert!(places.iter().any(|(text, _)| text == "1 value left out: not above 0, or not finite"));
}

#[test]
fn the_best_validation_is_a_ring_in_the_bitmap() {
    let mut stage = alone(TrainingPanel::Loss, vec![(1, 1.0), (40, 0.01)], 40);
    stage.best = Some((20, 0.1));
    let picture = training(&plot(&[stage]), 777, Format::Png).unwrap();
    let (width, height, pixels) = decode(&picture.bytes);
    assert_eq!((picture.width_px as usize, picture.height_px as usize), (width, height));
    assert_eq!(width, 2 * 777);
    let color = |x: f64, y: f64| {
        let at = 3 * ((2.0 * y) as usize * width + (2.0 * x) as usize);
        [pixels[at], pixels[at + 1], pixels[at + 2]]
    };
    // Half of the way, and the middle of the axis.
    let (x, y) = (64.0 + (777.0 - 64.0 - 28.0) / 2.0, 155.0 + 160.0);
    let cases = [(0.0, 0.0, [255; 3]), (4.0, 0.0, VERMILLION), (0.0, -4.0, VERMILLION)];
    for (dx, dy, wanted) in cases {
        assert_eq!(color(x + dx, y + dy), wanted, "{dx}, {dy} from the best");
    }
}

#[test]
fn many_steps_are_a_band_and_a_mean() {
    let steps: Vec<_> = (1..=9080).map(|step| (step, [0.01, 1.0][step as usize % 2])).collect();
    let scene = scene(&plot(&[alone(TrainingPanel::Loss, steps, 9080)]), 1000).unwrap();
    let band = scene.items.iter().find_map(|item| match item {
        SceneItem::Polygon { points, .. } => Some(points),
        _ => None,
    });
    let band = band.expect("a band");
    assert_eq!(band.len(), 2 * 454);
    let (top, height) = (155.0, 320.0);
    // The middle of the first 20 steps.
    let x = 64.0 + 10.5 / 9080.0 * 908.0;
    assert_near(band[0], [x, top + height * 0.1 / 2.2], "greatest value");
    assert_near(band[907], [x, top + height * 2.1 / 2.2], "least value");
    let mean = top + height * (0.1 - 0.505f64.log10()) / 2.2;
    assert_near(lines(&scene, BLUE)[1][0], [x, mean], "mean");
    assert!(texts(&scene).iter().any(|(text, _)| text == "mean and range of 20 steps"));
}

#[test]
fn a_linear_panel_begins_at_zero_and_tells_of_its_peaks() {
    let steps: Vec<_> = (1..=200).map(|step| (step, if step == 9 { 73.0 } else { 1.0 })).collect();
    let scene = scene(&plot(&[alone(TrainingPanel::GradientNorm, steps, 200)]), 1000).unwrap();
    let curve = lines(&scene, BLUE)[1];
    let x = |step: f64| 64.0 + step / 200.0 * 908.0;
    assert_near(curve[0], [x(1.0), 155.0 + 160.0], "half of the axis");
    assert_near(curve[8], [x(9.0), 155.0], "the peak, at the head of the axis");
    let wanted = "before it is clipped; up to 73, beyond the axis";
    assert!(texts(&scene).iter().any(|(text, _)| text == wanted), "{:?}", texts(&scene));
}

#[test]
fn fine_tuning_has_the_six_panels_of_the_reference_in_three_rows() {
    let finetune = TrainingStage::Finetune;
    let drawn = stage(finetune, 500, finetune.usual_panels());
    let wide = scene(&plot(std::slice::from_ref(&drawn)), 1000).unwrap();
    let headings = [
        "Total loss",
        "Diffusion",
        "Decoder position",
        "Velocity coherence",
        "Acceleration coherence",
        "Jerk",
    ];
    let left_top = |scene: &Scene, heading: &str| {
        let places = texts(scene);
        let (_, rect) = places.iter().find(|(text, _)| text == heading).expect(heading);
        (rect.left, rect.top)
    };
    let places = headings.map(|heading| left_top(&wide, heading));
    let right = 64.0 + (908.0 - 64.0) / 2.0 + 64.0;
    for (i, (left, top)) in places.into_iter().enumerate() {
        assert_eq!(left, [64.0, right][i % 2], "{}", headings[i]);
        let row_px = 170.0 + 26.0 + 18.0;
        assert!((top - places[0].1 - row_px * (i / 2) as f64).abs() < 1e-9, "{}", headings[i]);
    }
    let n_steps_titles = texts(&wide).iter().filter(|(text, _)| text == "step").count();
    assert_eq!(n_steps_titles, 2, "one below each column");
    // Too narrow for two columns.
    let narrow = scene(&plot(&[drawn]), 500).unwrap();
    assert!(headings.iter().all(|heading| left_top(&narrow, heading).0 == 64.0));
}

#[test]
fn the_learning_rates_of_two_networks_are_two_curves() {
    let drawn = stage(TrainingStage::Finetune, 30, &[TrainingPanel::LearningRate]);
    let scene = scene(&plot(&[drawn]), 800).unwrap();
    let [_, curve] = lines(&scene, PURPLE)[..] else { panic!("a key and a curve") };
    assert!(curve.iter().all(|point| point[1] == curve[0][1]));
    assert!(texts(&scene).iter().any(|(text, _)| text == "decoder’s learning rate"));
}

#[test]
fn the_svg_has_its_facts_and_stages_in_their_order() {
    let stages = TrainingStage::ALL.map(|s| stage(s, 240, s.usual_panels()));
    let picture = training(&plot(&stages), 1000, Format::Svg).unwrap();
    let svg = String::from_utf8(picture.bytes).unwrap();
    for text in [
        "<title>first-run</title>",
        ">first-run</text>",
        ">240 steps<",
        ">4 epochs<",
        ">12.6 min<",
        ">best validation loss 0.011 at step 240<",
        ">2 steps skipped<",
        ">steps<",
        ">mean of an epoch<",
        ">validation, averaged weights<",
        ">validation, live weights<",
        ">best<",
        ">Gradient norm<",
        ">Learning rate<",
        ">m²<",
        ">200<",
    ] {
        assert!(svg.contains(text), "no {text} in the plot");
    }
    let at = |heading: &str| svg.find(&format!("font-size=\"15\" fill=\"#1f2328\">{heading}<"));
    let places = ["Diffusion", "Decoder", "Fine-tuning", "Groups", "Tokenizer", "Planner"];
    let places = places.map(|h| at(h).expect(h));
    assert!(places.is_sorted(), "{places:?}");
}

#[test]
fn a_long_run_is_drawn_small() {
    let stages = TrainingStage::ALL.map(|s| stage(s, 100_000, s.panels()));
    let started = std::time::Instant::now();
    let svg = training(&plot(&stages), 1000, Format::Svg).unwrap().bytes;
    let png = training(&plot(&stages), 1000, Format::Png).unwrap().bytes;
    let n_panels: usize = stages.iter().map(|stage| stage.panels.len()).sum();
    assert!(svg.len() < 50_000 * n_panels, "{} bytes", svg.len());
    assert!(png.len() < 100_000 * n_panels, "{} bytes", png.len());
    // Much longer than it takes; a plot that grew with the steps would take longer still.
    assert!(started.elapsed().as_secs() < 30, "{:?}", started.elapsed());
}

#[test]
fn odd_input_is_drawn_all_the_same() {
    let odd = [f64::NAN, f64::INFINITY, -1.0, 0.0, f64::MAX, f64::MIN_POSITIVE, 1e-320, -1e300];
    let numbered = |values: &[f64]| (1..).zip(values.iter().copied()).collect::<Vec<_>>();
    let cases = [
        vec![],
        numbered(&odd),
        numbered(&odd[..4]),
        numbered(&[f64::NAN; 5]),
        vec![(0, 1.0)],
        vec![(u64::MAX, 1.0), (3, 2.0), (3, 4.0)],
    ];
    for values in cases {
        for n_steps in [0, 1, 8, u64::MAX] {
            for panel in [TrainingPanel::Loss, TrainingPanel::GradientNorm] {
                let mut stage = alone(panel, values.clone(), n_steps);
                stage.panels[0].validation.clone_from(&values);
                stage.elapsed_s = f64::NAN;
                stage.best = Some((u64::MAX, f64::INFINITY));
                for format in [Format::Png, Format::Svg] {
                    let bytes = training(&plot(&[stage.clone()]), 321, format).unwrap().bytes;
                    let text = String::from_utf8_lossy(&bytes);
                    let is_number =
                        |number: &str| number.parse::<f64>().is_ok_and(|x| x.abs() <= 10_000.0);
                    for points in text.split("points=\"").skip(1) {
                        let points = points.split('"').next().unwrap_or_default();
                        assert!(
                            points.split([' ', ',']).all(is_number),
                            "{points} in {n_steps} steps of {values:?}"
                        );
                    }
                }
            }
        }
    }
}

#[test]
fn the_same_plot_gives_the_same_bytes() {
    let stages = TrainingStage::ALL.map(|s| stage(s, 300, s.panels()));
    for format in [Format::Png, Format::Svg] {
        let bytes = || training(&plot(&stages), 640, format).unwrap();
        assert_eq!(bytes(), bytes());
    }
}

#[test]
fn what_cannot_be_plotted_is_said() {
    let good = [stage(TrainingStage::Decoder, 5, &[TrainingPanel::Loss])];
    let empty = [stage(TrainingStage::Decoder, 5, &[])];
    let many = [stage(TrainingStage::Decoder, 5, &[TrainingPanel::DecoderPosition; 90])];
    let cases: [(&[StageCurves], u32, &str); 4] = [
        (&good, 319, "plot is 319 px wide; choose a width from 320 to 8192 px"),
        (
            &[],
            800,
            "no panels to plot; ask for one of loss, diffusion, decoder_position, \
             velocity_coherence, acceleration_coherence, jerk, decoder_quaternion, \
             quaternion_delta, phase_monotonic, position_smoothness, markers, contrast, commitment, \
             perplexity, gradient_norm, learning_rate",
        ),
        (&empty, 800, "no panels to plot"),
        (&many, 800, "plot is 1600 × 35272 px; ask for fewer panels or a smaller width"),
    ];
    for (stages, width_px, wanted) in cases {
        let found = training(&plot(stages), width_px, Format::Png).unwrap_err().to_string();
        assert!(found.starts_with(wanted), "{found}");
    }
}
