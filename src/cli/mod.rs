//! The command line: flags, configuration, logging, progress and exit codes.
//!
//! This is the only room that prints, and `exit` is the only place that prints an error and chooses the exit
//! code.

mod config;
mod environment;
mod escaped;
mod exit;
mod help;
mod interrupt;
mod log;
mod progress;
mod shell;

use std::ffi::OsString;
use std::io::Write;
use std::path::Path;
use std::process::ExitCode;

use clap::builder::EnumValueParser;
use clap::{Arg, ArgAction, ArgMatches, Command, FromArgMatches as _};

use crate::stages::compact::Compact;
use crate::stages::evaluate::Evaluate;
use crate::stages::export::Export;
use crate::stages::extract::Extract;
use crate::stages::finetune::Finetune;
use crate::stages::generate::Generate;
use crate::stages::ingest::Ingest;
use crate::stages::library::Library;
use crate::stages::model::Model;
use crate::stages::plot::Plot;
#[cfg(feature = "query")]
use crate::stages::query::Query;
use crate::stages::status::Status;
use crate::stages::tokenize::Tokenize;
use crate::stages::train::Train;
use crate::stages::vacuum::Vacuum;
use crate::stages::view::View;
use crate::stages::{Stage, Summary, is_standard_output};
use exit::Form;
use progress::Bars;

/// A stage with its types taken away, for the front door.
struct StageEntry {
    name: &'static str,
    about: &'static str,
    command: fn() -> Command,
    run: fn(&ArgMatches) -> ExitCode,
}

impl StageEntry {
    fn of<S: Stage>() -> Self {
        Self { name: S::NAME, about: S::ABOUT, command: command::<S>, run: run_stage::<S> }
    }
}

/// Returns every stage, in the order in which a pipeline runs them.
fn entries() -> Vec<StageEntry> {
    vec![
        StageEntry::of::<Ingest>(),
        StageEntry::of::<Extract>(),
        StageEntry::of::<Library>(),
        StageEntry::of::<Train>(),
        StageEntry::of::<Finetune>(),
        StageEntry::of::<Tokenize>(),
        StageEntry::of::<Export>(),
        StageEntry::of::<Generate>(),
        StageEntry::of::<Evaluate>(),
        StageEntry::of::<Model>(),
        StageEntry::of::<Plot>(),
        StageEntry::of::<View>(),
        #[cfg(feature = "query")]
        StageEntry::of::<Query>(),
        StageEntry::of::<Status>(),
        StageEntry::of::<Compact>(),
        StageEntry::of::<Vacuum>(),
    ]
}

/// Returns the commands of every stage, without what runs them: a stage's own executable needs no other stage.
fn commands() -> Vec<Command> {
    vec![
        command::<Ingest>(),
        command::<Extract>(),
        command::<Library>(),
        command::<Train>(),
        command::<Finetune>(),
        command::<Tokenize>(),
        command::<Export>(),
        command::<Generate>(),
        command::<Evaluate>(),
        command::<Model>(),
        command::<Plot>(),
        command::<View>(),
        #[cfg(feature = "query")]
        command::<Query>(),
        command::<Status>(),
        command::<Compact>(),
        command::<Vacuum>(),
    ]
}

/// Runs one stage's own executable, `motiongen-<stage>`.
pub fn stage<S: Stage>() -> ExitCode {
    let command = command::<S>().name(format!("motiongen-{}", S::NAME)).version(VERSION);
    let arguments: Vec<OsString> = std::env::args_os().collect();
    match matches(command, S::NAME, false, &arguments) {
        Ok(matches) => run_stage::<S>(&matches),
        Err(code) => code,
    }
}

/// Runs `motiongen`, which has every stage as a subcommand.
pub fn front_door() -> ExitCode {
    let entries = entries();
    let hint = format!("{}\n\n{EXIT_CODES}", shell::HINT);
    let command = Command::new(PROGRAM)
        .version(VERSION)
        .about("Turns a music library into motion, stage by stage.")
        .subcommand_value_name("STAGE")
        .subcommand_help_heading("Stages, in the order of a pipeline")
        .args(general("Take defaults from this TOML file".to_owned()));
    // Stages have help of their own.
    let mut command = help::in_tiers(command, &hint);
    for entry in &entries {
        command = command.subcommand((entry.command)());
    }
    let stages: Vec<&'static str> = entries.iter().map(|entry| entry.name).collect();
    let command = command.subcommands(shell::commands(&stages));
    let program = command.clone();
    let arguments: Vec<OsString> = std::env::args_os().collect();
    if arguments.len() < 2 {
        return exit::report(PROGRAM, Form::Text, list_stages(&entries));
    }
    let chosen = config::subcommand_named(&command, &arguments);
    let name = chosen.as_deref().unwrap_or(PROGRAM);
    let matches = match matches(command, name, true, &arguments) {
        Ok(matches) => matches,
        Err(code) => return code,
    };
    if let Some(told) = matches.subcommand().and_then(|chosen| shell::run(chosen, program)) {
        return exit::report(name, Form::Text, told);
    }
    let chosen = matches.subcommand().and_then(|(name, matches)| {
        entries.iter().find(|entry| entry.name == name).map(|entry| (entry, matches))
    });
    match chosen {
        Some((entry, matches)) => (entry.run)(matches),
        None => exit::report(PROGRAM, Form::Text, list_stages(&entries)),
    }
}

