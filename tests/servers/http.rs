//! As much of an HTTP/1.1 reverse proxy as an object store on loopback needs, on `std` and
//! `httparse`. A full server crate would be compiled only for these tests.
//!
//! Clients keep their connections (a thread each). Upstream every request gets a connection of its
//! own and speaks HTTP/1.0: moto's server closes after each response anyway, and 1.0 rules out
//! chunked responses, so a body ends at its `Content-Length` or where the connection ends.

use std::io::{self, BufRead, BufReader, BufWriter, Error, ErrorKind, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;

const MAX_HEAD: usize = 64 * 1024;
const MAX_HEADERS: usize = 96;

#[derive(Clone, Debug, Default)]
pub struct Headers(pub Vec<(String, String)>);

impl Headers {
    pub fn get(&self, name: &str) -> Option<&str> {
        self.0.iter().find(|(key, _)| key.eq_ignore_ascii_case(name)).map(|(_, v)| v.as_str())
    }

    pub fn set(&mut self, name: &str, value: impl Into<String>) {
        self.take(name);
        self.0.push((name.to_owned(), value.into()));
    }

    pub fn take(&mut self, name: &str) -> Option<String> {
        let at = self.0.iter().position(|(key, _)| key.eq_ignore_ascii_case(name))?;
        Some(self.0.remove(at).1)
    }

    fn parsed(headers: &[httparse::Header<'_>]) -> io::Result<Self> {
        let text = |bytes: &[u8]| {
            String::from_utf8(bytes.to_vec()).map_err(|e| Error::new(ErrorKind::InvalidData, e))
        };
        headers
            .iter()
            .map(|h| Ok((h.name.to_ascii_lowercase(), text(h.value)?)))
            .collect::<io::Result<_>>()
            .map(Self)
    }

    fn length(&self) -> io::Result<Option<u64>> {
        let parse = |v: &str| v.trim().parse().map_err(|e| Error::new(ErrorKind::InvalidData, e));
        self.get("content-length").map(parse).transpose()
    }

    fn write(&self, out: &mut impl Write) -> io::Result<()> {
        self.0.iter().try_for_each(|(key, value)| write!(out, "{key}: {value}\r\n"))
    }
}

#[derive(Clone, Debug)]
pub struct Request {
    pub method: String,
    /// Path and query as sent, still percent-encoded.
    pub target: String,
    pub headers: Headers,
}

#[derive(Clone, Debug)]
pub struct Response {
    pub status: u16,
    pub headers: Headers,
}

/// What a proxy does with each request. An error closes the client's connection without an answer.
pub trait Service: Send + Sync + 'static {
    fn serve(&self, exchange: &mut Exchange<'_>) -> io::Result<()>;
}

/// Which part of a response is withheld from the client.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Withhold {
    Nothing,
    /// Headers and the first half of the body arrive, then the connection ends.
    HalfTheBody,
    /// The store has done its work, but the client never learns of it.
    Everything,
}

/// One request and its answer.
pub struct Exchange<'a> {
    pub request: Request,
    pub withhold: Withhold,
    body: io::Take<&'a mut BufReader<TcpStream>>,
    client: &'a mut BufWriter<TcpStream>,
    upstream: SocketAddr,
}

impl Exchange<'_> {
    /// Sends the request on, as it now stands, and the response back after `edit`.
    pub fn forward(&mut self, edit: impl FnOnce(&mut Response)) -> io::Result<()> {
        let length = self.body.limit();
        let mut upstream = BufWriter::new(connect(self.upstream)?);
        write_request(&mut upstream, &self.request, length)?;
        if io::copy(&mut self.body, &mut upstream)? != length {
            return Err(ErrorKind::UnexpectedEof.into());
        }
        upstream.flush()?;

        let mut reader = BufReader::new(upstream.into_inner().map_err(|e| e.into_error())?);
        let mut response = read_response(&mut reader)?;
        let head_only = self.request.method == "HEAD" || matches!(response.status, 204 | 304);
        let mut unsized_body = Vec::new();
        let length = match response.headers.length()? {
            Some(length) => length,
            None if head_only => 0,
            None => reader.read_to_end(&mut unsized_body)? as u64,
        };
        edit(&mut response);
        if self.withhold == Withhold::Everything {
            return Err(ErrorKind::ConnectionAborted.into());
        }
        write_response(self.client, &response, length)?;
        if !head_only {
            let (sent, cut) = match self.withhold {
                Withhold::HalfTheBody => (length / 2, true),
                _ => (length, false),
            };
            let mut body = unsized_body.as_slice().chain(reader).take(sent);
            if io::copy(&mut body, self.client)? != sent || cut {
                self.client.flush()?;
                return Err(ErrorKind::UnexpectedEof.into());
            }
        }
        self.client.flush()
    }

    /// Answers in place of the upstream, with the error document that XML APIs use.
    pub fn refuse(&mut self, status: u16, code: &str, message: &str) -> io::Result<()> {
        io::copy(&mut self.body, &mut io::sink())?;
        let body = format!(
            "<?xml version='1.0' encoding='UTF-8'?>\
             <Error><Code>{code}</Code><Message>{message}</Message></Error>"
        );
        let mut headers = Headers::default();
        headers.set("content-type", "application/xml; charset=UTF-8");
        write_response(self.client, &Response { status, headers }, body.len() as u64)?;
        if self.request.method != "HEAD" {
            self.client.write_all(body.as_bytes())?;
        }
        self.client.flush()
    }

    /// Asks the upstream something of the proxy's own.
    pub fn ask(&self, method: &str, target: &str, headers: Headers) -> io::Result<Response> {
        let request = Request { method: method.to_owned(), target: target.to_owned(), headers };
        send(self.upstream, &request)
    }
}

