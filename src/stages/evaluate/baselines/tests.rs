use std::collections::BTreeMap;
use std::path::Path;

use ndarray::Array2;

use super::*;
use crate::audio::FeatureScale;
use crate::autodiff::{Parameters, Stream};
use crate::diffusion::{DiffusionConfig, Prediction};
use crate::generation::{
    Engine as _, EngineInputs, FileEntry, MODEL_FORMAT, ModelFileName, Networks, Provenance,
    file_names, own_channels, own_features,
};
use crate::model::{DecoderConfig, MotionDecoder, ParameterList, UNet1D, UNetConfig};
use crate::motion::Normalizer;
use crate::motion::style_name::NamedStyles;
use crate::onnx::{EMBEDDED_BYTES, Form, ModelFile, Storage, decoder, unet};
use crate::stages::Silent;
use crate::stages::generate::weights_digest;
use crate::stages::model_files::{ModelFolder, sha256};
use crate::store::TimestampUs;
use crate::units::FPS;

/// Frames of a window of the model.
const WINDOW: usize = 24;

fn unet_config() -> UNetConfig {
    UNetConfig {
        widths: vec![8, 12],
        attention_levels: vec![1],
        num_heads: 2,
        time_embed_dim: 8,
        context_dim: 8,
        n_steps: 50,
        ..crate::model::Preset::Tiny.config()
    }
}

/// Writes a model into a folder, with weights as if something had been learned.
fn model_in(folder: &Path, config: UNetConfig) -> OpenModel {
    let decoder_config = DecoderConfig { hidden_dim: 12, n_blocks: 1, ..DecoderConfig::default() };
    let trained = |list: ParameterList| Parameters::<f32>::new(list.without_zero_layers(), 77);
    let unet_parameters = trained(UNet1D::new(&config).1);
    let decoder_parameters = trained(MotionDecoder::new(&decoder_config).1);
    let scale = FeatureScale::identity(FEATURE_DIM);
    let diffusion = DiffusionConfig {
        n_steps: config.n_steps,
        prediction: Prediction::Sample,
        ..DiffusionConfig::default()
    };
    let unet_weights = |id| unet_parameters.unpacked(id);
    let decoder_weights = |id| decoder_parameters.unpacked(id);
    let storage = Storage::Fp32;
    let graphs = [
        (unet(&config, &unet_weights, &scale, Form::default(), storage), ModelFileName::Unet),
        (decoder(&decoder_config, &decoder_weights, storage), ModelFileName::Decoder),
    ];
    let mut files = Vec::new();
    for (graph, name) in graphs {
        let graph = graph.expect("a graph");
        let file = ModelFile { graph, metadata: BTreeMap::new(), description: String::new() };
        let bytes = file.encode("weights", EMBEDDED_BYTES).model;
        std::fs::write(folder.join(name.name()), &bytes).expect("written");
        let (n_bytes, sha256) = (bytes.len() as u64, sha256(&bytes));
        files.push(FileEntry { name, n_bytes, sha256 });
    }
    let mut normalizer = Normalizer::identity();
    normalizer.centre[1] = 0.9;
    let card = ModelCard {
        family: crate::model::Family::Unet,
        format: MODEL_FORMAT,
        name: "m".to_owned(),
        program: "p".to_owned(),
        provenance: Provenance {
            run: "r".to_owned(),
            stage: "diffusion".to_owned(),
            unet_step: 1,
            decoder_step: 1,
            validation_loss: None,
            data: "d".to_owned(),
            learned_from: None,
        },
        precision: storage,
        unet: config,
        decoder: decoder_config,
        diffusion,
        alphas_cumprod: Vec::new(),
        n_parameters: Networks { unet: 1, decoder: 1 },
        weights_sha256: Networks { unet: "u".to_owned(), decoder: "d".to_owned() },
        window_frames: WINDOW,
        fps: FPS,
        channels: own_channels(),
        features: own_features(),
        normalizer,
        feature_scale: scale,
        motion_range: None,
        styles: NamedStyles::default(),
        sampling: None,
        licence: String::new(),
        files,
    };
    let text = serde_json::to_vec(&card).expect("JSON");
    std::fs::write(folder.join(file_names::CARD), text).expect("written");
    let files = ModelFolder::of_folder(folder).expect("a folder");
    OpenModel::of(files).expect("a model")
}

fn music(seed: u64, n_frames: usize) -> Array2<f32> {
    let mut features = Array2::zeros((n_frames, FEATURE_DIM));
    Stream::new(seed, 0).normal(0, features.as_slice_mut().expect("in order"));
    features
}