/// Parses the command line over the configuration file; what is wrong is printed.
fn matches(
    command: Command,
    name: &str,
    is_front_door: bool,
    arguments: &[OsString],
) -> Result<ArgMatches, ExitCode> {
    let form = Form::asked(arguments);
    let stages = commands();
    let variables = std::env::vars_os().map(|(variable, _)| variable);
    let command = environment::check(&stages, variables)
        .and_then(|()| config::apply(command, is_front_door, &stages, arguments))
        .map_err(|e| exit::report(name, form, Err(e)))?;
    command
        .try_get_matches_from(arguments)
        .map_err(|e| exit::usage(name, form, &e, config::file_named(arguments).as_deref()))
}

const PROGRAM: &str = "motiongen";
const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Returns a stage's command: its parameters and the flags that every stage has.
fn command<S: Stage>() -> Command {
    use clap::Args as _;
    let ending = format!(
        "Reads: {}\nWrites: {}\n\n{AFTER}\n{EXIT_CODES}",
        S::CONTRACT.reads,
        S::CONTRACT.writes
    );
    // The parameters' own doc comment would become the text about the stage, so that comes after.
    let mut command =
        S::Params::augment_args(Command::new(S::NAME)).about(S::ABOUT).long_about(S::ABOUT);
    if command.has_subcommands() {
        command = command
            .subcommand_value_name("KIND")
            .subcommand_help_heading("Kinds")
            .disable_help_subcommand(true);
    }
    let config_help = config::help(&command);
    help::in_tiers(environment::with_environment(command.args(general(config_help))), &ending)
}

/// Returns the flags that every stage has, and that may stand before its name.
fn general(config_help: String) -> [Arg; 4] {
    let arg =
        |name: &'static str| Arg::new(name).long(name).help_heading(help::GENERAL).global(true);
    [
        arg(config::FLAG).value_name("FILE").help(config_help),
        arg(exit::FLAG)
            .value_name("FORM")
            .value_parser(EnumValueParser::<Form>::new())
            .default_value("text")
            .hide_short_help(true)
            .help(
                "What is told at the end, on standard output: text for people, or one JSON object",
            ),
        arg(log::VERBOSE)
            .short('v')
            .action(ArgAction::Count)
            .hide_short_help(true)
            .help("Log more: -v progress of the work, -vv details, -vvv requests"),
        arg(log::QUIET)
            .short('q')
            .action(ArgAction::SetTrue)
            .hide_short_help(true)
            .help("Show neither progress nor warnings"),
    ]
}

const AFTER: &str = "A value comes from the flag, else from the environment, else from the --config \
                     file, else it is the default shown.";
const EXIT_CODES: &str = "Exit codes: 0 done, 1 done but some items failed (see the failures table), 2 could not \
                          run, 75 stopped before it was done (SIGTERM, Ctrl-C): the same command goes on.";

fn run_stage<S: Stage>(matches: &ArgMatches) -> ExitCode {
    let quiet = matches.get_flag(log::QUIET);
    let form = matches.get_one::<Form>(exit::FLAG).copied().unwrap_or_default();
    let bars = Bars::new(quiet);
    log::start(matches.get_count(log::VERBOSE), quiet, bars.clone());
    interrupt::listen(move || exit::stopped(S::NAME, form));
    let run = || {
        let params = S::Params::from_arg_matches(matches)?;
        let is_aside = writes_to_standard_output(matches);
        let claimed = S::claims_stdout(&params).or(is_aside.then_some("--output -"));
        if let Some(what) = claimed.filter(|_| form == Form::Json) {
            anyhow::bail!(
                "{what} and --summary json both want standard output; give {what} a file, or leave --summary out"
            );
        }
        let summary = S::run(params, &bars)?;
        Ok(if is_aside { Box::new(AccountAside(summary)) as Box<dyn Summary> } else { summary })
    };
    exit::report(S::NAME, form, run())
}

/// Returns whether the file that a stage writes is standard output.
fn writes_to_standard_output(matches: &ArgMatches) -> bool {
    let is_kind_output =
        matches.subcommand().is_some_and(|(_, kind)| writes_to_standard_output(kind));
    let named = OUTPUTS.iter().filter_map(|id| matches.try_get_raw(id).ok().flatten());
    is_kind_output || named.flatten().any(|value| is_standard_output(Path::new(value)))
}

/// Parameters that name one file to be written.
const OUTPUTS: [&str; 2] = ["output", "report"];

fn list_stages(entries: &[StageEntry]) -> anyhow::Result<Box<dyn Summary>> {
    struct Stages(Vec<(&'static str, &'static str)>);
    impl Summary for Stages {
        fn write(&mut self, out: &mut dyn std::io::Write) -> std::io::Result<()> {
            writeln!(out, "motiongen {VERSION}: the stages, in the order of a pipeline\n")?;
            for (name, about) in &self.0 {
                writeln!(out, "  {name:<10} {about}")?;
            }
            writeln!(out, "\nmotiongen STAGE --help tells the rest. {}.", shell::HINT)
        }
        fn n_failed(&self) -> u64 {
            0
        }
        fn figures(&mut self) -> serde_json::Value {
            serde_json::Value::Null
        }
    }
    Ok(Box::new(Stages(entries.iter().map(|e| (e.name, e.about)).collect())))
}

/// A stage whose file went to standard output, which has no room for its account.
struct AccountAside(Box<dyn Summary>);

impl Summary for AccountAside {
    fn write(&mut self, _out: &mut dyn Write) -> std::io::Result<()> {
        exit::account(self.0.as_mut(), &mut std::io::stderr().lock())
    }

    fn n_failed(&self) -> u64 {
        self.0.n_failed()
    }

    fn is_stopped(&self) -> bool {
        self.0.is_stopped()
    }

    fn figures(&mut self) -> serde_json::Value {
        self.0.figures()
    }
}
