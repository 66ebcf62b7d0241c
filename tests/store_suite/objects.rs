//! Objects: written whole or not at all, listed in order, read back as they were.

use std::sync::Barrier;

use bytes::Bytes;
use motiongen::store::{ClientOptions, ListedObject, Location, PutOutcome};

use super::{backends, noise, paths, put, put_file, read};

#[test]
fn a_new_object_of_any_size_reads_back_as_it_was_written() {
    for backend in backends("new") {
        for n in [0, 1, 13_001, (1 << 20) + 3] {
            let (path, bytes) = (format!("folder {n}/ä{n}.bin"), noise(n, 1 + n as u64));
            assert_eq!(
                put(&backend.location, &path, &bytes),
                PutOutcome::Written,
                "{backend}: {n}"
            );
            assert!(read(&backend.location, &path) == bytes, "{backend}: {n} bytes differ");
        }
    }
}

#[test]
fn a_put_over_an_existing_object_leaves_it_as_it_was() {
    for backend in backends("over") {
        assert_eq!(
            put(&backend.location, "commits/a.json", b"first"),
            PutOutcome::Written,
            "{backend}"
        );
        for second in [&b"second, and longer"[..], b"", b"first"] {
            let again = put(&backend.location, "commits/a.json", second);
            assert_eq!(again, PutOutcome::AlreadyThere, "{backend}");
            assert_eq!(read(&backend.location, "commits/a.json"), b"first", "{backend}");
        }
    }
}

#[test]
fn a_listing_is_sorted_and_ends_at_the_border_of_its_folder() {
    for backend in backends("list") {
        for (path, n) in [("b/x/2", 5), ("bc/1", 1), ("b/10", 7), ("b.txt", 3), ("a", 0)] {
            put(&backend.location, path, &noise(n, 4));
        }
        let listed = backend.location.list("b").expect("a listing");
        let expected = [("b/10", 7), ("b/x/2", 5)]
            .map(|(path, size_bytes)| ListedObject { path: path.to_owned(), size_bytes });
        assert_eq!(listed, expected, "{backend}");
        let all = ["a", "b.txt", "b/10", "b/x/2", "bc/1"];
        assert_eq!(paths(&backend.location, ""), all, "{backend}");
    }
}

#[test]
fn a_folder_that_nobody_wrote_is_empty() {
    for backend in backends("missing") {
        assert_eq!(paths(&backend.location, ""), [""; 0], "{backend}");
        put(&backend.location, "there/1", b"x");
        assert_eq!(paths(&backend.location, "not there"), [""; 0], "{backend}");
        assert_eq!(paths(&backend.location, "there/1/below"), [""; 0], "{backend}");
    }
}

#[test]
fn a_listing_passes_over_what_a_killed_writer_left_behind() {
    for backend in backends("partial") {
        let location = &backend.location;
        put(location, "t/1.parquet", b"x");
        let temporary = location.temporary("t/2.parquet").expect("a temporary file");
        // `keep` leaves the file behind, as a kill does.
        let (_file, left_behind) = temporary.keep().expect("a file to leave behind");
        assert_eq!(paths(location, ""), ["t/1.parquet"], "{backend}");
        if let Some(root) = location.local_path() {
            assert!(left_behind.starts_with(root.join("t")), "{}", left_behind.display());
            std::fs::write(root.join("t/.hidden.parquet"), "x").expect("a hidden file");
            assert_eq!(paths(location, "t"), ["t/1.parquet"], "{backend}");
        } else {
            std::fs::remove_file(left_behind).expect("removed");
        }
    }
}

#[test]
fn many_objects_are_read_in_the_order_asked_for_repetitions_included() {
    for backend in backends("many") {
        let path = |i: usize| format!("m/{i}");
        for i in 0..41 {
            put(&backend.location, &path(i), &noise(3 * i, i as u64));
        }
        let order: Vec<usize> = (0..59).map(|k| k * 17 % 41).collect();
        let listed: Vec<_> = order
            .iter()
            .map(|&i| ListedObject { path: path(i), size_bytes: 3 * i as u64 })
            .collect();
        let contents = backend.location.read_many(&listed).expect("all are there");
        assert_eq!(contents.len(), 59, "{backend}");
        for (i, content) in order.into_iter().zip(contents) {
            assert!(content == noise(3 * i, i as u64), "{backend}: object {i}");
        }
    }
}

#[test]
fn a_missing_object_is_named_in_the_error() {
    for backend in backends("none") {
        put(&backend.location, "there", b"x");
        let place = backend.location.url_of("not/here.json");
        let expected = format!("{place}: not found");
        let error = backend.location.read("not/here.json").expect_err("nothing to read");
        assert_eq!(error.to_string(), expected, "{backend}");
        let both = ["there", "not/here.json"]
            .map(|path| ListedObject { path: path.to_owned(), size_bytes: 1 });
        let error = backend.location.read_many(&both).expect_err("one is missing");
        assert_eq!(error.to_string(), expected, "{backend}");
        if let Some(remote) = &backend.remote {
            let url = remote.stores.url(&remote.bucket, "a folder/ü/not/here.json");
            assert_eq!(place, url);
        }
    }
}

