//! Starts moto, the S3 server that the tests of the AWS Python ecosystem use: one per process.

use super::http::{Headers, Request, send};
use std::io::{BufRead, BufReader, Read, Seek};
use std::net::{IpAddr, SocketAddr};
use std::process::{Child, Command, Stdio};
use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};

const LAUNCHER: &str = include_str!("moto_launcher.py");
const INSTALL: &str = "python3 -m pip install 'moto[server]'";
const MOTO_IS_MISSING: i32 = 3;

/// A running S3 server on loopback.
pub struct Moto {
    pub address: SocketAddr,
    /// Held for its standard input: the server ends when the pipe closes, which the kernel does
    /// even if this process is killed. `None` for a server that somebody else started.
    _child: Option<Child>,
}

/// The server of this process, started on first use.
///
/// # Panics
/// If moto is missing and `CI` is set. Elsewhere the caller gets `None`, and should return from
/// its test: a missing Python package must not stop anybody from working on the rest.
#[expect(clippy::print_stderr, reason = "a skipped test must say so")]
pub fn moto() -> Option<&'static Moto> {
    static MOTO: OnceLock<Result<Moto, String>> = OnceLock::new();
    let start = || match std::env::var("MOTIONGEN_TEST_S3_ENDPOINT") {
        Ok(endpoint) => Ok(Moto { address: loopback(&endpoint), _child: None }),
        Err(_) => launch(),
    };
    match MOTO.get_or_init(start) {
        Ok(moto) => Some(moto),
        Err(reason) if std::env::var("CI").is_ok_and(|v| !v.is_empty() && v != "false") => {
            panic!("the object store tests need moto, install it with {INSTALL}: {reason}")
        }
        Err(reason) => {
            eprintln!("SKIPPED: the object store tests need moto, install it with {INSTALL}");
            eprintln!("         (MOTIONGEN_TEST_PYTHON names another interpreter): {reason}");
            None
        }
    }
}

impl Moto {
    /// Creates a bucket that no other test uses, and returns its name.
    ///
    /// # Panics
    /// If the server does not create it.
    pub fn create_bucket(&self, label: &str) -> String {
        static COUNT: AtomicUsize = AtomicUsize::new(0);
        let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        // The time keeps processes apart that share a server and happen to share a process id.
        let unique = format!("{:x}-{:x}-{count}", since.as_micros(), std::process::id());
        let name = format!("{label}-{unique}");
        self.create_named_bucket(&name);
        name
    }

    /// # Panics
    /// If the server does not create it.
    pub fn create_named_bucket(&self, name: &str) {
        let mut headers = Headers::default();
        headers.set("host", self.address.to_string());
        headers.set("authorization", AUTHORIZATION);
        let request = Request { method: "PUT".to_owned(), target: format!("/{name}"), headers };
        let response = send(self.address, &request)
            .unwrap_or_else(|e| panic!("the S3 server at {} is gone: {e}", self.address));
        assert_eq!(response.status, 200, "the S3 server did not create the bucket {name}");
    }
}

/// moto checks no signature, but reads from this header which service is meant. Without it, moto
/// guesses from the body.
pub const AUTHORIZATION: &str = "AWS4-HMAC-SHA256 \
    Credential=loopback/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0";

fn launch() -> Result<Moto, String> {
    let python = std::env::var("MOTIONGEN_TEST_PYTHON").unwrap_or_else(|_| "python3".to_owned());
    let mut log = tempfile::tempfile().expect("a temporary file for the messages of the server");
    let mut child = Command::new(&python)
        .args(["-c", LAUNCHER])
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(log.try_clone().expect("a second handle of the same file"))
        .spawn()
        .map_err(|e| format!("{python} did not start: {e}"))?;

    // The port is printed after the socket listens, so connections are accepted from then on.
    let mut port = String::new();
    let stdout = child.stdout.take().expect("standard output is piped");
    BufReader::new(stdout).read_line(&mut port).expect("standard output of the server");
    if let Ok(port) = port.trim().parse::<u16>() {
        return Ok(Moto { address: ([127, 0, 0, 1], port).into(), _child: Some(child) });
    }

    let status = child.wait().expect("the server has ended");
    let mut messages = String::new();
    log.rewind().expect("the messages of the server");
    log.read_to_string(&mut messages).expect("the messages of the server");
    if status.code() == Some(MOTO_IS_MISSING) {
        return Err(format!("{python}: {}", messages.trim()));
    }
    // Anything but a missing package is a fault of this code, which skipping would hide.
    panic!("{python} ran the S3 server, which ended with {status}:\n{messages}");
}

/// Reads `http://127.0.0.1:PORT`. Tests empty buckets, so no other machine is acceptable.
fn loopback(endpoint: &str) -> SocketAddr {
    let authority = endpoint.strip_prefix("http://").map(|rest| rest.trim_end_matches('/'));
    let numeric = authority.map(|rest| rest.replace("localhost", "127.0.0.1"));
    let address = numeric.and_then(|rest| rest.parse::<SocketAddr>().ok());
    let Some(address) = address.filter(|a| IpAddr::is_loopback(&a.ip())) else {
        panic!("MOTIONGEN_TEST_S3_ENDPOINT is {endpoint:?}, expected http://127.0.0.1:PORT");
    };
    address
}
