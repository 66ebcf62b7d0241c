//! A store of songs that nobody has: the tables that plans are made from, without music behind them.
//!
//! ```sh
//! synthetic-store STORE FIRST END
//! ```
//!
//! Commits the songs from FIRST to END of ingest and extract, 4,096 at a time, as those stages would: a row in `phrases`
//! and in `extractions`, a manifest, and at the end the catalogues. Song n is the same whatever the range.
//! `benches/scale.py` asks `--dry-run` and `status` of such stores.

#![expect(clippy::print_stdout, clippy::print_stderr, reason = "a program of its own")]

use std::ops::Range;
use std::path::Path;
use std::process::ExitCode;

use motiongen::store::tables::{ExtractionRow, PhraseRow};
use motiongen::store::{
    Commit, Item, Ledger, Location, Row, StoreError, checkpoint, digest, split_of,
};

/// Items of a commit.
const BATCH_SONGS: u64 = 4096;
const SOURCE: &str = "s3://music/library";
const STAGES: [&str; 2] = ["ingest", "extract"];

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let numbers = |text: &String| text.parse::<u64>().ok();
    let [store, first, end] = arguments.as_slice() else {
        eprintln!("usage: synthetic-store STORE FIRST END");
        return ExitCode::from(2);
    };
    let (Some(first), Some(end)) = (numbers(first), numbers(end)) else {
        eprintln!("synthetic-store: FIRST and END are numbers of songs, found {first} and {end}");
        return ExitCode::from(2);
    };
    match fill(Path::new(store), first..end) {
        Ok(()) => {
            println!("{} songs in {store}", end - first);
            ExitCode::SUCCESS
        }
        Err(error) => {
            eprintln!("synthetic-store {store}: {error}");
            ExitCode::FAILURE
        }
    }
}

fn fill(store: &Path, songs: Range<u64>) -> Result<(), StoreError> {
    let store = Location::local(store)?;
    for first in songs.clone().step_by(BATCH_SONGS as usize) {
        let songs: Vec<Song> = (first..songs.end.min(first + BATCH_SONGS)).map(Song::new).collect();
        let phrases: Vec<PhraseRow> = songs.iter().map(Song::phrase).collect();
        let extractions: Vec<ExtractionRow> = songs.iter().map(Song::extraction).collect();
        commit(&store, STAGES[0], &songs, &phrases)?;
        commit(&store, STAGES[1], &songs, &extractions)?;
    }
    checkpoint(&store, &STAGES);
    Ok(())
}

fn commit<R: Row>(
    store: &Location,
    stage: &'static str,
    songs: &[Song],
    rows: &[R],
) -> Result<(), StoreError> {
    let mut commit = Commit::new(store, stage, "synthetic", SOURCE);
    commit.part(R::schema().name, R::schema)?.write_rows(rows)?;
    for song in songs {
        let (id, input_hash) = (song.id.clone(), song.hash.clone());
        let fingerprint = input_hash[..32].to_owned();
        commit.settle(Item { id, fingerprint, input_hash, failure: None }, &Ledger::default());
    }
    commit.publish().map(|_| ())
}

/// A song of 120 to 300 s.
struct Song {
    id: String,
    hash: String,
    duration_s: f64,
}

impl Song {
    fn new(number: u64) -> Self {
        let id = format!("{:04}/artist_{:06}/song_{number:010}.ogg", number / 65_536, number / 11);
        let hash = digest(id.as_bytes());
        let duration_s =
            120.0 + f64::from(number.wrapping_mul(2_654_435_761) as u32 % 18_000) / 100.0;
        Self { id, hash, duration_s }
    }

    fn url(&self) -> String {
        format!("{SOURCE}/{}", self.id)
    }

    fn phrase(&self) -> PhraseRow {
        PhraseRow {
            phrase_id: self.id.clone(),
            source: SOURCE.to_owned(),
            motion_url: None,
            features_url: None,
            audio_url: Some(self.url()),
            beats_url: None,
            motion_bytes: None,
            features_bytes: None,
            audio_bytes: Some((self.duration_s * 16_000.0) as i64),
            beats_bytes: None,
            content_hash: self.hash.clone(),
            song_hash: Some(self.hash.clone()),
            has_motion: false,
            has_features: false,
            has_audio: true,
            has_beats: false,
            motion_format: None,
            motion_root: None,
            motion_up: None,
            motion_unit_m: None,
            motion_cut_s: None,
            motion_notes: None,
            audio_codec: Some("vorbis".to_owned()),
            sample_rate_hz: Some(44_100),
            n_channels: Some(2),
            duration_s: self.duration_s,
            start_s: None,
            n_frames: None,
            n_feature_frames: None,
            split: split_of(&self.id).to_owned(),
            tempo_bpm: None,
            tempo_source: None,
            beats_per_bar: None,
            beats_per_bar_source: None,
            n_dancers: None,
            formation: None,
            unison: None,
            style_name: None,
        }
    }

    fn extraction(&self) -> ExtractionRow {
        let n_samples = (self.duration_s * 44_100.0) as i64;
        ExtractionRow {
            phrase_id: self.id.clone(),
            origin: "audio".to_owned(),
            source_url: self.url(),
            n_frames: 1 + n_samples / 1470,
            n_samples: Some(n_samples),
            duration_s: self.duration_s,
            tuning: Some(0.0),
            tuning_source: Some("estimated".to_owned()),
            tempo_bpm: Some(120.0),
            n_beats: (self.duration_s * 2.0) as i32,
            audio_codec: Some("vorbis".to_owned()),
            sample_rate_hz: Some(44_100),
            n_channels: Some(2),
            content_hash: Some(self.hash.clone()),
            truncated: Some(false),
            lost_s: Some(0.0),
        }
    }
}
