//! Datasets: of phrases at hand, of a folder, of a bucket.

use std::num::NonZeroUsize;
use std::sync::Arc;

use motiongen::autodiff::Parameters;
use motiongen::model::{DecoderConfig, MotionDecoder, ParameterList};
use motiongen::motion::Normalizer;
use motiongen::store::{Location, Patience, PutOutcome};
use motiongen::training::{
    CheckpointKind, Checkpoints, Dataset, DatasetOptions, Ensemble, Split, State,
};
use motiongen::weights::Section;
use ndarray::Array2;

use crate::support::Dir;

fn frames(n: usize, width: usize, first: f32) -> Array2<f32> {
    Array2::from_shape_fn((n, width), |(t, i)| first + (t * width + i) as f32)
}

#[test]
fn phrases_at_hand_are_read_back_in_order_of_name() {
    let dataset_ending_in = |last: f32| {
        let phrases = [
            ("b", Split::Train, frames(7, 25, 0.5), frames(8, 163, last)),
            ("a", Split::Validation, frames(5, 25, 1.5), frames(4, 163, 2.5)),
        ];
        Dataset::in_memory(phrases).expect("memory")
    };
    let dataset = dataset_ending_in(3.5);
    let [a, b] = dataset.phrases() else { panic!("two phrases") };
    assert_eq!((&*a.id, a.split, a.n_frames), ("a", Split::Validation, 4));
    assert_eq!((&*b.id, b.split, b.n_frames), ("b", Split::Train, 7));
    assert_eq!(dataset.motion(b, 2, 3).expect("frames"), frames(3, 25, 50.5));
    assert_eq!(dataset.features(b, 1, 6).expect("frames"), frames(6, 163, 166.5));
    assert_eq!(dataset.motion(a, 0, 4).expect("frames"), frames(4, 25, 1.5));
    assert_eq!(dataset.fingerprint(), dataset_ending_in(3.5).fingerprint());
    assert_ne!(dataset.fingerprint(), dataset_ending_in(4.5).fingerprint());
}

/// What is read of a store, wherever it lies.
fn read(store: &Location, in_memory: bool) -> Dataset {
    let reading = DatasetOptions {
        ensemble: Ensemble::Soloists,
        in_memory,
        n_threads: NonZeroUsize::new(3).expect("above 0"),
        patience: Patience::default(),
        max_train_phrases: None,
    };
    let (dataset, left_out) = Dataset::read(store, &reading, &|_, _| (), &|_, _| ()).expect("read");
    assert_eq!(left_out, []);
    dataset
}

#[test]
fn a_bucket_and_a_folder_hold_the_same_phrases() {
    let dir = Dir::new();
    let folder = crate::train::make_store(&dir);
    let local = Location::local(&folder).expect("a folder");
    let client = Arc::new(object_store::memory::InMemory::new());
    let bucket = Location::with_client("memory://bucket/below", client, "below");
    for (path, (bytes, _)) in crate::support::tree(&folder) {
        bucket.put_new(path.to_str().expect("UTF-8"), bytes.into()).expect("put");
    }
    let (here, there) = (read(&local, false), read(&bucket, true));
    assert_eq!(here.fingerprint(), there.fingerprint());
    assert_eq!((here.n_in(Split::Train), here.n_in(Split::Validation)), (13, 3));
    let frames = crate::support::motion(&folder);
    for (a, b) in here.phrases().iter().zip(there.phrases()) {
        assert_eq!((&a.id, a.split, a.n_frames), (&b.id, b.split, b.n_frames));
        let motion = here.motion(a, 0, a.n_frames).expect("at hand");
        assert_eq!(motion, there.motion(b, 0, b.n_frames).expect("at hand"));
        assert_eq!(motion.as_slice(), Some(frames[&*a.id].as_flattened()), "{}", a.id);
        let features = here.features(a, 0, a.n_frames).expect("at hand");
        assert_eq!(features, there.features(b, 0, b.n_frames).expect("at hand"));
    }

    // Checkpoints go there as well, and only the newest two stay.
    let weights = Parameters::<f32>::new(small_list(), 3);
    let mut state = State::new("stage", 7_u32, here.fingerprint(), Normalizer::identity());
    let checkpoints = Checkpoints::new(&bucket, "run", "stage");
    let section = Section { prefix: "unet.", plan: weights.plan(), values: weights.all() };
    for step in [3, 5, 9] {
        state.progress.step = step;
        assert_eq!(
            checkpoints.write(CheckpointKind::Step, &state, &[section]).expect("written"),
            PutOutcome::Written
        );
    }
    assert_eq!(checkpoints.steps(CheckpointKind::Step).expect("listed"), [5, 9]);
    assert_eq!(
        checkpoints.write(CheckpointKind::Step, &state, &[section]).expect("there"),
        PutOutcome::AlreadyThere
    );
    let back = checkpoints.read(CheckpointKind::Step, 9, |archive, place| {
        assert_eq!(State::<u32>::of(archive, place)?, state);
        Ok(archive.section::<f32>("unet.", small_list()).expect("weights"))
    });
    assert_eq!(back.expect("read").all(), weights.all());
    checkpoints.clear().expect("removed");
    assert_eq!(checkpoints.steps(CheckpointKind::Step).expect("listed"), [0_u64; 0]);
}

fn small_list() -> ParameterList {
    let config = DecoderConfig { hidden_dim: 5, n_blocks: 1, ..DecoderConfig::default() };
    MotionDecoder::new(&config).1
}
