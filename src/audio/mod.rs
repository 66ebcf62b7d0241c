//! Audio: bytes become samples, and samples the 163 features of every frame.
//!
//! Data flow: `container` → `decode` → `resample` → `features`, whose first pass collects spectra
//! (`spectral`: mel, RMS, centroid) and the tuning, and whose second pass adds chroma. Onsets, MFCC
//! and beats follow from the mel bands of the whole file. Apart from them, `meter` finds the beats and bars that motion
//! follows.

mod bank;
pub mod beat;
pub mod chroma;
mod container;
pub mod cqt;
pub mod decimate;
pub mod decode;
pub mod features;
pub mod formats;
pub mod framing;
pub mod header;
pub mod mel;
pub mod meter;
pub mod mfcc;
pub mod onset;
mod pcm;
mod peak;
mod product;
pub mod recording;
pub mod resample;
mod scale;
pub mod sliding_dft;
pub mod spectral;
pub mod stft;
pub mod tuning;

pub use beat::Rhythm;
pub use features::{
    BLOCKS, Block, FEATURE_DIM, FeatureError, Features, RawFeatures, extract, feature_names,
};
pub use meter::Meter;
pub use tuning::Tuning;

/// Rate at which everything is computed, in Hz.
pub const SAMPLE_RATE_HZ: u32 = 44_100;
/// Samples between frames: 44,100 / 30.
pub const HOP: usize = 1_470;
/// Samples of a frame's transform.
pub const N_FFT: usize = 2_048;
pub use scale::FeatureScale;