/// Windows of several phrases, one of them shorter than the model's.
fn windows() -> Vec<MusicWindow> {
    [("a", 0, 24), ("b", 24, 24), ("a", 48, 24), ("c/ü", 0, 17), ("d", 0, 24)]
        .into_iter()
        .zip(0..)
        .map(|((phrase, first_frame, n), seed)| MusicWindow {
            phrase_id: phrase.to_owned(),
            first_frame,
            features: music(seed, n),
            phase: (seed != 1).then(|| (0..n).map(|t| t as f64 / 60.0).collect()),
            clock: None,
        })
        .collect()
}

fn row(settings: Option<String>) -> GenerationRow {
    GenerationRow {
        generation: "run/a/0".to_owned(),
        run: "run".to_owned(),
        phrase_id: "a".to_owned(),
        sample: 0,
        candidate: 0,
        selected: true,
        seed: 5,
        model: "m".to_owned(),
        weights: String::new(),
        engine: "eager".to_owned(),
        sampler: "DDIM".to_owned(),
        n_steps: 3,
        guidance: 2.5,
        eta: Some(0.25),
        primed_by: None,
        n_frames: 24,
        n_windows: 1,
        score: None,
        checks_passed: 0,
        n_checks: 0,
        locking: None,
        velocity_error: 0.0,
        control_error_mm: None,
        control_error_deg: None,
        constraints: None,
        generate_s: 0.0,
        real_time_factor: 0.0,
        settings,
        content_hash: None,
        n_dancers: Some(1),
        consistency: None,
        time: TimestampUs(0),
    }
}

/// A store with a model beside it.
struct Bench {
    folder: tempfile::TempDir,
    store: Location,
    model: OpenModel,
}

impl Bench {
    fn new() -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let model_folder = folder.path().join("model");
        std::fs::create_dir(&model_folder).expect("a folder");
        let store = Location::local(&folder.path().join("store")).expect("a store");
        Self { model: model_in(&model_folder, unet_config()), store, folder }
    }

    fn settings(&self) -> RunSettings {
        RunSettings::of_run(&row(None), &self.model.card).expect("settings")
    }

    fn try_sample(
        &self,
        baseline: Baseline,
        windows: &[MusicWindow],
        seed: u64,
        n_threads: usize,
    ) -> anyhow::Result<Vec<BaselineMotion>> {
        let request = BaselineRequest {
            store: &self.store,
            model: &self.model,
            settings: &self.settings(),
            seed,
            windows,
            threads: NonZeroUsize::new(n_threads).expect("a thread"),
        };
        sample(baseline, &request, &Silent)
    }

    fn sample(&self, baseline: Baseline, windows: &[MusicWindow]) -> Vec<BaselineMotion> {
        self.try_sample(baseline, windows, 0, 2).expect("motions")
    }

    /// Files that the store keeps.
    fn kept(&self) -> Vec<std::path::PathBuf> {
        let entries = std::fs::read_dir(self.folder.path().join("store/baselines"));
        let entries = entries.into_iter().flatten();
        let mut paths: Vec<_> = entries.map(|entry| entry.expect("an entry").path()).collect();
        paths.sort();
        paths
    }
}

#[test]
fn an_untrained_network_moves_with_its_music_and_one_without_music_does_not() {
    let bench = Bench::new();
    let windows = windows();
    let mut others = windows.clone();
    for (window, seed) in others.iter_mut().zip(40..) {
        window.features = music(seed, window.features.nrows());
    }
    for baseline in [Baseline::Untrained, Baseline::NoMusic] {
        let motions = bench.sample(baseline, &windows);
        assert_eq!(motions.len(), windows.len());
        for (motion, window) in motions.iter().zip(&windows) {
            let n = window.features.nrows();
            assert_eq!((motion.decoded.dim(), motion.frames.dim()), ((n, 25), (n, 25)));
            assert!(motion.decoded.iter().chain(&motion.frames).all(|x| x.is_finite()));
            let x = motion.decoded.column(0);
            assert!(x.std(0.0) > 1e-3, "{baseline:?} stands still: {x}");
            // Post-processing takes the phase from the music, where it is known.
            let is_relocked = motion.frames[[6, 16]] == 0.1;
            assert_eq!(is_relocked, window.phase.is_some(), "{}", motion.frames[[6, 16]]);
        }
        // Every window has noise of its own.
        assert_ne!(motions[0].decoded, motions[1].decoded);
        assert_ne!(motions[0].decoded, motions[2].decoded);
        let other_motion = bench.sample(baseline, &others);
        let is_same = motions.iter().zip(&other_motion).all(|(a, b)| a.decoded == b.decoded);
        assert_eq!(is_same, baseline == Baseline::NoMusic);
    }
    assert_ne!(
        bench.sample(Baseline::Untrained, &windows)[0].decoded,
        bench.sample(Baseline::NoMusic, &windows)[0].decoded
    );
}

