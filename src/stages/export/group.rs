//! A run of the family `group` becomes a model: a denoiser and a score, checked through onnxruntime.

use std::collections::BTreeMap;
use std::io::{self, Write};
use std::num::NonZeroUsize;

use anyhow::{Context as _, bail};
use bytes::Bytes;
use ndarray::Array3;
use serde_json::json;

use super::checks::{CheckResults, FORWARD_TOLERANCE, difference, timed};
use super::files::weights_sha256;
use super::{Export, MAX_TRAIN_PHRASES, Params, card_path, motion_range, publish, record, tuning};
use crate::audio::FEATURE_DIM;
use crate::autodiff::{Arena, Eager, Interpreter as _, Parameters, Stream};
use crate::diffusion::Schedule;
use crate::generation::{
    FileEntry, GroupCard, GroupEngine, GroupProvenance, ModelFileName, own_channels, own_features,
};
use crate::model::{
    Family, GroupInputs, GroupNetworks, GroupScoreInputs, ParameterId, ParameterList,
};
use crate::motion::{CLOCK_DIM, MOTION_DIM};
use crate::onnx::{
    Device, EncodedModel, GroupNames, GroupScoreNames, Model, ModelFile, NamedTensor, Numbers,
    Runtime, Session, SessionOptions, check, group_denoiser, group_score, values_of,
};
use crate::stages::learned;
use crate::stages::model_files::{folder_of, sha256};
use crate::stages::train::session::{ProgressWatch, read_phrases};
use crate::stages::{Progress, Stage as _, Summary, lease};
use crate::store::tables::OnnxCheckRow;
use crate::store::{Location, TimestampUs, checkpoint, write_file};
use crate::training::{
    CheckpointKind, Checkpoints, GROUP, GroupLearner, GroupTrainConfig, Learner as _, State,
    TrainingError,
};
use crate::units::FPS;

/// Returns whether a run is one of the family `group`.
///
/// # Errors
/// When the store cannot be listed.
pub fn is_of_group(store: &Location, run: &str) -> anyhow::Result<bool> {
    let checkpoints = Checkpoints::new(store, run, GroupLearner::STAGE);
    Ok(!checkpoints.steps(CheckpointKind::Best)?.is_empty())
}

/// Runs the stage.
///
/// # Errors
/// What export says of a run of any family.
pub fn run(
    params: &Params,
    store: &Location,
    progress: &dyn Progress,
) -> anyhow::Result<Box<dyn Summary>> {
    let trained = TrainedGroup::read(store, &params.run)?;
    let machine = &params.machine;
    let watch = ProgressWatch(progress);
    let (most, is_dry_run) = (Some(MAX_TRAIN_PHRASES), params.dry_run);
    let phrases = read_phrases(
        store,
        Export::NAME,
        (machine, Family::Group),
        most,
        progress,
        &watch,
        is_dry_run,
    )?;
    let data = &trained.state.data;
    let learned_from = learned::of_group(store, &params.run, data, machine, progress, is_dry_run)?;
    let network = &trained.state.config.network;
    let scales = &trained.state.scales;
    let engine = GroupEngine::new(
        &network.group,
        trained.parameters.clone(),
        &scales.features,
        (NonZeroUsize::MIN, machine.threads),
    )
    .context("while starting threads")?;
    let dataset = &phrases.dataset;
    let sampling =
        tuning::group_sampling_defaults(&engine, network, &scales.motion, dataset, progress)?;
    drop(engine);
    let range = motion_range(dataset)?;
    let mut card = GroupCard {
        format: GroupCard::own_format(),
        family: Family::Group,
        name: params.model.clone(),
        program: format!("{} {}", env!("CARGO_PKG_NAME"), env!("CARGO_PKG_VERSION")),
        provenance: GroupProvenance {
            run: params.run.clone(),
            step: trained.step,
            validation_loss: trained.state.progress.best.map(|best| best.loss),
            data: data.clone(),
            learned_from,
        },
        precision: params.precision,
        group: network.group.clone(),
        diffusion: network.diffusion.clone(),
        alphas_cumprod: {
            let schedule = Schedule::new(&network.diffusion)?;
            (0..schedule.len()).map(|t| schedule.alpha_bar(t)).collect()
        },
        n_parameters: trained.parameters.list().n_elements(),
        weights_sha256: weights_sha256(&trained.parameters),
        window_frames: network.window_frames,
        fps: FPS,
        channels: own_channels(),
        features: own_features(),
        normalizer: scales.motion.clone(),
        feature_scale: scales.features.clone(),
        motion_range: range,
        sampling,
        licence: params.licence.clone(),
        files: Vec::new(),
    };
    let files = files(&trained, params, &card)?;
    card.files = files
        .iter()
        .map(|(name, bytes)| FileEntry {
            name: *name,
            n_bytes: bytes.len() as u64,
            sha256: sha256(bytes),
        })
        .collect();
    let mut text = serde_json::to_vec_pretty(&card)?;
    text.push(b'\n');
    let card_text = Bytes::from(text);
    let place = store.url_of(&folder_of(&params.model));
    let told = |is_up_to_date, checks| {
        let (card, place) = (card.clone(), place.clone());
        Box::new(GroupExportSummary { card, place, checks, is_up_to_date, is_dry_run })
    };
    if is_dry_run {
        return Ok(told(false, Vec::new()));
    }
    let (folder, what) = (folder_of(&params.model), format!("model {}", params.model));
    let (lease, _) = lease::take(store, &folder, &what, &|text| progress.note(text))?;
    match store.read_if_there(&card_path(store, &params.model)?)? {
        Some(there) if there == card_text => return Ok(told(true, Vec::new())),
        Some(_) if !params.force => bail!(
            "store {store} has a model \"{}\" of other weights or settings; give another --model name, or \
             replace it with --force",
            params.model
        ),
        _ => {}
    }
    let runtime = Runtime::load(params.ort_lib.as_deref())?;
    let results = checks(&trained, params, &files, &runtime)?;
    progress.is_interrupted();
    record(store, params, &card_text, &results)?;
    checkpoint(store, &[Export::NAME]);
    results.require(&params.model)?;
    lease.check()?;
    publish(store, &params.model, (&files, &card_text))?;
    Ok(told(false, results.rows))
}

