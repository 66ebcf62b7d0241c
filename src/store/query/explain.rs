//! What went wrong with a statement, in terms of the store's tables.

use std::collections::BTreeSet;

use polars::prelude::PolarsError;

use super::TableSchema;

/// Names offered when a name is not found.
const N_SUGGESTIONS: usize = 3;

/// Knows what a statement may have meant.
#[derive(Clone, Debug, Default)]
pub struct Explainer {
    schemas: Vec<TableSchema>,
    /// Names that the statement uses as tables.
    named: Vec<String>,
}

impl Explainer {
    pub fn new(schemas: Vec<TableSchema>, named: Vec<String>) -> Self {
        Self { schemas, named }
    }

    /// Says in one sentence what is wrong.
    pub fn explain(&self, error: &PolarsError) -> String {
        let text = first_line(error);
        if let Some(table) = between(&text, "relation '", "'") {
            return unknown_table(table, &self.schemas);
        }
        if let Some(name) = between(&text, "duplicate output name '", "'") {
            return format!(
                "two columns of the answer are called \"{name}\"; give one of them another name with \"as\""
            );
        }
        // An expression that is not known is shown as the parser holds it.
        if let Some((kind, _)) = text.strip_prefix("expression ").and_then(|e| e.split_once(" {")) {
            return format!(
                "\"{}\" is not in this SQL; docs/query.md has what is",
                kind.to_lowercase()
            );
        }
        let column = between(&text, "unable to find column \"", "\"")
            .or_else(|| between(&text, "no column named '", "'"));
        column.and_then(|column| self.unknown_column(column)).unwrap_or(text)
    }

    fn unknown_column(&self, column: &str) -> Option<String> {
        let is_named = |schema: &&TableSchema| {
            self.named.iter().any(|name| name.eq_ignore_ascii_case(schema.name))
        };
        let named_tables: Vec<_> = self.schemas.iter().filter(is_named).collect();
        let names = |schema: &TableSchema| {
            schema.columns.iter().map(|c| c.name.to_string()).collect::<Vec<_>>()
        };
        let columns: Vec<String> = named_tables.iter().flat_map(|schema| names(schema)).collect();
        let columns: Vec<&str> = columns.iter().map(String::as_str).collect();
        if columns.is_empty() {
            return None;
        }
        if columns.contains(&column) {
            return Some(format!(
                "column \"{column}\" cannot be asked for at this place; a join compares a column of one table with \
                 one of the other, and all else belongs into \"where\" or into a sub-select"
            ));
        }
        let lists: Vec<_> = named_tables
            .iter()
            .map(|schema| format!("table {} has {}", schema.name, names(schema).join(", ")))
            .collect();
        Some(format!(
            "column \"{column}\" not found; nearest: {}; {}",
            nearest(column, &columns).join(", "),
            lists.join("; ")
        ))
    }
}

/// Says that there is no such table, and which there are.
pub fn unknown_table(table: &str, schemas: &[TableSchema]) -> String {
    let known: Vec<_> = schemas.iter().map(|schema| schema.name).collect();
    format!(
        "table \"{table}\" not found; nearest: {}; a store has {}",
        nearest(table, &known).join(", "),
        known.join(", ")
    )
}

/// Returns the names most like `name`, best first.
fn nearest<'a>(name: &str, known: &[&'a str]) -> Vec<&'a str> {
    // Tables that are joined share columns; each is offered once.
    let known: BTreeSet<_> = known.iter().collect();
    let mut scored: Vec<_> =
        known.iter().map(|k| (strsim::jaro_winkler(&name.to_lowercase(), k), **k)).collect();
    scored.sort_by(|a, b| b.0.total_cmp(&a.0));
    scored.into_iter().take(N_SUGGESTIONS).map(|(_, k)| k).collect()
}

fn between<'a>(text: &'a str, before: &str, after: &str) -> Option<&'a str> {
    let start = text.find(before)? + before.len();
    let length = text[start..].find(after)?;
    Some(&text[start..start + length])
}

pub fn first_line(error: &PolarsError) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}