/// Sends one request without a body and reads the head of the response.
pub fn send(upstream: SocketAddr, request: &Request) -> io::Result<Response> {
    let mut out = BufWriter::new(connect(upstream)?);
    write_request(&mut out, request, 0)?;
    let stream = out.into_inner().map_err(|e| e.into_error())?;
    let mut reader = BufReader::new(stream);
    let response = read_response(&mut reader)?;
    if request.method != "HEAD" {
        io::copy(&mut reader, &mut io::sink())?;
    }
    Ok(response)
}

/// A proxy listening on 127.0.0.1 until it is dropped.
pub struct Proxy {
    pub address: SocketAddr,
    stop: Arc<AtomicBool>,
}

impl Proxy {
    pub fn start(upstream: SocketAddr, service: Arc<dyn Service>) -> io::Result<Self> {
        let listener = TcpListener::bind(("127.0.0.1", 0))?;
        let address = listener.local_addr()?;
        let stop = Arc::new(AtomicBool::new(false));
        let stopped = Arc::clone(&stop);
        thread::spawn(move || {
            for client in listener.incoming() {
                if stopped.load(Ordering::Relaxed) {
                    break;
                }
                let service = Arc::clone(&service);
                if let Ok(client) = client {
                    // An error means that one side hung up, which is the whole handling of it.
                    thread::spawn(move || converse(client, upstream, service.as_ref()).ok());
                }
            }
        });
        Ok(Self { address, stop })
    }
}

impl Drop for Proxy {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // The listener wakes only for a connection.
        TcpStream::connect(self.address).ok();
    }
}

fn converse(client: TcpStream, upstream: SocketAddr, service: &dyn Service) -> io::Result<()> {
    client.set_nodelay(true)?;
    let mut writer = BufWriter::new(client.try_clone()?);
    let mut reader = BufReader::new(client);
    while let Some(mut request) = read_request(&mut reader)? {
        if request.headers.get("transfer-encoding").is_some() {
            // Object store clients state the length; this proxy does not decode chunks.
            write!(writer, "HTTP/1.1 411 Length Required\r\ncontent-length: 0\r\n\r\n")?;
            return writer.flush();
        }
        if request.headers.take("expect").is_some() {
            write!(writer, "HTTP/1.1 100 Continue\r\n\r\n")?;
            writer.flush()?;
        }
        let close =
            request.headers.take("connection").is_some_and(|v| v.eq_ignore_ascii_case("close"));
        let body = (&mut reader).take(request.headers.length()?.unwrap_or(0));
        let mut exchange =
            Exchange { request, withhold: Withhold::Nothing, body, client: &mut writer, upstream };
        service.serve(&mut exchange)?;
        if close || exchange.body.limit() > 0 {
            break;
        }
    }
    Ok(())
}

fn connect(upstream: SocketAddr) -> io::Result<TcpStream> {
    let stream = TcpStream::connect(upstream)?;
    stream.set_nodelay(true)?;
    Ok(stream)
}

/// Everything up to the empty line; `None` when the other side is done.
fn read_head(reader: &mut impl BufRead) -> io::Result<Option<Vec<u8>>> {
    let mut head = Vec::new();
    while !head.ends_with(b"\r\n\r\n") {
        if reader.read_until(b'\n', &mut head)? == 0 {
            return if head.is_empty() { Ok(None) } else { Err(ErrorKind::UnexpectedEof.into()) };
        }
        if head.len() > MAX_HEAD {
            return Err(Error::new(ErrorKind::InvalidData, "the header section is too large"));
        }
    }
    Ok(Some(head))
}

fn read_request(reader: &mut impl BufRead) -> io::Result<Option<Request>> {
    let Some(head) = read_head(reader)? else { return Ok(None) };
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut parsed = httparse::Request::new(&mut headers);
    parsed.parse(&head).map_err(|e| Error::new(ErrorKind::InvalidData, e))?;
    let headers = Headers::parsed(parsed.headers)?;
    let method = parsed.method.unwrap_or_default().to_owned();
    Ok(Some(Request { method, target: parsed.path.unwrap_or_default().to_owned(), headers }))
}

fn read_response(reader: &mut impl BufRead) -> io::Result<Response> {
    let head = read_head(reader)?.ok_or(ErrorKind::UnexpectedEof)?;
    let mut headers = [httparse::EMPTY_HEADER; MAX_HEADERS];
    let mut parsed = httparse::Response::new(&mut headers);
    parsed.parse(&head).map_err(|e| Error::new(ErrorKind::InvalidData, e))?;
    let headers = Headers::parsed(parsed.headers)?;
    Ok(Response { status: parsed.code.unwrap_or_default(), headers })
}

fn write_request(out: &mut impl Write, request: &Request, length: u64) -> io::Result<()> {
    let mut headers = request.headers.clone();
    headers.set("content-length", length.to_string());
    headers.set("connection", "close");
    write!(out, "{} {} HTTP/1.0\r\n", request.method, request.target)?;
    headers.write(out)?;
    write!(out, "\r\n")
}

fn write_response(out: &mut impl Write, response: &Response, length: u64) -> io::Result<()> {
    let mut headers = response.headers.clone();
    headers.take("connection");
    headers.set("content-length", length.to_string());
    write!(out, "HTTP/1.1 {} \r\n", response.status)?;
    headers.write(out)?;
    write!(out, "\r\n")
}