#[test]
fn with_its_zeros_a_fresh_network_says_the_same_for_every_input() {
    let folder = tempfile::tempdir().expect("a folder");
    let model = model_in(folder.path(), unet_config());
    let one = NonZeroUsize::MIN;
    let drawn = model.untrained(one, one).expect("an engine");
    let (_, list) = UNet1D::new(&model.card.unet);
    let (decoder, decoder_list) = MotionDecoder::new(&model.card.decoder);
    let fresh = EagerEngine::new(
        (&model.card.unet, Parameters::new(list, 0)),
        (decoder, Parameters::new(decoder_list, 0)),
        &FeatureScale::identity(FEATURE_DIM),
        (one, one),
    )
    .expect("an engine");
    let audio = music(3, WINDOW).insert_axis(ndarray::Axis(0));
    let mut x = ndarray::Array3::zeros((1, WINDOW, 25));
    Stream::new(4, 0).normal(0, x.as_slice_mut().expect("in order"));
    let inputs =
        EngineInputs { x: x.view(), t: &[30], audio: audio.view(), drop_audio: &[], style: None };
    assert!(fresh.predict(&inputs).expect("a prediction").iter().all(|x| *x == 0.0));
    let predicted = drawn.predict(&inputs).expect("a prediction");
    assert!(predicted.std(0.0) > 0.01, "{}", predicted.std(0.0));
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let windows = windows();
    for baseline in [Baseline::Untrained, Baseline::NoMusic] {
        let with = |n| Bench::new().try_sample(baseline, &windows, 9, n).expect("motions");
        let one = with(1);
        assert_eq!(with(3), one);
        // And no window depends on the others.
        let alone = Bench::new().try_sample(baseline, &windows[3..4], 9, 2).expect("motions");
        assert_eq!(alone, one[3..4]);
    }
}

#[test]
fn what_was_sampled_is_read_again_and_what_is_broken_sampled_again() {
    let bench = Bench::new();
    let windows = windows();
    let motions = bench.sample(Baseline::Untrained, &windows);
    let [path] = bench.kept().try_into().expect("one file");
    let bytes = std::fs::read(&path).expect("the file");
    let array = npy_of(&bytes);
    assert_eq!(array.shape, [24 + 24 + 24 + 17 + 24, 50]);
    assert_eq!(array.values[..25], motions[0].decoded.row(0).to_vec());
    assert_eq!(array.values[25..50], motions[0].frames.row(0).to_vec());

    // What is there under the digest is taken as it is.
    let mut other = motions.clone();
    other[1].frames[[2, 3]] = 7.5;
    let settings = bench.settings();
    let request = BaselineRequest {
        store: &bench.store,
        model: &bench.model,
        settings: &settings,
        seed: 0,
        windows: &windows,
        threads: NonZeroUsize::MIN,
    };
    let digest = cache::digest_of(Baseline::Untrained, &request, &settings.0);
    bench.store.remove(&format!("baselines/{}.npy", &digest[..32])).expect("removed");
    cache::write(&bench.store, &digest, &other).expect("written");
    assert_eq!(bench.sample(Baseline::Untrained, &windows), other);

    let mut flipped = bytes.clone();
    flipped[1000] ^= 1;
    let shorter = &bytes[..bytes.len() - 1];
    for broken in [&flipped[..], shorter, b"x", b""] {
        std::fs::write(&path, broken).expect("written");
        assert_eq!(bench.sample(Baseline::Untrained, &windows), motions);
        assert_eq!(std::fs::read(&path).expect("the file"), bytes, "replaced");
    }
    assert_eq!(bench.kept().len(), 1);
}

fn npy_of(bytes: &[u8]) -> crate::motion::npy::NpyArray<f32> {
    crate::motion::npy::read_f32(bytes).expect("an array")
}

