//! `export`: a trained run becomes a model: two ONNX files that were checked, and what they say of themselves.

mod checks;
mod family;
mod files;
mod group;
mod report;
mod tokens;
mod tuning;
mod unet;

use std::path::PathBuf;

use anyhow::{bail, ensure};
use bytes::Bytes;

use self::checks::CheckResults;
pub(in crate::stages) use self::files::weights_sha256;
use self::group::TrainedGroup;
use self::tokens::TrainedTokens;
use super::model_files::{POINTER, current_folder, folder_of, is_model_name, pointer_to, sha256};
use super::train::session::{MachineParams, check_run_name};
use super::trained::{TrainedPlanner, TrainedRun, TrainedTokenizer, WeightsChoice};
use super::{ClientParams, Contract, Progress, RARE, Stage, Summary, lease};
use crate::generation::{ModelFileName, file_names};
use crate::motion::rates::MotionRange;
use crate::motion::style_name::{NamedStyles, StyleMeans};
use crate::onnx::{Runtime, Storage};
use crate::store::tables::OnnxCheckRow;
use crate::store::{
    Commit, Item, Ledger, ListedObject, Location, Row as _, StoreError, TimestampUs, checkpoint,
    digest,
};
use crate::training::{Dataset, Split};

/// Most training phrases that are read: enough to know how fast they move, and a bound on memory.
const MAX_TRAIN_PHRASES: usize = 4000;

/// The stage.
pub struct Export;

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Folder or bucket of the tables, the run and the models.
    #[arg(long, value_name = "URL")]
    pub store: String,
    /// Name of the run.
    #[arg(long, value_name = "NAME")]
    pub run: String,
    /// Name of the model: models/NAME in the store.
    #[arg(long, value_name = "NAME")]
    pub model: String,
    /// Which weights of the run.
    #[arg(long, value_enum, default_value_t = WeightsChoice::Latest)]
    pub weights: WeightsChoice,
    /// How weights are stored; computing is always in fp32.
    #[arg(long, value_enum, default_value_t = Storage::Fp32)]
    pub precision: Storage,
    /// Licence of the model, as people will read it in its files.
    #[arg(long, value_name = "TEXT", default_value = "not stated")]
    pub licence: String,
    /// Leave out the decoder's last layer, which fuses poses with velocities: decoded channels then contradict each
    /// other, and agree only after post-processing.
    #[arg(long, hide_short_help = RARE)]
    pub no_fusion: bool,
    /// Largest weights that lie within the .onnx file itself, in MB; larger ones lie beside it.
    #[arg(long, value_name = "MB", default_value_t = 1000, hide_short_help = RARE)]
    pub embed_mb: usize,
    /// Replace a model of the same name.
    #[arg(long)]
    pub force: bool,
    /// Say what would be written, and write nothing.
    #[arg(long)]
    pub dry_run: bool,
    /// Library of onnxruntime [default: ORT_DYLIB_PATH, else beside the program, in .runtime, of the system]
    #[arg(long, value_name = "FILE", help_heading = "Machine", hide_short_help = RARE)]
    pub ort_lib: Option<PathBuf>,
    #[command(flatten)]
    pub machine: MachineParams,
    #[command(flatten)]
    pub client: ClientParams,
}

impl Stage for Export {
    const NAME: &'static str = "export";
    const ABOUT: &'static str = "write a trained run as ONNX files, checked through onnxruntime";
    const CONTRACT: Contract = Contract {
        reads: "runs/<run>/, phrases, motion, features",
        writes: "models/<model>/ (.onnx files, model.json), onnx_checks",
    };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        check_run_name(&params.run)?;
        check_model_name(&params.model)?;
        let store = Location::open(&params.store, &params.client.options())?;
        if TrainedGroup::is_of(&store, &params.run)? {
            return family::run::<TrainedGroup>(&params, &store, progress);
        }
        if TrainedPlanner::is_of(&store, &params.run)? {
            return family::run::<TrainedTokens>(&params, &store, progress);
        }
        ensure!(
            !TrainedTokenizer::is_of(&store, &params.run)?,
            "run {run} has a tokenizer, which makes no motion for music; train a planner of its tokens (motiongen train \
             --family tokens --tokenizer {run} --run NAME) and export that run",
            run = params.run
        );
        family::run::<TrainedRun>(&params, &store, progress)
    }
}

