//! Fine-tuning goes on where training ended.

use std::time::Duration;

use super::*;
use crate::ingest_kill::Running;

const TRAINED: [&str; 3] = ["--steps=40", "--decoder-steps=30", "--warmup-steps=5"];

fn finetune_command(store: &Path, run: &str, more: &[&str]) -> Command {
    let mut command = motiongen();
    command.arg("finetune").arg("--store").arg(store).args(["--run", run]);
    command.args(["--batch-size=3", "--threads=2", "--store-patience=0", "--quiet"]).args(more);
    command
}

fn finetune(store: &Path, run: &str, more: &[&str]) -> Output {
    finish(&mut finetune_command(store, run, more))
}

#[test]
fn coherence_improves_and_every_loss_is_logged() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "run", &TRAINED).code, 0);
    let output = finetune(
        &store,
        "run",
        &["--steps=60", "--lr-diffusion=1e-4", "--lr-decoder=1e-3", "--patience=0"],
    );
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stdout.starts_with("finetune: is complete, 60 steps in "), "{output:?}");
    let rows = log(&store, "run", "finetune");
    let steps: Vec<_> = rows.iter().filter(|row| row.kind == "step").collect();
    assert_eq!(steps.len(), 60);
    for row in &steps {
        assert_eq!((row.learning_rate, row.lr_decoder), (Some(1e-4), Some(1e-3)));
        let loss = |x: Option<f64>| x.expect("a loss");
        let temporal = loss(row.velocity_coherence)
            + loss(row.acceleration_coherence)
            + loss(row.jerk)
            + loss(row.quaternion_delta)
            + loss(row.phase_monotonic)
            + loss(row.position_smoothness);
        let total = loss(row.diffusion)
            + 3.0 * (loss(row.decoder_position) + loss(row.decoder_quaternion))
            + 10.0 * temporal;
        // Sums of a dozen single-precision numbers.
        assert!((loss(row.loss) - total).abs() < 1e-5 * total, "{} and {total}", loss(row.loss));
    }
    let validations: Vec<_> = rows.iter().filter(|row| row.kind == "validation").collect();
    let (first, last) = (validations[0], validations[validations.len() - 1]);
    assert_eq!(first.step, 0, "what train left is measured too");
    assert!(last.loss < first.loss, "{:?} to {:?}", first.loss, last.loss);
    assert!(last.velocity_error < first.velocity_error);
    assert!(last.quaternion_pass_rate >= Some(0.0) && last.acceleration_error > Some(0.0));
}

#[test]
fn fine_tuning_killed_and_resumed_ends_bit_identical() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "run", &TRAINED).code, 0);
    let whole = dir.at("whole");
    for (path, (bytes, _)) in crate::support::tree(&store) {
        crate::support::write(&whole.join(path), bytes);
    }
    let arguments = ["--steps=50", "--save-every-steps=4", "--num-phrases=9", "--validate-every=4"];
    assert_eq!(finetune(&whole, "run", &arguments).code, 0);
    let mut n_cut = 0;
    for (n, delay_ms) in [(1, 3), (4, 11), (9, 0)] {
        let mut running = Running::start(finetune_command(&store, "run", &arguments));
        let name = format!("step-{:08}", 4 * n);
        let is_there = |path: &PathBuf| path.to_string_lossy().contains(&name);
        while !checkpoints(&store, "run", "finetune", "step").iter().any(is_there)
            && running.is_running()
        {
            std::thread::sleep(Duration::from_micros(300));
        }
        std::thread::sleep(Duration::from_millis(delay_ms));
        n_cut += usize::from(running.kill());
    }
    assert!(n_cut >= 2, "only {n_cut} of 3 kills hit");
    assert_eq!(finetune(&store, "run", &[&arguments[..], &["--resume"]].concat()).code, 0);
    for kind in ["step", "best"] {
        assert!(newest(&store, "run", "finetune", kind) == newest(&whole, "run", "finetune", kind));
    }
    assert_eq!(losses(&store, "run", "finetune"), losses(&whole, "run", "finetune"));
}

#[test]
fn a_run_that_was_not_trained_is_refused() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let said = |run: &str, more: &[&str]| {
        let output = finetune(&store, run, more);
        assert_eq!(output.code, 2, "{output:?}");
        output.stderr.trim_end().replace(&store.display().to_string(), "STORE")
    };
    assert_eq!(
        said("none", &[]),
        "error: run none has no trained UNet; run motiongen train --run none first"
    );
    assert_eq!(train(&store, "run", &TRAINED).code, 0);
    std::fs::remove_dir_all(store.join("runs/run/decoder")).expect("removed");
    assert_eq!(
        said("run", &[]),
        "error: run run has no trained decoder; run motiongen train --run run to the end first"
    );
    let output = train(&store, "run", &TRAINED);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(
        said("run", &["--num-steps=0"]),
        "error: n_steps of the sampler is 0; it must be 1 to 250, the number of steps that the network \
         was trained on"
    );
    assert_eq!(
        said("run", &["--resume"]),
        "error: run run has no fine-tuning to resume in STORE; leave --resume out to start it"
    );
    assert_eq!(finetune(&store, "run", &["--steps=2"]).code, 0);
    assert_eq!(
        said("run", &["--steps=2", "--temporal-weight=3"]),
        "error: run run exists with another configuration: temporal_weight is 3.0, the run has 10.0; give \
         the run another name, or the settings that it has"
    );
}
