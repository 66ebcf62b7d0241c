//! A model's folder, opened to be run.

use std::num::NonZeroUsize;
use std::path::{Path, PathBuf};

use anyhow::Context as _;

pub use super::model_folder::{
    ModelFolder, POINTER, current_folder, folder_of, is_model_name, pointer_to, sha256, sha256_of,
    shipped_as,
};
use super::{RARE, all_threads};
use crate::autodiff::Parameters;
use crate::generation::{
    EagerEngine, Engine, FamilyCard as _, ModelCard, ModelFileName, OnnxEngine, SessionPlan,
    file_names,
};
use crate::model::{MotionDecoder, ParameterList, UNet1D};
use crate::onnx::{Device, Model, OnnxError, PINNED_VERSION, Runtime, Session, check, values_of};
use crate::store::{Location, prepared};

/// The engine of a model.
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
    #[arg(long, value_enum, default_value_t = EngineChoice::Auto, help_heading = "Engine",
          hide_short_help = RARE)]
    pub engine: EngineChoice,
    /// Library of onnxruntime [default: ORT_DYLIB_PATH, else beside the program, in .runtime, of the system]
    #[arg(long, value_name = "FILE", help_heading = "Engine", hide_short_help = RARE)]
    pub ort_lib: Option<PathBuf>,
    /// Threads in all.
    #[arg(long, value_name = "N", default_value_t = all_threads(), help_heading = "Engine",
          hide_short_help = RARE)]
    pub threads: NonZeroUsize,
    /// Folder for models as this machine's processor likes them [default: ~/.cache/motiongen]
    #[arg(long, value_name = "DIR", help_heading = "Engine", hide_short_help = RARE)]
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

/// A model of one dancer whose files are at hand on this machine.
pub struct OpenModel {
    pub card: ModelCard,
    files: ModelFolder,
}

impl OpenModel {
    /// Opens a model of a store, and fetches its files if the store is far away.
    ///
    /// # Errors
    /// One sentence about what is missing or of another kind.
    pub fn of_store(store: &Location, name: &str, cache: &Path) -> anyhow::Result<Self> {
        Self::of(ModelFolder::of_store(store, name, cache)?)
    }

    /// Reads the card of a model.
    ///
    /// # Errors
    /// A card of another family, or none.
    pub fn of(files: ModelFolder) -> anyhow::Result<Self> {
        let card = ModelCard::read(files.card_bytes(), files.card_place())?;
        Ok(Self { card, files })
    }

    /// Makes an engine: onnxruntime's or ours, and what to tell of the choice.
    ///
    /// # Errors
    /// When the engine that was asked for cannot be had, or a file is not the one that the card lists.
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
        let needs_nothing = params.engine == EngineChoice::Auto && self.files.is_shipped();
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
    /// When a file is not the one that the card lists.
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
        let bytes = self.files.read(name)?;
        let has_weights = self.card.files.iter().any(|file| file.name == weights_name);
        let weights = if has_weights { Some(self.files.read(weights_name)?) } else { None };
        let place = self.files.place_of(name);
        Ok((Model::read(bytes, weights.as_ref(), &place)?, place))
    }

    /// Refuses a network that is not made as this program makes them: onnxruntime runs whatever a file says.
    fn check_graph(&self, name: ModelFileName, weights_name: ModelFileName) -> anyhow::Result<()> {
        let (model, place) = self.graph(name, weights_name)?;
        Ok(check(&model, &place)?)
    }

    /// Makes the engine of onnxruntime; on a processor from a copy of the UNet that was optimised once.
    ///
    /// # Errors
    /// When a file is not the one that the card lists, or onnxruntime refuses it.
    pub fn onnx(
        &self,
        runtime: &Runtime,
        plan: SessionPlan,
        cache: &Path,
    ) -> anyhow::Result<OnnxEngine> {
        let config = &self.card.unet;
        let folder = self.files.folder(cache)?;
        let unet = folder.join(file_names::UNET);
        let decoder = folder.join(file_names::DECODER);
        let check_unet = || self.check_graph(ModelFileName::Unet, ModelFileName::UnetWeights);
        self.check_graph(ModelFileName::Decoder, ModelFileName::DecoderWeights)?;
        // Files are looked through while onnxruntime loads what it has of them already.
        std::thread::scope(|scope| {
            let verified = scope.spawn(|| self.files.verify());
            let opened = (|| {
                if plan.device != Device::Cpu {
                    check_unet()?;
                    return Ok(OnnxEngine::open(runtime, (&unet, false), &decoder, config, plan)?);
                }
                let entry = self.files.entry(ModelFileName::Unet)?;
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
                    self.files.verify()?;
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
