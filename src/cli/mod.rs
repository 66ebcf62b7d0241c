//! The command line: flags, configuration, logging, progress and exit codes.
//!
//! This is the only room that prints, and `exit::report` is the only place that prints an error
//! and chooses the exit code.

mod config;
mod escaped;
mod exit;
mod interrupt;
mod log;
mod progress;
mod shell;

use std::ffi::OsString;
use std::io::{IsTerminal as _, Write};
use std::path::Path;
use std::process::ExitCode;

use clap::{Arg, ArgAction, ArgMatches, Command, FromArgMatches as _};

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
use crate::stages::train::Train;
use crate::stages::view::View;
use crate::stages::{Stage, Summary, is_standard_output, lines};
use escaped::Escaped;
use progress::Bars;

/// A stage with its types taken away, for the front door.
struct Entry {
    name: &'static str,
    about: &'static str,
    command: fn() -> Command,
    run: fn(&ArgMatches) -> anyhow::Result<Box<dyn Summary>>,
}

impl Entry {
    fn of<S: Stage>() -> Self {
        Self { name: S::NAME, about: S::ABOUT, command: command::<S>, run: run_stage::<S> }
    }
}

/// Returns every stage, in the order in which a pipeline runs them.
fn entries() -> Vec<Entry> {
    vec![
        Entry::of::<Ingest>(),
        Entry::of::<Extract>(),
        Entry::of::<Library>(),
        Entry::of::<Train>(),
        Entry::of::<Finetune>(),
        Entry::of::<Export>(),
        Entry::of::<Generate>(),
        Entry::of::<Evaluate>(),
        Entry::of::<Model>(),
        Entry::of::<Plot>(),
        Entry::of::<View>(),
        #[cfg(feature = "query")]
        Entry::of::<Query>(),
    ]
}

/// Runs one stage's own executable, `motiongen-<stage>`.
pub fn stage<S: Stage>() -> ExitCode {
    let command = command::<S>().name(format!("motiongen-{}", S::NAME)).version(VERSION);
    let arguments: Vec<OsString> = std::env::args_os().collect();
    let matches = match matches(command, false, &arguments) {
        Ok(matches) => matches,
        Err(code) => return code,
    };
    exit::report(run_stage::<S>(&matches))
}

/// Runs `motiongen`, which has every stage as a subcommand.
pub fn front_door() -> ExitCode {
    let entries = entries();
    let mut command = Command::new("motiongen")
        .version(VERSION)
        .about("Turns a music library into motion, stage by stage.")
        .subcommand_value_name("STAGE")
        .subcommand_help_heading("Stages, in the order of a pipeline");
    for entry in &entries {
        command = command.subcommand((entry.command)());
    }
    let stages: Vec<&'static str> = entries.iter().map(|entry| entry.name).collect();
    command = command.after_help(shell::HINT).subcommands(shell::commands(&stages));
    let program = command.clone();
    let arguments: Vec<OsString> = std::env::args_os().collect();
    if arguments.len() < 2 {
        return exit::report(list_stages(&entries));
    }
    let matches = match matches(command, true, &arguments) {
        Ok(matches) => matches,
        Err(code) => return code,
    };
    if let Some(told) = matches.subcommand().and_then(|chosen| shell::run(chosen, program)) {
        return exit::report(told);
    }
    let chosen = matches.subcommand().and_then(|(name, matches)| {
        entries.iter().find(|entry| entry.name == name).map(|entry| (entry, matches))
    });
    match chosen {
        Some((entry, matches)) => exit::report((entry.run)(matches)),
        None => exit::report(list_stages(&entries)),
    }
}

/// Parses the command line over the configuration file; what is wrong is printed.
fn matches(
    command: Command,
    is_front_door: bool,
    arguments: &[OsString],
) -> Result<ArgMatches, ExitCode> {
    let command =
        config::apply(command, is_front_door, arguments).map_err(|e| exit::report(Err(e)))?;
    command
        .try_get_matches_from(arguments)
        .map_err(|e| exit::usage(&e, config::file_named(arguments).as_deref()))
}

const VERSION: &str = env!("CARGO_PKG_VERSION");