/// A run that was trained.
struct TrainedGroup {
    state: State<GroupTrainConfig>,
    parameters: Parameters<f32>,
    step: u64,
}

impl TrainedGroup {
    fn read(store: &Location, run: &str) -> Result<Self, TrainingError> {
        let checkpoints = Checkpoints::new(store, run, GroupLearner::STAGE);
        let Some(&step) = checkpoints.steps(CheckpointKind::Best)?.last() else {
            let way_out = format!("run motiongen train --family group --run {run} first");
            let (run, what) = (run.to_owned(), "trained denoiser of groups");
            return Err(TrainingError::Missing { run, what, way_out });
        };
        checkpoints.read(CheckpointKind::Best, step, |archive, place| {
            let state: State<GroupTrainConfig> = State::of(archive, place)?;
            let (_, list) = GroupNetworks::new(&state.config.network.group);
            let place = place.to_owned();
            let parameters = archive
                .section(GROUP, list)
                .map_err(|source| TrainingError::Weights { place, source })?;
            Ok(Self { state, parameters, step })
        })
    }

    /// Returns the values of a parameter of one of the two networks.
    fn values(&self, is_denoiser: bool, list: &ParameterList, id: ParameterId) -> Vec<f32> {
        let name = &list.get(id).name;
        let mut all = self.parameters.list().iter();
        let found = all.find(|(_, p)| GroupNetworks::own_name(&p.name) == (is_denoiser, name));
        let (id, _) = found.expect("invariant: both networks are in the list");
        self.parameters.unpacked(id)
    }
}

