//! A run learns, and says what it did.

use super::*;

#[test]
fn a_run_learns_and_its_log_has_every_step() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let more = ["--steps=300", "--decoder-steps=80", "--validate-every=2", "--warmup-steps=20"];
    let output = train(&store, "one", &more);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.starts_with("diffusion: is complete, 300 steps in "), "{output:?}");

    // Phrases of 19, 35, 51 and 67 frames have 1, 1, 2 and 2 windows of 24: 13 phrases have 19.
    let rows = log(&store, "one", "diffusion");
    let steps: Vec<_> = rows.iter().filter(|row| row.kind == "step").collect();
    assert_eq!(steps.len(), 300);
    for (i, row) in steps.iter().enumerate() {
        assert_eq!(row.step, i as i64 + 1);
        assert_eq!(i64::from(row.epoch), (i as i64 * 5) / 19 + 1, "step {}", row.step);
        assert!(row.loss.is_some_and(f64::is_finite) && row.gradient_norm > Some(0.0));
        assert!(!row.skipped && row.samples_per_s > Some(0.0) && row.rss_bytes > Some(1 << 20));
    }
    // 300 steps are 1,500 windows, 78 epochs and a bit; every second is validated, and the end.
    let of_kind = |kind: &str| rows.iter().filter(|row| row.kind == kind).collect::<Vec<_>>();
    assert_eq!(of_kind("epoch").len(), 1500 / 19);
    let validations = of_kind("validation");
    assert_eq!(validations.len(), 1500 / 19 / 2 + 1);
    let loss = |row: &TrainingLogRow| row.loss.expect("a loss");
    // An untrained network predicts nothing, whose error is the variance of the noise, 1.
    assert!((loss(steps[0]) - 1.0).abs() < 0.1, "{}", loss(steps[0]));
    let best = validations.iter().map(|row| loss(row)).fold(f64::INFINITY, f64::min);
    assert!(best < 0.9, "validation loss {best}");
    // The summary holds it against what is lost without looking: the variance of 256 windows of noise, 1 within
    // 0.02 (five standard deviations of 150,000 squares), of which their mean can take no more than that.
    let said = output.stdout.lines().next().unwrap_or_default();
    let numbers: Vec<f64> = said
        .split(&[' ', '(', ')', ','][..])
        .map(|word| word.trim_end_matches(|c: char| !c.is_ascii_digit()))
        .filter_map(|word| word.parse().ok())
        .collect();
    let [_, _, said_best, _, below_constant, constant, below_untrained, untrained] = numbers[..]
    else {
        panic!("{said}");
    };
    assert!((said_best - best).abs() < 1e-4, "{said}");
    assert!((untrained - 1.0).abs() < 0.02 && constant <= untrained, "{said}");
    assert!(untrained - constant < 0.02, "{said}");
    // Percentages are said as whole numbers, of losses of four digits.
    for (below, loss) in [(below_constant, constant), (below_untrained, untrained)] {
        assert!((below - 100.0 * (1.0 - best / loss)).abs() < 0.6, "{said}");
    }
    // The epoch's row is the mean of its steps: the first is over within step 4.
    let first = of_kind("epoch")[0];
    let mean = steps[..4].iter().map(|row| loss(row)).sum::<f64>() / 4.0;
    assert!(first.step == 4 && (loss(first) - mean).abs() < 1e-12);
    // The warm-up's last step has the peak, the last of all nearly none.
    assert_eq!(steps[19].learning_rate, Some(3e-3));
    assert!(steps[299].learning_rate < Some(3e-7));

    let decoder = log(&store, "one", "decoder");
    let steps: Vec<_> = decoder.iter().filter(|row| row.kind == "step").collect();
    assert_eq!(steps.len(), 80);
    let reconstruction = |row: &TrainingLogRow| row.reconstruction.expect("a loss");
    assert!(reconstruction(steps[79]) < 0.7 * reconstruction(steps[0]));

    assert_eq!(checkpoints(&store, "one", "diffusion", "best").len(), 1);
    assert!(checkpoints(&store, "one", "diffusion", "step").len() <= 2);

    let output = train(&store, "one", &more);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.starts_with("diffusion: was complete already, 300 steps"), "{output:?}");
    assert_eq!(log(&store, "one", "diffusion"), rows);
}

