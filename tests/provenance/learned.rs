//! A run lists what it learns from, a model's card carries the list, and any store can ask it.

use std::collections::BTreeSet;
use std::path::PathBuf;

use motiongen::generation::{FamilyCard as _, LearnedFrom, ModelCard};
use motiongen::stages::learned::of_model;
use motiongen::store::tables::{GenerationRow, PhraseRow};
use motiongen::store::{Location, split_of};

use super::*;
use crate::library::{beat_list, clicks, constructed, from, library, write_captures, write_songs};
use crate::support::files::{coherent, features_npz, trajectory};
use crate::support::{finish, ingest, motiongen, phrases, rows, tree};
use crate::train::{make_store, train};

const TRAINED: [&str; 4] =
    ["--steps=6", "--decoder-steps=4", "--warmup-steps=2", "--prediction=x0"];

fn export(store: &Path, more: &[&str]) -> Output {
    let mut command = motiongen();
    command.args(["export", "--run=run", "--model=m", "--store"]).arg(store).args(more);
    finish(&mut command)
}

fn list(store: &Path, command: &str) -> LearnedFrom {
    let path = store.join(format!("runs/run/{command}.learned.json"));
    let text = std::fs::read(&path).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    serde_json::from_slice(&text).expect("a list")
}

fn card(store: &Path) -> ModelCard {
    let mut folder = store.join("models/m");
    // A model that was replaced lies in a folder of its own.
    if let Ok(text) = std::fs::read(folder.join("current.json")) {
        let pointer: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
        folder.push(pointer["folder"].as_str().expect("a folder"));
    }
    let text = std::fs::read(folder.join("model.json")).expect("a card");
    ModelCard::read(&text, "m").expect("a card")
}

/// The beginnings of digests, each once, in order.
fn short<'a>(digests: impl Iterator<Item = &'a str>) -> Vec<String> {
    digests.map(|digest| digest[..16].to_owned()).collect::<BTreeSet<_>>().into_iter().collect()
}

/// Songs and phrases of a split that could be learned from, as lists have them.
fn of_split(rows: &[PhraseRow], split: &str) -> [Vec<String>; 2] {
    let split_rows = || rows.iter().filter(|row| row.split == split && row.has_motion);
    [
        short(split_rows().map(|row| row.song_hash.as_deref().expect("a song"))),
        short(split_rows().map(|row| row.content_hash.as_str())),
    ]
}

fn digits<T: ToString>(digests: &BTreeSet<T>) -> Vec<String> {
    digests.iter().map(ToString::to_string).collect()
}

/// A name that ingest puts into a split.
fn named(split: &str, ending: &str) -> String {
    let mut names = (0..).map(|i| format!("other {i}{ending}"));
    names.find(|name| split_of(name) == split).expect("a name")
}

#[test]
fn a_model_in_another_store_tells_the_same_of_the_same_music() {
    let dir = Dir::new();
    let (songs, captures, store) = (write_songs(&dir), write_captures(&dir), dir.at("store"));
    succeeds(library(&store, &from(&songs, &captures, &["--takes=1"])));
    succeeds(train(&store, "run", &TRAINED));
    succeeds(export(&store, &["--quiet"]));

    // The list is that of the phrases, and the card's that of the run.
    let made: Vec<PhraseRow> = constructed(&store).into_values().collect();
    let listed = list(&store, "train");
    let [songs_trained, phrases_trained] = of_split(&made, "train");
    let [songs_validated, phrases_validated] = of_split(&made, "validation");
    assert!(songs_trained.len() == 1 && songs_validated.len() == 1 && phrases_trained.len() > 1);
    assert_eq!(digits(&listed.trained_on.songs), songs_trained);
    assert_eq!(digits(&listed.trained_on.phrases), phrases_trained);
    assert_eq!(digits(&listed.validated_on.songs), songs_validated);
    assert_eq!(digits(&listed.validated_on.phrases), phrases_validated);
    assert!(listed.is_complete);
    let provenance = card(&store).provenance;
    assert_eq!(provenance.data, listed.data);
    assert_eq!(provenance.learned_from.as_ref(), Some(&listed));
    // Going on changes nothing.
    let before = tree(&store.join("runs"));
    succeeds(train(&store, "run", &TRAINED));
    assert!(tree(&store.join("runs")) == before);
    let told = succeeds(finish(
        motiongen()
            .args(["model", "--model=m", "--engine=eager", "--frames=24", "--store"])
            .arg(&store),
    ));
    let expected = format!(
        "\nlearned from  trained on 1 song, {} phrases; validated on 1 song, {} phrases\n",
        phrases_trained.len(),
        phrases_validated.len()
    );
    assert!(told.stdout.contains(&expected), "{told:?}");

    // Another store: other names, other splits, a list of beats beside a song, and one song more.
    let song_of = |split: &str| {
        let row = made.iter().find(|row| row.split == split).expect("a phrase");
        let name = row.source.rsplit_once("/songs/").expect("a song").1.replace("%20", " ");
        std::fs::read(songs.join(name)).expect("a song")
    };
    let (renamed, beside) = (named("test", ".wav"), named("validation", " and beats.wav"));
    let (validated, tested) = (named("train", " v.wav"), named("train", " t.wav"));
    dir.write(format!("others/{renamed}"), song_of("train"));
    dir.write(format!("others/{beside}"), song_of("train"));
    let beats = beside.replace(".wav", ".beats.txt");
    dir.write(format!("others/{beats}"), beat_list(93.7, 8.0, 4));
    dir.write(format!("others/{validated}"), song_of("validation"));
    dir.write(format!("others/{tested}"), song_of("test"));
    dir.write("others/new.wav", clicks(133.0, 3.1));
    let other = dir.at("other store");
    succeeds(ingest(&dir.at("others"), &other, &[]));
    extract(&other);
    copy(&store.join("models"), &other.join("models"));
    let mut command = motiongen();
    command.args([
        "generate",
        "--model=m",
        "--engine=eager",
        "--steps=2",
        "--overlap=7",
        "--quiet",
        "--store",
    ]);
    succeeds(finish(command.arg(&other).args(["--phrase", "new.wav"])));
    let made: Vec<GenerationRow> = rows(&other);
    let location = Location::local(&other).expect("a folder");
    let learned = of_model(&location, &made[0].model, &made[0].weights).expect("a store");
    let learned = learned.expect("a list");
    let there = phrases(&other);
    let split = |id: &str| {
        let row = &there[id];
        (row.split.as_str(), learned.split_of(row.song_hash.as_deref(), &row.content_hash).name())
    };
    assert!(there[&beside].has_beats);
    assert_eq!(split(&renamed), ("test", "trained_on"));
    assert_eq!(split(&beside), ("validation", "trained_on"));
    assert_eq!(split(&validated), ("train", "validation"));
    assert_eq!(split(&tested), ("train", "held_out"));
    assert_eq!(split("new.wav").1, "held_out");

    reasons(&other, &made[0].weights);
}

