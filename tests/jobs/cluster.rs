//! The pipelines of clusters: what a task makes of exit codes, signals and what its node sees, and the chain of jobs.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::process::Command;

use super::{end, signal, start, wait_until};
use crate::support::{Dir, Output};

fn pipelines(path: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("pipelines").join(path)
}

fn program(dir: &Dir, name: &str, text: &str) -> PathBuf {
    let path = dir.write(name, text);
    let executable = std::fs::Permissions::from_mode(0o755);
    std::fs::set_permissions(&path, executable).expect("a program");
    path
}

/// A program of our own in the place of motiongen: it keeps its arguments and threads, does as the file `code` says,
/// and where there is a file `slow`, it ends with 75 once it is asked to.
fn fake(dir: &Dir) -> PathBuf {
    let place = dir.path().display();
    let script = format!(
        "#!/bin/sh\necho \"$@\" workers ${{MOTIONGEN_WORKERS:-all}} >> {place}/calls\n[ ! -e {place}/slow ] || {{ trap \
         'exit 75' TERM; touch {place}/began; while :; do sleep 0.01; done; }}\nexit $(cat {place}/code)\n"
    );
    program(dir, "bin/motiongen", &script)
}

fn calls(dir: &Dir) -> Vec<String> {
    let calls = std::fs::read_to_string(dir.at("calls")).unwrap_or_default();
    calls.lines().map(str::to_owned).collect()
}

/// Returns a command in an environment without Slurm's variables, the folder `bin` first in its path.
fn command(dir: &Dir, words: &[&Path]) -> Command {
    let mut command = Command::new(words[0]);
    command.args(&words[1..]);
    for (name, _) in std::env::vars_os() {
        let name = name.to_string_lossy();
        if ["MOTIONGEN", "SLURM", "SBATCH", "MAKE"].iter().any(|start| name.starts_with(start)) {
            command.env_remove(&*name);
        }
    }
    let path = std::env::var("PATH").expect("a path");
    command.env("PATH", format!("{}:{path}", dir.at("bin").display()));
    command
}

/// Returns task 3 of an array that runs `extract`, as Slurm would start it.
fn task(dir: &Dir) -> Command {
    let script = pipelines("slurm/stage.sbatch");
    let mut command = command(dir, &[Path::new("bash"), &script]);
    command.args(["extract", "--store", "tables"]);
    command.envs([
        ("SLURM_JOB_ID", "11"),
        ("SLURM_ARRAY_JOB_ID", "8"),
        ("SLURM_ARRAY_TASK_ID", "3"),
        ("SLURM_CPUS_PER_TASK", "2"),
        ("SLURMD_NODENAME", "n1"),
    ]);
    command
}

/// A scontrol that keeps what it is asked, of a Slurm that is configured so.
fn scontrol(dir: &Dir, configuration: &str) {
    let place = dir.path().display();
    let script = format!(
        "#!/bin/sh\nif [ $1 = show ]; then echo '{configuration}'; else echo \"$@\" >> {place}/queued; fi\n"
    );
    program(dir, "bin/scontrol", &script);
}

#[test]
fn scripts_are_of_a_syntax_that_their_shells_take() {
    for (shell, script) in
        [("bash", "slurm/stage.sbatch"), ("bash", "slurm/submit.sh"), ("sh", "kubernetes/task.sh")]
    {
        let output =
            Command::new(shell).arg("-n").arg(pipelines(script)).output().expect("a shell");
        assert!(output.status.success() && output.stderr.is_empty(), "{script}: {output:?}");
    }
}

#[test]
fn a_task_that_is_stopped_is_queued_again_once() {
    let dir = Dir::new();
    fake(&dir);
    // Where Slurm does it itself, asking for it would be a second time.
    for (configuration, queued) in [
        ("RequeueExit             = 75", ""),
        ("RequeueExit             = 74,75,99", ""),
        ("RequeueExit             = (null)", "requeue 8_3\n"),
        ("RequeueExit             = 175", "requeue 8_3\n"),
        ("RequeueExitHold         = 75", "requeue 8_3\n"),
    ] {
        scontrol(&dir, configuration);
        std::fs::remove_file(dir.at("queued")).ok();
        for (code, expected) in [("0", 0), ("1", 0), ("2", 2), ("75", 75)] {
            dir.write("code", code);
            let (found, _, stderr) = end(start(task(&dir)));
            assert_eq!(found, Some(expected), "{code}: {stderr}");
        }
        let found = std::fs::read_to_string(dir.at("queued")).unwrap_or_default();
        assert_eq!(found, queued, "{configuration}");
    }
    // The signal before the time limit reaches the stage.
    dir.write("slow", "");
    let child = start(task(&dir));
    wait_until("the stage", || dir.at("began").exists());
    signal("TERM", child.id());
    assert_eq!(end(child).0, Some(75));
}

