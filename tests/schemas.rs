//! `schemas/*.json` and `docs/tables.md` say what the code says; `UPDATE_SCHEMAS=1` rewrites them.

use std::path::{Path, PathBuf};

use motiongen::store::tables;

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn generated() -> Vec<(PathBuf, String)> {
    let tables = tables::all();
    let mut files: Vec<_> = tables
        .iter()
        .map(|table| {
            let json = serde_json::to_string_pretty(&table.to_json()).expect("JSON of strings");
            (root().join(format!("schemas/{}.json", table.name)), json + "\n")
        })
        .collect();
    let sections: Vec<_> = tables.iter().map(motiongen::store::TableSchema::to_markdown).collect();
    let text = format!(
        "# Tables\n\n\
         Every column of every table: type, unit and meaning. Generated from `src/store/tables.rs`; \
         the same is in `schemas/*.json` for programs.\n\n\
         A table is the rows of all parts that a commit names (`commits/<stage>/<key>.json`), less \
         those that a later commit supersedes; `motiongen query` resolves that. Each part carries \
         `motiongen.schema_version`, `motiongen.program`, `motiongen.params_hash` and \
         `motiongen.input_hash` in its Parquet key-value metadata.\n\n{}",
        sections.join("\n")
    );
    files.push((root().join("docs/tables.md"), text));
    files
}

#[test]
fn schema_files_and_table_docs_equal_the_code() {
    for (path, text) in generated() {
        if std::env::var_os("UPDATE_SCHEMAS").is_some() {
            std::fs::create_dir_all(path.parent().expect("a folder")).expect("folder made");
            std::fs::write(&path, &text).expect("file written");
        }
        let found = std::fs::read_to_string(&path).unwrap_or_default();
        assert_eq!(
            found,
            text,
            "{} is stale: run UPDATE_SCHEMAS=1 cargo test schemas",
            path.display()
        );
    }
}

#[test]
fn no_schema_file_is_left_over() {
    let known: Vec<_> = tables::all().iter().map(|t| format!("{}.json", t.name)).collect();
    for entry in std::fs::read_dir(root().join("schemas")).expect("schemas/") {
        let name = entry.expect("an entry").file_name().into_string().expect("UTF-8");
        assert!(known.contains(&name), "schemas/{name} belongs to no table");
    }
}
