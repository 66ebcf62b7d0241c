//! Object stores on loopback for trying things out by hand:
//!
//! ```sh
//! cargo run --example loopback-stores -- DIRECTORY BUCKET...
//! ```
//!
//! prints the variables with which `motiongen` reaches `s3://BUCKET` and `gs://BUCKET`, writes the
//! service-account file for `gs://` into DIRECTORY, and serves until its standard input ends
//! (Ctrl-D) or it is killed. Both schemes show the same objects, which live in memory only.

#[path = "mod.rs"]
mod servers;

use std::path::PathBuf;
use std::process::ExitCode;

#[expect(clippy::print_stdout, clippy::print_stderr, reason = "a program of its own")]
fn main() -> ExitCode {
    let mut arguments = std::env::args().skip(1);
    let Some(directory) = arguments.next().map(PathBuf::from) else {
        eprintln!("usage: loopback-stores DIRECTORY BUCKET...");
        return ExitCode::from(2);
    };
    // Both say on standard error how to install what is missing.
    let (Some(s3), Some(gs)) = (servers::s3(), servers::gs()) else {
        return ExitCode::FAILURE;
    };
    arguments.for_each(|bucket| s3.create_named_bucket(&bucket));

    let written = std::fs::create_dir_all(&directory)
        .and_then(|()| directory.canonicalize())
        .and_then(|directory| gs.write_service_account(&directory));
    let service_account = match written {
        Ok(path) => path,
        Err(error) => {
            eprintln!("cannot write the service-account file to {}: {error}", directory.display());
            return ExitCode::FAILURE;
        }
    };
    let mut env = s3.env().and(&gs.env());
    env.set("GOOGLE_SERVICE_ACCOUNT", &service_account.display().to_string());
    // Lets the tests use this server too, which saves them from starting one.
    env.set("MOTIONGEN_TEST_S3_ENDPOINT", &s3.s3_server());
    for (name, value) in &env.0 {
        println!("export {name}='{}'", value.replace('\'', r"'\''"));
    }

    match std::io::copy(&mut std::io::stdin(), &mut std::io::sink()) {
        Ok(_) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("standard input failed: {error}");
            ExitCode::FAILURE
        }
    }
}
