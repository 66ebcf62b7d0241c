//! What goes wrong on the way to a remote store: refusals, throttling, lost answers, broken lines.

use bytes::Bytes;
use motiongen::store::PutOutcome;

use super::{Backend, Remote, chain, noise, paths, put, put_file, read, remote_backends};
use crate::servers::faults::Faults;

/// Returns `s3://` and `gs://` locations that hold `data` with these bytes, and their servers.
fn with_object(label: &str, max_retries: usize, bytes: &[u8]) -> Vec<Backend> {
    let backends = remote_backends(label, max_retries);
    for backend in &backends {
        put_file(&backend.location, "data", bytes);
    }
    backends
}

fn remote(backend: &Backend) -> &Remote {
    backend.remote.as_ref().expect("a remote location")
}

fn is_put(method: &str, _path: &str) -> bool {
    method == "PUT"
}

#[test]
fn a_refusal_names_the_place_and_the_variables_that_grant_access() {
    for backend in with_object("deny", 10, b"x") {
        let location = &backend.location;
        let hint = match backend.name {
            "s3" => {
                "; access was refused: set AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY to a key \
                 that may do this"
            }
            _ => {
                "; access was refused: set GOOGLE_APPLICATION_CREDENTIALS to a key file that may \
                 do this"
            }
        };
        remote(&backend).stores.inject(Faults { deny: true, ..Faults::default() });
        let read = location.read("data").expect_err("refused");
        let expected = format!("{}/data: could not read{hint}", location.url());
        assert_eq!(read.to_string(), expected);
        let written = location.put_new("new", Bytes::new()).expect_err("refused");
        let expected = format!("{}/new: could not write{hint}", location.url());
        assert_eq!(written.to_string(), expected);
        let listed = location.list("commits").expect_err("refused");
        let expected = format!("{}/commits: could not list{hint}", location.url());
        assert_eq!(listed.to_string(), expected);
        // A refusal is final: nothing is tried again.
        let n = remote(&backend).stores.injected();
        assert!(n <= 4, "{backend}: {n} requests for three refusals and one look");
    }
}

#[test]
fn slow_answers_are_waited_for() {
    for backend in with_object("slow", 0, &noise(5_003, 1)) {
        remote(&backend).stores.inject(Faults { delay_ms: 70, ..Faults::default() });
        assert_eq!(put(&backend.location, "new", b"x"), PutOutcome::Written, "{backend}");
        assert_eq!(read(&backend.location, "data"), noise(5_003, 1), "{backend}");
        assert_eq!(paths(&backend.location, ""), ["data", "new"], "{backend}");
    }
}

#[test]
fn throttled_and_failed_requests_are_tried_again_until_they_succeed() {
    for backend in with_object("again", 5, &noise(5_003, 1)) {
        let stores = &remote(&backend).stores;
        let faults =
            Faults { too_many_requests_first: 3, server_error_first: 2, ..Faults::default() };
        stores.inject(faults);
        assert_eq!(put(&backend.location, "new", b"x"), PutOutcome::Written, "{backend}");
        assert_eq!(stores.injected(), 5, "{backend}");
        assert_eq!(read(&backend.location, "data"), noise(5_003, 1), "{backend}");
        assert_eq!(paths(&backend.location, ""), ["data", "new"], "{backend}");
        // One write, one HEAD, one GET and one listing.
        assert_eq!(stores.injected(), 20, "{backend}");
        let large = noise((8 << 20) + 1, 3);
        assert_eq!(put_file(&backend.location, "large", &large), PutOutcome::Written, "{backend}");
        assert!(read(&backend.location, "large") == large, "{backend}: bytes differ");
    }
}

#[test]
fn throttling_without_end_fails_after_the_last_try_with_the_place_and_the_status() {
    for backend in with_object("throttle", 1, b"x") {
        let (location, stores) = (&backend.location, &remote(&backend).stores);
        stores.inject(Faults { too_many_requests_first: usize::MAX, ..Faults::default() });
        let error = location.read("data").expect_err("throttled");
        assert_eq!(error.to_string(), format!("{}/data: could not read", location.url()));
        assert!(chain(&error).contains("after 1 retries"), "{}", chain(&error));
        assert!(chain(&error).contains("429 Too Many Requests"), "{}", chain(&error));
        assert_eq!(stores.injected(), 2, "{backend}: one try and one more");

        let faults = Faults { server_error_first: usize::MAX, ..Faults::default() };
        stores.inject(faults.only(is_put));
        let error = location.put_new("new", Bytes::new()).expect_err("failing");
        assert_eq!(error.to_string(), format!("{}/new: could not write", location.url()));
        assert!(chain(&error).contains("503 Service Unavailable"), "{}", chain(&error));
        assert_eq!(stores.injected(), 2, "{backend}: one try and one more");
        stores.inject(Faults::default());
        assert_eq!(paths(location, ""), ["data"], "{backend}");
    }
}