/// Writes both networks down, and checks them against the rules of the format.
fn files(
    trained: &TrainedGroup,
    params: &Params,
    card: &GroupCard,
) -> anyhow::Result<Vec<(ModelFileName, Bytes)>> {
    let (config, storage) = (&card.group, params.precision);
    let (_, list) = crate::model::GroupDenoiser::new(config);
    let weights = |id: ParameterId| trained.values(true, &list, id);
    let denoiser = group_denoiser(config, &weights, &card.feature_scale, storage)?;
    let (_, list) = crate::model::GroupScore::new(config);
    let weights = |id: ParameterId| trained.values(false, &list, id);
    let score = group_score(config, &weights, storage)?;
    let entries = [
        ("model", card.name.clone()),
        ("family", card.family.name().to_owned()),
        ("run", card.provenance.run.clone()),
        ("data", card.provenance.data.clone()),
        ("licence", card.licence.clone()),
        ("precision", card.precision.name().to_owned()),
        ("fps", card.fps.to_string()),
        ("window_frames", card.window_frames.to_string()),
        ("channels", card.channels.join(",")),
        ("features", card.features.join(",")),
        ("diffusion", serde_json::to_string(&card.diffusion)?),
        ("normalizer", serde_json::to_string(&card.normalizer)?),
        ("group", serde_json::to_string(&card.group)?),
        ("weights_sha256", card.weights_sha256.clone()),
    ];
    let metadata: BTreeMap<String, String> =
        entries.into_iter().map(|(key, value)| (format!("motiongen.{key}"), value)).collect();
    let mut files = Vec::new();
    for (graph, name) in [(denoiser, ModelFileName::Denoiser), (score, ModelFileName::Score)] {
        let description = format!("{} of {}, by {}", graph.name, card.name, card.program);
        let file = ModelFile { graph, metadata: metadata.clone(), description };
        // The largest preset has 250 MB.
        let EncodedModel { model, .. } = file.encode("", usize::MAX);
        let read = Model::read(model.clone(), None, name.name())?;
        check(&read, name.name()).map_err(|e| anyhow::anyhow!("{e}; please report this"))?;
        files.push((name, model));
    }
    Ok(files)
}

/// Groups that both engines are asked about.
#[derive(Clone, Copy)]
struct Case {
    n_groups: usize,
    n_dancers: usize,
    n_frames: usize,
}

/// Holds the files against the interpreter that trained the networks.
fn checks(
    trained: &TrainedGroup,
    params: &Params,
    files: &[(ModelFileName, Bytes)],
    runtime: &Runtime,
) -> anyhow::Result<CheckResults> {
    let folder = tempfile::tempdir().context("while making a temporary folder")?;
    let options = SessionOptions {
        n_threads: params.machine.threads.get(),
        is_alone: true,
        device: Device::Cpu,
        is_optimized: false,
    };
    let mut sessions = Vec::new();
    for (name, bytes) in files {
        let path = folder.path().join(name.name());
        write_file(&path, |out| out.write_all(bytes))
            .with_context(|| format!("while writing {}", path.display()))?;
        sessions.push(Session::open(runtime, &path, options)?);
    }
    let [denoiser, score] = &mut sessions[..] else { unreachable!("two files are written") };
    let network = &trained.state.config.network;
    let (networks, list) = GroupNetworks::new(&network.group);
    let parameters = read_back(files, list)?;
    let arena = Arena::default();
    let window = network.window_frames;
    let n_steps = network.diffusion.n_steps;
    let mut rows = Vec::new();
    for case in [
        Case { n_groups: 1, n_dancers: 5, n_frames: window },
        Case { n_groups: 3, n_dancers: 2, n_frames: window },
        Case { n_groups: 2, n_dancers: 3, n_frames: window / 2 + 17 },
        Case { n_groups: 1, n_dancers: 16, n_frames: 31 },
    ] {
        let given = CheckInputs::new(case, &network.group, n_steps);
        let (found, onnx_s) = timed(|| denoiser.run(&given.of_denoiser(), GroupNames::X0))?;
        let (w, _) = timed(|| denoiser.run(&given.of_denoiser(), GroupNames::W))?;
        let (wanted, eager_s) = timed(|| given.estimate(&networks, &parameters, &arena, trained))?;
        let apart = difference(&found.1, &wanted);
        rows.push((case, "forward", apart, onnx_s, eager_s));
        let (found, onnx_s) =
            timed(|| score.run(&given.of_score(&wanted, &w.1), GroupScoreNames::LOG_RATIO))?;
        let (logits, eager_s) =
            timed(|| given.score(&networks, &parameters, &arena, &wanted, &w.1))?;
        rows.push((case, "score", difference(&found.1, &logits), onnx_s, eager_s));
    }
    let build = runtime.build();
    let row = |(case, name, apart, onnx_s, eager_s): (
        Case,
        &str,
        super::checks::Difference,
        f64,
        f64,
    )| {
        OnnxCheckRow {
            model: params.model.clone(),
            run: params.run.clone(),
            check: name.to_owned(),
            precision: params.precision.name().to_owned(),
            n_samples: (case.n_groups * case.n_dancers) as i32,
            n_frames: case.n_frames as i32,
            n_steps: None,
            guidance: None,
            max_abs: apart.max_abs,
            rms: apart.rms,
            tolerance: FORWARD_TOLERANCE,
            passed: apart.max_abs <= FORWARD_TOLERANCE,
            onnx_s: Some(onnx_s),
            eager_s,
            runtime: build.clone(),
            time: TimestampUs::now(),
        }
    };
    let rows = rows.into_iter().map(row).collect();
    Ok(CheckResults { rows, runtime: runtime.build() })
}

