//! Repeats and endings, written out.

use super::body::Measure;
use super::{AbcError, MAX_MEASURES};

/// Returns the measures in the order in which they are played.
///
/// A part that ends with `:|` is played twice, or as often as its endings say; a measure of an ending only when
/// the ending's number is that of the time.
pub fn unfold(measures: &[Measure]) -> Result<Vec<usize>, AbcError> {
    let mut played = Vec::new();
    let (mut start, mut time, mut i) = (0, 1_u32, 0);
    // Whether an ending was left behind, after which nothing is repeated any more.
    let mut was_ending = false;
    while let Some(measure) = measures.get(i) {
        let is_ending = measure.endings != 0;
        if (was_ending && !is_ending) || (measure.begins_repeat && i != start) {
            (start, time) = (i, 1);
        }
        was_ending = is_ending;
        if is_ending && measure.endings & (1 << time.min(31)) == 0 {
            i += 1;
            continue;
        }
        played.push(i);
        if played.len() > MAX_MEASURES {
            return Err(AbcError::TooLong);
        }
        i += 1;
        if measure.ends_repeat {
            let last = last_time(measures, start);
            if time < last {
                (i, time, was_ending) = (start, time + 1, false);
            } else if !is_ending {
                (start, time) = (i, 1);
            }
        }
    }
    Ok(played)
}

/// Returns how often the part is played that begins at a measure: the highest number of its endings, or 2.
fn last_time(measures: &[Measure], start: usize) -> u32 {
    let mut highest = 0;
    let mut was_ending = false;
    for measure in &measures[start..] {
        let is_ending = measure.endings != 0;
        if was_ending && !is_ending {
            break;
        }
        highest = highest.max(measure.endings.checked_ilog2().unwrap_or(0));
        if measure.ends_repeat && !is_ending {
            break;
        }
        was_ending = is_ending;
    }
    highest.max(2)
}
