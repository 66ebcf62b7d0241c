//! Windows in pairs: groups that dance to the same music, so that what tells them apart is their dancers alone.

use std::collections::HashMap;
use std::hash::Hash;

use super::batch::PAIR;

/// Orders windows so that 2k and 2k + 1 are to the same music wherever a partner of another phrase is left.
///
/// Windows without such a partner come last, paired with each other; of an odd number the last is paired with the first
/// window. `phrase` and `music` tell what a window is of.
pub fn in_pairs<W: Copy, P: PartialEq, M: Eq + Hash>(
    windows: &[W],
    phrase: impl Fn(W) -> P,
    music: impl Fn(W) -> M,
) -> Vec<W> {
    let mut paired = Vec::with_capacity(windows.len() + 1);
    let mut waiting: HashMap<M, Vec<usize>> = HashMap::new();
    for (i, &window) in windows.iter().enumerate() {
        let of_music = waiting.entry(music(window)).or_default();
        match of_music.iter().position(|&j| phrase(windows[j]) != phrase(window)) {
            Some(k) => paired.extend([windows[of_music.remove(k)], window]),
            None => of_music.push(i),
        }
    }
    let mut left: Vec<usize> = waiting.into_values().flatten().collect();
    left.sort_unstable();
    paired.extend(left.into_iter().map(|i| windows[i]));
    if !paired.len().is_multiple_of(PAIR) {
        paired.extend(paired.first().copied());
    }
    paired
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn partners_dance_another_phrase_to_the_same_music() {
        // (phrase, music); phrase 1 has two windows, which are no partners of each other.
        let windows =
            [(1, 'a'), (1, 'a'), (2, 'b'), (3, 'a'), (4, 'c'), (5, 'b'), (6, 'a'), (7, 'd')];
        let paired = in_pairs(&windows, |w| w.0, |w| w.1);
        assert_eq!(
            paired,
            [(1, 'a'), (3, 'a'), (2, 'b'), (5, 'b'), (1, 'a'), (6, 'a'), (4, 'c'), (7, 'd')]
        );
    }

    #[test]
    fn an_odd_one_is_paired_with_the_first() {
        let windows = [(1, 'a'), (2, 'b'), (3, 'a')];
        let paired = in_pairs(&windows, |w| w.0, |w| w.1);
        assert_eq!(paired, [(1, 'a'), (3, 'a'), (2, 'b'), (1, 'a')]);
        assert_eq!(in_pairs(&[] as &[(u8, u8)], |w| w.0, |w| w.1), []);
    }
}
