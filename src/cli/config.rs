//! Configuration: flag, else environment, else TOML file, else default.
//!
//! A TOML value becomes the default of its flag before the command line is parsed, so clap checks
//! it like a typed one, `--help` shows it, and no parameter is declared twice.

use std::ffi::OsString;

use anyhow::{Context as _, bail};
use clap::{ArgAction, Command};

/// The flag that names the file.
pub const FLAG: &str = "config";
const VARIABLE_PREFIX: &str = "MOTIONGEN_";

/// Gives every flag of a command its environment variable, `MOTIONGEN_<FLAG>`.
pub fn with_environment(mut command: Command) -> Command {
    let flags: Vec<_> = command
        .get_arguments()
        .filter(|a| a.get_long().is_some() && !matches!(a.get_action(), ArgAction::Count))
        .map(|a| (a.get_id().clone(), variable(a.get_long().unwrap_or_default())))
        .collect();
    for (id, variable) in flags {
        command = command.mut_arg(id, |arg| arg.env(variable));
    }
    command
}

fn variable(flag: &str) -> String {
    format!("{VARIABLE_PREFIX}{}", flag.to_uppercase().replace('-', "_"))
}

/// Makes the values of the configuration file, if one is named, the defaults of `command`.
///
/// With `stages`, `command` is the front door and the stage that `arguments` name is configured;
/// without, it is the stage itself.
///
/// # Errors
/// When the file cannot be read, is not TOML, or has a key that the stage does not know.
pub fn apply(
    mut command: Command,
    stages: &[&str],
    arguments: &[OsString],
) -> anyhow::Result<Command> {
    let Some(path) = file_named(arguments) else { return Ok(command) };
    let text = std::fs::read_to_string(&path)
        .with_context(|| format!("configuration {}: could not be read", path.to_string_lossy()))?;
    let table: toml::Table = text
        .parse()
        .with_context(|| format!("configuration {}: is not TOML", path.to_string_lossy()))?;
    if stages.is_empty() {
        let name = command.get_name().trim_start_matches("motiongen-").to_owned();
        return with_defaults(command, &name, &table, &path.to_string_lossy());
    }
    let chosen = arguments.iter().skip(1).find_map(|a| {
        let word = a.to_str()?;
        stages.iter().find(|stage| **stage == word)
    });
    let Some(chosen) = chosen else { return Ok(command) };
    let mut outcome = Ok(());
    command = command.mut_subcommand(chosen, |sub| {
        match with_defaults(sub.clone(), chosen, &table, &path.to_string_lossy()) {
            Ok(configured) => configured,
            Err(e) => {
                outcome = Err(e);
                sub
            }
        }
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

fn with_defaults(
    mut command: Command,
    stage: &str,
    table: &toml::Table,
    path: &str,
) -> anyhow::Result<Command> {
    // Top-level values are for every stage; a stage's own table wins over them.
    let shared = table.iter().filter(|(_, value)| !value.is_table()).map(|kv| (kv, false));
    let own = table.get(stage).and_then(toml::Value::as_table);
    let own = own.into_iter().flatten().map(|kv| (kv, true));
    for ((key, value), is_own) in shared.chain(own) {
        let flag = key.replace('_', "-");
        let known = command.get_arguments().find(|a| {
            a.get_long() == Some(flag.as_str()) && !matches!(a.get_action(), ArgAction::Count)
        });
        let Some(argument) = known.filter(|_| flag != FLAG) else {
            // A shared key may be meant for another stage.
            if !is_own {
                continue;
            }
            bail!("configuration {path}: {}", unknown_key(&command, stage, key));
        };
        let id = argument.get_id().clone();
        let values = texts(value)
            .with_context(|| format!("configuration {path}: [{stage}] {key} cannot be a table"))?;
        command = command.mut_arg(id, |arg| arg.default_values(values).required(false));
    }
    Ok(command)
}

fn unknown_key(command: &Command, stage: &str, key: &str) -> String {
    let known: Vec<_> = command
        .get_arguments()
        .filter(|a| !matches!(a.get_action(), ArgAction::Count))
        .filter_map(|a| a.get_long())
        .filter(|flag| !["help", "version", FLAG].contains(flag))
        .collect();
    let nearest = known
        .iter()
        .max_by(|a, b| strsim::jaro_winkler(key, a).total_cmp(&strsim::jaro_winkler(key, b)))
        .map_or("", |flag| flag);
    format!(
        "[{stage}] has no key \"{key}\"; nearest: {nearest}; {stage} knows {}",
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
