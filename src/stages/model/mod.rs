//! `model`: what a network consists of and costs, or what an exported model is.

mod exported;
mod tokens;

use std::io::{self, Write};

use anyhow::ensure;

use super::model_files::{EngineChoice, EngineParams, ModelFolder};
use super::{ClientParams, Contract, Progress, Stage, Summary};
use crate::model::{
    ActivationCounts, DecoderConfig, Family, Layer, MotionDecoder, Outline, Preset, UNet1D,
    UNetConfig, UNetInputs,
};
use crate::store::Location;

/// The stage.
pub struct Model;

/// Which network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Network {
    /// The UNet, which predicts noise
    Unet,
    /// The decoder from a latent to motion, the same for every preset
    Decoder,
}

/// What the user asks for.
#[derive(Clone, Debug, clap::Args)]
pub struct Params {
    /// Size of the network.
    #[arg(long, value_enum, default_value_t = Preset::Base)]
    pub preset: Preset,
    /// The network.
    #[arg(long, value_enum, default_value_t = Network::Unet)]
    pub network: Network,
    /// Frames of a motion, 30 a second.
    #[arg(long, value_name = "N", default_value_t = 120)]
    pub frames: usize,
    /// Motions of a training batch.
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub batch_size: usize,
    /// Folder or bucket of an exported model.
    #[arg(long, value_name = "URL", requires = "model")]
    pub store: Option<String>,
    /// Tell of this exported model instead, of a store or in a folder: what it is, whether its files are whole, how
    /// fast it runs here.
    #[arg(long, value_name = "NAME|DIR", conflicts_with_all = ["preset", "network", "batch_size"])]
    pub model: Option<String>,
    #[command(flatten)]
    pub engine: EngineParams,
    #[command(flatten)]
    pub client: ClientParams,
    /// Keep no copy of the model for this machine's processor; nothing else is ever written.
    #[arg(long)]
    pub dry_run: bool,
}

impl Stage for Model {
    const NAME: &'static str = "model";
    const ABOUT: &'static str =
        "print what a network consists of and costs, or what an exported model is";
    const CONTRACT: Contract =
        Contract { reads: "nothing, or models/<model>/, or a folder", writes: "standard output" };
    type Params = Params;

    fn run(params: Params, progress: &dyn Progress) -> anyhow::Result<Box<dyn Summary>> {
        ensure!(params.frames > 0, "--frames is 0; a motion has at least one frame");
        if let Some(model) = &params.model {
            let open = |url| Location::open(url, &params.client.options());
            let store = params.store.as_deref().map(open).transpose()?;
            let mut engine = params.engine.clone();
            if params.dry_run {
                // The one engine that keeps no prepared copy of a model.
                engine.engine = EngineChoice::Eager;
            }
            let files = ModelFolder::named(model, store.as_ref(), &engine.cache())?;
            return match files.family() {
                Family::Tokens => tokens::look(files, params.frames, &engine, progress),
                _ => exported::look(files, params.frames, &engine, progress),
            };
        }
        ensure!(params.batch_size > 0, "--batch-size is 0; a batch has at least one motion");
        let one = follow(&params, 1, false)?;
        let kept = follow(&params, params.batch_size, false)?.kept;
        let checkpointed = follow(&params, params.batch_size, true)?.kept;
        let name = match params.network {
            Network::Unet => format!("UNet1D, preset {}", params.preset.name()),
            Network::Decoder => "MotionDecoder".to_owned(),
        };
        Ok(Box::new(NetworkSummary { name, params, one, kept, checkpointed }))
    }
}

/// Layers, operations and memory of a network, from following shapes through it.
struct NetworkOutline {
    layers: Vec<Layer>,
    flops: u64,
    kept: ActivationCounts,
    n_parameters: usize,
}

