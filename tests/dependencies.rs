//! `docs/dependencies.md` has every crate that `Cargo.toml` names, in the version that it names, and no other.

use std::collections::BTreeMap;

/// A crate's name and the version that is told, if one is.
type Crates = BTreeMap<String, Option<String>>;

/// Returns the crates of `Cargo.toml`, with the versions that they ask for.
fn wanted(manifest: &str) -> Crates {
    let manifest: toml::Table = manifest.parse().expect("Cargo.toml");
    let tables = ["dependencies", "dev-dependencies"];
    let named = tables.iter().filter_map(|table| manifest.get(*table)?.as_table());
    let version = |value: &toml::Value| {
        let version = value.as_str().or_else(|| value.get("version")?.as_str());
        version.map(|version| version.trim_start_matches('=').to_owned())
    };
    named.flatten().map(|(name, value)| (name.clone(), version(value))).collect()
}

/// Returns the crates of the first column of the tables: `` `a`, `b` 1.2 (`feature`) ``.
fn described(page: &str) -> Crates {
    let mut crates = Crates::new();
    let rows = page.lines().filter_map(|line| line.strip_prefix("| `"));
    for cell in rows.filter_map(|row| row.split(" | ").next()) {
        // What stands in parentheses are features and parts.
        let mut plain = String::new();
        let mut depth = 0;
        for c in cell.chars() {
            depth += i32::from(c == '(');
            if depth == 0 && c != '`' {
                plain.push(c);
            }
            depth -= i32::from(c == ')');
        }
        for entry in plain.split(',') {
            let mut words = entry.split_whitespace();
            let Some(name) = words.next() else { continue };
            crates.insert(name.to_owned(), words.next().map(str::to_owned));
        }
    }
    crates
}

/// Returns a sentence for each crate that one of both has, or has in another version.
fn differences(wanted: &Crates, described: &Crates) -> Vec<String> {
    let mut found = Vec::new();
    for (name, version) in wanted {
        match described.get(name) {
            None => found.push(format!("{name} is not described")),
            Some(Some(told)) => {
                let version = version.as_deref().unwrap_or_default();
                let is_of = version == told || version.starts_with(&format!("{told}."));
                if !is_of {
                    found.push(format!("{name} is {version}, and described as {told}"));
                }
            }
            Some(None) => {}
        }
    }
    let gone = described.keys().filter(|name| !wanted.contains_key(*name));
    found.extend(gone.map(|name| format!("{name} is described and not used")));
    found
}

#[test]
fn the_page_of_dependencies_has_every_crate_in_its_version() {
    let read = |path: &str| std::fs::read_to_string(path).expect(path);
    let found =
        differences(&wanted(&read("Cargo.toml")), &described(&read("docs/dependencies.md")));
    assert!(found.is_empty(), "docs/dependencies.md: {found:#?}");
}

#[test]
fn crates_that_are_missing_old_or_gone_are_told() {
    let manifest = "[dependencies]\na = \"1.2.3\"\nb = { version = \"=2.0.0-rc.15\" }\nc = \"0.4\"\n\
                    [dev-dependencies]\nd = \"5\"";
    let page = "| crate | for |\n|---|---|\n| `a` 1.2 (`x, y`) | it |\n| `b` 2.0.0-rc.15, `c` 0.3 | both |\n\
                | `e` | gone |\n";
    let found = differences(&wanted(manifest), &described(page));
    let expected =
        ["c is 0.4, and described as 0.3", "d is not described", "e is described and not used"];
    assert_eq!(found, expected);
}
