//! What a run learns from, what its model's card says of it, and what evaluate may believe.

use bytes::Bytes;

use super::generate::{weights_digest, weights_digest_of_tokens};
use super::model_files::{current_folder, folder_of, is_model_name};
use super::train::session::{MachineParams, ProgressWatch, read_phrases};
use super::trained::{FinetuneData, TrainedRun};
use super::{Progress, Stage as _, finetune::Finetune, model_files::shipped_as, train::Train};

use crate::generation::{
    CardError, FamilyCard as _, GroupCard, LearnedFrom, MAX_CARD_BYTES, ModelCard, Purpose,
    TokensCard, family_of, file_names,
};
use crate::model::Family;
use crate::store::{Location, Patience, StoreError};
use crate::training::{Dataset, Split};

/// Returns where the list of what a command of a run learns from lies below the store.
pub fn learned_path(run: &str, command: &str) -> String {
    format!("runs/{run}/{command}.learned.json")
}

/// Lists what is learned from a dataset: phrases of the training and of the validation split.
fn of_dataset(dataset: &Dataset) -> LearnedFrom {
    let used = dataset.phrases().iter().filter_map(|phrase| {
        let purpose = match phrase.split {
            Split::Train => Purpose::Training,
            Split::Validation => Purpose::Validation,
            Split::Test => return None,
        };
        Some((purpose, phrase.song_hash.as_deref(), &*phrase.content_hash))
    });
    LearnedFrom::new(dataset.fingerprint(), used)
}

/// Writes what a command of a run learns from, once it is certain that it does: a dataset that the run's
/// checkpoints agree with.
///
/// A list of the same data stays as it is, unless digests are known now that were not before. One of other data is
/// of a training that left no checkpoint, and is replaced.
///
/// # Errors
/// When the store cannot be read or written.
pub fn remember(
    store: &Location,
    run: &str,
    command: &str,
    dataset: &Dataset,
    patience: Patience,
    watch: &ProgressWatch,
) -> anyhow::Result<()> {
    let path = learned_path(run, command);
    let notice = |error: &StoreError, pause| watch.notice(error, pause);
    let found = of_dataset(dataset);
    let there = patience.wait_out(notice, || store.read_if_there(&path))?;
    let known: Option<LearnedFrom> =
        there.as_ref().and_then(|text| serde_json::from_slice(text).ok());
    let wanted = match &known {
        Some(known) if known.data == found.data => known.clone().refreshed(found),
        _ => found,
    };
    if known.as_ref() == Some(&wanted) {
        return Ok(());
    }
    if there.is_some() {
        patience.wait_out(notice, || store.remove(&path))?;
    }
    let text = serde_json::to_vec_pretty(&wanted)?;
    patience.wait_out(notice, || store.put_new(&path, text.clone().into()))?;
    Ok(())
}

/// Returns what the weights of a run learned from: train's phrases and, where they were fine-tuned, those of
/// finetune. None where the run has no list, as those of release 0.1, and the store's phrases are others by now.
///
/// # Errors
/// When the store cannot be read.
pub fn of_run(
    store: &Location,
    run: &str,
    trained: &TrainedRun,
    machine: &MachineParams,
    progress: &dyn Progress,
    is_dry_run: bool,
) -> anyhow::Result<Option<LearnedFrom>> {
    let learned_by = |command, data: &str, most| {
        let machine = (machine, Family::Unet);
        of_command(store, run, command, (data, most), machine, progress, is_dry_run)
    };
    let Some(by_train) = learned_by(Train::NAME, &trained.state.data, None)? else {
        return Ok(None);
    };
    let Some(FinetuneData { data, num_phrases }) = &trained.tuned else {
        return Ok(Some(by_train));
    };
    if *data == by_train.data {
        return Ok(Some(by_train));
    }
    let by_finetune = learned_by(Finetune::NAME, data, *num_phrases)?;
    Ok(by_finetune.map(|by_finetune| by_train.and(by_finetune)))
}

/// Returns what the weights of a run of the family `group` learned from.
///
/// # Errors
/// When the store cannot be read.
pub fn of_group(
    store: &Location,
    run: &str,
    data: &str,
    machine: &MachineParams,
    progress: &dyn Progress,
    is_dry_run: bool,
) -> anyhow::Result<Option<LearnedFrom>> {
    let machine = (machine, Family::Group);
    of_command(store, run, Train::NAME, (data, None), machine, progress, is_dry_run)
}

/// Returns what the weights of a planner and of its tokenizer learned from.
///
/// # Errors
/// When the store cannot be read.
pub fn of_planner(
    store: &Location,
    runs: [(&str, &str); 2],
    machine: &MachineParams,
    progress: &dyn Progress,
    is_dry_run: bool,
) -> anyhow::Result<Option<LearnedFrom>> {
    let learned_by = |(run, data): (&str, &str)| {
        let machine = (machine, Family::Tokens);
        of_command(store, run, Train::NAME, (data, None), machine, progress, is_dry_run)
    };
    let [planner, tokenizer] = runs;
    let Some(of_planner) = learned_by(planner)? else { return Ok(None) };
    if planner.1 == tokenizer.1 {
        return Ok(Some(of_planner));
    }
    Ok(learned_by(tokenizer)?.map(|of_tokenizer| of_planner.and(of_tokenizer)))
}

/// Returns what train says that a run learns from; none where it left no list.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn listed(store: &Location, run: &str) -> Result<Option<LearnedFrom>, StoreError> {
    let text = store.read_if_there(&learned_path(run, Train::NAME))?;
    Ok(text.and_then(|text| serde_json::from_slice(&text).ok()))
}

