//! Parquet files that are not parts of a store, written by any program and with any columns.

use std::collections::BTreeMap;

use arrow_array::cast::AsArray as _;
use arrow_array::types::{Float32Type, Float64Type, Int32Type, Int64Type};
use arrow_array::{Array, RecordBatch};
use arrow_schema::DataType;
use bytes::Bytes;
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::errors::ParquetError;

/// Most numbers that are read of a file: 1 GiB of them.
const MAX_NUMBERS: u64 = (1 << 30) / size_of::<f64>() as u64;

/// Why a file's columns could not be read.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum NumberColumnsError {
    #[error("is no readable Parquet file ({0}); write it again")]
    Parquet(#[from] ParquetError),
    #[error("has {n_rows} rows, more than the {most} that are read; split it")]
    TooLarge { n_rows: u64, most: u64 },
    #[error("has column {column} of type {found}, expected float, double, int32 or int64")]
    Type { column: String, found: String },
}

/// Reads those of the `wanted` columns that a Parquet file has, by name; what is null is NaN.
///
/// # Errors
/// [`NumberColumnsError`], a sentence that goes on from the file's name.
pub fn number_columns(
    bytes: Bytes,
    wanted: &[&str],
) -> Result<BTreeMap<String, Vec<f64>>, NumberColumnsError> {
    let builder = ParquetRecordBatchReaderBuilder::try_new(bytes)?;
    let n_rows = builder.metadata().file_metadata().num_rows();
    let n_rows = u64::try_from(n_rows)
        .map_err(|_| ParquetError::General(format!("its footer counts {n_rows} rows")))?;
    let most = MAX_NUMBERS / wanted.len().max(1) as u64;
    if n_rows > most {
        return Err(NumberColumnsError::TooLarge { n_rows, most });
    }
    let names = wanted.iter().copied().filter(|name| builder.schema().index_of(name).is_ok());
    let mut columns: BTreeMap<String, Vec<f64>> =
        names.map(|name| (name.to_owned(), Vec::new())).collect();
    let mask = ProjectionMask::columns(
        builder.parquet_schema(),
        columns.keys().map(String::as_str).collect::<Vec<_>>(),
    );
    for batch in builder.with_projection(mask).build()? {
        let batch = batch.map_err(ParquetError::from)?;
        for (name, values) in &mut columns {
            append(&batch, name, values)?;
        }
    }
    Ok(columns)
}

fn append(
    batch: &RecordBatch,
    name: &str,
    values: &mut Vec<f64>,
) -> Result<(), NumberColumnsError> {
    let unknown = |found: String| NumberColumnsError::Type { column: name.to_owned(), found };
    let column = batch.column_by_name(name).ok_or_else(|| unknown("none".to_owned()))?;
    let numbers = |number: &dyn Fn(usize) -> f64| -> Vec<f64> {
        (0..column.len()).map(|i| if column.is_null(i) { f64::NAN } else { number(i) }).collect()
    };
    values.extend(match column.data_type() {
        DataType::Float32 => {
            let column = column.as_primitive::<Float32Type>();
            numbers(&|i| f64::from(column.value(i)))
        }
        DataType::Float64 => {
            let column = column.as_primitive::<Float64Type>();
            numbers(&|i| column.value(i))
        }
        DataType::Int32 => {
            let column = column.as_primitive::<Int32Type>();
            numbers(&|i| f64::from(column.value(i)))
        }
        DataType::Int64 => {
            let column = column.as_primitive::<Int64Type>();
            numbers(&|i| column.value(i) as f64)
        }
        other => return Err(unknown(other.to_string())),
    });
    Ok(())
}

#[cfg(test)]
pub mod tests {
    use std::sync::Arc;

    use arrow_array::{ArrayRef, Float64Array, Int64Array, StringArray};
    use parquet::arrow::ArrowWriter;

    use super::*;

    fn file(columns: Vec<(&str, ArrayRef)>) -> Bytes {
        let batch = RecordBatch::try_from_iter_with_nullable(
            columns.into_iter().map(|(name, column)| (name, column, true)),
        );
        let batch = batch.expect("columns of one length");
        let mut bytes = Vec::new();
        let mut writer = ArrowWriter::try_new(&mut bytes, batch.schema(), None).expect("a writer");
        writer.write(&batch).expect("written");
        writer.close().expect("closed");
        bytes.into()
    }

    /// Returns the bytes of a Parquet file with columns of numbers.
    pub fn parquet_of(columns: &[(&str, Vec<f64>)]) -> Vec<u8> {
        let array = |values: &Vec<f64>| Arc::new(Float64Array::from(values.clone())) as ArrayRef;
        file(columns.iter().map(|(name, values)| (*name, array(values))).collect()).to_vec()
    }

    #[test]
    fn wanted_columns_are_read_by_name_and_nulls_are_nan() {
        let bytes = file(vec![
            ("name", Arc::new(StringArray::from(vec!["a", "b", "c"])) as ArrayRef),
            ("frame", Arc::new(Int64Array::from(vec![4, 5, 6]))),
            ("x", Arc::new(Float64Array::from(vec![Some(0.25), None, Some(f64::INFINITY)]))),
        ]);
        let found = number_columns(bytes.clone(), &["x", "y", "frame"]).expect("columns");
        assert_eq!(found.keys().collect::<Vec<_>>(), ["frame", "x"]);
        assert_eq!(found["frame"], [4.0, 5.0, 6.0]);
        assert_eq!((found["x"][0], found["x"][2]), (0.25, f64::INFINITY));
        assert!(found["x"][1].is_nan());
        let error = number_columns(bytes, &["name"]).expect_err("text");
        assert_eq!(
            error.to_string(),
            "has column name of type Utf8, expected float, double, int32 or int64"
        );
    }
}
