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
    let of = if headings.is_empty() { String::new() } else { format!(": {}", headings.join(", ")) };
    format!("More flags with --{HELP_ALL}{of}.")
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
