//! Killing `extract` at any moment costs time and nothing else.

use std::path::Path;
use std::time::Duration;

use super::bad_input::float_wav;
use super::{assert_consistent, contents, copy, extract, extract_command, extractions};
use crate::ingest_kill::Running;
use crate::support::files::{features_npz, wav};
use crate::support::{Dir, failures, ingest};

const N_SONGS: usize = 24;
/// Enough phrases for four batches; feature files cost next to nothing.
const N_IMPORTED: usize = 1_030;

/// When a run is killed.
#[derive(Clone, Copy)]
enum Moment {
    Start(Duration),
    Commit(Duration),
}

fn n_commits(store: &Path) -> usize {
    let Ok(entries) = std::fs::read_dir(store.join("commits/extract")) else { return 0 };
    let names = entries.map(|e| e.unwrap().file_name());
    names.filter(|name| name.as_encoded_bytes().ends_with(b".json")).count()
}

#[test]
fn runs_killed_six_times_commit_what_one_undisturbed_run_commits() {
    let dir = Dir::new();
    for i in 0..N_SONGS {
        dir.write(format!("source/audio/song {i:02}.wav"), wav(0.05 + 0.01 * i as f64));
    }
    // Two that fail, each time with the same sentence, one in each half of the shards below.
    for i in [4, 20] {
        let infinite = float_wav(8_000, &[0.1, f32::INFINITY]);
        dir.write(format!("source/audio/infinite {i:02}.wav"), infinite);
    }
    let (one, two) = (features_npz(1), features_npz(2));
    for i in 0..N_IMPORTED {
        let bytes = if i % 2 == 0 { &one } else { &two };
        dir.write(format!("source/audio_features/set {}/{i:04}/features.npz", i % 7), bytes);
    }
    let (store, whole, shards) = (dir.at("store"), dir.at("whole"), dir.at("shards"));
    let output = ingest(&dir.at("source"), &store, &[]);
    assert_eq!(output.code, 0, "{output:?}");
    for to in [&whole, &shards] {
        copy(&store, to);
    }
    assert_eq!(extract(&whole, &[]).code, 1);
    assert_eq!((n_commits(&whole), failures(&whole).len()), (4, 2));
    assert_eq!(extractions(&whole).len(), N_SONGS + N_IMPORTED);

    let ms = Duration::from_millis;
    let moments = [
        Moment::Start(ms(4)),
        Moment::Start(ms(40)),
        Moment::Commit(ms(0)),
        Moment::Start(ms(90)),
        Moment::Commit(ms(15)),
        Moment::Start(ms(20)),
    ];
    let (mut n_cut, mut history) = (0, Vec::new());
    for moment in moments {
        let before = n_commits(&store);
        let mut running = Running::start(extract_command(&store, &["--workers", "2"]));
        let delay = match moment {
            Moment::Start(delay) => delay,
            Moment::Commit(delay) => {
                while n_commits(&store) <= before && running.is_running() {
                    std::thread::sleep(Duration::from_micros(300));
                }
                delay
            }
        };
        std::thread::sleep(delay);
        n_cut += usize::from(running.kill());
        history.push(n_commits(&store));
        assert_consistent(&store);
    }
    // A kill that comes when everything is done proves nothing.
    let n_unfinished = history.iter().filter(|&&n| n < 4).count();
    assert!(n_cut >= 3 && n_unfinished >= 3, "{history:?}, {n_cut} cut");
    assert!(history.is_sorted(), "committed work went away: {history:?}");

    let output = extract(&store, &["--workers", "1"]);
    assert_eq!(output.code, 1, "{output:?}");
    contents(&store).assert_same_as(&contents(&whole));

    // With whole batches to each, shards commit the same parts, too.
    for shard in ["1/2", "0/2"] {
        assert_eq!(extract(&shards, &["--shard", shard, "--workers", "3"]).code, 1);
    }
    contents(&shards).assert_same_as(&contents(&whole));
}
