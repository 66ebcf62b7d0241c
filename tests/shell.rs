//! What the program tells a shell: completions and manual pages.

use std::io::Write as _;
use std::process::{Command, Stdio};

use crate::support::run;

const STAGES: [&str; 15] = [
    "ingest", "extract", "library", "train", "finetune", "tokenize", "export", "generate",
    "evaluate", "model", "plot", "view", "query", "compact", "vacuum",
];

#[test]
fn completions_know_every_stage_and_its_flags_and_bash_takes_them() {
    for shell in ["bash", "zsh", "fish", "powershell", "elvish"] {
        let output = run(["completions", shell]);
        assert_eq!((output.code, output.stderr.as_str()), (0, ""), "{shell}");
        for word in STAGES.iter().chain(&["guidance", "min-pass-rate"]) {
            assert!(output.stdout.contains(word), "{shell}: {word}");
        }
    }
    let script = run(["completions", "bash"]).stdout;
    let mut bash = Command::new("bash").arg("-n").stdin(Stdio::piped()).spawn().expect("bash");
    bash.stdin.take().expect("piped").write_all(script.as_bytes()).expect("written");
    assert!(bash.wait().expect("ended").success());
    let wrong = run(["completions", "tcsh"]);
    assert_eq!(wrong.code, 2);
    assert!(
        wrong.stderr.starts_with(
            "error: invalid value 'tcsh' for '<SHELL>'\n  [possible values: bash, elvish, fish, powershell, \
             zsh]\n"
        ),
        "{wrong:?}"
    );
}

#[test]
fn every_stage_has_a_manual_page() {
    let whole = run(["man"]).stdout;
    assert!(whole.contains(".TH motiongen 1"), "{whole}");
    for stage in STAGES {
        assert!(whole.contains(&format!("motiongen\\-{stage}(1)")), "{stage}");
        let page = run(["man", stage]);
        assert_eq!((page.code, page.stderr.as_str()), (0, ""), "{stage}");
        assert!(page.stdout.contains(&format!(".TH motiongen-{stage} 1")), "{}", page.stdout);
        for heading in [".SH NAME", ".SH SYNOPSIS", ".SH DESCRIPTION", "Exit codes: 0 done"] {
            assert!(page.stdout.contains(heading), "{stage}: {heading}");
        }
    }
    assert_eq!(run(["man", "dance"]).code, 2);
}
