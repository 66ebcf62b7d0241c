//! What training says of phrases, runs and checkpoints that it cannot use.

use super::*;
use crate::support::failures;

/// Returns what a run that could not start said.
fn refusal(store: &Path, run: &str, more: &[&str]) -> String {
    let output = train(store, run, more);
    assert_eq!(output.code, 2, "{output:?}");
    assert_eq!(output.stdout, "");
    output.stderr.trim_end().replace(&store.display().to_string(), "STORE")
}

const SHORT: [&str; 3] = ["--steps=8", "--decoder-steps=2", "--save-every-steps=4"];

#[test]
fn a_store_without_phrases_to_train_on_is_refused() {
    let dir = Dir::new();
    let store = dir.at("store");
    assert_eq!(
        refusal(&store, "a", &[]),
        "error: store STORE has no phrases with both motion and features; run ingest and extract (or \
         library) on it first"
    );
    // Captures have no music, which is no failure of theirs.
    let id = &names("train", 1)[0];
    dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&coherent(31, 1)));
    assert_eq!(crate::support::ingest(&dir.at("source"), &store, &[]).code, 0);
    assert!(refusal(&store, "a", &[]).contains("no phrases with both motion and features"));
    assert!(failures(&store).is_empty());
}

#[test]
fn an_empty_split_is_refused() {
    let dir = Dir::new();
    let store = dir.at("store");
    for (i, id) in names("train", 4).into_iter().enumerate() {
        let frames = coherent(31, i as u32);
        dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&frames));
        let features = npz(&features(&frames), CompressionMethod::Stored);
        dir.write(format!("source/audio_features/{id}/features.npz"), features);
    }
    assert_eq!(crate::support::ingest(&dir.at("source"), &store, &[]).code, 0);
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
    assert_eq!(
        refusal(&store, "a", &[]),
        "error: store STORE: split validation is empty (4 train, 0 validation phrases); without it \
         nobody can tell what was learned: ingest more phrases, or build a library from at least three \
         songs"
    );
}

#[test]
fn phrases_without_features_are_left_out_counted_and_recorded() {
    let dir = Dir::new();
    let source = dir.at("source");
    write_source(&source);
    let store = dir.at("store");
    // Ingested, but not yet extracted.
    assert_eq!(crate::support::ingest(&source, &store, &[]).code, 0);
    let said = refusal(&store, "a", &[]);
    assert!(said.contains("no phrases with both motion and features"), "{said}");
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
    // A phrase that comes later and is not extracted: one of 17 is more than 5 %.
    let late = names("train", 14)[13].clone();
    let frames = coherent(40, 99);
    dir.write(format!("late/motion/{late}/trajectory.npy"), trajectory(&frames));
    let features = npz(&features(&frames), CompressionMethod::Stored);
    dir.write(format!("late/audio_features/{late}/features.npz"), features);
    assert_eq!(crate::support::ingest(&dir.at("late"), &store, &[]).code, 0);
    assert_eq!(
        refusal(&store, "a", &[]),
        format!(
            "error: 1 of 17 phrases (5.9 %) cannot be learned from, more than --max-failed 5.0 %; they are \
             in the table of failures. The first: phrase {late} has motion but no features; run extract"
        )
    );
    let failed = failures(&store);
    assert_eq!(failed[&late].stage, "train");
    assert_eq!(failed[&late].kind, "no_features");
    assert_eq!(
        failed[&late].message,
        format!("phrase {late} has motion but no features; run extract")
    );

    let output = train(&store, "a", &[&SHORT[..], &["--max-failed=0.1"]].concat());
    assert_eq!(output.code, 1, "some phrases failed: {output:?}");
    assert!(
        output.stdout.contains(&format!("left out: phrase {late} has motion but no features")),
        "{output:?}"
    );
    // Once it is extracted it is no failure any more, and the run has other data than it began with.
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
    let said = refusal(&store, "a", &SHORT);
    let (head, tail) = said.split_once("digest ").expect("digests");
    assert_eq!(head, "error: run a was trained on other data: its phrases have the ");
    let (digests, tail) = tail.split_at(12 + ", those of the store now ".len() + 12);
    assert_ne!(digests[..12], digests[digests.len() - 12..]);
    assert_eq!(tail, "; train another run, or start this one anew with --force");
    assert!(failures(&store).is_empty());
    assert_eq!(train(&store, "a", &[&SHORT[..], &["--force"]].concat()).code, 0);
    assert_eq!(losses(&store, "a", "diffusion").len(), 8, "the log of the first run is withdrawn");
}

