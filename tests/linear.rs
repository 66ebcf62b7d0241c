//! Work on twice the phrases costs twice as much: bytes read and requests are counted, never timed.

use std::collections::BTreeMap;

use clap::{Args as _, FromArgMatches as _};
use motiongen::stages::evaluate::Evaluate;
use motiongen::stages::extract::Extract;
use motiongen::stages::generate::Generate;
use motiongen::stages::ingest::Ingest;
use motiongen::stages::library::Library;
#[cfg(feature = "query")]
use motiongen::stages::query::Query;
use motiongen::stages::tokenize::Tokenize;
use motiongen::stages::train::Train;
use motiongen::stages::view::View;
use motiongen::stages::{Silent, Stage};
use motiongen::store::{ClientOptions, Location, Traffic, memory_traffic};

use crate::support::Dir;
use crate::support::files::{coherent, features_npz, trajectory};

const N_FRAMES: usize = 33;
/// What twice the phrases may cost, over what they cost once.
const MOST: f64 = 2.2;

/// Runs a stage within this process.
#[track_caller]
fn run_stage<S: Stage>(arguments: &[&str]) {
    let command = S::Params::augment_args(clap::Command::new(S::NAME).no_binary_name(true));
    let matches = command.try_get_matches_from(arguments).unwrap_or_else(|e| panic!("{e}"));
    let params = S::Params::from_arg_matches(&matches).unwrap_or_else(|e| panic!("{e}"));
    let mut summary =
        S::run(params, &Silent).unwrap_or_else(|e| panic!("{} {arguments:?}: {e:#}", S::NAME));
    assert_eq!(summary.n_failed(), 0, "{}", S::NAME);
    summary.write(&mut Vec::new()).expect("a summary");
}

/// Copies the model that ships into a store.
fn put_model(store: &Location) {
    for entry in std::fs::read_dir("models/pretrained").expect("the model that ships") {
        let entry = entry.expect("an entry");
        let name = entry.file_name().into_string().expect("a name");
        let bytes = std::fs::read(entry.path()).expect("a file");
        store.put_new(&format!("models/m/{name}"), bytes.into()).expect("written");
    }
}

/// Writes the motion and the features of `n` phrases.
fn write_source(n: usize) -> Dir {
    let dir = Dir::new();
    for i in 0..n {
        let id = format!("p{:05}", i * 7919 % 100_003);
        let frames = coherent(N_FRAMES, i as u32 % 97);
        dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&frames));
        dir.write(format!("source/audio_features/{id}/features.npz"), features_npz(N_FRAMES));
    }
    dir
}

type Costs = BTreeMap<&'static str, Traffic>;

/// Counts what a piece of work asks of the store in memory of that name.
fn count(costs: &mut Costs, store: &str, what: &'static str, work: &dyn Fn()) {
    let before = memory_traffic(store);
    work();
    let after = memory_traffic(store);
    let cost = Traffic {
        n_requests: after.n_requests - before.n_requests,
        read_bytes: after.read_bytes - before.read_bytes,
    };
    costs.insert(what, cost);
}

/// Fails where the second costs are more than `MOST` times the first.
#[track_caller]
fn assert_linear(once: &Costs, twice: &Costs) {
    let (mut dear, mut all) = (Vec::new(), String::new());
    for (what, once) in once {
        let twice = &twice[what];
        let bytes = twice.read_bytes as f64 / once.read_bytes.max(1) as f64;
        let requests = twice.n_requests as f64 / once.n_requests.max(1) as f64;
        all += &format!("{what}: {once:?}, {twice:?}: {bytes:.2}, {requests:.2}\n");
        if bytes > MOST || requests > MOST {
            dear.push(what);
        }
    }
    assert!(dear.is_empty(), "{dear:?} cost more than {MOST} times as much:\n{all}");
}

/// Returns what every stage asks of a store of `n` phrases.
fn costs(n: usize) -> Costs {
    let dir = write_source(n);
    let (name, url) = (format!("linear-{n}"), format!("memory://linear-{n}"));
    put_model(&Location::open(&url, &ClientOptions::default()).expect("a store"));
    let store = format!("--store={url}");
    let source = format!("--source={}", dir.at("source").display());
    let page = format!("--output={}", dir.at("page.html").display());
    let mut costs = BTreeMap::new();
    let mut count = |what, work: &dyn Fn()| count(&mut costs, &name, what, work);
    let ingest = [store.as_str(), &source, "--batch-phrases=8"];
    count("ingest", &|| run_stage::<Ingest>(&ingest));
    count("ingest again", &|| run_stage::<Ingest>(&ingest));
    count("extract", &|| run_stage::<Extract>(&[&store]));
    count("train", &|| {
        let tiny = ["--run=r", "--preset=tiny", "--steps=1", "--decoder-steps=1"];
        run_stage::<Train>(&[&[store.as_str(), "--dry-run"][..], &tiny].concat());
    });
    count("generate", &|| {
        let quick = ["--model=m", "--steps=1", "--engine=eager", "--run=g", "--tracks=all"];
        run_stage::<Generate>(&[&[store.as_str()][..], &quick].concat());
    });
    let tokens = ["--family=tokens", "--run=t", "--preset=tiny", "--steps=1", "--batch-size=2"];
    run_stage::<Train>(&[&[store.as_str(), "--window-frames=24"][..], &tokens].concat());
    count("tokenize", &|| run_stage::<Tokenize>(&[&store, "--run=t"]));
    count("tokenize again", &|| run_stage::<Tokenize>(&[&store, "--run=t"]));
    count("evaluate", &|| run_stage::<Evaluate>(&[&store, "--run=g", "--quick"]));
    let composed = format!("--compose={}", n / 64);
    count("library", &|| run_stage::<Library>(&[&store, &composed, "--takes=1"]));
    count("view", &|| run_stage::<View>(&[&store, "--phrase=p00000", &page]));
    #[cfg(feature = "query")]
    count("query", &|| run_stage::<Query>(&[&store, "select count(*) from phrases"]));
    costs
}

