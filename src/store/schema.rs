//! Table schemas: a column's name, type, unit and meaning, spelled once.

use std::borrow::Cow;
use std::sync::Arc;

use arrow_array::{
    Array, ArrayRef, BooleanArray, Float32Array, Float64Array, Int32Array, Int64Array, RecordBatch,
    StringArray, TimestampMicrosecondArray, new_null_array,
};
use arrow_schema::{DataType, Field, Schema, SchemaRef, TimeUnit};

/// A table: what one row is, its columns, and the order of its rows within a part.
#[derive(Clone, Debug, PartialEq)]
pub struct TableSchema {
    pub name: &'static str,
    /// Raised when a column changes; parts of versions that are not read are refused, not guessed at.
    pub version: u32,
    /// The oldest version that is read: since then only columns were added that are null in older parts, or have
    /// the value there that they name.
    pub oldest_version: u32,
    /// The meaning of one row.
    pub description: &'static str,
    pub columns: Vec<Column>,
    /// Columns by which the rows of a part are sorted.
    pub sorted_by: &'static [&'static str],
}

/// One column of a table.
#[derive(Clone, Debug, PartialEq)]
pub struct Column {
    pub name: Cow<'static, str>,
    pub column_type: ColumnType,
    pub nullable: bool,
    /// Of a column that is not nullable and newer than its table: what it is in all rows of older parts.
    pub absent: Option<i32>,
    /// Unit of the values; empty for names, flags and other unitless text.
    pub unit: &'static str,
    pub description: Cow<'static, str>,
}

/// The types that columns may have, named as Arrow names them.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ColumnType {
    Utf8,
    Boolean,
    Int32,
    Int64,
    Float32,
    Float64,
    /// Microseconds since 1970-01-01T00:00:00 UTC.
    TimestampUs,
}

impl ColumnType {
    pub fn name(self) -> &'static str {
        match self {
            ColumnType::Utf8 => "utf8",
            ColumnType::Boolean => "boolean",
            ColumnType::Int32 => "int32",
            ColumnType::Int64 => "int64",
            ColumnType::Float32 => "float32",
            ColumnType::Float64 => "float64",
            ColumnType::TimestampUs => "timestamp[us, UTC]",
        }
    }

    fn data_type(self) -> DataType {
        match self {
            ColumnType::Utf8 => DataType::Utf8,
            ColumnType::Boolean => DataType::Boolean,
            ColumnType::Int32 => DataType::Int32,
            ColumnType::Int64 => DataType::Int64,
            ColumnType::Float32 => DataType::Float32,
            ColumnType::Float64 => DataType::Float64,
            ColumnType::TimestampUs => {
                DataType::Timestamp(TimeUnit::Microsecond, Some("UTC".into()))
            }
        }
    }
}

/// The column that counts the frames of a dancer, or of an item without dancers.
pub const FRAME_COLUMN: &str = "frame";

/// The column that counts the dancers of an item.
pub const DANCER_COLUMN: &str = "dancer";

