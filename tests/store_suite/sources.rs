//! Sources: files fetched ahead in order and within bounds, and kept in a cache.

use std::collections::BTreeSet;
use std::io::{Read as _, Seek as _};
use std::path::Path;
use std::time::Duration;

use motiongen::store::{Cache, ClientOptions, Content, Source, SourceFile};
use object_store::{ObjectStoreExt as _, path::Path as ObjectPath};

use super::{Backend, PREFIX, backends, noise, put, put_file, remote_backends};

/// Options under which three files are fetched ahead.
fn three_ahead() -> ClientOptions {
    ClientOptions { n_requests: 3, ..ClientOptions::default() }
}

fn listed(source: &Source) -> Vec<SourceFile> {
    let listing = source.list().expect("a listing");
    assert_eq!(listing.problems, []);
    listing.files
}

/// Reads files in order into memory, whichever way they are handed over.
fn contents(source: &Source, files: &[SourceFile]) -> Vec<Vec<u8>> {
    source
        .read_in_order(files.to_vec())
        .map(|(content, _)| bytes(content.expect("there")))
        .collect()
}

fn bytes(content: Content) -> Vec<u8> {
    match content {
        Content::Bytes(bytes) => bytes.to_vec(),
        Content::File(mut file) => {
            assert_eq!(file.stream_position().expect("a position"), 0, "not at its start");
            let mut bytes = Vec::new();
            file.read_to_end(&mut bytes).expect("a readable file");
            bytes
        }
    }
}

/// Waits until a server has had no new request for a while, and returns what was fetched.
fn fetched_at_rest(backend: &Backend) -> Vec<String> {
    let remote = backend.remote.as_ref().expect("a remote location");
    let mut before = None;
    loop {
        let fetched = remote.fetched();
        if before == Some(fetched.len()) {
            return fetched;
        }
        before = Some(fetched.len());
        std::thread::sleep(Duration::from_millis(400));
    }
}

#[test]
fn a_source_lists_every_file_sorted_with_a_fingerprint_of_its_own() {
    for backend in backends("source") {
        for (path, n) in [("b/é.npy", 11), ("a.wav", 0), ("b.txt", 7), ("b/c/d", 3)] {
            put(&backend.location, path, &noise(n, n as u64));
        }
        let source = Source::at(backend.location.clone(), &three_ahead(), None);
        let files = listed(&source);
        let found: Vec<_> = files.iter().map(|f| (f.path.as_str(), f.size_bytes)).collect();
        let expected = [("a.wav", 0), ("b.txt", 7), ("b/c/d", 3), ("b/é.npy", 11)];
        assert_eq!(found, expected, "{backend}");
        let fingerprints: BTreeSet<_> = files.iter().map(|f| &f.fingerprint).collect();
        assert_eq!(fingerprints.len(), 4, "{backend}: {files:?}");
        assert_eq!(listed(&source), files, "{backend}: a second listing differs");
    }
}

#[test]
fn files_come_in_the_order_asked_for_and_few_are_fetched_ahead() {
    for backend in backends("order") {
        for i in 0..29 {
            put(&backend.location, &format!("f/{i:02}"), &noise(1_000 + 37 * i, i as u64));
        }
        let source = Source::at(backend.location.clone(), &three_ahead(), None);
        let mut files = listed(&source);
        assert_eq!(files.len(), 29, "{backend}");
        files.reverse();
        let mut reader = source.read_in_order(files.clone());
        let mut read = vec![bytes(reader.next().expect("29 files").0.expect("there"))];
        if backend.remote.is_some() {
            // Three under way, one waiting to be taken, one on its way there, one taken.
            let ahead = fetched_at_rest(&backend);
            assert!((1..=6).contains(&ahead.len()), "{backend}: {ahead:?}");
        }
        read.extend(reader.map(|(content, _)| bytes(content.expect("there"))));
        let expected: Vec<_> = (0..29).rev().map(|i| noise(1_000 + 37 * i, i as u64)).collect();
        assert!(read == expected, "{backend}: contents or their order differ");
        if backend.remote.is_some() {
            assert_eq!(fetched_at_rest(&backend).len(), 29, "{backend}: fetched more than once");
        }
    }
}

#[test]
fn large_files_come_as_open_files_and_wait_for_room_in_the_budget() {
    // 64 MiB are fetched ahead at most: three of these, and not a fourth.
    let size = |i: usize| (17 << 20) + 7 * i;
    for backend in backends("large") {
        for i in 0..5 {
            put_file(&backend.location, &format!("{i}.wav"), &noise(size(i), i as u64));
        }
        let source = Source::at(backend.location.clone(), &ClientOptions::default(), None);
        let files = listed(&source);
        let mut reader = source.read_in_order(files);
        let mut first = Some(reader.next().expect("five files"));
        if backend.remote.is_some() {
            let ahead: BTreeSet<_> = fetched_at_rest(&backend).into_iter().collect();
            let expected = ["0.wav", "1.wav", "2.wav"].map(str::to_owned).into();
            assert_eq!(ahead, expected, "{backend}");
        }
        for i in 0..5 {
            let (content, budget) = first.take().or_else(|| reader.next()).expect("five files");
            let content = content.expect("there");
            assert!(matches!(content, Content::File(_)), "{backend}: {i} is in memory");
            assert!(bytes(content) == noise(size(i), i as u64), "{backend}: {i} differs");
            drop(budget);
        }
        assert!(reader.next().is_none(), "{backend}");
    }
}

