//! The `.npy` header: a Python dictionary literal with `descr`, `fortran_order` and `shape`.
//!
//! Source: NumPy enhancement proposal 1, "Format Specification: Version 1.0", and
//! `numpy.lib.format` for versions 2.0 and 3.0.

use super::error::NpyError;
use crate::excerpt::clip;

/// NumPy's own limit on the number of axes (`NPY_MAXDIMS` of NumPy 2).
const MAX_AXES: usize = 64;

/// Deepest nesting of tuples and lists that is followed; real headers need three levels.
const MAX_DEPTH: usize = 16;

/// The family of a plain numeric data type.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum DtypeKind {
    Bool,
    Int,
    Uint,
    Float,
}

/// A plain numeric data type as stored.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Dtype {
    pub kind: DtypeKind,
    pub size_bytes: usize,
    pub big_endian: bool,
    /// As written in the header, for messages.
    pub descr: String,
}

/// A parsed header.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Header {
    pub dtype: Dtype,
    pub fortran_order: bool,
    pub shape: Vec<usize>,
}

/// Parses the header text, padding and newline included.
pub(super) fn parse(text: &[u8]) -> Result<Header, NpyError> {
    let mut parser = Parser { text, at: 0 };
    let (mut descr, mut fortran_order, mut shape) = (None, None, None);
    parser.expect(b'{')?;
    while !parser.take(b'}') {
        let key_at = parser.at;
        let Literal::Text(key) = parser.literal(0)? else {
            return Err(malformed(key_at, "a key is no string".to_owned()));
        };
        parser.expect(b':')?;
        let value_at = parser.at;
        let value = parser.literal(0)?;
        let known = match key.as_str() {
            "descr" => descr.replace(value).is_none(),
            "fortran_order" => fortran_order.replace((value, value_at)).is_none(),
            "shape" => shape.replace((value, value_at)).is_none(),
            _ => {
                return Err(malformed(key_at, format!("unknown key {:?}", clip(&key))));
            }
        };
        if !known {
            return Err(malformed(key_at, format!("key {key:?} is given twice")));
        }
        if !parser.take(b',') {
            parser.expect(b'}')?;
            break;
        }
    }
    parser.end()?;

    let missing = |key: &str| malformed(parser.at, format!("key {key:?} is missing"));
    let dtype = dtype(descr.ok_or_else(|| missing("descr"))?)?;
    let fortran_order = match fortran_order.ok_or_else(|| missing("fortran_order"))? {
        (Literal::Bool(value), _) => value,
        (other, at) => {
            let reason = format!("fortran_order is {}, not True or False", other.name());
            return Err(malformed(at, reason));
        }
    };
    let (shape, shape_at) = shape.ok_or_else(|| missing("shape"))?;
    Ok(Header { dtype, fortran_order, shape: axes(shape, shape_at)? })
}

fn malformed(at_byte: usize, reason: String) -> NpyError {
    NpyError::Header { at_byte, reason }
}

fn axes(shape: Literal, at: usize) -> Result<Vec<usize>, NpyError> {
    let Literal::Tuple(items) = shape else {
        return Err(malformed(at, format!("shape is {}, not a tuple", shape.name())));
    };
    if items.len() > MAX_AXES {
        let reason = format!("shape has {} axes and NumPy allows {MAX_AXES}", items.len());
        return Err(malformed(at, reason));
    }
    let axis = |item: Literal| match item {
        // Saturated like the digits, so that the size check sees the excess.
        Literal::Int(length) => Ok(usize::try_from(length).unwrap_or(usize::MAX)),
        other => Err(malformed(at, format!("shape holds {}, not a length", other.name()))),
    };
    items.into_iter().map(axis).collect()
}

fn dtype(descr: Literal) -> Result<Dtype, NpyError> {
    match descr {
        Literal::Text(descr) => plain_dtype(&descr),
        Literal::List(fields) => Err(NpyError::Structured { n_fields: fields.len() }),
        Literal::Tuple(_) => Err(NpyError::Structured { n_fields: 1 }),
        other => Err(malformed(0, format!("descr is {}, not a string", other.name()))),
    }
}

fn plain_dtype(descr: &str) -> Result<Dtype, NpyError> {
    let refused = |what, way_out| Err(NpyError::Dtype { descr: clip(descr), what, way_out });
    // "=" and "|" mean the writer's own order, which is little-endian on every platform that
    // NumPy ships wheels for except s390x.
    let big_endian = descr.starts_with('>');
    let body = descr.strip_prefix(['<', '>', '=', '|']).unwrap_or(descr);
    let mut chars = body.chars();
    let code = chars.next();
    let kind = match (code, chars.as_str()) {
        (Some('b'), "1") => DtypeKind::Bool,
        (Some('i'), "1" | "2" | "4" | "8") => DtypeKind::Int,
        (Some('u'), "1" | "2" | "4" | "8") => DtypeKind::Uint,
        (Some('f'), "2" | "4" | "8") => DtypeKind::Float,
        (Some('O'), _) => return Err(NpyError::Pickle),
        (Some('f'), "10" | "12" | "16") => {
            return refused(
                "long doubles, whose layout differs between machines",
                "save a.astype('float64')",
            );
        }
        (Some('c'), _) => {
            return refused("complex numbers", "save a.real, a.imag or abs(a) as float32");
        }
        (Some('M' | 'm'), _) => {
            return refused("dates or time spans", "save them as float64 seconds");
        }
        (Some('S' | 'a' | 'U' | 'T'), _) => {
            return refused("strings", "save a numeric array, and names in a text file");
        }
        (Some('V'), _) => {
            return refused("raw bytes or records", "save each field as a numeric array");
        }
        _ => {
            return refused("values of an unknown type", "save a.astype('float32')");
        }
    };
    let size_bytes = match chars.as_str() {
        "1" => 1,
        "2" => 2,
        "4" => 4,
        _ => 8,
    };
    Ok(Dtype { kind, size_bytes, big_endian, descr: descr.to_owned() })
}