impl TableSchema {
    /// Returns the column that names the item which a row belongs to: the first that rows are sorted by.
    pub fn item_column(&self) -> &'static str {
        self.sorted_by[0]
    }

    /// Returns the place of the column that counts the frames of a frame table. Before it are the item, what else
    /// names it (labels) and the dancer if the table has dancers, behind it the channels.
    pub fn frame_column(&self) -> usize {
        self.columns.iter().position(|column| column.name == FRAME_COLUMN).unwrap_or(0)
    }

    /// Returns the place of the column that counts the dancers of a frame table, which is just before the frame;
    /// none where the table has no dancers.
    pub fn dancer_column(&self) -> Option<usize> {
        self.columns.iter().position(|column| column.name == DANCER_COLUMN)
    }

    /// Returns how many channels each frame of a frame table has.
    pub fn n_frame_channels(&self) -> usize {
        self.columns.len().saturating_sub(self.frame_column() + 1)
    }

    /// Returns how many columns of a frame table name an item beside the item column.
    pub fn n_labels(&self) -> usize {
        let n_named = self.dancer_column().unwrap_or(self.frame_column());
        n_named.saturating_sub(1)
    }

    /// Returns whether parts of a version are read.
    pub fn reads(&self, version: u32) -> bool {
        (self.oldest_version..=self.version).contains(&version)
    }

    /// Names the versions that are read, as messages do: `version 1` or `versions 1 to 3`.
    pub fn readable(&self) -> String {
        if self.oldest_version < self.version {
            format!("versions {} to {}", self.oldest_version, self.version)
        } else {
            format!("version {}", self.version)
        }
    }

    /// Returns whether parts of a version that is read lack a column which is not null in them.
    pub(super) fn lacks_values(&self, version: u32) -> bool {
        version < self.version && self.columns.iter().any(|column| column.absent.is_some())
    }

    /// Returns a batch of a part of a version that is read, with the columns that are newer than the part: null
    /// where they may be, else what they say that older parts have. A column that is missing for another reason
    /// stays missing.
    pub(super) fn completed(&self, batch: RecordBatch, version: u32) -> RecordBatch {
        if version >= self.version {
            return batch;
        }
        let (mut fields, mut columns) =
            (batch.schema().fields().to_vec(), batch.columns().to_vec());
        for (column, field) in self.columns.iter().zip(self.arrow().fields()) {
            if batch.column_by_name(field.name()).is_some() {
                continue;
            }
            let values: ArrayRef = match column.absent {
                Some(value) => Arc::new(Int32Array::from(vec![value; batch.num_rows()])),
                None if column.nullable => new_null_array(field.data_type(), batch.num_rows()),
                None => continue,
            };
            columns.push(values);
            fields.push(Arc::clone(field));
        }
        RecordBatch::try_new(Arc::new(Schema::new(fields)), columns)
            .expect("invariant: a whole batch, and columns of its length")
    }

    /// Returns the Arrow schema of the table's parts.
    pub fn arrow(&self) -> SchemaRef {
        let field = |c: &Column| Field::new(c.name.as_ref(), c.column_type.data_type(), c.nullable);
        Arc::new(Schema::new(self.columns.iter().map(field).collect::<Vec<_>>()))
    }

    /// Returns the schema as the JSON that `schemas/<table>.json` holds.
    pub fn to_json(&self) -> serde_json::Value {
        let columns: Vec<_> = self
            .columns
            .iter()
            .map(|c| {
                serde_json::json!({
                    "name": c.name,
                    "type": c.column_type.name(),
                    "nullable": c.nullable,
                    "unit": c.unit,
                    "description": c.description,
                })
            })
            .collect();
        serde_json::json!({
            "table": self.name,
            "version": self.version,
            "description": self.description,
            "sorted_by": self.sorted_by,
            "columns": columns,
        })
    }

    /// Returns the table's section of `docs/tables.md`.
    pub fn to_markdown(&self) -> String {
        let mut text = format!(
            "## `{}` (version {})\n\n{} Sorted by {}.\n\n\
             | column | type | null | unit | meaning |\n|---|---|---|---|---|\n",
            self.name,
            self.version,
            self.description,
            self.sorted_by.iter().map(|c| format!("`{c}`")).collect::<Vec<_>>().join(", "),
        );
        for c in &self.columns {
            let null = if c.nullable { "yes" } else { "" };
            text += &format!(
                "| `{}` | {} | {null} | {} | {} |\n",
                c.name,
                c.column_type.name(),
                c.unit,
                c.description
            );
        }
        text
    }
}

/// A moment, in microseconds since 1970-01-01T00:00:00 UTC.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TimestampUs(pub i64);

impl TimestampUs {
    /// Returns the present moment.
    pub fn now() -> Self {
        let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
        Self(since.map_or(0, |d| i64::try_from(d.as_micros()).unwrap_or(i64::MAX)))
    }
}

