//! Numbers of tasks as Slurm's `--array` takes them.

use std::collections::BTreeSet;
use std::fmt::Write as _;

/// Returns an array specification of numbers: `0,3,7-9`; of none it is empty.
pub fn array_specification(numbers: &BTreeSet<u32>) -> String {
    let mut text = String::new();
    let mut rest = numbers.iter().copied().peekable();
    while let Some(first) = rest.next() {
        let mut last = first;
        while rest.peek().is_some_and(|next| next - 1 == last) {
            last = rest.next().unwrap_or(last);
        }
        let comma = if text.is_empty() { "" } else { "," };
        match last - first {
            0 => write!(text, "{comma}{first}"),
            1 => write!(text, "{comma}{first},{last}"),
            _ => write!(text, "{comma}{first}-{last}"),
        }
        .expect("invariant: a string takes what is written");
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn runs_of_numbers_are_joined() {
        for (numbers, text) in [
            (&[][..], ""),
            (&[5], "5"),
            (&[0, 1], "0,1"),
            (&[0, 3, 7, 8, 9], "0,3,7-9"),
            (&[0, 1, 2, 4, 5, 6, 8, u32::MAX], "0-2,4-6,8,4294967295"),
        ] {
            assert_eq!(array_specification(&numbers.iter().copied().collect()), text);
        }
    }
}