#[test]
fn a_run_with_another_configuration_says_what_differs() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "one", &SHORT).code, 0);
    assert_eq!(
        refusal(&store, "one", &["--batch-size=6", "--dropout=0.25", "--min-snr-gamma=5"]),
        "error: run one exists with another configuration: diffusion.batch_size is 6, the run has 5; \
         diffusion.objective.min_snr_gamma is 5.0, the run has null; network.unet.dropout is 0.25, the \
         run has 0.1; give the run another name, or the settings that it has"
    );
    assert_eq!(
        refusal(&store, "two", &["--resume"]),
        "error: run two has no checkpoint to resume from in STORE; leave --resume out to start it"
    );
    assert_eq!(
        refusal(&store, "a/b", &[]),
        "error: --run \"a/b\" is no name for a run; use 1 to 100 letters, digits, -, _ and ., and no . at \
         the beginning"
    );
    assert_eq!(
        refusal(&store, "odd", &["--num-heads=5"]),
        "error: a width of 12 does not divide into 5 heads of attention; change num_heads, \
         num_head_channels or the width"
    );
    assert_eq!(
        refusal(&store, "odd", &["--beta-start=0.5", "--beta-end=0.1"]),
        "error: beta_start is 0.5 and beta_end is 0.1; both must lie between 0 and 1, and the end not \
         below the start; 0.0001 and 0.02 are usual"
    );
    assert_eq!(
        refusal(&store, "odd", &["--condition-dropout=1.5"]),
        "error: --condition-dropout 1.5 is no share; give a number from 0 to below 1"
    );
    assert_eq!(
        refusal(&store, "odd", &["--minutes=0"]),
        "error: --minutes 0 is not above 0; give a positive number"
    );
}

/// Writes a checkpoint again with another header.
fn rewrite(path: &Path, change: impl Fn(&str) -> String) {
    let bytes = std::fs::read(path).expect("a checkpoint");
    let length = u64::from_le_bytes(bytes[..8].try_into().expect("8 bytes")) as usize;
    let header = std::str::from_utf8(&bytes[8..8 + length]).expect("UTF-8");
    let mut header = change(header.trim_end());
    header += &" ".repeat((8 - header.len() % 8) % 8);
    let written =
        [&(header.len() as u64).to_le_bytes(), header.as_bytes(), &bytes[8 + length..]].concat();
    std::fs::write(path, written).expect("written");
}

