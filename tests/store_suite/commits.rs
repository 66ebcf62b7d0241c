//! Commits: what readers see of finished, repeated, replaced, rival and damaged work.

use motiongen::store::tables::{FailureRow, motion};
use motiongen::store::{
    Commit, CommitResult, Item, Ledger, Location, Row as _, Snapshot, StoreError, StoreSnapshot,
    TableSchema, TimestampUs,
};
use ndarray::Array2;

use super::{backends, chain, paths, put, put_file, read};

pub(super) const STAGE: &str = "ingest";

/// Returns the outcome of an item; `message` stands for what was read.
pub(super) fn outcome(id: &str, message: &str) -> FailureRow {
    FailureRow {
        stage: STAGE.to_owned(),
        phrase_id: id.to_owned(),
        source: format!("file:///{id}"),
        kind: "shape".to_owned(),
        message: message.to_owned(),
        time: TimestampUs(1_700_000_000_000_001),
    }
}

pub(super) fn item(id: &str, message: &str) -> Item {
    Item {
        id: id.to_owned(),
        fingerprint: String::new(),
        input_hash: message.to_owned(),
        failure: Some(message.to_owned()),
    }
}

/// Commits outcomes as a process does that has read `ledger`.
pub(super) fn commit(
    location: &Location,
    ledger: &Ledger,
    outcomes: &[(&str, &str)],
) -> CommitResult {
    let mut commit = Commit::new(location, STAGE, "rules", "file:///source");
    let rows: Vec<_> = outcomes.iter().map(|(id, message)| outcome(id, message)).collect();
    let part = commit.part("failures", FailureRow::schema).expect("a temporary file");
    part.write_rows(&rows).expect("rows");
    for (id, message) in outcomes {
        commit.settle(item(id, message), ledger);
    }
    commit.publish().unwrap_or_else(|e| panic!("{}", chain(&e)))
}

pub(super) fn ledger(location: &Location) -> Ledger {
    Ledger::read(location, STAGE).unwrap_or_else(|e| panic!("{}", chain(&e)))
}

pub(super) fn snapshot(location: &Location) -> Snapshot {
    Snapshot::take(location, FailureRow::schema()).unwrap_or_else(|e| panic!("{}", chain(&e)))
}

/// Returns what readers see: items and messages, sorted.
pub(super) fn visible(snapshot: &Snapshot) -> Vec<(String, String)> {
    let rows = snapshot.rows::<FailureRow>().unwrap_or_else(|e| panic!("{}", chain(&e)));
    let mut seen: Vec<_> = rows.into_iter().map(|r| (r.phrase_id, r.message)).collect();
    seen.sort();
    seen
}

#[track_caller]
fn assert_visible(location: &Location, expected: &[(&str, &str)]) {
    let seen = visible(&snapshot(location));
    let seen: Vec<_> = seen.iter().map(|(id, message)| (id.as_str(), message.as_str())).collect();
    assert_eq!(seen, expected, "{location}");
}

#[test]
fn a_store_that_nobody_has_written_is_empty() {
    for backend in backends("empty") {
        assert_visible(&backend.location, &[]);
        assert!(ledger(&backend.location).get("a").is_none(), "{backend}");
        assert_eq!(paths(&backend.location, ""), [""; 0], "{backend}: reading wrote something");
    }
}

#[test]
fn committed_rows_and_their_ledger_read_back_in_order_of_their_parts() {
    for backend in backends("commit") {
        let location = &backend.location;
        let committed = commit(location, &Ledger::default(), &[("a", "1"), ("b ü/ä", "2")]);
        assert_eq!((committed.n_rows, committed.already_there), (2, false), "{backend}");
        commit(location, &ledger(location), &[("c", "3")]);
        assert_visible(location, &[("a", "1"), ("b ü/ä", "2"), ("c", "3")]);
        assert_eq!(paths(location, "commits/ingest").len(), 2, "{backend}");
        let parts = snapshot(location).parts().to_vec();
        assert!(parts.is_sorted_by(|a, b| a.part.path < b.part.path), "{backend}");
        let n_bytes: u64 = parts.iter().map(|p| p.part.n_bytes).sum();
        let stored: usize = parts.iter().map(|p| read(location, &p.part.path).len()).sum();
        assert_eq!(n_bytes, stored as u64, "{backend}");
        let ledger = ledger(location);
        let known = ledger.get("b ü/ä").expect("settled");
        assert_eq!(known.item, item("b ü/ä", "2"), "{backend}");
        assert_eq!(
            (known.params_hash.as_str(), known.origin.as_str()),
            ("rules", "file:///source")
        );
        assert!(Ledger::read(location, "train").expect("another stage").get("a").is_none());
    }
}

