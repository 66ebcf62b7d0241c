//! Sampled baselines in a store: one `.npy` each, named by a digest of everything that determines it.
//!
//! The array is `[all frames, 50]`, the windows one behind the other: the 25 channels as they were decoded, then
//! the 25 after post-processing. Behind it stands the digest of these bytes, which NumPy does not look at.

use bytes::Bytes;
use ndarray::{Array2, ArrayView2, s};
use serde::Serialize;

use super::{Baseline, BaselineMotion, BaselineRequest, MusicWindow};
use crate::audio::FeatureScale;
use crate::diffusion::DiffusionConfig;
use crate::model::{DecoderConfig, UNetConfig};
use crate::motion::{MOTION_DIM, Normalizer, npy};
use crate::stages::generate::{MotionSettings, weights_digest};
use crate::store::{Location, StoreError, digest};

/// Raised when the same networks, settings and windows give other motion.
const VERSION: u32 = 1;
/// The folder in a store.
pub const FOLDER: &str = "baselines";
/// Channels of a row: decoded and processed.
const WIDTH: usize = 2 * MOTION_DIM;

/// What determines the motion of a baseline.
#[derive(Serialize)]
struct BaselineKey<'a> {
    version: u32,
    baseline: &'static str,
    /// Weights of the model; those of an untrained one follow from its sizes.
    weights: Option<String>,
    unet: &'a UNetConfig,
    decoder: &'a DecoderConfig,
    diffusion: &'a DiffusionConfig,
    window_frames: usize,
    normalizer: &'a Normalizer,
    feature_scale: &'a FeatureScale,
    settings: &'a MotionSettings,
    seed: u64,
    windows: Vec<BaselineKeyWindow<'a>>,
}

/// Phrase, first frame, and digests of features, phase and clock.
#[derive(Serialize)]
pub struct BaselineKeyWindow<'a>(&'a str, usize, String, Option<String>, Option<String>);

/// Returns what determines the music of windows, for a network that hears the clock or does not.
pub fn key_windows(windows: &[MusicWindow], hears_clock: bool) -> Vec<BaselineKeyWindow<'_>> {
    fn digest_of_values<const N: usize>(bytes: impl Iterator<Item = [u8; N]>) -> String {
        digest(&bytes.flatten().collect::<Vec<u8>>())
    }
    let key = |window: &'_ MusicWindow| {
        let features = digest_of_values(window.features.iter().map(|x| x.to_le_bytes()));
        let phase = window.phase.as_ref();
        let phase = phase.map(|phase| digest_of_values(phase.iter().map(|x| x.to_le_bytes())));
        let clock = window.clock.as_ref().filter(|_| hears_clock);
        let clock = clock.map(|clock| digest_of_values(clock.iter().map(|x| x.to_le_bytes())));
        (window.first_frame, features, phase, clock)
    };
    let keys = windows.iter().map(|window| {
        let (first, features, phase, clock) = key(window);
        BaselineKeyWindow(&window.phrase_id, first, features, phase, clock)
    });
    keys.collect()
}

/// Returns the digest of a baseline.
pub fn digest_of(
    baseline: Baseline,
    request: &BaselineRequest,
    settings: &MotionSettings,
) -> String {
    let card = &request.model.card;
    let digested = BaselineKey {
        version: VERSION,
        baseline: baseline.name(),
        weights: (baseline != Baseline::Untrained).then(|| weights_digest(card)),
        unet: &card.unet,
        decoder: &card.decoder,
        diffusion: &card.diffusion,
        window_frames: card.window_frames,
        normalizer: &card.normalizer,
        feature_scale: &card.feature_scale,
        settings,
        seed: request.seed,
        windows: key_windows(request.windows, card.unet.clock),
    };
    let text = serde_json::to_vec(&digested).expect("invariant: numbers and texts become JSON");
    digest(&text)
}

/// Reads what a store keeps under a digest; a file that is broken is removed.
///
/// # Errors
/// When the store cannot be read.
pub fn read(
    store: &Location,
    digest: &str,
    windows: &[MusicWindow],
) -> Result<Option<Vec<BaselineMotion>>, StoreError> {
    let path = path_of(digest);
    let bytes = match store.read(&path) {
        Err(StoreError::NotFound { .. }) => return Ok(None),
        read => read?,
    };
    let found = unpack(&bytes, windows);
    if found.is_none() {
        // What is sampled takes its place.
        store.remove(&path)?;
    }
    Ok(found)
}

/// Keeps motions under a digest.
///
/// # Errors
/// When the store cannot be written.
pub fn write(store: &Location, digest: &str, motions: &[BaselineMotion]) -> Result<(), StoreError> {
    store.put_new(&path_of(digest), pack(motions)).map(drop)
}

fn path_of(digest: &str) -> String {
    format!("{FOLDER}/{}.npy", &digest[..32.min(digest.len())])
}

fn pack(motions: &[BaselineMotion]) -> Bytes {
    let n_frames = motions.iter().map(|motion| motion.frames.nrows()).sum();
    let mut values: Vec<f32> = Vec::with_capacity(n_frames * WIDTH);
    for BaselineMotion { decoded, frames } in motions {
        for (decoded, frame) in decoded.rows().into_iter().zip(frames.rows()) {
            values.extend(decoded.iter().chain(frame));
        }
    }
    let mut bytes = npy::write(&[n_frames, WIDTH], &values);
    let seal = digest(&bytes);
    bytes.extend(seal.as_bytes());
    bytes.into()
}

/// Returns the motions in a file; `None` where it is not what [`pack`] made for windows of these lengths.
fn unpack(bytes: &[u8], windows: &[MusicWindow]) -> Option<Vec<BaselineMotion>> {
    let (array, seal) = bytes.split_at_checked(bytes.len().checked_sub(digest(&[]).len())?)?;
    if digest(array).as_bytes() != seal {
        return None;
    }
    let array = npy::read_f32(array).ok()?;
    let n_frames = windows.iter().map(|window| window.features.nrows()).sum();
    if array.shape != [n_frames, WIDTH] {
        return None;
    }
    let all = Array2::from_shape_vec((n_frames, WIDTH), array.values).ok()?;
    let mut first = 0;
    let motion = |window: &MusicWindow| {
        let last = first + window.features.nrows();
        let rows: ArrayView2<f32> = all.slice(s![first..last, ..]);
        first = last;
        let (decoded, frames) = rows.split_at(ndarray::Axis(1), MOTION_DIM);
        BaselineMotion {
            decoded: decoded.as_standard_layout().into_owned(),
            frames: frames.as_standard_layout().into_owned(),
        }
    };
    Some(windows.iter().map(motion).collect())
}
