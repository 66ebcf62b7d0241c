//! A model's folder, opened to be run.

use std::fmt::Write as _;
use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, bail};
use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use super::{all_threads, pretrained};
use crate::autodiff::Parameters;
pub use crate::generation::is_name as is_model_name;
use crate::generation::{
    CardError, EagerEngine, Engine, FileEntry, MAX_CARD_BYTES, ModelCard, ModelFileName,
    OnnxEngine, SessionPlan, file_names,
};
use crate::model::{MotionDecoder, ParameterList, UNet1D};
use crate::onnx::{Device, Model, OnnxError, PINNED_VERSION, Runtime, Session, check, values_of};
use crate::store::{Location, StoreError, prepared};

/// What runs a model.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum EngineChoice {
    /// onnxruntime where its library is found, else eager.
    #[default]
    Auto,
    /// The interpreter that trained it, which needs nothing.
    Eager,
    /// onnxruntime.
    Onnx,
}

/// How models are run, whatever for.
#[derive(Clone, Debug, clap::Args)]
pub struct EngineParams {
    /// What runs the model; MOTIONGEN_DEVICE chooses onnxruntime's device (auto, cpu, cuda, …).
    #[arg(long, value_enum, default_value_t = EngineChoice::Auto, help_heading = "Engine")]
    pub engine: EngineChoice,
    /// Library of onnxruntime [default: ORT_DYLIB_PATH, else beside the program, in .runtime, of the system]
    #[arg(long, value_name = "FILE", help_heading = "Engine")]
    pub ort_lib: Option<PathBuf>,
    /// Threads in all.
    #[arg(long, value_name = "N", default_value_t = all_threads(), help_heading = "Engine")]
    pub threads: NonZeroUsize,
    /// Folder for models as this machine's processor likes them [default: ~/.cache/motiongen]
    #[arg(long, value_name = "DIR", help_heading = "Engine")]
    pub model_cache: Option<PathBuf>,
}

impl EngineParams {
    /// Returns the folder of the cache.
    pub fn cache(&self) -> PathBuf {
        self.model_cache.clone().unwrap_or_else(default_model_cache)
    }
}

/// Returns the folder in which models are kept as this machine's processor likes them, unless another is named.
pub fn default_model_cache() -> PathBuf {
    let variable = |name: &str| std::env::var_os(name).filter(|value| !value.is_empty());
    let below = |folder: PathBuf| folder.join("motiongen");
    variable("XDG_CACHE_HOME")
        .map(|folder| below(folder.into()))
        .or_else(|| variable("HOME").map(|home| below(PathBuf::from(home).join(".cache"))))
        .unwrap_or_else(|| below(std::env::temp_dir()))
}

