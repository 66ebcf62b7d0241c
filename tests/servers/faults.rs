//! What every test store has in front of it: a record of the requests and, on demand, faults.

use super::gcs_translator::percent_decode;
use super::http::{Exchange, Request, Service, Withhold};
use std::collections::HashMap;
use std::io::{self, ErrorKind};
use std::sync::{Mutex, PoisonError};
use std::thread;
use std::time::Duration;

pub type Predicate = Box<dyn Fn(&str, &str) -> bool + Send + Sync>;

/// Faults to inject. The `…_first` counts apply to each distinct request (method, path and query)
/// one after the other, in the order of the fields: with `drop_connection_first: 1` and
/// `too_many_requests_first: 2`, a request is dropped, then throttled twice, then served.
#[derive(Default)]
pub struct Faults {
    /// The connection ends before the store has seen the request.
    pub drop_connection_first: usize,
    /// The store acts on the request, then the connection ends without an answer.
    pub lose_response_first: usize,
    /// The connection ends in the middle of the response's body.
    pub cut_body_first: usize,
    /// Status 429, which GCS answers when one object is written too often.
    pub too_many_requests_first: usize,
    /// Status 503, which is also how S3 throttles.
    pub server_error_first: usize,
    /// Every request waits this long first.
    pub delay_ms: u64,
    /// Status 403 for every request.
    pub deny: bool,
    /// Which requests the faults apply to; see [`Faults::only`].
    pub only: Option<Predicate>,
}

impl Faults {
    /// Limits the faults to requests for which `applies(method, path)` holds. The path is
    /// percent-decoded and without query: `/bucket/a key`.
    pub fn only(mut self, applies: impl Fn(&str, &str) -> bool + Send + Sync + 'static) -> Self {
        self.only = Some(Box::new(applies));
        self
    }

    fn apply_to(&self, request: &Request) -> bool {
        let path = request.target.split('?').next().unwrap_or_default();
        self.only.as_ref().is_none_or(|only| only(&request.method, &percent_decode(path)))
    }
}

#[derive(Default)]
struct State {
    faults: Faults,
    attempts: HashMap<(String, String), usize>,
    injected: usize,
    seen: Vec<Request>,
}

/// Records each request and injects faults before `inner` gets it.
pub struct Front {
    inner: Box<dyn Service>,
    state: Mutex<State>,
}

enum Fault {
    Drop,
    Withhold(Withhold),
    Refuse(u16, &'static str),
}

impl Front {
    pub fn new(inner: Box<dyn Service>) -> Self {
        Self { inner, state: Mutex::default() }
    }

    /// Replaces the faults and starts all counts anew.
    pub fn inject(&self, faults: Faults) {
        self.with(|state| {
            *state = State { faults, seen: std::mem::take(&mut state.seen), ..State::default() };
        });
    }

    /// Faults injected since [`Front::inject`]. Delays do not count.
    pub fn injected(&self) -> usize {
        self.with(|state| state.injected)
    }

    /// Every request so far, as the client sent it.
    pub fn requests(&self) -> Vec<Request> {
        self.with(|state| state.seen.clone())
    }

    fn with<T>(&self, f: impl FnOnce(&mut State) -> T) -> T {
        // A test that panicked elsewhere has not left this state half written.
        f(&mut self.state.lock().unwrap_or_else(PoisonError::into_inner))
    }
}

impl Service for Front {
    fn serve(&self, exchange: &mut Exchange<'_>) -> io::Result<()> {
        let (delay, fault) = self.with(|state| {
            state.seen.push(exchange.request.clone());
            state.next(&exchange.request)
        });
        thread::sleep(Duration::from_millis(delay));
        match fault {
            Some(Fault::Drop) => return Err(ErrorKind::ConnectionAborted.into()),
            Some(Fault::Refuse(status, code)) => {
                return exchange.refuse(status, code, "injected by the test");
            }
            Some(Fault::Withhold(part)) => exchange.withhold = part,
            None => {}
        }
        self.inner.serve(exchange)
    }
}

impl State {
    /// How long to wait, and what goes wrong this time.
    fn next(&mut self, request: &Request) -> (u64, Option<Fault>) {
        let faults = &self.faults;
        if !faults.apply_to(request) {
            return (0, None);
        }
        if faults.deny {
            self.injected += 1;
            return (faults.delay_ms, Some(Fault::Refuse(403, "AccessDenied")));
        }
        let key = (request.method.clone(), request.target.clone());
        let attempt = self.attempts.entry(key).or_default();
        let plan = [
            (faults.drop_connection_first, Fault::Drop),
            (faults.lose_response_first, Fault::Withhold(Withhold::Everything)),
            (faults.cut_body_first, Fault::Withhold(Withhold::HalfTheBody)),
            (faults.too_many_requests_first, Fault::Refuse(429, "TooManyRequests")),
            (faults.server_error_first, Fault::Refuse(503, "SlowDown")),
        ];
        let mut left = *attempt;
        *attempt += 1;
        for (count, fault) in plan {
            if left < count {
                self.injected += 1;
                return (faults.delay_ms, Some(fault));
            }
            left -= count;
        }
        (faults.delay_ms, None)
    }
}
