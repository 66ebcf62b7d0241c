//! A run that was killed, or interrupted, ends as one that was not.

use std::time::Duration;

use super::*;
use crate::ingest_kill::Running;

/// Some hundreds of steps, a checkpoint every seventh, several validations.
const RUN: [&str; 5] = [
    "--steps=220",
    "--decoder-steps=60",
    "--validate-every=3",
    "--save-every-steps=7",
    "--loader-threads=2",
];

/// Waits until a stage of a run has a checkpoint of at least this step, or the program has ended.
fn wait_for(store: &Path, stage: &str, step: u64, running: &mut Running) {
    let reached = |store: &Path| {
        let newest = checkpoints(store, "run", stage, "step-").pop()?;
        let name = newest.file_stem()?.to_string_lossy().into_owned();
        name.strip_prefix("step-")?.parse::<u64>().ok()
    };
    while reached(store).is_none_or(|reached| reached < step) && running.is_running() {
        std::thread::sleep(Duration::from_micros(300));
    }
}

fn copy(from: &Path, to: &Path) {
    for (path, (bytes, _)) in crate::support::tree(from) {
        crate::support::write(&to.join(path), bytes);
    }
}

#[test]
fn a_run_killed_at_five_steps_ends_bit_identical() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let whole = dir.at("whole");
    copy(&store, &whole);
    assert_eq!(train(&whole, "run", &RUN).code, 0);

    // Steps, and how long after their checkpoint: within the next steps, and while it is written.
    let ms = Duration::from_millis;
    let moments = [
        ("diffusion", 7, ms(3)),
        ("diffusion", 49, ms(17)),
        ("diffusion", 105, ms(0)),
        ("diffusion", 168, ms(9)),
        ("decoder", 21, ms(5)),
    ];
    let mut n_cut = 0;
    for (stage, step, delay) in moments {
        let mut running = Running::start(train_command(&store, "run", &RUN));
        wait_for(&store, stage, step, &mut running);
        std::thread::sleep(delay);
        n_cut += usize::from(running.kill());
    }
    assert!(n_cut >= 3, "only {n_cut} of {} kills hit", moments.len());
    let output = train(&store, "run", &[&RUN[..], &["--resume"]].concat());
    assert_eq!(output.code, 0, "{output:?}");
    for stage in ["diffusion", "decoder"] {
        for kind in ["step", "best"] {
            let (killed, undisturbed) =
                (newest(&store, "run", stage, kind), newest(&whole, "run", stage, kind));
            assert_eq!(killed.0, undisturbed.0, "{stage} {kind}");
            assert!(killed.1 == undisturbed.1, "{stage} {kind}: other numbers");
        }
        // Every step once, with the same loss.
        assert_eq!(losses(&store, "run", stage), losses(&whole, "run", stage), "{stage}");
        let others = |store: &Path| {
            let rows = log(store, "run", stage).into_iter().filter(|row| row.kind != "step");
            rows.map(|row| (row.kind, row.step, row.epoch, row.loss, row.loss_live))
                .collect::<Vec<_>>()
        };
        assert_eq!(others(&store), others(&whole), "{stage}: epochs and validations");
    }
}

#[cfg(unix)]
#[test]
fn who_interrupts_gets_a_checkpoint_and_the_command_that_goes_on() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let whole = dir.at("whole");
    copy(&store, &whole);
    assert_eq!(train(&whole, "run", &RUN).code, 0);

    for signal in ["TERM", "INT"] {
        let before = losses(&store, "run", "diffusion").len();
        let mut command = train_command(&store, "run", &RUN);
        command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
        let mut child = command.spawn().expect("started");
        // A checkpoint that was not there before says that the loop is under way.
        let known = checkpoints(&store, "run", "diffusion", "step-");
        while checkpoints(&store, "run", "diffusion", "step-") == known {
            assert!(child.try_wait().expect("a status").is_none(), "it ended too soon");
            std::thread::sleep(Duration::from_micros(300));
        }
        let asked = Command::new("kill")
            .args([&format!("-{signal}"), &child.id().to_string()])
            .status()
            .expect("kill");
        assert!(asked.success());
        let output = child.wait_with_output().expect("an end");
        let stdout = String::from_utf8(output.stdout).expect("UTF-8");
        assert_eq!(output.status.code(), Some(75), "{stdout}");
        assert!(stdout.contains("diffusion: was interrupted, "), "{stdout}");
        let last = stdout.lines().last().expect("a line");
        assert!(last.starts_with("saved; go on with: ") && last.ends_with(" --resume"), "{last}");
        assert!(losses(&store, "run", "diffusion").len() > before, "SIG{signal}");
    }
    assert_eq!(train(&store, "run", &[&RUN[..], &["--resume"]].concat()).code, 0);
    for stage in ["diffusion", "decoder"] {
        assert!(newest(&store, "run", stage, "step") == newest(&whole, "run", stage, "step"));
        assert_eq!(losses(&store, "run", stage), losses(&whole, "run", stage), "{stage}");
    }
}

#[test]
fn a_store_that_goes_away_for_a_while_is_waited_for() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let away = dir.at("away");
    let arguments = [&RUN[..], &["--store-patience=60"]].concat();
    let mut running = Running::start(train_command(&store, "run", &arguments));
    wait_for(&store, "diffusion", 14, &mut running);
    std::fs::rename(&store, &away).expect("moved away");
    // Several checkpoints fall into this time.
    std::thread::sleep(Duration::from_millis(1500));
    assert!(!store.exists(), "something was written where the store was");
    std::fs::rename(&away, &store).expect("moved back");
    while running.is_running() {
        std::thread::sleep(Duration::from_millis(5));
    }
    assert!(!running.kill());
    let steps: Vec<_> = losses(&store, "run", "diffusion").into_iter().map(|(s, _)| s).collect();
    assert_eq!(steps, (1..=220).collect::<Vec<_>>());
}
