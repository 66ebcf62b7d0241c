//! onnxruntime: where the library lies, which devices it has.
//!
//! The library is loaded when it is first needed, so that everything else works without it.

use std::path::{Path, PathBuf};
use std::sync::Mutex;

use ort::environment::Environment;
use ort::ep::{self, ExecutionProvider, ExecutionProviderDispatch};

use super::error::OnnxError;

/// The version that `make setup` obtains, and that everything was measured with.
pub const PINNED_VERSION: &str = "1.32.0";
/// The oldest version whose interface is used.
const OLDEST_VERSION: &str = "1.24";
/// The variable that names the library, onnxruntime's own.
const LIBRARY_VARIABLE: &str = "ORT_DYLIB_PATH";
/// The variable that names the device.
const DEVICE_VARIABLE: &str = "MOTIONGEN_DEVICE";

/// onnxruntime, loaded.
#[derive(Clone, Debug)]
pub struct Runtime {
    environment: Environment,
    library: PathBuf,
}

/// The onnxruntime that is loaded; a process has one.
static LOADED: Mutex<Option<Runtime>> = Mutex::new(None);

impl Runtime {
    /// Loads the library: `named` (a flag), else `ORT_DYLIB_PATH`, else one beside the executable, in
    /// `.runtime` below the working folder or a folder that holds the executable, or known to the system.
    ///
    /// # Errors
    /// [`OnnxError::NoRuntime`] where none is found, [`OnnxError::BadRuntime`] where one is found that
    /// cannot be loaded or is too old.
    pub fn load(named: Option<&Path>) -> Result<Self, OnnxError> {
        let mut loaded = LOADED.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if let Some(runtime) = &*loaded {
            return Ok(runtime.clone());
        }
        let variable = std::env::var_os(LIBRARY_VARIABLE).filter(|path| !path.is_empty());
        let named = named.map(Path::to_owned).or(variable.map(PathBuf::from));
        let found = named.clone().or_else(|| candidates().into_iter().find(|path| path.is_file()));
        let is_found = found.is_some();
        let library = found.unwrap_or_else(|| PathBuf::from(system_name()));
        let builder = ort::init_from(&library).map_err(|e| match e {
            ort::LoadDynamicError::Dlopen { .. } if !is_found => not_found(),
            ort::LoadDynamicError::BadVersion { version_str, .. } => bad(
                &library,
                format!("it is version {version_str}, {OLDEST_VERSION} or newer is needed"),
            ),
            ort::LoadDynamicError::Dlopen { .. } if !library.exists() => {
                bad(&library, "there is no such file".to_owned())
            }
            ort::LoadDynamicError::Dlopen { .. } => {
                bad(&library, "it is no shared library for this machine".to_owned())
            }
            ort::LoadDynamicError::MissingApi { .. } => {
                bad(&library, "it does not have onnxruntime's interface".to_owned())
            }
            other => bad(&library, other.to_string()),
        })?;
        let builder = builder.with_name(env!("CARGO_PKG_NAME")).with_telemetry(false);
        let environment = builder.build().map_err(|e| bad(&library, e.message().to_owned()))?;
        environment.set_log_level(ort::logging::LogLevel::Error);
        let runtime = Self { environment, library };
        *loaded = Some(runtime.clone());
        Ok(runtime)
    }

    pub(super) fn environment(&self) -> &Environment {
        &self.environment
    }

    /// Returns where the library was found.
    pub fn library(&self) -> &Path {
        &self.library
    }

    /// Returns what tells this build of onnxruntime from others.
    pub fn build(&self) -> String {
        ort::info().to_owned()
    }
}

fn bad(library: &Path, reason: String) -> OnnxError {
    let place = library.display().to_string();
    OnnxError::BadRuntime { place, reason, pinned: PINNED_VERSION }
}

fn not_found() -> OnnxError {
    let looked: Vec<String> = folders().iter().map(|path| path.display().to_string()).collect();
    OnnxError::NoRuntime {
        needed: OLDEST_VERSION.to_owned(),
        name: file_names()[0].clone(),
        looked: format!("{} and where the system looks", looked.join(", ")),
    }
}

fn system_name() -> String {
    format!("{}onnxruntime{}", std::env::consts::DLL_PREFIX, std::env::consts::DLL_SUFFIX)
}