#[test]
fn a_part_without_a_manifest_is_invisible() {
    for backend in backends("orphan") {
        let location = &backend.location;
        commit(location, &Ledger::default(), &[("a", "1")]);
        let [part] = &paths(location, "failures")[..] else { panic!("{backend}: not one part") };
        // What a process leaves that was killed between its part and its manifest.
        let orphan = read(location, part);
        put_file(location, "failures/00000000000000000000000000000000.parquet", &orphan);
        put(location, "failures/notes.txt", b"not a part at all");
        assert_visible(location, &[("a", "1")]);
        assert_eq!(snapshot(location).parts().len(), 1, "{backend}");
    }
}

#[test]
fn a_later_commit_replaces_the_rows_of_its_items_and_no_others() {
    for backend in backends("later") {
        let location = &backend.location;
        commit(location, &Ledger::default(), &[("a", "1"), ("b", "1"), ("c", "1")]);
        let before = snapshot(location);
        commit(location, &ledger(location), &[("b", "2")]);
        assert_visible(location, &[("a", "1"), ("b", "2"), ("c", "1")]);
        commit(location, &ledger(location), &[("a", "3"), ("b", "3"), ("c", "3")]);
        assert_visible(location, &[("a", "3"), ("b", "3"), ("c", "3")]);
        assert_eq!(snapshot(location).parts().len(), 1, "{backend}: replaced parts are read");
        // Back to the first input: the same content, and yet the latest word.
        commit(location, &ledger(location), &[("a", "1"), ("b", "1"), ("c", "1")]);
        assert_visible(location, &[("a", "1"), ("b", "1"), ("c", "1")]);
        assert_eq!(paths(location, "commits").len(), 4, "{backend}");
        let expected = ["a", "b", "c"].map(|id| (id.to_owned(), "1".to_owned()));
        assert_eq!(visible(&before), expected, "{backend}: an older snapshot lost its rows");
    }
}

#[test]
fn the_same_work_by_several_processes_leaves_one_commit() {
    for backend in backends("same") {
        let location = &backend.location;
        let work = [("a", "1"), ("b", "2"), ("c", "3")];
        let outcomes: Vec<CommitResult> = std::thread::scope(|scope| {
            let process = |_| scope.spawn(|| commit(location, &Ledger::default(), &work));
            let processes: Vec<_> = (0..5).map(process).collect();
            processes.into_iter().map(|p| p.join().expect("no panic")).collect()
        });
        let first = outcomes.iter().filter(|c| !c.already_there).count();
        assert_eq!(first, 1, "{backend}: {outcomes:?}");
        assert_eq!(paths(location, "commits").len(), 1, "{backend}");
        assert_eq!(paths(location, "failures").len(), 1, "{backend}");
        assert_visible(location, &work);
    }
}

#[test]
fn of_two_rival_commits_of_one_item_every_reader_sees_the_same_one() {
    for backend in backends("rival") {
        let location = &backend.location;
        // Neither knew of the other, and they read different contents of `b`.
        commit(location, &Ledger::default(), &[("a", "1"), ("b", "1")]);
        commit(location, &Ledger::default(), &[("b", "2"), ("c", "2")]);
        let seen = visible(&snapshot(location));
        let of_b: Vec<_> = seen.iter().filter(|(id, _)| id == "b").collect();
        assert_eq!((seen.len(), of_b.len()), (3, 1), "{backend}: {seen:?}");
        assert_eq!(visible(&snapshot(location)), seen, "{backend}");
        let known = ledger(location).get("b").expect("settled").item.input_hash.clone();
        assert_eq!(of_b[0].1, known, "{backend}: ledger and rows disagree");
        // The next one that does it ends the rivalry.
        commit(location, &ledger(location), &[("b", "3")]);
        assert_visible(location, &[("a", "1"), ("b", "3"), ("c", "2")]);
    }
}

