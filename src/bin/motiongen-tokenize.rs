//! `motiongen tokenize` as an executable of its own.

fn main() -> std::process::ExitCode {
    motiongen::cli::stage::<motiongen::stages::tokenize::Tokenize>()
}
