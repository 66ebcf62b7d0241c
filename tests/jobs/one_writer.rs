//! Two processes that are to write one run: the second waits or is refused, and says for whom.

use std::path::Path;
use std::time::Duration;

use motiongen::store::tables::{GenerationRow, MetricRow, TokenRow};
use motiongen::store::{ClientOptions, Lease, Location};

use crate::generate::modelled;
use crate::support::{Dir, finish, rows};

use super::{stage, succeed};

const GENERATE: [&str; 5] =
    ["--model=m", "--steps=1", "--engine=eager", "--overlap=7", "--tracks=all"];

/// Takes a lease as a process does that lives, and renews it often.
fn hold(store: &Path, name: &str) -> Lease {
    let store = Location::open(&store.display().to_string(), &ClientOptions::default());
    Lease::take_for(&store.expect("a store"), name, Duration::from_millis(900), &|_, _| {})
        .expect("a lease")
}

#[test]
fn a_run_that_another_process_generates_or_evaluates_is_refused_until_it_ends() {
    let dir = Dir::new();
    let store = modelled(&dir);
    let me = std::process::id();
    let refused = |what: &str, more: &[&str], name: &str| {
        let output = finish(&mut stage(what, &store, more));
        assert_eq!(output.code, 2, "{output:?}");
        let sentence = format!("error: {name} is being written by process {me} on ");
        let told = |line: &str| line.starts_with(&sentence);
        assert!(output.stderr.lines().any(told), "{sentence}: {output:?}");
    };

    let lease = hold(&store, "generate/m/0-of-1");
    refused("generate", &GENERATE, "generate/m/0-of-1");
    assert_eq!(
        rows::<GenerationRow>(&store).len(),
        0,
        "nothing was written beside the other process"
    );
    // A look, another run and another shard are nobody else's.
    succeed(&mut stage("generate", &store, &[&GENERATE[..], &["--dry-run"]].concat()));
    succeed(&mut stage("generate", &store, &[&GENERATE[..], &["--run=other"]].concat()));
    let n_other = rows::<GenerationRow>(&store).len();
    succeed(&mut stage("generate", &store, &[&GENERATE[..], &["--shard=0/2"]].concat()));
    assert!(rows::<GenerationRow>(&store).len() > n_other);
    drop(lease);
    succeed(&mut stage("generate", &store, &GENERATE));
    assert_eq!(rows::<GenerationRow>(&store).len(), 2 * n_other);

    let tokens = ["--family=tokens", "--preset=tiny", "--window-frames=24", "--steps=2"];
    succeed(&mut stage("train", &store, &[&tokens[..], &["--run=tok", "--batch-size=3"]].concat()));
    let lease = hold(&store, "tokenize/tok/0-of-1");
    refused("tokenize", &["--run=tok"], "tokenize/tok/0-of-1");
    assert_eq!(rows::<TokenRow>(&store).len(), 0);
    drop(lease);
    succeed(&mut stage("tokenize", &store, &["--run=tok"]));

    let lease = hold(&store, "evaluate/m");
    refused("evaluate", &["--run=m"], "evaluate/m");
    assert_eq!(rows::<MetricRow>(&store).len(), 0);
    drop(lease);
    succeed(&mut stage("evaluate", &store, &["--run=m"]));
    // What is up to date needs nobody's leave.
    let lease = hold(&store, "evaluate/m");
    succeed(&mut stage("evaluate", &store, &["--run=m"]));
    drop(lease);
}
