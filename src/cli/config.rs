//! Configuration: flag, else environment, else TOML file, else default.
//!
//! A TOML value becomes the default of its flag before the command line is parsed, so clap checks
//! it like a typed one, `--help` shows it, and no parameter is declared twice.

use std::collections::BTreeSet;
use std::ffi::OsString;

use anyhow::{Context as _, bail};
use clap::{Arg, Command, Id};

use super::environment::{nearest, variable};
use super::help::is_setting;

/// The flag that names the file.
pub const FLAG: &str = "config";
/// Sections of stages that a build may be without.
const OF_OTHER_BUILDS: [&str; 1] = ["query"];

/// Returns the text about the flag that names the file.
pub fn help(command: &Command) -> String {
    let stage = command.get_name();
    let tables = match command.get_subcommands().next() {
        Some(kind) => format!("in [{stage}], or in a kind's own [{stage}.{}]", kind.get_name()),
        None => format!("or in [{stage}]"),
    };
    format!("Take defaults from this TOML file: flags without their dashes, top level, {tables}")
}

/// Makes the values of the configuration file, if one is named, the defaults of `command`.
///
/// Of the front door, the stage that `arguments` name is configured; any other `command` is the stage
/// itself. `stages` are the commands of all stages, whose sections the file may have.
///
/// # Errors
/// When the file cannot be read, is not TOML, or has a section or a key that no stage knows.
pub fn apply(
    command: Command,
    is_front_door: bool,
    stages: &[Command],
    arguments: &[OsString],
) -> anyhow::Result<Command> {
    let Some(path) = file_named(arguments) else { return Ok(command) };
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("configuration {}: could not be read", path.to_string_lossy()))?;
    let table: toml::Table = text
        .parse()
        .with_context(|| format!("configuration {}: is not TOML", path.to_string_lossy()))?;
    // Top-level values are for every stage.
    let shared: Vec<_> = table.iter().filter(|(_, value)| !value.is_table()).collect();
    let file = File { path: path.to_string_lossy().into_owned(), arguments };
    file.check(&table, stages)?;
    if !is_front_door {
        let name = command.get_name().trim_start_matches("motiongen-").to_owned();
        return file.configure(command, &name, &shared, table.get(&name));
    }
    try_mut_subcommand(command, arguments, |stage, command| {
        file.configure(command, stage, &shared, table.get(stage))
    })
}

/// Changes the subcommand that `arguments` name, if they name one.
fn try_mut_subcommand(
    command: Command,
    arguments: &[OsString],
    change: impl FnOnce(&str, Command) -> anyhow::Result<Command>,
) -> anyhow::Result<Command> {
    let Some(name) = subcommand_named(&command, arguments) else { return Ok(command) };
    let mut outcome = Ok(());
    let command = command.mut_subcommand(&name, |sub| {
        change(&name, sub.clone()).unwrap_or_else(|e| {
            outcome = Err(e);
            sub
        })
    });
    outcome.map(|()| command)
}

/// Returns the name of the subcommand that `arguments` name, if they name one.
pub fn subcommand_named(command: &Command, arguments: &[OsString]) -> Option<String> {
    // The value of a general flag may be called like a stage.
    let general = [FLAG, super::exit::FLAG].map(|flag| format!("--{flag}"));
    let mut words = arguments.iter().skip(1).filter_map(|a| a.to_str());
    while let Some(word) = words.next() {
        if general.iter().any(|flag| flag == word) {
            words.next();
        } else if let Some(sub) = command.find_subcommand(word) {
            return Some(sub.get_name().to_owned());
        }
    }
    None
}

/// Returns the file that the flag or the environment names.
pub fn file_named(arguments: &[OsString]) -> Option<OsString> {
    value_of(FLAG, arguments)
}

/// Returns the value of a flag that is needed before all are parsed: that of the arguments, or of the environment.
pub fn value_of(flag: &str, arguments: &[OsString]) -> Option<OsString> {
    let long = format!("--{flag}");
    let mut rest = arguments.iter().skip(1);
    while let Some(argument) = rest.next() {
        if argument.to_str() == Some("--") {
            break;
        }
        if argument.to_str() == Some(&long) {
            return rest.next().cloned();
        }
        if let Some(value) = argument.to_str().and_then(|a| a.strip_prefix(&format!("{long}="))) {
            return Some(value.into());
        }
    }
    std::env::var_os(variable(flag)).filter(|value| !value.is_empty())
}

/// A configuration file that was read.
struct File<'a> {
    path: String,
    arguments: &'a [OsString],
}

/// A key and its value.
type ConfigEntry<'a> = (&'a String, &'a toml::Value);

