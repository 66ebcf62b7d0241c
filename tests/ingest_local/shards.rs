//! However a job is cut, the tables hold the same rows.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use motiongen::store::tables::PhraseRow;

use super::write_motion;
use crate::support::files::{Frame, wav};
use crate::support::{Dir, failures, finish, ingest, ingest_command, motion, phrases, tree};

/// 37 phrases of motion, no two of one length.
fn source(dir: &Dir) -> PathBuf {
    let source = dir.at("source");
    for i in 0..37 {
        write_motion(&source, &format!("take {}/{i}", i % 3), 1 + (i * 7) % 41, i as u32);
    }
    source
}

type Rows = (
    BTreeMap<String, PhraseRow>,
    BTreeMap<String, Vec<Frame>>,
    Vec<(String, String, String, String)>,
);

/// Every row of a store but the time of the failures.
fn all_rows(store: &Path) -> Rows {
    let failures = failures(store).into_values();
    let failures = failures.map(|row| (row.phrase_id, row.source, row.kind, row.message));
    (phrases(store), motion(store), failures.collect())
}

/// Every file of a store without its time.
fn all_bytes(store: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    tree(store).into_iter().map(|(path, (bytes, _))| (path, bytes)).collect()
}

#[test]
fn any_number_of_shards_gives_the_same_rows() {
    let dir = Dir::new();
    let source = source(&dir);
    dir.write("source/motion/broken/trajectory.npy", "");
    dir.write("source/motion/misnamed/trajectory.npz", "");
    dir.write("source/audio/also broken.wav", "text");
    dir.write("source/audio/take 1/1.wav", wav(8.0 / 30.0));
    let whole = dir.at("whole");
    assert_eq!(ingest(&source, &whole, &["--workers", "1"]).code, 1);
    let expected = all_rows(&whole);
    assert_eq!((expected.0.len(), expected.1.len(), expected.2.len()), (37, 37, 3));

    for (order, workers, batch_phrases) in [
        (&[0][..], "5", "1"),
        (&[1, 0], "3", "4"),
        (&[2, 0, 1], "2", "512"),
        (&[3, 1, 4, 0, 2], "1", "7"),
    ] {
        let n_shards = order.len();
        let store = dir.at(format!("store of {n_shards}"));
        for i in order {
            let shard = format!("{i}/{n_shards}");
            let more = ["--shard", &shard, "--workers", workers, "--batch-phrases", batch_phrases];
            let output = ingest(&source, &store, &more);
            assert!([0, 1].contains(&output.code), "{output:?}");
        }
        assert_eq!(all_rows(&store), expected, "{n_shards} shards");
    }
}

#[test]
fn two_or_four_shards_write_the_bytes_of_one() {
    let dir = Dir::new();
    let source = source(&dir);
    let whole = dir.at("whole");
    // 37 phrases, five to a batch, make eight batches.
    let more = ["--batch-phrases", "5", "--workers", "3"];
    assert_eq!(ingest(&source, &whole, &more).code, 0);
    let expected = all_bytes(&whole);
    for order in [&[1, 0][..], &[2, 0, 3, 1]] {
        let n_shards = order.len();
        let store = dir.at(format!("store of {n_shards}"));
        for i in order {
            let shard = format!("{i}/{n_shards}");
            let more = ["--batch-phrases", "5", "--shard", &shard];
            assert_eq!(ingest(&source, &store, &more).code, 0);
        }
        let found = all_bytes(&store);
        assert_eq!(found.keys().collect::<Vec<_>>(), expected.keys().collect::<Vec<_>>());
        for (path, bytes) in &expected {
            assert!(found[path] == *bytes, "{} differs in {n_shards} shards", path.display());
        }
    }
}

#[test]
fn an_array_job_takes_its_shard_from_the_environment() {
    let dir = Dir::new();
    let (source, store) = (source(&dir), dir.at("store"));
    let (auto, named) = (dir.at("auto"), dir.at("named"));
    let mut command = ingest_command(&source, &auto, &["--shard", "auto"]);
    command.env("SLURM_ARRAY_TASK_ID", "6").env("SLURM_ARRAY_TASK_COUNT", "3");
    assert_eq!(finish(command.env("SLURM_ARRAY_TASK_MIN", "5")).code, 0);
    assert_eq!(ingest(&source, &named, &["--shard", "1/3"]).code, 0);
    let ids: Vec<_> = phrases(&auto).into_keys().collect();
    assert!((1..37).contains(&ids.len()), "{} phrases", ids.len());
    assert_eq!(ids, phrases(&named).into_keys().collect::<Vec<_>>());

    let output = finish(&mut ingest_command(&source, &store, &["--shard", "auto"]));
    assert_eq!(output.code, 2);
    assert_eq!(
        output.stderr,
        "error: shard \"auto\" finds none of SLURM_ARRAY_TASK_ID, JOB_COMPLETION_INDEX, \
         BATCH_TASK_INDEX set; write it as i/n with 0 <= i < n, or \"auto\"\n"
    );
    assert!(!store.exists());
}