/// Reads weights out of the files, as the engine does.
fn read_back(
    files: &[(ModelFileName, Bytes)],
    list: ParameterList,
) -> anyhow::Result<Parameters<f32>> {
    let model = |i: usize| Model::read(files[i].1.clone(), None, files[i].0.name());
    let models = [model(0)?, model(1)?];
    let values = |p: &crate::model::Parameter| {
        let (is_denoiser, name) = GroupNetworks::own_name(&p.name);
        let own = crate::model::Parameter { name: name.to_owned(), ..p.clone() };
        let i = usize::from(!is_denoiser);
        values_of(&models[i], &own, files[i].0.name())
    };
    for (_, parameter) in list.iter() {
        values(parameter)?;
    }
    Ok(Parameters::from_fn(list, |p| values(p).expect("looked up before")))
}

/// Numbers that both engines are given.
struct CheckInputs {
    case: Case,
    width: usize,
    has_clock: bool,
    number: usize,
    x: Vec<f32>,
    t: Vec<usize>,
    features: Vec<f32>,
    clock: Vec<f32>,
    z: Vec<f32>,
}

impl CheckInputs {
    fn new(case: Case, config: &crate::model::GroupConfig, n_steps: usize) -> Self {
        let Case { n_groups, n_dancers, n_frames } = case;
        let normal = |n: usize, seed: u64| {
            let mut values = vec![0.0; n];
            Stream::new(seed, 0).normal(0, &mut values);
            values
        };
        Self {
            case,
            width: config.width,
            has_clock: config.clock,
            number: config.embedded_number(n_dancers),
            x: normal(n_groups * n_dancers * n_frames * MOTION_DIM, 11),
            t: (0..n_groups).map(|i| (i + 1) * (n_steps - 1) / n_groups).collect(),
            features: normal(n_groups * n_frames * FEATURE_DIM, 12),
            clock: normal(n_groups * n_frames * CLOCK_DIM, 13),
            z: normal(n_groups * config.width, 14),
        }
    }

    fn t_dancers(&self) -> Vec<usize> {
        self.t.iter().flat_map(|&t| std::iter::repeat_n(t, self.case.n_dancers)).collect()
    }

    fn of_denoiser(&self) -> Vec<NamedTensor<'_>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        let mut inputs = vec![
            floats(GroupNames::X, &[n_groups * n_dancers, n_frames, MOTION_DIM], &self.x),
            whole(GroupNames::T, &self.t),
            floats(GroupNames::AUDIO, &[n_groups, n_frames, FEATURE_DIM], &self.features),
            whole(GroupNames::NUMBER, &vec![self.number; n_groups]),
            floats(GroupNames::Z, &[n_groups, self.width], &self.z),
        ];
        if self.has_clock {
            inputs.push(floats(GroupNames::CLOCK, &[n_groups, n_frames, CLOCK_DIM], &self.clock));
        }
        inputs
    }

    fn of_score<'a>(&'a self, x0: &'a [f32], w: &'a [f32]) -> Vec<NamedTensor<'a>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        vec![
            floats(GroupScoreNames::X0, &[n_groups * n_dancers, n_frames, MOTION_DIM], x0),
            whole(GroupScoreNames::T, &self.t_dancers()),
            floats(GroupScoreNames::W, &[n_groups, self.width], w),
            whole(GroupScoreNames::NUMBER, &vec![self.number; n_groups]),
        ]
    }

    fn estimate(
        &self,
        networks: &GroupNetworks,
        parameters: &Parameters<f32>,
        arena: &Arena<f32>,
        trained: &TrainedGroup,
    ) -> anyhow::Result<Vec<f32>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        let mut features =
            Array3::from_shape_vec((n_groups, n_frames, FEATURE_DIM), self.features.clone())?;
        let rows = features.view_mut().into_shape_with_order((n_groups * n_frames, FEATURE_DIM))?;
        trained.state.scales.features.apply(rows);
        let mut heard = Vec::new();
        for (row, clock) in features.rows().into_iter().zip(self.clock.chunks_exact(CLOCK_DIM)) {
            heard.extend(row);
            heard.extend(clock.iter().filter(|_| self.has_clock));
        }
        let dim = heard.len() / (n_groups * n_frames);
        let mut g = Eager::new(parameters, arena);
        let of_groups = |values: Vec<f32>, g: &Eager<f32>| g.constant(&[n_groups], &values);
        let x = g.constant(&[n_groups * n_dancers, n_frames, MOTION_DIM], &self.x);
        let t = of_groups(self.t.iter().map(|&t| t as f32).collect(), &g);
        let audio = g.constant(&[n_groups, n_frames, dim], &heard);
        let number = of_groups(vec![self.number as f32; n_groups], &g);
        let z = g.constant(&[n_groups, self.width], &self.z);
        let inputs = GroupInputs {
            x: &x,
            t: &t,
            audio: &audio,
            drop_audio: None,
            number: &number,
            z: &z,
            mask: None,
        };
        Ok(networks.denoiser.forward(&mut g, &inputs)?.x0.data().to_vec())
    }

    fn score(
        &self,
        networks: &GroupNetworks,
        parameters: &Parameters<f32>,
        arena: &Arena<f32>,
        x0: &[f32],
        w: &[f32],
    ) -> anyhow::Result<Vec<f32>> {
        let Case { n_groups, n_dancers, n_frames } = self.case;
        let mut g = Eager::new(parameters, arena);
        let x0 = g.constant(&[n_groups * n_dancers, n_frames, MOTION_DIM], x0);
        let t: Vec<f32> = self.t_dancers().iter().map(|&t| t as f32).collect();
        let t = g.constant(&[t.len()], &t);
        let w = g.constant(&[n_groups, self.width], w);
        let number = g.constant(&[n_groups], &vec![self.number as f32; n_groups]);
        let inputs = GroupScoreInputs { x0: &x0, t: &t, w: &w, number: &number, mask: None };
        Ok(networks.score.forward(&mut g, &inputs)?.data().to_vec())
    }
}

