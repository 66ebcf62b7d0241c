//! The front door: every stage as a subcommand.

fn main() -> std::process::ExitCode {
    motiongen::cli::front_door()
}