#[test]
fn a_task_knows_its_shard_and_its_cores() {
    let dir = Dir::new();
    fake(&dir);
    dir.write("code", "0");
    end(start(task(&dir)));
    end(start({
        // A part of a former array names how many there were.
        let mut command = task(&dir);
        command.env("SHARDS", "16").env("MOTIONGEN_WORKERS", "5");
        command
    }));
    end(start({
        let mut command = task(&dir);
        command.env_remove("SLURM_ARRAY_TASK_ID").env("SHARDS", "16");
        command
    }));
    assert_eq!(
        calls(&dir),
        [
            "extract --store tables --shard auto workers 2",
            "extract --store tables --shard 3/16 workers 5",
            "extract --store tables workers 2"
        ]
    );
}

#[test]
fn a_node_without_the_store_or_the_program_refuses_in_a_sentence() {
    let dir = Dir::new();
    fake(&dir);
    dir.write("code", "0");
    dir.write("seen/.cluster", "token\n");
    dir.write("other/.cluster", "of another cluster\n");
    std::fs::create_dir(dir.at("empty")).expect("a folder");
    let with_store = |folder: &str| {
        let mut command = task(&dir);
        command.env("STORE_FOLDER", dir.at(folder)).env("STORE_TOKEN", "token");
        end(start(command))
    };
    assert_eq!(with_store("seen").0, Some(0));
    for folder in ["other", "empty", "absent"] {
        let (code, _, stderr) = with_store(folder);
        let place = dir.at(folder).display().to_string();
        assert_eq!(
            (code, stderr),
            (
                Some(2),
                format!(
                    "error: store {place} is missing on node n1, or is another folder there; name a folder that \
                     every node sees, or a bucket\n"
                )
            )
        );
        assert_eq!(dir.at(folder).exists(), folder != "absent", "nothing is made");
    }
    assert_eq!(calls(&dir).len(), 1);
    let mut command = task(&dir);
    let (code, _, stderr) = end(start({
        command.env("MOTIONGEN", "/nowhere/motiongen");
        command
    }));
    let sentence = "error: /nowhere/motiongen is not there on node n1; set MOTIONGEN to an executable that every node \
                    sees\n";
    assert_eq!((code, stderr.as_str()), (Some(2), sentence));
    // A list of tasks without the number of shards is refused by the stage itself, as is a shard beyond them.
    let of_array = |variables: &[(&str, &str)]| {
        let mut command = task(&dir);
        command.env("MOTIONGEN", env!("CARGO_BIN_EXE_motiongen")).envs(variables.iter().copied());
        let (code, _, stderr) = end(start(command));
        assert_eq!(code, Some(2), "{stderr}");
        stderr
    };
    let list = [
        ("SLURM_ARRAY_TASK_COUNT", "3"),
        ("SLURM_ARRAY_TASK_MIN", "3"),
        ("SLURM_ARRAY_TASK_MAX", "12"),
        ("SLURM_ARRAY_TASK_STEP", "1"),
    ];
    assert!(
        of_array(&list)
            .contains("so it is a list of tasks, which does not tell the shards of the whole")
    );
    let beyond = of_array(&[("SHARDS", "3")]);
    assert_eq!(
        beyond,
        "error: shard \"3/3\" has index 3 but only 3 shards; write it as i/n with 0 <= i < n, or \"auto\"\n"
    );
}

/// Runs `make cluster` with settings.
fn make_cluster(dir: &Dir, settings: &[&str]) -> Output {
    let mut command = command(dir, &[Path::new("make")]);
    command.current_dir(env!("CARGO_MANIFEST_DIR")).args(["--silent", "cluster"]).args(settings);
    let (code, stdout, stderr) = end(start(command));
    Output { code: code.expect("a code"), stdout, stderr }
}

