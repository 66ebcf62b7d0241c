//! What is kept of a table to compare it with later: a few numbers for each column.

use std::collections::BTreeMap;

use motiongen::store::digest;
use serde::{Deserialize, Serialize};

use super::table::{Table, Values};

/// A table's digest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TableDigest {
    pub n_rows: usize,
    pub columns: BTreeMap<String, ColumnDigest>,
}

/// A column's digest.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum ColumnDigest {
    Numbers(NumbersDigest),
    Texts(TextsDigest),
}

/// The digest of a column of numbers x₁ … x_n, in which changes of any value and of the order show.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct NumbersDigest {
    pub n_null: usize,
    /// Values that are not finite.
    pub n_not_finite: usize,
    pub min: f64,
    pub max: f64,
    pub mean: f64,
    /// √(Σ x² / n)
    pub rms: f64,
    /// Σ wᵢ xᵢ / √n, wᵢ uniform in −1 … 1 by a hash of the row: of the order of `rms`.
    pub weighted: f64,
}

/// The digest of a column of text.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TextsDigest {
    pub n_null: usize,
    /// BLAKE3 of all values in order.
    pub blake3: String,
}

impl TableDigest {
    pub fn of(table: &Table) -> Self {
        let digests = table.columns.iter().map(|(name, values)| {
            let digest = match values {
                Values::Numbers(x) => ColumnDigest::Numbers(numbers(x)),
                Values::Texts(x) => ColumnDigest::Texts(texts(x)),
            };
            (name.clone(), digest)
        });
        Self { n_rows: table.n_rows, columns: digests.collect() }
    }
}

fn numbers(values: &[Option<f64>]) -> NumbersDigest {
    let finite = || {
        let known = values.iter().enumerate().filter_map(|(i, x)| Some((i, (*x)?)));
        known.filter(|(_, x)| x.is_finite())
    };
    let n_null = values.iter().filter(|x| x.is_none()).count();
    let n = finite().count();
    let per_value = 1.0 / n.max(1) as f64;
    let least = finite().map(|(_, x)| x).reduce(f64::min);
    let greatest = finite().map(|(_, x)| x).reduce(f64::max);
    NumbersDigest {
        n_null,
        n_not_finite: values.len() - n_null - n,
        min: least.unwrap_or(0.0),
        max: greatest.unwrap_or(0.0),
        mean: finite().map(|(_, x)| x).sum::<f64>() * per_value,
        rms: (finite().map(|(_, x)| x * x).sum::<f64>() * per_value).sqrt(),
        weighted: finite().map(|(i, x)| weight(i as u64) * x).sum::<f64>() * per_value.sqrt(),
    }
}

/// Returns a number in −1 … 1 that a row's place determines: the finalizer of SplitMix64.
fn weight(row: u64) -> f64 {
    let z = row.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    let z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    let z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    2.0 * ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64 - 1.0
}

fn texts(values: &[Option<String>]) -> TextsDigest {
    let mut all = String::new();
    for text in values {
        // Lengths keep neighbours apart, and null from the empty text.
        match text {
            Some(text) => all += &format!("{} {text}\n", text.len()),
            None => all += "null\n",
        }
    }
    TextsDigest {
        n_null: values.iter().filter(|x| x.is_none()).count(),
        blake3: digest(all.as_bytes()),
    }
}
