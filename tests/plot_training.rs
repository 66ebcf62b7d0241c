//! `plot training`: pictures of the log of a run, and every mistake with them.

use std::path::Path;

use motiongen::plot::TrainingStage;
use motiongen::store::tables::TrainingLogRow;
use motiongen::store::{Commit, Item, Ledger, Location, Row as _, TimestampUs};
use motiongen::training::{
    DecoderLearner, DiffusionLearner, FinetuneLearner, GroupLearner, Learner as _, PlannerLearner,
    RowKind, TokensLearner,
};

use crate::support::plots::{self, png_size, svg, text};
use crate::support::{Dir, finish, motiongen};

/// Draws, and returns the summary.
#[track_caller]
fn drawn(arguments: &[&str]) -> String {
    plots::drawn("training", arguments)
}

/// Returns the sentence with which the program refuses.
#[track_caller]
fn refusal(arguments: &[&str]) -> String {
    plots::refusal("training", arguments)
}

/// A row of which nothing but its place is known.
fn row(run: &str, stage: &str, kind: RowKind, epoch: i32, step: i64) -> TrainingLogRow {
    TrainingLogRow {
        segment: format!("{run}/{stage}/00000000"),
        run: run.to_owned(),
        stage: stage.to_owned(),
        kind: kind.name().to_owned(),
        epoch,
        step,
        learning_rate: None,
        lr_decoder: None,
        loss: None,
        loss_live: None,
        diffusion: None,
        reconstruction: None,
        decoder_position: None,
        decoder_quaternion: None,
        velocity_coherence: None,
        acceleration_coherence: None,
        jerk: None,
        quaternion_delta: None,
        phase_monotonic: None,
        position_smoothness: None,
        velocity_error: None,
        acceleration_error: None,
        quaternion_pass_rate: None,
        speed_ratio: None,
        markers: None,
        contrast: None,
        sampled_distance: None,
        commitment: None,
        perplexity: None,
        gradient_norm: None,
        skipped: false,
        samples_per_s: None,
        data_wait_s: None,
        rss_bytes: None,
        elapsed_s: 1.5 * step as f64,
        time: TimestampUs(0),
    }
}

/// A loss that falls from 1 to 0.01 on a straight line of a log scale.
fn loss(step: i64, n_steps: i64) -> f64 {
    10f64.powf(-2.0 * (step - 1) as f64 / (n_steps - 1) as f64)
}

/// Rows of a stage with an epoch every 10 steps and a validation every 20.
///
/// Step 7 is skipped; the best validation is the last but one.
fn rows(run: &str, stage: &str, n_steps: i64) -> Vec<TrainingLogRow> {
    let is_finetune = stage == "finetune";
    let mut rows = Vec::new();
    for step in 1..=n_steps {
        let (loss, epoch) = (loss(step, n_steps), (step - 1) as i32 / 10 + 1);
        let is_skipped = step == 7;
        let part =
            |factor: f64| is_finetune.then_some(if is_skipped { f64::NAN } else { factor * loss });
        let taken = TrainingLogRow {
            learning_rate: Some(1e-4),
            lr_decoder: is_finetune.then_some(5e-5),
            loss: (!is_skipped).then_some(loss),
            gradient_norm: (!is_skipped).then_some(0.5),
            skipped: is_skipped,
            diffusion: part(0.5),
            decoder_position: part(0.2),
            decoder_quaternion: part(0.1),
            velocity_coherence: part(3.0),
            acceleration_coherence: part(2.0),
            jerk: part(1e-6),
            quaternion_delta: is_finetune.then_some(0.0),
            phase_monotonic: part(0.01),
            position_smoothness: part(0.02),
            ..row(run, stage, RowKind::Step, epoch, step)
        };
        rows.push(taken);
        if step % 10 == 0 {
            rows.push(TrainingLogRow {
                loss: Some(loss),
                ..row(run, stage, RowKind::Epoch, epoch, step)
            });
        }
        if step % 20 == 0 {
            let validation = if step == n_steps { 0.9 } else { 1.5 * loss };
            rows.push(TrainingLogRow {
                loss: Some(validation),
                loss_live: (!is_finetune).then_some(2.0 * loss),
                ..row(run, stage, RowKind::Validation, epoch, step)
            });
        }
    }
    rows
}

