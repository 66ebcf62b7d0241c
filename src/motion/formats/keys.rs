//! Lists of keys in messages.

use crate::excerpt::clip;

/// Most keys that a message lists.
const MAX_LISTED: usize = 12;

/// Returns the keys that a file has, the first of them.
pub fn listed(keys: &[String]) -> String {
    if keys.is_empty() {
        return "nothing".to_owned();
    }
    let mut names: Vec<String> = keys.iter().take(MAX_LISTED).map(|key| clip(key)).collect();
    if keys.len() > MAX_LISTED {
        names.push(format!("{} more", keys.len() - MAX_LISTED));
    }
    names.join(", ")
}

/// Returns the keys of which one is expected.
pub fn one_of(keys: &[&str]) -> String {
    match keys.split_last() {
        Some((last, rest)) if !rest.is_empty() => format!("{} or {last}", rest.join(", ")),
        Some((last, _)) => (*last).to_owned(),
        None => String::new(),
    }
}