/// A model whose files are at hand on this machine.
pub struct OpenModel {
    pub card: ModelCard,
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
    Pretrained,
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

impl OpenModel {
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
            Err(StoreError::NotFound { .. }) if name == pretrained::NAME => {
                return Self::pretrained();
            }
            Err(StoreError::NotFound { .. }) => bail!(
                "store {store} has no model \"{name}\"{}; run motiongen export --store {store} --run RUN \
                 --model {name} first",
                others(store)?
            ),
            read => read?,
        };
        let card = ModelCard::read(&bytes, &store.url_of(&path))?;
        let place = store.url_of(&folder);
        if let Some(root) = store.local_path() {
            let source = Source::Folder(root.join(folder));
            return Ok(Self { card, source, place, is_verified: false });
        }
        let key = format!("model-{}", &sha256(&bytes)[..32]);
        let fetched = prepared(cache, &key, |into| {
            for file in &card.files {
                let bytes = read_listed(store, &folder, file, &place)?;
                write_verified(into, file, &bytes, &place)?;
            }
            anyhow::Ok(())
        })?;
        Ok(Self { card, source: Source::Folder(fetched), place, is_verified: true })
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
        let card = ModelCard::read(&bytes, &store.url_of(file_names::CARD))?;
        let place = folder.display().to_string();
        let source = Source::Folder(folder.to_owned());
        Ok(Self { card, source, place, is_verified: false })
    }

    /// Opens the model that ships with the program.
    ///
    /// # Errors
    /// When the program was built without it.
    pub fn pretrained() -> anyhow::Result<Self> {
        let Some(bytes) = pretrained::file(file_names::CARD) else {
            bail!(
                "this program was built without a model (feature pretrained); name one: --model NAME of a store, or \
                 the folder of one"
            )
        };
        let card = ModelCard::read(&bytes, pretrained::PLACE)?;
        let place = pretrained::PLACE.to_owned();
        Ok(Self { card, source: Source::Pretrained, place, is_verified: false })
    }

    /// Returns the folder of the files; those of the program are written into the cache first.
    fn folder(&self, cache: &Path) -> anyhow::Result<PathBuf> {
        if let Source::Folder(folder) = &self.source {
            return Ok(folder.clone());
        }
        let key = format!("model-{}", &sha256(&serde_json::to_vec(&self.card)?)[..32]);
        prepared(cache, &key, |into| {
            for file in &self.card.files {
                write_verified(into, file, &self.bytes(file)?, &self.place)?;
            }
            anyhow::Ok(())
        })
    }

    /// Reads a file as it is.
    fn bytes(&self, file: &FileEntry) -> anyhow::Result<Bytes> {
        match &self.source {
            Source::Folder(folder) => read_listed(&Location::local(folder)?, "", file, &self.place),
            Source::Pretrained => pretrained::file(file.name.name())
                .with_context(|| format!("{} has no file {}", self.place, file.name)),
        }
    }

    /// Makes an engine: onnxruntime's or ours, and what to tell of the choice.
    ///
    /// # Errors
    /// When the engine that was asked for cannot be had, or a file is not what the card says.
    pub fn engine(
        &self,
        params: &EngineParams,
        n_workers: NonZeroUsize,
    ) -> anyhow::Result<(Box<dyn Engine>, Option<String>)> {
        let n_workers = n_workers.min(params.threads);
        let n_threads =
            NonZeroUsize::new(params.threads.get() / n_workers.get()).unwrap_or(NonZeroUsize::MIN);
        let eager = || -> anyhow::Result<Box<dyn Engine>> {
            Ok(Box::new(self.eager(n_workers, n_threads)?))
        };
        // What the program has in itself needs nothing beside it.
        let needs_nothing =
            params.engine == EngineChoice::Auto && matches!(self.source, Source::Pretrained);
        if params.engine == EngineChoice::Eager || needs_nothing {
            return Ok((eager()?, None));
        }
        let asked = Device::from_environment()?;
        let runtime = match Runtime::load(params.ort_lib.as_deref()) {
            Err(OnnxError::NoRuntime { .. }) if params.engine == EngineChoice::Auto => {
                let note = "onnxruntime was not found, so the model runs in the eager engine; `make setup` \
                            obtains it";
                return Ok((eager()?, Some(note.to_owned())));
            }
            loaded => loaded?,
        };
        let (device, note) = asked.chosen(&runtime);
        let plan = SessionPlan { n_workers: n_workers.get(), n_threads: n_threads.get(), device };
        Ok((Box::new(self.onnx(&runtime, plan, &params.cache())?), note))
    }

    /// Makes the engine of our own interpreter, with the weights that the files have.
    ///
    /// # Errors
    /// When a file is not what the card says.
    pub fn eager(
        &self,
        n_workers: NonZeroUsize,
        n_threads: NonZeroUsize,
    ) -> anyhow::Result<EagerEngine> {
        let card = &self.card;
        let (_, list) = UNet1D::new(&card.unet);
        let unet_parameters =
            self.parameters(ModelFileName::Unet, ModelFileName::UnetWeights, list)?;
        let (decoder, list) = MotionDecoder::new(&card.decoder);
        let decoder_parameters =
            self.parameters(ModelFileName::Decoder, ModelFileName::DecoderWeights, list)?;
        let engine = EagerEngine::new(
            (&card.unet, unet_parameters),
            (decoder, decoder_parameters),
            &card.feature_scale,
            (n_workers, n_threads),
        );
        engine.context("while starting threads")
    }

    /// Makes the engine of our own interpreter with the networks' first weights, of seed 0, as if nothing had
    /// been learned.
    ///
    /// The UNet's last convolution begins at zero, so that a fresh network predicts the same for every input
    /// and what is sampled from it hardly moves. Here layers that begin at zero are drawn like all others of
    /// their kind ([`ParameterList::without_zero_layers`]). The decoder has its first weights as well; the
    /// scales of channels and features are the model's.
    ///
    /// # Errors
    /// When the system gives no threads.
    pub fn untrained(
        &self,
        n_workers: NonZeroUsize,
        n_threads: NonZeroUsize,
    ) -> anyhow::Result<EagerEngine> {
        let card = &self.card;
        let first = |list: ParameterList| Parameters::new(list.without_zero_layers(), 0);
        let (_, list) = UNet1D::new(&card.unet);
        let unet_parameters = first(list);
        let (decoder, list) = MotionDecoder::new(&card.decoder);
        let engine = EagerEngine::new(
            (&card.unet, unet_parameters),
            (decoder, first(list)),
            &card.feature_scale,
            (n_workers, n_threads),
        );
        engine.context("while starting threads")
    }

    fn parameters(
        &self,
        name: ModelFileName,
        weights_name: ModelFileName,
        list: ParameterList,
    ) -> anyhow::Result<Parameters<f32>> {
        let (model, place) = self.graph(name, weights_name)?;
        // Looked up first, since filling cannot fail.
        for (_, parameter) in list.iter() {
            values_of(&model, parameter, &place)?;
        }
        let values = |parameter: &crate::model::Parameter| {
            values_of(&model, parameter, &place).expect("looked up before")
        };
        Ok(Parameters::from_fn(list, values))
    }

    /// Reads a network, and what messages call its file.
    fn graph(
        &self,
        name: ModelFileName,
        weights_name: ModelFileName,
    ) -> anyhow::Result<(Model, String)> {
        let bytes = self.read(name)?;
        let has_weights = self.card.files.iter().any(|file| file.name == weights_name);
        let weights = if has_weights { Some(self.read(weights_name)?) } else { None };
        let place = format!("{}/{name}", self.place);
        Ok((Model::read(bytes, weights.as_ref(), &place)?, place))
    }

    /// Refuses a network that is not made as this program makes them: onnxruntime runs whatever a file says.
    fn check_graph(&self, name: ModelFileName, weights_name: ModelFileName) -> anyhow::Result<()> {
        let (model, place) = self.graph(name, weights_name)?;
        Ok(check(&model, &place)?)
    }

    /// Reads a file and holds it against the card.
    fn read(&self, name: ModelFileName) -> anyhow::Result<Bytes> {
        let entry = self.card.file(name, &self.place)?;
        let bytes = self.bytes(entry)?;
        if !self.is_verified {
            verify(entry, &sha256(&bytes), &self.place)?;
        }
        Ok(bytes)
    }

    /// Makes the engine of onnxruntime; on a processor from a copy of the UNet that was optimised once.
    ///
    /// # Errors
    /// When a file is not what the card says, or onnxruntime refuses it.
    pub fn onnx(
        &self,
        runtime: &Runtime,
        plan: SessionPlan,
        cache: &Path,
    ) -> anyhow::Result<OnnxEngine> {
        let config = &self.card.unet;
        let folder = self.folder(cache)?;
        let unet = folder.join(file_names::UNET);
        let decoder = folder.join(file_names::DECODER);
        let check_unet = || self.check_graph(ModelFileName::Unet, ModelFileName::UnetWeights);
        self.check_graph(ModelFileName::Decoder, ModelFileName::DecoderWeights)?;
        // Files are looked through while onnxruntime loads what it has of them already.
        std::thread::scope(|scope| {
            let verified = scope.spawn(|| self.verify());
            let opened = (|| {
                if plan.device != Device::Cpu {
                    check_unet()?;
                    return Ok(OnnxEngine::open(runtime, (&unet, false), &decoder, config, plan)?);
                }
                let entry = self.card.file(ModelFileName::Unet, &self.place)?;
                let key = format!(
                    "optimized-{}",
                    &sha256(
                        format!(
                            "{}\n{PINNED_VERSION}\n{}\n{}",
                            entry.sha256,
                            runtime.build(),
                            processor()
                        )
                        .as_bytes()
                    )[..32]
                );
                let optimized = prepared(cache, &key, |into| {
                    // What is kept must come from the file that the card names.
                    self.verify()?;
                    check_unet()?;
                    Ok::<_, anyhow::Error>(Session::optimize(
                        runtime,
                        &unet,
                        &into.join(file_names::UNET),
                    )?)
                })?;
                let unet = optimized.join(file_names::UNET);
                Ok(OnnxEngine::open(runtime, (&unet, true), &decoder, config, plan)?)
            })();
            // A file that was changed explains whatever else went wrong.
            verified.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
            opened
        })
    }

    /// Holds every file against the card.
    fn verify(&self) -> anyhow::Result<()> {
        if self.is_verified {
            return Ok(());
        }
        for file in &self.card.files {
            verify(file, &sha256(&self.bytes(file)?), &self.place)?;
        }
        Ok(())
    }
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
    Sha256::digest(bytes).iter().fold(String::with_capacity(64), |mut text, byte| {
        // Writing to a string cannot fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

/// Returns what tells this processor from others: a model that is optimised for one may not run on another.
fn processor() -> String {
    let known = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let first_group = known.lines().take_while(|line| !line.is_empty());
    let mut told: Vec<&str> = first_group
        .filter(|line| ["model name", "flags", "Features"].iter().any(|key| line.starts_with(key)))
        .collect();
    told.push(std::env::consts::ARCH);
    told.push(std::env::consts::OS);
    told.join("\n")
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
