//! The rooms use each other only as `docs/architecture.md` allows.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Which rooms a room may use.
const MAY_USE: [(&str, &[&str]); 22] = [
    ("units", &[]),
    ("audio", &["excerpt", "instructions", "units"]),
    ("autodiff", &["instructions", "model"]),
    ("chance", &[]),
    ("diffusion", &[]),
    ("evaluation", &["chance", "motion", "units"]),
    ("excerpt", &[]),
    ("generation", &["audio", "autodiff", "diffusion", "model", "motion", "onnx", "units"]),
    ("instructions", &[]),
    ("markup", &[]),
    ("model", &["audio", "motion", "units"]),
    ("motion", &["chance", "excerpt", "units"]),
    ("music", &["audio", "chance"]),
    ("onnx", &["audio", "model", "motion"]),
    ("plot", &["markup", "motion", "units"]),
    ("report", &["markup"]),
    ("store", &["audio", "motion", "units"]),
    (
        "training",
        &["audio", "autodiff", "diffusion", "model", "motion", "store", "units", "weights"],
    ),
    ("view", &["markup", "motion", "units"]),
    ("weights", &["autodiff", "model"]),
    (
        "stages",
        &[
            "audio",
            "autodiff",
            "diffusion",
            "evaluation",
            "generation",
            "model",
            "motion",
            "music",
            "onnx",
            "plot",
            "report",
            "store",
            "training",
            "units",
            "view",
            "weights",
        ],
    ),
    ("cli", &["stages"]),
];

/// Crates that only one place may name: crate, where.
const KEPT_TO: [(&str, &str); 20] = [
    ("polars", "store/query"),
    ("sqlparser", "store/sql.rs"),
    ("object_store", "store/"),
    ("parquet", "store/"),
    ("arrow_array", "store/"),
    ("symphonia", "audio/"),
    ("opus_pure", "audio/"),
    ("realfft", "audio/"),
    ("rustfft", "audio/"),
    ("tiny_skia", "plot/"),
    ("ab_glyph", "plot/"),
    ("indicatif", "cli/"),
    ("signal_hook", "cli/"),
    ("rayon", "autodiff/"),
    ("safetensors", "weights.rs"),
    ("ort", "onnx/"),
    ("rustysynth", "music/"),
    ("pathfinding", "motion/group/"),
    ("prost", "onnx/"),
    ("mpi", "training/ranks/"),
];

fn walk(folder: &Path, found: &mut BTreeMap<PathBuf, String>) {
    for entry in std::fs::read_dir(folder).expect("a folder of sources") {
        let path = entry.expect("an entry").path();
        if path.is_dir() {
            walk(&path, found);
        } else if path.extension().is_some_and(|e| e == "rs") {
            found.insert(path.clone(), std::fs::read_to_string(&path).expect("UTF-8"));
        }
    }
}

fn sources() -> BTreeMap<PathBuf, String> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut found = BTreeMap::new();
    walk(&root, &mut found);
    found
        .into_iter()
        .map(|(path, text)| (path.strip_prefix(&root).expect("in src").into(), text))
        .collect()
}

/// Returns the code of a file without comments, in which rooms and crates are only talked about.
fn code(text: &str) -> impl Iterator<Item = (usize, &str)> {
    text.lines().enumerate().filter(|(_, line)| !line.trim_start().starts_with("//"))
}

fn room_of(path: &Path) -> String {
    let first = path.components().next().expect("a component").as_os_str().to_string_lossy();
    first.trim_end_matches(".rs").to_owned()
}

#[test]
fn rooms_use_only_the_rooms_that_they_may() {
    let mut n_uses = 0;
    for (path, text) in sources() {
        let room = room_of(&path);
        if room == "lib" || room == "bin" {
            continue;
        }
        let (_, allowed) = MAY_USE
            .iter()
            .find(|(name, _)| *name == room)
            .unwrap_or_else(|| panic!("{}: room {room} is not in MAY_USE", path.display()));
        for (i, line) in code(&text) {
            for (at, _) in line.match_indices("crate::") {
                if line[..at].ends_with('$') {
                    continue;
                }
                let used: String = line[at + 7..]
                    .chars()
                    .take_while(|c| c.is_alphanumeric() || *c == '_')
                    .collect();
                n_uses += 1;
                assert!(
                    used == room || allowed.contains(&used.as_str()),
                    "src/{}:{}: {room} uses {used}; it may use {allowed:?}",
                    path.display(),
                    i + 1
                );
            }
        }
    }
    assert!(n_uses > 20, "only {n_uses} uses were seen: the test reads the wrong lines");
}

/// Returns whether a line speaks of a crate: its name before `::` or after `use`, and not the end of another.
fn names(line: &str, name: &str) -> bool {
    let is_whole = |at: usize| {
        let before = line[..at].chars().next_back();
        !before.is_some_and(|c| c.is_alphanumeric() || c == '_')
    };
    line.match_indices(&format!("{name}::")).any(|(at, _)| is_whole(at))
        || line.contains(&format!("use {name};"))
}

#[test]
fn some_crates_are_named_in_one_place_only() {
    for (name, place) in KEPT_TO {
        let uses: Vec<_> = sources()
            .into_iter()
            .filter(|(_, text)| code(text).any(|(_, line)| names(line, name)))
            .map(|(path, _)| path.to_string_lossy().into_owned())
            .collect();
        assert!(!uses.is_empty(), "{name} is used nowhere: is this list out of date?");
        for path in uses {
            assert!(path.starts_with(place), "src/{path} names {name}; only src/{place} may");
        }
    }
}

#[test]
fn only_the_command_line_prints_and_only_the_kernel_is_unsafe() {
    for (path, text) in sources() {
        let is_cli = path.starts_with("cli");
        // `Element` declares the tile that the kernel implements; the choice of instructions is shared.
        let is_kernel = path.starts_with("autodiff/kernel")
            || path == Path::new("autodiff/element.rs")
            || path == Path::new("instructions.rs");
        for (i, line) in code(&text) {
            let prints = ["println!", "eprintln!", "print!(", "eprint!(", "dbg!("]
                .iter()
                .any(|word| line.contains(word));
            assert!(is_cli || !prints, "src/{}:{}: prints; only cli may", path.display(), i + 1);
            assert!(
                is_kernel || !line.contains("unsafe "),
                "src/{}:{}: unsafe is kept to one measured kernel module",
                path.display(),
                i + 1
            );
        }
    }
}

/// Folders of Rust code.
const CODE: [&str; 4] = ["src", "tests", "benches", "fuzz/fuzz_targets"];
/// A file beyond this has a second subject, which goes into a file named after it.
const MAX_LINES: usize = 500;
const MAX_MEDIAN_LINES: usize = 165;

#[test]
fn no_file_has_more_than_500_lines_and_the_median_stays_small() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let mut found = BTreeMap::new();
    for folder in CODE {
        walk(&root.join(folder), &mut found);
    }
    let mut sizes: Vec<usize> = Vec::with_capacity(found.len());
    for (path, text) in found {
        let path = path.strip_prefix(root).expect("in the folder").to_string_lossy().into_owned();
        let n_lines = text.lines().count();
        assert!(
            n_lines <= MAX_LINES,
            "{path} has {n_lines} lines: move its second subject to a file named after it"
        );
        sizes.push(n_lines);
    }
    sizes.sort_unstable();
    assert!(sizes.len() > 500, "only {} files were seen", sizes.len());
    let median = sizes[sizes.len() / 2];
    assert!(median <= MAX_MEDIAN_LINES, "half of all files have {median} lines or more");
}
