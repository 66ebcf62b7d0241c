//! MikuMikuDance motion (`.vmd`): the root bones' or the camera's keys, drawn at 30 fps.
//!
//! Layout, little-endian: 30 bytes of signature, 20 of the model's name; a count and that many bone keys of
//! 111 bytes (name in Shift-JIS, frame, position, quaternion x y z w, curves); a count and that many morph keys
//! of 23; a count and that many camera keys of 61 (frame, distance, position, Euler angles, curves, field of
//! view, flag). A key's curves are those of the way to it from the key before. World: left-handed, +Y up,
//! models face -Z; turned into ours by reflecting z. Sources: the format as Higuchi's program writes it, in the
//! readers of saba, three.js and mmd_tools.

mod camera;
mod curve;
mod root;
#[cfg(test)]
mod tests;

use thiserror::Error;

use crate::excerpt::preview;
use crate::motion::capture::RigidTrack;

/// Frames per second of every file.
pub const RATE_HZ: f64 = 30.0;
/// Metres of a unit: a model of 20 units is 1.6 m.
pub const UNIT_M: f64 = 0.08;
/// Most frames: two hours.
pub const MAX_FRAMES: usize = 216_000;

const SIGNATURE: &[u8] = b"Vocaloid Motion Data 0002";
const SIGNATURE_BYTES: usize = 30;
const MODEL_NAME_BYTES: usize = 20;
const BONE_KEY_BYTES: usize = 111;
const MORPH_KEY_BYTES: usize = 23;
const CAMERA_KEY_BYTES: usize = 61;

/// Why a file was refused.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum VmdError {
    /// Another signature.
    #[error(
        "vmd starts with {found}, expected \"Vocaloid Motion Data 0002\"; save the motion again in \
         MikuMikuDance 5 or later"
    )]
    NotVmd { found: String },
    /// Fewer bytes than the counts need.
    #[error(
        "vmd declares {declared} {what} of {key_bytes} bytes, {found_bytes} bytes follow; the file was cut \
         short, copy it again"
    )]
    Truncated { what: &'static str, declared: u32, key_bytes: usize, found_bytes: usize },
    /// The file ends before a count.
    #[error("vmd ends at byte {at_byte}, before its number of {what}; copy the file again")]
    NoCount { what: &'static str, at_byte: usize },
    /// Nothing that moves a root.
    #[error(
        "vmd has {n_bone_keys} bone keys, none of 全ての親, センター or グルーブ (root, centre, groove), and no \
         camera keys; export a motion that moves one of them"
    )]
    NoRoot { n_bone_keys: usize },
    /// A key later than any take.
    #[error("vmd has a key at frame {frame}, at most {MAX_FRAMES} are read; split the motion")]
    TooLong { frame: u32 },
    /// A key with a NaN or an infinity.
    #[error(
        "vmd has a value that is not finite in the {what} key of frame {frame}; mend or delete that key"
    )]
    NotFinite { what: &'static str, frame: u32 },
}

impl VmdError {
    /// The error's class in reports.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Truncated { .. } | Self::NoCount { .. } => "truncated",
            Self::TooLong { .. } => "too_large",
            Self::NotFinite { .. } => "non_finite",
            Self::NotVmd { .. } | Self::NoRoot { .. } => "motion_format",
        }
    }
}

/// Reads the root bones' track, or the camera's where no root bone has a key.
///
/// # Errors
/// [`VmdError`].
pub fn read(bytes: &[u8]) -> Result<RigidTrack, VmdError> {
    if !bytes.starts_with(SIGNATURE) {
        return Err(VmdError::NotVmd { found: preview(bytes) });
    }
    let mut sections = Sections { bytes, at: SIGNATURE_BYTES + MODEL_NAME_BYTES };
    let bone_keys: &[[u8; BONE_KEY_BYTES]] = sections.next("bone keys")?;
    // Early versions end after the bones, or after the morphs.
    let mut camera_keys: &[[u8; CAMERA_KEY_BYTES]] = &[];
    if !sections.is_at_end() {
        sections.next::<MORPH_KEY_BYTES>("morph keys")?;
        if !sections.is_at_end() {
            camera_keys = sections.next("camera keys")?;
        }
    }
    match root::track(bone_keys)? {
        Some(mut track) => {
            if !camera_keys.is_empty() {
                track.notes.push(format!("{} camera keys are left out", camera_keys.len()));
            }
            Ok(track)
        }
        None if camera_keys.is_empty() => Err(VmdError::NoRoot { n_bone_keys: bone_keys.len() }),
        None => camera::track(camera_keys),
    }
}

/// The sections of a file, one after the other.
struct Sections<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Sections<'a> {
    fn is_at_end(&self) -> bool {
        self.at >= self.bytes.len()
    }

    /// Reads a count and as many keys of `N` bytes.
    fn next<const N: usize>(&mut self, what: &'static str) -> Result<&'a [[u8; N]], VmdError> {
        let no_count = VmdError::NoCount { what, at_byte: self.bytes.len() };
        let rest = self.bytes.get(self.at..).ok_or_else(|| no_count.clone())?;
        let (count, rest) = rest.split_first_chunk().ok_or(no_count)?;
        let declared = u32::from_le_bytes(*count);
        let (keys, _) = rest.as_chunks::<N>();
        let keys = usize::try_from(declared).ok().and_then(|n| keys.get(..n));
        let found_bytes = rest.len();
        let keys = keys.ok_or(VmdError::Truncated { what, declared, key_bytes: N, found_bytes })?;
        self.at += count.len() + N * keys.len();
        Ok(keys)
    }
}

/// The number at a place in a key; 0 beyond its end.
fn f32_at(key: &[u8], at: usize) -> f64 {
    f64::from(f32::from_bits(u32_at(key, at)))
}

fn u32_at(key: &[u8], at: usize) -> u32 {
    let bytes = key.get(at..).and_then(|rest| rest.first_chunk());
    bytes.map_or(0, |bytes| u32::from_le_bytes(*bytes))
}

/// Frames of a take that ends with this key.
fn n_frames(last: u32) -> Result<usize, VmdError> {
    let n = usize::try_from(last).ok().and_then(|last| last.checked_add(1));
    n.filter(|&n| n <= MAX_FRAMES).ok_or(VmdError::TooLong { frame: last })
}

/// A position of the file's world in ours, m.
fn position_m(p: [f64; 3]) -> [f64; 3] {
    [p[0] * UNIT_M, p[1] * UNIT_M, -p[2] * UNIT_M]
}