/// Commits rows of one stage of one run.
fn commit(store: &Path, rows: &[TrainingLogRow]) {
    let store = Location::local(store).expect("a folder");
    let ledger = Ledger::read(&store, "train").expect("commits");
    let mut commit = Commit::new(&store, "train", "", "run");
    let schema = TrainingLogRow::schema;
    commit.part(schema().name, schema).expect("a part").write_rows(rows).expect("rows");
    let id = rows[0].segment.clone();
    let item = Item { fingerprint: id.clone(), input_hash: id.clone(), id, failure: None };
    commit.settle(item, &ledger);
    commit.publish().expect("published");
}

/// Makes a store with a run of all stages and one of two.
fn store(dir: &Dir) -> String {
    let store = dir.at("store");
    // Not in the order of the pipeline, nor of steps.
    let mut finetune = rows("whole", "finetune", 60);
    finetune.reverse();
    commit(&store, &finetune);
    commit(&store, &rows("whole", "diffusion", 100));
    commit(&store, &rows("whole", "decoder", 40));
    commit(&store, &rows("half", "diffusion", 40));
    text(&store)
}

#[test]
fn stages_are_called_what_training_calls_them() {
    let learners = [
        DiffusionLearner::STAGE,
        DecoderLearner::STAGE,
        FinetuneLearner::STAGE,
        GroupLearner::STAGE,
        TokensLearner::STAGE,
        PlannerLearner::STAGE,
    ];
    assert_eq!(TrainingStage::ALL.map(TrainingStage::name), learners);
}

#[test]
fn a_run_is_drawn_as_png() {
    let dir = Dir::new();
    let store = store(&dir);
    let path = text(&dir.at("pictures/run.png"));
    let flags = ["--store", &store, "--run", "whole", "--output", &path];
    let summary = drawn(&flags);
    let (width, height) = (2000, 4524);
    assert_eq!(
        summary,
        format!(
            "100 steps of diffusion, 40 of decoder, 60 of finetune → {path} ({width} × {height} \
             px)\n"
        )
    );
    assert_eq!(png_size(&path), (width, height));
    let first = std::fs::read(&path).expect("a picture");
    drawn(&flags);
    assert_eq!(std::fs::read(&path).expect("a picture"), first, "the same run, other bytes");
    // Nothing else is left in the folder.
    assert_eq!(std::fs::read_dir(dir.at("pictures")).expect("the folder").count(), 1);
}

#[test]
fn an_svg_has_the_curves_where_the_losses_are() {
    let dir = Dir::new();
    let store = store(&dir);
    let path = text(&dir.at("half.svg"));
    let flags = ["--store", &store, "--run", "half", "--output", &path];
    let summary = drawn(&flags);
    assert_eq!(summary, format!("40 steps of diffusion → {path} (1000 × 780 px)\n"));
    let picture = svg(&path);
    for label in [
        "<title>half</title>",
        "width=\"1000\" height=\"780\"",
        ">Diffusion<",
        ">40 steps<",
        ">4 epochs<",
        ">1 min<",
        ">1 step skipped<",
        ">validation, averaged weights<",
        ">validation, live weights<",
        ">Gradient norm<",
        ">Learning rate<",
        ">1e−4<",
        ">step<",
        ">20<",
    ] {
        assert!(picture.contains(label), "no {label} in the picture");
    }
    let best = 1.5 * loss(20, 40);
    assert!(picture.contains(&format!(">best validation loss {best:.3} at step 20<")));
    // The panel of the loss is from y = 155 to 435; values go from 0.01 to 1, with a tenth of a decade
    // more at each end.
    let point = |step: i64, value: f64| {
        let x = 64.0 + step as f64 / 40.0 * 908.0;
        let y = 155.0 + 280.0 * (0.1 - value.log10()) / 2.2;
        let short =
            |x: f64| format!("{x:.2}").trim_end_matches('0').trim_end_matches('.').to_owned();
        format!("{},{}", short(x), short(y))
    };
    let lines = |points: &[String]| format!("<polyline points=\"{}\"", points.join(" "));
    let before: Vec<_> = (1..7).map(|step| point(step, loss(step, 40))).collect();
    let after: Vec<_> = (8..=40).map(|step| point(step, loss(step, 40))).collect();
    let validation = [point(20, best), point(40, 0.9)];
    let live = [20, 40].map(|step| point(step, 2.0 * loss(step, 40)));
    let epochs = [10, 20, 30, 40].map(|end| point(end - 5, loss(end, 40)));
    for points in [&before[..], &after, &validation, &live, &epochs] {
        let line = lines(points);
        assert!(
            picture.contains(&format!("{line} fill")) || picture.contains(&format!("{line}\""))
        );
    }
    assert!(picture.contains(">0.05<") && picture.contains(">0.01<"));
    // The same bytes again.
    drawn(&flags);
    assert_eq!(svg(&path), picture);
}