/// Whatever keeps a card from telling is said in a sentence.
fn reasons(store: &Path, weights: &str) {
    let location = Location::local(store).expect("a folder");
    let why = |model: &str, weights: &str| {
        let told = of_model(&location, model, weights).expect("a store");
        told.expect_err("a reason").to_string()
    };
    for model in ["n", "../models/m", ""] {
        assert_eq!(
            why(model, weights),
            format!(
                "store {location} has no model \"{model}\", so what it learned from is not known; copy the folder \
                 of the model to models/{model} there"
            )
        );
    }
    let other = "0123456789abcdef".repeat(4);
    assert_eq!(
        why("m", &other),
        format!(
            "model \"m\" of store {location} has other weights ({}) than the motions were made with \
             (0123456789ab), so what those learned from is not known; generate the motions again, or copy the \
             model there that made them",
            &weights[..12]
        )
    );
    let path = store.join("models/m/model.json");
    let text = std::fs::read_to_string(&path).expect("a card");
    let mut silent: serde_json::Value = serde_json::from_str(&text).expect("JSON");
    silent["provenance"].as_object_mut().expect("an object").remove("learned_from");
    std::fs::write(&path, silent.to_string()).expect("written");
    let not_listed = "the card of model \"m\" does not tell what it learned from; export it again from its run \
                      with this version of motiongen";
    assert_eq!(why("m", weights), not_listed);
    let card = text.replacen("\"songs\": [\n", "\"songs\": [\n\"6131\",\n", 1);
    std::fs::write(&path, card).expect("written");
    let broken = why("m", weights);
    let start = format!(
        "file://{}: is no description of a model (\"6131\" is no digest; it must be 16 hexadecimal digits at \
         line ",
        path.display().to_string().replace(' ', "%20")
    );
    assert!(broken.starts_with(&start), "{broken}");
}

/// Adds a phrase to the source and the store; returns its features.
fn grow(dir: &Dir, split: &str) -> Vec<u8> {
    let id = named(split, "");
    let features = features_npz(40);
    dir.write(format!("source/motion/{id}/trajectory.npy"), trajectory(&coherent(40, 77)));
    dir.write(format!("source/audio_features/{id}/features.npz"), &features);
    succeeds(ingest(&dir.at("source"), &dir.at("store"), &[]));
    extract(&dir.at("store"));
    features
}

fn finetune(store: &Path, more: &[&str]) {
    let mut command = motiongen();
    command.args([
        "finetune",
        "--run=run",
        "--steps=2",
        "--batch-size=2",
        "--threads=2",
        "--quiet",
    ]);
    succeeds(finish(command.args(["--store-patience=0", "--store"]).arg(store).args(more)));
}