#[test]
fn a_creation_whose_answer_was_lost_is_no_error_and_happened_once() {
    // 3 bytes leave with the head of the request, 1 MiB does not: the line breaks differently.
    for n in [3, (1 << 20) + 1] {
        for backend in with_object("lost", 3, b"x") {
            let (stores, bytes) = (&remote(&backend).stores, noise(n, 2));
            stores.inject(Faults { lose_response_first: 1, ..Faults::default() }.only(is_put));
            // Whose object it is cannot be told if the client itself repeated the request.
            let _either: PutOutcome = put(&backend.location, "new", &bytes);
            assert_eq!(stores.injected(), 1, "{backend}: {n}");
            assert!(read(&backend.location, "new") == bytes, "{backend}: {n} bytes differ");
            assert_eq!(
                put(&backend.location, "new", b"other"),
                PutOutcome::AlreadyThere,
                "{backend}"
            );
        }
    }
}

#[test]
fn a_creation_whose_answer_was_lost_does_not_replace_what_was_there() {
    for backend in with_object("lost-old", 3, b"old") {
        let stores = &remote(&backend).stores;
        stores.inject(Faults { lose_response_first: 1, ..Faults::default() }.only(is_put));
        backend.location.put_new("data", Bytes::from_static(b"new")).ok();
        assert_eq!(stores.injected(), 1, "{backend}");
        assert_eq!(read(&backend.location, "data"), b"old", "{backend}");
    }
}

#[test]
fn a_large_upload_whose_last_answer_was_lost_is_whole() {
    for backend in remote_backends("lost-end", 3) {
        let (stores, bytes) = (&remote(&backend).stores, noise((8 << 20) + 77, 6));
        stores.inject(
            Faults { lose_response_first: 1, ..Faults::default() }
                .only(|method, _| method == "POST"),
        );
        assert_eq!(put_file(&backend.location, "large", &bytes), PutOutcome::Written, "{backend}");
        // The start of the upload and its end.
        assert!(stores.injected() >= 2, "{backend}: {} answers were lost", stores.injected());
        stores.inject(Faults::default());
        assert!(read(&backend.location, "large") == bytes, "{backend}: bytes differ");
    }
}

#[test]
fn a_large_upload_that_fails_leaves_no_object_and_no_parts() {
    for backend in remote_backends("abort", 0) {
        let stores = &remote(&backend).stores;
        let faults = Faults { server_error_first: usize::MAX, ..Faults::default() };
        stores.inject(faults.only(is_put));
        let mut file = backend.location.temporary("t/large").expect("a temporary file");
        std::io::Write::write_all(&mut file, &noise((8 << 20) + 77, 6)).expect("room");
        let error = backend.location.put_file_new("t/large", file).expect_err("failing");
        let place = backend.location.url_of("t/large");
        assert_eq!(error.to_string(), format!("{place}: could not write"), "{backend}");
        let requests = stores.requests();
        let aborted =
            requests.iter().any(|r| r.method == "DELETE" && r.target.contains("uploadId="));
        assert!(aborted, "{backend}: the upload was not aborted");
        assert_eq!(paths(&backend.location, ""), [""; 0], "{backend}");
    }
}

#[test]
fn broken_connections_are_opened_again_for_reads_writes_and_listings() {
    for n in [3, (1 << 20) + 1] {
        for backend in with_object("dropped", 3, &noise(n, 1)) {
            let stores = &remote(&backend).stores;
            stores.inject(Faults { drop_connection_first: 2, ..Faults::default() });
            assert_eq!(
                put(&backend.location, "new", &noise(n, 2)),
                PutOutcome::Written,
                "{backend}: {n}"
            );
            assert!(read(&backend.location, "data") == noise(n, 1), "{backend}: {n}");
            assert!(read(&backend.location, "new") == noise(n, 2), "{backend}: {n}");
            assert_eq!(paths(&backend.location, ""), ["data", "new"], "{backend}: {n}");
            assert!(stores.injected() >= 6, "{backend}: {} drops", stores.injected());
        }
    }
}

#[test]
fn a_connection_that_always_breaks_is_reported_with_the_place() {
    for backend in with_object("broken", 1, b"x") {
        let (location, stores) = (&backend.location, &remote(&backend).stores);
        stores.inject(Faults { drop_connection_first: usize::MAX, ..Faults::default() });
        let error = location.read("data").expect_err("no connection holds");
        assert_eq!(error.to_string(), format!("{}/data: could not read", location.url()));
        let error = location.put_new("new", Bytes::new()).expect_err("no connection holds");
        assert_eq!(error.to_string(), format!("{}/new: could not write", location.url()));
        stores.inject(Faults::default());
        assert_eq!(paths(location, ""), ["data"], "{backend}");
    }
}

#[test]
fn a_body_that_was_cut_is_read_to_its_end() {
    for n in [300_007, (9 << 20) + 5] {
        for backend in with_object("cut", 5, &noise(n, 9)) {
            let stores = &remote(&backend).stores;
            stores.inject(Faults { cut_body_first: 2, ..Faults::default() });
            assert!(read(&backend.location, "data") == noise(n, 9), "{backend}: {n} bytes differ");
            assert!(stores.injected() >= 2, "{backend}: {n}");
        }
    }
}