/// A Rust type that can be a column's cell.
pub trait Cell: Sized {
    const TYPE: ColumnType;
    const NULLABLE: bool = false;

    fn array(cells: impl Iterator<Item = Self>) -> ArrayRef;

    /// Returns the cell of row `i`, or `None` when the array is of another type.
    fn get(array: &dyn Array, i: usize) -> Option<Self>;
}

macro_rules! cell {
    ($rust:ty, $array:ty, $variant:ident, |$v:ident| $get:expr) => {
        impl Cell for $rust {
            const TYPE: ColumnType = ColumnType::$variant;
            fn array(cells: impl Iterator<Item = Self>) -> ArrayRef {
                Arc::new(cells.map(Some).collect::<$array>())
            }
            fn get(array: &dyn Array, i: usize) -> Option<Self> {
                let $v = array.as_any().downcast_ref::<$array>()?.value(i);
                Some($get)
            }
        }
        impl Cell for Option<$rust> {
            const TYPE: ColumnType = ColumnType::$variant;
            const NULLABLE: bool = true;
            fn array(cells: impl Iterator<Item = Self>) -> ArrayRef {
                Arc::new(cells.collect::<$array>())
            }
            fn get(array: &dyn Array, i: usize) -> Option<Self> {
                if array.is_null(i) {
                    return Some(None);
                }
                <$rust as Cell>::get(array, i).map(Some)
            }
        }
    };
}

cell!(String, StringArray, Utf8, |v| v.to_owned());
cell!(bool, BooleanArray, Boolean, |v| v);
cell!(i32, Int32Array, Int32, |v| v);
cell!(i64, Int64Array, Int64, |v| v);
cell!(f32, Float32Array, Float32, |v| v);
cell!(f64, Float64Array, Float64, |v| v);

impl Cell for TimestampUs {
    const TYPE: ColumnType = ColumnType::TimestampUs;
    fn array(cells: impl Iterator<Item = Self>) -> ArrayRef {
        let array: TimestampMicrosecondArray = cells.map(|t| Some(t.0)).collect();
        Arc::new(array.with_timezone("UTC"))
    }
    fn get(array: &dyn Array, i: usize) -> Option<Self> {
        let array = array.as_any().downcast_ref::<TimestampMicrosecondArray>()?;
        Some(TimestampUs(array.value(i)))
    }
}

/// A row type of a table; made by `rows!`.
pub trait Row: Sized {
    fn schema() -> TableSchema;

    /// Returns rows as a batch of the table's Arrow schema.
    fn to_batch(rows: &[Self]) -> RecordBatch;

    /// Returns the rows of a batch, or `None` when a column is missing or of another type.
    fn from_batch(batch: &RecordBatch) -> Option<Vec<Self>>;
}

