//! A model's folder: where its files are, and that they are what its card says.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use super::pretrained::ShippedModel;
pub use crate::generation::is_name as is_model_name;
use crate::generation::{
    CardError, FamilyCard as _, FileEntry, GroupCard, MAX_CARD_BYTES, ModelCard, ModelFileName,
    TokensCard, family_of, file_names,
};
use crate::model::Family;
use crate::store::{Location, StoreError, prepared};

/// The files of a model of any family, at hand on this machine.
pub struct ModelFolder {
    family: Family,
    card_bytes: Bytes,
    /// What messages call the card.
    card_place: String,
    /// The files that the card lists.
    entries: Vec<FileEntry>,
    source: Source,
    /// The name in messages.
    place: String,
    /// Whether the files' digests are known to be those of the card.
    is_verified: bool,
}

/// Where a model's files are.
enum Source {
    Folder(PathBuf),
    /// Within the program.
    Shipped(ShippedModel),
}

/// Returns where a model lies below a store.
pub fn folder_of(name: &str) -> String {
    format!("models/{name}")
}

/// File beside the card of a model that was replaced, which names the folder of the model that counts.
pub const POINTER: &str = "current.json";
/// Digits of the name of such a folder.
const VERSION_DIGITS: usize = 32;

/// The content of [`POINTER`].
#[derive(serde::Serialize, serde::Deserialize)]
struct Pointer {
    folder: String,
}

/// Returns the name of the folder of a model with that card, and the text that points there.
pub fn pointer_to(card_text: &[u8]) -> (String, Bytes) {
    let folder = sha256(card_text)[..VERSION_DIGITS].to_owned();
    let text = serde_json::json!({ "folder": folder }).to_string() + "\n";
    (folder, text.into())
}

/// Returns where the files of a model lie: below its own folder where that was replaced, else in it.
///
/// # Errors
/// [`StoreError`] when the store cannot be read.
pub fn current_folder(store: &Location, folder: &str) -> Result<String, StoreError> {
    let below = |name: &str| match folder {
        "" => name.to_owned(),
        folder => format!("{folder}/{name}"),
    };
    let Some(bytes) = store.read_if_there(&below(POINTER))? else { return Ok(folder.to_owned()) };
    let is_version =
        |name: &String| name.len() == VERSION_DIGITS && name.bytes().all(|b| b.is_ascii_hexdigit());
    match serde_json::from_slice(&bytes) {
        Ok(Pointer { folder: version }) if is_version(&version) => Ok(below(&version)),
        // Nothing of ours: the model is where it was before there were pointers.
        _ => Ok(folder.to_owned()),
    }
}

impl ModelFolder {
    /// Opens a model of a store, and fetches its files if the store is far away.
    ///
    /// # Errors
    /// One sentence about what is missing or of another kind.
    pub fn of_store(store: &Location, name: &str, cache: &Path) -> anyhow::Result<Self> {
        match Self::of_store_once(store, name, cache) {
            // It was replaced while it was read.
            Err(e) if matches!(e.downcast_ref(), Some(StoreError::NotFound { .. })) => {
                Self::of_store_once(store, name, cache)
            }
            opened => opened,
        }
    }

    fn of_store_once(store: &Location, name: &str, cache: &Path) -> anyhow::Result<Self> {
        let folder = current_folder(store, &folder_of(name))?;
        let path = format!("{folder}/{}", file_names::CARD);
        let bytes = match store.read_regular(&path, MAX_CARD_BYTES) {
            Err(StoreError::NotFound { .. }) => match shipped_as(name) {
                Some(model) => return Self::shipped(model),
                None => bail!(
                    "store {store} has no model \"{name}\"{}; run motiongen export --store {store} --run RUN \
                 --model {name} first",
                    others(store)?
                ),
            },
            read => read?,
        };
        let (card_place, place) = (store.url_of(&path), store.url_of(&folder));
        let key = format!("model-{}", &sha256(&bytes)[..32]);
        // Where a store is far away, its files have no folder yet.
        let root = store.local_path().map(|root| root.join(&folder)).unwrap_or_default();
        let found = Self::new(bytes, card_place, (Source::Folder(root), place))?;
        if store.local_path().is_some() {
            return Ok(found);
        }
        let fetched = prepared(cache, &key, |into| {
            for file in &found.entries {
                let bytes = read_listed(store, &folder, file, &found.place)?;
                write_verified(into, file, &bytes, &found.place)?;
            }
            anyhow::Ok(())
        })?;
        Ok(Self { source: Source::Folder(fetched), is_verified: true, ..found })
    }

