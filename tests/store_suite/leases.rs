//! Of two processes that want to write one thing, one does.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use motiongen::store::{Lease, Location, StoreError};

use super::{backends, chain, paths, put};

const SHORT: Duration = Duration::from_millis(900);

fn take(location: &Location, name: &str) -> Result<Lease, StoreError> {
    Lease::take_for(location, name, SHORT, &|_, _| {})
}

#[test]
fn a_lease_that_is_held_is_refused_and_one_that_was_given_back_is_taken() {
    for backend in &backends("held") {
        let location = &backend.location;
        let lease = take(location, "runs/q9").expect("a lease");
        let error = take(location, "runs/q9").expect_err("it is held");
        let held = format!("runs/q9 is being written by process {} on ", std::process::id());
        assert!(error.to_string().starts_with(&held), "{backend}: {error}");
        let end = "; wait for its end, or give another name";
        assert!(error.to_string().ends_with(end), "{backend}: {error}");
        take(location, "runs/other").expect("another lease");
        lease.check().expect("it is held");
        drop(lease);
        take(location, "runs/q9").expect("it was given back");
        assert!(paths(location, "leases/runs/q9").len() <= 5, "{backend}: all old terms are kept");
    }
}

#[test]
fn a_lease_outlives_its_lifetime_while_its_holder_lives() {
    let location = &backends("renewed").swap_remove(0).location;
    let lease = take(location, "x").expect("a lease");
    std::thread::sleep(SHORT * 2);
    lease.check().expect("it was renewed");
    assert!(take(location, "x").is_err());
}

/// Terms of a process of another machine, which nobody renews.
fn terms(expires_in: Duration) -> String {
    let now = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH).expect("after");
    let expires_us = (now + expires_in).as_micros();
    format!(
        r#"{{"holder": {{"host": "elsewhere", "pid": 7, "machine": "m", "started": "1", "nonce": 0}},
            "expires_us": {expires_us}, "is_released": false}}"#
    )
}

#[test]
fn a_lease_whose_holder_was_killed_is_waited_for_until_it_runs_out() {
    for backend in &backends("killed")[..2] {
        let location = &backend.location;
        put(location, "leases/x/0000000041.json", terms(SHORT).as_bytes());
        let told = Mutex::new(Vec::new());
        let lease = Lease::take_for(location, "x", SHORT, &|holder, _| {
            told.lock().expect("no panic").push(holder.to_owned());
        });
        lease.unwrap_or_else(|e| panic!("{}", chain(&e))).check().expect("it is held");
        assert_eq!(*told.lock().expect("no panic"), ["process 7 on elsewhere"], "{backend}");
    }
}

#[test]
fn a_lease_that_was_lost_is_not_written_under() {
    let location = &backends("lost").swap_remove(0).location;
    let lease = take(location, "x").expect("a lease");
    // As if the store had been out of reach for a lifetime, and another process had come by.
    for number in 2..9 {
        let path = format!("leases/x/{number:010}.json");
        location.put_new(&path, terms(SHORT * 9).into()).expect("written");
    }
    std::thread::sleep(SHORT);
    let error = lease.check().expect_err("it is lost");
    assert!(
        error.to_string().starts_with("x is being written by process 7 on elsewhere"),
        "{error}"
    );
}

#[test]
fn damaged_terms_do_not_lock_anybody_out() {
    let location = &backends("damaged-lease").swap_remove(0).location;
    put(location, "leases/x/0000000003.json", b"{");
    put(location, "leases/x/notes.txt", b"mine");
    take(location, "x").expect("a lease");
    assert!(paths(location, "leases/x").contains(&"leases/x/notes.txt".to_owned()));
}

#[test]
fn of_many_at_once_one_has_it_at_any_moment() {
    for backend in &backends("many")[..2] {
        let (location, n_inside, n_entered) =
            (&backend.location, AtomicUsize::new(0), AtomicUsize::new(0));
        std::thread::scope(|scope| {
            for _ in 0..5 {
                scope.spawn(|| {
                    for _ in 0..4 {
                        // Longer than a disk that others use may make its holder wait.
                        let lease = Lease::take_for(location, "x", SHORT * 60, &|_, _| {});
                        let Ok(lease) = lease else { continue };
                        assert_eq!(n_inside.fetch_add(1, Ordering::SeqCst), 0, "{backend}");
                        std::thread::sleep(Duration::from_millis(3));
                        n_inside.fetch_sub(1, Ordering::SeqCst);
                        n_entered.fetch_add(1, Ordering::SeqCst);
                        drop(lease);
                    }
                });
            }
        });
        assert!(n_entered.load(Ordering::SeqCst) > 5, "{backend}");
    }
}
