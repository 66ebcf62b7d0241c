//! Uncompressed audio: WAV, RF64, Wave64, AIFF, AIFC, AU and CAF.
//!
//! Read here rather than by a library, because only the format and the place of the samples matter:
//! damaged or unusual metadata before and after them, sizes that a dying recorder left at 0 and
//! placeholders of streams do not keep a sample from being read. libsndfile reads the same way.

mod aiff;
mod apple;
mod layout;
mod riff;
mod samples;
mod sun;
#[cfg(test)]
mod tests;

pub(in crate::audio) use apple::valid_frames;
pub(in crate::audio) use layout::{Layout, Payload};
pub(in crate::audio) use samples::{SampleFormat, Samples};