    /// Opens a model as users name it: the folder of one, or the name of one of the store.
    ///
    /// # Errors
    /// One sentence about what is missing or of another kind.
    pub fn named(model: &str, store: Option<&Location>, cache: &Path) -> anyhow::Result<Self> {
        let folder = Path::new(model);
        if [file_names::CARD, POINTER].iter().any(|name| folder.join(name).is_file()) {
            return Self::of_folder(folder);
        }
        match (store, shipped_as(model)) {
            (Some(store), _) => Self::of_store(store, model, cache),
            (None, Some(shipped)) => Self::shipped(shipped),
            (None, None) => bail!(
                "there is no model in the folder {model}; name the folder of a model (STORE/models/NAME), or give \
                 --store beside its name"
            ),
        }
    }

    /// Returns what messages call the folder.
    pub fn place(&self) -> &str {
        &self.place
    }

    /// Opens a model in a folder of this machine.
    ///
    /// # Errors
    /// One sentence about what is missing or of another kind.
    pub fn of_folder(folder: &Path) -> anyhow::Result<Self> {
        let current = current_folder(&Location::local(folder)?, "")?;
        let folder = &folder.join(current);
        let store = Location::local(folder)?;
        let bytes = store.read_regular(file_names::CARD, MAX_CARD_BYTES)?;
        let place = folder.display().to_string();
        let source = Source::Folder(folder.to_owned());
        Ok(Self::new(bytes, store.url_of(file_names::CARD), (source, place))?)
    }

    /// Opens a model that ships with the program.
    ///
    /// # Errors
    /// When the program was built without it.
    pub fn shipped(model: ShippedModel) -> anyhow::Result<Self> {
        let Some(bytes) = model.file(file_names::CARD) else {
            bail!(
                "this program was built without a model (feature pretrained); name one: --model NAME of a store, or \
                 the folder of one"
            )
        };
        let place = model.place().to_owned();
        Ok(Self::new(bytes, place.clone(), (Source::Shipped(model), place))?)
    }

    /// Returns the folder of the files; those of the program are written into the cache first.
    ///
    /// # Errors
    /// When they cannot be written.
    pub fn folder(&self, cache: &Path) -> anyhow::Result<PathBuf> {
        if let Source::Folder(folder) = &self.source {
            return Ok(folder.clone());
        }
        let key = format!("model-{}", &sha256(&self.card_bytes)[..32]);
        prepared(cache, &key, |into| {
            for file in &self.entries {
                write_verified(into, file, &self.bytes(file)?, &self.place)?;
            }
            anyhow::Ok(())
        })
    }

    /// Reads a file as it is.
    fn bytes(&self, file: &FileEntry) -> anyhow::Result<Bytes> {
        match &self.source {
            Source::Folder(folder) => read_listed(&Location::local(folder)?, "", file, &self.place),
            Source::Shipped(model) => model
                .file(file.name.name())
                .with_context(|| format!("{} has no file {}", self.place, file.name)),
        }
    }

    /// Takes a card, of any family, whose files are in `source`.
    fn new(
        card_bytes: Bytes,
        card_place: String,
        (source, place): (Source, String),
    ) -> Result<Self, CardError> {
        let family = family_of(&card_bytes, &card_place)?;
        let entries = match family {
            Family::Unet => ModelCard::read(&card_bytes, &card_place)?.files,
            Family::Tokens => TokensCard::read(&card_bytes, &card_place)?.files,
            Family::Group => GroupCard::read(&card_bytes, &card_place)?.files,
        };
        Ok(Self { family, card_bytes, card_place, entries, source, place, is_verified: false })
    }

    /// Returns the family of the model.
    pub fn family(&self) -> Family {
        self.family
    }

    /// Returns the text of the card.
    pub fn card_bytes(&self) -> &[u8] {
        &self.card_bytes
    }

    /// Returns what messages call the card.
    pub fn card_place(&self) -> &str {
        &self.card_place
    }

