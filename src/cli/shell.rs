//! What a shell wants to know of the program: completions and manual pages, on standard output.

use std::io::{self, Write};

use clap::{Arg, ArgMatches, Command};
use clap_complete::Shell;
use clap_mangen::Man;

use super::help::{in_one_tier, in_tiers};
use crate::stages::Summary;

const COMPLETIONS: &str = "completions";
const MAN: &str = "man";
const SHELL: &str = "shell";
const STAGE: &str = "stage";

const COMPLETIONS_HINT: &str = "bash: motiongen completions bash > ~/.local/share/bash-completion/completions/motiongen\n\
     zsh: a file _motiongen in a folder of $fpath; fish: ~/.config/fish/completions/motiongen.fish";
const MAN_HINT: &str =
    "For example: motiongen man generate > ~/.local/share/man/man1/motiongen-generate.1";

/// How the list of stages names these commands.
pub const HINT: &str = "For the shell: motiongen completions SHELL, motiongen man [STAGE]";

/// Returns the commands, which are no stages and stand in no list of them.
pub fn commands(stages: &[&'static str]) -> [Command; 2] {
    let completions = Command::new(COMPLETIONS).about("print the completions of a shell").arg(
        Arg::new(SHELL)
            .value_name("SHELL")
            .required(true)
            .value_parser(clap::value_parser!(Shell))
            .help("Which shell"),
    );
    let man = Command::new(MAN).about("print the manual page of the program or of a stage").arg(
        Arg::new(STAGE)
            .value_name("STAGE")
            .value_parser(clap::builder::PossibleValuesParser::new(stages.iter().copied()))
            .help("Which stage [default: the program itself]"),
    );
    [in_tiers(completions.hide(true), COMPLETIONS_HINT), in_tiers(man.hide(true), MAN_HINT)]
}

/// Does what one of these commands asks; none for another.
pub fn run(
    chosen: (&str, &ArgMatches),
    mut program: Command,
) -> Option<anyhow::Result<Box<dyn Summary>>> {
    let text = match chosen {
        (COMPLETIONS, matches) => {
            let shell = *matches.get_one::<Shell>(SHELL)?;
            let mut text = Vec::new();
            let name = program.get_name().to_owned();
            clap_complete::generate(shell, &mut program, name, &mut text);
            Ok(text)
        }
        (MAN, matches) => page(program, matches.get_one::<String>(STAGE).map(String::as_str)),
        _ => return None,
    };
    Some(text.map(|text| Box::new(CapturedOutput(text)) as Box<dyn Summary>).map_err(Into::into))
}

fn page(program: Command, stage: Option<&str>) -> io::Result<Vec<u8>> {
    let version = program.get_version().unwrap_or_default().to_owned();
    let page = match stage.and_then(|stage| program.find_subcommand(stage)) {
        Some(stage) => {
            let name = format!("{}-{}", program.get_name(), stage.get_name());
            stage.clone().name(name).version(version)
        }
        None => program,
    };
    let mut text = Vec::new();
    Man::new(in_one_tier(page)).render(&mut text)?;
    Ok(text)
}

struct CapturedOutput(Vec<u8>);

impl Summary for CapturedOutput {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        out.write_all(&self.0)
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        serde_json::Value::Null
    }

    fn is_data(&self) -> bool {
        true
    }
}