#[test]
fn a_digest_is_that_of_everything_that_determines_the_motion() {
    let bench = Bench::new();
    let windows = windows();
    let settings = bench.settings();
    let digest = |baseline, seed, windows: &[MusicWindow], settings: &RunSettings| {
        let request = BaselineRequest {
            store: &bench.store,
            model: &bench.model,
            settings,
            seed,
            windows,
            threads: NonZeroUsize::MIN,
        };
        cache::digest_of(baseline, &request, &settings.0)
    };
    let changed = |change: &dyn Fn(&mut MusicWindow)| {
        let mut windows = windows.clone();
        change(&mut windows[2]);
        digest(Baseline::Untrained, 0, &windows, &settings)
    };
    let mut stronger = settings.clone();
    stronger.0.guidance = 3.0;
    let all = [
        digest(Baseline::Untrained, 0, &windows, &settings),
        digest(Baseline::NoMusic, 0, &windows, &settings),
        digest(Baseline::Untrained, 1, &windows, &settings),
        digest(Baseline::Untrained, 0, &windows[1..], &settings),
        digest(Baseline::Untrained, 0, &windows, &stronger),
        changed(&|window| window.phrase_id = "e".to_owned()),
        changed(&|window| window.first_frame = 3),
        changed(&|window| window.features[[7, 9]] += 0.5),
        changed(&|window| window.phase = None),
    ];
    let distinct: std::collections::BTreeSet<&String> = all.iter().collect();
    assert_eq!(distinct.len(), all.len());
    // The weights of a trained network count, those of an untrained one follow from its sizes.
    let mut other = model_in(bench.folder.path(), unet_config());
    other.card.weights_sha256.unet = "another".to_owned();
    assert_ne!(weights_digest(&other.card), weights_digest(&bench.model.card));
    let other_digest = |baseline| {
        let request = BaselineRequest {
            store: &bench.store,
            model: &other,
            settings: &settings,
            seed: 0,
            windows: &windows,
            threads: NonZeroUsize::MIN,
        };
        cache::digest_of(baseline, &request, &settings.0)
    };
    assert_eq!(other_digest(Baseline::Untrained), all[0]);
    assert_ne!(other_digest(Baseline::NoMusic), all[1]);
}

#[test]
fn settings_are_those_of_the_run_else_of_its_columns() {
    let bench = Bench::new();
    let card = &bench.model.card;
    let RunSettings(settings) = bench.settings();
    assert_eq!(settings.sampler.sampler, Sampler::Ddim { eta: 0.25 });
    assert_eq!((settings.sampler.n_steps, settings.guidance), (3, 2.5));
    assert_eq!((settings.overlap_frames, settings.best_of), (WINDOW - 1, 1));
    let usual = crate::motion::postprocess::SavitzkyGolay { window: 11, order: 3 };
    assert_eq!(settings.postprocess.savitzky_golay, Some(usual), "as generate does by default");

    let mut own = settings.clone();
    (own.best_of, own.guidance, own.overlap_frames) = (4, 1.5, 5);
    own.constraints = Some("digest".to_owned());
    let RunSettings(read) = RunSettings::of_run(&row(Some(own.to_json())), card).expect("settings");
    assert_eq!(read, MotionSettings { best_of: 1, constraints: None, ..own.clone() });

    let refused =
        |row: &GenerationRow| format!("{:#}", RunSettings::of_run(row, card).expect_err("unknown"));
    assert_eq!(
        refused(&GenerationRow { sampler: "Heun".to_owned(), ..row(None) }),
        "run \"run\" was made with sampler \"Heun\", and this program has DDPM, DDIM, DPM-Solver++; make its \
         motions again with motiongen generate --force"
    );
    let again = "run \"run\" has settings that this program cannot sample with; make its motions again with \
                 motiongen generate --force: ";
    assert_eq!(
        refused(&row(Some("{".to_owned()))),
        format!("{again}EOF while parsing an object at line 1 column 1")
    );
    own.overlap_frames = WINDOW;
    assert_eq!(refused(&row(Some(own.to_json()))), format!("{again}windows of 24 frames share 24"));
    let steps = GenerationRow { n_steps: 51, ..row(None) };
    assert!(refused(&steps).starts_with(&format!("{again}n_steps of the sampler is 51;")));
}

#[test]
fn windows_that_are_no_music_are_refused() {
    let bench = Bench::new();
    let refused = |change: &dyn Fn(&mut MusicWindow)| {
        let mut windows = windows();
        change(&mut windows[1]);
        let said = bench.try_sample(Baseline::NoMusic, &windows, 0, 1);
        said.expect_err("no music").to_string()
    };
    assert_eq!(
        refused(&|window| window.features = Array2::zeros((24, 7))),
        "features of b from frame 24 are 24 frames of 7; give one or more frames of 163"
    );
    assert_eq!(
        refused(&|window| window.features = Array2::zeros((0, FEATURE_DIM))),
        "features of b from frame 24 are 0 frames of 163; give one or more frames of 163"
    );
    assert_eq!(
        refused(&|window| window.phase = Some(vec![0.0; 3])),
        "b from frame 24 has 3 phases for 24 frames; give one for each"
    );
    assert_eq!(bench.sample(Baseline::NoMusic, &[]), []);
    assert!(bench.kept().is_empty());
}