/// The names that the library goes by, of which builds for Linux and macOS carry the version.
fn file_names() -> Vec<String> {
    let plain = system_name();
    match std::env::consts::OS {
        "linux" => vec![plain.clone(), format!("{plain}.1"), format!("{plain}.{PINNED_VERSION}")],
        "macos" => vec![plain, format!("libonnxruntime.{PINNED_VERSION}.dylib")],
        _ => vec![plain],
    }
}

/// The folders that are looked through.
fn folders() -> Vec<PathBuf> {
    let download = Path::new(".runtime").join("onnxruntime").join(PINNED_VERSION);
    let mut folders = Vec::new();
    let executable = std::env::current_exe().ok();
    let beside = executable.as_deref().and_then(Path::parent);
    folders.extend(beside.map(Path::to_owned));
    folders.extend(std::env::current_dir().ok().map(|folder| folder.join(&download)));
    // `target/debug/motiongen` and `target/debug/examples/…` lie in the project's folder.
    let above = beside.map(Path::ancestors).into_iter().flatten().skip(1).take(4);
    folders.extend(above.map(|folder| folder.join(&download)));
    folders.dedup();
    folders
}

fn candidates() -> Vec<PathBuf> {
    let in_folder = |folder: PathBuf| file_names().into_iter().map(move |name| folder.join(name));
    folders().into_iter().flat_map(in_folder).collect()
}

/// The device that a session runs on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Device {
    /// The first of cuda, coreml and directml that the library has, else the processor.
    #[default]
    Auto,
    Cpu,
    Cuda,
    TensorRt,
    CoreMl,
    DirectMl,
}

impl Device {
    const ALL: [Self; 6] =
        [Self::Auto, Self::Cpu, Self::Cuda, Self::TensorRt, Self::CoreMl, Self::DirectMl];

    /// Returns the name that `MOTIONGEN_DEVICE` uses.
    pub fn name(self) -> &'static str {
        match self {
            Self::Auto => "auto",
            Self::Cpu => "cpu",
            Self::Cuda => "cuda",
            Self::TensorRt => "tensorrt",
            Self::CoreMl => "coreml",
            Self::DirectMl => "directml",
        }
    }

    /// Reads `MOTIONGEN_DEVICE`; auto where it is not set.
    ///
    /// # Errors
    /// [`OnnxError::Device`] for a name that is none.
    pub fn from_environment() -> Result<Self, OnnxError> {
        let Some(found) = std::env::var(DEVICE_VARIABLE).ok().filter(|name| !name.is_empty())
        else {
            return Ok(Self::Auto);
        };
        Self::ALL.into_iter().find(|device| device.name() == found).ok_or_else(|| {
            let known = Self::ALL.map(Self::name).join(", ");
            OnnxError::Device { found, known }
        })
    }

    /// Returns whether the loaded library was built for a device.
    fn is_available(self) -> bool {
        match self {
            Self::Auto | Self::Cpu => true,
            Self::Cuda => ep::CUDA::is_available().unwrap_or(false),
            Self::TensorRt => ep::TensorRT::is_available().unwrap_or(false),
            Self::CoreMl => ep::CoreML::is_available().unwrap_or(false),
            Self::DirectMl => ep::DirectML::is_available().unwrap_or(false),
        }
    }

    /// Returns the device that will be used, and what to say where it is not the one that was asked for.
    pub fn chosen(self, _runtime: &Runtime) -> (Self, Option<String>) {
        match self {
            Self::Auto => {
                let fast = [Self::Cuda, Self::CoreMl, Self::DirectMl];
                (fast.into_iter().find(|d| d.is_available()).unwrap_or(Self::Cpu), None)
            }
            asked if asked.is_available() => (asked, None),
            asked => {
                let has: Vec<&str> = Self::ALL[1..]
                    .iter()
                    .filter(|device| device.is_available())
                    .map(|device| device.name())
                    .collect();
                let note = format!(
                    "this onnxruntime was not built for {} (it has {}); using cpu",
                    asked.name(),
                    has.join(", ")
                );
                (Self::Cpu, Some(note))
            }
        }
    }

    /// Returns onnxruntime's providers for a device; the processor needs none.
    pub(super) fn providers(self) -> Vec<ExecutionProviderDispatch> {
        match self {
            Self::Auto | Self::Cpu => Vec::new(),
            Self::Cuda => vec![ep::CUDA::default().build()],
            Self::TensorRt => vec![ep::TensorRT::default().build(), ep::CUDA::default().build()],
            Self::CoreMl => vec![ep::CoreML::default().build()],
            Self::DirectMl => vec![ep::DirectML::default().build()],
        }
    }
}