#[test]
fn a_file_that_went_away_after_the_listing_fails_alone() {
    for backend in backends("gone") {
        for i in 0..5 {
            put(&backend.location, &format!("{i}"), &[i; 3]);
        }
        let source = Source::at(backend.location.clone(), &three_ahead(), None);
        let mut files = listed(&source);
        files[2].path = "2 is gone".to_owned();
        let read: Vec<_> = source
            .read_in_order(files)
            .map(|(content, _)| content.map(bytes).map_err(|e| e.to_string()))
            .collect();
        let place = match backend.location.local_path() {
            Some(root) => root.join("2 is gone").display().to_string(),
            None => backend.location.url_of("2 is gone"),
        };
        let expected = [0, 1, 2, 3, 4].map(|i| match i {
            2 => Err(format!("{place}: not found")),
            i => Ok(vec![i; 3]),
        });
        assert_eq!(read, expected, "{backend}");
    }
}

#[test]
fn a_missing_local_source_is_an_error_and_an_empty_remote_prefix_is_empty() {
    for backend in backends("nothing") {
        let source = Source::at(backend.location.clone(), &three_ahead(), None);
        match (source.list(), backend.location.local_path()) {
            (Err(e), Some(root)) => {
                assert_eq!(e.to_string(), format!("{}: not found", root.display()))
            }
            (Ok(listing), None) => assert_eq!(listing.files, [], "{backend}"),
            (other, _) => panic!("{backend}: {other:?}"),
        }
    }
}

/// Returns a source with a cache of `max_bytes` in `folder`.
fn cached(backend: &Backend, folder: &Path, max_bytes: u64) -> Source {
    let cache = Cache::open(folder, max_bytes).expect("a cache");
    Source::at(backend.location.clone(), &three_ahead(), Some(cache))
}

fn entry_sizes(folder: &Path) -> Vec<u64> {
    let entries = std::fs::read_dir(folder).expect("the cache folder");
    entries.map(|e| e.and_then(|e| e.metadata()).expect("an entry").len()).collect()
}

#[test]
fn a_second_reading_with_a_cache_fetches_changed_objects_alone() {
    for backend in remote_backends("cache", 3) {
        let remote = backend.remote.as_ref().expect("a remote location");
        let folder = tempfile::tempdir().expect("a temporary folder");
        for i in 0..7 {
            put(&backend.location, &format!("{i}"), &noise(500 + i, i as u64));
        }
        let mut expected: Vec<_> = (0..7).map(|i| noise(500 + i, i as u64)).collect();
        let source = cached(&backend, folder.path(), 1 << 20);
        assert!(contents(&source, &listed(&source)) == expected, "{backend}: first reading");
        assert_eq!(remote.fetched().len(), 7, "{backend}");

        let source = cached(&backend, folder.path(), 1 << 20);
        assert!(contents(&source, &listed(&source)) == expected, "{backend}: second reading");
        assert_eq!(remote.fetched().len(), 7, "{backend}: fetched again");

        // Of the same size, so that only the entity tag tells.
        expected[3] = noise(503, 99);
        let client = remote.stores.client(&remote.bucket);
        let path = ObjectPath::parse(format!("{PREFIX}/3")).expect("a key");
        let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build();
        let put = client.put(&path, expected[3].clone().into());
        runtime.expect("a runtime").block_on(put).expect("written");
        let source = cached(&backend, folder.path(), 1 << 20);
        assert!(contents(&source, &listed(&source)) == expected, "{backend}: third reading");
        assert_eq!(remote.fetched()[7..], ["3"], "{backend}");
    }
}

#[test]
fn a_cache_stays_within_its_bound_and_its_files_stay_right() {
    for backend in remote_backends("bound", 3) {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let expected: Vec<_> = (0..11).map(|i| noise(3_000 + 501 * i, i as u64)).collect();
        for (i, bytes) in expected.iter().enumerate() {
            put(&backend.location, &format!("{i:02}"), bytes);
        }
        for round in 0..3 {
            let source = cached(&backend, folder.path(), 20_011);
            assert!(contents(&source, &listed(&source)) == expected, "{backend}: round {round}");
            let sizes = entry_sizes(folder.path());
            let total: u64 = sizes.iter().sum();
            assert!(total > 0 && total <= 20_011, "{backend}: {sizes:?}");
        }
    }
}

#[test]
fn a_cached_file_that_was_cut_is_fetched_again() {
    for backend in remote_backends("cache-cut", 3) {
        let folder = tempfile::tempdir().expect("a temporary folder");
        put(&backend.location, "song.wav", &noise(4_001, 1));
        for _ in 0..2 {
            let source = cached(&backend, folder.path(), 1 << 20);
            assert!(contents(&source, &listed(&source)) == [noise(4_001, 1)], "{backend}");
            let entries = std::fs::read_dir(folder.path()).expect("the cache folder");
            for entry in entries {
                let path = entry.expect("an entry").path();
                let file = std::fs::File::options().write(true).open(path).expect("an entry");
                file.set_len(1_999).expect("cut");
            }
        }
        assert_eq!(backend.remote.expect("a remote location").fetched().len(), 2);
    }
}

#[test]
fn local_files_are_read_where_they_are_and_never_cached() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    for backend in backends("uncached").into_iter().filter(|b| b.location.local_path().is_some()) {
        put(&backend.location, "song.wav", &noise(4_001, 1));
        let source = cached(&backend, folder.path(), 1 << 20);
        assert!(contents(&source, &listed(&source)) == [noise(4_001, 1)], "{backend}");
        assert_eq!(entry_sizes(folder.path()), [0; 0]);
    }
}

#[test]
fn a_cache_that_cannot_be_used_is_refused_with_its_folder() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("a file");
    std::fs::write(&file, "x").expect("a file");
    let error = Cache::open(&file, 1).expect_err("a file is no folder");
    let expected = format!(
        "cache {}: cannot be used (File exists (os error 17)); name a folder that may be written",
        file.display()
    );
    assert_eq!(error.to_string(), expected);
}