#[test]
fn an_item_settled_without_rows_loses_the_rows_that_it_had() {
    for backend in backends("settled") {
        let location = &backend.location;
        commit(location, &Ledger::default(), &[("a", "1"), ("b", "1")]);
        let mut healed = Commit::new(location, STAGE, "rules", "file:///source");
        let done = Item { failure: None, ..item("a", "2") };
        healed.settle(done, &ledger(location));
        healed.publish().expect("published");
        assert_visible(location, &[("b", "1")]);
    }
}

#[test]
fn a_damaged_manifest_is_refused_with_its_place_and_the_damage() {
    for (text, reason) in [
        ("", "EOF while parsing a value at line 1 column 0"),
        ("{\"format\": 1, \"sta", "EOF while parsing a string at line 1 column 18"),
        ("{\"format\": 1}", "missing field `stage` at line 1 column 13"),
    ] {
        for backend in backends("damaged") {
            let location = &backend.location;
            commit(location, &Ledger::default(), &[("a", "1")]);
            put(location, "commits/ingest/0123.json", text.as_bytes());
            let expected = format!(
                "{}: commit manifest is damaged ({reason}); move it away and run the stage again",
                location.url_of("commits/ingest/0123.json")
            );
            let error = Snapshot::take(location, FailureRow::schema()).expect_err("damaged");
            assert_eq!(error.to_string(), expected, "{backend}");
            let error = Ledger::read(location, STAGE).expect_err("damaged");
            assert_eq!(error.to_string(), expected, "{backend}");
            assert!(Ledger::read(location, "train").is_ok(), "{backend}: another stage suffers");
        }
    }
}

#[test]
fn a_manifest_of_another_format_asks_for_a_newer_program() {
    let newer = r#"{"format": 3, "stage": "ingest", "key": "k", "sequence": 0, "program": "p",
        "params_hash": "h", "origin": "o", "parts": [], "items": []}"#;
    for backend in backends("newer") {
        put(&backend.location, "commits/ingest/0123.json", newer.as_bytes());
        let error = Ledger::read(&backend.location, STAGE).expect_err("another format");
        let expected = format!(
            "{}: commit manifest has format 3, this program reads formats up to 2; install a newer motiongen",
            backend.location.url_of("commits/ingest/0123.json")
        );
        assert_eq!(error.to_string(), expected, "{backend}");
    }
}

#[test]
fn what_is_no_manifest_is_left_alone() {
    for backend in backends("beside") {
        commit(&backend.location, &Ledger::default(), &[("a", "1")]);
        put(&backend.location, "commits/ingest/README.txt", b"who put this here?");
        put(&backend.location, "commits.json", b"{");
        assert_visible(&backend.location, &[("a", "1")]);
    }
}

/// Commits three frames of a phrase under a schema.
fn commit_motion(location: &Location, schema: TableSchema) -> String {
    let mut commit = Commit::new(location, STAGE, "rules", "file:///source");
    let n_channels = schema.n_frame_channels();
    let part = commit.part("motion", || schema).expect("a temporary file");
    part.write_frames("a", Array2::zeros((3, n_channels)).view()).expect("frames");
    commit.settle(item("a", "1"), &Ledger::default());
    commit.publish().expect("published");
    let [part] = &paths(location, "motion")[..] else { panic!("{location}: not one part") };
    part.clone()
}

#[test]
fn a_part_of_another_schema_version_is_refused_with_what_to_do() {
    for (version, remedy) in
        [(3, "install a newer motiongen"), (0, "run the stage that wrote it again with --force")]
    {
        for backend in backends("version") {
            let location = &backend.location;
            let part = commit_motion(location, TableSchema { version, ..motion() });
            let error = Snapshot::take(location, motion()).expect_err("another version");
            let expected = format!(
                "table motion: {} has schema version {version}, this program reads versions 1 to 2; \
                 {remedy}",
                location.url_of(&part)
            );
            assert_eq!(error.to_string(), expected, "{backend}");
            // The other tables of the store are read as before.
            assert_visible(location, &[]);
        }
    }
}

/// Returns the first error of reading `motion`.
fn first_error(location: &Location) -> StoreError {
    let snapshot = Snapshot::take(location, motion()).expect("a snapshot");
    let error = snapshot.batches().find_map(Result::err);
    error.unwrap_or_else(|| panic!("{location}: read without an error"))
}

