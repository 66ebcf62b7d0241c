//! A table in memory, its rows in the order that its schema names.

use anyhow::{Context as _, bail};
use arrow_array::ArrayRef;
use arrow_array::cast::AsArray as _;
use arrow_array::types::{Float32Type, Float64Type, Int32Type, Int64Type};
use motiongen::store::{Column, ColumnType, Location, Snapshot, TableSchema};

/// The values of a column, row by row.
#[derive(Clone, Debug, PartialEq)]
pub enum Values {
    Numbers(Vec<Option<f64>>),
    Texts(Vec<Option<String>>),
}

impl Values {
    fn of(column_type: ColumnType) -> Self {
        match column_type {
            ColumnType::Utf8 => Self::Texts(Vec::new()),
            _ => Self::Numbers(Vec::new()),
        }
    }

    fn extend(&mut self, array: &ArrayRef, column: &Column) -> anyhow::Result<()> {
        match self {
            Self::Texts(texts) => {
                let found = array.as_string_opt::<i32>().context("not a column of text")?;
                texts.extend(found.iter().map(|text| text.map(str::to_owned)));
            }
            Self::Numbers(numbers) => match column.column_type {
                ColumnType::Boolean => {
                    let found = array.as_boolean_opt().context("not a column of flags")?;
                    numbers.extend(found.iter().map(|x| x.map(f64::from)));
                }
                ColumnType::Int32 => {
                    let found = array.as_primitive_opt::<Int32Type>().context("not int32")?;
                    numbers.extend(found.iter().map(|x| x.map(f64::from)));
                }
                ColumnType::Int64 => {
                    let found = array.as_primitive_opt::<Int64Type>().context("not int64")?;
                    numbers.extend(found.iter().map(|x| x.map(|x| x as f64)));
                }
                ColumnType::Float32 => {
                    let found = array.as_primitive_opt::<Float32Type>().context("not float32")?;
                    numbers.extend(found.iter().map(|x| x.map(f64::from)));
                }
                ColumnType::Float64 => {
                    let found = array.as_primitive_opt::<Float64Type>().context("not float64")?;
                    numbers.extend(found.iter());
                }
                ColumnType::Utf8 | ColumnType::TimestampUs => bail!("not a column of numbers"),
            },
        }
        Ok(())
    }

    fn arranged(self, order: &[usize]) -> Self {
        match self {
            Self::Numbers(x) => Self::Numbers(order.iter().map(|&i| x[i]).collect()),
            Self::Texts(x) => Self::Texts(order.iter().map(|&i| x[i].clone()).collect()),
        }
    }

    /// Compares two rows.
    fn compare(&self, a: usize, b: usize) -> std::cmp::Ordering {
        match self {
            Self::Numbers(x) => {
                let number = |i: usize| x[i].unwrap_or(f64::NEG_INFINITY);
                number(a).total_cmp(&number(b))
            }
            Self::Texts(x) => x[a].cmp(&x[b]),
        }
    }
}

/// A table of a store, whatever parts it lies in.
pub struct Table {
    pub n_rows: usize,
    /// Names and values, in the order of the schema.
    pub columns: Vec<(String, Values)>,
}

/// Returns whether a column tells of the run rather than of its results: when and how fast it went, and where files lay.
pub fn is_of_the_run(column: &Column) -> bool {
    const OF_THE_RUN: [&str; 7] = [
        "elapsed_s",
        "samples_per_s",
        "data_wait_s",
        "generate_s",
        "resident_bytes",
        "real_time_factor",
        "took_s",
    ];
    column.column_type == ColumnType::TimestampUs
        || column.unit == "URL"
        || OF_THE_RUN.contains(&column.name.as_ref())
}

impl Table {
    /// Reads the live rows of a table, without the columns that tell of the run.
    pub fn read(store: &Location, schema: &TableSchema) -> anyhow::Result<Self> {
        let kept: Vec<&Column> =
            schema.columns.iter().filter(|column| !is_of_the_run(column)).collect();
        let mut columns: Vec<Values> =
            kept.iter().map(|column| Values::of(column.column_type)).collect();
        let mut n_rows = 0;
        for batch in Snapshot::take(store, schema.clone())?.batches() {
            let batch = batch?;
            n_rows += batch.num_rows();
            for (values, column) in columns.iter_mut().zip(&kept) {
                let place = || format!("table {}, column {}", schema.name, column.name);
                let array = batch.column_by_name(&column.name).with_context(place)?;
                values.extend(array, column).with_context(place)?;
            }
        }
        let keys: Vec<&Values> = schema
            .sorted_by
            .iter()
            .filter_map(|key| kept.iter().position(|column| column.name == *key))
            .map(|i| &columns[i])
            .collect();
        let mut order: Vec<usize> = (0..n_rows).collect();
        order.sort_by(|&a, &b| {
            let differing = keys.iter().map(|key| key.compare(a, b));
            differing.fold(std::cmp::Ordering::Equal, |known, next| known.then(next))
        });
        let names = kept.iter().map(|column| column.name.to_string());
        let arranged = columns.into_iter().map(|values| values.arranged(&order));
        let columns = names.zip(arranged).collect();
        Ok(Self { n_rows, columns })
    }
}