#[test]
fn the_same_bytes_for_any_number_of_threads_and_parts_of_memory() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let augmented = ["--steps=23", "--decoder-steps=9", "--time-stretch=0.1", "--yaw-rotation=20"];
    let with = |run: &str, more: &[&str]| {
        let arguments = [&augmented[..], more].concat();
        let output = train(&store, run, &arguments);
        assert_eq!(output.code, 0, "{output:?}");
        ["diffusion", "decoder"].map(|stage| newest(&store, run, stage, "step"))
    };
    let one = with("one", &["--threads=1", "--loader-threads=1"]);
    let three = with("three", &["--threads=3", "--loader-threads=4", "--in-memory"]);
    assert!(one == three, "threads");
    assert_eq!(losses(&store, "one", "diffusion"), losses(&store, "three", "diffusion"));
    let other = with("other", &["--seed=1"]);
    assert!(one != other, "seeds");
}

#[test]
fn parts_of_a_batch_add_up() {
    let dir = Dir::new();
    let store = make_store(&dir);
    // Without dropout a batch in parts is the same batch; only sums are rounded in another order.
    let common = ["--steps=3", "--decoder-steps=1", "--dropout=0"];
    let log_of = |run: &str, parts: [&str; 2]| {
        assert_eq!(train(&store, run, &[&common[..], &parts].concat()).code, 0);
        log(&store, run, "diffusion")
    };
    let whole = log_of("whole", ["--accumulate=1", "--side-by-side=1"]);
    for (run, parts) in [
        ("one after the other", ["--accumulate=3", "--side-by-side=1"]),
        ("at once", ["--accumulate=1", "--side-by-side=3"]),
        ("both", ["--accumulate=2", "--side-by-side=2"]),
    ] {
        let parts = log_of(&run.replace(' ', "-"), parts);
        for (whole, parts) in whole.iter().zip(parts) {
            let (a, b) = (whole.loss.expect("a loss"), parts.loss.expect("a loss"));
            assert!((a - b).abs() < 1e-5 * a, "{run}, step {}: {a} and {b}", whole.step);
        }
    }
}

#[test]
fn training_ends_when_nothing_improves_and_when_time_is_over() {
    let dir = Dir::new();
    let store = make_store(&dir);
    // So high a rate spoils what was learned at once.
    let output = train(
        &store,
        "stale",
        &[
            "--steps=5000",
            "--decoder-steps=1",
            "--patience=2",
            "--validate-every=1",
            "--learning-rate=0.5",
            "--warmup-steps=0",
        ],
    );
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.starts_with("diffusion: stopped improving, "), "{output:?}");
    let n = log(&store, "stale", "diffusion").iter().filter(|row| row.kind == "step").count();
    assert!(n < 200, "{n} steps");

    let output = train(&store, "timed", &["--minutes=0.02", "--decoder-steps=3"]);
    assert_eq!(output.code, 0, "{output:?}");
    let rows = log(&store, "timed", "diffusion");
    let last = rows.last().expect("rows");
    assert!(last.step >= 1 && last.elapsed_s < 20.0, "{} steps in {} s", last.step, last.elapsed_s);
    assert!(rows.iter().any(|row| row.kind == "validation"), "the end is validated");
}

#[test]
fn the_checkpoint_of_least_loss_is_kept_or_the_one_that_moves_most_as_real_motion_does() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let kept = |run: &str, more: &[&str]| {
        let common = ["--steps=60", "--decoder-steps=1", "--validate-every=2", "--warmup-steps=0"];
        let output = train(&store, run, &[&common[..], more].concat());
        assert_eq!(output.code, 0, "{output:?}");
        let mut validations = log(&store, run, "diffusion");
        validations.retain(|row| row.kind == "validation");
        let (name, _) = newest(&store, run, "diffusion", "best");
        let step = name.strip_prefix("best-").and_then(|name| name.strip_suffix(".safetensors"));
        (validations, step.and_then(|step| step.parse::<i64>().ok()).expect("a step"))
    };
    let least = |rows: &[TrainingLogRow], value: fn(&TrainingLogRow) -> Option<f64>| {
        let value = |row: &TrainingLogRow| value(row).expect("a number");
        rows.iter().min_by(|a, b| value(a).total_cmp(&value(b))).expect("a validation").step
    };
    let (rows, step) = kept("loss", &[]);
    assert!(rows.len() > 5 && rows.iter().all(|row| row.sampled_distance.is_none()), "{rows:?}");
    assert_eq!(step, least(&rows, |row| row.loss));
    let (rows, step) = kept("motion", &["--keep=motion"]);
    assert_eq!(step, least(&rows, |row| row.sampled_distance));
    assert_ne!(step, least(&rows, |row| row.loss), "a run that tells the two apart");
}

#[test]
fn a_dry_run_writes_nothing() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let before = crate::support::tree(&store);
    let output = train(&store, "dry", &["--dry-run"]);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(
        output.stdout.ends_with(
            "parameters on 19 windows, 4 steps an epoch, and validate on 5; 0 phrases are left out\n"
        ),
        "{output:?}"
    );
    assert!(crate::support::tree(&store) == before);
}