#[test]
fn a_part_with_other_columns_than_its_version_says_is_refused_with_both() {
    for backend in backends("columns") {
        let mut columns = motion().columns;
        columns.truncate(4);
        columns[3].name = "position_u".into();
        let part = commit_motion(&backend.location, TableSchema { columns, ..motion() });
        let text = first_error(&backend.location).to_string();
        let place = backend.location.url_of(&part);
        let start = format!("table motion: {place} lacks columns [\"position_x: Float32\", ");
        let end = "it has [\"phrase_id: Utf8\", \"dancer: Int32\", \"frame: Int32\", \"position_u: Float32\"]";
        assert!(text.starts_with(&start) && text.ends_with(end), "{backend}: {text}");
    }
}

#[test]
fn a_part_that_was_cut_or_lost_is_refused_with_its_place() {
    for backend in backends("cut-part") {
        let location = &backend.location;
        let part = commit_motion(location, motion());
        let bytes = read(location, &part);
        let manifest = paths(location, "commits").remove(0);
        let manifest = String::from_utf8(read(location, &manifest)).expect("JSON");
        // The same commit in another place, with half a part and then without any.
        for (folder, kept) in [("half", Some(bytes.len() / 2)), ("none", None)] {
            let Some(elsewhere) = below(&backend.location, folder) else { continue };
            put(&elsewhere, "commits/ingest/1.json", manifest.as_bytes());
            if let Some(kept) = kept {
                put(&elsewhere, &part, &bytes[..kept]);
            }
            let error = first_error(&elsewhere);
            let place = elsewhere.url_of(&part);
            let expected = format!("table motion: {place} is not a readable Parquet part");
            assert_eq!(error.to_string(), expected, "{backend}");
            assert!(std::error::Error::source(&error).is_some(), "{backend}: no cause");
        }
    }
}

/// Returns a location below a local one or one in memory.
fn below(location: &Location, folder: &str) -> Option<Location> {
    let options = motiongen::store::ClientOptions::default();
    let is_remote = location.url().starts_with("s3:") || location.url().starts_with("gs:");
    let url = format!("{}/{folder}", location.url());
    (!is_remote).then(|| Location::open(&url, &options).expect("a location"))
}

#[test]
fn a_snapshot_is_of_one_moment_in_all_tables() {
    let settle = |location: &Location, n: usize| {
        let known = ledger(location);
        let mut commit = Commit::new(location, STAGE, "rules", "source");
        let frames = Array2::from_elem((n, 25), n as f32);
        commit.part("motion", motion).expect("a part").write_frames("a", frames.view()).expect("a");
        let (text, part) = (n.to_string(), commit.part("failures", FailureRow::schema));
        part.expect("a part").write_rows(&[outcome("b", &text)]).expect("rows");
        commit.settle(Item { failure: None, ..item("a", &text) }, &known);
        commit.settle(item("b", &text), &known);
        commit.publish().expect("published");
    };
    let seen = |taken: &StoreSnapshot| {
        let failures = visible(&taken.table(FailureRow::schema()).expect("a table"));
        let table = taken.table(motion()).expect("a table");
        let n_frames: u64 = table.parts().iter().map(|live| live.part.n_rows).sum();
        let rows: Vec<FailureRow> = taken.item("b").and_then(|b| b.rows()).expect("rows");
        let known = taken.ledger(STAGE).expect("a ledger");
        let known = known.get("a").expect("settled").item.input_hash.clone();
        (n_frames, failures, rows[0].message.clone(), known)
    };
    for backend in backends("one-moment") {
        let location = &backend.location;
        settle(location, 2);
        let before = StoreSnapshot::take(location).expect("a snapshot");
        // What comes between the reading of two tables shows in neither.
        settle(location, 3);
        let expected = |n: u64| {
            let text = n.to_string();
            (n, vec![("b".to_owned(), text.clone())], text.clone(), text)
        };
        assert_eq!(seen(&before), expected(2), "{backend}");
        let after = StoreSnapshot::take(location).expect("a snapshot");
        assert_eq!(after.table(motion()).expect("a table").parts().len(), 1, "{backend}");
        assert_eq!(seen(&after), expected(3), "{backend}");
    }
}