/// Declares a table and its row type at once, so that neither can drift from the other. `version 3 reads 2` says
/// that parts of version 2 are read, too: all that was added since then is nullable.
macro_rules! rows {
    (
        $description:literal
        $row:ident in $name:literal version $version:literal $(reads $oldest:literal)? sorted by [$($sort:ident),+]
        { $($field:ident: $type:ty, $unit:literal, $meaning:literal;)+ }
    ) => {
        #[doc = $description]
        #[derive(Clone, Debug, PartialEq)]
        pub struct $row {
            $(#[doc = $meaning] pub $field: $type,)+
        }

        impl $crate::store::schema::Row for $row {
            fn schema() -> $crate::store::schema::TableSchema {
                use $crate::store::schema::{Cell, Column, TableSchema};
                TableSchema {
                    name: $name,
                    version: $version,
                    oldest_version: [$($oldest,)? $version][0],
                    description: $description,
                    columns: vec![$(Column {
                        name: stringify!($field).into(),
                        column_type: <$type as Cell>::TYPE,
                        nullable: <$type as Cell>::NULLABLE,
                        absent: None,
                        unit: $unit,
                        description: $meaning.into(),
                    },)+],
                    sorted_by: &[$(stringify!($sort)),+],
                }
            }

            fn to_batch(rows: &[Self]) -> arrow_array::RecordBatch {
                use $crate::store::schema::Cell;
                let columns = vec![$(
                    <$type as Cell>::array(rows.iter().map(|r| r.$field.clone())),
                )+];
                arrow_array::RecordBatch::try_new(Self::schema().arrow(), columns)
                    .expect("invariant: the arrays are made from the schema's own cell types")
            }

            fn from_batch(batch: &arrow_array::RecordBatch) -> Option<Vec<Self>> {
                use $crate::store::schema::Cell;
                $(let $field = batch.column_by_name(stringify!($field))?;)+
                (0..batch.num_rows())
                    .map(|i| Some($row { $($field: <$type as Cell>::get($field.as_ref(), i)?,)+ }))
                    .collect()
            }
        }
    };
}
pub(crate) use rows;

#[cfg(test)]
mod tests {
    use super::*;

    rows! {
        "As it was."
        OldRow in "things" version 2 sorted by [id]
        {
            id: String, "", "Name.";
            length_m: f64, "m", "Length.";
        }
    }

    rows! {
        "With two columns more, one of them in the middle."
        NewRow in "things" version 4 reads 2 sorted by [id]
        {
            id: String, "", "Name.";
            colour: Option<String>, "", "Colour.";
            length_m: f64, "m", "Length.";
            weight_kg: Option<i32>, "kg", "Weight.";
        }
    }

    #[test]
    fn an_older_batch_is_read_with_nulls_where_nothing_was() {
        let (old, new) = (OldRow::schema(), NewRow::schema());
        assert_eq!((old.oldest_version, new.oldest_version), (2, 2));
        assert_eq!(
            (0..6).map(|v| new.reads(v)).collect::<Vec<_>>(),
            [false, false, true, true, true, false]
        );
        assert_eq!(
            (old.readable(), new.readable()),
            ("version 2".into(), "versions 2 to 4".into())
        );
        let batch = OldRow::to_batch(&[
            OldRow { id: "a".into(), length_m: 1.5 },
            OldRow { id: "b".into(), length_m: -2.0 },
        ]);
        assert_eq!(NewRow::from_batch(&batch), None);
        let row =
            |id: &str, length_m| NewRow { id: id.into(), colour: None, length_m, weight_kg: None };
        let rows = NewRow::from_batch(&new.completed(batch.clone(), 2));
        assert_eq!(rows, Some(vec![row("a", 1.5), row("b", -2.0)]));
        assert!(!new.lacks_values(2) && !new.lacks_values(4));
        // A column that is not null is what it says that older parts have.
        let mut counted = new.clone();
        counted.columns[2] = Column {
            name: "dancer".into(),
            column_type: ColumnType::Int32,
            absent: Some(7),
            ..counted.columns[2].clone()
        };
        assert!(counted.lacks_values(2) && !counted.lacks_values(4));
        let filled = counted.completed(batch.clone(), 2);
        let dancer = filled.column_by_name("dancer").and_then(|c| c.as_any().downcast_ref());
        assert_eq!(dancer, Some(&Int32Array::from(vec![7, 7])));
        assert!(counted.completed(batch.clone(), 4).column_by_name("dancer").is_none());
        // A part of this version has all its columns, or is broken.
        assert_eq!(NewRow::from_batch(&new.completed(batch.clone(), 4)), None);
        // What may not be null is not made up.
        let short = batch.project(&[0]).expect("one column");
        let completed = new.completed(short, 2);
        assert_eq!(NewRow::from_batch(&completed), None);
        assert_eq!(completed.column_by_name("length_m").map(|c| c.len()), None);
    }
}