/// Checks a model, whose checks it keeps, and puts it in place; returns the checks, or none where it was there already.
///
/// # Errors
/// A model of the same name that may not be replaced, no onnxruntime, and a check that failed.
fn put_in_place(
    params: &Params,
    store: &Location,
    (files, card_text): (&[(ModelFileName, Bytes)], &Bytes),
    progress: &dyn Progress,
    check: impl FnOnce(&Runtime) -> anyhow::Result<CheckResults>,
) -> anyhow::Result<Option<CheckResults>> {
    let (folder, what) = (folder_of(&params.model), format!("model {}", params.model));
    let (lease, _) = lease::take(store, &folder, &what, &|text| progress.note(text))?;
    match store.read_if_there(&card_path(store, &params.model)?)? {
        Some(there) if there == *card_text => return Ok(None),
        Some(_) if !params.force => bail!(
            "store {store} has a model \"{}\" of other weights or settings; give another --model name, \
             or replace it with --force",
            params.model
        ),
        _ => {}
    }
    // Before anything is computed: without the library there is nothing to check with.
    let runtime = Runtime::load(params.ort_lib.as_deref())?;
    let results = check(&runtime)?;
    // From here on a signal is left until the model is whole.
    progress.is_interrupted();
    record(store, params, card_text, &results)?;
    checkpoint(store, &[Export::NAME]);
    results.require(&params.model)?;
    lease.check()?;
    publish(store, &params.model, (files, card_text))?;
    Ok(Some(results))
}

/// Returns how fast the motion is that was trained on; none where it never moves.
fn motion_range(dataset: &Dataset) -> Result<Option<MotionRange>, StoreError> {
    let train = dataset.phrases().iter().filter(|phrase| phrase.split == Split::Train);
    let motions: Vec<_> =
        train.map(|phrase| dataset.motion(phrase, 0, phrase.n_frames)).collect::<Result<_, _>>()?;
    Ok(MotionRange::fit(motions.iter().map(|frames| frames.view())).filter(MotionRange::is_sound))
}

/// Returns the mean style of the phrases that were trained on by the name of their style; none of a network that takes
/// no style.
fn named_styles(dataset: &Dataset, style_dim: usize) -> Result<NamedStyles, StoreError> {
    let mut styles = StyleMeans::default();
    if style_dim == 0 {
        return Ok(styles.means());
    }
    for phrase in dataset.phrases().iter().filter(|phrase| phrase.split == Split::Train) {
        if let Some(name) = &phrase.style_name {
            styles.add(name, dataset.motion(phrase, 0, phrase.n_frames)?.view());
        }
    }
    Ok(styles.means())
}

fn check_model_name(model: &str) -> anyhow::Result<()> {
    ensure!(
        is_model_name(model),
        "--model {model:?} is no name for a model; use 1 to 100 letters, digits, -, _ and ., and no . at \
         the beginning"
    );
    Ok(())
}

/// Returns where the card of the model is that counts.
fn card_path(store: &Location, model: &str) -> Result<String, StoreError> {
    Ok(format!("{}/{}", current_folder(store, &folder_of(model))?, file_names::CARD))
}

