//! The one integration-test crate; every file of `tests/` is a module of it.

mod audio_header;
mod diffusion;
mod engine;
mod extract;
mod generate;
mod ingest_bad_input;
mod ingest_kill;
mod ingest_local;
mod ingest_remote;
mod library;
mod motion_capture;
mod npy_files;
mod object_store_conformance;
mod onnx;
mod plot_features;
mod plot_motion;
mod plot_training;
mod query_tables;
mod rooms;
mod schemas;
mod servers;
mod store_suite;
mod support;
mod train;
mod training;
mod view;