    /// Returns what messages call a file.
    pub fn place_of(&self, name: ModelFileName) -> String {
        format!("{}/{name}", self.place)
    }

    /// Returns whether the model is one within the program.
    pub fn is_shipped(&self) -> bool {
        matches!(self.source, Source::Shipped(_))
    }

    /// Returns what the card says of a file.
    ///
    /// # Errors
    /// [`CardError::NoFile`] when the card lists none.
    pub fn entry(&self, name: ModelFileName) -> Result<&FileEntry, CardError> {
        let found = self.entries.iter().find(|file| file.name == name);
        found.ok_or_else(|| CardError::NoFile { place: self.place.clone(), name })
    }

    /// Reads a file and holds it against the card.
    ///
    /// # Errors
    /// When it is missing, or not the one that the card lists.
    pub fn read(&self, name: ModelFileName) -> anyhow::Result<Bytes> {
        let entry = self.entry(name)?;
        let bytes = self.bytes(entry)?;
        if !self.is_verified {
            verify(entry, &sha256(&bytes), &self.place)?;
        }
        Ok(bytes)
    }

    /// Holds every file against the card.
    ///
    /// # Errors
    /// The first that is not the one that the card lists.
    pub fn verify(&self) -> anyhow::Result<()> {
        if self.is_verified {
            return Ok(());
        }
        for file in &self.entries {
            verify(file, &sha256(&self.bytes(file)?), &self.place)?;
        }
        Ok(())
    }
}

/// Returns the model of a name that is within this program.
pub fn shipped_as(name: &str) -> Option<ShippedModel> {
    ShippedModel::named(name).filter(|model| model.file(file_names::CARD).is_some())
}

/// Reads a file that a card lists, if it is a regular one of the size that the card says.
fn read_listed(
    location: &Location,
    folder: &str,
    file: &FileEntry,
    place: &str,
) -> anyhow::Result<Bytes> {
    let path = match folder {
        "" => file.name.name().to_owned(),
        folder => format!("{folder}/{}", file.name),
    };
    let found = location.size_bytes(&path)?;
    if found != file.n_bytes {
        let place = format!("{place}/{}", file.name);
        return Err(CardError::Size { place, found, expected: file.n_bytes }.into());
    }
    Ok(location.read_regular(&path, file.n_bytes)?)
}

/// Writes a file into a folder of the cache if it is what the card says.
fn write_verified(into: &Path, file: &FileEntry, bytes: &[u8], place: &str) -> anyhow::Result<()> {
    verify(file, &sha256(bytes), place)?;
    let to = into.join(file.name.name());
    crate::store::write_file(&to, |out| out.write_all(bytes))
        .with_context(|| to.display().to_string())
}

fn verify(file: &FileEntry, found: &str, folder: &str) -> Result<(), CardError> {
    if found == file.sha256 {
        return Ok(());
    }
    Err(CardError::Digest {
        place: format!("{folder}/{}", file.name),
        found: found.to_owned(),
        expected: file.sha256.clone(),
    })
}

/// Returns the SHA-256 of bytes as hexadecimal digits.
pub fn sha256(bytes: &[u8]) -> String {
    sha256_of([bytes])
}

/// Returns the SHA-256 of pieces of bytes, one behind the other, as hexadecimal digits.
pub fn sha256_of(pieces: impl IntoIterator<Item = impl AsRef<[u8]>>) -> String {
    let mut hash = Sha256::new();
    pieces.into_iter().for_each(|piece| hash.update(piece));
    hash.finalize().iter().fold(String::with_capacity(64), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Says which models a store has.
fn others(store: &Location) -> anyhow::Result<String> {
    let listed = store.list("models")?;
    let name_of = |path: &'_ str| -> Option<String> {
        let (name, file) = path.strip_prefix("models/")?.split_once('/')?;
        [file_names::CARD, POINTER].contains(&file).then(|| name.to_owned())
    };
    let names: std::collections::BTreeSet<String> =
        listed.iter().filter_map(|listed| name_of(&listed.path)).collect();
    let names: Vec<String> = names.into_iter().collect();
    Ok(if names.is_empty() { String::new() } else { format!(" (it has {})", names.join(", ")) })
}