/// Puts the files in place. A model that is there is replaced by a folder of its own and, once that is whole, by one
/// pointer: at any moment there is the old model or the new one. Its card comes last, without which there is none.
fn publish(
    store: &Location,
    model: &str,
    (files, card_text): (&[(ModelFileName, Bytes)], &Bytes),
) -> Result<(), StoreError> {
    let folder = folder_of(model);
    let before = current_folder(store, &folder)?;
    let is_there = store.read_if_there(&format!("{before}/{}", file_names::CARD))?.is_some();
    let (version, pointer) = pointer_to(card_text);
    let into = if is_there { format!("{folder}/{version}") } else { folder.clone() };
    let is_within =
        |path: &str, folder: &str| path.strip_prefix(folder).is_some_and(|p| p.starts_with('/'));
    // Files that an export that was killed left behind.
    for listed in store.list(&into)?.into_iter().filter(|_| into != before || !is_there) {
        store.remove(&listed.path)?;
    }
    for (name, bytes) in files {
        store.put_new(&format!("{into}/{name}"), bytes.clone())?;
    }
    store.put_new(&format!("{into}/{}", file_names::CARD), card_text.clone())?;
    if !is_there {
        return Ok(());
    }
    let pointer_path = format!("{folder}/{POINTER}");
    store.replace(&pointer_path, pointer)?;
    // The model before this one stays where it has a folder, for programs that are reading it.
    for ListedObject { path, .. } in store.list(&folder)? {
        let is_kept = path == pointer_path
            || is_within(&path, &into)
            || (before != folder && is_within(&path, &before));
        if !is_kept {
            store.remove(&path)?;
        }
    }
    Ok(())
}

/// Writes the checks of a model into their table, in place of those of an earlier export.
fn record(
    store: &Location,
    params: &Params,
    card_text: &Bytes,
    results: &CheckResults,
) -> Result<(), StoreError> {
    let ledger = Ledger::read(store, Export::NAME)?;
    let mut commit = Commit::new(store, Export::NAME, "", &params.run);
    let time = TimestampUs::now();
    let rows: Vec<OnnxCheckRow> =
        results.rows.iter().map(|row| OnnxCheckRow { time, ..row.clone() }).collect();
    commit.part(OnnxCheckRow::schema().name, OnnxCheckRow::schema)?.write_rows(&rows)?;
    let known = format!("{}\n{}", sha256(card_text), results.runtime);
    let input_hash = digest(known.as_bytes())[..32].to_owned();
    let id = params.model.clone();
    commit.settle(Item { id, fingerprint: input_hash.clone(), input_hash, failure: None }, &ledger);
    commit.publish().map(|_| ())
}

#[cfg(all(test, feature = "pretrained"))]
mod tests {
    use super::files::ExportedFiles;
    use super::*;
    use crate::generation::{FamilyCard as _, ModelCard};
    use crate::stages::pretrained::ShippedModel;
    use crate::store::ClientOptions;

    const NAMES: [&str; 2] = [file_names::UNET, file_names::DECODER];

    /// Files of a model that all say `version`.
    fn files(version: usize) -> ExportedFiles<ModelCard> {
        let card = ShippedModel::Soloist.file(file_names::CARD).expect("the model that ships");
        let card = ModelCard::read(&card, "card").expect("a card");
        let text = |name: &str| format!("{name} of {version}").into();
        let named = |name: &&str| {
            let file = ModelFileName::of_name(name).expect("a file of a model");
            (file, text(name))
        };
        let bytes = NAMES.iter().map(named).collect();
        ExportedFiles { card, card_text: text(file_names::CARD), bytes }
    }

    /// Returns which version a reader finds; none where a file is gone.
    fn version(store: &Location) -> Option<String> {
        let folder = current_folder(store, &folder_of("m")).expect("a folder");
        let read = |name: &str| {
            let bytes = store.read_if_there(&format!("{folder}/{name}")).expect("readable")?;
            let text = String::from_utf8(bytes.to_vec()).expect("a text");
            Some(text.strip_prefix(name).expect("a file of that name").to_owned())
        };
        let found = read(file_names::CARD)?;
        for name in NAMES {
            assert_eq!(read(name)?, found, "{name} is of another version than its card");
        }
        Some(found)
    }

