//! Names that are like one that is not there.

/// Names that an unknown name is told.
const N_NEAREST: usize = 3;

/// Returns the names most like `wanted`, as messages list them.
pub fn nearest(wanted: &str, names: impl IntoIterator<Item = String>) -> String {
    let mut names: Vec<String> = names.into_iter().collect();
    let likeness = |name: &String| strsim::jaro_winkler(wanted, name);
    names.sort_by(|a, b| likeness(b).total_cmp(&likeness(a)).then_with(|| a.cmp(b)));
    names.truncate(N_NEAREST);
    names.join(", ")
}
