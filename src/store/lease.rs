//! Leases: who may write what two processes must not write at once.
//!
//! `leases/<name>/<number>.json`, each put unless it is there: the highest number tells who holds the lease and until
//! when. The holder renews it under the next number for as long as it lives; when it is killed the lease runs out,
//! and a process that waits takes the next number. No object is ever changed.

use std::path::Path as FsPath;
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};

use super::StoreError;
use super::location::{Location, PutOutcome};
use super::schema::TimestampUs;

/// Folder of the leases.
pub(super) const FOLDER: &str = "leases";
/// Time after which a lease runs out that is not renewed, and the time between renewals.
const LIFETIME: Duration = Duration::from_secs(60);
const RENEWALS_PER_LIFETIME: u32 = 3;
/// Numbers before the highest that are kept: who listed them before the highest came finds the next one taken.
const N_KEPT: u64 = 3;
/// Time between looks at a lease that somebody else holds.
const PAUSE: Duration = Duration::from_millis(500);

/// Who holds a lease, and until when.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
struct LeaseTerms {
    holder: Holder,
    expires_us: i64,
    is_released: bool,
}

/// A process.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
struct Holder {
    host: String,
    pid: u32,
    /// The identity of this machine since it was started, as process numbers are only unique there.
    machine: String,
    /// When the process started, in ticks since the machine did.
    started: String,
    /// Tells leases of one process apart.
    nonce: u64,
}

/// The right to write something, until it is dropped.
#[derive(Debug)]
pub struct Lease {
    held: Arc<HeldLease>,
    thread: Option<std::thread::JoinHandle<()>>,
}

#[derive(Debug)]
struct HeldLease {
    store: Location,
    name: String,
    holder: Holder,
    lifetime: Duration,
    state: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug)]
struct State {
    number: u64,
    is_lost: bool,
    is_ended: bool,
}

impl Lease {
    /// Takes the lease `name`. One that another process holds is waited for while it is not renewed, as after a
    /// kill; `waiting` is told once for how long.
    ///
    /// # Errors
    /// [`StoreError::Held`] when the other process lives; errors of the storage.
    pub fn take(
        store: &Location,
        name: &str,
        waiting: &dyn Fn(&str, Duration),
    ) -> Result<Self, StoreError> {
        Self::take_for(store, name, LIFETIME, waiting)
    }

    /// Takes a lease of another lifetime.
    ///
    /// # Errors
    /// As [`Lease::take`].
    pub fn take_for(
        store: &Location,
        name: &str,
        lifetime: Duration,
        waiting: &dyn Fn(&str, Duration),
    ) -> Result<Self, StoreError> {
        let holder = Holder::of_this_process();
        let mut seen: Option<u64> = None;
        loop {
            let highest = latest(store, name)?;
            let number = match &highest {
                Some((number, terms)) if !terms.is_over() => {
                    if seen.is_some_and(|seen| seen != *number) {
                        return Err(StoreError::Held {
                            what: name.to_owned(),
                            holder: terms.holder.to_string(),
                        });
                    }
                    if seen.is_none() {
                        waiting(&terms.holder.to_string(), terms.rest());
                    }
                    seen = Some(*number);
                    std::thread::sleep(PAUSE.min(lifetime / 8));
                    continue;
                }
                Some((number, _)) => number + 1,
                None => 1,
            };
            if put(store, name, number, &LeaseTerms::new(&holder, lifetime))? == PutOutcome::Written
            {
                // A listing that was taken while numbers came and went may have missed the highest.
                if latest(store, name)?.is_none_or(|(highest, _)| highest <= number) {
                    return Ok(Self::hold(store, name, holder, lifetime, number));
                }
                store.remove(&format!("{}/{number:010}.json", folder(name)))?;
                continue;
            }
            // Another process was faster; the lease is looked at again, as one that was renewed.
            seen = Some(number - 1);
        }
    }

    fn hold(store: &Location, name: &str, holder: Holder, lifetime: Duration, number: u64) -> Self {
        let state = Mutex::new(State { number, is_lost: false, is_ended: false });
        let (store, name) = (store.clone(), name.to_owned());
        let changed = Condvar::new();
        let held = Arc::new(HeldLease { store, name, holder, lifetime, state, changed });
        held.forget_old(number);
        let renewing = Arc::clone(&held);
        let thread = std::thread::Builder::new()
            .name("lease".to_owned())
            .spawn(move || renewing.renew())
            .ok();
        Self { held, thread }
    }

    /// Refuses to go on when the lease was lost: its store could not be reached for too long, and somebody else took
    /// it.
    ///
    /// # Errors
    /// [`StoreError::Held`].
    pub fn check(&self) -> Result<(), StoreError> {
        if !self.held.lock().is_lost {
            return Ok(());
        }
        let holder = latest(&self.held.store, &self.held.name)?
            .map_or_else(|| "nobody".to_owned(), |(_, terms)| terms.holder.to_string());
        Err(StoreError::Held { what: self.held.name.clone(), holder })
    }
}

impl Drop for Lease {
    fn drop(&mut self) {
        self.held.lock().is_ended = true;
        self.held.changed.notify_all();
        if let Some(thread) = self.thread.take() {
            thread.join().ok();
        }
        let state = self.held.lock();
        if state.is_lost {
            return;
        }
        let terms = LeaseTerms {
            holder: self.held.holder.clone(),
            expires_us: TimestampUs::now().0,
            is_released: true,
        };
        // Where it cannot be given back it runs out.
        let number = state.number + 1;
        if put(&self.held.store, &self.held.name, number, &terms).is_ok() {
            self.held.forget_old(number);
        }
    }
}