/// The values of Python's literal syntax that occur in headers.
#[derive(Debug)]
enum Literal {
    Text(String),
    /// Non-negative; saturated at `u64::MAX`.
    Int(u64),
    Negative,
    Bool(bool),
    None,
    Tuple(Vec<Literal>),
    List(Vec<Literal>),
}

impl Literal {
    fn name(&self) -> &'static str {
        match self {
            Self::Text(_) => "a string",
            Self::Int(_) => "a number",
            Self::Negative => "a negative number",
            Self::Bool(_) => "True or False",
            Self::None => "None",
            Self::Tuple(_) => "a tuple",
            Self::List(_) => "a list",
        }
    }
}

/// A position in the header text.
struct Parser<'a> {
    text: &'a [u8],
    at: usize,
}

impl Parser<'_> {
    /// The next byte that is no white space, not consumed.
    fn peek(&mut self) -> Option<u8> {
        let rest = self.text.get(self.at..).unwrap_or_default();
        self.at += rest.len() - rest.trim_ascii_start().len();
        self.text.get(self.at).copied()
    }

    /// Consumes `wanted` if it comes next.
    fn take(&mut self, wanted: u8) -> bool {
        let found = self.peek() == Some(wanted);
        self.at += usize::from(found);
        found
    }

    fn expect(&mut self, wanted: u8) -> Result<(), NpyError> {
        if self.take(wanted) {
            return Ok(());
        }
        Err(self.unexpected(&format!("{:?}", char::from(wanted))))
    }

    fn end(&mut self) -> Result<(), NpyError> {
        match self.peek() {
            None => Ok(()),
            Some(_) => Err(self.unexpected("nothing after the closing brace")),
        }
    }

    fn unexpected(&mut self, wanted: &str) -> NpyError {
        let found = match self.peek() {
            Some(byte) => format!("{:?}", char::from(byte)),
            None => "the end".to_owned(),
        };
        malformed(self.at, format!("expected {wanted}, found {found}"))
    }

    fn literal(&mut self, depth: usize) -> Result<Literal, NpyError> {
        if depth > MAX_DEPTH {
            return Err(malformed(self.at, format!("nested deeper than {MAX_DEPTH} levels")));
        }
        match self.peek() {
            Some(quote @ (b'\'' | b'"')) => self.string(quote),
            Some(b'0'..=b'9') => Ok(Literal::Int(self.digits())),
            Some(b'-') => {
                self.at += 1;
                match self.peek() {
                    Some(b'0'..=b'9') => {
                        let value = self.digits();
                        Ok(if value == 0 { Literal::Int(0) } else { Literal::Negative })
                    }
                    _ => Err(self.unexpected("a digit")),
                }
            }
            Some(b'(') => {
                self.at += 1;
                let (mut items, comma) = self.items(b')', depth)?;
                // In Python `(3)` is the number and `(3,)` the tuple.
                match items.pop() {
                    Some(only) if items.is_empty() && !comma => Ok(only),
                    Some(last) => {
                        items.push(last);
                        Ok(Literal::Tuple(items))
                    }
                    None => Ok(Literal::Tuple(items)),
                }
            }
            Some(b'[') => {
                self.at += 1;
                Ok(Literal::List(self.items(b']', depth)?.0))
            }
            Some(byte) if byte.is_ascii_alphabetic() => self.word(),
            _ => Err(self.unexpected("a value")),
        }
    }

    /// The items up to `close`, and whether a comma followed the last of them.
    fn items(&mut self, close: u8, depth: usize) -> Result<(Vec<Literal>, bool), NpyError> {
        let mut items = Vec::new();
        let mut comma = false;
        while !self.take(close) {
            items.push(self.literal(depth + 1)?);
            comma = self.take(b',');
            if !comma {
                self.expect(close)?;
                break;
            }
        }
        Ok((items, comma))
    }

    fn string(&mut self, quote: u8) -> Result<Literal, NpyError> {
        let start = self.at + 1;
        let rest = self.text.get(start..).unwrap_or_default();
        let Some(length) = rest.iter().position(|&byte| byte == quote) else {
            return Err(malformed(self.at, "a string is not closed".to_owned()));
        };
        self.at = start + length + 1;
        Ok(Literal::Text(String::from_utf8_lossy(&rest[..length]).into_owned()))
    }

    /// Decimal digits and the `L` that Python 2 put after long integers.
    fn digits(&mut self) -> u64 {
        let mut value = 0_u64;
        while let Some(digit @ b'0'..=b'9') = self.text.get(self.at) {
            value = value.saturating_mul(10).saturating_add(u64::from(digit - b'0'));
            self.at += 1;
        }
        self.at += usize::from(self.text.get(self.at) == Some(&b'L'));
        value
    }

    fn word(&mut self) -> Result<Literal, NpyError> {
        let rest = self.text.get(self.at..).unwrap_or_default();
        let length = rest.iter().take_while(|byte| byte.is_ascii_alphanumeric()).count();
        let literal = match &rest[..length] {
            b"True" => Literal::Bool(true),
            b"False" => Literal::Bool(false),
            b"None" => Literal::None,
            other => {
                let reason = format!("unknown word {:?}", clip(&String::from_utf8_lossy(other)));
                return Err(malformed(self.at, reason));
            }
        };
        self.at += length;
        Ok(literal)
    }
}
