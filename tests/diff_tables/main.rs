//! Two stores side by side, table by table and column by column: what differs is printed.
//!
//! ```sh
//! cargo run --example diff-tables -- STORE OTHER               # two stores, row by row
//! cargo run --example diff-tables -- --digest STORE > d.json   # what is kept of a store
//! cargo run --example diff-tables -- d.json STORE              # a store against what was kept
//! ```
//!
//! `--tables phrases,motion` compares some tables alone. Numbers may lie apart by `--tolerance` (1e-6) of their column's
//! root mean square, `--tolerance TABLE=X` or `--tolerance TABLE.COLUMN=X` for some, X = inf to leave them out. Columns that tell when and how fast
//! something ran, and where files lay, are left out. Exit codes: 0 nothing differs, 1 something does, 2 could not run.

mod compare;
mod digest;
mod table;

use std::collections::BTreeMap;
use std::process::ExitCode;

use anyhow::{Context as _, bail};
use motiongen::store::{ClientOptions, Location, tables};

use compare::Tolerances;
use digest::TableDigest;
use table::Table;

const USAGE: &str = "usage: diff-tables STORE|DIGEST STORE [--tables NAME,…] [--tolerance [TABLE[.COLUMN]=]X]…\n       \
                     diff-tables --digest STORE [--tables NAME,…]";

/// What was asked for.
struct Arguments {
    places: Vec<String>,
    tables: Option<Vec<String>>,
    tolerances: Tolerances,
    is_digest: bool,
}

impl Arguments {
    fn parse(arguments: impl IntoIterator<Item = String>) -> anyhow::Result<Self> {
        let tolerances = Tolerances { usual: 1e-6, named: Vec::new() };
        let mut parsed = Self { places: Vec::new(), tables: None, tolerances, is_digest: false };
        let mut arguments = arguments.into_iter();
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--digest" => parsed.is_digest = true,
                "--tables" => {
                    let names = arguments.next().context(USAGE)?;
                    parsed.tables = Some(names.split(',').map(str::to_owned).collect());
                }
                "--tolerance" => {
                    let text = arguments.next().context(USAGE)?;
                    let (name, number) = match text.rsplit_once('=') {
                        Some((name, number)) => (Some(name), number),
                        None => (None, text.as_str()),
                    };
                    let number: f64 =
                        number.parse().with_context(|| format!("--tolerance {text}"))?;
                    match name {
                        Some(name) => parsed.tolerances.named.push((name.to_owned(), number)),
                        None => parsed.tolerances.usual = number,
                    }
                }
                _ if argument.starts_with("--") => bail!("{argument}? {USAGE}"),
                _ => parsed.places.push(argument),
            }
        }
        if parsed.places.len() != if parsed.is_digest { 1 } else { 2 } {
            bail!(USAGE);
        }
        Ok(parsed)
    }

    fn wants(&self, table: &str) -> bool {
        self.tables.as_ref().is_none_or(|wanted| wanted.iter().any(|name| name == table))
    }
}

type Digests = BTreeMap<String, TableDigest>;

fn open(place: &str) -> anyhow::Result<Location> {
    Ok(Location::open(place, &ClientOptions::default())?)
}

/// Returns the digests of a store's tables, or those that a file keeps.
fn digests(place: &str, arguments: &Arguments) -> anyhow::Result<Digests> {
    if place.ends_with(".json") {
        let text = std::fs::read_to_string(place).with_context(|| place.to_owned())?;
        return serde_json::from_str(&text).with_context(|| format!("{place} is no digest"));
    }
    let store = open(place)?;
    let wanted = tables::all().into_iter().filter(|schema| arguments.wants(schema.name));
    wanted
        .map(|schema| Ok((schema.name.to_owned(), TableDigest::of(&Table::read(&store, &schema)?))))
        .collect()
}

/// Returns a sentence for everything that differs.
fn differences(arguments: &Arguments) -> anyhow::Result<Vec<String>> {
    let [a, b] = &arguments.places[..] else { bail!(USAGE) };
    let mut found = Vec::new();
    if a.ends_with(".json") || b.ends_with(".json") {
        let (a, b) = (digests(a, arguments)?, digests(b, arguments)?);
        for (name, kept) in a.iter().filter(|(name, _)| arguments.wants(name)) {
            match b.get(name) {
                Some(now) => {
                    found.extend(compare::digests(name, kept, now, &arguments.tolerances));
                }
                None => found.push(format!("{name}: is there no more")),
            }
        }
        return Ok(found);
    }
    let (a, b) = (open(a)?, open(b)?);
    for schema in tables::all().into_iter().filter(|schema| arguments.wants(schema.name)) {
        let (a, b) = (Table::read(&a, &schema)?, Table::read(&b, &schema)?);
        found.extend(compare::tables(schema.name, &a, &b, &arguments.tolerances));
    }
    Ok(found)
}

#[expect(clippy::print_stdout, clippy::print_stderr, reason = "a program of its own")]
fn main() -> ExitCode {
    let run = || {
        let arguments = Arguments::parse(std::env::args().skip(1))?;
        if arguments.is_digest {
            let digests = digests(&arguments.places[0], &arguments)?;
            println!("{}", serde_json::to_string_pretty(&digests)?);
            return Ok(0);
        }
        let found = differences(&arguments)?;
        found.iter().for_each(|difference| println!("{difference}"));
        Ok::<_, anyhow::Error>(found.len())
    };
    match run() {
        Ok(0) => ExitCode::SUCCESS,
        Ok(_) => ExitCode::FAILURE,
        Err(e) => {
            eprintln!("error: {e:#}");
            ExitCode::from(2)
        }
    }
}