#[test]
fn tokenizers_and_planners_have_panels_of_their_own() {
    let dir = Dir::new();
    let place = dir.at("store");
    let of_codes = rows("tok", "tokens", 40).into_iter().map(|row| TrainingLogRow {
        diffusion: row.loss,
        commitment: row.loss.map(|loss| 0.3 * loss),
        perplexity: row.loss.map(|loss| 1.0 / loss),
        ..row
    });
    commit(&place, &of_codes.collect::<Vec<_>>());
    commit(&place, &rows("plan", "planner", 60));
    let (store, path) = (text(&place), text(&dir.at("run.svg")));
    let headings = |run: &str, panels: &[&str]| {
        let flags = [&["--store", &store, "--run", run, "--output", &path], panels].concat();
        let summary = drawn(&flags);
        let picture = svg(&path);
        let all =
            ["Loss", "Diffusion", "Commitment", "Perplexity", "Gradient norm", "Learning rate"];
        let has = |heading: &&str| {
            picture.contains(&format!("font-size=\"13\" fill=\"#1f2328\">{heading}<"))
        };
        (summary, all.into_iter().filter(has).collect::<Vec<_>>())
    };
    let (summary, found) = headings("tok", &[]);
    assert!(summary.starts_with("40 steps of tokens → "), "{summary}");
    assert_eq!(found, ["Loss", "Commitment", "Perplexity", "Gradient norm", "Learning rate"]);
    assert_eq!(headings("tok", &["--panel", "all"]).1.len(), 6);
    let (summary, found) = headings("plan", &[]);
    assert!(summary.starts_with("60 steps of planner → "), "{summary}");
    assert_eq!(found, ["Loss", "Gradient norm", "Learning rate"]);
    assert_eq!(
        refusal(&["--store", &store, "--run", "plan", "--output", &path, "--panel", "perplexity"]),
        format!(
            "store {store}: run \"plan\" has no panel perplexity in planner; ask for one of loss, gradient_norm, \
             learning_rate"
        )
    );
}

#[test]
fn fine_tuning_is_the_six_losses_of_the_reference_or_all() {
    let dir = Dir::new();
    let store = store(&dir);
    let path = text(&dir.at("fine.svg"));
    let flags = ["--store", &store, "--run", "whole", "--output", &path, "--stage", "finetune"];
    let usual = [
        "Total loss",
        "Diffusion",
        "Decoder position",
        "Velocity coherence",
        "Acceleration coherence",
        "Jerk",
    ];
    let more = [
        "Decoder quaternion",
        "Quaternion delta",
        "Phase",
        "Position smoothness",
        "Gradient norm",
        "Learning rate",
    ];
    let headings = |picture: &str| {
        let has = |heading: &&str| {
            picture.contains(&format!("font-size=\"13\" fill=\"#1f2328\">{heading}<"))
        };
        [usual, more].concat().into_iter().filter(has).collect::<Vec<_>>()
    };
    let summary = drawn(&flags);
    assert_eq!(summary, format!("60 steps of finetune → {path} (1000 × 818 px)\n"));
    let picture = svg(&path);
    assert_eq!(headings(&picture), usual);
    for label in [">validation<", ">m²<", ">1e−8<", ">2e−8<"] {
        assert!(picture.contains(label), "no {label} in the picture");
    }
    // What was skipped is that, and not left out as well.
    assert!(!picture.contains("left out"));

    drawn(&[&flags[..], &["--panel", "all"]].concat());
    let picture = svg(&path);
    assert_eq!(headings(&picture), [usual, more].concat());
    for label in [">60 values left out: not above 0, or not finite<", ">no values<"] {
        assert!(picture.contains(label), "no {label} in the picture");
    }
    drawn(&[&flags[..], &["--panel", "jerk,loss", "--panel", "phase_monotonic"]].concat());
    assert_eq!(headings(&svg(&path)), ["Total loss", "Jerk", "Phase"]);
}