/// Follows shapes through the network for a batch.
fn follow(params: &Params, batch: usize, use_checkpoint: bool) -> anyhow::Result<NetworkOutline> {
    let frames = params.frames;
    let (layers, flops, kept, n_parameters);
    match params.network {
        Network::Unet => {
            let config = UNetConfig { use_checkpoint, ..params.preset.config() };
            let (unet, list) = UNet1D::new(&config);
            let mut g = Outline::new(&list);
            let x = g.input(&[batch, frames, config.in_channels]);
            let audio = g.input(&[batch, frames, config.condition_dim()]);
            let t = g.input(&[batch]);
            let (drop_audio, mask, style) = (Some(&t), None, None);
            let inputs = UNetInputs { x: &x, t: &t, audio: &audio, drop_audio, mask, style };
            unet.forward(&mut g, inputs)?;
            (layers, flops, kept) = (g.layers().to_vec(), g.flops(), g.kept());
            n_parameters = list.n_elements();
        }
        Network::Decoder => {
            let config = DecoderConfig::default();
            let (decoder, list) = MotionDecoder::new(&config);
            let mut g = Outline::new(&list);
            let x = g.input(&[batch, frames, config.input_dim]);
            decoder.forward(&mut g, &x)?;
            (layers, flops, kept) = (g.layers().to_vec(), g.flops(), g.kept());
            n_parameters = list.n_elements();
        }
    }
    Ok(NetworkOutline { layers, flops, kept, n_parameters })
}

/// The account of a network.
struct NetworkSummary {
    name: String,
    params: Params,
    one: NetworkOutline,
    kept: ActivationCounts,
    checkpointed: ActivationCounts,
}

/// Bytes of a number.
const F32: f64 = 4.0;

/// Writes a whole number with its thousands apart.
fn thousands(n: usize) -> String {
    let digits = n.to_string();
    let mut written = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            written.push(',');
        }
        written.push(digit);
    }
    written
}

fn megabytes(numbers: usize) -> String {
    format!("{:.1} MB", numbers as f64 * F32 / 1e6)
}

impl Summary for NetworkSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Params { frames, batch_size, .. } = self.params;
        let width = self.one.layers.iter().map(|layer| layer.name.len()).max().unwrap_or(0);
        writeln!(out, "{}, one motion of {frames} frames\n", self.name)?;
        let head = ["layer", "operation", "shape of the result", "parameters", "MFLOP"];
        let [layer, operation, shape, parameters, mflop] = head;
        writeln!(
            out,
            "{layer:<width$}  {operation:<10}  {shape:<19}  {parameters:>11}  {mflop:>8}"
        )?;
        for layer in &self.one.layers {
            let Layer { name, operation, shape, n_parameters, flops } = layer;
            let shape = format!("{shape:?}");
            let parameters = match n_parameters {
                0 => String::new(),
                n => thousands(*n),
            };
            let mflop = match flops {
                0 => String::new(),
                n => format!("{:.1}", *n as f64 / 1e6),
            };
            writeln!(
                out,
                "{name:<width$}  {operation:<10}  {shape:<19}  {parameters:>11}  {mflop:>8}"
            )?;
        }
        let n = self.one.n_parameters;
        let plain = self.kept.numbers + self.kept.within_part;
        let checkpointed = self.checkpointed.numbers + self.checkpointed.within_part;
        writeln!(out)?;
        writeln!(out, "parameters                      {}  ({})", thousands(n), megabytes(n))?;
        writeln!(out, "one forward                     {:.2} GFLOP", self.one.flops as f64 / 1e9)?;
        writeln!(
            out,
            "a training step, batch {batch_size:<8} {:.1} GFLOP",
            3.0 * self.one.flops as f64 * batch_size as f64 / 1e9
        )?;
        writeln!(out, "\nmemory of training with batch {batch_size}:")?;
        writeln!(out, "  weights, gradients, moments   {}", megabytes(4 * n))?;
        writeln!(out, "  activations                   {}", megabytes(plain))?;
        if self.params.network == Network::Unet {
            writeln!(out, "  activations with checkpoints  {}", megabytes(checkpointed))?;
        }
        Ok(())
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let Params { frames, batch_size, .. } = self.params;
        serde_json::json!({
            "network": self.name,
            "n_parameters": self.one.n_parameters,
            "n_frames": frames,
            "batch_size": batch_size,
            "flops": self.one.flops,
        })
    }
}
