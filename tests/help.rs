//! Help in two tiers: what matters, and everything.

use std::collections::BTreeSet;

use crate::support::{Dir, finish, motiongen, run};

/// Stages, and kinds of stages that take flags of their own.
const COMMANDS: [&[&str]; 20] = [
    &["ingest"],
    &["extract"],
    &["library"],
    &["train"],
    &["finetune"],
    &["tokenize"],
    &["export"],
    &["generate"],
    &["evaluate"],
    &["model"],
    &["plot"],
    &["plot", "features"],
    &["plot", "training"],
    &["plot", "motion"],
    &["plot", "tokens"],
    &["view"],
    &["query"],
    &["status"],
    &["compact"],
    &["vacuum"],
];
/// More flags than this are no first look.
const MAX_SHOWN: usize = 15;

/// Returns the flags of a help text, whose entries stand in the seventh column, or in the third where they are short,
/// too; what is said of them stands further right.
fn flags(text: &str) -> Vec<String> {
    let entry = |line: &str| {
        let is_short_too = line.starts_with("  -") && line.get(4..8) == Some(", --");
        let long = line.strip_prefix("      ").or(line.get(6..).filter(|_| is_short_too))?;
        let name = long.strip_prefix("--")?;
        let end = name.find(|c: char| !c.is_alphanumeric() && c != '-').unwrap_or(name.len());
        Some(format!("--{}", &name[..end]))
    };
    text.lines().filter_map(entry).collect()
}

/// Returns the flags that completions offer for a command: they know nothing of tiers.
fn completed(script: &str, command: &[&str]) -> BTreeSet<String> {
    let (stage, kind) = (command[0], command.get(1));
    let of_stage = format!("__fish_motiongen_using_subcommand {stage}");
    let lines = script.lines().filter(|line| line.contains(&of_stage)).filter(|line| match kind {
        Some(kind) => line.contains(&format!("__fish_seen_subcommand_from {kind}\"")),
        None => !line.contains("; and __fish_seen_subcommand_from"),
    });
    let flag = |line: &str| {
        let words: Vec<&str> = line.split_whitespace().collect();
        let at = words.iter().position(|word| *word == "-l")?;
        Some(format!("--{}", words[at + 1]))
    };
    lines.filter_map(flag).collect()
}

fn help(command: &[&str], flag: &str) -> String {
    let arguments: Vec<&str> = command.iter().copied().chain([flag]).collect();
    let output = run(&arguments);
    assert_eq!((output.code, output.stderr.as_str()), (0, ""), "{arguments:?}");
    output.stdout
}

#[test]
fn help_shows_what_matters_and_help_all_every_flag() {
    let script = run(["completions", "fish"]).stdout;
    for command in COMMANDS {
        let short = help(command, "--help");
        assert_eq!(short, help(command, "-h"), "{command:?}");
        let shown = flags(&short);
        assert!(shown.len() <= MAX_SHOWN, "{command:?} shows {}: {shown:?}", shown.len());
        for flag in ["--help", "--help-all", "--config"] {
            assert!(shown.iter().any(|f| f == flag), "{command:?}: {flag} in {shown:?}");
        }
        assert!(short.contains("\nMore flags with --help-all"), "{command:?}: {short}");

        let long = help(command, "--help-all");
        let all = flags(&long);
        let all_once: BTreeSet<String> = all.iter().cloned().collect();
        assert_eq!(all.len(), all_once.len(), "{command:?} shows a flag twice: {all:?}");
        let offered = completed(&script, command);
        assert!(offered.len() >= 6, "{command:?}: completions offer {offered:?}");
        assert_eq!(all_once, offered, "{command:?}");
        let is_lost = |flag: &&String| !all_once.contains(*flag);
        assert_eq!(shown.iter().find(is_lost), None, "{command:?}");
        for text in ["Exit codes: 0 done", "Reads: ", "--summary", "MOTIONGEN_SUMMARY"] {
            assert!(long.contains(text), "{command:?}: {text}");
        }
        assert!(!long.contains("More flags with"), "{command:?}");
    }
}

#[test]
fn the_program_and_its_commands_for_the_shell_have_help_of_both_kinds() {
    let front = help(&[], "--help");
    for text in ["Stages, in the order of a pipeline", "  vacuum ", "--config", "--help-all"] {
        assert!(front.contains(text), "{text}: {front}");
    }
    assert!(!front.contains("--summary") && help(&[], "--help-all").contains("--summary"));
    for command in ["completions", "man"] {
        let text = help(&[command], "--help");
        assert!(
            text.contains("xample: motiongen man") || text.contains("bash: motiongen"),
            "{text}"
        );
        assert!(flags(&text).iter().any(|flag| flag == "--help-all"), "{text}");
    }
    // The help command shows everything.
    let whole = run(["help", "train"]).stdout;
    assert!(whole.contains("--beta-start") && whole.contains("Exit codes: 0 done"), "{whole}");
}

#[test]
fn the_rare_flags_of_train_are_grouped_and_named_in_the_short_help() {
    let (short, long) = (help(&["train"], "--help"), help(&["train"], "--help-all"));
    let more = "More flags with --help-all: Budget, Networks, Diffusion, Groups, Tokens, Augmentation, Optimizer, \
                Decoder, Machine, Remote storage.";
    assert!(short.replace('\n', " ").contains(more), "{short}");
    for (flag, heading) in [
        ("--save-every", "Budget"),
        ("--widths", "Networks"),
        ("--beta-start", "Diffusion"),
        ("--negatives", "Groups"),
        ("--least-usage", "Tokens"),
        ("--no-mirror", "Augmentation"),
        ("--ema-decay", "Optimizer"),
        ("--decoder-noised-to", "Decoder"),
        ("--store-patience", "Machine"),
        ("--max-retries", "Remote storage"),
    ] {
        assert!(!flags(&short).iter().any(|f| f == flag), "{flag} is rare");
        let at = long.find(&format!("      {flag}")).unwrap_or_else(|| panic!("{flag}: {long}"));
        let mut headings =
            long[..at].lines().filter(|line| line.ends_with(':') && !line.starts_with(' '));
        assert_eq!(headings.next_back(), Some(format!("{heading}:").as_str()), "{flag}");
    }
}

#[test]
fn a_rare_flag_keeps_its_text_in_the_manual_page() {
    let page = run(["man", "train"]).stdout;
    assert!(page.contains("Course of the learning rate after the warm"), "{page}");
}

#[test]
fn neither_the_environment_nor_a_file_may_ask_for_help() {
    let refused = finish(motiongen().args(["query", "--tables"]).env("MOTIONGEN_HELP_ALL", "1"));
    assert_eq!(refused.code, 2, "{refused:?}");
    let sentence = "environment variable MOTIONGEN_HELP_ALL is no setting of motiongen";
    assert!(refused.stderr.contains(sentence), "{refused:?}");
    let dir = Dir::new();
    let file = dir.write("help.toml", "[query]\nhelp-all = true\n");
    let refused =
        run(["query", "--config", file.to_str().expect("UTF-8"), "--tables", "--store", "x"]);
    assert_eq!(refused.code, 2, "{refused:?}");
    assert!(refused.stderr.contains("[query] has no key \"help-all\""), "{refused:?}");
}
