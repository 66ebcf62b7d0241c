//! Which phrase a file's motion is for, by its name.

use std::collections::HashMap;
use std::path::Path;

use super::ForeignPhrase;
use crate::stages::ingest::is_audio;

/// Most digits of a sample's number.
const MAX_DIGITS: usize = 9;

/// The phrases of a store by all the names that files may have; values are their places.
pub struct Names<'a> {
    /// By the whole name, with or without an audio extension.
    whole: HashMap<&'a str, usize>,
    /// By the last part of the name, `None` where several phrases have it.
    last: HashMap<&'a str, Option<usize>>,
    /// By the name of the audio file.
    audio: HashMap<&'a str, Option<usize>>,
}

impl<'a> Names<'a> {
    pub fn new(phrases: &'a [ForeignPhrase]) -> Self {
        let (mut whole, mut last, mut audio) = (HashMap::new(), HashMap::new(), HashMap::new());
        for (i, phrase) in phrases.iter().enumerate() {
            // Whole names first, so that no phrase `a.ogg` takes the name of a phrase `a`.
            whole.insert(phrase.id, i);
        }
        let add = |names: &mut HashMap<&'a str, Option<usize>>, name: &'a str, i: usize| {
            names
                .entry(name)
                .and_modify(|known| *known = known.filter(|k| *k == i))
                .or_insert(Some(i));
        };
        for (i, phrase) in phrases.iter().enumerate() {
            whole.entry(without_audio(phrase.id)).or_insert(i);
            for (names, name) in [(&mut last, phrase.id), (&mut audio, phrase.url)] {
                let name = last_part(name);
                add(names, name, i);
                add(names, without_audio(name), i);
            }
        }
        Self { whole, last, audio }
    }

    /// Returns the place of the phrase and the number of the sample that a name stands for.
    pub fn find(&self, name: &str) -> Option<(usize, usize)> {
        let whole = |name: &str| self.whole.get(name).copied();
        let bare = |name: &str| {
            let name = last_part(name);
            let lookup = |names: &HashMap<&str, Option<usize>>| names.get(name).copied().flatten();
            lookup(&self.last).or_else(|| lookup(&self.audio))
        };
        let numbered = numbered(name);
        let first = |phrase: usize| (phrase, 0);
        let with_number = |look: &dyn Fn(&str) -> Option<usize>| {
            numbered.iter().find_map(|&(name, sample)| Some((look(name)?, sample)))
        };
        whole(name)
            .map(first)
            .or_else(|| with_number(&whole))
            .or_else(|| bare(name).map(first))
            .or_else(|| with_number(&bare))
    }
}

/// Returns what stands before a number at the end of a name, `NAME.K` or `NAME/K`, with the number.
fn numbered(name: &str) -> Option<(&str, usize)> {
    let (before, digits) = name.rsplit_once(['.', '/'])?;
    let is_number = (1..=MAX_DIGITS).contains(&digits.len())
        && digits.bytes().all(|byte| byte.is_ascii_digit());
    Some((before, digits.parse().ok().filter(|_| is_number)?))
}

/// Returns a file's path below a folder without its extension, parts joined by `/`.
pub fn name_below(dir: &Path, path: &Path) -> String {
    let below = path.strip_prefix(dir).unwrap_or(path).with_extension("");
    let parts: Vec<_> = below.components().map(|part| part.as_os_str().to_string_lossy()).collect();
    parts.join("/")
}

fn last_part(name: &str) -> &str {
    name.rsplit_once('/').map_or(name, |(_, last)| last)
}

fn without_audio(name: &str) -> &str {
    match name.rsplit_once('.') {
        Some((before, extension)) if is_audio(extension) => before,
        _ => name,
    }
}