#[test]
fn twice_the_phrases_cost_twice_as_much() {
    assert_linear(&costs(256), &costs(512));
}

/// Returns what stages whose batches hold up to 512 phrases ask of a store of `n` phrases, without the ingest.
fn costs_of_large_batches(n: usize) -> Costs {
    let dir = write_source(n);
    let (name, store) = (format!("large-{n}"), format!("--store=memory://large-{n}"));
    run_stage::<Ingest>(&[&store, &format!("--source={}", dir.at("source").display())]);
    let mut costs = BTreeMap::new();
    let mut count = |what, work: &dyn Fn()| count(&mut costs, &name, what, work);
    count("extract", &|| run_stage::<Extract>(&[&store]));
    count("extract again", &|| run_stage::<Extract>(&[&store]));
    let tokens = ["--family=tokens", "--run=t", "--preset=tiny", "--steps=1", "--batch-size=2"];
    run_stage::<Train>(&[&[store.as_str(), "--window-frames=24"][..], &tokens].concat());
    count("tokenize", &|| run_stage::<Tokenize>(&[&store, "--run=t"]));
    costs
}

#[test]
fn twice_the_batches_of_512_phrases_cost_twice_as_much() {
    assert_linear(&costs_of_large_batches(1031), &costs_of_large_batches(2062));
}

/// Returns what a stage would cost that read the whole store for each 64 phrases, as `generate` of 0.1 did.
fn costs_of_a_quadratic_stage(n: usize) -> Costs {
    let dir = write_source(n);
    let (name, store) = (format!("quadratic-{n}"), format!("--store=memory://quadratic-{n}"));
    let source = format!("--source={}", dir.at("source").display());
    run_stage::<Ingest>(&[&store, &source, "--batch-phrases=8"]);
    run_stage::<Extract>(&[&store]);
    let mut costs = BTreeMap::new();
    let extract = || (0..n / 64).for_each(|_| run_stage::<Extract>(&[&store]));
    count(&mut costs, &name, "extract", &extract);
    costs
}

#[test]
#[should_panic(expected = "[\"extract\"] cost more than 2.2 times as much")]
fn a_stage_that_reads_everything_for_each_batch_is_refused() {
    assert_linear(&costs_of_a_quadratic_stage(131), &costs_of_a_quadratic_stage(262));
}

/// Requests that counting a table and looking a phrase up may take each; opening a phrase's page over a network takes
/// about 30 ms for each of them.
const MOST_REQUESTS: u64 = 20;

#[test]
fn a_thousand_commits_cost_a_reader_few_requests() {
    let dir = Dir::new();
    for i in 0..1500 {
        let frames = coherent(N_FRAMES, i % 97);
        dir.write(format!("source/motion/p{i:05}/trajectory.npy"), trajectory(&frames));
    }
    let store = "--store=memory://few-requests";
    let source = format!("--source={}", dir.at("source").display());
    run_stage::<Ingest>(&[store, &source, "--batch-phrases=1"]);
    let location = Location::open("memory://few-requests", &ClientOptions::default());
    let commits = location.and_then(|store| store.list("commits/ingest")).expect("a listing");
    // More than an object store lists at once.
    assert!(commits.len() > 1000, "{}", commits.len());
    let n_requests = |work: &dyn Fn()| {
        let before = memory_traffic("few-requests");
        work();
        memory_traffic("few-requests").n_requests - before.n_requests
    };
    let page = format!("--output={}", dir.at("page.html").display());
    let looked_up = n_requests(&|| run_stage::<View>(&[store, "--phrase=p00777", &page]));
    assert!(looked_up < MOST_REQUESTS, "{looked_up}");
    #[cfg(feature = "query")]
    {
        let counted = n_requests(&|| run_stage::<Query>(&[store, "select count(*) from phrases"]));
        assert!(counted < MOST_REQUESTS, "{counted}");
    }
}
