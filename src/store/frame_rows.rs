//! The rows of one item of a frame table, dancer by dancer and frame by frame.

use std::ops::Range;

use arrow_array::{Array as _, Float32Array, Int32Array, RecordBatch, StringArray};
use ndarray::Array3;

use super::schema::TableSchema;

/// The columns of a batch of a frame table.
pub(super) struct FrameColumns<'a> {
    pub items: &'a StringArray,
    /// None where the table has no dancers.
    dancers: Option<&'a Int32Array>,
    numbers: &'a Int32Array,
    channels: Vec<&'a Float32Array>,
}

impl<'a> FrameColumns<'a> {
    /// Finds the columns of `table` in a batch, wherever they are.
    ///
    /// # Errors
    /// What the batch lacks, to go on from its name.
    pub fn of(batch: &'a RecordBatch, table: &TableSchema) -> Result<Self, String> {
        let column = |i: usize| batch.column_by_name(&table.columns[i].name);
        let missing = || "has no columns of frames".to_owned();
        let numbers_in =
            |i: usize| column(i).and_then(|c| c.as_any().downcast_ref()).ok_or_else(missing);
        let frame = table.frame_column();
        let items = batch.column_by_name(table.item_column());
        Ok(Self {
            items: items.and_then(|c| c.as_any().downcast_ref()).ok_or_else(missing)?,
            dancers: table.dancer_column().map(numbers_in).transpose()?,
            numbers: numbers_in(frame)?,
            channels: (frame + 1..table.columns.len())
                .map(|i| column(i).and_then(|c| c.as_any().downcast_ref()).ok_or_else(missing))
                .collect::<Result<_, _>>()?,
        })
    }
}

/// Frames of one item so far.
pub(super) struct GatheredFrames {
    n_channels: usize,
    /// The dancer whose frames come, and how many came.
    dancer: usize,
    n_frames: usize,
    /// Frames of each dancer, as the first has them.
    n_expected: Option<usize>,
    values: Vec<f32>,
}

impl GatheredFrames {
    pub fn new(n_channels: usize) -> Self {
        Self { n_channels, dancer: 0, n_frames: 0, n_expected: None, values: Vec::new() }
    }

    pub fn is_empty(&self) -> bool {
        self.values.is_empty()
    }

    /// Appends rows to those of the same item that came before.
    ///
    /// # Errors
    /// What is wrong with the rows, to go on from the item's name.
    pub fn take(&mut self, columns: &FrameColumns, rows: Range<usize>) -> Result<(), String> {
        if rows.is_empty() {
            return Ok(());
        }
        for row in rows.clone() {
            let dancer = columns.dancers.map_or(0, |dancers| dancers.value(row));
            self.expect(dancer, columns.numbers.value(row))?;
        }
        let start = self.values.len();
        self.values.resize(start + rows.len() * self.n_channels, 0.0);
        for (channel, column) in columns.channels.iter().enumerate() {
            let targets = self.values[start + channel..].iter_mut().step_by(self.n_channels);
            for (target, value) in targets.zip(&column.values()[rows.clone()]) {
                *target = *value;
            }
        }
        Ok(())
    }

    /// Counts a row, which is the next frame of the dancer or the first of the next dancer.
    fn expect(&mut self, dancer: i32, frame: i32) -> Result<(), String> {
        let found = (usize::try_from(dancer).ok(), usize::try_from(frame).ok());
        if found == (Some(self.dancer), Some(self.n_frames)) {
            self.n_frames += 1;
            return Ok(());
        }
        if found == (Some(self.dancer + 1), Some(0)) && self.n_frames > 0 {
            self.end_dancer()?;
            (self.dancer, self.n_frames) = (self.dancer + 1, 1);
            return Ok(());
        }
        let expected = self.n_frames;
        if (dancer, self.dancer) == (0, 0) {
            return Err(format!("has frame {frame} where frame {expected} should be"));
        }
        Err(format!(
            "has frame {frame} of dancer {dancer} where frame {expected} of dancer {} should be",
            self.dancer
        ))
    }

    /// Compares a dancer whose frames are all there with the first.
    fn end_dancer(&mut self) -> Result<(), String> {
        let n_first = *self.n_expected.get_or_insert(self.n_frames);
        if n_first == self.n_frames {
            return Ok(());
        }
        Err(format!(
            "has {} frames of dancer {} and {n_first} of dancer 0; the dancers of a group have as many frames each",
            self.n_frames, self.dancer
        ))
    }