#[test]
fn the_chain_is_printed_as_a_script_that_submits_it() {
    let dir = Dir::new();
    let motiongen = fake(&dir);
    let place = dir.path().display();
    let settings: [&str; 11] = [
        &format!("SOURCE={place}/my music"),
        &format!("STORE={place}/tables"),
        "RUN=night",
        "SHARDS=8",
        "PARALLEL=3",
        &format!("LOGS={place}/logs"),
        "SBATCH=--partition=main",
        "TRAIN=--preset base --epochs 9",
        "TRAIN_SBATCH=--time=2-0",
        &format!("MOTIONGEN={}", motiongen.display()),
        "DRY_RUN=1",
    ];
    let printed = make_cluster(&dir, &settings);
    assert_eq!((printed.code, printed.stderr.as_str()), (0, ""));
    assert!(!dir.at("tables").exists() && !dir.at("logs").exists(), "a dry run makes nothing");
    // The script itself is run, with an sbatch that keeps its words and answers with a number.
    let sbatch = format!(
        "#!/bin/bash\n{{ for word in \"$@\"; do printf '[%s]' \"$word\"; done; echo; }} >> {place}/submitted\n\
         echo $((100 + $(wc -l < {place}/submitted)))\n"
    );
    program(&dir, "bin/sbatch", &sbatch);
    let script = dir.write("chain.sh", &printed.stdout);
    let (code, _, stderr) =
        end(start(command(&dir, &[Path::new("bash"), Path::new("-eu"), &script])));
    assert_eq!((code, stderr.as_str()), (Some(0), ""));
    let submitted = std::fs::read_to_string(dir.at("submitted")).expect("text");
    let submitted: Vec<&str> = submitted.lines().collect();
    let usual = "[--cpus-per-task=2][--mem=4G][--time=04:00:00]";
    let stage = pipelines("slurm/stage.sbatch").display().to_string();
    let array = format!("[--array=0-7%3][--output={place}/logs/%x-%A_%a.log][--partition=main]");
    let single = format!("[--output={place}/logs/%x-%j.log][--partition=main]");
    let after = |job: u32| format!("[--kill-on-invalid-dep=yes][--dependency=afterok:{job}]");
    let tables = format!("[--store][{place}/tables]");
    let expected = [
        format!(
            "[--parsable][--job-name=motiongen-ingest]{usual}{array}[{stage}][ingest][--source][{place}/my music]{tables}"
        ),
        format!(
            "[--parsable][--job-name=motiongen-extract]{usual}{array}{}[{stage}][extract]{tables}",
            after(101)
        ),
        format!(
            "[--parsable][--job-name=motiongen-library]{usual}{single}{}[{stage}][library]{tables}",
            after(102)
        ),
        format!(
            "[--parsable][--job-name=motiongen-train]{usual}{single}[--time=2-0]{}[{stage}][train]{tables}[--run][night]\
             [--preset][base][--epochs][9]",
            after(103)
        ),
        format!(
            "[--parsable][--job-name=motiongen-export]{usual}{single}{}[{stage}][export]{tables}[--run][night]\
             [--model][night]",
            after(104)
        ),
        format!(
            "[--parsable][--job-name=motiongen-generate]{usual}{array}{}[{stage}][generate]{tables}[--model][night]",
            after(105)
        ),
        format!(
            "[--parsable][--job-name=motiongen-evaluate]{usual}{single}{}[{stage}][evaluate]{tables}[--run][night]",
            after(106)
        ),
    ];
    assert_eq!(submitted, expected);
    // Submitted at once, it is the same, but for the mark in the store by which nodes know it.
    std::fs::remove_file(dir.at("submitted")).expect("removed");
    let done = make_cluster(&dir, &settings[..settings.len() - 1]);
    assert_eq!((done.code, done.stderr.as_str()), (0, ""));
    assert!(
        done.stdout.starts_with("ingest    job 101, tasks 0-7 of 8 shards\nextract   job 102, "),
        "{done:?}"
    );
    let submitted = std::fs::read_to_string(dir.at("submitted")).expect("text");
    assert_eq!(submitted.lines().collect::<Vec<_>>(), expected);
    assert!(!std::fs::read_to_string(dir.at("tables/.cluster")).expect("a mark").trim().is_empty());
}

