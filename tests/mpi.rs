//! `mpirun motiongen train`, as a user runs it, and what a build without MPI says to it.

use crate::support::{Dir, finish};
use crate::train::{make_store, train_command};

/// A launcher's variables make a process one of two, though there is no other.
#[cfg(not(feature = "mpi"))]
#[test]
fn an_executable_without_mpi_refuses_to_be_one_of_several() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let launchers = [
        ("OMPI_COMM_WORLD_SIZE", "mpirun"),
        ("PMI_SIZE", "mpiexec or srun"),
        ("SLURM_STEP_NUM_TASKS", "srun"),
    ];
    for (variable, launcher) in launchers {
        let output = finish(train_command(&store, "run", &["--steps=1"]).env(variable, "2"));
        assert_eq!(output.code, 2, "{output:?}");
        let sentence = format!(
            "error: {launcher} started 2 processes of train, but this executable was built without MPI, so each would train \
             the same run; build it with --features mpi, or start one process\n"
        );
        assert_eq!(output.stderr, sentence);
    }
    assert!(!store.join("runs").exists(), "nothing was written");
    let one = finish(train_command(&store, "run", &["--steps=1"]).env("PMI_SIZE", "1"));
    assert_eq!(one.code, 0, "{one:?}");
}

#[test]
fn fine_tuning_runs_in_one_process() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let mut command = crate::support::motiongen();
    command.args(["finetune", "--run", "run", "--store"]).arg(&store);
    let output = finish(command.env("OMPI_COMM_WORLD_SIZE", "2"));
    let sentence = "error: mpirun started 2 processes of finetune, which runs in one; start it without mpirun, or with -n 1\n";
    assert_eq!((output.code, output.stderr.as_str()), (2, sentence));
}

#[cfg(feature = "mpi")]
mod ranks {
    use std::ffi::OsString;
    use std::path::{Path, PathBuf};
    use std::process::Command;
    use std::time::{Duration, Instant};

    use motiongen::store::split_of;

    use super::*;
    use crate::ingest_kill::Running;
    use crate::support::files::{coherent, npz, trajectory};
    use crate::train::{checkpoints, features, losses, newest, train};

    /// Two parts for each of two ranks; checkpoints often, several validations.
    const RUN: [&str; 7] = [
        "--side-by-side=4",
        "--accumulate=1",
        "--steps=120",
        "--decoder-steps=20",
        "--validate-every=3",
        "--save-every-steps=7",
        "--threads=1",
    ];

    /// Returns whether tests with mpirun can run here, and says loudly when not.
    #[expect(clippy::print_stderr, reason = "a test that is skipped says so")]
    fn has_mpirun() -> bool {
        let found = Command::new("mpirun").arg("--version").output().is_ok();
        if !found {
            eprintln!("SKIPPED: mpirun was not found, so that nothing of MPI is tested");
        }
        found
    }

    /// Returns the launcher of the pipelines with `n` processes of a command.
    fn mpirun(commands: &[(usize, &Command)]) -> Command {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines/mpi/mpirun.sh");
        let mut launcher = Command::new(script);
        launcher.args(["--allow-run-as-root", "--oversubscribe"]);
        for (i, (n, command)) in commands.iter().enumerate() {
            if i > 0 {
                launcher.arg(":");
            }
            launcher
                .args(["-n", &n.to_string()])
                .arg(command.get_program())
                .args(command.get_args());
        }
        launcher
    }

    fn copy(from: &Path, to: &Path) -> PathBuf {
        for (path, (bytes, _)) in crate::support::tree(from) {
            crate::support::write(&to.join(path), bytes);
        }
        to.to_owned()
    }

    fn assert_same(found: &Path, wanted: &Path, what: &str) {
        for stage in ["diffusion", "decoder"] {
            for kind in ["step", "best"] {
                let (found, wanted) =
                    (newest(found, "run", stage, kind), newest(wanted, "run", stage, kind));
                assert_eq!(found.0, wanted.0, "{what}: {stage} {kind}");
                assert!(found.1 == wanted.1, "{what}: {stage} {kind} has other numbers");
            }
            assert_eq!(
                losses(found, "run", stage),
                losses(wanted, "run", stage),
                "{what}: {stage}"
            );
        }
    }

    /// Returns the processes of motiongen that have `store` among their arguments.
    fn ranks_of(store: &Path) -> Vec<u32> {
        let is_rank = |pid: &u32| {
            let words = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
            let text = String::from_utf8_lossy(&words).replace('\0', " ");
            let mut words = text.split(' ');
            let is_program = words.next().is_some_and(|program| program.ends_with("/motiongen"));
            is_program && text.contains(&*store.to_string_lossy())
        };
        let all = std::fs::read_dir("/proc").expect("processes");
        let pids = all.filter_map(|one| one.ok()?.file_name().to_str()?.parse().ok());
        let mut pids: Vec<u32> = pids.filter(is_rank).collect();
        pids.sort_unstable();
        pids
    }

