//! `--dancers`: groups in the tables and as files.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use motiongen::motion::npy::read_f32;
use motiongen::store::{Location, Snapshot, StoreError, tables};
use ndarray::Array3;

use super::{beat_list, clicks, constructed, contents, from, library, write_captures};
use crate::support::{Dir, motion};

/// Motion of all phrases of a store, [N, T, 25] each.
fn groups(store: &Path) -> BTreeMap<String, Array3<f32>> {
    let location = Location::local(store).expect("a store");
    let table = Snapshot::take(&location, tables::motion()).expect("a table");
    let wanted: BTreeSet<String> = constructed(store).into_keys().collect();
    let mut found = BTreeMap::new();
    let visited = table.visit_groups(&wanted, |id, frames| {
        assert!(found.insert(id.to_owned(), frames).is_none(), "{id} comes twice");
        Ok::<_, StoreError>(())
    });
    visited.expect("groups");
    found
}

/// Writes two songs of 42 s: a span of a group lasts 12.8 s in the march and 12.7 s in the waltz.
fn write_long_songs(dir: &Dir) {
    for (name, tempo_bpm, beats_per_bar) in [("march", 150.0, 4), ("waltz", 141.3, 3)] {
        dir.write(format!("songs/{name}.wav"), clicks(tempo_bpm, 42.0));
        let list = beat_list(tempo_bpm, 42.0, beats_per_bar);
        dir.write(format!("songs/{name}.beats.txt"), list);
    }
}

fn least_distance_m(group: &Array3<f32>) -> f64 {
    let (n_dancers, n_frames, _) = group.dim();
    let mut least = f64::INFINITY;
    for t in 0..n_frames {
        for i in 0..n_dancers {
            for j in 0..i {
                let apart = |c: usize| f64::from(group[[i, t, c]] - group[[j, t, c]]);
                least = least.min(apart(0).hypot(apart(2)));
            }
        }
    }
    least
}