#[test]
fn only_what_is_left_is_submitted_again() {
    let dir = Dir::new();
    let place = dir.path().display();
    // A motiongen whose status has shards left of extract alone.
    let script = format!(
        "#!/bin/sh\necho \"$@\" >> {place}/calls\ncase \"$*\" in *--stage\\ extract*) echo 0,3,5-7; exit 75;; esac\n"
    );
    let motiongen = program(&dir, "bin/motiongen", &script);
    let again = |stages: &str| {
        make_cluster(
            &dir,
            &[
                &format!("STORE={place}/tables"),
                &format!("SOURCE={place}/s"),
                "MODEL=pretrained",
                "SHARDS=8",
                &format!("STAGES={stages}"),
                &format!("MOTIONGEN={}", motiongen.display()),
                "AGAIN=1",
                "DRY_RUN=1",
            ],
        )
    };
    let printed = again("ingest extract generate");
    assert_eq!(printed.code, 0, "{printed:?}");
    let lines: Vec<&str> = printed.stdout.lines().collect();
    assert_eq!((lines.len(), lines[0]), (3, "# ingest: nothing is left"));
    assert!(
        lines[1].starts_with("EXTRACT_JOB=$(SHARDS=8 ")
            && lines[1].contains(" --array=0\\,3\\,5-7 ")
    );
    assert!(
        lines[2].contains(" --array=0-7 ") && lines[2].contains("afterok:$EXTRACT_JOB "),
        "{lines:?}"
    );
    assert_eq!(
        calls(&dir),
        [
            format!("status --store {place}/tables --stage ingest --missing 8 --source {place}/s"),
            format!("status --store {place}/tables --stage extract --missing 8")
        ]
    );
    let nothing = again("ingest library generate evaluate");
    let none = ["ingest", "library", "generate", "evaluate"];
    let none = none.map(|stage| format!("# {stage}: nothing is left\n")).concat();
    assert_eq!(nothing.stdout, none);
    assert_eq!(
        calls(&dir)[3..],
        [
            format!("status --store {place}/tables --stage library --missing"),
            format!("status --store {place}/tables --stage generate --missing 8 --run pretrained"),
            format!("status --store {place}/tables --stage evaluate --missing --run pretrained")
        ]
    );
}

#[test]
fn a_chain_that_cannot_be_is_refused_in_a_sentence() {
    let dir = Dir::new();
    let motiongen = format!("MOTIONGEN={}", fake(&dir).display());
    let whole = ["SOURCE=s", "STORE=t", "RUN=r"];
    let name = |what: &str| {
        format!("error: name the {what}: make cluster SOURCE=music STORE=tables RUN=name\n")
    };
    let cases: [(&[&str], String); 6] = [
        (&["SOURCE=s", "RUN=r"], name("store")),
        (&["STORE=t", "RUN=r"], name("source")),
        (&["SOURCE=s", "STORE=t"], name("run")),
        (&["STORE=t", "STAGES=generate"], name("run or a model")),
        (
            &["STORE=t", "STAGES=extract dance"],
            "error: STAGES has \"dance\"; it may have ingest, extract, library, train, export, generate and evaluate\n"
                .to_owned(),
        ),
        (
            &[&whole[..], &["SHARDS=0-15"]].concat(),
            "error: SHARDS is \"0-15\"; give a number of tasks, such as 16\n".to_owned(),
        ),
    ];
    for (settings, sentence) in cases {
        let refused = make_cluster(&dir, &[settings, &[&motiongen]].concat());
        assert_eq!(refused.code, 2, "{refused:?}");
        assert!(refused.stderr.starts_with(&sentence), "{refused:?}");
    }
    // Without Slurm: a path that has the shell's own tools alone.
    for tool in ["bash", "dirname", "realpath", "make", "sh", "env"] {
        let found = std::env::split_paths(&std::env::var_os("PATH").expect("a path"))
            .map(|folder| folder.join(tool))
            .find(|path| path.exists())
            .unwrap_or_else(|| panic!("{tool} is needed"));
        std::os::unix::fs::symlink(found, dir.at("bin").join(tool)).expect("a link");
    }
    let mut command = command(&dir, &[&dir.at("bin/bash"), &pipelines("slurm/submit.sh")]);
    command.env("PATH", dir.at("bin")).env("MOTIONGEN", dir.at("bin/motiongen"));
    command.envs([("SOURCE", "s"), ("STORE", "t"), ("RUN", "r")]);
    let (code, _, stderr) = end(start(command));
    assert_eq!(
        (code, stderr.as_str()),
        (
            Some(2),
            "error: sbatch was not found, so there is no Slurm here; DRY_RUN=1 prints the commands, make ingest works \
             without\n"
        )
    );
}

/// What a container runs: 1 is a success for an indexed job, and the signal reaches the stage.
#[test]
fn a_container_ends_as_an_indexed_job_wants_it() {
    let dir = Dir::new();
    let motiongen = fake(&dir);
    let container = || {
        let script = pipelines("kubernetes/task.sh");
        let mut command = command(&dir, &[Path::new("sh"), &script]);
        command.env("MOTIONGEN", &motiongen).args(["ingest", "--shard=auto"]);
        start(command)
    };
    for (code, expected) in [("0", 0), ("1", 0), ("2", 2), ("75", 75)] {
        dir.write("code", code);
        assert_eq!(end(container()).0, Some(expected), "{code}");
    }
    dir.write("slow", "");
    let child = container();
    wait_until("the stage", || dir.at("began").exists());
    signal("TERM", child.id());
    assert_eq!(end(child).0, Some(75));
}
