//! Audio files: what their headers say.

pub mod header;
