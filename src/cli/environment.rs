//! Environment variables: `MOTIONGEN_<FLAG>` for every flag of every stage, and the few that are no flags.

use std::collections::BTreeSet;
use std::ffi::OsStr;

use anyhow::bail;
use clap::builder::{BoolishValueParser, TypedValueParser};
use clap::{Arg, ArgAction, Command};

use super::help::is_setting;

/// The prefix of the names of all variables of the program.
const PREFIX: &str = "MOTIONGEN_";
/// Variables that are read elsewhere: by the log, by onnxruntime's sessions, by the kernels.
const OTHERS: [&str; 3] = ["MOTIONGEN_LOG", "MOTIONGEN_DEVICE", "MOTIONGEN_SIMD"];
/// The prefix of the names of variables that the project's own tests read.
const OF_TESTS: [&str; 2] = ["MOTIONGEN_TEST_", "MOTIONGEN_PAGE"];
/// Flags of stages that a build may be without.
const OF_OTHER_BUILDS: [&str; 3] = ["MOTIONGEN_SQL", "MOTIONGEN_TABLES", "MOTIONGEN_SOUNDFONT"];

/// Returns the name of the variable that stands for a flag.
pub fn variable(flag: &str) -> String {
    format!("{PREFIX}{}", flag.to_uppercase().replace('-', "_"))
}

/// Gives every flag of a command and its kinds its environment variable, and lets switches take what people write.
pub fn with_environment(mut command: Command) -> Command {
    let flags: Vec<_> = command
        .get_arguments()
        .filter(|a| is_setting(a))
        .map(|a| {
            let name = variable(a.get_long().unwrap_or_default());
            (a.get_id().clone(), name, matches!(a.get_action(), ArgAction::SetTrue))
        })
        .collect();
    for (id, name, is_switch) in flags {
        command = command.mut_arg(id, |arg| {
            let arg = arg.env(name);
            if is_switch { arg.value_parser(SwitchParser) } else { arg }
        });
    }
    command.mut_subcommands(with_environment)
}

/// Reads a switch: 1, yes, true, on or 0, no, false, off, in any case; empty is off.
#[derive(Clone)]
struct SwitchParser;

impl TypedValueParser for SwitchParser {
    type Value = bool;

    fn parse_ref(
        &self,
        command: &Command,
        arg: Option<&Arg>,
        value: &OsStr,
    ) -> Result<bool, clap::Error> {
        if value.is_empty() {
            return Ok(false);
        }
        BoolishValueParser::new().parse_ref(command, arg, value)
    }

    fn possible_values(
        &self,
    ) -> Option<Box<dyn Iterator<Item = clap::builder::PossibleValue> + '_>> {
        BoolishValueParser::new().possible_values().map(|values| {
            let values: Vec<_> = values.collect();
            Box::new(values.into_iter()) as Box<dyn Iterator<Item = _>>
        })
    }
}

/// Refuses a variable whose name begins like those of the program but is none of them.
///
/// # Errors
/// One sentence that names the variable and the nearest known one.
pub fn check(
    commands: &[Command],
    variables: impl Iterator<Item = std::ffi::OsString>,
) -> anyhow::Result<()> {
    let mut known: BTreeSet<String> = OTHERS.map(str::to_owned).into();
    for command in commands {
        add(command, &mut known);
    }
    let mut found: Vec<String> =
        variables.map(|name| name.to_string_lossy().into_owned()).collect();
    found.sort_unstable();
    let is_known = |name: &String| {
        known.contains(name)
            || OF_TESTS.iter().any(|start| name.starts_with(start))
            || OF_OTHER_BUILDS.contains(&name.as_str())
    };
    let unknown = found.iter().find(|name| name.starts_with(PREFIX) && !is_known(name));
    if let Some(name) = unknown {
        let nearest = nearest(name, known.iter().map(String::as_str));
        bail!("environment variable {name} is no setting of motiongen; nearest: {nearest}");
    }
    Ok(())
}

fn add(command: &Command, known: &mut BTreeSet<String>) {
    let flags = command.get_arguments().filter(|a| is_setting(a)).filter_map(Arg::get_long);
    known.extend(flags.map(variable));
    command.get_subcommands().for_each(|kind| add(kind, known));
}

/// Returns the known name that is most like a name.
pub fn nearest<'a>(name: &str, known: impl Iterator<Item = &'a str>) -> &'a str {
    let likeness = |a: &str| strsim::jaro_winkler(name, a);
    known.max_by(|a, b| likeness(a).total_cmp(&likeness(b))).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn switch(text: &str) -> Option<bool> {
        SwitchParser.parse_ref(&Command::new("x"), None, OsStr::new(text)).ok()
    }

    #[test]
    fn switches_take_what_people_write() {
        for text in ["1", "yes", "true", "on", "YES", "True", "y", "t"] {
            assert_eq!(switch(text), Some(true), "{text}");
        }
        for text in ["0", "no", "false", "off", "No", "OFF", "n", "f", ""] {
            assert_eq!(switch(text), Some(false), "{text:?}");
        }
        for text in ["2", "ja", " ", "truee"] {
            assert_eq!(switch(text), None, "{text:?}");
        }
    }

    #[test]
    fn a_variable_that_nobody_reads_is_refused() {
        let commands = [Command::new("query").arg(Arg::new("format").long("format"))];
        let check = |names: &[&str]| {
            check(&commands, names.iter().map(Into::into)).map_err(|e| e.to_string())
        };
        let known =
            ["PATH", "MOTIONGEN", "MOTIONGEN_FORMAT", "MOTIONGEN_LOG", "MOTIONGEN_TEST_PYTHON"];
        assert_eq!(check(&known), Ok(()));
        assert_eq!(
            check(&["MOTIONGEN_FORMTA"]),
            Err("environment variable MOTIONGEN_FORMTA is no setting of motiongen; nearest: MOTIONGEN_FORMAT"
                .to_owned())
        );
    }
}
