//! Motion as a stream of JSON: a line for each frame, an object of the columns of `csv`.

use std::io::{self, Write};

use ndarray::ArrayView2;

use super::csv::column_names;
use crate::units::frames_to_s;

/// Writes the lines of frames, `[T, 25]`, of which the first has the number `first_frame`.
///
/// Numbers are the shortest that are read back bit for bit; JSON has no word for what is not finite, which is `null`.
///
/// # Errors
/// The error of `out`.
pub fn write_ndjson_rows(
    frames: ArrayView2<'_, f32>,
    first_frame: usize,
    out: &mut dyn Write,
) -> io::Result<()> {
    let names: Vec<&str> = column_names().collect();
    let [of_frame, of_time, channels @ ..] = &names[..] else {
        unreachable!("frame and time come before the channels")
    };
    for (frame, row) in (first_frame..).zip(frames.rows()) {
        write!(out, "{{\"{of_frame}\":{frame},\"{of_time}\":{:?}", frames_to_s(frame))?;
        for (name, x) in channels.iter().zip(row) {
            match x.is_finite() {
                true => write!(out, ",\"{name}\":{x:?}")?,
                false => write!(out, ",\"{name}\":null")?,
            }
        }
        out.write_all(b"}\n")?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motion::MOTION_DIM;
    use ndarray::Array2;

    #[test]
    fn every_line_is_an_object_that_gives_the_numbers_back() {
        let mut motion = Array2::from_shape_fn((3, MOTION_DIM), |(t, i)| {
            (t as f32 - 1.1) * 1e-9_f32.powi(i as i32 % 3)
        });
        motion[[2, 24]] = f32::NAN;
        let mut text = Vec::new();
        write_ndjson_rows(motion.view(), 7, &mut text).expect("memory");
        let text = String::from_utf8(text).expect("text");
        let lines: Vec<serde_json::Value> =
            text.lines().map(|line| serde_json::from_str(line).expect("an object")).collect();
        assert_eq!(lines.len(), 3);
        for (t, line) in lines.iter().enumerate() {
            assert_eq!(line["frame"], 7 + t);
            for (i, name) in column_names().skip(2).enumerate() {
                match line[name].as_f64() {
                    Some(x) => assert_eq!(x as f32, motion[[t, i]], "{name}"),
                    None => assert_eq!((t, i), (2, 24)),
                }
            }
        }
    }
}