/// Returns what a command learned from the data with a fingerprint: from its list, and where that is missing or has
/// gaps from the store.
fn of_command(
    store: &Location,
    run: &str,
    command: &str,
    (data, max_train_phrases): (&str, Option<usize>),
    machine: (&MachineParams, Family),
    progress: &dyn Progress,
    is_dry_run: bool,
) -> anyhow::Result<Option<LearnedFrom>> {
    let text = store.read_if_there(&learned_path(run, command))?;
    let listed: Option<LearnedFrom> = text.and_then(|text| serde_json::from_slice(&text).ok());
    let listed = listed.filter(|listed| listed.data == data);
    if listed.as_ref().is_some_and(|listed| listed.is_complete) {
        return Ok(listed);
    }
    let watch = ProgressWatch(progress);
    let stage = super::export::Export::NAME;
    let phrases =
        read_phrases(store, stage, machine, max_train_phrases, progress, &watch, is_dry_run)?;
    if phrases.dataset.fingerprint() != data {
        return Ok(listed);
    }
    let found = of_dataset(&phrases.dataset);
    Ok(Some(match listed {
        Some(listed) => listed.refreshed(found),
        None => found,
    }))
}

/// Why it is not known what the model of a motion learned from.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LearnedFromError {
    #[error(
        "store {store} has no model \"{model}\", so what it learned from is not known; copy the folder of the \
         model to models/{model} there"
    )]
    NoModel { store: String, model: String },
    #[error(
        "model \"{model}\" of store {store} has other weights ({found}) than the motions were made with \
         ({expected}), so what those learned from is not known; generate the motions again, or copy the model \
         there that made them"
    )]
    OtherWeights { store: String, model: String, found: String, expected: String },
    #[error(
        "the card of model \"{model}\" does not tell what it learned from; export it again from its run with this \
         version of motiongen"
    )]
    NotListed { model: String },
    #[error(transparent)]
    Card(#[from] CardError),
}

/// Returns what the model that made a motion learned from, as the card in the store says; only the card is read.
///
/// `model` and `weights` are those of the motion's row in `generations`.
///
/// # Errors
/// [`StoreError`] when the store cannot be read; within, why the card does not tell.
pub fn of_model(
    store: &Location,
    model: &str,
    weights: &str,
) -> Result<Result<LearnedFrom, LearnedFromError>, StoreError> {
    let path = format!("{}/{}", folder_of(model), file_names::CARD);
    let Some(bytes) = card_of(store, model)? else {
        let (store, model) = (store.to_string(), model.to_owned());
        return Ok(Err(LearnedFromError::NoModel { store, model }));
    };
    let (found, learned_from) = match weights_and_music(&bytes, &store.url_of(&path)) {
        Ok(found) => found,
        Err(error) => return Ok(Err(error.into())),
    };
    if found != weights {
        let short = |digest: &str| digest.chars().take(12).collect();
        return Ok(Err(LearnedFromError::OtherWeights {
            store: store.to_string(),
            model: model.to_owned(),
            found: short(&found),
            expected: short(weights),
        }));
    }
    let model = model.to_owned();
    Ok(learned_from.ok_or(LearnedFromError::NotListed { model }))
}

/// Returns the digest of a model's weights, and what it learned from, as the card of a model of any family says.
fn weights_and_music(card: &[u8], place: &str) -> Result<(String, Option<LearnedFrom>), CardError> {
    Ok(match family_of(card, place)? {
        Family::Unet => {
            let card = ModelCard::read(card, place)?;
            (weights_digest(&card), card.provenance.learned_from)
        }
        Family::Tokens => {
            let card = TokensCard::read(card, place)?;
            (weights_digest_of_tokens(&card), card.provenance.learned_from)
        }
        Family::Group => {
            let card = GroupCard::read(card, place)?;
            (card.weights_sha256, card.provenance.learned_from)
        }
    })
}

/// Returns the family of the model that made a motion; none where the store does not have it with the same weights.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn family_with_weights(
    store: &Location,
    model: &str,
    weights: &str,
) -> Result<Option<Family>, StoreError> {
    let place = store.url_of(&format!("{}/{}", folder_of(model), file_names::CARD));
    let Some(card) = card_of(store, model)? else { return Ok(None) };
    let found = weights_and_music(&card, &place).ok().filter(|(found, _)| found == weights);
    Ok(found.and_then(|_| family_of(&card, &place).ok()))
}

/// Returns the digest of the weights that a model has now, as its card says; none where there is no such model.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn weights_now(store: &Location, model: &str) -> Result<Option<String>, StoreError> {
    let path = format!("{}/{}", folder_of(model), file_names::CARD);
    let card = card_of(store, model)?;
    Ok(card
        .and_then(|card| weights_and_music(&card, &store.url_of(&path)).ok())
        .map(|found| found.0))
}

/// Returns the card of a model of the store, or of the one that ships with the program.
fn card_of(store: &Location, model: &str) -> Result<Option<Bytes>, StoreError> {
    // The name is from a table, where a foreign one may say anything.
    if !is_model_name(model) {
        return Ok(None);
    }
    let path = format!("{}/{}", current_folder(store, &folder_of(model))?, file_names::CARD);
    match store.read_regular(&path, MAX_CARD_BYTES) {
        Err(StoreError::NotFound { .. }) => {
            Ok(shipped_as(model).and_then(|shipped| shipped.file(file_names::CARD)))
        }
        read => read.map(Some),
    }
}