/// Returns a stage's command: its parameters and the flags that every stage has.
fn command<S: Stage>() -> Command {
    use clap::Args as _;
    let contract =
        format!("Reads: {}\nWrites: {}\n\n{AFTER}", S::CONTRACT.reads, S::CONTRACT.writes);
    // The parameters' own doc comment would become the text about the stage, so that comes after.
    let mut command = S::Params::augment_args(Command::new(S::NAME))
        .about(S::ABOUT)
        .long_about(S::ABOUT)
        .after_help(contract.clone());
    if command.has_subcommands() {
        command = command
            .subcommand_value_name("KIND")
            .subcommand_help_heading("Kinds")
            .disable_help_subcommand(true)
            .mut_subcommands(|kind| kind.after_help(contract.clone()));
    }
    let config_help = config::help(&command);
    let command = command
        .arg(
            Arg::new(config::FLAG)
                .long(config::FLAG)
                .value_name("FILE")
                .help(config_help)
                .help_heading("General")
                .global(true),
        )
        .arg(
            Arg::new(log::VERBOSE)
                .long(log::VERBOSE)
                .short('v')
                .action(ArgAction::Count)
                .help("Log more: -v progress of the work, -vv details, -vvv requests")
                .help_heading("General")
                .global(true),
        )
        .arg(
            Arg::new(log::QUIET)
                .long(log::QUIET)
                .short('q')
                .action(ArgAction::SetTrue)
                .help("Show neither progress nor warnings")
                .help_heading("General")
                .global(true),
        );
    config::with_environment(command)
}

const AFTER: &str = "A value comes from the flag, else from the environment, else from the --config \
                     file, else it is the default shown.\nExit codes: 0 done, 1 done but some items \
                     failed (see the failures table), 2 could not run.";

fn run_stage<S: Stage>(matches: &ArgMatches) -> anyhow::Result<Box<dyn Summary>> {
    let quiet = matches.get_flag(log::QUIET);
    let bars = Bars::new(quiet);
    log::start(matches.get_count(log::VERBOSE), quiet, bars.clone());
    let params = S::Params::from_arg_matches(matches)?;
    let summary = S::run(params, &bars)?;
    Ok(if writes_to_standard_output(matches) { Box::new(AccountAside(summary)) } else { summary })
}

/// Returns whether the file that a stage writes is standard output.
fn writes_to_standard_output(matches: &ArgMatches) -> bool {
    let of_kind = matches.subcommand().is_some_and(|(_, kind)| writes_to_standard_output(kind));
    let named = OUTPUTS.iter().filter_map(|id| matches.try_get_raw(id).ok().flatten());
    of_kind || named.flatten().any(|value| is_standard_output(Path::new(value)))
}

/// Parameters that name one file to be written.
const OUTPUTS: [&str; 2] = ["output", "report"];

fn list_stages(entries: &[Entry]) -> anyhow::Result<Box<dyn Summary>> {
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
    }
    Ok(Box::new(Stages(entries.iter().map(|e| (e.name, e.about)).collect())))
}

/// Writes what a stage has to say; a reader that went away is not an error.
fn print(summary: &mut dyn Summary) -> std::io::Result<()> {
    let written = if summary.is_data() {
        let out = std::io::stdout().lock();
        let is_terminal = out.is_terminal();
        let mut out = std::io::BufWriter::new(out);
        if is_terminal {
            let mut out = Escaped::new(out);
            summary.write(&mut out).and_then(|()| out.flush())
        } else {
            summary.write(&mut out).and_then(|()| out.flush())
        }
    } else {
        account(summary, &mut std::io::stdout().lock())
    };
    match written {
        Err(e) if e.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        written => written,
    }
}

/// Writes an account for people, which names files that may be called anything.
fn account(summary: &mut dyn Summary, out: &mut dyn Write) -> std::io::Result<()> {
    let mut text = Vec::new();
    summary.write(&mut text)?;
    out.write_all(lines(&String::from_utf8_lossy(&text)).as_bytes())?;
    out.flush()
}

/// A stage whose file went to standard output, which has no room for its account.
struct AccountAside(Box<dyn Summary>);

impl Summary for AccountAside {
    fn write(&mut self, _out: &mut dyn Write) -> std::io::Result<()> {
        account(self.0.as_mut(), &mut std::io::stderr().lock())
    }

    fn n_failed(&self) -> u64 {
        self.0.n_failed()
    }
}
