//! Configuration: flag, else environment, else TOML file, else default.
//!
//! A TOML value becomes the default of its flag before the command line is parsed, so clap checks
//! it like a typed one, `--help` shows it, and no parameter is declared twice.

use std::collections::BTreeSet;
use std::ffi::OsString;

use anyhow::{Context as _, bail};
use clap::{Arg, ArgAction, Command, Id};

/// The flag that names the file.
pub const FLAG: &str = "config";
const VARIABLE_PREFIX: &str = "MOTIONGEN_";

/// Returns the text about the flag that names the file.
pub fn help(command: &Command) -> String {
    let stage = command.get_name();
    let tables = match command.get_subcommands().next() {
        Some(kind) => format!("in [{stage}], or in a kind's own [{stage}.{}]", kind.get_name()),
        None => format!("or in [{stage}]"),
    };
    format!("Take defaults from this TOML file: flags without their dashes, top level, {tables}")
}

/// Gives every flag of a command and its kinds its environment variable, `MOTIONGEN_<FLAG>`.
pub fn with_environment(mut command: Command) -> Command {
    let flags: Vec<_> = command
        .get_arguments()
        .filter(|a| a.get_long().is_some() && !matches!(a.get_action(), ArgAction::Count))
        .map(|a| (a.get_id().clone(), variable(a.get_long().unwrap_or_default())))
        .collect();
    for (id, variable) in flags {
        command = command.mut_arg(id, |arg| arg.env(variable));
    }
    command.mut_subcommands(with_environment)
}

fn variable(flag: &str) -> String {
    format!("{VARIABLE_PREFIX}{}", flag.to_uppercase().replace('-', "_"))
}

/// Makes the values of the configuration file, if one is named, the defaults of `command`.
///
/// Of the front door, the stage that `arguments` name is configured; any other `command` is the stage
/// itself.
///
/// # Errors
/// When the file cannot be read, is not TOML, or has a key that the stage does not know.
pub fn apply(
    command: Command,
    is_front_door: bool,
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
    let mut words = arguments.iter().skip(1).filter_map(|a| a.to_str());
    let chosen = words.find_map(|word| command.find_subcommand(word));
    let Some(name) = chosen.map(|sub| sub.get_name().to_owned()) else { return Ok(command) };
    let mut outcome = Ok(());
    let command = command.mut_subcommand(&name, |sub| {
        change(&name, sub.clone()).unwrap_or_else(|e| {
            outcome = Err(e);
            sub
        })
    });
    outcome.map(|()| command)
}

/// Returns the file that the flag or the environment names.
pub fn file_named(arguments: &[OsString]) -> Option<OsString> {
    let flag = format!("--{FLAG}");
    let mut rest = arguments.iter().skip(1);
    while let Some(argument) = rest.next() {
        if argument.to_str() == Some("--") {
            break;
        }
        if argument.to_str() == Some(&flag) {
            return rest.next().cloned();
        }
        if let Some(value) = argument.to_str().and_then(|a| a.strip_prefix(&format!("{flag}="))) {
            return Some(value.into());
        }
    }
    std::env::var_os(variable(FLAG)).filter(|value| !value.is_empty())
}

/// A configuration file that was read.
struct File<'a> {
    path: String,
    arguments: &'a [OsString],
}

/// A key and its value.
type Entry<'a> = (&'a String, &'a toml::Value);

impl File<'_> {
    /// Makes values the defaults of `command` and of the kind of it that was chosen.
    ///
    /// `shared` are values for whoever knows them; those of the command's own table win over them
    /// and must be known.
    fn configure(
        &self,
        mut command: Command,
        section: &str,
        shared: &[Entry<'_>],
        own: Option<&toml::Value>,
    ) -> anyhow::Result<Command> {
        let path = &self.path;
        let own = own.and_then(toml::Value::as_table);
        let is_kind = |(key, value): &Entry<'_>| {
            value.is_table() && command.get_subcommands().any(|kind| kind.get_name() == *key)
        };
        let own_values: Vec<_> = own.into_iter().flatten().filter(|kv| !is_kind(kv)).collect();
        let entries = shared.iter().map(|kv| (*kv, false));
        for ((key, value), is_own) in entries.chain(own_values.iter().map(|kv| (*kv, true))) {
            let Some(id) = find(&command, key) else {
                // A shared key may be meant for another stage, an own one for a kind.
                if is_own && !command.get_subcommands().any(|kind| find(kind, key).is_some()) {
                    bail!("configuration {path}: {}", unknown_key(&command, section, key));
                }
                continue;
            };
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
    let is_it = |a: &&Arg| {
        a.get_long() == Some(flag.as_str()) && !matches!(a.get_action(), ArgAction::Count)
    };
    command.get_arguments().find(is_it).filter(|_| flag != FLAG).map(|a| a.get_id().clone())
}

fn unknown_key(command: &Command, section: &str, key: &str) -> String {
    let mut known: Vec<_> = std::iter::once(command)
        .chain(command.get_subcommands())
        .flat_map(Command::get_arguments)
        .filter(|a| !matches!(a.get_action(), ArgAction::Count))
        .filter_map(|a| a.get_long())
        .filter(|flag| !["help", "version", FLAG].contains(flag))
        .collect();
    let mut seen = BTreeSet::new();
    known.retain(|flag| seen.insert(*flag));
    let nearest = known
        .iter()
        .max_by(|a, b| strsim::jaro_winkler(key, a).total_cmp(&strsim::jaro_winkler(key, b)))
        .map_or("", |flag| flag);
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