#[test]
fn stages_and_panels_are_chosen() {
    let dir = Dir::new();
    let store = store(&dir);
    let path = text(&dir.at("a.svg"));
    let flags = ["--store", &store, "--run", "whole", "--output", &path];
    let stages = |more: &[&str]| {
        let summary = drawn(&[&flags[..], more].concat());
        summary.split(" → ").next().expect("an account").to_owned()
    };
    assert_eq!(
        stages(&["--stage", "finetune", "--stage", "diffusion", "--stage", "finetune"]),
        "100 steps of diffusion, 60 of finetune"
    );
    assert_eq!(stages(&["--stage", "decoder,finetune"]), "40 steps of decoder, 60 of finetune");
    // Stages without the panel are left out.
    assert_eq!(stages(&["--panel", "decoder_position"]), "40 steps of decoder, 60 of finetune");
    assert_eq!(stages(&["--panel", "jerk"]), "60 steps of finetune");
    let mut command = motiongen();
    command.args(["plot", "training"]).args(flags).env("MOTIONGEN_PANEL", "jerk");
    let output = finish(command.env("MOTIONGEN_WIDTH", "400"));
    assert!(output.stdout.starts_with("60 steps of finetune → "), "{output:?}");
    assert!(output.stdout.contains("(400 × "), "{output:?}");
}

#[test]
fn what_cannot_be_drawn_is_said_in_a_sentence() {
    let dir = Dir::new();
    let store = store(&dir);
    let nothing = text(&dir.at("nothing"));
    let (png, gif) = (text(&dir.at("x.png")), text(&dir.at("x.gif")));
    let newer = dir.at("newer");
    commit(&newer, &[row("r", "distillation", RowKind::Step, 1, 1)]);
    let newer = text(&newer);
    let cases: [(&str, &str, &[&str], String); 9] = [
        (
            &store,
            "wholes",
            &[],
            format!("store {store} has no run \"wholes\"; nearest: whole, half"),
        ),
        (
            &nothing,
            "whole",
            &[],
            format!(
                "store {nothing} has no log of a training; run motiongen train --store {nothing} \
                 --run whole first"
            ),
        ),
        (
            &store,
            "half",
            &["--stage", "finetune"],
            format!(
                "store {store}: run \"half\" has no stage finetune; ask for one of its own: \
                 diffusion"
            ),
        ),
        (
            &newer,
            "r",
            &[],
            format!(
                "store {newer}: run \"r\" has no stage that can be drawn (diffusion, decoder, finetune, group, \
                 tokens, planner); install a newer motiongen"
            ),
        ),
        (
            &store,
            "whole",
            &["--stage", "diffusion,decoder", "--panel", "jerk"],
            format!(
                "store {store}: run \"whole\" has no panel jerk in diffusion, decoder; ask for one \
                 of loss, decoder_position, decoder_quaternion, gradient_norm, learning_rate"
            ),
        ),
        (
            &store,
            "whole",
            &["--panel", "total"],
            "invalid value 'total' for '--panel <PANEL>': panel \"total\" is unknown; the panels \
             are all, loss, diffusion, decoder_position, velocity_coherence, \
             acceleration_coherence, jerk, decoder_quaternion, quaternion_delta, phase_monotonic, \
             position_smoothness, markers, contrast, commitment, perplexity, gradient_norm, learning_rate"
                .to_owned(),
        ),
        (
            &store,
            "whole",
            &["--stage", "unet"],
            "invalid value 'unet' for '--stage <STAGE>'".to_owned(),
        ),
        (
            &store,
            "whole",
            &["--width", "9000"],
            "invalid value '9000' for '--width <PX>': 9000 is not in 320..=8192".to_owned(),
        ),
        (
            &store,
            "whole",
            &["--output", &gif],
            format!(
                "--output {gif} has the extension .gif, which is no format of plots; name it .png \
                 or .svg"
            ),
        ),
    ];
    for (store, run, more, expected) in cases {
        let output = ["--output", &png];
        let output = if more.contains(&"--output") { &[][..] } else { &output };
        let flags = [&["--store", store, "--run", run], output, more].concat();
        assert_eq!(refusal(&flags), expected, "{flags:?}");
    }
    assert!(!dir.at("x.png").exists());
    let below_a_file = text(&dir.write("file", "").join("x.png"));
    let sentence = refusal(&["--store", &store, "--run", "half", "--output", &below_a_file]);
    assert!(sentence.starts_with(&format!("while writing {below_a_file}: ")), "{sentence}");
}
