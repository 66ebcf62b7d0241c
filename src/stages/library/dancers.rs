//! How many dancers the takes of a library have.

use std::fmt;
use std::str::FromStr;

use crate::motion::choreography::{GROUP_SIZES, draw_group_size};

/// A range of numbers of dancers, both ends included.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DancerRange {
    min: usize,
    max: usize,
}

impl DancerRange {
    /// Returns the number of dancers of the take with this seed, each of the range equally likely.
    pub fn draw(self, seed: u64) -> usize {
        draw_group_size(self.min..=self.max, seed)
    }
}

impl FromStr for DancerRange {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let (min, max) = text.split_once("..").unwrap_or((text, text));
        let number = |text: &str| text.trim().parse::<usize>();
        let (Ok(min), Ok(max)) = (number(min), number(max)) else {
            return Err("give a number of dancers such as 3, or a range such as 2..5".to_owned());
        };
        if min > max {
            return Err(format!("the range ends with {max}, before its {min}; write {max}..{min}"));
        }
        if !GROUP_SIZES.contains(&min) || !GROUP_SIZES.contains(&max) {
            let (low, high) = (GROUP_SIZES.start(), GROUP_SIZES.end());
            return Err(format!("a group has {low} to {high} dancers"));
        }
        Ok(Self { min, max })
    }
}

impl fmt::Display for DancerRange {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.min == self.max {
            write!(f, "{}", self.min)
        } else {
            write!(f, "{}..{}", self.min, self.max)
        }
    }
}

impl serde::Serialize for DancerRange {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_read_and_written_back() {
        for (text, min, max) in [("3", 3, 3), ("2..5", 2, 5), ("1..16", 1, 16), ("4..4", 4, 4)] {
            let range: DancerRange = text.parse().unwrap();
            assert_eq!((range.min, range.max), (min, max));
            let written = range.to_string();
            assert_eq!(written.parse::<DancerRange>().unwrap(), range);
        }
        assert_eq!(serde_json::json!("2..5".parse::<DancerRange>().unwrap()), "2..5");
        let refused = |text: &str| text.parse::<DancerRange>().unwrap_err();
        let form = "give a number of dancers such as 3, or a range such as 2..5";
        assert_eq!(["", "a", "2..", "-1", "2...5"].map(refused), [form; 5]);
        assert_eq!(refused("5..2"), "the range ends with 2, before its 5; write 2..5");
        assert_eq!(["0", "2..17"].map(refused), ["a group has 1 to 16 dancers"; 2]);
    }

    #[test]
    fn draws_lie_within_the_range() {
        let range: DancerRange = "2..5".parse().unwrap();
        let drawn: std::collections::BTreeSet<usize> = (0..100).map(|s| range.draw(s)).collect();
        assert_eq!(drawn.into_iter().collect::<Vec<_>>(), [2, 3, 4, 5]);
    }
}
