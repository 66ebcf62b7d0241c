//! Help in two tiers: `--help` shows the flags that matter, `--help-all` every flag.
//!
//! A flag of the second tier says so where it is declared: `hide_short_help`, which stages give `RARE`.

use std::collections::BTreeSet;

use clap::{Arg, ArgAction, Command};

const HELP: &str = "help";
const HELP_ALL: &str = "help-all";
/// The heading of the flags that every stage has.
pub const GENERAL: &str = "General";

/// Gives a command and its kinds `--help`, which tells of `--help-all`, and `--help-all`.
///
/// `ending` stands below the flags of both.
pub fn in_tiers(command: Command, ending: &str) -> Command {
    let more = more(&command);
    let arg = |name: &'static str, action: ArgAction| {
        Arg::new(name).long(name).action(action).help_heading(GENERAL)
    };
    command
        .disable_help_flag(true)
        .arg(arg(HELP, ArgAction::HelpShort).short('h').help("Print the flags that matter"))
        .arg(arg(HELP_ALL, ArgAction::HelpLong).help("Print all flags, and what their values mean"))
        .after_help(format!("{more}\n\n{ending}"))
        .after_long_help(ending.to_owned())
        .mut_subcommands(|kind| in_tiers(kind, ending))
}

/// Returns the sentence about flags that `--help` leaves out, by their headings.
fn more(command: &Command) -> String {
    let rare = command.get_arguments().filter(|arg| arg.is_hide_short_help_set());
    let mut seen = BTreeSet::new();
    let headings: Vec<&str> = rare
        .filter_map(Arg::get_help_heading)
        .filter(|heading| *heading != GENERAL && seen.insert(*heading))
        .collect();
    let groups =
        if headings.is_empty() { String::new() } else { format!(": {}", headings.join(", ")) };
    format!("More flags with --{HELP_ALL}{groups}.")
}

/// Returns a command all of whose flags are of the first tier, for a manual page.
pub fn in_one_tier(command: Command) -> Command {
    command.mut_args(|arg| arg.hide_short_help(false)).mut_subcommands(in_one_tier)
}

/// Returns whether an argument is a flag whose value the environment and a configuration file may give.
pub fn is_setting(arg: &Arg) -> bool {
    let is_question = matches!(
        arg.get_action(),
        ArgAction::Count
            | ArgAction::Help
            | ArgAction::HelpShort
            | ArgAction::HelpLong
            | ArgAction::Version
    );
    arg.get_long().is_some() && !is_question
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rare_flag_is_left_out_of_the_short_help_and_of_no_other() {
        let flag = |name: &'static str, heading: &'static str| {
            Arg::new(name).long(name).help_heading(heading).help(format!("about {name}"))
        };
        let kind = Command::new("kind").arg(flag("depth", "Sizes").hide_short_help(true));
        let command = Command::new("stage")
            .long_about("about")
            .args([flag("store", "Options"), flag("beta", "Noise").hide_short_help(true)])
            .arg(flag("gamma", "Noise").hide_short_help(true))
            .arg(flag("quiet", GENERAL).hide_short_help(true))
            .subcommand(kind);
        let mut command = in_tiers(command, "The end.");
        command.build();
        let short = command.render_help().to_string();
        assert!(short.contains("--store") && short.contains("--help-all"), "{short}");
        for rare in ["--beta", "--gamma", "--quiet", "about beta"] {
            assert!(!short.contains(rare), "{rare}: {short}");
        }
        assert!(short.ends_with("More flags with --help-all: Noise.\n\nThe end.\n"), "{short}");
        let long = command.render_long_help().to_string();
        for text in ["--store", "--beta", "--gamma", "--quiet", "about beta", "The end."] {
            assert!(long.contains(text), "{text}: {long}");
        }
        let kind = command.find_subcommand_mut("kind").expect("the kind");
        assert!(kind.render_help().to_string().contains("More flags with --help-all: Sizes."));
        let page = in_one_tier(command).render_help().to_string();
        assert!(page.contains("--beta"), "{page}");
    }

    #[test]
    fn questions_are_no_settings() {
        let mut command = in_tiers(Command::new("stage").version("1"), "");
        command = command.arg(Arg::new("on").long("on").action(ArgAction::SetTrue));
        command = command.arg(Arg::new("v").long("v").action(ArgAction::Count));
        command.build();
        let settings = command.get_arguments().filter(|arg| is_setting(arg));
        assert_eq!(settings.filter_map(Arg::get_long).collect::<Vec<_>>(), ["on"]);
    }
}