fn floats<'a>(name: &'static str, shape: &[usize], numbers: &'a [f32]) -> NamedTensor<'a> {
    NamedTensor { name, shape: shape.to_vec(), numbers: Numbers::Float(numbers.into()) }
}

fn whole(name: &'static str, numbers: &[usize]) -> NamedTensor<'static> {
    let numbers: Vec<i64> = numbers.iter().map(|&n| n as i64).collect();
    NamedTensor { name, shape: vec![numbers.len()], numbers: Numbers::Integer(numbers.into()) }
}

/// The account of an export of a model of groups.
struct GroupExportSummary {
    card: GroupCard,
    place: String,
    checks: Vec<OnnxCheckRow>,
    is_up_to_date: bool,
    is_dry_run: bool,
}

impl Summary for GroupExportSummary {
    fn write(&mut self, out: &mut dyn Write) -> io::Result<()> {
        let Self { card, place, checks, is_up_to_date, is_dry_run } = self;
        if *is_dry_run {
            let size = |f: &FileEntry| format!("{} ({:.1} MB)", f.name, f.n_bytes as f64 / 1e6);
            let sizes: Vec<String> = card.files.iter().map(size).collect();
            let GroupProvenance { run, step, .. } = &card.provenance;
            let sizes = sizes.join(" and ");
            return writeln!(
                out,
                "would check and write {sizes} of run {run} (step {step}) to {place}"
            );
        }
        super::report::write_checks(out, checks)?;
        let note = if *is_up_to_date { ", up to date" } else { "" };
        writeln!(out, "model {}{note} → {place}", card.name)?;
        for file in &card.files {
            let mb = file.n_bytes as f64 / 1e6;
            writeln!(out, "  {:<20} {mb:>8.1} MB  {}", file.name, &file.sha256[..16])?;
        }
        writeln!(
            out,
            "  {} parameters, {}, of run {} (family {}, step {})",
            card.n_parameters,
            card.precision.name(),
            card.provenance.run,
            card.family.name(),
            card.provenance.step
        )
    }

    fn n_failed(&self) -> u64 {
        0
    }

    fn figures(&mut self) -> serde_json::Value {
        let files = self.card.files.iter().map(
            |file| json!({ "name": file.name, "n_bytes": file.n_bytes, "sha256": file.sha256 }),
        );
        json!({
            "model": self.card.name,
            "family": self.card.family.name(),
            "to": self.place,
            "run": self.card.provenance.run,
            "precision": self.card.precision.name(),
            "files": files.collect::<Vec<_>>(),
            "is_up_to_date": self.is_up_to_date,
            "dry_run": self.is_dry_run,
            "n_checks": self.checks.len(),
        })
    }
}
