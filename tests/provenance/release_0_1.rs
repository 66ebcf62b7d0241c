//! Stores of release 0.1: one that it wrote, and parts as it wrote them.

use std::path::PathBuf;

use arrow_array::RecordBatch;
use motiongen::generation::{FamilyCard as _, ModelCard, MusicSplit};
use motiongen::stages::learned::of_model;
use motiongen::store::tables::PhraseRow;
use motiongen::store::{ItemTables, Location, PartWriter, Row, Snapshot, TableSchema};

use super::*;
use crate::support::files::wav;
use crate::support::{ingest, phrases};

/// A row of `phrases` as release 0.1 wrote it.
struct OldRow(PhraseRow);

impl Row for OldRow {
    fn schema() -> TableSchema {
        let mut schema = TableSchema { version: 2, ..PhraseRow::schema() };
        schema.columns.retain(|column| column.name != "song_hash");
        schema
    }

    fn to_batch(rows: &[Self]) -> RecordBatch {
        let rows: Vec<PhraseRow> = rows.iter().map(|row| row.0.clone()).collect();
        let batch = PhraseRow::to_batch(&rows);
        let schema = batch.schema();
        let kept = (0..batch.num_columns()).filter(|&i| schema.field(i).name() != "song_hash");
        batch.project(&kept.collect::<Vec<_>>()).expect("columns of the batch")
    }

    fn from_batch(_: &RecordBatch) -> Option<Vec<Self>> {
        None
    }
}

/// Makes the live parts of `phrases` that a stage wrote those of release 0.1; returns how many.
pub fn downgrade(store: &Path, stage: &str) -> usize {
    downgrade_where(store, stage, |_| true)
}

/// Makes the live part that holds a phrase one of release 0.1.
pub fn downgrade_one(store: &Path, id: &str) -> usize {
    downgrade_where(store, "ingest", |rows| rows.iter().any(|row| row.phrase_id == id))
}

fn downgrade_where(store: &Path, stage: &str, is_old: impl Fn(&[PhraseRow]) -> bool) -> usize {
    let location = Location::local(store).expect("a folder");
    let table = Snapshot::take(&location, PhraseRow::schema()).expect("a snapshot");
    let mut n_parts = 0;
    for entry in std::fs::read_dir(store.join("commits").join(stage)).expect("commits") {
        let path = entry.expect("an entry").path();
        let text = std::fs::read(&path).expect("a manifest");
        let mut manifest: serde_json::Value = serde_json::from_slice(&text).expect("JSON");
        for part in manifest["parts"].as_array_mut().expect("parts") {
            let place = part["path"].as_str().expect("a path").to_owned();
            let Some(i) = table.parts().iter().position(|live| live.part.path == place) else {
                continue;
            };
            let rows: Vec<PhraseRow> = table.part(i).rows().expect("rows");
            if !is_old(&rows) {
                continue;
            }
            let file = tempfile::NamedTempFile::new().expect("a file");
            let mut writer = PartWriter::new(OldRow::schema(), file).expect("a part");
            let rows: Vec<OldRow> = rows.into_iter().map(OldRow).collect();
            writer.write_rows(&rows).expect("rows");
            let finished = writer.finish(&[]).expect("a part");
            std::fs::copy(finished.file.path(), store.join(&place)).expect("copied");
            part["schema_version"] = 2.into();
            n_parts += 1;
        }
        std::fs::write(&path, manifest.to_string()).expect("written");
    }
    n_parts
}

/// The store that release 0.1 wrote.
fn golden() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/golden/release_0_1/store")
}

fn csv(store: &Path, sql: &str) -> String {
    let store = store.display().to_string();
    succeeds(run(["query", "--store", &store, "--format", "csv", sql])).stdout
}

#[test]
fn its_tables_are_read_without_the_identity_of_music() {
    let rows = phrases(&golden());
    let ids: Vec<&str> = rows.keys().map(String::as_str).collect();
    assert_eq!(
        ids,
        [
            "humanoid3d_dance_a",
            "humanoid3d_spin",
            "march.wav",
            "march.wav.t00.0000",
            "tango.wav",
            "tango.wav.t00.0000",
            "waltz.wav",
            "waltz.wav.t00.0000",
            "waltz.wav.t00.0001",
        ]
    );
    assert!(rows.values().all(|row| row.song_hash.is_none()));
    let (song, phrase) = (&rows["waltz.wav"], &rows["waltz.wav.t00.0001"]);
    assert_eq!((song.duration_s, song.split.as_str(), song.n_channels), (6.1, "train", Some(1)));
    assert_eq!((phrase.start_s, phrase.split.as_str()), (Some(2.0), "test"));
    assert_eq!(
        phrase.content_hash,
        "a842d091b7bba7ad7d633b508547d66372e289e81297aedd8af400a062255d8b"
    );
    let location = Location::local(&golden()).expect("a folder");
    let one: Vec<PhraseRow> =
        ItemTables::take(&location, "waltz.wav.t00.0001").and_then(|t| t.rows()).expect("rows");
    assert_eq!(one.as_slice(), std::slice::from_ref(phrase));
}

#[test]
fn its_rows_and_new_ones_are_one_table() {
    let dir = Dir::new();
    let store = dir.at("store");
    copy(&golden(), &store);
    write(&dir.at("source/new.wav"), wav(0.6));
    succeeds(ingest(&dir.at("source"), &store, &[]));
    let hash = motiongen::store::digest(&wav(0.6));
    let rows = phrases(&store);
    assert_eq!((rows.len(), rows["new.wav"].song_hash.as_ref()), (10, Some(&hash)));
    let sql = "select phrase_id, song_hash, duration_s from phrases where song_hash is not null or \
               split = 'validation' order by phrase_id";
    assert_eq!(
        csv(&store, sql),
        format!(
            "phrase_id,song_hash,duration_s\nhumanoid3d_dance_a,,{}\nmarch.wav.t00.0000,,4.0\n\
             new.wav,{hash},0.6\n",
            rows["humanoid3d_dance_a"].duration_s
        )
    );
    assert_eq!(
        csv(&store, "select count(*) n, count(song_hash) songs from phrases"),
        "n,songs\n10,1\n"
    );
}

#[test]
fn its_models_are_read_and_do_not_tell_what_they_learned_from() {
    let bytes = std::fs::read(golden().join("models/m/model.json")).expect("a card");
    let card = ModelCard::read(&bytes, "m").expect("a card of release 0.1");
    assert_eq!(card.provenance.learned_from, None);
    // As the row of a motion would have it.
    let weights = "d5bf9e49e4247cfce75963884690f380dfff62c489c5dcbd902447561d90c57f";
    let location = Location::local(&golden()).expect("a folder");
    let why = of_model(&location, "m", weights).expect("a store").expect_err("nothing to tell");
    assert_eq!(
        why.to_string(),
        "the card of model \"m\" does not tell what it learned from; export it again from its run with this \
         version of motiongen"
    );
    assert_eq!(MusicSplit::Unknown.name(), "unknown");
}