#[test]
fn a_published_file_reads_back_whatever_its_size() {
    // The large one goes up in two parts to a remote store.
    for (n, n_parts) in [(0, 0), (40_961, 0), ((9 << 20) + 7, 2)] {
        for backend in backends("file") {
            let (location, bytes) = (&backend.location, noise(n, 7));
            assert_eq!(
                put_file(location, "t/a.parquet", &bytes),
                PutOutcome::Written,
                "{backend}: {n}"
            );
            let other = noise(n + 1, 8);
            let again = put_file(location, "t/a.parquet", &other);
            assert_eq!(again, PutOutcome::AlreadyThere, "{backend}: {n}");
            assert!(read(location, "t/a.parquet") == bytes, "{backend}: {n} bytes differ");
            assert_eq!(paths(location, ""), ["t/a.parquet"], "{backend}: {n}");
            if let Some(root) = location.local_path() {
                let all = std::fs::read_dir(root.join("t")).expect("the folder").count();
                assert_eq!(all, 1, "a temporary file is left over");
            }
            if let Some(remote) = &backend.remote {
                let requests = remote.stores.requests();
                let parts = requests.iter().filter(|r| r.target.contains("partNumber="));
                assert_eq!(parts.count(), n_parts, "{backend}: {n}");
            }
        }
    }
}

#[test]
fn a_large_object_is_read_in_ranges_of_8_mib() {
    for backend in backends("ranges") {
        let bytes = noise((17 << 20) + 11, 5);
        assert_eq!(put_file(&backend.location, "large", &bytes), PutOutcome::Written, "{backend}");
        assert!(read(&backend.location, "large") == bytes, "{backend}: bytes differ");
        let Some(remote) = &backend.remote else { continue };
        let requests = remote.stores.requests();
        let ranges: Vec<_> = requests
            .iter()
            .filter(|r| r.method == "GET")
            .map(|r| r.headers.get("range").unwrap_or("none"))
            .collect();
        let expected = ["bytes=0-8388607", "bytes=8388608-16777215", "bytes=16777216-17825802"];
        assert_eq!(ranges, expected, "{backend}");
    }
}

#[test]
fn of_eight_threads_that_create_one_object_exactly_one_succeeds() {
    for backend in backends("race") {
        for round in 0..5 {
            let path = format!("commits/ingest/{round}.json");
            let start = Barrier::new(8);
            let bytes_of = |i: usize| noise(100 + i, i as u64);
            let outcomes: Vec<PutOutcome> = std::thread::scope(|scope| {
                let create = |i| {
                    let (location, path, start) = (&backend.location, &path, &start);
                    scope.spawn(move || {
                        start.wait();
                        put(location, path, &bytes_of(i))
                    })
                };
                let threads: Vec<_> = (0..8).map(create).collect();
                threads.into_iter().map(|t| t.join().expect("no panic")).collect()
            });
            let winners: Vec<_> = (0..8).filter(|&i| outcomes[i] == PutOutcome::Written).collect();
            let [winner] = winners[..] else { panic!("{backend}: {outcomes:?}") };
            assert_eq!(read(&backend.location, &path), bytes_of(winner), "{backend}");
        }
        assert_eq!(paths(&backend.location, "").len(), 5, "{backend}");
    }
}

#[test]
fn every_opening_of_a_memory_store_sees_the_same_objects() {
    let open = |url| Location::open(url, &ClientOptions::default()).expect("a store in memory");
    open("memory://shared/a").put_new("b/c", Bytes::from_static(b"x")).expect("written");
    assert_eq!(paths(&open("memory://shared"), ""), ["a/b/c"]);
    assert_eq!(open("memory://shared/a/b").read("c").expect("there"), "x");
    assert_eq!(paths(&open("memory://other"), ""), [""; 0]);
}

#[test]
fn locations_that_cannot_be_opened_are_refused_in_a_sentence() {
    let hint = "; use a path, file://, gs://, s3://, az:// or memory://NAME";
    for (text, reason) in [
        ("", "is empty"),
        ("ftp://host/x", "has the unknown scheme ftp://"),
        ("memory://", "has no bucket or container name after memory://"),
        ("file://host/x", "is not a local path"),
        ("s3://a b/", "is not a URL (invalid domain character)"),
    ] {
        let error = Location::open(text, &ClientOptions::default()).expect_err(text);
        assert_eq!(error.to_string(), format!("location \"{text}\" {reason}{hint}"));
    }
}

#[test]
fn permission_to_a_local_folder_is_left_to_the_operating_system() {
    // Root may write anywhere, so a refused local write is not tried here; the remote
    // refusals are in `faults`. A file where the folder should be is refused to everybody.
    let folder = tempfile::tempdir().expect("a temporary folder");
    let file = folder.path().join("a file");
    std::fs::write(&file, "x").expect("a file");
    let location = Location::local(&file).expect("a location");
    let error = location.put_new("t/x", Bytes::new()).expect_err("a file is no folder");
    assert_eq!(error.to_string(), format!("{}: could not write", location.url_of("t/x")));
    assert!(super::chain(&error).ends_with("could not write: Not a directory (os error 20)"));
}