#[test]
fn a_checkpoint_of_another_kind_is_refused_and_a_damaged_one_passed_over() {
    let dir = Dir::new();
    let store = make_store(&dir);
    assert_eq!(train(&store, "one", &SHORT).code, 0);
    let all = losses(&store, "one", "diffusion");
    let paths = checkpoints(&store, "one", "diffusion", "step");
    let names: Vec<_> = paths.iter().map(|p| p.file_name().expect("a name").to_owned()).collect();
    assert_eq!(names, ["step-00000004.safetensors", "step-00000008.safetensors"]);

    // Half of the newest is lost: the one before is as good, and the end is the same.
    let whole = std::fs::read(&paths[1]).expect("a checkpoint");
    std::fs::write(&paths[1], &whole[..whole.len() / 2]).expect("written");
    let mut command = train_command(&store, "one", &SHORT);
    let quiet: Vec<_> = command.get_args().map(ToOwned::to_owned).collect();
    command = motiongen();
    command.args(quiet.into_iter().filter(|argument| argument != "--quiet"));
    let output = finish(&mut command);
    assert_eq!(output.code, 0, "{output:?}");
    assert!(output.stderr.contains("step-00000008.safetensors is damaged ("), "{output:?}");
    assert!(output.stderr.contains("diffusion: going on from step 4\n"), "{output:?}");
    assert_eq!(losses(&store, "one", "diffusion"), all);

    let newest = checkpoints(&store, "one", "diffusion", "step").pop().expect("a checkpoint");
    let url = "file://STORE/runs/one/diffusion/step-00000008.safetensors";
    rewrite(&paths[0], |header| header.replace(r#"\"format\":1"#, r#"\"format\":7"#));
    rewrite(&newest, |header| header.replace(r#"\"format\":1"#, r#"\"format\":7"#));
    let said = refusal(&store, "one", &SHORT);
    assert_eq!(
        said,
        format!(
            "error: checkpoint {url}: has format 7, this program reads format 1; use the version of \
             motiongen that wrote it, or train anew with --force"
        )
    );
    rewrite(&newest, |header| {
        header
            .replace(r#"\"format\":7"#, r#"\"format\":1"#)
            .replace("unet.conv_in.bias", "unet.bent")
    });
    let said = refusal(&store, "one", &SHORT);
    assert_eq!(
        said,
        format!(
            "error: checkpoint {url}: the weights are not those of this network: conv_in.bias is \
             missing; bent is not a parameter of the network"
        )
    );
}

#[test]
fn numbers_that_are_not_finite_stop_training_and_name_the_phrases() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let wild = ["--steps=60", "--learning-rate=1e30", "--warmup-steps=0", "--gradient-clip=0"];
    let said = refusal(&store, "wild", &wild);
    let head = "error: diffusion: loss or gradient was not finite 10 times in a row, last at step ";
    assert!(said.starts_with(head), "{said}");
    let tail =
        "; the last good checkpoint is none. Look at these phrases, or lower the learning rate";
    assert!(said.ends_with(tail), "{said}");
    let named = said[head.len()..].split_once(" with the phrases ").expect("phrases").1;
    let named: Vec<_> = named.strip_suffix(tail).expect("the end").split(", ").collect();
    let known = names("train", 13);
    assert!(!named.is_empty() && named.iter().all(|id| known.iter().any(|k| k == id)), "{said}");
}

#[cfg(target_os = "linux")]
#[test]
fn a_disk_that_is_full_costs_no_checkpoint_that_is_there() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let whole = dir.at("whole");
    for (path, (bytes, _)) in crate::support::tree(&store) {
        crate::support::write(&whole.join(path), bytes);
    }
    // A rate that stays, so that steps do not depend on how many follow.
    let short = [&SHORT[..], &["--lr-schedule=constant"]].concat();
    assert_eq!(train(&whole, "run", &short).code, 0);
    let first = ["--steps=4", "--decoder-steps=2", "--lr-schedule=constant"];
    assert_eq!(train(&store, "run", &first).code, 0);
    std::fs::remove_dir_all(store.join("runs/run/decoder")).expect("removed");
    let before = newest(&store, "run", "diffusion", "step");
    assert_eq!(before.0, "step-00000004.safetensors");

    // Files may not grow beyond 20 kB: a checkpoint is cut off where it reaches that, as on a full disk.
    let plain = train_command(&store, "run", &[&short[..], &["--in-memory"]].concat());
    let mut command = Command::new("sh");
    command.args(["-c", "trap '' XFSZ; ulimit -f 40; exec \"$0\" \"$@\""]);
    command.arg(plain.get_program()).args(plain.get_args());
    let output = finish(&mut command);
    assert_eq!(output.code, 2, "{output:?}");
    let said = output.stderr.replace(&store.display().to_string(), "STORE");
    let head = "error: diffusion: the checkpoint of step 8 could not be saved; the last good one is \
                file://STORE/runs/run/diffusion/step-00000004.safetensors: checkpoint \
                file://STORE/runs/run/diffusion/step-00000008.safetensors: ";
    assert!(said.starts_with(head) && said.contains("File too large"), "{said}");
    assert!(newest(&store, "run", "diffusion", "step") == before);
    assert_eq!(train(&store, "run", &short).code, 0);
    for stage in ["diffusion", "decoder"] {
        assert!(newest(&store, "run", stage, "step") == newest(&whole, "run", stage, "step"));
        assert_eq!(losses(&store, "run", stage), losses(&whole, "run", stage));
    }
}

#[test]
fn channels_that_never_change_are_named() {
    let dir = Dir::new();
    let source = dir.at("source");
    for (i, id) in names("train", 4).into_iter().chain(names("validation", 1)).enumerate() {
        let mut frames = coherent(31, i as u32);
        for frame in &mut frames {
            (frame[16], frame[20]) = (0.25, -0.5);
        }
        dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&frames));
        let features = npz(&features(&frames), CompressionMethod::Stored);
        dir.write(format!("source/audio_features/{id}/features.npz"), features);
    }
    let store = dir.at("store");
    assert_eq!(crate::support::ingest(&source, &store, &[]).code, 0);
    let output = run(["extract".as_ref(), "--store".as_ref(), store.as_os_str()]);
    assert_eq!(output.code, 0, "{output:?}");
    let command = train_command(&store, "one", &SHORT);
    let mut loud = motiongen();
    loud.args(command.get_args().filter(|argument| *argument != "--quiet"));
    let output = finish(&mut loud);
    assert_eq!(output.code, 0, "{output:?}");
    // These walks turn about the vertical, each at a rate that stays.
    let note = "constant in all training phrases, kept in their own unit: angular_velocity_x, \
                angular_velocity_y, angular_velocity_z, phase, style_3\n";
    assert!(output.stderr.contains(note), "{output:?}");
}