    fn published(store: &Location, files: &ExportedFiles<ModelCard>) -> Result<(), StoreError> {
        publish(store, "m", (&files.bytes, &files.card_text))
    }

    fn stores() -> (tempfile::TempDir, [Location; 2]) {
        let folder = tempfile::tempdir().expect("a folder");
        let local = Location::local(folder.path()).expect("a location");
        let memory = Location::open("memory://exported", &ClientOptions::default());
        (folder, [local, memory.expect("a location")])
    }

    #[test]
    fn the_first_model_lies_in_its_folder_and_the_next_in_one_of_its_own() {
        let (_folder, stores) = stores();
        for store in &stores {
            let paths = || -> Vec<String> {
                store.list("models").expect("listed").into_iter().map(|l| l.path).collect()
            };
            // What an export that was killed left behind is no part of a model.
            store.put_new("models/m/unet.onnx", "half".into()).expect("written");
            published(store, &files(1)).expect("published");
            let plain = ["models/m/decoder.onnx", "models/m/model.json", "models/m/unet.onnx"];
            assert_eq!(paths(), plain);
            assert_eq!(version(store).as_deref(), Some(" of 1"));
            published(store, &files(2)).expect("published");
            assert_eq!(version(store).as_deref(), Some(" of 2"));
            assert_eq!(paths().len(), 4, "three files and the pointer: {:?}", paths());
            published(store, &files(3)).expect("published");
            assert_eq!(version(store).as_deref(), Some(" of 3"));
            assert_eq!(paths().len(), 7, "the one before stays for its readers");
            published(store, &files(2)).expect("published");
            assert_eq!((version(store).as_deref(), paths().len()), (Some(" of 2"), 7));
        }
    }

    #[test]
    fn there_is_a_whole_model_at_any_moment() {
        let (_folder, stores) = stores();
        for store in &stores {
            published(store, &files(0)).expect("published");
            published(store, &files(1)).expect("published");
            let is_done = std::sync::atomic::AtomicBool::new(false);
            let order = std::sync::atomic::Ordering::SeqCst;
            std::thread::scope(|scope| {
                let reader = scope.spawn(|| {
                    let mut n_read = 0;
                    while !is_done.load(order) {
                        // As a model is opened: once more where it was replaced twice meanwhile.
                        assert!(version(store).or_else(|| version(store)).is_some());
                        n_read += 1;
                    }
                    n_read
                });
                for i in 2..120 {
                    published(store, &files(i)).expect("published");
                    std::thread::sleep(std::time::Duration::from_millis(1));
                }
                is_done.store(true, order);
                assert!(reader.join().expect("a reader") > 20);
            });
        }
    }

    #[test]
    fn a_first_model_is_whole_as_soon_as_it_has_a_card() {
        let (_folder, [store, _]) = stores();
        let card = format!("models/m/{}", file_names::CARD);
        for i in 0..20 {
            std::thread::scope(|scope| {
                let reader = scope.spawn(|| {
                    while store.read_if_there(&card).expect("readable").is_none() {}
                    version(&store)
                });
                published(&store, &files(i)).expect("published");
                assert_eq!(reader.join().expect("a reader"), Some(format!(" of {i}")));
            });
            for ListedObject { path, .. } in store.list("models").expect("listed") {
                store.remove(&path).expect("removed");
            }
        }
    }

    #[test]
    fn a_pointer_of_others_is_passed_over() {
        let (_folder, [store, _]) = stores();
        published(&store, &files(1)).expect("published");
        let digits = "0123456789abcdef0123456789abcdef";
        for text in ["", "{}", r#"{"folder": "../../../etc"}"#, r#"{"folder": "/etc"}"#, digits] {
            store.replace("models/m/current.json", text.to_owned().into()).expect("written");
            assert_eq!(version(&store).as_deref(), Some(" of 1"), "{text}");
        }
    }
}