#[test]
fn fine_tuning_adds_what_it_learned_from_and_no_more() {
    let dir = Dir::new();
    let store = make_store(&dir);
    succeeds(train(&store, "run", &TRAINED));
    finetune(&store, &["--num-phrases=4"]);
    let (by_train, by_finetune) = (list(&store, "train"), list(&store, "finetune"));
    let counts = |listed: &LearnedFrom| {
        [&listed.trained_on, &listed.validated_on]
            .map(|side| (side.songs.len(), side.phrases.len()))
    };
    assert_eq!(counts(&by_train), [(13, 13), (3, 3)]);
    assert_eq!(counts(&by_finetune), [(4, 4), (3, 3)]);
    assert!(by_finetune.trained_on.phrases.is_subset(&by_train.trained_on.phrases));
    succeeds(export(&store, &["--quiet"]));
    assert_eq!(card(&store).provenance.learned_from, Some(by_train.clone()));

    // More music for the end than for the beginning.
    let features = grow(&dir, "train");
    finetune(&store, &["--force"]);
    succeeds(export(&store, &["--quiet", "--force"]));
    let learned = card(&store).provenance.learned_from.expect("a list");
    assert_eq!(counts(&learned), [(14, 14), (3, 3)]);
    assert_eq!(learned.data, by_train.data);
    let hash = motiongen::store::digest(&features);
    assert_eq!(by_train.split_of(Some(&hash), "").name(), "held_out");
    assert_eq!(learned.split_of(Some(&hash), "").name(), "trained_on");
    succeeds(export(&store, &["--quiet", "--force", "--weights=train"]));
    assert_eq!(card(&store).provenance.learned_from, Some(by_train));
}

#[test]
fn a_run_of_release_0_1_is_listed_from_the_store_while_its_phrases_are_there() {
    let dir = Dir::new();
    let store = make_store(&dir);
    let path = store.join("runs/run/train.learned.json");
    // A run on rows that do not tell their music has gaps, which are filled when the rows are.
    assert!(release_0_1::downgrade(&store, "ingest") > 0);
    succeeds(train(&store, "run", &TRAINED));
    let gaps = list(&store, "train");
    assert!(!gaps.is_complete && gaps.trained_on.songs.is_empty());
    assert_eq!(gaps.trained_on.phrases.len(), 13);
    let hash = motiongen::store::digest(&features_npz(40));
    assert_eq!(gaps.split_of(Some(&hash), "").name(), "unknown");
    succeeds(ingest(&dir.at("source"), &store, &[]));
    succeeds(export(&store, &["--quiet"]));
    let whole = card(&store).provenance.learned_from.expect("a list");
    assert!(whole.is_complete && whole.trained_on.songs.len() == 13);
    assert_eq!(whole.split_of(Some(&hash), "").name(), "held_out");
    succeeds(train(&store, "run", &TRAINED));
    assert_eq!(list(&store, "train"), whole);

    // Without the list, as release 0.1 left its runs.
    let text = std::fs::read(&path).expect("a list");
    std::fs::remove_file(&path).expect("removed");
    let again = succeeds(export(&store, &["--quiet"]));
    assert!(again.stdout.starts_with("model m, up to date → "), "{again:?}");
    succeeds(train(&store, "run", &TRAINED));
    assert_eq!(std::fs::read(&path).expect("a list"), text);

    // Other phrases: they are not what the run learned from.
    std::fs::remove_file(&path).expect("removed");
    grow(&dir, "train");
    let output = succeeds(export(&store, &["--force"]));
    let note = format!(
        "run run does not tell what it learned from, and the phrases of {} are others by now: the model's card will \
         not tell either, and evaluate will hold no music for held out",
        store.display()
    );
    assert!(output.stderr.contains(&note), "{output:?}");
    assert_eq!(card(&store).provenance.learned_from, None);
    let told = succeeds(finish(
        motiongen()
            .args(["model", "--model=m", "--engine=eager", "--frames=24", "--store"])
            .arg(&store),
    ));
    assert!(told.stdout.contains("\nlearned from  not known\n"), "{told:?}");
    let refused = train(&store, "run", &TRAINED);
    assert_eq!(refused.code, 2, "{refused:?}");
    assert!(!path.exists(), "a list of phrases that the run did not learn from");
}

/// A run that begins anew lists anew.
#[test]
fn the_list_of_a_run_that_left_no_checkpoint_is_replaced() {
    let dir = Dir::new();
    let store = make_store(&dir);
    succeeds(train(&store, "run", &TRAINED));
    let first = list(&store, "train");
    for folder in ["diffusion", "decoder"] {
        std::fs::remove_dir_all(store.join("runs/run").join(folder)).expect("removed");
    }
    grow(&dir, "validation");
    succeeds(train(&store, "run", &TRAINED));
    let second = list(&store, "train");
    assert_ne!(first.data, second.data);
    assert_eq!((first.validated_on.songs.len(), second.validated_on.songs.len()), (3, 4));
    let path: PathBuf = store.join("runs/run/train.learned.json");
    std::fs::write(&path, "{").expect("written");
    succeeds(train(&store, "run", &TRAINED));
    assert_eq!(list(&store, "train"), second);
}