    /// Returns all frames, `[n_dancers, n_frames, n_channels]`.
    ///
    /// # Errors
    /// What is wrong with them, to go on from the item's name.
    pub fn into_group(mut self) -> Result<Array3<f32>, String> {
        self.end_dancer()?;
        let shape = (self.dancer + 1, self.n_frames, self.n_channels);
        Ok(Array3::from_shape_vec(shape, self.values)
            .expect("invariant: every dancer has as many frames, all of whole rows"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::tables;
    use arrow_array::ArrayRef;
    use ndarray::{Axis, array};
    use std::sync::Arc;

    /// Rows of an item with two channels, each of dancer and frame; the channels are the row and its half.
    fn batch(table: &TableSchema, rows: &[(i32, i32)]) -> RecordBatch {
        let dancers: Int32Array = rows.iter().map(|row| Some(row.0)).collect();
        let frames: Int32Array = rows.iter().map(|row| Some(row.1)).collect();
        let channel =
            |scale: f32| (0..rows.len()).map(|i| Some(i as f32 * scale)).collect::<Float32Array>();
        let items: StringArray = rows.iter().map(|_| Some("a")).collect();
        let columns: Vec<ArrayRef> = vec![
            Arc::new(items),
            Arc::new(dancers),
            Arc::new(frames),
            Arc::new(channel(1.0)),
            Arc::new(channel(0.5)),
        ];
        RecordBatch::try_new(table.arrow(), columns).expect("the table's columns")
    }

    fn table() -> TableSchema {
        let mut table = tables::motion();
        table.columns.truncate(5);
        table
    }

    fn group(rows: &[(i32, i32)], cut: usize) -> Result<Array3<f32>, String> {
        let table = table();
        let batch = batch(&table, rows);
        let columns = FrameColumns::of(&batch, &table)?;
        let mut gathered = GatheredFrames::new(table.n_frame_channels());
        gathered.take(&columns, 0..cut)?;
        gathered.take(&columns, cut..rows.len())?;
        gathered.into_group()
    }

    #[test]
    fn dancers_come_apart_wherever_batches_end() {
        let rows = [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)];
        let expected =
            array![[[0.0, 0.0], [1.0, 0.5]], [[2.0, 1.0], [3.0, 1.5]], [[4.0, 2.0], [5.0, 2.5]]];
        for cut in 0..=rows.len() {
            assert_eq!(group(&rows, cut), Ok(expected.clone()), "{cut}");
        }
        let solo = group(&rows[..2], 1).expect("a soloist");
        assert_eq!(solo.index_axis(Axis(0), 0), array![[0.0, 0.0], [1.0, 0.5]]);
    }

    #[test]
    fn rows_out_of_order_are_refused_with_what_should_be_there() {
        for (rows, expected) in [
            (&[(0, 1)][..], "has frame 1 where frame 0 should be"),
            (&[(0, 0), (0, 2)], "has frame 2 where frame 1 should be"),
            (&[(0, 0), (0, 0)], "has frame 0 where frame 1 should be"),
            (&[(1, 0)], "has frame 0 of dancer 1 where frame 0 of dancer 0 should be"),
            (&[(0, 0), (2, 0)], "has frame 0 of dancer 2 where frame 1 of dancer 0 should be"),
            (&[(0, 0), (1, 1)], "has frame 1 of dancer 1 where frame 1 of dancer 0 should be"),
            (
                &[(0, 0), (1, 0), (0, 1)],
                "has frame 1 of dancer 0 where frame 1 of dancer 1 should be",
            ),
            (&[(0, 0), (-1, 0)], "has frame 0 of dancer -1 where frame 1 of dancer 0 should be"),
            (
                &[(0, 0), (0, 1), (1, 0), (2, 0), (2, 1)],
                "has 1 frames of dancer 1 and 2 of dancer 0; the dancers of a group have as many frames each",
            ),
            (
                &[(0, 0), (1, 0), (1, 1)],
                "has 2 frames of dancer 1 and 1 of dancer 0; the dancers of a group have as many frames each",
            ),
        ] {
            for cut in 0..=rows.len() {
                assert_eq!(group(rows, cut), Err(expected.to_owned()), "{rows:?} {cut}");
            }
        }
    }

    #[test]
    fn a_batch_without_frames_is_told() {
        let table = table();
        let short = batch(&table, &[(0, 0)]).project(&[0, 2, 3, 4]).expect("columns");
        let refused = FrameColumns::of(&short, &table).map(|_| ());
        assert_eq!(refused, Err("has no columns of frames".to_owned()));
    }
}