#[test]
fn groups_lie_in_tables_and_files_with_what_is_known_of_them() {
    let dir = Dir::new();
    write_long_songs(&dir);
    let (songs, captures) = (dir.at("songs"), write_captures(&dir));
    let (store, files) = (dir.at("store"), dir.at("files"));
    let path = files.to_str().expect("UTF-8").to_owned();
    let asked = ["--takes", "4", "--dancers", "2..4"];
    let output =
        library(&store, &from(&songs, &captures, &[&asked[..], &["--output", &path]].concat()));
    assert_eq!(output.code, 0, "{output:?}");

    // 1260 frames: 20 phrases a take.
    let (rows, motion) = (constructed(&store), groups(&store));
    assert_eq!((rows.len(), motion.len()), (160, 160));
    let mut of_take: BTreeMap<&str, i32> = BTreeMap::new();
    let mut counts: BTreeMap<i32, usize> = BTreeMap::new();
    let (mut formations, mut unisons) = (BTreeMap::new(), BTreeMap::new());
    for (id, row) in &rows {
        let group = &motion[id];
        let n_dancers = row.n_dancers.expect("dancers");
        assert_eq!(group.dim(), (n_dancers as usize, 120, 25), "{id}");
        let take = id.rsplit_once('.').expect("a number").0;
        assert_eq!(*of_take.entry(take).or_insert(n_dancers), n_dancers, "{id}");
        *counts.entry(n_dancers).or_default() += 1;
        let least = least_distance_m(group);
        assert!(least >= 0.7, "{id}: {least}");
        let centre = |c: usize| (0..group.dim().0).map(|k| group[[k, 0, c]]).sum::<f32>();
        assert!(centre(0).abs() < 1e-5 && centre(2).abs() < 1e-5, "{id}");
        // Everybody hears the same bar.
        for k in 1..group.dim().0 {
            assert!((0..120).all(|t| group[[k, t, 16]] == group[[0, t, 16]]), "{id}");
        }
        *formations.entry(row.formation.clone()).or_insert(0) += 1;
        *unisons.entry(row.unison.clone()).or_insert(0) += 1;

        let bytes =
            std::fs::read(files.join(format!("motion/{id}/trajectory.npy"))).expect("a file");
        let array = read_f32(&bytes).expect("an array");
        assert_eq!(array.shape, group.shape(), "{id}");
        assert!(array.values.iter().eq(group.iter()), "{id}: values differ");
    }
    assert!(counts.keys().all(|n| (2..=4).contains(n)) && counts.len() > 1, "{counts:?}");
    let names = |of: &BTreeMap<Option<String>, usize>| -> Vec<String> {
        of.keys().map(|kind| kind.clone().unwrap_or("between two".to_owned())).collect()
    };
    let known = ["circle", "line", "rows", "scatter", "v", "between two"];
    assert!(names(&formations).iter().all(|name| known.contains(&name.as_str())), "{formations:?}");
    let known = ["same", "mirrored", "canon", "call_and_response", "free", "between two"];
    assert!(names(&unisons).iter().all(|name| known.contains(&name.as_str())), "{unisons:?}");
    assert!(formations.len() > 3 && unisons.len() > 3, "{formations:?} {unisons:?}");
    // A phrase of 4 s in spans of more than three times that.
    assert!(unisons.get(&None).is_none_or(|n| *n < 40), "{unisons:?}");

    let sizes: Vec<String> =
        counts.iter().map(|(n, phrases)| format!("{phrases} of {n}")).collect();
    let line = format!("  phrases by number of dancers: {}\n", sizes.join(", "));
    assert!(output.stdout.contains(&line), "{}", output.stdout);
    for (start, kinds) in [("formations", &formations), ("unison", &unisons)] {
        let line = output.stdout.lines().find(|line| line.starts_with(&format!("  {start}: ")));
        let line = line.unwrap_or_else(|| panic!("{}", output.stdout));
        for (kind, n) in kinds {
            let kind = kind.as_deref().unwrap_or("between two");
            assert!(line.contains(&format!("{n} {kind}")), "{line}: {kind}");
        }
    }

    // Asked for again, everything is there; other sizes are other dances.
    let before = contents(&store);
    let again = library(&store, &from(&songs, &captures, &asked));
    assert!(again.stdout.contains("  nothing to do: 2 songs are up to date"), "{}", again.stdout);
    contents(&store).assert_same_as(&before);
    let other = from(&songs, &captures, &["--takes", "4", "--dancers", "2..5", "--dry-run"]);
    let other = library(&store, &other);
    assert!(other.stdout.contains("  would dance to 2 songs"), "{}", other.stdout);
}

#[test]
fn groups_of_one_are_soloists() {
    let dir = Dir::new();
    write_long_songs(&dir);
    let (songs, captures) = (dir.at("songs"), write_captures(&dir));
    let (solo, one) = (dir.at("solo"), dir.at("one"));
    assert_eq!(library(&solo, &from(&songs, &captures, &["--takes", "1"])).code, 0);
    let output = library(&one, &from(&songs, &captures, &["--takes", "1", "--dancers", "1"]));
    assert_eq!(output.code, 0, "{output:?}");
    assert!(!output.stdout.contains("formations"), "{}", output.stdout);
    assert!(motion(&solo) == motion(&one), "motion differs");
    let rows = (constructed(&solo), constructed(&one));
    assert_eq!(rows.0, rows.1);
    let told = |row: &tables::PhraseRow| (row.n_dancers, row.formation.clone(), row.unison.clone());
    assert!(rows.1.values().all(|row| told(row) == (Some(1), None, None)));
}

#[test]
fn numbers_of_dancers_that_are_none_are_refused() {
    let dir = Dir::new();
    for (asked, expected) in [
        ("0..3", "a group has 1 to 16 dancers"),
        ("17", "a group has 1 to 16 dancers"),
        ("5..2", "the range ends with 2, before its 5; write 2..5"),
        ("few", "give a number of dancers such as 3, or a range such as 2..5"),
    ] {
        let output = library(&dir.at("store"), &["--dancers", asked]);
        assert_eq!(output.code, 2, "{output:?}");
        let start = format!("invalid value '{asked}' for '--dancers <MIN..MAX>': {expected}");
        assert!(output.stderr.contains(&start), "{}", output.stderr);
    }
}