    fn signal(pid: u32, name: &str) {
        Command::new("kill").args([&format!("-{name}"), &pid.to_string()]).status().expect("kill");
    }

    fn wait_for_checkpoint(store: &Path, n: usize, running: &mut Running) {
        let started = Instant::now();
        let count = || {
            checkpoints(store, "run", "diffusion", "step-").last().and_then(|path| {
                path.file_stem()?.to_str()?.strip_prefix("step-")?.parse::<usize>().ok()
            })
        };
        while count().is_none_or(|step| step < n) && running.is_running() {
            assert!(started.elapsed() < Duration::from_secs(300), "no checkpoint");
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    #[test]
    fn one_two_and_four_ranks_end_with_the_same_bits() {
        if !has_mpirun() {
            return;
        }
        let dir = Dir::new();
        let store = make_store(&dir);
        let alone = copy(&store, &dir.at("alone"));
        assert_eq!(train(&alone, "run", &RUN).code, 0);
        for n in [2, 4] {
            let store = copy(&store, &dir.at(format!("of {n}")));
            let output = finish(&mut mpirun(&[(n, &train_command(&store, "run", &RUN))]));
            assert_eq!(output.code, 0, "{output:?}");
            // The first rank tells of it, and no other.
            assert_eq!(output.stdout.matches("diffusion: is complete").count(), 1, "{output:?}");
            assert_same(&store, &alone, &format!("{n} ranks"));
        }
    }

    /// Trains in two copies of a store, by one process and by two, and compares what they wrote.
    fn assert_same_by_two(
        dir: &Dir,
        store: &Path,
        stage: &str,
        command: impl Fn(&Path) -> Command,
    ) {
        let [alone, both] = ["alone", "both"].map(|name| {
            let store = copy(store, &dir.at(format!("{stage} {name}")));
            let mut command = command(&store);
            if name == "both" {
                command = mpirun(&[(2, &command)]);
            }
            let output = finish(&mut command);
            assert_eq!(output.code, 0, "{stage} {name}: {output:?}");
            store
        });
        for kind in ["step", "best"] {
            let [alone, both] = [&alone, &both].map(|store| newest(store, "run", stage, kind));
            assert_eq!(both.0, alone.0, "{stage} {kind}");
            assert!(both.1 == alone.1, "{stage} {kind} has other numbers");
        }
        let alone = losses(&alone, "run", stage);
        assert!(!alone.is_empty() && losses(&both, "run", stage) == alone, "{stage}: {alone:?}");
    }

    /// Parts of a batch by their number, whatever the family's usual number is; several validations.
    const FEW: [&str; 4] = ["--side-by-side=2", "--steps=12", "--validate-every=2", "--threads=1"];

    #[test]
    fn groups_of_two_ranks_have_the_bits_of_one_process() {
        if !has_mpirun() {
            return;
        }
        let dir = Dir::new();
        let store = crate::group_model::make_store(&dir);
        assert_same_by_two(&dir, &store, "group", |store| {
            crate::group_model::train_command(store, "run", &FEW)
        });
    }

    #[test]
    fn tokenizers_and_planners_of_two_ranks_have_the_bits_of_one_process() {
        if !has_mpirun() {
            return;
        }
        let dir = Dir::new();
        let store = crate::planner::store_with_tokenizer(&dir);
        let with_few = |more: &[&'static str]| more.iter().chain(&FEW).copied().collect::<Vec<_>>();
        for (stage, more) in [
            ("tokens", &[][..]),
            ("planner", &crate::planner::MASKED),
            ("planner", &crate::planner::AUTOREGRESSIVE),
        ] {
            let dir = Dir::new();
            assert_same_by_two(&dir, &store, stage, |store| {
                crate::tokens::train_command(store, "run", &with_few(more))
            });
        }
    }

    #[test]
    fn a_dead_rank_ends_the_job_with_75_and_the_same_command_goes_on_with_any_number() {
        if !has_mpirun() {
            return;
        }
        let dir = Dir::new();
        let store = make_store(&dir);
        let alone = copy(&store, &dir.at("alone"));
        assert_eq!(train(&alone, "run", &RUN).code, 0);
        let mut n_cut = 0;
        for (n, which, step) in [(2, 1, 7), (2, 0, 28), (4, 2, 49), (2, 1, 70), (4, 0, 91)] {
            let mut running = Running::start(mpirun(&[(n, &train_command(&store, "run", &RUN))]));
            wait_for_checkpoint(&store, step, &mut running);
            std::thread::sleep(Duration::from_millis(step as u64));
            if let Some(&rank) = ranks_of(&store).get(which) {
                signal(rank, "KILL");
                let code = running.wait();
                assert_eq!(code, Some(75), "{n} ranks, {which} killed after step {step}");
                n_cut += 1;
            }
            assert!(ranks_of(&store).is_empty(), "a rank is left");
        }
        assert!(n_cut >= 4, "only {n_cut} of 5 kills hit");
        // One process takes over what four left.
        assert_eq!(train(&store, "run", &RUN).code, 0);
        assert_same(&store, &alone, "after kills");
    }

    #[test]
    fn a_rank_that_is_asked_to_end_ends_all_with_a_checkpoint_and_75() {
        if !has_mpirun() {
            return;
        }
        let dir = Dir::new();
        let store = make_store(&dir);
        let alone = copy(&store, &dir.at("alone"));
        assert_eq!(train(&alone, "run", &RUN).code, 0);
        let mut running = Running::start(mpirun(&[(2, &train_command(&store, "run", &RUN))]));
        wait_for_checkpoint(&store, 7, &mut running);
        if let Some(&rank) = ranks_of(&store).get(1) {
            signal(rank, "TERM");
        }
        assert_eq!(running.wait(), Some(75));
        let output = finish(&mut mpirun(&[(2, &train_command(&store, "run", &RUN))]));
        assert_eq!(output.code, 0, "{output:?}");
        assert_same(&store, &alone, "after SIGTERM");
    }

    #[test]
    fn ranks_that_differ_are_refused_in_a_sentence() {
        if !has_mpirun() {
            return;
        }
        let dir = Dir::new();
        let store = make_store(&dir);
        let usual = train_command(&store, "run", &RUN);
        let refused = |commands: &[(usize, &Command)]| {
            let output = finish(&mut mpirun(commands));
            assert_eq!(output.code, 2, "{output:?}");
            let errors = output.stderr.lines().filter(|line| line.starts_with("error: "));
            let [error] = errors.collect::<Vec<_>>()[..] else { panic!("{}", output.stderr) };
            error.to_owned()
        };
        let host = std::fs::read_to_string("/proc/sys/kernel/hostname").expect("a name");
        let host = host.trim();

        assert_eq!(
            refused(&[(3, &usual)]),
            "error: --side-by-side 4 parts of a batch cannot be shared out among 3 ranks; give --side-by-side 6 (it is a \
             part of the run: a run that was begun with 4 goes on with 4)"
        );

        let mut bytes = std::fs::read(usual.get_program()).expect("the executable");
        bytes.push(0);
        let other = dir.at("motiongen");
        crate::support::write(&other, bytes);
        let mode = std::os::unix::fs::PermissionsExt::from_mode(0o755);
        std::fs::set_permissions(&other, mode).expect("a mode");
        let mut elsewhere = Command::new(&other);
        elsewhere.args(usual.get_args());
        let said = refused(&[(1, &usual), (1, &elsewhere)]);
        let start = format!("error: rank 0 on {host} runs another executable (");
        assert!(said.starts_with(&start) && said.ends_with("); give all nodes the same"), "{said}");

        let with_store = |store: &Path| {
            let args: Vec<OsString> = usual
                .get_args()
                .map(|word| if word == dir.at("store") { store.into() } else { word.to_owned() })
                .collect();
            let mut command = Command::new(usual.get_program());
            command.args(args);
            command
        };
        let said = refused(&[(1, &usual), (1, &with_store(&dir.at("nowhere")))]);
        let start = format!("error: rank 1 on {host}: ");
        assert!(said.starts_with(&start) && said.contains("nowhere"), "{said}");

        let (more, source) = (copy(&store, &dir.at("more")), dir.at("one more"));
        let id = (0..).map(|i| format!("another {i}")).find(|id| split_of(id) == "train");
        let id = id.expect("a name of the training split");
        let frames = coherent(40, 99);
        let write = |path: String, bytes| crate::support::write(&source.join(path), bytes);
        write(format!("motion/{id}/trajectory.npy"), trajectory(&frames));
        let features = npz(&features(&frames), zip::CompressionMethod::Deflated);
        write(format!("audio_features/{id}/features.npz"), features);
        assert_eq!(crate::support::ingest(&source, &more, &[]).code, 0);
        let output = finish(crate::support::motiongen().args(["extract", "--store"]).arg(&more));
        assert_eq!(output.code, 0, "{output:?}");
        let said = refused(&[(1, &usual), (1, &with_store(&more))]);
        let start =
            format!("error: rank 0 on {host} and rank 1 on {host} see different phrases in ");
        let end = "; name a folder that every node sees, or a bucket";
        assert!(said.starts_with(&start) && said.ends_with(end), "{said}");
        assert!(!store.join("runs/run/diffusion").exists(), "no step was taken");
    }
}