impl File<'_> {
    /// Refuses a section that is no stage's, and a key that no stage knows.
    fn check(&self, table: &toml::Table, stages: &[Command]) -> anyhow::Result<()> {
        let path = &self.path;
        for (name, value) in table {
            let stage = stages.iter().find(|stage| stage.get_name() == name);
            match (value.as_table(), stage) {
                (Some(own), Some(stage)) => self.check_section(name, own, stage)?,
                (Some(_), None) if OF_OTHER_BUILDS.contains(&name.as_str()) => {}
                (Some(_), None) => {
                    let names = || stages.iter().map(Command::get_name);
                    bail!(
                        "configuration {path}: has a section [{name}], which is no stage; nearest: {}; the stages \
                         are {}",
                        nearest(name, names()),
                        names().collect::<Vec<_>>().join(", ")
                    );
                }
                (None, Some(_)) => {
                    bail!("configuration {path}: {name} is a stage; write its keys below [{name}]")
                }
                (None, None) if stages.iter().any(|stage| knows(stage, name)) => {}
                (None, None) => {
                    let known: BTreeSet<&str> = stages.iter().flat_map(keys).collect();
                    bail!(
                        "configuration {path}: no stage has a key \"{name}\"; nearest: {}",
                        nearest(name, known.into_iter())
                    );
                }
            }
        }
        Ok(())
    }

    fn check_section(
        &self,
        section: &str,
        own: &toml::Table,
        command: &Command,
    ) -> anyhow::Result<()> {
        for (key, value) in own {
            let kind = command.get_subcommands().find(|kind| kind.get_name() == key);
            match (value.as_table(), kind) {
                (Some(own), Some(kind)) => {
                    self.check_section(&format!("{section}.{key}"), own, kind)?;
                }
                _ if knows(command, key) => {}
                _ => bail!("configuration {}: {}", self.path, unknown_key(command, section, key)),
            }
        }
        Ok(())
    }

    /// Makes values the defaults of `command` and of the kind of it that was chosen.
    ///
    /// `shared` are values of the file that any command may use if it has such a flag; values of the command's own
    /// table take precedence.
    fn configure(
        &self,
        mut command: Command,
        section: &str,
        shared: &[ConfigEntry<'_>],
        own: Option<&toml::Value>,
    ) -> anyhow::Result<Command> {
        let path = &self.path;
        let own = own.and_then(toml::Value::as_table);
        let is_kind = |(key, value): &ConfigEntry<'_>| {
            value.is_table() && command.get_subcommands().any(|kind| kind.get_name() == *key)
        };
        let own_values: Vec<_> = own.into_iter().flatten().filter(|kv| !is_kind(kv)).collect();
        for (key, value) in shared.iter().chain(&own_values).copied() {
            // A shared key may be meant for another stage, an own one for a kind.
            let Some(id) = find(&command, key) else { continue };
            let values = texts(value).with_context(|| {
                format!("configuration {path}: [{section}] {key} cannot be a table")
            })?;
            command = command.mut_arg(id, |arg| arg.default_values(values).required(false));
        }
        let shared: Vec<_> = shared.iter().chain(&own_values).copied().collect();
        try_mut_subcommand(command, self.arguments, |kind, command| {
            let own = own.and_then(|table| table.get(kind));
            self.configure(command, &format!("{section}.{kind}"), &shared, own)
        })
    }
}

/// Returns the argument that a key sets.
fn find(command: &Command, key: &str) -> Option<Id> {
    let flag = key.replace('_', "-");
    let is_it = |a: &&Arg| a.get_long() == Some(flag.as_str()) && is_setting(a);
    command.get_arguments().find(is_it).filter(|_| flag != FLAG).map(|a| a.get_id().clone())
}

/// Returns whether a key sets a flag of a command or of one of its kinds.
fn knows(command: &Command, key: &str) -> bool {
    find(command, key).is_some() || command.get_subcommands().any(|kind| knows(kind, key))
}

/// Returns the flags of a command and its kinds that keys may set, each once.
fn keys(command: &Command) -> Vec<&str> {
    let mut seen = BTreeSet::new();
    let own = command
        .get_arguments()
        .filter(|a| is_setting(a))
        .filter_map(Arg::get_long)
        .filter(|flag| *flag != FLAG);
    let kind_keys = command.get_subcommands().flat_map(keys);
    own.chain(kind_keys).filter(|flag| seen.insert(*flag)).collect()
}

fn unknown_key(command: &Command, section: &str, key: &str) -> String {
    let known = keys(command);
    let nearest = nearest(key, known.iter().copied());
    format!(
        "[{section}] has no key \"{key}\"; nearest: {nearest}; {section} knows {}",
        known.join(", ")
    )
}

fn texts(value: &toml::Value) -> Option<Vec<String>> {
    match value {
        toml::Value::String(text) => Some(vec![text.clone()]),
        toml::Value::Array(values) => {
            values.iter().map(|v| texts(v).and_then(|mut t| t.pop())).collect()
        }
        toml::Value::Integer(n) => Some(vec![n.to_string()]),
        toml::Value::Float(x) => Some(vec![x.to_string()]),
        toml::Value::Boolean(yes) => Some(vec![yes.to_string()]),
        toml::Value::Datetime(time) => Some(vec![time.to_string()]),
        toml::Value::Table(_) => None,
    }
}