impl HeldLease {
    fn lock(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Renews the lease until it ends or is lost.
    fn renew(&self) {
        let pause = self.lifetime / RENEWALS_PER_LIFETIME;
        let mut valid_until = Instant::now() + self.lifetime;
        loop {
            let state = self.lock();
            let (mut state, _) = self
                .changed
                .wait_timeout_while(state, pause, |state| !state.is_ended)
                .unwrap_or_else(PoisonError::into_inner);
            if state.is_ended {
                return;
            }
            let number = state.number + 1;
            let begun = Instant::now();
            match put(
                &self.store,
                &self.name,
                number,
                &LeaseTerms::new(&self.holder, self.lifetime),
            ) {
                Ok(PutOutcome::Written) => {
                    state.number = number;
                    valid_until = begun + self.lifetime;
                    drop(state);
                    self.forget_old(number);
                }
                Ok(PutOutcome::AlreadyThere) => {
                    state.is_lost = true;
                    return;
                }
                // As long as the lease is not over, the store may come back.
                Err(_) if Instant::now() < valid_until => {}
                Err(e) => tracing::warn!("lease {}: could not be renewed: {e}", self.name),
            }
        }
    }

    /// Removes numbers below `number`; who cannot leaves them to vacuum.
    fn forget_old(&self, number: u64) {
        for listed in self.store.list(&folder(&self.name)).unwrap_or_default() {
            if number_of(&listed.path).is_some_and(|known| known + N_KEPT < number) {
                self.store.remove(&listed.path).ok();
            }
        }
    }
}

impl LeaseTerms {
    fn new(holder: &Holder, lifetime: Duration) -> Self {
        let lifetime_us = i64::try_from(lifetime.as_micros()).unwrap_or(i64::MAX);
        let expires_us = TimestampUs::now().0.saturating_add(lifetime_us);
        Self { holder: holder.clone(), expires_us, is_released: false }
    }

    fn rest(&self) -> Duration {
        let rest_us = self.expires_us.saturating_sub(TimestampUs::now().0);
        Duration::from_micros(u64::try_from(rest_us).unwrap_or(0))
    }

    fn is_over(&self) -> bool {
        self.is_released || self.rest().is_zero() || self.holder.is_known_dead()
    }
}

impl std::fmt::Display for Holder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "process {} on {}", self.pid, self.host)
    }
}

impl Holder {
    fn of_this_process() -> Self {
        use std::sync::atomic::{AtomicU64, Ordering};
        static COUNT: AtomicU64 = AtomicU64::new(0);
        let read = |path: &str| {
            std::fs::read_to_string(path).map(|text| text.trim().to_owned()).unwrap_or_default()
        };
        let pid = std::process::id();
        let host = read("/proc/sys/kernel/hostname");
        Self {
            host: if host.is_empty() { "an unnamed host".to_owned() } else { host },
            pid,
            machine: machine(),
            started: started(pid).unwrap_or_default(),
            nonce: COUNT.fetch_add(1, Ordering::Relaxed),
        }
    }

    /// Returns whether the process is one of this machine that has ended. Others are known to live by renewing.
    fn is_known_dead(&self) -> bool {
        !self.machine.is_empty()
            && self.machine == machine()
            && started(self.pid).is_none_or(|started| started != self.started)
    }
}

/// Returns what tells this machine since it was started, and its process numbers, from all others; nothing where the
/// system does not say it.
fn machine() -> String {
    let boot = std::fs::read_to_string("/proc/sys/kernel/random/boot_id").unwrap_or_default();
    match std::fs::read_link("/proc/self/ns/pid") {
        Ok(namespace) if !boot.is_empty() => format!("{} {}", boot.trim(), namespace.display()),
        _ => String::new(),
    }
}

/// Returns when a process of this machine started; none where there is none.
fn started(pid: u32) -> Option<String> {
    let path = format!("/proc/{pid}/stat");
    let stat = std::fs::read_to_string(FsPath::new(&path)).ok()?;
    // The name of the program may hold anything; what follows it is the third field.
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_whitespace();
    // A process that ended and was not yet waited for is dead.
    let state = fields.next()?;
    (state != "Z" && state != "X").then_some(())?;
    fields.nth(18).map(str::to_owned)
}

fn folder(name: &str) -> String {
    format!("{FOLDER}/{name}")
}

fn number_of(path: &str) -> Option<u64> {
    path.rsplit_once('/')?.1.strip_suffix(".json")?.parse().ok()
}

/// Returns the terms of the highest number, if the lease was ever taken.
fn latest(store: &Location, name: &str) -> Result<Option<(u64, LeaseTerms)>, StoreError> {
    for _ in 0..8 {
        let listed = store.list(&folder(name))?;
        let numbers = listed.iter().filter_map(|l| Some((number_of(&l.path)?, &l.path)));
        let Some((number, path)) = numbers.max() else { return Ok(None) };
        // One that was renewed meanwhile is gone.
        let Some(bytes) = store.read_if_there(path)? else { continue };
        // A lease that cannot be read is over as soon as a process takes the next number.
        let terms = serde_json::from_slice(&bytes).unwrap_or(LeaseTerms {
            holder: Holder::default(),
            expires_us: 0,
            is_released: true,
        });
        return Ok(Some((number, terms)));
    }
    let holder = "a process that renews it".to_owned();
    Err(StoreError::Held { what: name.to_owned(), holder })
}

fn put(
    store: &Location,
    name: &str,
    number: u64,
    terms: &LeaseTerms,
) -> Result<PutOutcome, StoreError> {
    let text = serde_json::to_vec(terms).expect("invariant: terms are strings and numbers");
    store.put_new(&format!("{}/{number:010}.json", folder(name)), text.into())
}
